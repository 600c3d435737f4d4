"""Running the code of other libraries without being disturbed by it."""

from __future__ import annotations

import random
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO

import numpy as np

from scm_world.errors import ModelError, ScmWorldError


@contextmanager
def borrowed(learner: str, seed: int) -> Iterator[None]:
    """Run what another library does: seeded, silent, and with its complaints in our words.

    Some libraries draw from the global generators. They are seeded here and put back afterwards, so
    that the result depends on the seed alone and the caller notices nothing.

    Args:
        learner: Its name, for the message.
        seed: Of both global generators.

    Raises:
        ModelError: The library cannot do it with these data.
    """
    python = random.getstate()
    numpy = np.random.get_state()  # noqa: NPY002 # not ours: it is put back
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 # the libraries draw from this one
    try:
        with (
            redirect_stdout(StringIO()),
            redirect_stderr(StringIO()),
            warnings.catch_warnings(),
            np.errstate(all="ignore"),
        ):
            warnings.simplefilter("ignore")
            yield
    except ScmWorldError:
        raise
    except (ArithmeticError, AssertionError, IndexError, ValueError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ModelError(
            [f"the library behind {learner!r} cannot use these data: {said}; try fewer columns"]
        ) from error
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
