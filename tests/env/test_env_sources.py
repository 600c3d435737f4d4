"""Options of an environment mean the same, however its task is given and whoever makes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world as sw
from scm_world.errors import FunctionFailure, UnknownOption

MODEL = "scm_world/Model-v0"
POLE = """<mujoco><worldbody><body name="pole"><joint name="hinge" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0 0 -1" size="0.05"/></body></worldbody>
<actuator><motor name="m" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""


class Pole(sw.ModelTask):
    """A pole whose episodes begin at rest, but for its speed."""

    model = POLE
    reward = (np.cos, "hinge.position")
    seconds = 0.2
    spaces = {"pole.mass": {"a": (1.0, 3.0)}}  # noqa: RUF012
    start = {"hinge.velocity": 0.5}  # noqa: RUF012


def make_pole(**options: Any) -> Pole:
    """Return such a task."""
    return Pole(**options)


HERE = str(Path(__file__))
SOURCES: dict[str, Any] = {
    "name": "pole of a test",
    "class": Pole,
    "object": Pole(),
    "function": make_pole,
    "file:class": f"{HERE}:Pole",
    "file:function": f"{HERE}:make_pole",
}
OPTIONS: dict[str, dict[str, Any]] = {
    "nothing": {},
    "a space by its name": {"start": {"pole.mass": "A"}},
    "a space": {"start": {"hinge.position": sw.Box(0.1, 0.2)}},
    "a range": {"start": {"hinge": {"position": (0.1, 0.2)}}},
    "a space by a pattern": {"start": {"*.mass": sw.Box(1.5, 2.5)}},
    "a value and an act": {"start": {"hinge.position": 0.15, "pole.mass": sw.Scale(2.0)}},
    "frame_skip": {"frame_skip": 5},
    "observe": {"observe": ["hinge.velocity", "pole.mass"]},
    "observe as custom": {"observe": "hinge.velocity", "observation_mode": "custom"},
    "all": {"start": {"pole.mass": "A"}, "frame_skip": 5, "observe": ["pole.mass"]},
}


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scm_world.tasks.sources._REGISTERED", {})
    sw.tasks.register(type("Registered", (Pole,), {"name": SOURCES["name"]}))


def check(option: str, observed: Any, world: Any) -> None:
    """Compare the beginning of an episode with what the options say."""
    assert world["hinge.velocity"] == 0.5, "the start of the task itself"
    mass, place = float(world["pole.mass"]), float(world["hinge.position"])
    if option in ("a space by its name", "all"):
        assert 1.0 < mass < 3.0
        assert mass != world.model.declared("pole.mass").default
    if option == "a space by a pattern":
        assert 1.5 < mass < 2.5
    if option in ("a space", "a range"):
        assert 0.1 < place < 0.2
    if option == "a value and an act":
        assert place == 0.15
        assert mass == pytest.approx(2.0 * float(world.model.declared("pole.mass").default))
    skip = 5 if option in ("frame_skip", "all") else 10
    assert world.options.control_period == pytest.approx(0.002 * skip)
    expected = {
        "observe": [0.5, mass],
        "observe as custom": [0.5],
        "all": [mass],
    }.get(option, [place, 0.5])
    np.testing.assert_allclose(observed, expected, rtol=1e-6)


@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("source", SOURCES)
def test_options_mean_the_same_for_every_source(source: str, option: str) -> None:
    """One environment, several, and those for Stable-Baselines3 begin as the options say."""
    given = {"model": SOURCES[source], **OPTIONS[option]}
    env = gymnasium.make(MODEL, **given)
    check(option, env.reset(seed=3)[0], env.unwrapped.world)  # type: ignore[attr-defined]
    envs = gymnasium.make_vec(MODEL, num_envs=2, **given)
    seen, _ = envs.reset(seed=2)
    for row, world in enumerate(envs.get_attr("world")):  # type: ignore[attr-defined]
        check(option, seen[row], world)
    np.testing.assert_array_equal(seen[1], env.reset(seed=3)[0])
    env.close()
    envs.close()


@pytest.mark.parametrize("source", SOURCES)
def test_stable_baselines_gets_the_same(source: str) -> None:
    """``make_sb3`` takes what ``make_vec`` takes."""
    pytest.importorskip("stable_baselines3")
    from scm_world.training.sb3 import make_sb3

    envs = make_sb3(MODEL, 2, model=SOURCES[source], **OPTIONS["all"])
    envs.seed(3)
    check("all", envs.reset()[0], envs.get_attr("world")[0])
    envs.close()


@pytest.mark.parametrize("source", ["file:class", "file:function"])
def test_the_command_line_takes_them(source: str, tmp_path: Path) -> None:
    """An evaluation has as many steps as the frame skip says, and masses from the space."""
    from typer.testing import CliRunner

    from scm_world.cli.app import app
    from scm_world.evaluation import Evaluation

    options = ['start={"pole.mass": "A"}', "frame_skip=5"]
    command = [
        "evaluate",
        "random",
        SOURCES[source],
        "--protocols=P0",
        "-n2",
        "--workers=1",
        "--out",
        str(tmp_path),
    ]
    done = CliRunner().invoke(app, [*command, *(f"--env={one}" for one in options)])
    assert done.exit_code == 0, done.output
    found = Evaluation.load(tmp_path).frame
    assert found["steps"].tolist() == [20, 20]
    assert ((found["drawn pole.mass"] > 1.0) & (found["drawn pole.mass"] < 3.0)).all()
    assert found["drawn pole.mass"].nunique() == 2


def test_options_of_a_task_that_is_made_are_refused_by_name() -> None:
    """Its class takes them; an option that neither has is named with those that there are."""
    with pytest.raises(UnknownOption, match=r"options of a Pole cannot be \['seconds'\]"):
        gymnasium.make(MODEL, model=Pole(), seconds=3.0)
    env = gymnasium.make(MODEL, model=Pole, seconds=3.0)
    assert env.unwrapped.world.max_episode_length == 150  # type: ignore[attr-defined]
    with pytest.raises(UnknownOption, match="frame_skip"):
        gymnasium.make(MODEL, model=Pole(), frame_skp=3)
    with pytest.raises(FunctionFailure, match="check raised TypeError"):
        gymnasium.make(MODEL, model=check)
