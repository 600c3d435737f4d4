"""The commands that show what there is: ``graph``, ``variables`` and ``list``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from enum import StrEnum
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from scm_world.cli import console, options
from scm_world.cli.arguments import load_system, suffix, tag
from scm_world.errors import UnknownOption

if TYPE_CHECKING:
    from scm_world.graph import SCM
    from scm_world.variables import Variable

KIND_STYLE = {"exogenous": "yellow", "derived": "green", "measured": "blue", "action": "magenta"}
LONG = 80  # [characters] what is longer is written once
HEADINGS = ("variable", "unit", "shape", "role", "default", "possible", "A", "B", "follows", "")
DO = {
    "parameter": "holds until the reset",
    "state": "is set at this instant; physics carries it on",
    "readout": "is not possible; intervene on a cause",
    "action": "takes the place of the policy's command until the reset",
}
"""What ``do`` means for each role."""


class Format(StrEnum):
    """How a graph is written down."""

    TABLE = "table"
    DOT = "dot"
    JSON = "json"
    PNG = "png"
    HTML = "html"
    GML = "gml"
    GRAPHML = "graphml"
    NODE_LINK = "node-link"
    DAGITTY = "dagitty"
    CSV = "csv"


def _model(name: str, option: Sequence[str] | None, **settings: str | None) -> SCM:
    """Return the declared causal model of a system; no physics engine is loaded."""
    from scm_world.graph import SCM
    from scm_world.queries import World

    made = load_system(name, option)
    if isinstance(made, SCM):
        return made
    with World(made, backend="fake", **settings) as world:  # type: ignore[arg-type]
        return world.model


def graph(
    task: options.System,
    format_: Annotated[
        Format | None,
        typer.Option(
            "--format",
            help="How to write it; without it the ending of --out says so.",
            show_default="table",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File to write to.")] = None,
    action_mode: Annotated[
        str | None,
        typer.Option(
            help="Of the TriFinger: joint_positions, joint_torques or end_effector_positions.",
            show_default="joint_positions",
        ),
    ] = None,
    option: options.Option = None,
    resolution: options.Resolution = None,
) -> None:
    """Show the declared causal graph of a system.

    Example: scm-world graph pushing --out graph.html
    """
    from scm_world.graph import to_json
    from scm_world.graph.exchange import causal_graph, to_html, write_graph

    if format_ is None:
        ending = "" if out is None else out.suffix.lower().removeprefix(".")
        if ending not in {*Format, "", "txt"}:
            raise UnknownOption("format of a graph", ending, tuple(Format))
        format_ = Format(ending) if ending in {*Format} else Format.TABLE
    if format_ is Format.PNG and out is None:
        out = Path(f"{tag(task)}{suffix(option or ())}-graph.png")
    if out is not None:
        console.check_writable(out, folder=False)
    model = _model(task, option, action_mode=action_mode, resolution=resolution)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
    title = f"{tag(task)}, as it is declared"
    page = StringIO()
    match format_:
        case Format.PNG if out is not None:
            from scm_world.discovery.plots import draw_model

            draw_model(model, out, title=title)
        case Format.TABLE:
            console.terminal(file=None if out is None else page, width=console.PAGE).print(
                _parents_table(model)
            )
        case Format.JSON:
            page.write(to_json(model) + "\n")
        case Format.HTML:
            page.write(to_html(causal_graph(model), title=title) + "\n")
        case _:
            page.write(write_graph(model, format=format_.value) + "\n")
    if out is None:
        typer.echo(page.getvalue(), nl=False)
        return
    if format_ is not Format.PNG:
        out.write_text(page.getvalue(), encoding="utf-8")
    console.say(f"written: {out}", stderr=True)


def _parents_table(model: SCM) -> Table:
    """Return one row per variable; rows that differ in a number of the name only become one."""
    from scm_world.discovery.names import braces, by_entity
    from scm_world.graph.exchange import space_lines

    made = console.table(
        *("variable", "kind", "unit", "shape", "default", "A", "B", "parents"),
        title=f"{len(model)} variables, {len(model.edges)} edges",
        whole=(0,),
    )
    alike: dict[tuple[str, ...], list[str]] = {}
    for variable in model.variables:
        given: Any = variable
        parents = []
        for lag in (0, 1):
            here = {parent.name for parent in variable.all_parents if parent.lag == lag}
            if here:
                short = by_entity(name for name in model if name in here)
                parents.append(f"lag {lag}: {', '.join(short)}")
        default = getattr(given, "value" if given.kind == "fixed" else "default", None)
        if given.kind == "measured" and given.start is not None:
            text = "follows lag 0"
        else:
            text = "" if default is None else console.show(default)
        cells = (
            given.kind if given.kind == variable.role else f"{given.kind}\n{variable.role}",
            variable.unit,
            "x".join(map(str, variable.shape)) or "-",
            text,
            "\n".join(space_lines(variable.a)),
            "\n".join(space_lines(variable.b)),
            "\n".join(parents),
        )
        alike.setdefault(cells, []).append(variable.name)
    first: dict[str, str] = {}  # the variable at which a long list of parents is written out
    for (kind, *rest, links), names in alike.items():
        for name in braces(names):
            lines = links.splitlines()
            for number, line in enumerate(lines):
                like = first.setdefault(line, name)
                if like != name and len(line) >= LONG:
                    lines[number] = f"{line.partition(':')[0]}: same as {like}"
            style = KIND_STYLE.get(kind.partition("\n")[0], "")
            shown = map(Text, (*rest, "\n".join(lines)))
            made.add_row(Text(name, style="bold"), Text(kind, style=style), *shown)
    return made


def variables(
    task: options.Systems,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Write the tables of all tasks as Markdown.")
    ] = False,
    option: options.Option = None,
) -> None:
    """Show every variable of a system: unit, role, default, and the spaces A and B.

    A is the training support, B the held-out one.
    Example: scm-world variables pushing
    """
    from scm_world.tasks import TASKS

    if markdown:
        typer.echo(variables_page(), nl=False)
        return
    for title, rows in _sections(tuple(TASKS) if task == "all" else (task,), option):
        made = console.table(*HEADINGS[:5], "A", "B", title=title)
        for name, unit, shape, role, default, _, a, b, *_ in rows:
            made.add_row(Text(name), unit, shape, role, default, a, b)
        console.terminal().print(made)


def variables_page() -> str:
    """Return the tables of all tasks as Markdown: the text of ``docs/variables.md``."""
    from scm_world.tasks import TASKS

    lines = [
        "# Variables",
        "",
        "Every variable of every task, as it is declared; written by `scm-world variables all "
        "--markdown`. The tables show the structure that each task begins with; `F` stands for a "
        "finger (60, 120, 300) and `N` for a number. *Possible* is what physics allows; A is the "
        "training space and B the held-out one. *Follows* lists the causes: one control step "
        "earlier for states, at once for everything else; `(set)` marks a cause that acts when "
        "something is set, and *contacts* stands for every physical quantity of the world.",
        "",
        "What `do` means depends on the role:",
        "",
        *(f"* **{role}**: {meaning}." for role, meaning in DO.items()),
        "",
    ]
    for title, rows in _sections(TASKS):
        lines += [f"## {title}", "", "| " + " | ".join(HEADINGS) + " |"]
        lines += ["|" + "---|" * len(HEADINGS)]
        lines += ["| " + " | ".join((f"`{name}`", *cells)) + " |" for name, *cells in rows]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _sections(
    systems: Iterable[str], option: Sequence[str] | None = None
) -> Iterator[tuple[str, list[tuple[str, ...]]]]:
    """Yield the rows that all systems have in common, then what each has besides."""
    found = {
        name: list(dict.fromkeys(map(_row, _model(name, option).variables))) for name in systems
    }
    common = [row for row in next(iter(found.values())) if all(row in f for f in found.values())]
    if len(found) > 1:
        yield "every task", common
    for name, rows in found.items():
        yield name, [row for row in rows if len(found) == 1 or row not in common]


def _row(variable: Variable) -> tuple[str, ...]:
    """Describe a variable; those that differ in the numbers of their names only are alike."""
    from scm_world.graph.exchange import space_lines
    from scm_world.variables import Derived, Exogenous, Fixed, Measured, names

    default, causes = "", list[str]()
    match variable:
        case Exogenous(default=value) | Fixed(value=value):
            default = _numbers(value)
        case Measured(default=value, start=None) if value is not None:
            default = _numbers(value)
    if isinstance(variable, Measured) and variable.mechanism is None:
        chosen = [p for p in variable.parents if p.when != "contact"]
        causes = [f"{p.name}{' (set)' if p.when == 'set' else ''}" for p in chosen] + ["contacts"]
    elif isinstance(variable, Derived | Measured):
        causes = list(names(variable.all_parents))
    causes = list(dict.fromkeys(map(_pattern, causes)))
    spaces = (variable.bounds, variable.a, variable.b)
    cells = (
        variable.name,
        "" if variable.unit == "1" else variable.unit,
        "×".join(map(str, variable.shape)),
        "constant" if isinstance(variable, Fixed) else variable.role,
        default,
        *(", ".join(space_lines(space, digits=6)) for space in spaces),
        ", ".join(causes[:8]) + (", …" if len(causes) > 8 else ""),
        variable.doc,
    )
    return tuple(map(_pattern, cells))


def _pattern(text: str) -> str:
    text = re.sub(r"(finger_|goal_)(60|120|300)(?=_|\b)", r"\1F", text)
    return re.sub(r"(level|col|row|num|tool|goal|block|obstacle)_\d+", r"\1_N", text)


def _numbers(value: object) -> str:
    flat = [f"{x:.6g}" for x in np.ravel(np.asarray(value, dtype=float))]
    if len(flat) > 1 and len(set(flat)) == 1:
        return f"{flat[0]} each"
    return ", ".join(flat) if len(flat) <= 12 else f"{len(flat)} numbers"


def list_(
    zoo: Annotated[
        bool, typer.Option("--zoo", help="List the trained policies of the package instead.")
    ] = False,
) -> None:
    """List tasks, backends, presets, learners, protocols, environments and trained policies.

    Example: scm-world list --zoo
    """
    from scm_world.backends import backends, make_backend
    from scm_world.discovery.learners import learners
    from scm_world.discovery.problems import FAMILIES
    from scm_world.env import IDS
    from scm_world.errors import EngineError
    from scm_world.evaluation import protocols_of
    from scm_world.policies import zoo as policies
    from scm_world.tasks import CONVENTIONS, TASKS
    from scm_world.tasks.trifinger.entities.robot import ACTIONS
    from scm_world.tasks.trifinger.hardware import PRESETS

    if zoo:
        made = console.table("name", "task", "seed", "scores", "command", title="trained policies")
        for name, about in policies.zoo().items():
            seed, command = about.card.get("seed", ""), about.card.get("command", "")
            cells = (name, about.task, seed, policies.best_known(about), command)
            made.add_row(*(Text(str(cell)) for cell in cells))
        nothing = "there are no trained policies in this installation"
        console.terminal().print(made if made.row_count else nothing)
        return

    def first_line(text: str | None) -> str:
        return (text or "").strip().partition("\n")[0]

    engines: dict[str, str | Text] = {}
    for name in backends():
        try:
            backend = make_backend(name)
        except EngineError as error:
            engines[name] = Text(f"not available: {error}", style="yellow")
        else:
            engines[name] = Text(f"available, version {backend.version}", style="green")
            backend.close()
    algorithms = {
        name: f"{one.doc} ({', '.join(one.takes)}"
        + ("" if one.is_installed else f"; needs the extra {one.extra!r}")
        + ")"
        for name, one in learners().items()
    }
    protocols = {p.name: p.doc for p in protocols_of("pushing")}
    for protocol in protocols_of("reaching"):
        protocols.setdefault(protocol.name, f"{protocol.doc}; reaching only")
    trained = {
        name: ": ".join(filter(None, (about.task, policies.best_known(about))))
        for name, about in policies.zoo().items()
    }
    sections: dict[str, Any] = {
        "tasks": {name: first_line(made.__doc__) for name, made in TASKS.items()},
        "backends": engines,
        "presets": {p.name: f"physics steps of {1000 * p.timestep:g} ms" for p in PRESETS.values()},
        "action modes": {name: unit for name, (unit, _) in ACTIONS.items()},
        "conventions": dict.fromkeys(CONVENTIONS, ""),
        "learners": algorithms,
        "protocols": protocols,
        "trained policies": trained,
        "families": {f"{name}:N": first_line(draw.__doc__) for name, draw in FAMILIES.items()},
        "environments": {name: f"gymnasium.make({name!r})" for name in IDS},
    }
    shown = console.table("", "name", "")
    shown.show_header = False
    for title, rows in sections.items():
        for number, (name, about) in enumerate(rows.items()):
            cell = about if isinstance(about, Text) else Text(about)
            shown.add_row(Text("" if number else title, style="bold"), name, cell)
        shown.add_section()
    console.terminal().print(shown)
