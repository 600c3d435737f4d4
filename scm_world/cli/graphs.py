"""``scm-world graph``."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.text import Text

from scm_world.cli.console import PAGE, check_writable, console, keep_whole, show, table, written
from scm_world.cli.tasks import build, suffix, tag
from scm_world.discovery.names import braces, by_entity
from scm_world.graph import SCM, to_json
from scm_world.graph.exchange import causal_graph, space_lines, to_html, write_graph
from scm_world.variables import Variable
from scm_world.world import World

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

KIND_STYLE = {"exogenous": "yellow", "derived": "green", "measured": "blue", "action": "magenta"}
LONG = 80  # [characters] what is longer is written once


def run(
    task: str,
    format_: str,
    out: Path | None,
    action_mode: str | None,
    arguments: Sequence[str] = (),
    resolution: str | None = None,
) -> None:
    """Write the declared graph of a task."""
    if format_ == "png" and out is None:
        out = Path(f"{tag(task)}{suffix(arguments)}-graph.png")
    if out is not None:
        check_writable(out, folder=False)
    made = build(task, arguments)
    world = World(made, backend="fake", action_mode=action_mode, resolution=resolution)
    if out is None:
        _to_terminal(world, format_)
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    if format_ == "png":
        from scm_world.discovery.plots import draw_model

        draw_model(world.model, out, title=f"{tag(task)}, as it is declared")
    else:
        out.write_text(_text(world, format_), encoding="utf-8")
    written(console(stderr=True), out)


def _to_terminal(world: World, format_: str) -> None:
    if format_ == "table":
        _print(console(width=PAGE), world.model)
    else:
        typer.echo(_text(world, format_), nl=False)


def _text(world: World, format_: str) -> str:
    match format_:
        case "json":
            return to_json(world.model) + "\n"
        case "html":
            title = f"{world.task.name}, as it is declared"
            return to_html(causal_graph(world.model), title=title) + "\n"
        case "table":
            page = io.StringIO()
            _print(console(file=page, width=PAGE), world.model)
            return page.getvalue()
    return write_graph(world.model, format=format_) + "\n"


def _print(terminal: Console, model: SCM) -> None:
    terminal.print(keep_whole(describe(model), terminal, 0))


def describe(model: SCM) -> Table:
    """Write one row per variable; rows that differ in a number of the name only become one."""
    title = f"{len(model)} variables, {len(model.edges)} edges"
    headers = ("variable", "kind", "unit", "shape", "default", "A", "B", "parents")
    made = table(*headers, title=title)
    rows: dict[tuple[str, ...], list[str]] = {}
    for variable in model.variables:
        rows.setdefault(_row(model, variable), []).append(variable.name)
    order = {name: number for number, name in enumerate(model)}
    written_out: dict[str, str] = {}
    for row, names in sorted(rows.items(), key=lambda entry: order[entry[1][0]]):
        for short in braces(names):
            kind, *cells, parents = row
            style = KIND_STYLE.get(kind.partition("\n")[0], "")
            lines = [_once(line, short, written_out) for line in parents.splitlines()]
            about = map(Text, (*cells, "\n".join(lines)))
            made.add_row(Text(short, style="bold"), Text(kind, style=style), *about)
    return made


def _once(line: str, name: str, written_out: dict[str, str]) -> str:
    """Write a long list of parents once, and refer to it afterwards."""
    first = written_out.setdefault(line, name)
    lag = line.partition(":")[0]
    return line if first == name or len(line) < LONG else f"{lag}: same as {first}"


def _row(model: SCM, variable: Variable) -> tuple[str, ...]:
    given: Any = variable
    kind = given.kind if given.kind == variable.role else f"{given.kind}\n{variable.role}"
    shape = "x".join(map(str, variable.shape)) or "-"
    return (
        kind,
        variable.unit,
        shape,
        _default(given),
        "\n".join(space_lines(variable.a)),
        "\n".join(space_lines(variable.b)),
        "\n".join(_parents(model, variable)),
    )


def _default(variable: Any) -> str:
    if variable.kind == "fixed":
        return show(variable.value)
    if getattr(variable, "start", None) is not None and variable.kind == "measured":
        return "follows lag 0"
    if variable.kind in ("exogenous", "measured") and variable.default is not None:
        return show(variable.default)
    return ""


def _parents(model: SCM, variable: Variable) -> list[str]:
    """Write one line per lag, with the parents in the order of the model."""
    found = []
    for lag in (0, 1):
        names = {parent.name for parent in variable.all_parents if parent.lag == lag}
        if names:
            short = by_entity(name for name in model if name in names)
            found.append(f"lag {lag}: {', '.join(short)}")
    return found
