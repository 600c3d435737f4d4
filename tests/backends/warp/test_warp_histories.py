"""Worlds of one batch against worlds that are alone: equal to the last bit on the CPU device."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mujoco_warp")

import scm_world as sw
from scm_world.errors import InterventionError
from scm_world.testing.backend import MODEL

N = 5
MASSES = "crate.mass", "falling.mass", "upper.mass", "fore.mass"
OTHERS = "floor.friction", "shoulder.damping", "servo.kp", "gravity", "crate.size"
STATES = "elbow.position", "shoulder.velocity", "crate.linear_velocity", "apart.cartesian_position"


@pytest.fixture(scope="module")
def worlds() -> Iterator[tuple[sw.World, list[sw.World]]]:
    """Provide a batch, and as many worlds alone."""
    many = sw.World(MODEL, backend="warp", device="cpu", num_worlds=N)
    alone = [sw.World(MODEL, backend="warp:cpu") for _ in range(N)]
    yield many, alone
    for world in (many, *alone):
        world.close()


def _request(rng: np.random.Generator, now: sw.World) -> dict[str, object]:
    """Draw values of some variables: for each world, or for all alike."""
    found: dict[str, object] = {}
    for name in rng.choice([*MASSES, *OTHERS, *STATES], size=rng.integers(1, 4), replace=False):
        value = now[name]
        each = rng.random() < 0.5
        factor = rng.uniform(0.7, 1.4, size=(N, *[1] * value[0].ndim) if each else None)
        drawn = value * factor if each else value[0] * factor
        found[str(name)] = drawn + 0.05 * (str(name) in STATES)
    return found


def _of(request: dict[str, object], shape_of: sw.World, row: int) -> dict[str, object]:
    found = {}
    for name, value in request.items():
        each = np.shape(value) == np.shape(shape_of[name])
        found[name] = np.asarray(value)[row] if each else value
    return found


def _equal(many: sw.World, alone: list[sw.World], what: str) -> None:
    values = many.values()
    for row, world in enumerate(alone):
        here = world.evaluate()
        for name, each in values.items():
            assert np.array_equal(each[row], here[name]), (what, row, name)


def _history(many: sw.World, alone: list[sw.World], seed: int) -> None:
    """Play one history in both."""
    rng = np.random.default_rng(seed)
    many.reset(seed=seed)
    for row, world in enumerate(alone):
        world.reset(seed=seed + row)
    for turn in range(10):
        mask = rng.random(N) < 0.6
        mask[rng.integers(N)] = True
        rows = np.flatnonzero(mask)
        match rng.choice(["do", "step", "reset", "back"], p=[0.4, 0.45, 0.05, 0.1]):
            case "do":
                request = _request(rng, many)
                audits = many.do(request, where=mask, on_refusal="skip")
                for row in rows.tolist():
                    try:
                        alone[row].do(_of(request, many, row))
                        assert row not in audits.refused
                    except InterventionError:
                        assert row in audits.refused
            case "step":
                actions = rng.uniform(-1.0, 1.0, (N, 2))
                for _ in range(int(rng.integers(1, 4))):
                    many.step(actions, where=mask)
                    for row in rows.tolist():
                        alone[row].step(actions[row])
            case "reset":
                seeds = [int(one) for one in rng.integers(0, 100, N)]
                many.reset(seed=seeds, where=mask)
                for row in rows.tolist():
                    alone[row].reset(seed=seeds[row])
            case _:  # there and back: nothing is left
                before = many["falling.mass"]
                many.do({"falling.mass": 1.3 * before}, where=mask)
                many.do({"falling.mass": before}, where=mask)
        _equal(many, alone, f"seed {seed}, turn {turn}")


def test_masked_histories(worlds: tuple[sw.World, list[sw.World]]) -> None:
    """Random histories of interventions, steps and resets, each in some of the worlds."""
    for seed in range(12):
        _history(*worlds, seed)


@pytest.mark.slow
def test_many_masked_histories(worlds: tuple[sw.World, list[sw.World]]) -> None:
    """Three hundred of them."""
    for seed in range(1000, 1300):
        _history(*worlds, seed)
