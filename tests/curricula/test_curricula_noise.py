"""Every part draws from a noise of its own: others change none of its draws."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
from curriculum_envs import STILL, series, under, value

from scm_world.curricula import (
    at_step,
    everything,
    goals,
    joints,
    looks,
    physics,
    poses,
    resample,
    timed,
    together,
)
from scm_world.curricula.curriculum import as_curriculum
from scm_world.queries import World
from scm_world.variables import Draw, Normal, Scale, Shift

MASSES = ("tool_block.mass", "robot_finger_60_link_1.mass", "floor_friction", "gravity")
COLORS = ("tool_block.color", "floor_color", "light_azimuth")
POSE = ("tool_block.cylindrical_position", "goal_block.cylindrical_position")


def test_the_noise_of_a_part_is_a_function_of_its_text() -> None:
    """Published draws depend on it: another way to write a part would change all of them."""
    parts = (
        as_curriculum({"floor_friction": "B"}),
        resample("*.mass"),
        goals("A"),
        looks("B"),
        as_curriculum(
            {
                "floor_friction": Scale(0.9),
                "tool_block.mass": Draw("A"),
                "gravity": Shift([0, 0, 0.5]),
            }
        ),
    )
    assert [part.key for part in parts] == [
        "35899b28b745bb32",
        "6d58c699f34d8250",
        "a716ae35245280ea",
        "970192d931ed0468",
        "e042d54f93782377",
    ]


def test_draws_are_those_that_were_published() -> None:
    """Of curricula, of ``start`` and of resets: no release changes them."""
    fixed = {
        "floor_friction": Scale(0.9),
        "tool_block.mass": Draw("A"),
        "gravity": Shift([0, 0, 0.5]),
    }
    parts = everything("A", besides=["@joints", "gravity"]), resample(["*.mass"], "B")
    env = under(together(*parts, as_curriculum(fixed), goals("A")))
    env.reset(seed=3)
    names = ("tool_block.mass", "floor_friction", "stage_friction", "robot_finger_60_link_1.mass")
    found = [float(value(env, name)) for name in names]
    assert found == PUBLISHED
    unscaled = under(together(*parts))  # a scale acts on what the parts before it draw
    unscaled.reset(seed=3)
    assert found[1] == 0.9 * float(value(unscaled, "floor_friction"))
    world = World("pushing", backend="fake")
    drawn = {"tool_block.mass": Draw("A"), "floor_friction": Draw(Normal(0.5, 0.01))}
    world.reset(seed=5, do={**drawn, "stage_friction": Scale(1.1)})
    found = [float(world[name]) for name in names[:3]]
    assert found == [0.028577491422921833, 0.4829695705010773, 0.55]


PUBLISHED = [0.024368482317636414, 0.3248865205675027, 0.38214488904078703, 0.0980027403957813]
"""Values of an episode, as version 0.1 drew them; the second has been scaled since 0.3.0."""


def drawn(part: Any, names: tuple[str, ...], episodes: int = 12) -> list[Any]:
    """Give the values of some variables at the beginning of some episodes."""
    env = under(part)
    found = []
    for number in range(episodes):
        env.reset(seed=0 if number == 0 else None)
        found.append([value(env, name) for name in names])
    return found


def known(names: tuple[str, ...]) -> tuple[str, ...]:
    """Keep the names that there are."""
    model = under({}).unwrapped.world.model
    return tuple(name for name in names if name in model)


@pytest.mark.parametrize(
    "other", [goals("B"), looks("B"), poses("A|B"), joints(), resample("block.size")]
)
def test_another_part_changes_no_draw_of_physics(other: Any) -> None:
    """Masses are the same whatever else is drawn, even where bodies collide and are redrawn."""
    alone = drawn(physics("A"), MASSES)
    assert drawn(together(physics("A"), other), MASSES) == alone
    assert drawn(together(other, physics("A")), MASSES) == alone
    assert alone[0] != alone[1]


def test_redraws_do_happen_in_these_tests() -> None:
    """Poses and joints collide: then both are drawn anew, and colors are not."""
    colors, pose = known(COLORS), (POSE[0],)
    alone = drawn(together(looks(), poses("A|B")), pose)
    crowded = together(looks(), poses("A|B"), joints("A|B"))
    assert drawn(crowded, pose) != alone
    assert drawn(crowded, colors) == drawn(looks(), colors)


def test_a_goal_is_the_same_whatever_becomes_of_the_block() -> None:
    """Goals are no bodies where there is no obstacle: they are drawn once."""
    alone = drawn(goals("A"), POSE[1:])
    assert drawn(together(goals("A"), poses("B"), joints()), POSE[1:]) == alone


def test_a_part_within_the_episode_changes_no_reset() -> None:
    """Draws of another time, or by lot, leave those of the resets alone."""
    alone = drawn(physics("A"), MASSES)
    later = together(physics("A"), at_step(1, physics("B")), timed({"every": 2}, looks()))
    assert drawn(later, MASSES) == alone


def test_draws_have_nothing_in_common_with_those_of_the_environment() -> None:
    """A draw of a curriculum is another one than that of ``start``, or of another part."""
    mass = "tool_block.mass"
    started = under({}, start={mass: "A"})
    one, two = under(resample(mass)), under(resample(["*.mass"]))
    assert len({*map(tuple, (series(env, mass, 3) for env in (started, one, two)))}) == 3


def test_an_episode_does_not_depend_on_those_before() -> None:
    """Seed and number of the episode decide all draws, in any order."""
    part = together(everything(besides="joint_positions"), at_step(2, resample("*.mass")))
    env = under(part)
    forwards = {}
    for episode in (0, 1, 2, 3):
        forwards[episode] = played(env, episode)
    assert {episode: played(env, episode) for episode in (3, 1, 2, 0)} == forwards
    assert len({str(found) for found in forwards.values()}) == 4


def played(env: Any, episode: int) -> Any:
    """Give what an episode begins with, and what it is a little later."""
    env.reset(seed=5, options={"episode": episode})
    names = ("tool_block.mass", *POSE, "floor_color")
    first = [value(env, name) for name in names]
    env.step(STILL)
    env.step(STILL)
    return first, value(env, "tool_block.mass")


def test_another_process_draws_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing depends on hashes or on what was imported."""
    program = (
        "import gymnasium, scm_world;"
        "from scm_world.curricula import *;"
        "part = together(physics('A'), poses('B'), goals('A'), looks());"
        "env = CurriculumEnv(gymnasium.make('scm_world/Pushing-v0', backend='fake'), part);"
        "[env.reset(seed=3 if i == 0 else None) for i in range(3)];"
        "print([env.unwrapped.world[n].tolist() for n in ('tool_block.mass', 'floor_color',"
        " 'tool_block.cylindrical_position', 'goal_block.cylindrical_position')])"
    )
    exec(program, {})  # noqa: S102 # our own text
    here = capsys.readouterr().out
    done = subprocess.run(  # noqa: S603 # our own text
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONHASHSEED": "1", "PATH": ""},
    )
    assert done.stdout == here
    assert here.startswith("[0.0")
