"""Physics and declaration disagree: it is seen, and where they agree nothing is."""

from __future__ import annotations

import pytest

from benchmarks.sabotage import HONEST, SABOTAGES, Sabotage, caught, complaints
from scm_world.queries import verify

BY_NAME = {one.name: one for one in SABOTAGES}
QUICK = [
    "balls attract without contact",
    "an outcome reads another state",
    "an outcome draws from a global generator",
    "a mechanism mixes in what it was last asked",
    "the motor echoes after three steps",
    "noise is keyed by another state",
    "label and paint act together only",
]


@pytest.mark.parametrize("one", [BY_NAME[name] for name in QUICK], ids=lambda one: one.name)
def test_a_sabotage_is_caught(one: Sabotage) -> None:
    """The report names what was sabotaged, and does not confirm the graph."""
    report = verify(one.make(), probes=6, held_out=6, seed=1)
    assert caught(report, one.names), str(report)


@pytest.mark.parametrize("system", ["balls, mujoco", "cart, bullet", "tanks, step", "equations"])
def test_an_honest_system_is_not_suspected(system: str) -> None:
    """With other seeds than those of the study."""
    report = verify(HONEST[system](), probes=6, held_out=4, seed=17)
    assert not [*complaints(report)], str(report)
    assert report.outcome != "refuted"


def test_a_cut_edge_is_named_where_the_honest_system_shows_it() -> None:
    """A motor that is not connected refutes nothing; its edges are listed as never seen."""
    one = BY_NAME["the motor is not connected"]
    honest, report = (
        verify(make(), probes=16, held_out=4) for make in (HONEST[one.system], one.make)
    )
    assert honest.outcome == "confirmed"
    assert report.outcome == "not refuted"
    assert not caught(report, one.names)
    assert caught(report, one.names, honest)


def test_two_colors_together_are_named_together() -> None:
    """Neither of them acts alone: the effect has both as its cause, and no smaller set."""
    report = verify(BY_NAME["label and paint act together only"].make(), probes=8)
    causes = {edge.cause for edge in report.undeclared if edge.effect == "lower"}
    assert causes & {"paint & label", "label & paint", "paint", "label"}
    assert all(" & " in cause or cause in ("paint", "label") for cause in causes)


def test_memory_has_a_lag() -> None:
    """What is put back after one step acts three steps later."""
    report = verify(BY_NAME["the motor echoes after three steps"].make(), probes=2, held_out=2)
    assert {edge.lag for edge in report.undeclared if edge.cause == "push.control"} == {4}


def test_every_system_is_known_and_every_class_has_sabotages() -> None:
    """The study has at least forty, in five classes, and says why some cannot be seen."""
    assert len(SABOTAGES) >= 40
    assert len(BY_NAME) == len(SABOTAGES)
    assert {one.kind for one in SABOTAGES} == {"effect", "cut", "meaning", "readout", "time"}
    assert all(one.system in HONEST for one in SABOTAGES)
    assert all(one.why or one.test for one in SABOTAGES if not one.visible)
