"""The help of every command, as a new user reads it."""

from __future__ import annotations

import re
import shlex
from typing import Any

import pytest
from rich.text import Text
from typer.main import get_command
from typer.testing import CliRunner

from scm_world.cli.app import app

GROUP: Any = get_command(app)


@pytest.mark.parametrize("name", ["", *GROUP.commands])
def test_help_has_an_example_of_existing_options(name: str) -> None:
    """The example is one of this command."""
    words = [name] if name else []
    shown = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0, shown.output
    command = GROUP.commands[name] if name else GROUP
    (example,) = re.findall(r"Example: (scm-world [^\n]+)", " ".join(command.help.split()))
    _, called, *rest = shlex.split(example.rstrip("."))
    known = {flag for option in GROUP.commands[called].params for flag in option.opts}
    assert called == name or not name
    assert {word for word in rest if word.startswith("-")} <= known


def test_every_option_has_a_help_text() -> None:
    """It is shown as it is written: no unit in brackets is taken for a style."""
    for name, command in GROUP.commands.items():
        for option in command.params:
            assert option.help, (name, option.name)
            assert Text.from_markup(option.help).plain == option.help
