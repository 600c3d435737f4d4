"""Numbers of NumPy are taken wherever Python's are; nothing is taken in another meaning."""

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world as sw
from scm_world.curricula import during, goals
from scm_world.discovery import Levels, problem
from scm_world.discovery.data import Design, collect
from scm_world.discovery.problems import random_model
from scm_world.errors import UnknownOption, UnknownVariable
from scm_world.evaluation import evaluate
from scm_world.evaluation.recording import as_data, record
from scm_world.evaluation.statistics import mean_interval
from scm_world.graph import to_json
from scm_world.policies.planning.policy import CrossEntropy
from scm_world.queries import load_episode, save_episode
from scm_world.tasks import StepTask
from scm_world.variables import Box, Normal

SEVEN = [np.int64(7), np.uint8(7), np.array(7)]
CUSTOM = {"observation_mode": "custom", "observe": ["foo"]}
POLE = """<mujoco><worldbody><body name="pole"><joint name="h"/><geom size="0.05"/></body>
  </worldbody><actuator><motor joint="h" ctrlrange="-1 1"/></actuator></mujoco>"""
GRAVITY = np.array([0.0, 0.0, -9.0])


def pushing(**options: Any) -> Any:
    """Return a short environment without an engine."""
    return gymnasium.make("scm_world/Pushing-v0", backend="fake", max_episode_length=5, **options)


@pytest.fixture(scope="module")
def model() -> sw.SCM:
    """Return a model of one variable."""
    return sw.SCM([sw.Exogenous(name="a", distribution=Normal(), a=Box(-1.0, 1.0))])


@pytest.mark.parametrize("seed", SEVEN)
def test_a_seed_of_numpy_gives_the_same_data(model: sw.SCM, seed: Any, tmp_path: Path) -> None:
    """Tables and episodes are those of the whole number 7, and can be written."""
    table = collect(model, Design(), 10, seed=seed)
    assert table.values.tobytes() == collect(model, Design(), 10, seed=7).values.tobytes()
    er = problem("er2:5")
    found, expected = (er.data("observational", 10, seed=one).values for one in (seed, 7))
    assert found.tobytes() == expected.tobytes()
    world = sw.World("pushing", backend="fake")
    saved = save_episode(world.rollout("random", seed=seed, steps=2), tmp_path / "episode")
    assert load_episode(saved).seed == 7


def test_arrays_of_numpy_are_values_of_nature_and_start() -> None:
    """A context of gravity is the same as a tuple and as an array; a recording keeps it."""
    world = sw.World("pushing", backend="fake")
    options: Any = {"n": 2, "steps": 2, "policy": None}
    found = world.effect("reward", do={}, nature={"gravity": GRAVITY}, **options)
    expected = world.effect("reward", do={}, nature={"gravity": GRAVITY.tolist()}, **options)
    assert found.mean == expected.mean
    env = pushing(start={"gravity": GRAVITY})
    written = as_data(record("still", env, np.int64(1), noise=np.float32(0.0)).environment)
    assert written["start"] == {"gravity": GRAVITY.tolist()}


def test_seeds_of_an_evaluation_may_be_an_array() -> None:
    """Seeds from np.arange are the whole numbers 0 and 1."""
    options: Any = {"n": 1, "env": {"max_episode_length": 5}, "backend": "fake"}
    found = evaluate("still", "P5", seeds=np.arange(2), **options)
    assert str(found) == str(evaluate("still", "P5", seeds=(0, 1), **options))


@pytest.mark.parametrize("share", [np.float32(0.5), np.float64(0.5), np.array(0.5)])
def test_a_share_of_numpy_is_a_share(share: Any) -> None:
    """Half of the episodes are observed, whichever kind of number says so."""
    design = Design("single", ("a",), observational_fraction=share)
    assert design.chosen(0, 0, 10).sum() == 5


@pytest.mark.parametrize("share", [np.float32(1.5), -0.5, True, np.nan, np.ones(2)])
def test_a_share_beyond_one_is_refused(share: Any) -> None:
    """A share is one finite number from 0 to 1."""
    with pytest.raises(UnknownOption, match="observational_fraction"):
        Design("single", ("a",), observational_fraction=share)


@pytest.mark.parametrize("option", ["goal_env", "normalize_actions", "normalize_observations"])
@pytest.mark.parametrize("value", ["False", "no", 2, None])
def test_a_switch_is_true_or_false(option: str, value: Any) -> None:
    """A text is no switch: "False" would be true."""
    with pytest.raises(UnknownOption, match=option):
        pushing(**{option: value})


def test_a_pad_names_variables_that_decide_bodies() -> None:
    """A name that decides nothing of the bodies is refused when the environment is made."""
    with pytest.raises(UnknownVariable, match="foo"):
        pushing(pad={"foo": 3})


@pytest.mark.parametrize("episodes", [[3, 7, 9], [5], (1, 2), 5])
def test_a_list_of_episodes_is_not_read_as_a_range(episodes: Any) -> None:
    """During takes a range; a list would mean these episodes to its reader."""
    with pytest.raises(UnknownOption, match="range"):
        during(episodes, goals("A"))


def test_paired_is_true_or_false() -> None:
    """A text is not taken for true."""
    model = sw.SCM([sw.Exogenous(name="a", distribution=Normal())])
    with pytest.raises(UnknownOption, match="paired cannot be"):
        model.effect("a", do={"a": 1.0}, n=2, paired="no")  # type: ignore[arg-type]
    assert model.effect("a", do={"a": 1.0}, n=2, paired=np.bool_(False)).n == 2


@pytest.mark.parametrize("seven", SEVEN)
def test_checked_functions_get_numbers_of_python(seven: Any) -> None:
    """A number of NumPy, or an array of shape (), gives the model and the table of 7."""
    assert to_json(random_model("er2:4", seed=seven)) == to_json(random_model("er2:4", seed=7))
    table = problem("er2:4", seed=seven).data("observational", seven, seed=seven)
    expected = problem("er2:4", seed=7).data("observational", 7, seed=7)
    assert table.values.tobytes() == expected.values.tobytes()
    assert table.first(seven).values.tobytes() == expected.values.tobytes()
    assert type(Levels("A", seven).count) is int


@pytest.mark.parametrize("seven", SEVEN)
def test_questions_take_numbers_of_numpy(model: sw.SCM, seven: Any) -> None:
    """Values, counts and seeds of NumPy give the numbers that those of Python give."""
    options: Any = {"do": {"a": seven}, "versus": {"a": np.float32(0.5)}, "n": seven}
    found = model.effect("a", seed=seven, **options)
    assert (found.mean, found.n) == (6.5, 7)
    assert model.do({"a": seven}).draw(seven, seed=seven)["a"].tolist() == [7.0] * 7


@pytest.mark.parametrize("two", [np.int64(2), np.array(2)])
def test_environments_take_numbers_of_numpy(two: Any) -> None:
    """Counts, lengths and seeds are those of the whole number 2, in one environment and many."""
    options: Any = {"backend": "fake", "max_episode_length": two}
    many = gymnasium.make_vec("scm_world/Pushing-v0", num_envs=two, **options)
    alone = gymnasium.make("scm_world/Pushing-v0", **options)
    first = many.reset(seed=two)[0]
    assert first.shape[0] == 2
    assert first[0].tobytes() == alone.reset(seed=two)[0].tobytes()
    ends = [alone.step(alone.action_space.sample())[3] for _ in range(2)]
    assert ends == [False, True]


STATE = sw.Measured(name="x", parents=[sw.Parent(name="x", lag=1)])


def stays(before: Any, action: Any, parameters: Any) -> Any:
    """Leave the state alone."""
    return {"x": before["x"]}


def small() -> sw.World:
    """Return a world without an engine."""
    return sw.World("pushing", backend="fake")


@pytest.mark.parametrize(
    ("option", "call"),
    [
        ("copy", lambda no: gymnasium.make_vec("scm_world/Pushing-v0", backend="fake", copy=no)),
        ("every_step", lambda no: collect(small(), Design(), 1, steps=1, every_step=no)),
        ("contacts", lambda no: collect(small(), Design(), 1, steps=1, contacts=no)),
        ("foresees", lambda no: CrossEntropy(foresees=no)),
        ("proportion", lambda no: mean_interval([0.0, 1.0], proportion=no)),
        ("ground", lambda no: sw.World.from_mjcf("<mujoco/>", ground=no)),
        ("vectorized", lambda no: StepTask(stays, states=[STATE], vectorized=no)),
    ],
)
@pytest.mark.parametrize("no", ["no", 0, [False]])
def test_documented_switches_are_true_or_false(option: str, call: Any, no: Any) -> None:
    """A text, a number and a list are no switches."""
    with pytest.raises(UnknownOption, match=f"{option} cannot be .* True or False"):
        call(no)


@pytest.mark.parametrize("options", [{"start": {"foo": 3}}, {"include": ["foo"]}, CUSTOM])
def test_unknown_names_are_refused_when_an_environment_is_made(options: Any) -> None:
    """A typing error is said before the first episode."""
    with pytest.raises(UnknownVariable, match="foo"):
        pushing(**options)


@pytest.mark.parametrize("start", [{"foo": 3}, {"foo": "A"}, {"pole.foo": "A"}])
def test_an_unknown_start_of_a_model_is_refused_when_it_is_made(start: Any) -> None:
    """Values and spaces of an environment of any model are checked alike."""
    with pytest.raises((UnknownOption, UnknownVariable), match="foo"):
        gymnasium.make("scm_world/Model-v0", model=POLE, reward=(np.cos, "h.position"), start=start)


def test_a_start_may_name_bodies_that_an_episode_can_have() -> None:
    """Where variables decide which blocks exist, further blocks may have what blocks have."""
    options: Any = {"backend": "fake", "max_episode_length": 2}
    make = partial(gymnasium.make, "scm_world/CreativeStackedBlocks-v0", **options)
    names = sw.World("creative_stacked_blocks", backend="fake").model
    with pytest.raises(UnknownVariable, match="foo"):
        make(start={"tool_block_level_0_num_0.foo": 3})
    absent = next(f"{n[: -len('0.mass')]}77.mass" for n in names if n.endswith("_0.mass"))
    assert absent not in names
    make(start={absent: 0.1}).close()
