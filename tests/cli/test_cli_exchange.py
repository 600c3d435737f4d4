"""``scm-world graph`` in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from scm_world.cli.app import app
from scm_world.cli.inspection import Format
from scm_world.graph.exchange import FORMATS, CausalGraph, causal_graph, read_graph
from scm_world.world import World


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, ["graph", *arguments])


@pytest.fixture(scope="module")
def pushing() -> CausalGraph:
    """The graph that is shown."""
    return causal_graph(World("pushing", backend="fake").model)


def test_every_format_is_on_offer() -> None:
    """What can be written can be asked for."""
    assert {form.value for form in Format} == {"table", "json", "png", *FORMATS}


@pytest.mark.parametrize("form", ["gml", "graphml", "node-link"])
def test_what_is_printed_can_be_read(form: str, pushing: CausalGraph) -> None:
    """Formats with attributes give back the whole graph."""
    result = call("pushing", "--format", form)
    assert result.exit_code == 0, result.output
    assert read_graph(result.stdout, format=form) == pushing


def test_slices_are_put_together_again(pushing: CausalGraph, tmp_path: Path) -> None:
    """A format without time gives back names and lags, from a file, too."""
    form = "csv"
    file = tmp_path / "deep" / "graph.txt"
    result = call("pushing", "--format", form, "--out", str(file))
    assert (result.exit_code, result.stdout) == (0, "")
    found = read_graph(file, format=form)
    assert found.names == pushing.names
    assert [edge.key for edge in found.edges] == [edge.key for edge in pushing.edges]


def test_the_page_says_what_it_shows() -> None:
    """The picture is one page with every variable."""
    page = call("pushing", "--format", "html").stdout
    assert page.startswith("<!DOCTYPE html>")
    assert "<h1>pushing, as it is declared</h1>" in page
    assert page.count('class="n"') == 88
