"""Every source of a world, at every entrance."""

from __future__ import annotations

import pickle
import textwrap
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import scm_world as sw
from scm_world import graph
from scm_world.cli.options import load_system
from scm_world.discovery import TaskView, problem
from scm_world.env.models import MODEL_ID
from scm_world.errors import ModelError, UnknownOption
from scm_world.evaluation import protocols_of
from scm_world.graph import to_json
from scm_world.studio.spec import Spec
from scm_world.tasks import Pushing, make_task
from scm_world.variables import Box, Derived, Exogenous, Linear, Measured, Normal
from scm_world.world import Simulation

XML = (
    "<mujoco model='pole'><worldbody><body name='pole'><joint name='hinge' axis='0 1 0'/>"
    "<geom type='capsule' size='0.02' fromto='0 0 0 0 0 1'/></body></worldbody></mujoco>"
)
URDF = (
    "<robot name='pole'><link name='base'/><link name='pole'><inertial><mass value='1'/>"
    "<inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
    "<joint name='hinge' type='continuous'><parent link='base'/><child link='pole'/>"
    "<axis xyz='0 1 0'/></joint></robot>"
)
STEP: dict[str, Any] = {
    "parameters": [Exogenous(name="rate", default=1.0, bounds=Box(0.0, 2.0), a=Box(0.5, 1.5))],
    "states": [Measured(name="size", default=1.0, parents=("rate", "size"))],
    "control_dt": 0.1,
}
MODEL = sw.SCM(
    [
        Exogenous(name="x", distribution=Normal(), a=Box(-1.0, 1.0)),
        Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
    ]
)
MODULE = """
    import scm_world as sw
    from scm_world.tasks import Pushing
    from scm_world.variables import Exogenous

    model = sw.SCM([Exogenous(name="x", default=1.0)])

    def task(**options):
        return Pushing(**options)

    def pole():
        return sw.World({xml!r})

    def held():
        return sw.World(model).given({{"x": 3.0}})
"""


def grow(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Let something grow."""
    return {"size": state["size"] * (1.0 + 0.1 * parameters["rate"])}


def physical(folder: Path) -> dict[str, tuple[Any, dict[str, Any]]]:
    """Return sources of worlds with an engine, with their options."""
    (folder / "pole.xml").write_text(XML)
    (folder / "pole.urdf").write_text(URDF)
    spec = mujoco.MjSpec.from_string(XML)
    return {
        "name": ("pushing", {}),
        "task": (Pushing(), {}),
        "class": (Pushing, {}),
        "function": (partial(Pushing), {}),
        "path": (folder / "pole.xml", {}),
        "name of a file": (str(folder / "pole.xml"), {}),
        "URDF": (str(folder / "pole.urdf"), {}),
        "text": (XML, {}),
        "spec": (spec, {}),
        "compiled": (spec.compile(), {}),
        "step function": (grow, STEP),
        "module": (f"{folder / 'mine.py'}:task", {}),
        "world in a module": (f"{folder / 'mine.py'}:pole", {}),
        "springs": ("springs:5", {}),
        "world": (sw.World("pushing"), {}),
    }


def causal(folder: Path) -> dict[str, tuple[Any, tuple[str, ...]]]:
    """Return sources of worlds of equations, with the names of their variables."""
    (folder / "model.json").write_text(to_json(MODEL))
    return {
        "model": (MODEL, ("x", "y")),
        "graph": (graph.SCM(MODEL.variables), ("x", "y")),
        "equations": (sw.World(MODEL), ("x", "y")),
        "file": (str(folder / "model.json"), ("x", "y")),
        "path": (folder / "model.json", ("x", "y")),
        "module": (f"{folder / 'mine.py'}:model", ("x",)),
        "family": ("er2:4", ("x0", "x1", "x2", "x3")),
        "hidden": ("er2:2:1", ("x0", "x1", "x2")),
    }


PHYSICAL = [
    *("name", "task", "class", "function", "path", "name of a file", "URDF", "text", "spec"),
    *("compiled", "step function", "module", "world in a module", "springs", "world"),
]
CAUSAL = ["model", "graph", "equations", "file", "path", "module", "family", "hidden"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a module of sources."""
    made = tmp_path_factory.mktemp("sources")
    (made / "mine.py").write_text(textwrap.dedent(MODULE).format(xml=XML))
    return made


@pytest.mark.parametrize("kind", PHYSICAL)
def test_a_source_with_physics_is_the_same_at_every_entrance(kind: str, folder: Path) -> None:
    """World, Simulation, task, environment, problem, protocols, command and studio agree."""
    sources = physical(folder)
    assert [*sources] == PHYSICAL
    source, options = sources[kind]
    task = make_task(source, **options)
    backend = "step" if kind == "step function" else "fake" if kind != "springs" else "mujoco"
    with sw.World(source, backend=backend, **options) as world:
        assert isinstance(world, sw.World)
        assert world.backend.name == backend
        names = tuple(world.model)
        assert world.task.name == task.name
    with closing(Simulation(source, backend=backend, **options)) as plain:
        assert tuple(plain.model) == names
    with sw.World(source, num_worlds=2, backend=backend, **options) as worlds:
        assert len(worlds) == 2
        assert tuple(worlds.world(1).model) == names
    reward = {} if "reward" in names else {"reward": (np.sum, names[-1])}
    if reward and kind in ("step function", *PHYSICAL[4:10]):
        with closing(gymnasium.make(MODEL_ID, model=source, **options, **reward)) as env:
            assert {*names, "reward"} <= {*env.unwrapped.world.model}
    elif not reward:
        with closing(gymnasium.make(MODEL_ID, model=source, backend=backend)) as env:
            assert tuple(env.unwrapped.world.model) == names
    if not options:
        parts = tuple(part.name for part in protocols_of(task))
        assert parts == tuple(part.name for part in protocols_of(source))
    if isinstance(source, str):
        assert load_system(source).task().name == task.name
        with Spec(source, {}, {"backend": backend}).make() as seen:
            assert tuple(seen.model) == names


@pytest.mark.parametrize("kind", CAUSAL)
def test_a_causal_model_is_the_same_at_every_entrance(kind: str, folder: Path) -> None:
    """World, problem, verification, command, studio and environment take it."""
    sources = causal(folder)
    assert [*sources] == CAUSAL
    source, names = sources[kind]
    with sw.World(source) as world:
        assert isinstance(world, sw.World)
        assert world.engine == "equations"
        assert tuple(world.model) == names
    assert {*problem(source).truth.names} <= {*names}
    assert sw.verify(source, probes=2).outcome != "refuted"
    if isinstance(source, str):
        assert tuple(sw.World(load_system(source)).model) == names
        with Spec(source).make() as seen:
            assert tuple(seen.model) == names
    entrances: tuple[Callable[[Any], Any], ...] = (
        make_task,
        Simulation,
        protocols_of,
        lambda one: gymnasium.make(MODEL_ID, model=one),
    )
    for entrance in entrances:  # nothing acts in it yet
        with pytest.raises(ModelError, match="nothing acts"):
            entrance(source)
    acts: dict[str, Any] = {"actions": {names[0]: (-1.0, 1.0)}, "reward": names[-1]}
    task = make_task(source, **acts)
    with pytest.raises(ModelError, match="no engine"):
        Simulation(task, backend="fake")
    assert protocols_of(task)[0].name == "P0"
    with closing(gymnasium.make(MODEL_ID, model=source, **acts)) as env:
        assert {*env.unwrapped.world.model} == {*names, "reward", "terminated"}
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space
        assert env.step(env.action_space.high)[2]
    with closing(gymnasium.make_vec(MODEL_ID, 2, model=source, **acts)) as envs:
        assert envs.reset(seed=0)[0].shape == (2, *env.observation_space.shape)
    with sw.World(source, num_worlds=2) as worlds:
        assert len(worlds) == 2
        assert tuple(worlds.world(1).model) == names
    for option in ({"backend": "mujoco"}, {"threads": 2}, {"frame_skip": 3}, {"control_dt": 1}):
        with pytest.raises(UnknownOption, match=next(iter(option))):
            sw.World(source, **option)


def test_the_interventions_of_a_world_that_a_function_returns_are_kept(folder: Path) -> None:
    """A world keeps them, and what cannot keep them refuses."""
    name = f"{folder / 'mine.py'}:held"
    world = sw.World(name)
    world.reset(seed=0)
    assert float(world["x"]) == 3.0
    with sw.World(sw.World(XML).given({"pole.mass": 3.0})) as heavy:
        heavy.reset(seed=0)
        assert float(heavy["pole.mass"]) == 3.0
        with pytest.raises(UnknownOption, match=r"pole\.mass"):
            make_task(heavy)


def test_servos_follow_one_another_in_a_world() -> None:
    """The world of a network of servos is the network, as in the problem, and so are many."""
    other = problem("servo:5").setting["nature"]
    with sw.World("servo:5") as world, sw.World("servo:5", num_worlds=2) as worlds:
        for one in (world, worlds.world(0), worlds.world(1)):
            assert {*one.plan} == {*other}
    with sw.World(sw.World(XML).given({"pole.mass": 3.0}), num_worlds=2) as heavy:
        heavy.reset(seed=0)
        assert heavy["pole.mass"].tolist() == [3.0, 3.0]


def test_a_world_made_of_a_world_has_its_options() -> None:
    """Unless others are given; what cannot keep them refuses."""
    with sw.World("reaching", backend="fake", frame_skip=5, max_episode_length=7) as first:
        with sw.World(first) as again:
            assert again.settings == first.settings
            assert (again.backend.name, again.max_episode_length) == ("fake", 7)
        with sw.World(first, max_episode_length=9) as longer:
            assert longer.max_episode_length == 9
        for entrance in (make_task, protocols_of, lambda one: gymnasium.make(MODEL_ID, model=one)):
            with pytest.raises(UnknownOption, match="max_episode_length"):
                entrance(first)


def test_files_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """A pickle of a model finds the functions of its own file."""
    text = (
        "import scm_world as sw\nfrom scm_world.variables import Function\n"
        "def times(x):\n    return {} * x\n"
        "model = sw.SCM([sw.Exogenous(name='x', default=1.0), "
        "sw.Derived(name='y', parents=('x',), mechanism=Function(times))])\n"
    )
    for factor in (2, 3):
        (tmp_path / str(factor)).mkdir()
        (tmp_path / str(factor) / "mine_too.py").write_text(text.format(factor))
    worlds = {f: sw.World(f"{tmp_path / str(f) / 'mine_too.py'}:model") for f in (2, 3)}
    for factor, world in worlds.items():
        again = pickle.loads(pickle.dumps(world))  # noqa: S301 # its own
        again.reset(seed=0)
        assert float(again["y"]) == factor


def test_endings_and_conflicts(tmp_path: Path) -> None:
    """Capitals do not matter; one option is not given twice."""
    (tmp_path / "MODEL.JSON").write_text(to_json(MODEL))
    for source in (tmp_path / "MODEL.JSON", lambda: str(tmp_path / "MODEL.JSON")):
        assert tuple(sw.World(source).model) == ("x", "y")
    with pytest.raises(UnknownOption, match="control_dt"):
        sw.World(XML, frame_skip=4, control_dt=0.05)
    for source in ("picking", "pushing"):
        with pytest.raises(UnknownOption, match="task beside a source"):
            sw.World(source, task="reaching")
    assert sw.World(task="reaching", backend="fake").task.name == "reaching"
    assert sw.World(backend="fake").task.name == "pushing"
    with pytest.raises(UnknownOption, match="task beside a model"):
        gymnasium.make(MODEL_ID, model=Pushing(), task="reaching")
    assert problem("er2:5", view=TaskView(arguments={"seed": 3})).truth.edges == (
        problem("er2:5", seed=3).truth.edges
    )


@pytest.mark.parametrize(
    ("source", "options", "told"),
    [
        ("mars", {}, "pushing"),
        ("er2:1", {}, "er2"),
        ("no_such_module:x", {}, "no_such_module"),
        ("no_such.json", {}, "no_such.json"),
        (3, {}, "SCM"),
        (None, {}, "SCM"),
        (MODEL, {"seed": 3}, "seed"),
        (Pushing(), {"mass": 3}, "left out"),
        ("er2:4", {"size": 3}, "size"),
        (XML, {"nonsense": 1}, "nonsense"),
        (grow, {"nonsense": 1}, "nonsense"),
        (lambda: 3, {}, "SCM"),
        (lambda: sw.World, {}, "SCM"),
    ],
)
def test_what_is_no_source_is_refused(source: Any, options: dict[str, Any], told: str) -> None:
    """The error names what was given, or what is allowed."""
    with pytest.raises(sw.errors.ScmWorldError, match=told):
        sw.World(source, **options)


@pytest.mark.parametrize(
    ("method", "given"), [("fidelity", ()), ("scene", ()), ("cameras", ()), ("compare", ("fake",))]
)
def test_equations_refuse_what_needs_an_engine(method: str, given: tuple[str, ...]) -> None:
    """Every method of a world exists, and says why it cannot be answered."""
    world = sw.World(MODEL)
    with pytest.raises(ModelError, match=f"no {method}: no engine"):
        getattr(world, method)(*given)


def test_a_path_may_have_a_colon(tmp_path: Path) -> None:
    """As paths of Windows do: it names a file, not a module and a function."""
    folder = tmp_path / "C:"
    folder.mkdir()
    (folder / "pair.json").write_text(to_json(sw.SCM([Exogenous(name="x", default=0.5)])))
    with sw.World(str(folder / "pair.json")) as world:
        world.reset(seed=0)
        assert world["x"] == 0.5
    assert Spec(str(folder / "arm.xml")).title == "arm.xml"
