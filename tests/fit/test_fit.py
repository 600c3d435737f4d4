"""Parameters are fitted to recordings, on real engines."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import scm_world as sw
from scm_world.cli.app import app
from scm_world.errors import (
    InterventionError,
    ModelError,
    NotIntervenable,
    ScmWorldError,
    UnknownOption,
    UnknownVariable,
    UnreadableFile,
)
from scm_world.fit import Fit
from scm_world.fit.recordings import read_recording
from scm_world.fit.search import gauss_newton
from scm_world.queries.equations import stepped

PENDULUM = """
<mujoco model="pendulum">
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/>
      <site name="tip" pos="0 0 -0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
NOISE = 1e-3  # [rad]
STEPS = 150


@pytest.fixture(scope="module")
def world() -> sw.World:
    """A pendulum with a motor."""
    return sw.World(PENDULUM, outcomes=["tip.position"])


def recorded(world: sw.World, do: dict[str, Any], seed: int = 1) -> pd.DataFrame:
    """Return time, commands and noisy positions of a run with an intervention."""
    episode = world.rollout("random", seed=seed, steps=STEPS, do=do)
    noise = NOISE * np.random.default_rng(seed).normal(size=STEPS + 1)
    arrays = {
        "time": 0.02 * np.arange(STEPS + 1),
        "motor.control": np.append(episode.actions[:, 0], np.nan),
        "hinge.position": episode["hinge.position"] + noise,
    }
    return pd.DataFrame(arrays)


@pytest.fixture(scope="module")
def damped(world: sw.World) -> pd.DataFrame:
    """A recording of one with twice the damping."""
    return recorded(world, {"hinge.damping": 0.02})


@pytest.fixture(scope="module")
def fit(world: sw.World, damped: pd.DataFrame) -> Fit:
    """The fit of damping and mass to it."""
    return world.fit(damped, ["hinge.damping", "pole.mass"])


def test_a_deviation_is_found_with_its_interval(fit: Fit) -> None:
    """Doubled damping; the mass stays; velocities were not measured."""
    rows = fit.table.set_index("parameter")
    for name, true in (("hinge.damping", 0.02), ("pole.mass", 0.2)):
        assert rows.low[name] < true < rows.high[name]
        assert rows.high[name] - rows.low[name] < 0.02 * true
    assert rows.determined.all()
    assert rows.unit["pole.mass"] == "kg"
    assert rows.deviation["hinge.damping"] == pytest.approx(1.0, abs=0.01)
    assert fit.explains
    assert fit.noise[0] == pytest.approx(NOISE, rel=0.2)
    assert not fit.confounded


def test_the_world_with_the_fitted_values_is_another_one(world: sw.World, fit: Fit) -> None:
    """The world that was asked keeps its own."""
    fit.world.reset(seed=0)
    world.reset(seed=0)
    assert float(fit.world["hinge.damping"]) == fit.values["hinge.damping"]
    assert float(world["hinge.damping"]) == 0.01


def test_what_is_known_is_given(world: sw.World) -> None:
    """A fit, an explanation and an experiment are those of the world with its given values."""
    recording = recorded(world, {"hinge.damping": 0.02, "pole.mass": 0.4}).iloc[:61]
    known = world.given({"pole.mass": 0.4})
    names = ["hinge.damping", "motor.gear", "pole.mass"]
    fit = known.fit(recording, names[:2])
    assert fit.explains
    assert fit.values == pytest.approx({"hinge.damping": 0.02, "motor.gear": 1.0}, rel=0.01)
    fit.world.reset(seed=0)
    assert [float(fit.world[name]) for name in names] == [*fit.values.values(), 0.4]
    same = fit.counterfactual({}, draws=2)
    np.testing.assert_allclose(same.counterfactual, recording["hinge.position"], atol=1e-12)
    found = known.explain(recording, names)
    assert found.best == ("hinge.damping",)
    assert found.fits[("hinge.damping",)].explains
    assert not world.fit(recording, names[:2]).explains
    with pytest.raises(ModelError, match=r"pole\.mass at a time.*give values without a time"):
        world.given({"pole.mass": sw.Hard(0.4, at=3)}).fit(recording, names)


def test_residuals_are_those_of_every_measurement(fit: Fit, damped: pd.DataFrame) -> None:
    """A row for each; a picture shows them."""
    rows = fit.residuals
    np.testing.assert_allclose(rows.measured, damped["hinge.position"])
    np.testing.assert_allclose(rows.measured - rows.fitted, rows.residual, atol=1e-12)
    assert rows.scaled.std() == pytest.approx(1.0, abs=0.1)
    assert len(fit.picture().axes) == 2


def test_what_cannot_be_told_apart_is_named_and_an_experiment_determines_it(
    world: sw.World, damped: pd.DataFrame
) -> None:
    """Torque, mass, inertia and damping in one proportion move in the same way."""
    names, short = ["hinge.damping", "pole.mass", "pole.inertia", "motor.gear"], damped.iloc[:61]
    fit = world.fit(short, names)
    assert not fit.identifiable.determined.iloc[-1]
    assert {"pole.mass", "motor.gear"} <= {*fit.confounded[-1]}
    assert "cannot be told apart" in str(fit)
    limits = {"hinge.position": (-2.5, 2.5), "motor.control": (-0.5, 0.5)}
    (experiment,) = world.fit(short, names[1:3]).suggest(steps=60, limits=limits)
    assert experiment.after > experiment.before
    assert np.abs(experiment.commands).max() <= 0.5
    assert experiment.frame().shape == (60, 2)
    again = world.rollout(experiment.commands, steps=60, do=dict(experiment.start))
    assert np.abs(again["hinge.position"]).max() < 2.6


def test_a_payload_under_stiff_servos_needs_another_experiment() -> None:
    """Held still, the arm hardly yields to its load; the suggested motion shows it."""
    servo = '<position name="motor" joint="hinge" kp="400" kv="5" ctrlrange="-1.5 1.5"/>'
    motor = '<motor name="motor" joint="hinge" ctrlrange="-1 1"/>'
    world = sw.World(PENDULUM.replace(motor, servo))
    true = world.given({"pole.mass": 0.3})

    def run(commands: Any, start: dict[str, float], seed: int) -> dict[str, Any]:
        episode = true.rollout(commands, steps=50, do=start)
        noise = 2.0 * NOISE * np.random.default_rng(seed).normal(size=51)
        found = {"time": 0.02 * np.arange(51), "motor.control": episode.actions[:, 0]}
        return found | {"hinge.position": episode["hinge.position"] + noise}

    still = run(np.full(1, 0.3), {"hinge.position": 0.3}, 1)
    before = world.fit(still, "pole.mass")
    assert not before.table.determined[0]
    assert "pole.mass is not determined by this recording" in str(before)
    (experiment,) = before.suggest(1)
    moved = run(experiment.commands, dict(experiment.start), 2)
    after = world.fit([still, moved], "pole.mass").table.iloc[0]
    assert after.determined
    assert after.low < 0.3 < after.high


def test_an_experiment_may_begin_with_a_vector() -> None:
    """A pendulum on a ball joint, which nothing drives, shows its damping from another pose."""
    world = sw.World(
        "<mujoco><worldbody><body name='bob'><joint name='pivot' type='ball' damping='0.01'/>"
        "<geom type='capsule' fromto='0 0 0 0 0 -0.3' size='0.02' mass='0.2'/></body></worldbody>"
        "</mujoco>"
    )
    name, still = "pivot.orientation", world.rollout(steps=10)["pivot.orientation"]
    seen = still + NOISE * np.random.default_rng(0).normal(size=still.shape)
    recording = {"time": 0.02 * np.arange(11), name: seen}
    fit = world.fit(recording, "pivot.damping", noise=NOISE, window=None)
    assert not fit.table.determined.all()
    (experiment,) = fit.suggest(1, steps=20)
    assert len(experiment.start[name]) == 4
    assert f"{name} = [" in str(experiment)
    before, after = experiment.errors["pivot.damping"]
    assert after < 0.1 < before


def test_limits_of_experiments_are_kept_or_refused(fit: Fit) -> None:
    """They cannot exceed the range of a command, or be impossible."""
    with pytest.raises(UnknownOption, match="within -1 to 1"):
        fit.suggest(limits={"motor.control": (-2.0, 2.0)})
    with pytest.raises(UnknownOption, match="all leave the limits"):
        fit.suggest(steps=20, limits={"hinge.velocity": (5.0, 6.0)})
    with pytest.raises(UnknownVariable, match="elbow"):
        fit.suggest(limits={"elbow.*": (0.0, 1.0)})
    with pytest.raises(UnknownOption, match="a dictionary of ranges"):
        fit.suggest(limits=[0.0, 1.0])  # type: ignore[arg-type]


def test_the_parameter_that_explains_is_not_the_one_with_the_largest_effect(
    world: sw.World, damped: pd.DataFrame
) -> None:
    """Mass acts more than damping does; no mass reproduces the recording."""
    found = world.explain(damped.iloc[:61], ["hinge.damping", "pole.mass", "delay"], window=30)
    assert found.best == ("hinge.damping",)
    rows = found.table.set_index("parameters")
    assert rows.explained["hinge.damping"] > 0.999
    assert rows.explained["pole.mass"] < 0.5
    assert rows.explained["none"] == 0.0
    assert "accounts for 100 % of the deviation" in str(found)
    assert found.fit.values["hinge.damping"] == pytest.approx(0.02, rel=0.05)


def test_no_deviation_is_said(world: sw.World) -> None:
    """No candidate is determined, so none of them is preferred."""
    found = world.explain(recorded(world, {}), ["hinge.damping", "pole.mass"], window=10)
    assert found.best == ("none",)
    assert "no parameter is needed: the world explains the recording as it is" in str(found)
    assert not found.table.determined[1:].any()


def test_a_deviation_of_something_else_is_said(world: sw.World) -> None:
    """Damping is not friction, and the length of a pole is not a parameter here."""
    rubbed = recorded(world, {"hinge.frictionloss": 0.1}).iloc[:61]
    found = world.explain(rubbed, ["hinge.damping", "pole.mass"], window=30, noise=NOISE)
    assert "something else deviates, too, or a minimum was missed" in str(found)


def test_ties_are_said() -> None:
    """Two motors of one joint always get the same command."""
    motor = '<motor name="motor" joint="hinge" ctrlrange="-1 1"/>'
    both = motor.replace('"motor"', '"left"') + motor.replace('"motor"', '"right"')
    world = sw.World(PENDULUM.replace(motor, both))
    sent = np.repeat(np.random.default_rng(1).uniform(-0.3, 0.3, 40), 2).reshape(40, 2)
    episode = world.rollout(sent, steps=40, do={"right.gear": 1.5})
    noise = NOISE * np.random.default_rng(2).normal(size=41)
    arrays = {"time": 0.02 * np.arange(41), "hinge.position": episode["hinge.position"] + noise}
    arrays |= {f"{name}.control": sent[:, 0] for name in ("left", "right")}
    found = world.explain(arrays, ["left.gear", "right.gear", "hinge.damping"], window=20)
    assert {*found.best} == {"left.gear", "right.gear"}
    assert "the recording cannot tell apart" in str(found)


def test_friction_of_a_joint_that_sticks_is_not_screened_out() -> None:
    """At its default the joint sticks, and a small change of its friction changes nothing."""
    sticking = PENDULUM.replace('damping="0.01"', 'damping="0.01" frictionloss="1.5"')
    world = sw.World(sticking)
    loose = recorded(world, {"hinge.frictionloss": 0.7}).iloc[:41]
    names = ["hinge.damping", "pole.mass", "motor.gear", "hinge.frictionloss"]
    found = world.explain(loose, names, window=20)
    assert found.best == ("hinge.frictionloss",)
    assert found.fit.values["hinge.frictionloss"] == pytest.approx(0.7, rel=0.02)


def test_parameters_explain_together(world: sw.World) -> None:
    """The set is named in which all deviate, and no larger one."""
    both = recorded(world, {"hinge.damping": 0.02, "pole.mass": 0.25})
    names = ["hinge.damping", "hinge.armature", "pole.mass"]
    found = world.explain(both.iloc[:61], names, most=3, window=30)
    assert found.best == ("hinge.damping + pole.mass",)
    assert found.bic[()] - found.bic["hinge.damping", "pole.mass"] > 100.0


def test_a_counterfactual_of_a_recorded_run(
    world: sw.World, fit: Fit, damped: pd.DataFrame
) -> None:
    """Nothing done gives what was measured; a heavier pole what it would have been."""
    same = fit.counterfactual({}, at=50, draws=4)
    np.testing.assert_allclose(same.counterfactual, damped["hinge.position"], atol=1e-12)
    found = fit.counterfactual({"pole.mass": 0.4}, at=50)
    episode = world.rollout("random", seed=1, steps=STEPS, do={"hinge.damping": 0.02})
    other = episode.counterfactual({"pole.mass": 0.4}, at=50)
    true = (other["hinge.position"] - episode["hinge.position"])[51:]
    got = (found.counterfactual - found.measured).to_numpy()
    assert np.abs(true).max() > 0.3
    assert np.abs(got[:51]).max() < 1e-12
    np.testing.assert_allclose(got[51:], true, atol=5e-3)
    assert (found.low <= found.counterfactual + 1e-9)[51:].mean() > 0.9
    with pytest.raises(UnknownOption, match="0 to 149"):
        fit.counterfactual({}, at=150)
    with pytest.raises(InterventionError):
        fit.counterfactual({"pole.mass": -1.0}, draws=2)


def test_a_delay_of_commands_is_fitted(world: sw.World) -> None:
    """It is one of the candidates where there are commands."""
    late = recorded(world, {})
    episode = world.rollout("random", seed=1, steps=STEPS)
    sent = episode.actions[:, 0]
    shifted = np.append(sent[2:], [0.0, 0.0])  # what was sent two steps before it acted
    late["motor.control"] = np.append(shifted, np.nan)
    rows = world.fit(late.iloc[3:-3], ["delay", "hinge.damping"]).table.set_index("parameter")
    assert rows.value["delay"] == pytest.approx(0.04, abs=2e-3)
    assert rows.unit["delay"] == "s"


def test_a_fitted_delay_is_one_of_the_commands_of_the_fitted_world(world: sw.World) -> None:
    """It replays the recording; beside a delay that commands have, it is refused."""
    late = sw.World(PENDULUM, delay={"motor.control": 1.4})
    fit = world.fit(recording := late.rollout("random", seed=1, steps=60), "delay")
    assert fit.values["delay"] == pytest.approx(0.028, abs=1e-4)
    again = fit.world.rollout(recording.actions, steps=60)
    np.testing.assert_allclose(again["hinge.position"], recording["hinge.position"], atol=2e-3)
    fit.world.reset(seed=0)
    assert float(fit.world["motor.control_delay"]) == pytest.approx(1.4, abs=5e-3)
    later = sw.World(PENDULUM, delay={"motor.control": 2.4})
    sent = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 1))
    sent[:3] = 0.0  # the first command, which held before
    run = later.rollout(sent, steps=30)
    given = {"time": 0.02 * np.arange(31), "motor.control": run.actions[:, 0]}
    table = {**given, "hinge.position": run["hinge.position"]}
    with pytest.raises(NotIntervenable, match=r"have already; fit motor\.control_delay"):
        late.fit(table, "delay")
    own = sw.World(PENDULUM, delay={"motor.control": sw.Box(0.0, 3.0)})
    second = own.given({"motor.control_delay": 1.0}).fit(table, "motor.control_delay")
    assert second.values["motor.control_delay"] == pytest.approx(2.4, abs=1e-4)


def test_the_size_of_a_body_that_lies_is_fitted() -> None:
    """It grows into the floor: start states lift it."""
    ball = (
        '<mujoco><worldbody><geom name="floor" type="plane" size="5 5 .1"/>'
        '<body name="ball" pos="0 0 SIZE"><freejoint/>'
        '<geom name="shell" type="sphere" size="SIZE" mass="1"/></body></worldbody></mujoco>'
    )
    true = sw.World(ball.replace("SIZE", "0.13"))
    episode = true.rollout(None, steps=20, do={"ball.linear_velocity": [1.0, 0.2, 0.0]})
    seen = {n: episode[n] for n in ("ball.cartesian_position", "ball.orientation")}
    world = sw.World(ball.replace("SIZE", "0.1"))
    fit = world.fit({"time": 0.02 * np.arange(21), **seen}, "shell.size")
    assert fit.values["shell.size"] == pytest.approx(0.13, rel=0.01)


def test_candidates_that_cannot_be_best_are_screened(world: sw.World, damped: pd.DataFrame) -> None:
    """They have predictions in place of fits, which is said."""
    found = world.explain(damped.iloc[:61], window=30)
    assert found.best == ("hinge.damping",)
    assert found.screened
    assert (~found.table.fitted).sum() == len(found.screened)
    assert f"{len(found.screened)} of {len(found.table)} candidates were not fitted" in str(found)


def test_an_unreachable_fit_is_said(world: sw.World) -> None:
    """No damping makes a stronger motor."""
    recording = recorded(world, {"motor.gear": 1.5}).iloc[:61]
    fit = world.fit(recording, "hinge.damping", noise=NOISE)
    assert not fit.explains
    assert "no values that were found explain them; where bodies bump, window=10 may" in str(fit)
    assert fit.table.low[0] == 0.0
    assert fit.table.high[0] > 1.2 * fit.table.value[0]  # the interval is not that of the noise


def test_recordings_of_many_kinds(world: sw.World, damped: pd.DataFrame, tmp_path: Path) -> None:
    """Files, frames and arrays are read alike, and so are episodes, datasets and Minari's."""
    from scm_world.discovery import Design, collect

    def read(recording: Any) -> tuple[Any, ...]:
        found = read_recording(world, recording)
        names = [column.name for column in found.columns]
        order = np.argsort(names)
        runs = [(run.commands, run.instants, run.values[:, order]) for run in found.runs]
        return sorted(names), runs

    damped = damped.iloc[:41].reset_index(drop=True)
    damped.to_csv(tmp_path / "run.csv", index=False)
    damped.to_parquet(tmp_path / "run.parquet")
    arrays: dict[str, Any] = {str(name): damped[name].to_numpy() for name in damped}
    np.savez(tmp_path / "run.npz", **arrays)
    episode = world.rollout("random", seed=2, steps=40, do={"hinge.damping": 0.02})
    states = {"time": 0.02 * np.arange(41), "motor.control": episode.actions[:, 0]}
    states |= {name: episode[name] for name in ("hinge.position", "hinge.velocity")}

    class OfMinari:
        observations = np.column_stack([episode[name] for name in world.observed])
        actions = episode.actions

    seen = {name: episode[name] for name in world.observed} | states
    two = pd.concat([damped.assign(episode=0), damped.assign(episode=1)])
    same: list[tuple[Any, Any]] = [
        *((kind, damped) for kind in (tmp_path / "run.csv", str(tmp_path / "run.parquet"))),
        (tmp_path / "run.npz", arrays),
        (damped, damped.iloc[:, ::-1]),
        (two, [damped, damped]),
        (episode, states),
        (OfMinari, seen),
    ]
    for one, other in same:
        (names, runs), (others, wanted) = read(one), read(other)
        assert names == others
        for run, good in zip(runs, wanted, strict=True):
            for got, right in zip(run, good, strict=True):
                np.testing.assert_array_equal(got, right)
    rows = collect(world.given({"hinge.damping": 0.02}), Design(), 2, every_step=True, steps=30)
    fit = world.fit(rows, "hinge.damping", noise=NOISE)
    assert fit.values["hinge.damping"] == pytest.approx(0.02, rel=0.1)


@pytest.mark.filterwarnings("ignore::UserWarning:minari")
def test_a_dataset_of_minari(world: sw.World, tmp_path: Path, monkeypatch: Any) -> None:
    """Its observations are those of the environment, in units."""
    minari = pytest.importorskip("minari")
    spaces = pytest.importorskip("gymnasium").spaces
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    buffers, episodes = [], []
    for number in range(2):
        episode = world.rollout("random", seed=number, steps=30, do={"hinge.damping": 0.02})
        ends = np.arange(30) == 29
        buffers.append(
            minari.data_collector.EpisodeBuffer(
                id=number,
                observations=np.column_stack([episode[name] for name in world.observed]),
                actions=episode.actions,
                rewards=[0.0] * 30,
                terminations=[False] * 30,
                truncations=ends.tolist(),
            )
        )
        episodes.append(episode)
    width = buffers[0].observations.shape[1]
    box = {"observation_space": spaces.Box(-np.inf, np.inf, (width,), np.float64)}
    box["action_space"] = spaces.Box(-1.0, 1.0, (1,), np.float64)
    found = minari.create_dataset_from_buffers("fit/pendulum-v0", buffers, **box)
    for given, count in ((found, 2), (found[1], 1)):
        measured = read_recording(world, given)
        runs = measured.runs
        assert len(runs) == count
        place = [column.name for column in measured.columns].index("hinge.velocity")
        np.testing.assert_array_equal(runs[-1].values[:, place], episodes[1]["hinge.velocity"])
        np.testing.assert_array_equal(runs[-1].commands, episodes[1].actions.clip(-1.0, 1.0))


def test_rows_may_be_sparse(world: sw.World, damped: pd.DataFrame) -> None:
    """A command holds until the next row."""
    held = damped.copy()
    held["motor.control"] = np.repeat(damped["motor.control"][::5], 5)[: len(damped)].to_numpy()
    commands = np.nan_to_num(held["motor.control"].to_numpy())[:-1, None]
    episode = world.rollout(commands, steps=STEPS, do={"hinge.damping": 0.03})
    held["hinge.position"] = episode["hinge.position"]
    fit = world.fit(held.iloc[::5], "hinge.damping")
    assert fit.values["hinge.damping"] == pytest.approx(0.03, rel=1e-3)


def test_lost_rows_and_cells_cost_information_only(world: sw.World, damped: pd.DataFrame) -> None:
    """A gap ends a run, as its commands are not known; an empty cell was not measured."""
    lost = damped.copy()
    lost.loc[[5, 6, 40], "hinge.position"] = np.nan
    lost.loc[70, ["hinge.position", "motor.control"]] = np.nan
    lost = lost.drop(index=range(100, 117))
    fit = world.fit(lost, ["hinge.damping", "pole.mass"])
    assert [len(run.instants) for run in fit.runs] == [71, 29, 34]
    assert [run.begin for run in fit.runs] == pytest.approx([0.0, 1.42, 2.34])
    rows = fit.table.set_index("parameter")
    for name, true in (("hinge.damping", 0.02), ("pole.mass", 0.2)):
        assert rows.low[name] < true < rows.high[name]
        assert rows.high[name] - rows.low[name] < 0.03 * true
    assert fit.explains
    assert fit.noise[0] == pytest.approx(NOISE, rel=0.2)
    seen = damped["hinge.position"].drop(index=[5, 6, 40, 70, *range(100, 117)])
    np.testing.assert_allclose(fit.residuals.measured, seen)
    np.testing.assert_allclose(fit.residuals.time, damped.time[seen.index], atol=1e-9)
    same = fit.counterfactual({}, run=1, draws=2)
    np.testing.assert_allclose(same.counterfactual, damped["hinge.position"][71:100], atol=1e-12)


def test_sensors_of_two_rates(world: sw.World, damped: pd.DataFrame) -> None:
    """One measures in every fourth row; another run lacks it."""
    episode = world.rollout("random", seed=1, steps=STEPS, do={"hinge.damping": 0.02})
    speed = episode["hinge.velocity"] + 0.01 * np.random.default_rng(3).normal(size=STEPS + 1)
    slow = damped.assign(**{"hinge.velocity": np.where(np.arange(STEPS + 1) % 4, np.nan, speed)})
    fit = world.fit([slow, damped.iloc[:61]], "hinge.damping")
    assert fit.values["hinge.damping"] == pytest.approx(0.02, rel=0.02)
    assert fit.explains
    assert fit.noise == pytest.approx([NOISE, 0.01], rel=0.3)
    assert np.bincount(fit.residuals.run).tolist() == [151 + 38, 61]
    with pytest.raises(UnknownOption, match="at least 5 measurements; give noise="):
        world.fit(slow.iloc[:15], "hinge.damping")


def test_clocks_of_robots(world: sw.World, damped: pd.DataFrame) -> None:
    """Times jitter, drift and begin anywhere; angles are wrapped; files round."""
    rng = np.random.default_rng(0)
    wrapped = np.linspace(0.0, 9.0, STEPS + 1)
    given = damped.assign(
        time=1.7e9 + 1.001 * damped.time + rng.uniform(-2e-3, 2e-3, STEPS + 1),
        **{"hinge.position": (wrapped + np.pi) % (2.0 * np.pi) - np.pi},
    )
    given.loc[3, "motor.control"] = 1.0001
    (run,) = read_recording(world, given).runs
    np.testing.assert_array_equal(run.instants, np.arange(STEPS + 1))
    np.testing.assert_allclose(run.values[:, 0], wrapped)
    assert run.commands.max() == 1.0
    with pytest.raises(ModelError, match=r"by row 10: rows are usually 0\.02 s"):
        read_recording(world, damped.assign(time=damped.time + 0.009 * (damped.index == 10)))


def test_readouts_are_measurements(world: sw.World) -> None:
    """The place of the tip alone determines the damping."""
    episode = world.rollout("random", seed=3, steps=100, do={"hinge.damping": 0.02})
    time = 0.02 * np.arange(101)
    arrays = {"time": time, "motor.control": episode.actions[:, 0]}
    fit = world.fit({**arrays, "tip.position": episode["tip.position"]}, "hinge.damping")
    assert fit.values["hinge.damping"] == pytest.approx(0.02, rel=1e-2)
    assert [column.name for column in fit.columns][:2] == ["tip.position[0]", "tip.position[1]"]


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (
            lambda d: d.rename(columns={"hinge.position": "knee"}),
            ModelError,
            "rename a column.* 'knee'",
        ),
        (lambda d: d.assign(**{"hinge.angle": 0.0}), ModelError, r"hinge.velocity \[rad/s\]"),
        (lambda d: d.assign(**{"end.position[0]": 0}), ModelError, r"outcomes=\['end.position'\]"),
        (lambda d: d.drop(columns="time"), ModelError, "no column 'time'"),
        (lambda d: d.iloc[-2::-1], ModelError, "time does not rise in row 1"),
        (lambda d: d.iloc[[0, 1, 2, 2, 3]], ModelError, "remove repeated ones"),
        (lambda d: d.assign(time=d.time * 0.77), ModelError, "control_dt=0.0154"),
        (lambda d: d.assign(time=d.time * 0.1), ModelError, "control_dt=0.002"),
        (lambda d: d.assign(time=d.time * 1e3), ModelError, "the time in seconds"),
        (lambda d: d.assign(time=pd.to_datetime(d.time, unit="s")), ModelError, "give seconds"),
        (lambda d: d.assign(time=d.time.where(d.time > 0.0)), ModelError, "'time' is nan: remove"),
        (
            lambda d: d.assign(**{"motor.control": 1.5}),
            ModelError,
            r"limits \[-1, 1\] N m: clip it",
        ),
        (lambda d: d.assign(**{"motor.control": 57.3}), ModelError, "convert it"),
        (lambda d: d.assign(**{"motor.control": np.nan}), ModelError, "no command is known"),
        (
            lambda d: d.drop(columns="motor.control"),
            ModelError,
            r"motor.control \[N m\] are missing",
        ),
        (lambda d: d.drop(columns="hinge.position"), ModelError, "nothing was measured"),
        (lambda d: d.replace(d["hinge.position"][7], np.inf), ModelError, "row 7"),
        (lambda d: d.iloc[:1], ModelError, "two rows or more"),
        (lambda d: d.iloc[:0], ModelError, "two rows or more"),
        (lambda d: pd.concat([d, d[["hinge.position"]]], axis=1), ModelError, "more than once"),
        (lambda d: d.iloc[:3], UnknownOption, "at least"),
        (lambda d: d.assign(**{"pole.mass": 0.2}), ModelError, "not measured"),
        (lambda d: d.assign(**{"hinge.position": "low"}), ModelError, "not numbers"),
        (lambda d: [d, d.assign(knee=0.0)], ModelError, "run 1: rename .* 'knee'"),
        (lambda d: {"time": d.time, "hinge.position": [0.0]}, ModelError, "a row for each instant"),
        (lambda d: 5, UnknownOption, ".csv, .txt, .tsv, .parquet or .npz"),
        (lambda d: [], UnknownOption, "one or more runs"),
        (lambda d: "missing.csv", UnreadableFile, "there is no such file; give the path"),
        (lambda d: "run.mat", UnknownOption, ".csv, .txt, .tsv, .parquet, .npz"),
    ],
)
def test_wrong_recordings_are_refused(
    world: sw.World, damped: pd.DataFrame, change: Any, error: type[ScmWorldError], words: str
) -> None:
    """The message names the fault, and what to do."""
    with pytest.raises(error, match=words):
        world.fit(change(damped), ["hinge.damping", "pole.mass", "motor.gear"])


def test_orientations_alone_determine_the_proportions_of_an_inertia() -> None:
    """Angular velocities are guessed from them; the signs of quaternions do not matter."""
    box = '<body name="box"><freejoint/><geom type="box" size=".1 .2 .3" density="300"/></body>'
    world = sw.World(f"<mujoco><worldbody>{box}</worldbody></mujoco>")
    start = {"box.inertia": [0.5, 0.3, 0.24], "box.angular_velocity": [1.0, 2.0, 3.0]}
    seen = world.rollout(None, seed=0, steps=40, do=start)["box.orientation"].copy()
    seen += 1e-4 * np.random.default_rng(0).normal(size=seen.shape)
    seen[::3] *= -1.0
    given = {"time": 0.02 * np.arange(41), "box.orientation": seen}
    fit = world.fit(given, ["box.inertia[0]", "box.inertia[1]"])
    assert fit.explains
    assert fit.values["box.inertia[0]"] == pytest.approx(0.5, rel=5e-3)
    assert fit.values["box.inertia[1]"] == pytest.approx(0.3, rel=5e-3)
    same = fit.counterfactual({}, at=10, draws=2)
    assert np.abs(same.measured - same.counterfactual).max() < 1e-9
    seen[5] = 0.0
    with pytest.raises(ModelError, match=r"row 5 of 'box.orientation' has the length 0"):
        world.fit(given, "box.inertia[0]")


def test_a_vector_of_commands_is_no_measurement() -> None:
    """It is read as the commands that it consists of, and not beside them."""
    two = PENDULUM.replace("</actuator>", '<motor name="brake" joint="hinge"/></actuator>')
    world = sw.World(two)
    world.reset(seed=0)
    time, commands = [0.0, 0.02, 0.04], np.array([[0.1, 0.2], [0.3, 0.4], [np.nan, np.nan]])
    given = {"time": time, "action": commands, "hinge.position": np.zeros(3)}
    measured = read_recording(world, given)
    (run,), columns = measured.runs, measured.columns
    assert [column.name for column in columns] == ["hinge.position"]
    np.testing.assert_array_equal(run.commands, commands[:2])
    with pytest.raises(ModelError, match=r"action\[0\], motor.control give a number more than"):
        read_recording(world, {**given, "motor.control": commands[:, 0]})


def test_wrong_arguments_are_refused(world: sw.World, damped: pd.DataFrame) -> None:
    """Parameters, noise and windows."""
    for parameters, error in (
        ("elbow.damping", UnknownVariable),
        ("*.stifness", UnknownVariable),
        ("hinge.position", NotIntervenable),
        ("motor.control", NotIntervenable),
    ):
        with pytest.raises(error):
            world.fit(damped, parameters)
    with pytest.raises(UnknownOption, match="parameters cannot be None"):
        world.fit(damped, None)
    with pytest.raises(UnknownOption, match="above zero"):
        world.fit(damped, "hinge.damping", noise=0.0)
    with pytest.raises(UnknownVariable):
        world.fit(damped, "hinge.damping", noise={"elbow.position": 1.0})
    with pytest.raises(UnknownOption, match="window"):
        world.fit(damped, "hinge.damping", window=1)


@pytest.mark.parametrize("name", ["rate", "delay"])
def test_a_step_function_is_fitted(name: str) -> None:
    """Any world has parameters, of any name; one that draws noise cannot be fitted."""

    def cooled(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
        rate, here = parameters[name], state["warmth"]
        return {"warmth": here + 0.1 * (action["heat"] - rate * here)}

    declared: dict[str, Any] = {
        "parameters": [sw.Exogenous(name=name, default=0.5, bounds=sw.Box(0.0, 5.0))],
        "states": [sw.Measured(name="warmth", default=1.0)],
        "actions": [sw.Action(name="heat", bounds=sw.Box(0.0, 1.0))],
        "control_dt": 0.1,
    }
    world = sw.World(cooled, **declared)
    fit = world.fit(world.rollout("random", seed=1, steps=50, do={name: 0.8}), name)
    assert fit.values[name] == pytest.approx(0.8, rel=1e-4)
    from scm_world.variables import Normal

    noisy = sw.World(cooled, noise={"draft": Normal(0.0, 1.0)}, **declared)
    with pytest.raises(ModelError, match="draws noise"):
        noisy.fit(noisy.rollout(steps=20), name)


def test_a_bullet_world_is_fitted() -> None:
    """The other engine, one world after another."""
    pytest.importorskip("pybullet")
    world = sw.World(PENDULUM, backend="bullet")
    recording = world.rollout("random", seed=1, steps=20, do={"hinge.damping": 0.02})
    fit = world.fit(recording, "hinge.damping", window=10)
    assert fit.values["hinge.damping"] == pytest.approx(0.02, rel=0.01)


def test_the_command(damped: pd.DataFrame, tmp_path: Path, monkeypatch: Any) -> None:
    """It prints the table, and writes results with versions and seed."""
    monkeypatch.chdir(tmp_path)
    Path("pendulum.xml").write_text(PENDULUM)
    damped.to_csv("plain.csv", index=False)  # without the column that is renamed
    spoiled = damped.rename(columns={"motor.control": "torque"}).assign(temperature=20.0)
    spoiled.to_csv("run.csv", index=False, sep=";", decimal=",")
    damped = spoiled
    damped.iloc[20:61].to_parquet("more.parquet")
    words = ["fit", "pendulum.xml", "run.csv", "more.parquet", "--out", "out"]
    more = ["--parameters", "*.damping", "--noise", "hinge.position=0.001"]
    asked = ["--suggest", "1", "--steps", "40", "--limits", "hinge.position=-2,2"]
    asked += ["--do", "pole.mass=0.3", "--at", "10", "--run", "1", "--predict", "run.csv"]
    asked += ["--predict", "plain.csv"]
    more += ["--column", "torque=motor.control", "--ignore", "temp*"]
    asked += ["--begins", "hinge.velocity=0,1", "--held-out", "0.3"]
    done = CliRunner().invoke(app, [*words, *more, *asked], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "2 runs of 135 rows, 2.66 s, 1 measured column" in done.output
    assert "hinge.damping" in done.output
    assert "experiment 1: 40 control steps (0.8 s)" in done.output
    assert "with pole.mass=0.3 from 10 on" in done.output
    import json

    found = json.loads(Path("out/result.json").read_text())
    assert found["fit"][0]["value"] == pytest.approx(0.02, rel=0.02)
    assert found["backend"] == "mujoco"
    assert found["replay"][0]["fit"] < 0.3 * found["replay"][0]["constant"]
    assert {*found["predictions"]} == {"run.csv", "plain.csv", "held out"}
    assert found["predictions"]["run.csv"][0]["skill"] > 0.9
    assert "hinge.velocity at the start" in found["noise"]
    assert {"seed", "versions", "noise", "remarks"} <= {*found}
    assert {*(path.name for path in Path("out").iterdir())} == {
        *("result.json", "residuals.csv", "fit.png", "experiment-1.csv", "counterfactual.csv")
    }
    assert pd.read_csv("out/counterfactual.csv").time.min() == pytest.approx(0.4)
    damped.iloc[:31].to_csv("short.csv", index=False)
    never = ["--suggest", "1", "--limits", "hinge.velocity=5,6", "--out", "never"]
    done = CliRunner().invoke(app, ["fit", "pendulum.xml", "short.csv", *more, *never])
    assert done.exit_code == 2
    assert Path("never/result.json").exists()  # the fit is written nevertheless
    assert "most of them those of hinge.velocity (5 to 6)" in " ".join(done.output.split())
    short = ["fit", "pendulum.xml", "short.csv", "--out", "why", "--window", "30", *more[-4:]]
    done = CliRunner().invoke(app, short, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    why = json.loads(Path("why/result.json").read_text())["explanation"]
    assert {"none", "hinge.damping", "hinge.armature", "delay"} <= {r["parameters"] for r in why}
    done = CliRunner().invoke(app, [*words[:3], *more[-4:], "--parameters", "knee.*"])
    assert done.exit_code == 2
    assert "no variable fits the pattern 'knee.*'" in done.output


def test_equations_are_fitted_as_a_step_function() -> None:
    """Least squares of the autoregression, in closed form, finds the same numbers."""
    model = sw.SCM(
        [
            sw.Exogenous(name="rate", default=0.1, bounds=sw.Box(0.0, 1.0)),
            sw.Exogenous(name="gain", default=1.0, bounds=sw.Box(0.0, 5.0)),
            sw.Action(name="u", bounds=sw.Box(-1.0, 1.0)),
            sw.Derived(
                name="x",
                parents=(
                    sw.Parent("x", 1),
                    sw.Parent("rate"),
                    sw.Parent("u", 1),
                    sw.Parent("gain"),
                ),
                mechanism=_decays,
                start=2.0,
            ),
            sw.Derived(name="y", parents=("x",), mechanism=sw.Linear(weights=(3.0,))),
        ]
    )
    world = sw.World(model)
    episode = world.rollout("random", do={"rate": 0.3, "gain": 2.0}, seed=1, steps=40)
    x, u = episode["x"], episode["u"]
    found = np.linalg.lstsq(np.column_stack([x[:-1], u[:-1]]), x[1:], rcond=None)[0]
    np.testing.assert_allclose(found, [0.7, 2.0], atol=1e-9)
    recording = {"time": np.arange(41.0), "u": u, "x": x}
    for given in (recording, episode):
        table = world.fit(given, ["rate", "gain"]).table.set_index("parameter")["value"]
        np.testing.assert_allclose([table["rate"], table["gain"]], [1.0 - found[0], found[1]], 1e-5)


RATE = sw.Exogenous(name="a", default=1.0, bounds=sw.Box(0.0, 1.0))
NOISY = sw.Derived(
    name="b",
    parents=(sw.Parent("b", 1), "a"),
    mechanism=sw.Linear(weights=(0.5, 1.0)),
    noise=sw.variables.Normal(),
)
NOISELESS = NOISY.model_copy(update={"noise": None})
COMMANDED = sw.Derived(
    name="b", parents=(sw.Parent("b", 1), "u"), mechanism=sw.Linear(weights=(0.5, 1.0))
)


@pytest.mark.parametrize(
    ("variables", "told"),
    [
        ([sw.Derived(name="b", parents=(sw.Parent("a", 2),), mechanism=sw.Linear(weights=(1.0,)))],
         "one step"),
        ([sw.Derived(name="b", parents=("a",), mechanism=sw.Linear(weights=(1.0,)))],
         "without lagged"),
        ([NOISY], "noise of 'b' moves"),
        ([sw.Action(name="u", bounds=sw.Box(-1.0, 1.0)), COMMANDED], "acts within its instant"),
    ],
)  # fmt: skip
def test_equations_that_cannot_be_fitted(variables: list[Any], told: str) -> None:
    """Without a motion, with long lags, with noise that lasts, a model is refused."""
    with pytest.raises(ModelError, match=told):
        sw.World(sw.SCM([RATE, *variables])).fit({"time": [0.0, 1.0], "b": [0.0, 1.0]}, ["a"])


def test_a_fit_of_equations_replaces_no_mechanism() -> None:
    """A world or an episode with an intervention on a state is refused; the rest is found."""
    moved = sw.Derived(
        name="b", parents=(sw.Parent("b", 1), "a"), mechanism=lambda b, a: a * b, start=2.0
    )
    world = sw.World(sw.SCM([RATE, moved]))
    episode = world.rollout(steps=15, do={"a": 0.8})
    fit = world.fit(episode, "a")
    assert fit.values["a"] == pytest.approx(0.8)
    assert pickle.dumps(stepped(sw.SCM([RATE, NOISELESS])))
    with pytest.raises(ModelError, match="world that is fitted has interventions on b"):
        world.given({"b": sw.Shift(0.5)}).fit(episode, "a")
    with pytest.raises(ModelError, match="episode has interventions on b"):
        world.fit(world.rollout(steps=15, do={"b": sw.Hard(5.0, at=10)}), "a")


def test_a_world_of_equations_is_fitted_with_what_it_was_given() -> None:
    """A given parameter is held while another one is fitted, by any search."""
    rates = [sw.Exogenous(name=n, default=1.0, bounds=sw.Box(0.0, 5.0)) for n in ("rate", "gain")]
    moved = sw.Derived(
        name="x", parents=(sw.Parent("x", 1), "rate", "gain"), mechanism=_relaxes, start=2.0
    )
    world, seen = sw.World(sw.SCM([*rates, moved])), list[int]()

    def search(*given: Any) -> Any:
        seen.append(len(given))
        return gauss_newton(*given)

    recording = {"time": np.arange(6.0), "x": 2.0 + 3.0 * np.arange(6.0) * 0.5}
    held = world.given({"rate": 0.5})
    assert held.fit(recording, "gain", search=search).values["gain"] == pytest.approx(3.0)
    assert world.fit(recording, "gain").values["gain"] == pytest.approx(1.5)
    assert seen


def _relaxes(x: Any, rate: Any, gain: Any) -> Any:
    return x + rate * gain


def _decays(x: Any, rate: Any, u: Any, gain: Any) -> Any:
    return (1.0 - rate) * x + gain * u
