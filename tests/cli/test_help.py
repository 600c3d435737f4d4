"""The help of every command, as a new user reads it."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from typing import Any

import pytest
from rich.text import Text
from typer.main import get_command
from typer.testing import CliRunner

from scm_world.cli.app import app


def _commands(group: Any, *before: str) -> Iterator[tuple[str, Any]]:
    """Yield commands and groups by the words that call them."""
    for name, one in group.commands.items():
        yield " ".join((*before, name)), one
        if hasattr(one, "commands"):
            yield from _commands(one, *before, name)


GROUP: Any = get_command(app)
COMMANDS = dict(_commands(GROUP))


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_help_has_an_example_of_existing_options(name: str) -> None:
    """The example is one of this command."""
    shown = CliRunner().invoke(app, [*name.split(), "--help"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0, shown.output
    command = COMMANDS[name] if name else GROUP
    (example,) = re.findall(r"Example: scm-world ([^\n]+)", " ".join(command.help.split()))
    example = example.rstrip(".")
    called = max((one for one in COMMANDS if f"{example} ".startswith(f"{one} ")), key=len)
    known = {flag for option in COMMANDS[called].params for flag in option.opts}
    assert called.startswith(name)
    words = shlex.split(example.removeprefix(called))
    assert {word for word in words if word.startswith("-")} <= known


def test_every_option_has_a_help_text() -> None:
    """It is shown as it is written: no unit in brackets is taken for a style."""
    for name, command in COMMANDS.items():
        for option in () if hasattr(command, "commands") else command.params:
            assert option.help, (name, option.name)
            assert Text.from_markup(option.help).plain == option.help
