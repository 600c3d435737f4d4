"""What interventions, noise, time and counterfactuals mean: the same for every kind of system."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from kinds import KINDS, Kind, same

from scm_world.errors import InterventionError, ScmWorldError, SeveralProblems
from scm_world.queries import Outcome
from scm_world.variables import Draw, Hard, Natural, Reaches, Scale, Shift

STEPS = 6


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> Kind:
    """Return each kind in turn."""
    return KINDS[request.param]


def rollout(kind: Kind, do: Any = None, **options: Any) -> Any:
    """Run an episode with random actions."""
    return kind.asked.rollout(
        **{"policy": "random", "seed": 3, "steps": STEPS, "do": do, **options}
    )


# --- interventions are values, and do is pure -----------------------------------------------------


def test_another_world_leaves_the_first_as_it_was(kind: Kind) -> None:
    """What is given holds in the other world only."""
    before = rollout(kind)
    with kind.asked.given({kind.parameter: kind.values[0]}) as other:
        there = other.rollout("random", seed=3, steps=STEPS)
        assert (there[kind.parameter] == kind.values[0]).all()
    assert rollout(kind) == before
    assert not (before[kind.parameter] == kind.values[0]).any()


def test_later_interventions_take_the_place_of_earlier_ones(kind: Kind) -> None:
    """``given(a).given(b)`` is ``given({**a, **b})``."""
    one, other = ({kind.parameter: value} for value in kind.values)
    more = {**other, kind.of: Shift(0.01)}
    with kind.asked.given(one) as first, first.given(more) as both:
        found = both.rollout("random", seed=3, steps=STEPS)
    assert {n: v.tobytes() for n, v in _all(found).items()} == {
        n: v.tobytes() for n, v in _all(rollout(kind, more)).items()
    }


def _all(episode: Any) -> dict[str, Any]:
    return {name: episode[name] for name in episode.names}


@pytest.mark.parametrize(
    "act", [Shift(-1e-3), Scale(1.01), Draw("A"), Draw("B"), Draw("A|B")], ids=repr
)
def test_the_acts_mean_what_they_say(kind: Kind, act: Any) -> None:
    """A shift and a scale start from what would have been; a draw lies in its space."""
    natural = rollout(kind)[kind.parameter][0]
    value = rollout(kind, {kind.parameter: act})[kind.parameter][0]
    match act:
        case Shift():
            assert value == natural - 1e-3
        case Scale():
            assert value == natural * 1.01
        case Draw(source=source):
            spaces = [kind.asked.graph.declared(kind.parameter).space(s) for s in source.split("|")]
            assert any(space.contains(value) for space in spaces)
            again = rollout(kind, {kind.parameter: act}, seed=4)
            assert again[kind.parameter][0] != value


def test_a_parameter_holds_until_the_reset(kind: Kind) -> None:
    """From the instant at which it is set; the next episode has nothing of it."""
    episode = rollout(kind, {kind.parameter: Hard(kind.values[1], at=2)})
    assert (episode[kind.parameter] == kind.values[1]).tolist() == [
        i >= 2 for i in range(STEPS + 1)
    ]
    system = kind.system()
    system.reset(seed=0)
    before = system.values()
    system.do({kind.parameter: kind.values[1]})
    system.step(system.action_low)
    assert system[kind.parameter] == kind.values[1]
    system.reset(seed=0)
    assert same(system.values(), before)


def test_what_holds_a_parameter_can_be_taken_away(kind: Kind) -> None:
    """``Natural`` hands it back to its own equation."""
    plan = {kind.parameter: (Hard(kind.values[0]), Natural(at=3))}
    episode, free = rollout(kind, plan), rollout(kind)
    held = [i < 3 for i in range(STEPS + 1)]
    assert (episode[kind.parameter] == kind.values[0]).tolist() == held
    assert (episode[kind.parameter] == free[kind.parameter]).tolist() == [not h for h in held]


# --- one do is one transaction --------------------------------------------------------------------


def test_all_problems_are_reported_together(kind: Kind) -> None:
    """And nothing has changed: neither values nor what follows."""
    system = kind.system()
    system.reset(seed=1)
    system.step(system.action_high)
    before, start = system.values(), system.snapshot()
    system.step(system.action_low)
    after = system.values()
    system.restore(start)
    wrong = {kind.parameter: -1e9, "nothing": 1.0, kind.of: np.nan}
    with pytest.raises(SeveralProblems) as caught:
        system.do(wrong)
    assert len(caught.value.problems) == 3
    text = str(caught.value)
    assert kind.parameter in text
    assert "nothing" in text
    assert same(system.values(), before)
    system.step(system.action_low)
    assert same(system.values(), after)


def test_an_error_names_the_nearest_value_that_is_allowed(kind: Kind) -> None:
    """A value out of bounds is refused with what was given and what is allowed."""
    with pytest.raises(InterventionError) as caught:
        rollout(kind, {kind.parameter: -1e9})
    assert kind.parameter in str(caught.value)
    nearest = caught.value.nearest
    assert rollout(kind, {kind.parameter: nearest})[kind.parameter][0] == nearest


def test_an_audit_says_what_was_done_and_what_followed(kind: Kind) -> None:
    """The value that was asked for, the one that holds, and the readouts that changed."""
    system = kind.system()
    system.reset(seed=0)
    before = system.values()
    audit = system.do({kind.of: Shift(0.02)})
    assert {*audit.targets} == {kind.of}
    assert (audit.targets[kind.of].applied == system[kind.of]).all()
    assert "0.02" in str(audit) or kind.of in str(audit)
    for name, (old, new) in audit.followed.items():
        assert same({0: old, 1: new}, {0: before[name], 1: system[name]}), name


def test_dos_at_one_instant_are_one(kind: Kind) -> None:
    """In either order, or together: the same values and the same future."""
    acts = {kind.parameter: kind.values[1], kind.of: Shift(0.01)}
    found = []
    for requests in ([acts], [{n: acts[n]} for n in acts], [{n: acts[n]} for n in [*acts][::-1]]):
        system = kind.system()
        system.reset(seed=2)
        system.step(system.action_low)
        for request in requests:
            system.do(request)
        now = system.values()
        system.step(system.action_high)
        found.append((now, system.values()))
    assert all(same(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))


# --- noise is a value -----------------------------------------------------------------------------


def test_an_intervention_leaves_the_noise_of_others(kind: Kind) -> None:
    """What it does not act on is the same, bit for bit, though it varies with the seed."""
    natural, other = (rollout(kind, do, steps=3) for do in ({}, {kind.parameter: kind.values[1]}))
    assert natural[kind.beside].tobytes() == other[kind.beside].tobytes()
    assert natural[kind.moved].tobytes() != other[kind.moved].tobytes()


def test_worlds_of_one_seed_are_a_pair(kind: Kind) -> None:
    """The same seed gives the same episode, in systems of their own; another seed another one."""
    ends = []
    for seed in (5, 5, 6):
        system = kind.system()
        system.reset(seed=seed)
        ends.append(_gone(system))
    assert same(ends[0], ends[1])
    assert not same(ends[0], ends[2]) or kind is KINDS["robot"]  # its start does not vary


def _gone(system: Any) -> dict[str, Any]:
    for share in (0.2, 0.9, 0.5):
        system.step(system.action_low + share * (system.action_high - system.action_low))
    found: dict[str, Any] = system.values()
    return found


def test_results_depend_on_neither_number_nor_workers(kind: Kind) -> None:
    """Episode i is the same in every question, and with any number of threads."""
    options: dict[str, Any] = {"steps": 4, "policy": "random", "seed": 1, "outcomes": [kind.moved]}
    do = {kind.parameter: Draw("A")}
    whole = kind.asked.sample(9, do, **options)[kind.moved]
    part = kind.asked.sample(4, do, first=5, **options)[kind.moved]
    threads = kind.asked.sample(9, do, workers=2, **options)[kind.moved]
    assert whole[5:].tobytes() == part.tobytes()
    assert whole.tobytes() == threads.tobytes()
    alone = [rollout(kind, do, seed=1, steps=4, episode=i).final(kind.moved) for i in range(9)]
    assert whole.tobytes() == np.array(alone).tobytes()


def test_questions_leave_the_system_as_it_is(kind: Kind) -> None:
    """A world under way is at the same instant afterwards, and goes on alike."""
    system = kind.make()
    if not hasattr(system, "step"):
        pytest.skip("a causal model has no present")
    system.reset(seed=1)
    system.step(system.action_low)
    before, index = system.values(), system.index
    system.rollout("random", seed=2, steps=2)
    system.effect(kind.moved, do={kind.parameter: kind.values[0]}, n=2, steps=2)
    assert (same(system.values(), before), system.index) == (True, index)


# --- time -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("act", "held"),
    [
        (lambda value: Hard(value, at=2), [0, 0, 1, 1, 1, 1, 1]),
        (lambda value: Hard(value, during=(1, 4)), [0, 1, 1, 1, 0, 0, 0]),
        (lambda value: (Hard(value, at=1), Natural(at=2, every=2)), [0, 1, 0, 0, 0, 0, 0]),
    ],
    ids=["at", "during", "every"],
)
def test_time_is_a_field_of_an_intervention(kind: Kind, act: Any, held: list[int]) -> None:
    """At a control step, over a window, and again and again."""
    episode = rollout(kind, {kind.parameter: act(kind.values[1])})
    assert (episode[kind.parameter] == kind.values[1]).tolist() == [bool(h) for h in held]


def test_an_intervention_can_wait_for_an_event(kind: Kind) -> None:
    """It happens at the first instant at which its condition holds."""
    path = rollout(kind)[kind.of]
    if path.ndim > 1:
        path = path[:, 0]
    step = int(np.argmax(np.abs(path - path[0])))
    mean, above = (path[step] + path[0]) / 2, path[step] > path[0]
    step = int(np.argmax(path > mean if above else path < mean))
    when = Reaches(kind.of, **{"above" if above else "below": float(mean)})
    episode = rollout(kind, {kind.parameter: Hard(kind.values[1], when=when)})
    assert episode.events == {kind.parameter: step}
    found = (episode[kind.parameter] == kind.values[1]).tolist()
    assert found == [i >= step for i in range(STEPS + 1)]


def test_an_intervention_acts_forward_in_time_only(kind: Kind) -> None:
    """Before its instant the episode is the same, bit for bit."""
    free, other = rollout(kind), rollout(kind, {kind.parameter: Hard(kind.values[1], at=3)})
    assert free[kind.moved][:4].tobytes() == other[kind.moved][:4].tobytes()
    assert free[kind.moved].tobytes() != other[kind.moved].tobytes()


# --- counterfactuals are exact --------------------------------------------------------------------


def test_nothing_done_is_the_episode(kind: Kind) -> None:
    """From the beginning and from any instant, bit for bit, also under an intervention."""
    for do in ({}, {kind.parameter: Draw("A"), kind.of: Shift(0.01)}):
        episode = rollout(kind, do)
        assert all(episode.counterfactual({}, at=at) == episode for at in (0, 1, STEPS - 1))


def test_a_counterfactual_is_the_episode_of_the_intervention(kind: Kind) -> None:
    """What is imagined afterwards equals what is done beforehand, with the same noise."""
    act = {kind.parameter: kind.values[0]}
    for at in (0, 2, 4):
        imagined = rollout(kind).counterfactual(act, at=at)
        done = rollout(kind, {kind.parameter: Hard(kind.values[0], at=at)})
        assert imagined == done


def test_many_counterfactuals_are_the_same_as_one_by_one(kind: Kind) -> None:
    """Run together or alone."""
    episode = rollout(kind)
    acts = [{kind.parameter: value} for value in kind.values] * 3
    together = episode.worlds(acts, at=1)
    assert [*together] == [episode.counterfactual(act, at=1) for act in acts]


def test_an_effect_without_a_path_is_zero(kind: Kind) -> None:
    """Exactly: pairs share their noise; of what has a path it is not."""
    options: dict[str, Any] = {"n": 4, "steps": 3, "policy": None}
    do, versus = ({kind.parameter: value} for value in kind.values)
    beside = Outcome(kind.beside)
    none = kind.asked.effect(beside, do=do, versus=versus, **options)
    some = kind.asked.effect(kind.moved, do=do, versus=versus, **options)
    assert (np.asarray(none.mean) == 0.0).all()
    assert (np.asarray(some.mean) != 0.0).any()


# --- what is not possible -------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [{"nothing": 1.0}, {"": 1.0}, 5, {"nothing": Hard(1.0, at=1)}])
def test_what_is_wrong_is_one_typed_error(kind: Kind, wrong: Any) -> None:
    """Whichever way it is asked, and the system answers the next question."""
    before = rollout(kind, steps=2)
    with pytest.raises(ScmWorldError):
        rollout(kind, wrong, steps=2)
    assert rollout(kind, steps=2) == before
