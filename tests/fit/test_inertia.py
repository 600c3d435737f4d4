"""The inertia of a body as one block: ten numbers, of which every trial is a body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import scm_world as sw
from scm_world.errors import InterventionError, NotIntervenable
from scm_world.fit.inertia import NUMBERS, PARTS, InertiaBlock, ten_numbers
from scm_world.fit.shooting import Shooting

ARM = """<mujoco><option timestep="0.005"/><worldbody>
  <body name="upper" pos="0 0 1"><joint name="a" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
    <body name="load" pos="0.3 0 0">
      <joint name="b" axis="1 0 0" damping="0.05"/>{joint}
      <inertial pos="0.05 0.02 -0.1" mass="0.4" {inertia}/>
    </body></body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/>{motor}</actuator></mujoco>"""
THIRD = '<joint name="c" axis="0 0 1" damping="0.05"/>'
PLAIN = 'diaginertia="0.004 0.005 0.003"'
TWO = ARM.format(joint="", motor="", inertia=PLAIN)
THREE = ARM.format(joint=THIRD, motor='<motor joint="c"/>', inertia=PLAIN)
EXPOSE = ["*", "load.center_of_mass", "load.principal_axes"]
HELD: dict[str, Any] = {
    "load.mass": 0.7,
    "load.center_of_mass": np.array([0.08, -0.03, -0.06]),
    "load.inertia": np.array([0.006, 0.004, 0.0045]),
    "load.principal_axes": Rotation.from_rotvec([0.4, -0.3, 0.6]).as_quat(),
}
TRUE = ten_numbers(*(HELD[f"load.{part}"] for part in PARTS))


def recorded(world: sw.World, do: dict[str, Any], steps: int = 60) -> dict[str, Any]:
    """Record the positions of joints, with noise of a milliradian."""
    rng, episode = np.random.default_rng(0), world.rollout("random", seed=0, steps=steps, do=do)
    commands = zip(world.compiled.actions, episode.actions.T, strict=True)
    found: dict[str, Any] = {name: np.append(one, np.nan) for name, one in commands}
    for joint in (name.partition(".")[0] for name in world.compiled.actions):
        noise = 1e-3 * rng.normal(size=steps + 1)
        found[f"{joint}.position"] = episode[f"{joint}.position"] + noise
    return found | {"time": 0.02 * np.arange(steps + 1)}


def test_ten_numbers_are_those_of_the_points_of_a_body() -> None:
    """Mass, mass times center, and inertia about the frame, by sums over points; and back."""
    rng = np.random.default_rng(1)
    points, masses = 0.1 * rng.normal(size=(6, 3)) + [0.2, -0.1, 0.0], rng.uniform(0.1, 0.3, 6)
    around = np.einsum("p,pi,pj->ij", masses, points, points)
    tensor = np.trace(around) * np.eye(3) - around
    expected = [masses.sum(), *(masses @ points), *tensor[np.triu_indices(3)]]
    block = InertiaBlock.of("load.inertial", {part: HELD[f"load.{part}"] for part in PARTS})
    scaled = block.searched(np.array(expected))
    assert scaled is not None
    mass, center, moments, axes = block.body(scaled)
    np.testing.assert_allclose(block.numbers(scaled), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(center, masses @ points / masses.sum(), rtol=1e-12)
    turn, shift = Rotation.from_quat(axes).as_matrix(), mass * np.outer(center, center)
    own = tensor - (np.trace(shift) * np.eye(3) - shift)
    np.testing.assert_allclose(turn @ np.diag(moments) @ turn.T, own, rtol=1e-12, atol=1e-15)
    assert block.searched(np.array([1.0, *np.zeros(3), 1.0, 0.0, 0.0, 1.0, 0.0, 2.1])) is None


def test_any_ten_numbers_are_a_body() -> None:
    """Masses and second moments are positive, however far a search goes; zero is the body as is."""
    block = InertiaBlock.of("load.inertial", {part: HELD[f"load.{part}"] for part in PARTS})
    for scaled in np.random.default_rng(2).normal(scale=4.0, size=(200, 10)):
        mass, _, moments, axes = block.body(scaled)
        assert mass > 0.0
        assert 2.0 * moments.max() <= moments.sum() * (1.0 + 1e-12)
        assert np.linalg.norm(axes) == pytest.approx(1.0, abs=1e-12)
    for part, value in zip(PARTS, block.body(np.zeros(10)), strict=True):
        np.testing.assert_array_equal(value, HELD[f"load.{part}"])


@pytest.mark.parametrize(
    ("backend", "exact"), [("mujoco", 1e-12), ("bullet", 1e-12), ("warp:cpu", 1e-5)]
)
def test_turned_axes_step_as_a_file_with_that_inertia(backend: str, exact: float) -> None:
    """A ``do`` of the axes is what MuJoCo compiles from the full tensor, to rounding."""
    if backend == "warp:cpu":
        pytest.importorskip("mujoco_warp")
    full = "0.004 0.005 0.003 0.0005 -0.0004 0.0003"
    text = ARM.format(joint=THIRD, motor='<motor joint="c"/>', inertia=f'fullinertia="{full}"')
    model = mujoco.MjModel.from_xml_string(text)
    moments, axes = model.body("load").inertia, np.roll(model.body("load").iquat, -1)
    with sw.World(THREE, backend=backend, expose=EXPOSE) as world:
        own = world.composition.system.source.realized.opt
        model.opt.disableflags, model.opt.enableflags = own.disableflags, own.enableflags
        data, generator = mujoco.MjData(model), np.random.default_rng(0)
        data.qvel[0], data.qpos[1] = 1.0, 0.5
        start = {"load.inertia": moments, "a.velocity": 1.0, "b.position": 0.5}
        world.reset(seed=0, do={**start, "load.principal_axes": axes})
        for _ in range(30):
            data.ctrl[:] = command = generator.uniform(-0.1, 0.1, 3)
            world.advance(command)
            mujoco.mj_step(model, data, world.substeps)
        reached = [float(world[f"{joint}.position"]) for joint in "abc"]
        np.testing.assert_allclose(reached, data.qpos, atol=exact)


def test_a_load_is_found_and_every_trial_is_a_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """All ten numbers of a tilted load on three axes are within their intervals."""
    tried, write = [], Shooting._write

    def written(self: Shooting, row: int, scaled: Any, setup: Any) -> None:
        tried.append(scaled.copy())
        write(self, row, scaled, setup)  # raises if the world refuses

    world = sw.World(THREE, expose=EXPOSE)
    recording = recorded(world, HELD)
    monkeypatch.setattr(Shooting, "_write", written)
    refused, check = [], Shooting.check

    def checked(self: Shooting, scaled: Any) -> None:
        try:
            check(self, scaled)
        except InterventionError:
            refused.append(scaled)
            raise

    monkeypatch.setattr(Shooting, "check", checked)
    fit = world.fit(recording, ["load.inertial", "load.mass"])
    assert [*fit.values] == [f"load.inertial.{name}" for name in NUMBERS]
    assert len(tried) > 100
    assert not refused
    assert fit.table.determined.all()
    table = fit.table
    assert ((table.low < TRUE) & (table.high > TRUE)).sum() >= 9
    np.testing.assert_allclose(table.value, TRUE, rtol=0.02, atol=1e-4)
    fit.world.reset(seed=0)
    again = ten_numbers(*(np.array(fit.world[f"load.{part}"]) for part in PARTS))
    np.testing.assert_allclose(again, table.value, rtol=1e-9)


def test_a_single_hinge_shows_three_of_ten() -> None:
    """Its moment, and both moments of first order across it; combinations of the others are none.

    Source:
        Atkeson, An and Hollerbach, 1986, as in ``Fit.linear_reach``.
    """
    text = TWO.replace('<joint name="a" axis="0 1 0" damping="0.1"/>', "")
    world = sw.World(text.replace('<motor joint="a"/>', ""), expose=EXPOSE)
    fit = world.fit(recorded(world, HELD, 40), ["load.inertial", "b.damping"], noise=1e-3)
    table = fit.table.set_index("parameter")
    shown = [f"load.inertial.{name}" for name in ("my", "mz", "ixx")]
    assert [*table.index[table.determined]] == [*shown, "b.damping"]
    about = zip(shown, TRUE[[2, 3, 4]], strict=True)
    assert all(table.low[name] < true < table.high[name] for name, true in about)
    assert table[["low", "high"]].drop([*shown, "b.damping"]).isna().all().all()
    assert fit.identifiable.determined.sum() == 4
    names = {name for names in fit.confounded for name in names}
    assert names == {*table.index} - {*shown, "b.damping"}


def test_what_no_motion_shows_is_said() -> None:
    """An arm that stands still without gravity: ten numbers that nothing determines."""
    world = sw.World(TWO.replace("<option", '<option gravity="0 0 0"'), expose=EXPOSE)
    noise = 1e-3 * np.random.default_rng(0).normal(size=(2, 21))
    still = {f"{joint}.position": one for joint, one in zip("ab", noise, strict=True)}
    commands = {f"{joint}.control": np.zeros(21) for joint in "ab"}
    fit = world.fit({"time": 0.02 * np.arange(21), **still, **commands}, "load.inertial")
    assert not fit.table.determined.any()
    assert "load.inertial.mass" in " ".join(fit.remarks)


def test_a_block_is_refused_where_a_part_is_missing() -> None:
    """The message says which name to expose, or that the body has no thickness."""
    world = sw.World(TWO)
    with pytest.raises(NotIntervenable, match=r"load.inertial.*load.center_of_mass, which is not"):
        world.fit(recorded(world, {}, 20), "load.inertial")
    flat = sw.World(TWO.replace("0.004 0.005 0.003", "0.004 0.007 0.003"), expose=EXPOSE)
    with pytest.raises(NotIntervenable, match=r"of a body without thickness"):
        flat.fit(recorded(flat, {}, 20), "*.inertial")


def test_a_file_has_the_whole_inertia(tmp_path: Path) -> None:
    """Plain MuJoCo reads the ten numbers of the fit, however the file says the axes."""
    world = sw.World(TWO, expose=EXPOSE)
    fit = world.fit(recorded(world, HELD, 20), "load.inertial", noise=1e-3)
    full = 'fullinertia="0.004 0.005 0.003 0.0005 -0.0004 0.0003"'
    for said in (PLAIN, f'{PLAIN} euler="10 20 30"', f'{PLAIN} quat="1 0.1 0 0"', full):
        asked = sw.World(TWO.replace(PLAIN, said), expose=EXPOSE)
        replace(fit, asked=asked).save(tmp_path / "arm.xml")
        body = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml")).body("load")
        read = ten_numbers(body.mass[0], body.ipos, body.inertia, np.roll(body.iquat, -1))
        np.testing.assert_allclose(read, [*fit.values.values()], rtol=1e-9, atol=1e-15)


def test_draws_of_the_posterior_are_bodies_with_its_spread() -> None:
    """Ten numbers of worlds that are drawn have the means and the errors of the table."""
    world = sw.World(THREE, expose=EXPOSE)
    fit = world.fit(recorded(world, HELD, 40), "load.inertial", noise=1e-3)
    worlds = sw.World(THREE, expose=EXPOSE, num_worlds=200)
    worlds.reset(seed=0, do=fit.posterior())
    values = worlds.values()
    parts = [np.asarray(values[f"load.{part}"]) for part in PARTS]
    drawn = np.array([ten_numbers(*one) for one in zip(*parts, strict=True)])
    assert (2.0 * parts[2].max(axis=1) <= parts[2].sum(axis=1)).all()
    away = (drawn - [*fit.values.values()]) / (fit.units * fit.errors)
    np.testing.assert_allclose(away.mean(axis=0), 0.0, atol=4 / 200**0.5)
    np.testing.assert_allclose(away.std(axis=0), 1.0, atol=4 / 400**0.5)
