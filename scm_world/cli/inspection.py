"""The commands that show what there is: ``graph``, ``variables`` and ``list``."""

from __future__ import annotations

from contextlib import closing
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import typer

from scm_world.cli import console, options
from scm_world.cli.arguments import load_system, tag
from scm_world.errors import UnknownOption, UnreadableFile

ELEMENTS = 4
"""How many elements with a hidden attribute are named."""

Format = Literal["table", "json", "png", "graphml"]
"""How a graph is written down."""


def _declared(made: Any, **settings: str | None) -> Any:
    """Return the declared causal model of a task, or of equations; no physics engine is loaded."""
    from scm_world.graph import SCM
    from scm_world.queries import World

    if isinstance(made, SCM):
        return made
    given: Any = settings  # checked by the world
    with World(made, backend="fake", **given) as world:
        return world.model


def graph(
    task: options.System,
    *,
    format_: Annotated[
        Format | None, typer.Option(show_default="table or the ending of --out")
    ] = None,
    out: Path | None = None,
    strength: Path | None = None,
    at_least: options.Amount = 0.0,
    fold: Annotated[bool | None, typer.Option("--fold/--unfold", show_default="if large")] = None,
    action_mode: options.Text = None,
    option: options.Pairs = None,
    resolution: options.Text = None,
) -> None:
    """Show the declared causal graph of a system.

    A picture with more than 64 nodes is folded: quantities of a kinematic tree are one node.
    Example: scm-world graph pushing --out graph.png

    Args:
        format_: How to write it.
        out: File to write to.
        strength: The edges.csv that verify or discover wrote: strong edges are drawn thick.
        fold: Fold a picture, whether it is large or not.
        action_mode: Action mode of the TriFinger: joint_positions, joint_torques or
            end_effector_positions.
    """
    from scm_world.graph import to_digraph, to_json

    sizes = {} if strength is None else _strengths(strength)
    if at_least and strength is None:
        remedy = "left out, or with --strength edges.csv, which verify and discover write"
        raise UnknownOption("--at-least", at_least, (remedy,))
    formats = get_args(Format)
    ending = "" if out is None else out.suffix.lower().removeprefix(".")
    if format_ is None and ending not in {*formats, "", "txt"}:
        raise UnknownOption("format of a graph", ending, formats)
    how = format_ or (ending if ending in formats else "table")
    if sizes and how == "json":
        raise UnknownOption("--format with --strength", how, [f for f in formats if f != how])
    if how == "png" and out is None:
        out = Path("-".join((tag(task), *(option or ()), "graph.png")))
    if out is not None:
        console.writable(out, is_folder=False)
    made = load_system(task, option)
    model = _declared(made, action_mode=action_mode, resolution=resolution)
    page, shown = StringIO(), to_digraph(model, strength=sizes, at_least=at_least)
    match how:
        case "table":
            edges = dict.fromkeys(shown.edges, "")
            title = f"{len(model)} variables, {len(edges)} edges"
            into = None if out is None else page
            console.edge_table(tuple(model), edges, title=title, file=into)
        case "json":
            page.write(to_json(model) + "\n")
        case "graphml":
            import networkx as nx

            page.write("\n".join(nx.generate_graphml(shown)) + "\n")
    if out is None:
        typer.echo(page.getvalue(), nl=False)
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    if how == "png":
        from scm_world.discovery.model_pictures import draw_model

        title = f"{tag(task)}, as it is declared"
        draw_model(model, out, title=title, folded=fold, strength=sizes, at_least=at_least)
    else:
        out.write_text(page.getvalue(), encoding="utf-8")
    console.say(f"written: {out}", stderr=True)


def _strengths(path: Path) -> dict[tuple[str, str, int], float]:
    """Read the strengths of edges from a table that ``verify`` or ``discover`` wrote."""
    import pandas

    remedy = "give the edges.csv that scm-world verify or discover wrote"
    try:
        found = pandas.read_csv(path)[["cause", "effect", "lag", "largest"]].dropna()
    except (OSError, ValueError, KeyError) as error:
        raise UnreadableFile(str(path), str(error), remedy) from None
    return {(cause, effect, int(lag)): size for cause, effect, lag, size in found.to_numpy()}


def variables(task: options.System, *, option: options.Pairs = None, all_: bool = False) -> None:
    """Show every variable of a system: role, unit, shape, default, and the spaces A and B.

    A is the training space, B the held-out one. "Possible" is what physics allows.
    Example: scm-world variables pushing

    Args:
        all_: Also list the attributes of a model that are no variables, with the pattern that
            exposes them, or the reason why they cannot be set.
    """
    import pandas

    def row(variable: Any) -> dict[str, Any]:
        default = getattr(variable, "value" if variable.kind == "fixed" else "default", None)
        starts = getattr(variable, "start", None) is not None
        spaces = {"possible": variable.bounds, "A": variable.a, "B": variable.b}
        return {
            "variable": variable.name,
            "role": variable.role,
            "unit": variable.unit,
            "shape": "x".join(map(str, variable.shape)) or "-",
            "default": "follows lag 0" if starts else console.show(default),
            **{name: "" if s is None else s.describe() for name, s in spaces.items()},
        }

    made = load_system(task, option)
    model = _declared(made)
    rows = pandas.DataFrame([row(variable) for variable in model.variables])
    console.frame(rows, title=f"{len(model)} variables")
    if not all_:
        return
    hidden = made.system.hidden() if hasattr(getattr(made, "system", None), "hidden") else []
    for one in hidden:
        names, more = one["elements"][:ELEMENTS], len(one["elements"]) - ELEMENTS
        one["elements"] = ", ".join(names) + f" and {more} more" * (more > 0)
    if hidden:
        console.frame(pandas.DataFrame(hidden), title="attributes that are no variables")
    else:
        console.say("no attributes but these")


def list_(*, zoo: bool = False) -> None:
    """List tasks, backends, presets, learners, protocols, environments and trained policies.

    Example: scm-world list --zoo

    Args:
        zoo: List the trained policies of the package instead.
    """
    import pandas

    from scm_world.backends import backends, make_backend
    from scm_world.discovery.learners import learners
    from scm_world.discovery.physics import PHYSICS
    from scm_world.discovery.problems import FAMILIES
    from scm_world.env import IDS
    from scm_world.errors import EngineError
    from scm_world.evaluation import protocols_of
    from scm_world.policies import zoo as policies
    from scm_world.tasks import CONVENTIONS, TASKS
    from scm_world.tasks.trifinger.entities.robot import ACTIONS
    from scm_world.tasks.trifinger.hardware import PRESETS

    trained = policies.zoo()
    if zoo:
        rows = [
            {
                "name": name,
                "task": one.task,
                "seed": one.card.get("seed", ""),
                "scores": policies.best_known(one),
                "command": one.card.get("command", ""),
            }
            for name, one in trained.items()
        ]
        console.frame(pandas.DataFrame(rows), title="trained policies")
        return

    def version_of(backend: str) -> str:
        try:
            with closing(make_backend(backend)) as made:
                return f"available, version {made.version}"
        except EngineError as error:
            return f"not available: {error}"

    def said_of(learner: Any) -> str:
        needs = "" if learner.is_installed else f"; needs the extra {learner.extra!r}"
        kind = "baseline: " * learner.baseline
        return f"{kind}{learner.doc} ({', '.join(learner.takes)}{needs})"

    protocols = {p.name: f"{p.doc}; reaching only" for p in protocols_of("reaching")}
    protocols |= {p.name: p.doc for p in protocols_of("pushing")}
    sections: dict[str, dict[str, str]] = {
        "tasks": {
            name: (made.__doc__ or "").strip().partition("\n")[0] for name, made in TASKS.items()
        },
        "backends": {name: version_of(name) for name in backends()},
        "presets": {p.name: f"physics steps of {1000 * p.timestep:g} ms" for p in PRESETS.values()},
        "action modes": {name: unit for name, (unit, _) in ACTIONS.items()},
        "conventions": dict.fromkeys(CONVENTIONS, ""),
        "learners": {name: said_of(one) for name, one in learners().items()},
        "protocols": protocols,
        "trained policies": {
            name: ": ".join(filter(None, (one.task, policies.best_known(one))))
            for name, one in trained.items()
        },
        "families": {f"{name}:N": family.doc for name, family in FAMILIES.items()}
        | {f"{name}:N": doc for name, doc in PHYSICS.items()},
        "environments": {name: f"gymnasium.make({name!r})" for name in IDS},
    }
    cells = [
        ("" if number else title, name, about)
        for title, entries in sections.items()
        for number, (name, about) in enumerate(entries.items())
    ]
    console.frame(pandas.DataFrame(cells, columns=["", "name", "about"]))
