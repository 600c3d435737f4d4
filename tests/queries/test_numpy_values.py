"""Numbers of NumPy are taken wherever Python's are; nothing is taken in another meaning."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world as sw
from scm_world.curricula import during, goals
from scm_world.discovery import problem
from scm_world.discovery.data import Design, collect
from scm_world.errors import UnknownOption, UnknownVariable
from scm_world.evaluation import evaluate
from scm_world.evaluation.recording import as_data, record
from scm_world.queries import load_episode, save_episode
from scm_world.variables import Box, Normal

SEVEN = [np.int64(7), np.uint8(7), np.array(7)]
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
    written = as_data(record("still", env, 1).environment)
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
    with pytest.raises(UnknownOption, match="True or False"):
        model.effect("a", do={"a": 1.0}, n=2, paired="no")  # type: ignore[arg-type]
    assert model.effect("a", do={"a": 1.0}, n=2, paired=np.bool_(False)).n == 2
