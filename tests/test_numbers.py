"""Documented numbers and switches: those of NumPy are Python's, and nothing is read as one."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world as sw
from scm_world import curricula, discovery, env, evaluation, graph, queries, variables
from scm_world.curricula import CurriculumEnv, make_vec
from scm_world.discovery import data
from scm_world.errors import ScmWorldError
from scm_world.evaluation import statistics
from scm_world.policies import as_agent, planning
from scm_world.tasks import StepTask, families, make_task
from scm_world.training.imitation import lesson
from scm_world.training.recipe import recipe
from scm_world.variables import Box, Derived, Exogenous, Linear, Measured, Normal, Parent

MODEL = sw.SCM(
    [
        Exogenous(name="x", distribution=Normal(), a=Box(-1.0, 1.0)),
        Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,)), noise=Normal()),
    ]
)
LAGGED = sw.SCM(
    [
        Exogenous(name="u", distribution=Normal()),
        Derived(
            name="v", parents=(Parent(name="v", lag=1), "u"), mechanism=Linear(weights=(0.5, 1))
        ),
    ]
)
WORLD = sw.World("pushing", backend="fake")
EPISODE = WORLD.rollout("random", steps=3)
TABLE = discovery.collect(MODEL, discovery.Design("single", ("x",)), 20)
TRUTH: Any = TABLE.truth
OBSERVED = {"x": 1.0, "y": 2.5}
SCORES = [[0.0, 1.0], [0.5, 1.0]]
VALUES = [0.0, 1.0, 1.0]
REPORT = queries.verify(MODEL, probes=1, held_out=0)


def told(value: Any) -> Any:
    """Return what a result says, with the types of its numbers."""
    if isinstance(value, np.ndarray):
        return str(value.dtype), repr(value.tolist())
    if isinstance(value, Mapping):
        return {key: told(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [told(one) for one in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = (one.name for one in dataclasses.fields(value) if one.compare)
        return {name: told(getattr(value, name)) for name in fields if name != "seconds"}
    if type(value).__module__ == "numpy" or isinstance(value, str | int | float | None):
        return type(value).__name__, repr(value)  # NaN is NaN
    return (
        str(value).partition(" at 0x")[0] if type(value).__str__ is object.__str__ else str(value)
    )


Case = tuple[Callable[..., Any], dict[str, Any]]


def environment(**options: Any) -> Any:
    """Return the first observations of an environment."""
    made = env.make_env(task="pushing", backend="fake", **options)
    first = made.reset(seed=0)[0]
    return first, made.step(made.action_space.high * 0.5)[0], made.world.options.control_period


def vector(**options: Any) -> Any:
    """Return the first observations of several environments."""
    made = env.vector_env(task="pushing", backend="fake", **options)
    first = made.reset(seed=0)[0]
    made.close()
    return first


QUESTION = {"steps": 2, "seed": 3, "workers": 1}
CASES: dict[str, Case] = {
    # variables
    "Affine": (variables.Affine, {"parent": "x", "index": 0, "scale": 0.5, "offset": 1.5}),
    "Box": (Box, {"low": 0.5, "high": 2.0}),
    "Categories": (variables.Categories, {"members": (1, 3)}),
    "Derived": (
        Derived,
        {"name": "z", "parents": (), "mechanism": Linear(weights=()), "start": 0.5},
    ),
    "Discrete": (variables.Discrete, {"values": (1, 2), "probabilities": (0.5, 0.5)}),
    "Draw": (lambda **k: sw.Draw(*k.values()), {"low": 0.5, "high": 2.0}),
    "Exogenous": (Exogenous, {"name": "z", "default": 0.5}),
    "Fixed": (sw.Fixed, {"name": "z", "value": 0.5, "intervenable": True}),
    "Hard": (lambda value: sw.Hard(value=value), {"value": 0.5}),
    "Integers": (variables.Integers, {"low": 1, "high": 3}),
    "Linear": (Linear, {"weights": (0.5, 1.0), "intercept": 0.5}),
    "Measured": (Measured, {"name": "z", "settable_state": True, "default": 0.5}),
    "Noise": (lambda seed: variables.Noise(seed).uniforms("u", n=2), {"seed": 3}),
    "Normal": (Normal, {"mean": 0.5, "std": 1.5}),
    "Parent": (Parent, {"name": "z", "lag": 1}),
    "Reaches": (sw.Reaches, {"name": "x", "above": 0.5, "component": 1}),
    "Rotations": (variables.Rotations, {"keeps_sign": True}),
    "Scale": (sw.Scale, {"by": 0.5}),
    "Shift": (sw.Shift, {"by": 0.5}),
    "Shift.shared": (
        lambda shared: sw.Shift(by=sw.Draw(0.5, 1.5), shared=shared),
        {"shared": True},
    ),
    "Switch": (variables.Switch, {"parent": "x", "below": 0.5, "above": 1.5, "at": 0.25}),
    "Table": (
        lambda **k: variables.Table(probabilities=(0.5, 0.5), **k),
        {"values": (1, 2)},
    ),
    "Time": (variables.Time, {"at": 2}),
    "Time.every": (variables.Time, {"every": 3}),
    "Time.during": (variables.Time, {"during": (1, 3)}),
    # graphs
    "episode_outcome": (
        lambda contact: sorted(
            graph.episode_outcome(WORLD.model, ["reward"], contact=contact).edges
        ),
        {"contact": False},
    ),
    "unrolled": (lambda steps: sorted(graph.unrolled(LAGGED, steps).edges), {"steps": 2}),
    "to_digraph": (
        lambda at_least: sorted(graph.to_digraph(MODEL, strength={}, at_least=at_least).edges),
        {"at_least": 0.5},
    ),
    "SCM.draw": (MODEL.draw, {"n": 3, "seed": 1, "first": 2}),
    # questions
    "SCM.rollout": (lambda **k: episode(MODEL.rollout(**k)), {"seed": 3, "episode": 2}),
    "SCM.live": (lambda **k: started(WORLD.live(**k)), {"seed": 3, "episode": 2}),
    "SCM.sample": (MODEL.sample, {"n": 3, "first": 2, "seed": 3, "workers": 1}),
    "SCM.see": (MODEL.see, {"n": 3}),
    "SCM.effect": (MODEL.effect, {"outcome": "y", "do": {"x": 1.0}, "n": 3, "paired": False}),
    "SCM.direct_effect": (
        MODEL.direct_effect,
        {"outcome": "y", "do": {"x": 1.0}, "mediators": [], "n": 3},
    ),
    "SCM.effect_over": (
        MODEL.effect_over,
        {"outcome": "y", "name": "x", "values": (0.5, 1.0), "n": 3},
    ),
    "SCM.effect_by": (
        MODEL.effect_by,
        {"outcome": "y", "do": {"x": 1.0}, "by": "x", "n": 8, "bins": 2},
    ),
    "SCM.counterfactual": (
        MODEL.counterfactual,
        {"observed": OBSERVED, "do": {"x": 2.0}, "n": 3, "seed": 1, "tolerance": 0.5},
    ),
    "World.sample": (WORLD.sample, {"n": 2, "first": 1, "outcomes": ["reward"], **QUESTION}),
    "World.rollout": (lambda **k: episode(WORLD.rollout(**k)), {"seed": 3, "steps": 2}),
    "World.reset": (WORLD.reset, {"seed": 3, "episode": 1}),
    "World": (
        lambda **k: len(sw.World("pushing", backend="fake", **k)),
        {"num_worlds": 2},
    ),
    "Simulation": (
        lambda **k: sw.World("pushing", backend="fake", **k).options,
        {"frame_skip": 2, "max_episode_length": 5},
    ),
    "World.compare": (lambda **k: WORLD.compare("fake", **k).effects, {"probes": 1}),
    "from_urdf": (
        lambda fixed_base: [*sw.World(URDF, fixed_base=fixed_base).model],
        {"fixed_base": False},
    ),
    "Episode.counterfactual": (
        lambda at: EPISODE.counterfactual({"tool_block.mass": 0.05}, at=at)["reward"],
        {"at": 1},
    ),
    "Verification.weak": (REPORT.weak, {"at_least": 0.5}),
    "but_for": (
        lambda **k: queries.but_for(EPISODE, "reward", {"tool_block.mass": 0.05}, **k),
        {"at": 1, "most": 1, "workers": 1},
    ),
    "compare": (
        lambda tolerance: queries.compare(EPISODE, EPISODE, tolerance=tolerance).variables,
        {"tolerance": 0.5},
    ),
    "consequences": (
        lambda **k: queries.consequences(WORLD, {"tool_block.mass": 0.05}, **k).variables,
        {"steps": 2, "seed": 1},
    ),
    "nature_graph": (
        lambda contact: sorted(
            queries.nature_graph(WORLD, None, ["reward"], contact=contact).edges
        ),
        {"contact": False},
    ),
    "Laboratory": (lambda budget: sw.Laboratory(MODEL, budget=budget).remaining, {"budget": 5}),
    "Laboratory.do": (lambda n: sw.Laboratory(MODEL).do({"x": 1.0}, n=n), {"n": 2}),
    "Laboratory.see": (lambda n: sw.Laboratory(MODEL).see(n), {"n": 2}),
    "Laboratory.counterfactual": (
        lambda **k: laboratory().counterfactual(request={"x": 1.0}, **k),
        {"unit": 1, "at": 0},
    ),
    "Outcome": (queries.Outcome, {"name": "x", "component": 1}),
    "Random": (queries.Random, {"share": 0.5, "every": 2}),
    "Setting": (queries.Setting, {"steps": 3, "seed": 1, "workers": 2}),
    "verify": (lambda **k: queries.verify(MODEL, **k).outcome, {"probes": 2, "held_out": 1}),
    "Batch": (
        lambda **k: len(sw.World("pushing", backend="fake", **k)),
        {"num_worlds": 2, "threads": 1},
    ),
    "Batch.reset": (
        lambda seed: batch().reset(seed=seed),
        {"seed": 3},
    ),
    "Batch.table": (lambda index: batch().table(index), {"index": 1}),
    "Batch.world": (lambda index: batch().world(index)["tool_block.mass"], {"index": 1}),
    # environments
    "ScmWorldEnv": (
        environment,
        {
            "frame_skip": 2,
            "normalize_actions": False,
            "normalize_observations": False,
            "goal_env": False,
            "max_episode_length": 7,
            "stack_images": False,
            "stack_history": False,
        },
    ),
    "ScmWorldEnv.delta": (
        lambda delta_scale: environment(
            action_mode="delta_joint_positions", delta_scale=delta_scale
        ),
        {"delta_scale": 0.5},
    ),
    "vector_env": (vector, {"num_envs": 2, "copy": False, "workers": 1, "threads": 1}),
    "ScmWorldEnv.reset": (
        lambda seed: env.make_env(task="pushing", backend="fake").reset(seed=seed)[0],
        {"seed": 3},
    ),
    # curricula
    "at_step": (lambda step: curricula.at_step(step, {}), {"step": 3}),
    "timed": (lambda every: curricula.timed({"every": every}, {}), {"every": 3}),
    "resample": (
        lambda exclusive: curricula.resample("*.mass", exclusive=exclusive),
        {"exclusive": True},
    ),
    "stages": (
        lambda **k: curricula.stages({}, {}, **k),
        {"up": 0.75, "down": 0.25, "window": 3},
    ),
    "make_vec": (
        lambda num_envs: (
            make_vec("scm_world/Pushing-v0", num_envs, curriculum={}, backend="fake").num_envs
        ),
        {"num_envs": 2},
    ),
    "CurriculumEnv.reset": (
        lambda seed: CurriculumEnv(env.make_env(task="pushing", backend="fake"), {}).reset(
            seed=seed
        )[0],
        {"seed": 3},
    ),
    "CurriculumState": (curricula.CurriculumState, {"episode": 2, "noise": (1, 2), "every": 3}),
    # discovery
    "discover": (
        lambda **k: discovery.discover(MODEL, **k).outcome,
        {"probes": 2, "seed": 1, "at_least": 0.5},
    ),
    "Dataset.adjacency": (TABLE.adjacency, {"lag": 0}),
    "Dataset.first": (TABLE.first, {"episodes": 3}),
    "Dataset.lagged": (TABLE.lagged, {"lags": 0}),
    "Dataset.weights": (TABLE.weights, {"lag": 0}),
    "Design": (discovery.Design, {"observational_fraction": 0.5}),
    "Design.chosen": (
        discovery.Design("single", ("x",)).chosen,
        {"seed": 1, "first": 2, "count": 3},
    ),
    "Design.regime": (
        lambda **k: discovery.Design("single", ("x",)).regime(**k),
        {"episode": 2, "seed": 1},
    ),
    "Learner": (
        discovery.Learner,
        {"name": "n", "learn": len, "temporal": True, "baseline": True, "marked": True},
    ),
    "Levels": (lambda count: discovery.Levels("A", count), {"count": 3}),
    "TaskView": (
        lambda **k: discovery.TaskView("step", **k),
        {"steps": 3, "sensor_noise": 0.5, "contacts": True},
    ),
    "collect": (
        lambda **k: discovery.collect(MODEL, discovery.Design(), **k).values,
        {"n": 3, "seed": 1, "shard": 2, "workers": 1},
    ),
    "discovery.evaluate": (
        lambda marks: discovery.evaluate(
            discovery.EstimatedGraph.of_edges(["x", "y"], [("x", "y", 0)]), TRUTH, marks=marks
        ),
        {"marks": False},
    ),
    "learn": (
        lambda **k: discovery.learn("empty", TABLE, **k).edges,
        {"seed": 1, "shuffle": False},
    ),
    "problem": (lambda seed: discovery.problem("er2:4", seed=seed).truth.edges, {"seed": 3}),
    "Problem.data": (
        lambda **k: discovery.problem("er2:4").data("observational", **k).values,
        {"budget": 3, "seed": 1},
    ),
    "random_model": (
        lambda seed: graph.to_json(families.random_model("er2:4", seed=seed)),
        {"seed": 3},
    ),
    "sweep": (
        lambda **k: discovery.sweep(MODEL, {"x": [1, 2]}, ["y"], **k).units(0),
        {"n": 2, "shard": 2, "workers": 1, "seed": 1},
    ),
    "GroundTruth.adjacency": (TRUTH.adjacency, {"lag": 0}),
    "GroundTruth.mag": (TRUTH.mag, {"lags": 0}),
    "GroundTruth.pag": (TRUTH.pag, {"lags": 0}),
    "GroundTruth.marked": (
        lambda at_least: TRUTH.marked(REPORT, at_least=at_least).unseen,
        {"at_least": 0.5},
    ),
    "Pictures": (data.Pictures, {"size": (8, 8), "goals": True}),
    "default_outcomes": (lambda **k: data.default_outcomes(WORLD, **k), {"every_step": True}),
    "Column": (data.Column, {"name": "x", "variable": "x", "component": 1, "lag": 1}),
    # evaluation
    "evaluate": (
        lambda **k: str(
            evaluation.evaluate("still", "P5", env={"max_episode_length": 2}, backend="fake", **k)
        ),
        {"n": 2, "workers": 1, "steps": True},
    ),
    "inferred": (
        lambda **k: str(
            evaluation.inferred(
                "still", "*.mass", env={"max_episode_length": 4}, backend="fake", **k
            )
        ),
        {"n": 2, "seed": 1, "steps": [1], "at": 1, "after": 1, "workers": 1},
    ),
    "Adaptive": (
        lambda **k: evaluation.Adaptive("still", "mass", measures={"x": 0.1}, **k).keeps,
        {"after": 3, "keeps": True},
    ),
    "play": (
        lambda **k: evaluation.play(gymnasium.make(PUSHING, **SHORT), STILL, **k)[
            "fractional_success"
        ],
        {"seed": 1, "episode": 2},
    ),
    "record": (
        lambda n, **k: (
            evaluation.record("still", gymnasium.make(PUSHING, **SHORT), n, **k).episodes[0].actions
        ),
        {"n": 1, "seed": 1, "first": 2, "noise": 0.5},
    ),
    "aggregate": (lambda **k: statistics.aggregate(SCORES, **k), {"gamma": 0.5, "level": 0.75}),
    "difference_interval": (
        lambda **k: statistics.difference_interval(VALUES, VALUES, **k),
        {"level": 0.75, "proportion": True},
    ),
    "find_causes": (
        lambda **k: statistics.find_causes({"m": VALUES * 4}, VALUES * 4, **k).found(0.5),
        {"level": 0.75, "permutations": 20, "seed": 1, "proportion": True},
    ),
    "mean_interval": (
        lambda **k: statistics.mean_interval(VALUES, **k),
        {"level": 0.75, "proportion": True},
    ),
    "performance_profile": (
        lambda **k: statistics.performance_profile(SCORES, **k),
        {"level": 0.75},
    ),
    "Protocol": (
        lambda step: evaluation.Protocol("mine", varies=("*.mass",), space="A", step=step),
        {"step": 3},
    ),
    # policies and training
    "CrossEntropy": (
        lambda **k: vars(planning.CrossEntropy(**k)),
        {"every": 2, "foresees": True, "seed": 1, "threads": 1},
    ),
    "Search": (
        planning.Search,
        {
            "samples": 8,
            "horizon": 3,
            "iterations": 1,
            "elites": 2,
            "spread": 0.5,
            "color": 1.5,
            "momentum": 0.25,
        },
    ),
    "Score": (lambda sums: planning.Score(("x",), len, sums=sums), {"sums": True}),
    "recipe": (
        lambda **k: recipe("pushing", **k).to_json(),
        {
            "worlds": 8,
            "steps": 100_000,
            "scale_rewards": True,
            "episode_length": 5,
            "staggered": False,
            "critic_warmup": 2,
            "n_steps": 4,
            "gamma": 0.5,
        },
    ),
    "Lesson": (
        lambda **k: lesson("pushing", **k).model_dump_json(),
        {"episodes": 30, "rounds": 2, "more": 5, "noise": 0.5, "share": 0.25},
    ),
    # tasks
    "Towers": (
        lambda **k: task_of("towers", **k),
        {"tool_block_mass": 0.0625, "activate_sparse_reward": True, "tower_center": (0.0, 0.0)},
    ),
    "CreativeStackedBlocks": (
        lambda **k: task_of("creative_stacked_blocks", **k),
        {"num_of_levels": 3, "max_level_width": 0.125, "number_of_obstacles": 1},
    ),
    "ModelTask": (
        lambda **k: told_task(POLE, **k),
        {
            "control_dt": 0.5,
            "seconds": 8.0,
            "ground": True,
            "exact": False,
            "follow": True,
            "fixed_base": True,
            "self_collision": False,
        },
    ),
    "StepTask": (
        lambda **k: StepTask(lambda p, s, a: s, states=[STATE], **k).control_dt,
        {"control_dt": 0.5, "vectorized": False},
    ),
}
STATE = Measured(name="s", parents=(Parent(name="s", lag=1),))
PUSHING, SHORT = "scm_world/Pushing-v0", {"backend": "fake", "max_episode_length": 2}
STILL = as_agent("still")
POLE = """<mujoco><worldbody><body name="pole"><joint name="h"/><geom size="0.05"/></body>
  </worldbody><actuator><motor joint="h" ctrlrange="-1 1"/></actuator></mujoco>"""
URDF = """<robot name="r"><link name="a"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def task_of(name: str, **options: Any) -> Any:
    """Return what a task declares."""
    made = sw.World(make_task(name, **options), backend="fake")
    return {name: made.model.declared(name) for name in made.model}, made.task.weights


def told_task(name: str, **options: Any) -> Any:
    """Return what a task of a model declares."""
    made = make_task(name, **options)
    return made.control_dt, made.seconds, made.frame_skip, [*made.system.notes]


def laboratory() -> sw.Laboratory:
    """Return a laboratory with two units."""
    made = sw.Laboratory(MODEL)
    made.see(2)
    return made


def episode(found: Any) -> Any:
    """Return what an episode holds."""
    return found.seed, found.number, {name: found[name] for name in found.names}


def started(found: Any) -> Any:
    """Return a live episode after a control step."""
    found.step()
    return episode(found.episode())


def batch() -> Any:
    """Return two worlds."""
    made = sw.World("pushing", backend="fake", num_worlds=2)
    made.reset(seed=0)
    return made


def is_number(value: Any) -> bool:
    """Return whether a value is a number or switch, or a tuple of numbers."""
    return isinstance(value, bool | int | float) or (
        isinstance(value, tuple) and bool(value) and all(isinstance(v, int | float) for v in value)
    )


ARGUMENTS = [
    pytest.param(call, given, name, id=f"{case}-{name}")
    for case, (call, given) in CASES.items()
    for name, value in given.items()
    if is_number(value)
]


def numpys(value: Any) -> Iterator[Any]:
    """Return the same number, switch or numbers, as NumPy has them."""
    if isinstance(value, bool):
        yield np.bool_(value)
        return
    yield np.array(value)
    if isinstance(value, int):
        yield np.int64(value)
    elif isinstance(value, float):
        yield np.float32(value)


def others(value: Any) -> Iterator[Any]:
    """Return values that may be taken for a number or a switch, and are none."""
    if isinstance(value, bool):
        yield from ("no", 1, None, [value])
    elif isinstance(value, int | float):
        yield from (True, str(value))
    else:
        yield "no"


@pytest.mark.parametrize(("call", "given", "name"), ARGUMENTS)
def test_numbers_of_numpy_are_those_of_python(call: Any, given: Any, name: str) -> None:
    """A number, array of shape () or switch of NumPy gives exactly the result of Python's."""
    expected = told(call(**given))
    for value in numpys(given[name]):
        assert told(call(**{**given, name: value})) == expected
    if not isinstance(
        given[name], tuple
    ):  # what is not one number is refused, or taken as a list is
        results = []
        for value in (np.array([given[name]]), [given[name]]):
            try:
                results.append(told(call(**{**given, name: value})))
            except ScmWorldError as error:
                results.append(type(error))
        assert results[0] == results[1]


MEANT = {("shared", "no"), ("shared", None), ("proportion", None)}
"""A name of a shared draw, and arguments that may be left open."""


@pytest.mark.parametrize(("call", "given", "name"), ARGUMENTS)
def test_nothing_is_read_as_a_number_or_a_switch(call: Any, given: Any, name: str) -> None:
    """Texts and switches are no numbers; texts and numbers are no switches."""
    for value in others(given[name]):
        if not isinstance(value, list) and (name, value) in MEANT:
            continue
        with pytest.raises(ScmWorldError):
            call(**{**given, name: value})


MODULES = (
    "",
    ".variables",
    ".graph",
    ".queries",
    ".world",
    ".env",
    ".curricula",
    ".discovery",
    ".discovery.data",
    ".discovery.learners",
    ".evaluation",
    ".evaluation.statistics",
    ".policies.planning",
    ".tasks",
)
RESULTS = {
    *(
        "Counterfactuals",
        "Deviation",
        "DiscoveryReport",
        "Effect",
        "Fit",
        "Identification",
        "Otherwise",
    ),
    *("Progress", "Snapshot", "Verification"),
}
"""What questions return, and no user makes."""
ELSEWHERE = {
    ("identify", "frontdoor"),
    ("PlanningModel", "foresees"),
    ("ScmWorldEnv", "keypoints"),
    ("ScmWorldVectorEnv", "copy"),
    ("benchmark", "standardised"),
    ("load", "partial"),
    ("batches", "partial"),
    ("Conventions", "published"),
    ("Observation", "saturates"),
    ("Scale", "shared"),
    *((name, "exclusive") for name in ("everything", "joints", "looks", "physics", "poses")),
}
"""They have the checks of a case above, or call for files and benchmarks."""


def test_every_public_switch_is_called_with_something_else() -> None:
    """A function or class of a public module with a new switch needs a case above."""
    cased = {
        (word, name)
        for case, (_, given) in CASES.items()
        for name in given
        for word in case.split(".")
    }
    missing = set()
    for module in MODULES:
        home = importlib.import_module(f"scm_world{module}")
        for public in home.__all__:
            made = getattr(home, public)
            if (
                not callable(made)
                or public in RESULTS
                or getattr(made, "__module__", "") == "builtins"
            ):
                continue
            try:
                found = inspect.signature(made).parameters.values()
            except ValueError:  # a dictionary of types
                continue
            missing |= {
                (public, one.name)
                for one in found
                if isinstance(one.default, bool)
                or str(one.annotation) in ("bool", "<class 'bool'>")
            }
    assert missing - cased - ELSEWHERE == set()
