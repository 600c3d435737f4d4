"""Facts about seeing, doing, effects, differences and causes of outcomes."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scm_world.errors import InterventionError, SnapshotMismatch, UnknownOption, UnreadableFile
from scm_world.queries import (
    Episode,
    Outcome,
    World,
    but_for,
    compare,
    load_episode,
    save_episode,
)
from scm_world.queries.samples import caution, difference
from scm_world.tasks import Pushing

NATURE = {"tool_block.mass": "A", "tool_block.cylindrical_position": "A"}
SLIDE = {"tool_block.linear_velocity": [0.4, 0.0, 0.0]}


def slid(episode: Episode) -> float:
    """Measure how far the block slid along x [m]."""
    place = episode["tool_block.cartesian_position"]
    return float(place[-1, 0] - place[0, 0])


def test_intervals_cover_the_truth() -> None:
    """In 95 of 100 cases, paired or not, and pairing pays as much as is said."""
    random, hits = np.random.default_rng(0), np.zeros(2)
    for _ in range(400):
        unit = random.normal(0.0, 3.0, 12)
        one, other = unit + 1.0 + random.normal(0.0, 1.0, 12), unit + random.normal(0.0, 1.0, 12)
        for paired in (0, 1):
            _, low, high, ratio = difference(one, other, paired=bool(paired))
            hits[paired] += low <= 1.0 <= high
    assert ratio > 2.0
    assert 0.92 < hits[1] / 400 < 0.98
    assert hits[0] / 400 > 0.98  # of pairs taken for strangers: too wide


def test_an_arm_without_variance_does_not_lend_its_degrees_of_freedom() -> None:
    """What is held at a value, compared with five units that vary: Student's t of four degrees."""
    random, held = np.random.default_rng(0), np.ones(5)
    hits = 0
    for _ in range(2000):
        _, low, high, _ = difference(random.normal(1.0, 2.0, 5), held, paired=False)
        hits += low <= 0.0 <= high
    assert 0.94 < hits / 2000 < 0.96


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_more_friction_stops_a_block_sooner(backend: str) -> None:
    """The effect has its sign, the pairs need far fewer units, and both agree."""
    world = World("pushing", backend=backend)
    acts = {"do": {**SLIDE, "floor_friction": 0.6}, "versus": {**SLIDE, "floor_friction": 0.4}}
    nature = {"tool_block.mass": "A", "tool_block.friction": "A"}
    paired = world.effect(slid, **acts, n=12, nature=nature, steps=15, policy=None)
    apart = world.effect(slid, **acts, n=24, nature=nature, steps=15, policy=None, paired=False)
    assert paired.high < 0.0
    assert paired.variance_ratio > 3.0
    assert apart.low < paired.mean < apart.high
    assert json.loads(paired.to_json())["n"] == 12
    assert "n = 12 paired" in str(paired)


def test_colors_have_no_effect_at_all() -> None:
    """Not a small one: none, in every unit, so nothing varies and there is no interval."""
    found = World("pushing").effect(
        "tool_block.cartesian_position", do={"tool_block.color": [0.9, 0.1, 0.1]}, n=4, steps=8
    )
    assert not found.mean.any()
    assert not found.excludes_zero
    assert np.isnan(found.high).all()
    assert found.caution == "nothing varies in 4 units, so there is no interval"


@pytest.mark.parametrize("n", [10, 30])
def test_skewed_effects_come_with_a_word_of_caution(n: int) -> None:
    """Hardly a sample of lognormal effects or of rare responders misses the truth unseen."""
    rng, zeros = np.random.default_rng(0), np.zeros((n, 1))
    for draw, truth in (
        (lambda: rng.lognormal(size=(n, 1)), math.exp(0.5)),
        (lambda: (rng.random((n, 1)) < 0.05) * 1.0, 0.05),
    ):
        unseen = 0
        for _ in range(300):
            sample = draw()
            _, low, high, _ = difference(sample, zeros, paired=True)
            if not caution(sample, zeros, paired=True):
                unseen += not low[0] <= truth <= high[0]
        assert unseen <= 24  # 5 % of 300, and two standard errors
    ordinary = rng.normal(size=(100, 1))
    assert caution(ordinary, np.zeros((100, 1)), paired=True) == ""
    assert "2 components" in caution(
        np.hstack([ordinary, zeros[:1] * ordinary, 0.0 * ordinary]), np.zeros((100, 3)), paired=True
    )


def test_units_are_the_same_in_every_question() -> None:
    """Episode i of a seed is one unit, however many are asked for, by however many threads."""
    world = World("pushing", backend="fake")
    outcomes = ["tool_block.mass", Outcome("reward", "sum"), slid]
    ten = world.see(10, outcomes=outcomes, nature=NATURE, steps=3)
    last = world.sample(3, first=7, outcomes=outcomes, nature=NATURE, steps=3, workers=3)
    assert [*ten] == ["tool_block.mass", "sum reward", "slid"]
    for name in ten:
        np.testing.assert_array_equal(ten[name][7:], last[name])
    assert len(np.unique(ten["tool_block.mass"])) == 10


def test_a_table_goes_to_a_file(tmp_path: Path) -> None:
    """Numbers without loss."""
    found = World("pushing", backend="fake").sample(
        3, {"tool_block.mass": "B"}, outcomes=["tool_block.mass", "joint_positions"], steps=2
    )
    found.frame().to_csv(tmp_path / "table.csv")
    table = np.loadtxt(tmp_path / "table.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, 1], found["tool_block.mass"])
    np.testing.assert_array_equal(table[:, 2:], found["joint_positions"])


def test_effects_over_values_and_by_a_covariate() -> None:
    """Each value against the first; each group of units by itself."""
    world = World("pushing")
    over = world.effect_over(
        "reward", name="tool_block.mass", values=[0.02, 0.02, 0.1], n=3, steps=6
    )
    assert over[0].mean == 0.0
    assert len(over) == 2
    place = Outcome("tool_block.cylindrical_position", "first", 0)
    groups = world.effect_by(
        slid, do=SLIDE, by=place, bins=2, n=8, nature=NATURE, steps=6, policy=None
    )
    assert groups[0][0][1] <= groups[1][0][0]
    assert all(effect.excludes_zero for _, effect in groups)
    assert sum(effect.n for _, effect in groups) == 8


def test_two_episodes_are_compared() -> None:
    """What differs, since when, and which contacts are in one only."""
    world = World("pushing")
    one = world.rollout(steps=10, do=SLIDE)
    assert str(compare(one, one.counterfactual({}))) == "no difference"
    other = one.counterfactual({"floor_friction": "B", "floor_color": [1.0, 0.0, 0.0]}, at=3)
    apart = compare(one, other)
    assert apart.first == 3
    assert apart.variables["first"]["floor_friction"] == 3
    assert apart.variables["first"]["tool_block.linear_velocity"] == 4
    assert "goal_block.size" not in apart.variables.index
    high = one.counterfactual({"tool_block.linear_velocity": [0.0, 0.0, 2.0]}, at=5)
    contacts = compare(one, high).contacts.itertuples(index=False)
    assert (6, ("floor", "tool_block"), "a") in [tuple(contact) for contact in contacts]
    assert compare(one, other, ["floor_color"], tolerance=2.0).variables.empty
    with pytest.raises(UnknownOption, match="10 steps"):
        compare(one, world.rollout(steps=9))


def test_causes_are_told_from_what_did_not_matter() -> None:
    """But for the speed the block would not have moved; the color is innocent."""
    world = World("pushing")
    episode = world.rollout(steps=8, do={**SLIDE, "floor_color": [1.0, 0.0, 0.0]})
    first, last = but_for(episode, slid).itertuples()
    assert (first.causes, last.causes) == (("tool_block.linear_velocity",), ("floor_color",))
    assert first.mattered
    assert not last.mattered
    assert abs(first.without) < 1e-3
    pair = but_for(
        episode,
        lambda e: slid(e) > 0.01,
        {"floor_friction": 0.1, "tool_block.mass": 0.1},
        most=2,
    )
    assert [causes for causes in pair.causes if len(causes) == 2] == [
        ("floor_friction", "tool_block.mass")
    ]
    with pytest.raises(UnknownOption, match="cause"):
        but_for(episode, slid, ["gravity"])


@pytest.mark.parametrize("outcome", [3, None, lambda e: "far", lambda e: math.nan, "nobody"])
def test_what_is_no_outcome_is_refused(outcome: object) -> None:
    """With what it can be."""
    with pytest.raises((UnknownOption, InterventionError)):
        World("pushing", backend="fake").effect(outcome, do=SLIDE, n=2, steps=2)


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_an_episode_in_a_file_happens_again(tmp_path: Path, backend: str) -> None:
    """Bit for bit, with its task's arguments, its plans and its branches."""
    world = World(Pushing(tool_block_mass=0.05), backend=backend, frame_skip=5)
    episode = world.rollout("random", seed=2, episode=5, steps=9, do={"floor_friction": "A"})
    branch = episode.counterfactual({"gravity": [0.0, 0.0, -5.0]}, at=4)
    again = load_episode(save_episode(branch, tmp_path / "branch"))
    assert again == branch
    assert again != episode
    assert again.counterfactual({}, at=6) == branch
    with again.twins.twin() as twin:
        assert twin.made_with["frame_skip"] == 5
    ask = (
        "import sys; from scm_world.queries import load_episode; "
        "print(load_episode(sys.argv[1]).vectors[-1].tobytes().hex())"
    )
    elsewhere = subprocess.run(  # noqa: S603 # our own
        [sys.executable, "-c", ask, str(tmp_path / "branch.npz")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert elsewhere.stdout.strip() == branch.vectors[-1].tobytes().hex()


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    """So is one whose states did not come about again."""
    (tmp_path / "text.npz").write_text("no")
    with pytest.raises(UnreadableFile, match="save_episode"):
        load_episode(tmp_path / "text.npz")
    with pytest.raises(UnreadableFile):
        load_episode(tmp_path / "missing.npz")
    path = save_episode(World("pushing").rollout(steps=3), tmp_path / "one")
    with np.load(path) as found:
        arrays = dict(found)
    about = json.loads(str(arrays["about"]))
    about["instants"][-1] = "0" * 16
    arrays["about"] = np.array(json.dumps(about))
    np.savez(path, **arrays)
    with pytest.raises(SnapshotMismatch, match="control step 3"):
        load_episode(path)
