"""Functions named on the command line: ``"module:function"`` or ``"file.py:function"``."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scm_world.errors import ModelError, ScmWorldError, UnknownOption, in_one_line


def load_factory(reference: str) -> Callable[..., Any]:
    """Import a function.

    Args:
        reference: ``"package.module:name"``, looked up in the present folder too, or
            ``"path/file.py:name"``.

    Raises:
        UnknownOption: There is no such module or file, or nothing of this name in it.
        ModelError: The module raised an error.
    """
    home, _, name = reference.rpartition(":")
    if home.endswith(".py"):
        path = Path(home)
        if not path.is_file():
            raise UnknownOption("task", reference, (f"a file that exists, not {home}",))
        module_name = f"scm_world_factory_{path.stem}"
        spec: Any = importlib.util.spec_from_file_location(module_name, path)
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module
        with blamed(home):
            spec.loader.exec_module(module)
    else:
        here = os.getcwd()
        added = here not in sys.path
        if added:
            sys.path.insert(0, here)
        try:
            with blamed(home):
                module = importlib.import_module(home)
        except ModelError as error:
            if isinstance(error.__cause__, ModuleNotFoundError):
                raise UnknownOption("task", reference, (f"a module: {error.__cause__}",)) from error
            raise
        finally:
            if added and here in sys.path:
                sys.path.remove(here)
    found = getattr(module, name, None)
    if not callable(found):
        offered = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise UnknownOption(f"function in {home}", name, offered)
    return found  # type: ignore[no-any-return]


@contextmanager
def blamed(reference: str) -> Iterator[None]:
    """Name the module or function of a user in the errors that it raises.

    Raises:
        ModelError: It raised an error that is none of this package.
    """
    try:
        yield
    except ScmWorldError:
        raise
    except Exception as error:
        raise ModelError([f"{reference} raised {in_one_line(error)}"]) from error
