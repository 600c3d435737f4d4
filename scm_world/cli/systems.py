"""The commands about one system: its graph and variables, interventions, fits and the studio."""

from __future__ import annotations

import json
from contextlib import closing, nullcontext
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

import scm_world as sw
from scm_world._arguments import load, one_of
from scm_world.cli import console, options
from scm_world.cli.options import load_system, parse_assignments, parse_outcome, tag
from scm_world.errors import MissingExtra, ModelError, ScmWorldError, UnknownOption, UnreadableFile
from scm_world.runs.canvas import png
from scm_world.runs.files import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable

    from scm_world.backends import Backend
    from scm_world.graph import SCM
    from scm_world.queries.differences import Consequences
    from scm_world.tasks import WorldSource
    from scm_world.variables import Variable

ELEMENTS = 4
"""How many elements with a hidden attribute are named."""

Format = Literal["table", "json", "png", "graphml"]
"""How a graph is written down."""


# --- descriptions ---------------------------------------------------------------------------------


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
    formats, ending = get_args(Format), "" if out is None else out.suffix.lower()
    how = format_ or {"": "table", ".txt": "table"}.get(ending, ending.removeprefix("."))
    one_of("format of a graph", how, formats)
    if sizes and how == "json":
        raise UnknownOption("--format with --strength", how, [f for f in formats if f != how])
    picture = out or Path("-".join((tag(task), *(option or ()), "graph.png")))
    out = picture if how == "png" else out
    if out is not None:
        console.writable(out, is_folder=False)
    model = _declared(load_system(task, option), action_mode=action_mode, resolution=resolution)
    shown = to_digraph(model, strength=sizes, at_least=at_least)
    text: str | None = None
    match how:
        case "png":
            from scm_world.discovery.model_pictures import draw_model

            title = f"{tag(task)}, as it is declared"
            draw_model(model, picture, title=title, folded=fold, strength=sizes, at_least=at_least)
        case "table":
            edges, page = dict.fromkeys(shown.edges, ""), None if out is None else StringIO()
            title = f"{len(model)} variables, {len(edges)} edges"
            console.edge_table(tuple(model), edges, title=title, file=page)
            text = None if page is None else page.getvalue()
        case "json":
            text = to_json(model) + "\n"
        case "graphml":
            import networkx as nx

            text = "\n".join(nx.generate_graphml(shown)) + "\n"
    if out is None:
        typer.echo(text or "", nl=False)
        return
    if text is not None:
        write_whole(out, text)
    console.say(f"written: {out}", stderr=True)


def _declared(source: WorldSource, **settings: str | None) -> SCM:
    """Return the declared causal model of a source; no physics engine is loaded."""
    is_light = source.backend in (None, "step")  # it has no bodies
    given: dict[str, Any] = {} if source.backend is None else dict(settings)
    given |= {} if is_light else {"backend": "fake"}
    with sw.World(source, **given) as world:
        return world.model


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

    A is the training space, B the held-out one. "Possible" is the range that physics allows.
    Example: scm-world variables pushing

    Args:
        all_: Also list the attributes of a model that are no variables, with the pattern that
            exposes them, or the reason why they cannot be set.
    """

    def row(variable: Variable) -> dict[str, object]:
        default = getattr(variable, "default", getattr(variable, "value", None))
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

    source = load_system(task, option)
    model = _declared(source)
    console.frame((row(model[name]) for name in model), title=f"{len(model)} variables")
    if not all_:
        return
    hidden: list[Any] = getattr(getattr(source.made, "system", None), "hidden", list)()
    for one in hidden:
        names, more = one["elements"][:ELEMENTS], len(one["elements"]) - ELEMENTS
        one["elements"] = ", ".join(names) + f" and {more} more" * (more > 0)
    if hidden:
        console.frame(hidden, title="attributes that are no variables")
    else:
        console.say("no attributes but these")


def list_(*, zoo: bool = False) -> None:
    """List tasks, backends, presets, learners, protocols, environments and trained policies.

    What an installed package declares is listed with its name, and with its error if it fails.
    Example: scm-world list --zoo

    Args:
        zoo: List the trained policies of the package instead.
    """
    from scm_world.backends import known
    from scm_world.discovery.learners import Learner, learners
    from scm_world.env import IDS
    from scm_world.evaluation import protocols_of
    from scm_world.policies import zoo as policies
    from scm_world.tasks import CONVENTIONS, models, tasks
    from scm_world.tasks.families import FAMILIES, PHYSICS
    from scm_world.tasks.trifinger.entities.robot import ACTIONS
    from scm_world.tasks.trifinger.hardware import PRESETS

    trained = {name: (one, policies.best_known(one)) for name, one in policies.zoo().items()}
    if zoo:
        rows = [
            {
                "name": name,
                "task": one.task,
                "seed": one.card.get("seed", ""),
                "scores": scores,
                "command": one.card.get("command", ""),
            }
            for name, (one, scores) in trained.items()
        ]
        console.frame(rows, title="trained policies")
        return

    def version_of(make: Callable[[], Backend]) -> str:
        with closing(make()) as made:
            return f"available, version {made.version}"

    def first_line(made: Any) -> str:
        said = made.__doc__ if hasattr(made, "__name__") else repr(made)[:60]
        return (said or "").strip().partition("\n")[0]

    def said_of(learner: Learner) -> str:
        needs = "" if learner.is_installed else f"; needs the extra {learner.extra!r}"
        kind = "baseline: " * learner.baseline
        return f"{kind}{learner.doc} ({', '.join(learner.takes)}{needs})"

    protocols = {p.name: f"{p.doc}; reaching only" for p in protocols_of("reaching")}
    protocols |= {p.name: p.doc for p in protocols_of("pushing")}
    families = {**{name: family.doc for name, family in FAMILIES.items()}, **PHYSICS}
    sections: dict[str, dict[str, str]] = {
        "tasks": tasks().described(first_line),
        "models": models().described(first_line),
        "backends": known().described(version_of),
        "presets": {p.name: f"physics steps of {1000 * p.timestep:g} ms" for p in PRESETS.values()},
        "action modes": {name: unit for name, (unit, _) in ACTIONS.items()},
        "conventions": dict.fromkeys(CONVENTIONS, ""),
        "learners": learners().described(said_of),
        "protocols": protocols,
        "trained policies": {
            name: ": ".join(filter(None, (one.task, scores)))
            for name, (one, scores) in trained.items()
        },
        "families": {f"{name}:N": doc for name, doc in families.items()},
        "environments": {name: f"gymnasium.make({name!r})" for name in IDS},
    }
    cells = [
        {"": "" if number else title, "name": name, "about": about}
        for title, entries in sections.items()
        for number, (name, about) in enumerate(entries.items())
    ]
    console.frame(cells)


def studio(
    task: options.System = "pushing",
    *,
    host: str = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8700,
    open_: bool = False,
    opening: options.Opening,
) -> None:
    """Serve a page: the causal graph, interventions and the moving world side by side.

    It works without a network. Ctrl-C ends it.
    Example: scm-world studio pushing --open

    Args:
        host: Address to serve on; for one that other machines reach, the printed address has a
            token.
        port: Port to serve on; 0 for any that is free.
        open_: Open the page in the usual browser.
    """
    from scm_world.studio.spec import PipedProcess, Spec, session

    arguments = options.task_arguments(opening.option)
    spec = Spec(system=task, options=arguments, settings=opening.settings())
    with closing(PipedProcess(session, spec)) as first:  # imports and reads, too
        for package in ("starlette", "uvicorn", "websockets"):
            load(package, package, "studio")
        from scm_world.studio.server import serve

        serve(spec, first, host=host, port=port, open_=open_, say=console.say)


# --- interventions --------------------------------------------------------------------------------


def do(
    task: options.System,
    assignments: options.Assignments,
    *,
    steps: options.NotNegative = 25,
    space: options.Text = None,
    show_all: Annotated[bool, typer.Option("--all")] = False,
    asked: options.Asked,
) -> None:
    """Intervene on a system, and compare it with the same system without the intervention.

    Of a world, pictures before and after are written, too. Exits 1 if a variable moves that is no
    descendant of a target.
    Example: scm-world do pushing tool_block.mass=0.05 --steps 50

    Args:
        steps: Control steps to run afterwards.
        space: Refuse values outside this space: A (training support), B (held out) or 'A|B'.
        show_all: Show descendants that did not move, too.
    """
    from scm_world.queries import consequences

    request = parse_assignments(assignments)
    with asked.open("do", task) as (system, folder, engine):
        asked.settings(system, space)
        found = consequences(system, request, steps=steps, seed=asked.seed, space=space)  # type: ignore[arg-type] # it checks the space
        pictures = {} if system.backend is None else _pictures(found)
    audit, astray, steps = found.audit, found.astray, found.done.steps
    console.say(f"Intervention in {tag(task)} on {engine}, seed {asked.seed}:", audit, "")
    descendants = found.variables[found.variables["descendant"]]
    shown = descendants if show_all else descendants[descendants["moved"]]
    names = {"right_after": "right after", "after": f"after {steps} steps"}
    table = shown.drop(columns=["descendant", "moved"]).rename(columns=names)
    console.frame(table.rename_axis("descendant").reset_index(), title="Consequences")
    still = len(descendants) - int(descendants["moved"].sum())
    console.say(
        f"{still} of {len(descendants)} descendants did not move"
        + " (--all shows them)" * (still > 0 and not show_all)
    )
    others = f"the {len(found.variables) - len(descendants)} other variables did not move"
    wrong = f"MOVED WITHOUT A DECLARED PATH FROM A TARGET: {', '.join(astray)}."
    alarm = typer.style(f"{wrong} The graph is wrong.", bold=True, fg="white", bg="red")
    console.say(alarm if astray else others)
    result = asked.answer(
        *("do/1", task, engine),
        space=space,
        steps=steps,
        audit=audit.targets,
        **{part: getattr(audit, part) for part in ("followed", "engine", "came", "went")},
        variables=found.variables.to_dict("index"),
        moved_without_a_path=astray,
    )
    console.write(folder, {**pictures, "result.json": result})
    raise typer.Exit(int(bool(astray)))


def _pictures(found: Consequences) -> dict[str, bytes]:
    """Return a PNG of each scene, from the camera of the first; none of systems without bodies."""
    from scm_world.backends import renderer
    from scm_world.backends.step import StepModel

    before, after = found.plain.scene(0)[0], found.done.scene(found.done.steps)[0]
    if isinstance(before.structure, StepModel):
        return {}
    camera = renderer.scene_camera(before)
    return {
        f"{name}.png": renderer.png(renderer.picture(scene, camera, samples=2))
        for name, scene in (("before", before), ("after", after))
    }


def check(
    source: Annotated[str, typer.Argument(metavar="SYSTEM")],
    *,
    worlds: options.Count = 8,
    ranges: Path | None = None,
    by: Annotated[Literal["set", "reset"] | None, typer.Option(show_default="see sw.check")] = None,
    steps: options.Count = 25,
    resets: Annotated[int, typer.Option(min=4)] = 50,
    asked: options.Asked,
) -> None:
    """Check whether declared ranges of parameters are real: randomisation of many environments.

    Each range is changed in one world, in runs with equal noise and actions: does the state
    respond, at once, and do the others stay as they are? Does a second reset accumulate? A
    picture, a table and a report are written. Exits 1 if a fault is found.
    Example: scm-world check HalfCheetah-v5 --worlds 2

    Args:
        source: A system as of other commands; an environment of Gymnasium with MuJoCo models, such
            as HalfCheetah-v5; or module:name of a function that makes many environments.
        worlds: How many; of a function, those that it makes.
        ranges: JSON file of ranges by name: a list of two ends, or a text as of --nature: draw:A,
            draw:0.1,0.2 or scale:draw:0.5,1.5. By default the spaces A, or 0.8 to 1.2 times the
            usual fields of a MuJoCo model.
        by: How values change: set from outside, or at a reset, where environments draw them.
        steps: Control steps of a run.
        resets: Resets after which values are read, where environments draw them.
    """
    given = None if ranges is None else _ranges(ranges)
    folder = asked.folder("check", source, asked.backend or "")
    envs = _many(source, worlds, asked)
    with (
        closing(envs) if hasattr(envs, "close") else nullcontext(),
        console.progress("ranges") as tell,
    ):
        how: dict[str, Any] = {"by": by, "steps": steps, "resets": resets, "seed": asked.seed}
        found = sw.check(envs, given, progress=tell, **how)
    console.say(found, "")
    console.frame(found.table)
    files = {"report.json": found.to_json(), "ranges.csv": found.table.to_csv(index=False)}
    console.write(folder, {**files, "check.png": png(found.picture())})
    raise typer.Exit(int(bool(found.faults)))


def _ranges(path: Path) -> dict[str, Any]:
    """Read declared ranges."""
    remedy = 'give an object such as {"body_mass[torso]": "scale:draw:0.5,1.5"}'
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UnreadableFile(str(path), str(error), remedy) from None
    if not isinstance(found, dict):
        raise UnreadableFile(str(path), "it is not an object", remedy)
    read = options.parse_value
    how = {n: read(one, "'--ranges'") for n, one in found.items() if isinstance(one, str)}
    return found | how


def _many(source: str, count: int, asked: options.Asked) -> Any:
    """Make many environments."""
    import gymnasium

    from scm_world.tasks.sources import made_from

    if source in gymnasium.registry and not source.startswith("scm_world/"):
        try:
            return gymnasium.make_vec(source, count, vectorization_mode="sync")
        except ModuleNotFoundError as error:  # such as imageio, of gymnasium[mujoco]
            raise MissingExtra(error.name or source) from None
        except (ImportError, gymnasium.error.Error) as error:
            raise ModelError([f"{source} cannot be made: {error}"]) from None
    if ":" in source:
        made = made_from(source, options.task_arguments(asked.option))
        if not isinstance(made, sw.Task | sw.SCM):
            return made
    system = load_system(source, asked.option, asked.backend)
    return sw.World(system, num_worlds=count, **asked.settings(system))


def effect(
    task: options.System,
    outcome: Annotated[str, typer.Argument()],
    assignments: options.Assignments,
    *,
    versus: options.Pairs = None,
    n: Annotated[int, typer.Option("-n", min=2)] = 100,
    episodes: options.Varied,
    asked: options.Asked,
) -> None:
    """Estimate the average treatment effect of an intervention, with a 95 % interval.

    Units are paired: the same noise, with and without the intervention.
    Example: scm-world effect pushing reward floor_friction=0.3 --versus floor_friction=0.5

    Args:
        outcome: A variable at the end: name, or a component: name[2]; or HOW:name with change,
            mean, max, min, sum or first.
        versus: The other intervention; none by default.
        n: Number of units.
    """
    request, other = parse_assignments(assignments), parse_assignments(versus, "'--versus'")
    measured = parse_outcome(outcome)
    with asked.open("effect", task) as (system, folder, engine), console.progress("episodes") as at:
        how = {**episodes.setting(system), "n": n, "seed": asked.seed, "progress": at}
        found = system.effect(measured, do=request, versus=other, **how)
    console.say(f"{tag(task)} on {engine}, seed {asked.seed}, with its 95 % interval:", found)
    console.write(folder, {"effect.json": found.to_json() + "\n"})


def counterfactual(
    task: options.System,
    assignments: options.Assignments,
    *,
    at: options.NotNegative = 0,
    episodes: options.EpisodeOptions,
    asked: options.Asked,
) -> None:
    """Run an episode, and again with an intervention and the same noise; compare them.

    Both episodes are saved.
    Example: scm-world counterfactual pushing tool_block.mass=0.1 --at 5

    Args:
        at: Control step of the intervention.
    """
    from scm_world.queries import compare, save_episode

    request = parse_assignments(assignments)
    with asked.open("counterfactual", task) as (system, folder, engine):
        episode = system.rollout(**episodes.setting(system), seed=asked.seed)
        other = episode.counterfactual(request, at=at)
        apart = compare(episode, other)
    console.say(
        f"{tag(task)}, seed {asked.seed}: with the intervention at control step {at} (b), and "
        "without it (a)",
        apart,
    )
    result = asked.answer(
        *("counterfactual/1", task, engine),
        at=at,
        steps=episode.steps,
        variables=apart.variables.to_dict("index"),
        contacts=apart.contacts.to_dict("records"),
    )
    saved = {"episode": episode, "counterfactual": other}
    paths = [save_episode(one, folder / f"{name}.npz") for name, one in saved.items()]
    console.write(folder, {"difference.json": result}, *paths)


# --- recordings -----------------------------------------------------------------------------------


def _setups(given: list[str], n: int) -> list[dict[str, object]]:
    """Return the set-up of each of n recordings from texts ``number:name=value``."""
    found: list[dict[str, object]] = [{} for _ in range(n)]
    for text in given:
        number, colon, rest = text.partition(":")
        if not colon or not number.isdigit() or int(number) >= n:
            allowed = (f"0:name=value to {n - 1}:name=value, with the number of a recording",)
            raise UnknownOption("--setup", text, allowed)
        found[int(number)] |= parse_assignments([rest], "'--setup'")
    return found


def _predicted(found: sw.Fit, recording: str, names: dict[str, Any]) -> Any:
    """Predict a recording, which may lack renamed columns: those that were fitted have them."""
    from scm_world.fit.recordings import LACKING

    try:
        return found.predict(recording, **names)
    except UnknownOption as error:
        if error.option != LACKING:
            raise
        columns = {old: new for old, new in names["columns"].items() if old != error.value}
        return _predicted(found, recording, {**names, "columns": columns})


def fit(
    task: options.System,
    recordings: Annotated[list[str], typer.Argument(metavar="RECORDING...")],
    *,
    parameters: options.Words = None,
    noise: options.Pairs = None,
    window: options.NotNegative = 0,
    begins: Annotated[list[str] | None, typer.Option(metavar="rest|NAME=VALUE,SD")] = None,
    column: Annotated[list[str] | None, typer.Option(metavar="COLUMN=NAME")] = None,
    ignore: options.Words = None,
    setup: Annotated[list[str] | None, typer.Option(metavar="NUMBER:NAME=VALUE")] = None,
    symmetric: bool = False,
    thin: options.NotNegative = 0,
    held_out: options.Amount = 0.0,
    predict: options.Words = None,
    diagnose: bool = False,
    suggest: options.NotNegative = 0,
    steps: Annotated[int | None, typer.Option(min=2, show_default="the longest run's")] = None,
    limits: Annotated[list[str] | None, typer.Option(metavar="NAME=LOW,HIGH")] = None,
    do: options.Pairs = None,
    at: options.NotNegative = 0,
    run: options.NotNegative = 0,
    save: list[Path] | None = None,
    asked: options.Asked,
) -> None:
    """Fit parameters of a world to recordings: tables of time, commands and measurements.

    Without --parameters, each parameter is fitted alone, to find the one that accounts for the
    deviation. Exits 1 if the residuals are larger than the noise: nothing fitted explains them.
    Ctrl-C writes the best values so far, without what was asked of the fit (exit code 130).
    Example: scm-world fit arm.xml run.csv --parameters "*.damping" --noise elbow.position=0.001

    Args:
        recordings: Tables of text (with commas, semicolons or tabs), Parquet or npz files with the
            time in seconds, every command, and any states or readouts; ROS bags, or LeRobot
            datasets; they are fitted together.
        parameters: Fitted parameter, such as '*.damping', upper_arm.mass or delay.
        noise: Standard deviation of a measurement; estimated by default.
        window: Used rows of a window, which begins in a fitted state; 0 for 50, or 10 where only
            these explain the recording.
        begins: How the recordings begin: 'rest', or a state with its standard deviation, such as
            '*.velocity=0,0.01'; fitted by default.
        column: Name of this system for a column of the files, such as torque=motor.control, if need
            be with its unit after it in brackets.
        ignore: Columns that are left out, such as 'temperature*'.
        setup: Value of a parameter that was set for a recording, such as 1:weight.mass=1.0; the
            first recording has the number 0.
        symmetric: Whether fitted ranges [-a, a] stay symmetric.
        thin: Every which row is used, 1 for all; 0 for as many as the motion needs.
        held_out: Share of the rows at the end of each run that are predicted, not fitted.
        predict: Another recording, which is predicted by the fit and by the unfitted world.
        diagnose: Whether to try standard terms that the system lacks, such as backlash or the lag
            of a sensor, on what the fit leaves; Ctrl-C ends it with those that were tried.
        suggest: Number of further experiments that are suggested; their commands are written.
        steps: Control steps of a suggested experiment.
        limits: Range that suggested experiments keep, such as '*.velocity=-2,2', besides those of
            commands and joints.
        do: Intervention on a recorded run: its counterfactual measurements are written.
        at: Control step of this intervention.
        run: Number of this run.
        save: File with the fitted values: .xml or .urdf (that of the system, with other numbers),
            .yaml, or .html (a page).
    """
    known, size = parse_assignments(noise, "'--noise'") or None, window or None
    ranges, request = parse_assignments(limits, "'--limits'"), parse_assignments(do, "'--do'")
    name = "-".join(["fit", *(Path(recording).stem for recording in recordings)])
    experiments: tuple[Any, ...] = ()
    failed = None
    with asked.open(name, task) as (system, folder, engine), console.progress("searches") as tell:
        began = "rest" if begins == ["rest"] else parse_assignments(begins, "'--begins'") or None
        given: dict[str, Any] = {"noise": known, "window": size, "begins": began, "progress": tell}
        texts = parse_assignments(column, "'--column'", lambda text, hint: text)
        names: dict[str, Any] = {"columns": texts, "ignore": ignore or ()}
        given |= {**names, "thin": thin or None}
        given["setups"] = _setups(setup, len(recordings)) if setup else None
        shown: sw.Fit | sw.Deviation
        if parameters:
            given |= {"held_out": held_out or None, "symmetric": symmetric}
            found = shown = system.fit(recordings, parameters, **given)
            combinations = found.identifiable.drop(columns="parameters")
            frames = {"fit": found.table, "identifiable": combinations}
        elif held_out or symmetric:
            asks = "--held-out" if held_out else "--symmetric"
            raise UnknownOption(asks, "given", ("left out, where no --parameters are named",))
        else:
            shown = deviation = system.explain(recordings, **given)
            found, frames = deviation.fit, {"explanation": deviation.table}
        if found.interrupted:
            predict, request, suggest = None, {}, 0
        predictions = {other: _predicted(found, other, names) for other in predict or ()}
        other = found.counterfactual(request, at=at, run=run, seed=asked.seed) if request else None
        diagnosis = found.diagnose(progress=tell) if diagnose else None
        try:
            if suggest:
                experiments = found.suggest(suggest, steps=steps, limits=ranges, seed=asked.seed)
        except ScmWorldError as error:  # the fit is printed first
            failed = error
    console.say(f"{tag(task)}, {', '.join(recordings)}: {found.read}")
    console.say(shown, *(() if parameters else found.remarks))
    if parameters:
        console.frame(combinations, title="identifiable")
    console.say(*([] if diagnosis is None else [diagnosis]))
    console.say(*(f"{path}: {prediction}" for path, prediction in predictions.items()))
    if found.held_out is not None:
        predictions["held out"] = found.held_out
    if other is not None:
        last = other.groupby("column", sort=False).tail(1)
        console.frame(last, title=f"end of run {run}, with {', '.join(do or ())} from {at} on")
    console.say(*(f"experiment {i}: {one}" for i, one in enumerate(experiments, 1)))
    tables = {"residuals": found.residuals} | ({} if other is None else {"counterfactual": other})
    tables |= {f"experiment-{i}": one.frame() for i, one in enumerate(experiments, 1)}
    result = asked.answer(
        *("fit/2", task, engine),
        recordings=recordings,
        parameters=parameters or (),
        noise=dict(zip((c.name for c in found.columns), found.noise, strict=True)),
        window=size,
        **{what: frame.to_dict("records") for what, frame in frames.items()},
        misfit=found.misfit,
        explains=found.explains,
        remarks=found.remarks,
        replay=found.replay.to_dict("records"),
        diagnosis=[] if diagnosis is None else diagnosis.table.to_dict("records"),
        predictions={name: one.table.to_dict("records") for name, one in predictions.items()},
        starts=[experiment.start for experiment in experiments],
    )
    files = {f"{name}.csv": table.to_csv(index=False) for name, table in tables.items()}
    console.write(folder, {**files, "fit.png": png(found.picture()), "result.json": result})
    for path in save or ():
        found.save(path)
        late = ", ".join(t.name for t in found.targets if t.values is None)
        lost = late if path.suffix not in (".yaml", ".yml", ".html") else ""
        console.say(f"written: {path}" + f", which has no {lost}" * bool(lost))
    if failed is not None:
        raise failed
    raise typer.Exit(console.INTERRUPTED if found.interrupted else int(not found.explains))
