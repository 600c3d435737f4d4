"""Explanations with many candidates: few of them are fitted, and a stopped search says so."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import scm_world as sw

MANY = 24  # parameters of a world


def driven(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """A mass, with forces of many parameters that depend on position, speed and command."""
    x, v, u = state["x"], state["v"], action["u"]
    force = u - 0.5 * v - x
    for i in range(MANY):
        force = force + parameters[f"p{i}"] * np.sin((1 + i) * x + i * v) / (1 + i)
    return {"x": x + 0.1 * v, "v": v + 0.1 * force}


@pytest.fixture(scope="module")
def world() -> sw.World:
    """A world with many parameters that are zero, and one that changes nothing."""
    names = [*(f"p{i}" for i in range(MANY)), "idle"]
    return sw.World(
        driven,
        parameters=[sw.Exogenous(name=n, default=0.0, bounds=sw.Box(-5.0, 5.0)) for n in names],
        states=[sw.Measured(name=n, default=0.0) for n in ("x", "v")],
        actions=[sw.Action(name="u", bounds=sw.Box(-1.0, 1.0))],
        control_dt=0.1,
    )


@pytest.fixture(scope="module")
def recording(world: sw.World) -> dict[str, Any]:
    """A noisy recording in which one of the parameters deviates."""
    episode = world.rollout("random", seed=3, steps=30, do={"p7": 1.5})
    noise = 1e-3 * np.random.default_rng(0).normal(size=31)
    return {"time": 0.1 * np.arange(31), "u": episode.actions[:, 0], "x": episode["x"] + noise}


def test_few_of_many_candidates_are_fitted(world: sw.World, recording: Any) -> None:
    """The one that deviates is found by its score; one that changes nothing has no test."""
    told = list[tuple[int, int]]()
    found = world.explain(recording, ["p*", "idle"], progress=lambda *how: told.append(how))
    assert found.best == ("p7",)
    assert found.fit.values["p7"] == pytest.approx(1.5, rel=0.05)
    assert len(found.fits) < MANY / 2
    assert len(found.table) == MANY + 2
    assert found.untested == ("idle",)
    assert "no measurement of this recording changes with idle: no test is possible" in str(found)
    assert [done for done, _ in told] == [*range(1, len(told) + 1)]
    assert told[-1] == (len(told), len(told))
    assert all(done <= planned for done, planned in told)


def test_a_stopped_search_has_what_is_known(world: sw.World, recording: Any) -> None:
    """A Ctrl-C ends the search; candidates that were not fitted have their predictions."""

    def stop(done: int, _: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    found = world.explain(recording, ["p*"], progress=stop)
    assert found.stopped
    assert str(found).startswith("stopped before all searches were done; so far: ")
    assert len(found.fits) == 2
    assert len(found.table) == MANY + 1
