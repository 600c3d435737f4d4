"""Facts about commands that change or show what stands in a world."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from scm_world.cli.app import app

RUNNER = CliRunner()


def test_a_do_may_change_what_there_is(tmp_path: Path) -> None:
    """Blocks that come and go are named, and what is there before and after is compared."""
    words = ["do", "towers", "number_of_blocks_in_tower=1,1,4", "--backend", "fake"]
    done = RUNNER.invoke(app, [*words, "--steps", "2", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "gone: tool_level_4_col_0_row_0" in done.output
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["went"] == ["tool_level_4_col_0_row_0"]
    assert "tool_level_4_col_0_row_0.mass" not in result["variables"]
    assert result["variables"]["tool_level_0_col_0_row_0.size"]["moved"]


def test_every_variable_is_shown() -> None:
    """The table of a task has each name once, with its default and its spaces."""
    done = RUNNER.invoke(app, ["variables", "reaching"], env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    for name in ("number_of_obstacles", "torque_limit", "camera_60.field_of_view"):
        assert name.replace("_60", "_") in done.output or name in done.output


def test_the_markdown_is_that_of_the_docs() -> None:
    """``--markdown`` writes what stands in ``docs/variables.md``."""
    done = RUNNER.invoke(app, ["variables", "all", "--markdown"])
    page = Path(__file__).parents[2] / "docs" / "variables.md"
    assert done.output == page.read_text()
