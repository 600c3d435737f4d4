"""Curricula are values: they go to JSON, to files and to other processes, and come back."""

from __future__ import annotations

import copy
import json
import pickle
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import gymnasium
import numpy as np
import pytest
from curriculum_envs import STILL, follow_mass, series, under, value
from gymnasium.envs.registration import EnvSpec
from hypothesis import given, settings
from hypothesis import strategies as st

from scm_world import Draw, Hard, Scale, do
from scm_world.curricula import (
    A,
    B,
    Curriculum,
    at_step,
    during,
    everything,
    follow,
    goals,
    resample,
    stages,
    timed,
    together,
)
from scm_world.curricula.curriculum import as_curriculum, nested
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.graph import SCM
from scm_world.variables import Box, Either, Function, Mechanism, Natural, Normal


def read(text: str, **options: Any) -> Curriculum:
    """Read the text of a curriculum from a file."""
    with NamedTemporaryFile("w", suffix=".json") as file:
        file.write(text)
        file.flush()
        return Curriculum.load(file.name, **options)


LEAVES: list[Any] = [
    {},
    {"floor_friction": 0.4},
    {"block": {"size": [0.05, 0.06, 0.07]}, "tool_block.mass": Draw("B"), "gravity": Scale(0.5)},
    do({"floor_friction": (0.3, Hard(0.2, at=1)), "tool_block": {"mass": Draw("A", every=4)}}),
    {"floor_friction": Mechanism(Function("numpy:mean"), ["floor_color"]), "x": Natural()},
    resample(["*.mass", "@looks"], "A|B", besides="robot_*"),
    resample("tool_block.mass", Normal(0.03, 0.001)),
    resample("*.mass", Either(Box(0.01, 0.02), Box(0.03, 0.04))),
    everything(A["tool_block.*"] * B["*.mass"] - "joint_positions"),
    goals("B", besides="goal_block.euler_orientation"),
    follow("scm_world.tasks.rewards:above"),
    together(goals("A|B"), during(range(3, 10, 2), resample("@published", exclusive=True))),
]


def wrapped(inner: Any) -> Any:
    """Put parts into others."""
    numbers = st.integers(0, 50)
    several = st.lists(inner, min_size=1, max_size=3)
    return st.one_of(
        st.builds(at_step, numbers, inner),
        st.builds(lambda n, at, p: timed({"every": n + 1, "at": at}, p), *[numbers] * 2, inner),
        st.builds(lambda a, n, k, p: during(range(a, a + n + 1, k + 1), p), *[numbers] * 3, inner),
        st.builds(lambda parts: together(*parts), several),
        st.builds(lambda parts: stages(*parts, up=0.75, down=0.25, window=7), several),
    )


@settings(max_examples=60, deadline=None)
@given(st.recursive(st.sampled_from(LEAVES), wrapped, max_leaves=5))
def test_every_curriculum_survives_json_and_pickle(given_part: Any) -> None:
    """Whatever is put together is the same afterwards, with the same noise."""
    one = as_curriculum(given_part)
    again = read(one.to_json(), trusted=["numpy"])
    assert again == one
    assert hash(again) == hash(one)
    assert again.to_json() == one.to_json()
    keys = [[part.key for part in nested(each, Curriculum)] for each in (again, one)]
    assert keys[0] == keys[1]
    assert pickle.loads(pickle.dumps(one)) == one == copy.deepcopy(one)  # noqa: S301 # our own


def test_every_kind_is_tried() -> None:
    """The leaves above and what wraps them are all kinds there are."""
    text = together(*LEAVES, at_step(1, {}), stages({}))
    known = {one.model_fields["kind"].default for one in Curriculum.__subclasses__()}
    assert {part.kind for part in nested(text, Curriculum)} == known


def test_a_file_makes_the_same_episodes(tmp_path: Path) -> None:
    """What was written down and read again draws the same."""
    one = together(goals("A"), resample("*.mass", "B"), at_step(3, {"gravity": "A"}))
    file = tmp_path / "curriculum.json"
    file.write_text(one.to_json())
    again = Curriculum.load(file)
    mass = "tool_block.mass"
    assert series(under(one), mass, 4) == series(under(again), mass, 4)
    assert as_curriculum(json.loads(one.to_json())) == one


def test_functions_of_others_are_called_only_if_trusted() -> None:
    """A file with a function needs a reader who trusts its package; a lambda has no file."""
    text = together({}, follow(follow_mass)).to_json()
    with pytest.raises(UnreadableFile, match="curriculum_envs:follow_mass"):
        read(text)
    env = under(read(text, trusted=["curriculum_envs"]))
    env.reset(seed=0)
    assert value(env, "tool_block.mass") == 0.02
    with pytest.raises(ModelError, match="top level"):
        follow(lambda _: {}).to_json()
    mechanism = Mechanism(Function("os:getcwd"), [])
    with pytest.raises(UnreadableFile, match="os:getcwd"):
        read(together({"floor_friction": mechanism}).to_json())


WRONG = [
    ("[1, 2", "Expecting"),
    ("[]", "expected the format"),
    ('{"format": "scm_world/curriculum/1", "part": {}}', "expected the format"),
    ('{"format": "scm_world/curriculum/2"}', "part of a curriculum"),
    ('{"format": "scm_world/curriculum/2", "kind": "sing"}', "sing"),
    ('{"format": "scm_world/curriculum/2", "kind": "do"}', "request"),
    ('{"format": "scm_world/curriculum/2", "kind": "timed", "part": {}}', "time"),
    ('{"format": "scm_world/curriculum/2", "kind": "goal", "space": "C"}', "C"),
    (
        '{"format": "scm_world/curriculum/2", "kind": "during", "episodes": 1, "part": {}}',
        "range",
    ),
    (
        '{"format": "scm_world/curriculum/2", "kind": "during", "episodes": [1, 9, 0], "part": {}}',
        "zero",
    ),
    (
        '{"format": "scm_world/curriculum/2", "kind": "resample", "what": "a", "mor": 1}',
        "no field of Resample is named 'mor'",
    ),
    (
        '{"format": "scm_world/curriculum/2", "kind": "stages", "of": [{}], "window": 0}',
        "greater than 0",
    ),
]


@pytest.mark.parametrize(("text", "says"), WRONG)
def test_what_is_no_curriculum_is_refused(text: str, says: str, tmp_path: Path) -> None:
    """A wrong file says what is wrong."""
    file = tmp_path / "wrong.json"
    file.write_text(text)
    with pytest.raises(UnreadableFile, match=says) as refused:
        Curriculum.load(file)
    assert "pydantic" not in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_is_not_finite_has_no_file() -> None:
    """It is refused as in a plan."""
    with pytest.raises(ModelError, match="not finite"):
        together({}, {"floor_friction": float("nan")}).to_json()


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    """No file, or one that is no text."""
    with pytest.raises(UnreadableFile, match="absent"):
        Curriculum.load(tmp_path / "absent.json")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UnreadableFile, match="binary"):
        Curriculum.load(tmp_path / "binary")
    with pytest.raises(UnknownOption, match="part of a curriculum"):
        as_curriculum(5)


def test_wrapped_environments_can_be_written_down() -> None:
    """The specification of an environment under plain data is JSON, and makes the same one."""
    one = together(goals("A"), at_step(2, resample("*.mass", A["*"] * B["tool*"])))
    env = under(one.as_dict())
    assert env.spec is not None
    again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(env.reset(seed=4)[0], again.reset(seed=4)[0])
    assert again.get_wrapper_attr("curriculum") == one
    assert again.action_space == env.action_space
    called = under(follow(follow_mass))
    assert isinstance(called.spec.additional_wrappers[-1].kwargs["curriculum"], Curriculum)
    same = gymnasium.make(called.spec)
    np.testing.assert_array_equal(same.reset(seed=0)[0], called.reset(seed=0)[0])


@pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])  # noqa: S301 # our own
def test_copies_go_on_alike(how: Any) -> None:
    """A copy in the middle of an episode goes through the same episodes as the original."""
    part = stages({"tool_block.mass": 0.02}, {"tool_block.mass": 0.03}, window=1, up=1.0)
    env = under(
        together(
            everything(besides="joint_positions"), timed({"every": 2}, resample("*.mass")), part
        )
    )
    env.reset(seed=3)
    env.step(STILL)
    twin = how(env)
    for _ in range(2):
        for _ in range(5):
            np.testing.assert_array_equal(env.step(STILL)[0], twin.step(STILL)[0])
        np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])


def test_a_model_is_no_curriculum() -> None:
    """The text of a graph is refused by its format."""
    with pytest.raises(UnreadableFile, match="format"):
        read(SCM([]).to_json() if hasattr(SCM, "to_json") else "{}")
