"""Facts about wrong arguments of methods: they are refused with an error of this package."""

from __future__ import annotations

import copy
import inspect
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest

import scm_world as sw
from scm_world import curricula, discovery, evaluation
from scm_world.discovery import data
from scm_world.errors import ScmWorldError
from scm_world.queries import Outcome
from scm_world.variables import Box, Derived, Exogenous, Linear, Measured, Noise, Normal
from scm_world.world import Batch, EquationBatch

SLOWEST = 3.0  # [s]
PENDULUM = """<mujoco><worldbody><body name="pole"><joint name="hinge" axis="0 1 0" damping="0.1"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 1"/></body></worldbody>
<actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""


class Mine(Exception):
    """An error of a user's function, which passes through."""


def mine(*_: Any, **__: Any) -> Any:
    """Raise an error, whatever is given."""
    raise Mine


WRONG: tuple[Any, ...] = (
    *(None, 3, -1, 2.5, float("nan"), "", "nonsense", "two\nlines\x00", [], {}, object(), True),
    *(10**30, mine, pd.DataFrame({"a": [1.0]}), np.zeros((2, 3)), {"no_such": 1}, {3: 4}, [None]),
)


@dataclass
class Case:
    """A method, and arguments with which it can be called.

    Attributes:
        made: The object.
        method: The name of the method.
        valid: Arguments by name.
        owner: What has the present that a refused call must not change; None without any.
        changes: Arguments that, refused, leave an episode that has begun, as documented.
    """

    made: Any
    method: str
    valid: Mapping[str, Any]
    owner: Any = None
    changes: tuple[str, ...] = ()

    def __str__(self) -> str:
        kind = self.made if isinstance(self.made, type) else type(self.made)
        return f"{kind.__name__}.{self.method}"


def of(made: Any, owner: Any = None, /, **methods: Mapping[str, Any]) -> list[Case]:
    """List methods of one object."""
    return [
        Case(made, name, valid, owner, ("do", "space", "options") * (name == "reset"))
        for name, valid in methods.items()
    ]


@dataclass
class Found:
    """What came of calls with one wrong argument."""

    calls: int = 0
    raw: list[str] = field(default_factory=list)
    slow: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)


def present(owner: Any) -> Any:
    """Return what there is now, bit for bit."""
    if isinstance(owner, sw.ScmWorldEnv | gymnasium.Wrapper):
        return present(owner.unwrapped.world)  # type: ignore[attr-defined] # of this package
    worlds = (
        [owner.world(i) for i in range(len(owner))]
        if isinstance(owner, Batch | EquationBatch)
        else [owner]
    )
    return [
        (one.index, one.noise.seed, one.episode, {n: v.tobytes() for n, v in one.values().items()})
        for one in worlds
    ]


def called(call: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """Call a method with arguments by name; those under ``"*"`` have none."""
    return call(*given.get("*", ()), **{name: one for name, one in given.items() if name != "*"})


def tried(cases: Iterator[Case] | list[Case]) -> Found:
    """Call each method with every wrong value of every argument, one at a time."""
    found = Found()
    for case in cases:
        call = getattr(case.made, case.method)
        called(call, case.valid)  # it can be
        for name in case.valid:
            for wrong in WRONG:
                before = None if case.owner is None else present(case.owner)
                back = case.owner.snapshot() if hasattr(case.owner, "snapshot") else None
                what, began = f"{case}({name}={wrong!r:.30})", time.process_time()
                found.calls += 1
                try:
                    called(call, {**case.valid, name: [wrong] if name == "*" else wrong})
                except (ScmWorldError, Mine):
                    if before is not None and name not in case.changes:
                        found.changed += [what] * (present(case.owner) != before)
                except Exception as error:
                    found.raw.append(f"{what}: {type(error).__name__}: {error}"[:160])
                if time.process_time() - began > SLOWEST:
                    found.slow.append(what)
                if back is not None:
                    case.owner.restore(back)
    return found


# --- the objects ----------------------------------------------------------------------------------


def model() -> sw.SCM:
    """Return a model of three variables whose noise can be inferred."""
    return sw.SCM(
        [
            Exogenous(name="x", distribution=Normal(), a=Box(0.0, 1.0)),
            Derived(name="m", parents=("x",), mechanism=Linear(weights=(1.0,)), noise=Normal()),
            Derived(
                name="y", parents=("x", "m"), mechanism=Linear(weights=(2.0, 1.0)), noise=Normal()
            ),
        ]
    )


def stepped(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, float]:
    """Let a number grow at a rate."""
    return {"size": state["size"] * (1.0 + 0.1 * parameters["rate"]) + action["push"]}


def grown() -> sw.World:
    """Return a world of a step function."""
    return sw.World(
        stepped,
        parameters=[Exogenous(name="rate", default=1.0, bounds=Box(0.0, 2.0))],
        states=[Measured(name="size", default=1.0, parents=("rate", "size", "push"))],
        actions=[sw.Action(name="push", bounds=Box(-1.0, 1.0))],
        control_dt=0.1,
    )


def questions(asked: Any, do: Any, out: str, name: str, steps: int) -> list[Case]:
    """List the questions of a world or a model."""
    unit: Any = {"policy": None, "seed": 0, "episode": 0, "do": do}
    two: Any = {"n": 2, "progress": None}
    effect: Any = {"outcome": out, "do": do, "versus": None, "n": 2, "progress": None}
    setting: Any = {"steps": steps, "policy": None, "nature": do, "seed": 0, "workers": None}
    few: Any = {"steps": steps}
    return of(
        asked,
        given={"do" if isinstance(asked, sw.World) else "request": do},
        planned={"do": do},
        rollout={**unit, "steps": steps, "record": (out,)},
        live=unit,
        identify={"treatment": name, "outcome": out},
        see={**two, **few, "outcomes": [out]},
        sample={**two, **setting, "do": do, "outcomes": [out], "first": 0},
        effect={**effect, **few, "paired": True},
        direct_effect={**effect, **few, "mediators": {}},
        effect_by={**effect, **few, "n": 4, "by": out, "bins": 1},
        effect_over={**two, **few, "outcome": out, "name": name, "values": [0.5, 0.6]},
        verify={"probes": 1, "seed": 0},
    )


def doing(world: Any, do: Any, name: str, action: Any) -> list[Case]:
    """List the methods that change a world."""
    world.reset(seed=0)
    return of(
        world,
        world,
        __getitem__={"name": name},
        do={"request": do, "space": None},
        reset={"seed": 1, "episode": 0, "do": do, "space": None},
        restore={"snapshot": world.snapshot()},
        evaluate={"names": (name,)},
        **({} if action is None else {"step": {"action": action}}),
    )


def at_the_start(world: Any) -> Any:
    """Return another world of the kind, at the beginning of an episode."""
    other = copy.deepcopy(world)
    other.reset(seed=0)
    return other


def of_worlds(_: Path) -> Iterator[Case]:
    """Yield the methods of worlds of a file and of a step function, and of two worlds together."""
    world = sw.World(PENDULUM)
    yield from doing(world, {"pole.mass": 0.5}, "pole.mass", [0.0])
    yield from of(at_the_start(world).base, value={"name": "pole.mass"})
    yield from of(
        world,
        compare={"backend": "mujoco", "probes": 1, "seed": 0, "progress": None},
        local_graph={"action": [0.0]},
    )
    yield from of(world.rollout(steps=2), scene={"step": 1})
    both: Any = sw.World(PENDULUM, num_worlds=2)
    both.reset(seed=0)
    yield from of(
        both,
        both,
        __getitem__={"name": "pole.mass"},
        do={
            "request": {"pole.mass": 0.5},
            "where": None,
            "space": None,
            "on_refusal": "raise",
        },
        reset={"seed": 0, "where": None, "do": {"pole.mass": 0.5}, "space": None},
        step={"actions": np.zeros((2, 1)), "where": None},
        values={"where": None},
        world={"index": 0},
        table={"index": 0},
        given={"do": {"pole.mass": 0.5}},
        evaluate={"names": ("pole.mass",)},
        restore={"snapshots": both.snapshot()},
    )


def of_questions(_: Path) -> Iterator[Case]:
    """Yield the questions of a step function, of a model, and of a world of equations."""
    world = grown()
    yield from doing(world, {"rate": 0.5}, "size", [0.0])
    yield from questions(world, {"rate": 0.5}, "size", "rate", 2)
    yield from questions(model(), {"x": 0.5}, "y", "x", 0)
    equations: Any = sw.World(model())  # type: ignore[call-overload, arg-type] # not a World
    yield from doing(equations, {"x": 0.5}, "y", None)
    yield from of(
        equations,
        planned={"do": {"x": 0.5}},
        local_graph={"action": None},
        length={"steps": None},
    )
    yield from of(grown(), length={"steps": 3})
    many: Any = sw.World(model(), num_worlds=2)
    many.reset(seed=0)
    yield from of(
        many,
        many,
        __getitem__={"name": "x"},
        do={"request": {"x": 0.5}, "where": None, "space": None, "on_refusal": "raise"},
        reset={"seed": 0, "where": None, "do": {"x": 0.5}, "space": None},
        values={"where": None},
        world={"index": 0},
        given={"do": {"x": 0.5}},
        evaluate={"names": ("x",)},
        restore={"snapshots": many.snapshot()},
    )
    growth = sw.Derived(
        name="size",
        parents=(sw.Parent("size", 1), "rate"),
        mechanism=sw.Linear(weights=(0.5, 1.0)),
    )
    rate = sw.Exogenous(name="rate", default=1.0, bounds=sw.Box(0.0, 2.0))
    steps: Any = sw.World(sw.SCM([rate, growth]), num_worlds=2)
    steps.reset(seed=0)
    yield from of(steps, steps, step={"actions": np.zeros((2, 0)), "where": None})
    recording = {"time": np.arange(6.0), "size": [0.0, 1.0, 1.5, 1.75, 1.875, 1.9375]}
    yield from of(
        sw.World(sw.SCM([rate, growth])),
        fit={"recording": recording, "parameters": "rate"},
        explain={"recording": recording, "candidates": ["rate"]},
    )


def of_fits(folder: Path) -> Iterator[Case]:
    """Yield what a recording is asked for, and the methods of a fit."""
    world = grown()
    recorded = world.rollout("random", steps=12)
    search: Any = {"recording": recorded, "noise": None, "window": None, "progress": None}
    yield from of(
        world,
        fit={**search, "parameters": ["rate"]},
        explain={**search, "candidates": ["rate"], "most": 1},
    )
    fit, once = world.fit(recorded, ["rate"]), {"at": 0, "run": 0, "draws": 2, "seed": 0}
    yield from of(fit, counterfactual={"do": {"rate": 0.5}, **once}, picture={"run": 0})
    yield from of(fit, suggest={"n": 1, "steps": 3, "limits": None, "seed": 0})
    yield from of(fit, deviates={"name": "rate"}, save={"path": str(folder / "fit.yaml")})
    yield from of(
        fit,
        predict={"recording": recorded, "ahead": 0.2},
        diagnose={"terms": "*", "progress": None},
    )


def of_models(_: Path) -> Iterator[Case]:
    """Yield the methods of a model, of plans, and of what they return."""
    made = model()
    names: Any = ("declared", "parents", "children", "ancestors", "descendants", "target")
    yield from of(made, **{name: {"name": "x"} for name in (*names, "targets", "__getitem__")})
    yield from of(
        made,
        do={"request": {"x": 1.0}, "any_variable": False},
        named={"request": {"x": 1.0}},
        accept={"name": "x", "value": 1.0},
        draw={"n": 2, "seed": 0, "first": 0, "steps": None},
        solve=dict.fromkeys(("known", "previous", "key", "only")) | {"begins": False},
        evaluate={"name": "y", "values": {"x": 1.0, "m": 1.0}, "key": None},
    )
    unit = {"x": 1.0, "m": 1.0, "y": 3.0}
    ask: Any = {"do": {"x": 0.0}, "n": 20, "seed": 0, "tolerance": 1e-6}
    yield from of(made, counterfactual={"observed": unit, **ask})
    yield from of(
        made.counterfactual(unit, **ask),
        __getitem__={"name": "y"},
        difference={"name": "y"},
        interval={"name": "y", "level": 0.9},
        probability={"name": "y", "value": 1.0},
    )
    plan = sw.Plan({"x": 1.0})
    yield from of(
        plan,
        __getitem__={"name": "x"},
        do={"request": {"m": 1.0}},
        over={"below": {"x": 2.0}, "kind": "given"},
        only={"wanted": lambda *_: True},
        named={"model": made},
        composed={"model": made},
        then={"request": {"x": 2.0}, "model": made, "at": 1},
        from_dict={"data": plan.as_dict(), "trusted": ()},
        from_json={"text": plan.to_json(), "trusted": ()},
    )
    for report in (made.verify(probes=1), sw.discover(made)):
        yield from of(report, weak={"at_least": 0.1}, from_json={"text": report.to_json()})
    yield from of(made.sample(2), __getitem__={"name": "y"})
    laboratory = sw.Laboratory(made, budget=10**8)
    laboratory.see(1)
    yield from of(
        laboratory,
        see={"n": 1},
        do={"request": {"x": 0.5}, "n": 1},
        counterfactual={"unit": 0, "request": {"x": 0.5}, "at": 0},
    )


def of_episodes(_: Path) -> Iterator[Case]:
    """Yield the methods of finished and live episodes, and of outcomes."""
    world = grown()
    run, live, do = world.rollout("random", steps=4), world.live("random"), {"rate": 0.5}
    yield from of(
        run,
        __getitem__={"name": "rate"},
        final={"name": "rate"},
        until={"step": 2},
        era={"step": 2},
        counterfactual={"do": do, "at": 2, "actions": "replay", "record": ()},
        worlds={"dos": [do], "at": 0, "actions": "replay", "record": (), "workers": None},
    )
    live.step()
    yield from of(live, do={"request": do}, step={"action": [0.0]}, split={"do": do, "at": 1})
    yield from of(Outcome("size"), of={"episode": run})


def of_tables(place: Path) -> Iterator[Case]:
    """Yield the methods of tables, of true and estimated graphs, designs and sweeps."""
    made = model()
    design = data.Design("single", ("x",), values="A")
    table = data.collect(made, design, 20, seed=0)
    yield from of(
        table,
        __getitem__={"name": "x"},
        adjacency={"lag": 0},
        weights={"lag": 0},
        first={"episodes": 3},
        hide={"names": ["m"]},
        select={"names": ["x", "y"]},
        joined={"parts": [table]},
        lagged={"lags": 1},
        rows={"chosen": [0, 1]},
        of={
            "values": np.zeros((3, 2)),
            "names": ["a", "b"],
            **dict.fromkeys(("targets", "episode", "step")),
        },
    )
    report = made.verify(probes=1)
    yield from of(
        table.truth,
        adjacency={"lag": 0},
        for_rows={"table": table},
        mag={"lags": None},
        pag={"lags": None},
        during={"*": ["contact"]},
        marked={"report": report, "at_least": 0.0},
    )
    yield from of(
        design,
        named={"model": made},
        regime={"episode": 0, "seed": 0},
        chosen={"seed": 0, "first": 0, "count": 3},
        cases={"seed": 0, "numbers": range(3)},
    )
    graph, names = discovery.EstimatedGraph.of_edges(["x", "y"], [("x", "y", 0)]), ["x", "y"]
    yield from of(
        graph,
        from_dict={"data": graph.as_dict()},
        of={"names": names, "matrix": np.zeros((2, 2)), "edge_scores": None},
        of_edges={"names": names, "edges": [("x", "y", 0)]},
        of_marks={"names": names, "marks": np.zeros((2, 2), int)},
        restricted={"names": ["x"]},
    )
    yield from of(discovery.Levels("A", 3), of={"variable": made.declared("x")})
    swept = data.sweep(made, {"x": [0.0, 1.0]}, ["y"], n=5)
    yield from of(swept, units={"point": 0}, values={"point": 0, "name": "y"})
    yield from of(swept, save={"folder": place})


def pushing(**options: Any) -> Any:
    """Return a short environment."""
    name = "scm_world/Pushing-v0"
    return gymnasium.make(name, backend="fake", max_episode_length=5, **options)


class Resets:
    """The options of a reset of an environment, as arguments."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def reset(self, **options: Any) -> Any:
        """Begin an episode with some options."""
        return self.env.reset(seed=0, options=options)


def of_environments(place: Path) -> Iterator[Case]:
    """Yield the methods of environments, vectors, curricula, recorders and recordings."""
    env, action, do = pushing().unwrapped, np.zeros(9, np.float32), {"tool_block.mass": 0.04}
    env.reset(seed=0)
    options: Any = {"do": do, "episode": 1, "space": None}
    yield from of(
        env,
        env,
        reset={"seed": 0, "options": {"do": do}},
        step={"action": action},
        do={"request": do, "space": None},
        restore={"snapshot": env.snapshot()},
    )
    yield from of(
        env,
        as_action={"command": np.zeros(9)},
        beginning={"do": do},
        observe_values={"values": {name: env.world[name] for name in env.observed}},
    )
    yield from of(Resets(env), env, reset=options)
    goals = pushing(goal_env=True).unwrapped
    seen, _ = goals.reset(seed=0)
    pair = {"achieved": seen["achieved_goal"], "desired": seen["desired_goal"]}
    yield from of(goals, goal_reward=pair, compute_reward=pair)
    both: Any = gymnasium.make_vec("scm_world/Pushing-v0", num_envs=2, backend="fake")
    both.reset(seed=0)
    yield from of(
        both,
        reset={"seed": 0, "options": {"do": do}},
        step={"actions": np.zeros((2, 9), np.float32)},
        do={"requests": do, "space": None},
        branch={"source": 0, "into": 1},
        restore={"snapshot": both.snapshot()},
    )
    yield from of(Resets(both), reset={**options, "reset_mask": np.ones(2, bool)})
    curriculum = curricula.resample("tool_block.mass", space="A")
    lesson = curricula.CurriculumEnv(pushing(), curriculum)
    lesson.reset(seed=0)
    yield from of(lesson, reset={"seed": 0, "options": {"do": do}}, over={"success": True})
    yield from of(lesson, restore={"snapshot": lesson.snapshot()}, step={"action": action})
    situation = curricula.Situation(0, {}, env.world.compiled, Noise(0), 0)
    (place / "lesson.json").write_text(curriculum.to_json(), encoding="utf-8")
    yield from of(
        curriculum,
        plan={"situation": situation},
        check={"world": env.world},
        load={"path": place / "lesson.json", "trusted": ()},
    )
    yield from of(situation, generator={"key": "a"}, uniform={"key": "a"})
    recorder = evaluation.Recorder(pushing())
    recorder.reset(seed=0)
    yield from of(recorder, label={"action": action}, step={"action": action})
    yield from of(recorder, recording={"policy": None}, reset={"seed": 0, "options": {"do": do}})
    recording = evaluation.record("random", pushing(), 2)
    recording.save(place / "two.parquet")
    yield from of(
        recording,
        __getitem__={"number": 0},
        save={"path": place / "more.parquet"},
        load={"path": place / "two.parquet", "trusted": ()},
        replay={"which": 0, "task": None},
    )


def of_evaluations(place: Path) -> Iterator[Case]:
    """Yield the methods of an evaluation, its scores and its protocols."""
    agents, short = {"one": "random", "two": "still"}, {"max_episode_length": 3}
    found = evaluation.evaluate(
        *(agents, ["P0", "P1"]), task="pushing", n=4, backend="fake", env=short, repeats=2,
        steps=True,
    )  # fmt: skip
    found.save(place / "found")
    named: Any = {"metric": None, "agent": "one", "engine": None}
    yield from of(
        found,
        score={"protocol": "P1", **named},
        scores=named,
        overall=named,
        causes={"protocol": "P1", **named},
        difference={"one": "one", "other": "two", "protocol": "P1", "metric": None, "engine": None},
        regret={
            "agent": "one",
            "reference": "two",
            "protocol": "P1",
            "metric": None,
            "engine": None,
        },
        probability_of_improvement={"one": "one", "other": "two", "protocol": "P1"},
        attempts={"protocol": "P1", **named},
        since={"protocol": "P1", "agent": "one", "engine": None, "every": 2},
        metric={"name": None},
        only={"agent": "one", "protocol": "P1", "seed": 0, "episode": 0},
        runs={"agent": "one"},
        the={"name": "agent", "given": "one"},
        load={"path": place / "found"},
        save={"folder": place / "again"},
    )
    yield from of(found.causes("P1", agent="one"), found={"alpha": 0.05})
    yield from of(found.score("P1", agent="one"), excludes={"number": 0.0})
    protocol = evaluation.Protocol(name="mine", varies=("tool_block.mass",), space="B")
    yield from of(protocol, at={"step": 3}, from_dict={"data": protocol.as_dict(), "trusted": ()})


FAMILIES = (
    *(of_worlds, of_questions, of_fits, of_models, of_episodes),
    *(of_tables, of_environments, of_evaluations),
)


@pytest.mark.filterwarnings("ignore")  # of few episodes, and of values that mean little
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_wrong_arguments_are_refused(
    family: Callable[[Path], Iterator[Case]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One wrong argument gives an error of this package, soon, and changes nothing."""
    monkeypatch.chdir(tmp_path)  # a text is the name of a file in it
    found = tried(family(tmp_path))
    assert not found.raw, f"{len(found.raw)} of {found.calls}:\n" + "\n".join(found.raw)
    assert not found.slow
    assert not found.changed


LEFT_OUT = {
    **dict.fromkeys(
        ("advance", "batched", "by_structure", "move", "noise_key", "draw_key", "take"),
        "for loops of this package",
    ),
    **dict.fromkeys(
        ("may_have", "is_set_at_once", "usual_columns", "for_fit", "of_each"),
        "for questions of this package",
    ),
    **dict.fromkeys(
        ("of", "several", "together", "differs", "refuse"), "for many equations as one"
    ),
    **dict.fromkeys(("takes_each", "awaits"), "for many equations as one"),
    "require_exact": "asks an engine, and takes any name of a question",
    "image": "draws a picture, which takes seconds",
    "to_minari": "needs a library",
    "touching": "needs contacts",
    "tensor": "needs an engine with a device",
}


def test_every_method_is_tried(tmp_path: Path) -> None:
    """Every documented method with arguments of these classes is among those that are called."""
    kinds, seen = set[type](), set[str]()
    for case in (case for family in FAMILIES for case in family(tmp_path)):
        kinds.add(case.made if isinstance(case.made, type) else type(case.made))
        seen.add(getattr(case.made, case.method).__qualname__)
    left = {
        one.__qualname__
        for kind in kinds
        for name, one in inspect.getmembers(kind, callable)
        if not (name.startswith("_") or name in LEFT_OUT or isinstance(one, type))
        and (getattr(one, "__module__", None) or "").startswith("scm_world")
        and one.__doc__
        and [*inspect.signature(one).parameters] not in ([], ["self"])
    }
    refused = {  # whatever the arguments: by equations, and by many worlds
        sw.World(model()).compare.__qualname__,
        sw.World(model(), num_worlds=2).scene.__qualname__,
    }
    assert sorted(left - seen - refused) == []
