"""``scm-world graph`` in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

import networkx as nx
from typer.testing import CliRunner, Result

from scm_world.cli.app import app
from scm_world.graph import to_digraph
from scm_world.world import Simulation


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, ["graph", *arguments])


def test_what_is_printed_can_be_read() -> None:
    """Networkx reads the whole graph."""
    result = call("pushing", "--format", "graphml")
    assert result.exit_code == 0, result.output
    found = nx.parse_graphml(result.stdout, force_multigraph=True)
    pushing = to_digraph(Simulation("pushing", backend="fake").model)
    assert dict(found.nodes(data=True)) == dict(pushing.nodes(data=True))
    assert set(found.edges()) == set(pushing.edges())


def test_a_file_is_written_into_new_folders(tmp_path: Path) -> None:
    """A file has what would be printed, and nothing is printed."""
    file = tmp_path / "deep" / "graph.txt"
    result = call("pushing", "--format", "graphml", "--out", str(file))
    assert (result.exit_code, result.stdout) == (0, "")
    assert file.read_text() == call("pushing", "--format", "graphml").stdout
