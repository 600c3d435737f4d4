"""Whatever is done to a system in any order: a twin that repeats it is the same, bit for bit."""

from __future__ import annotations

import copy
import pickle
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)
from kinds import KINDS, Kind, same

from scm_world.errors import ActionError, InterventionError
from scm_world.variables import Draw, Natural, Scale, Shift

FAULTS = (
    "do", "undo", "step", "reset", "snapshot", "restore", "branch", "pickle", "refuse", "action"
)  # fmt: skip


@cache
def twin_of(kind: str) -> Any:
    """Return the twin that repeats what was done; one for each kind."""
    return KINDS[kind].system()


def through(given: Any) -> Any:
    """Write something down and read it again."""
    return pickle.loads(pickle.dumps(given))  # noqa: S301 # what was written a moment ago


class Histories(RuleBasedStateMachine):
    """Random operations on a system, and what has to be repeated to be where it is.

    What was undone or refused, and what was before a reset, is not repeated.
    """

    kind: str
    fault: str | None = None

    def __init__(self) -> None:
        super().__init__()
        self.about: Kind = KINDS[self.kind]
        self.world = self.about.system()
        self.done: list[tuple[str, Any]] = []
        self.kept: list[tuple[Any, list[tuple[str, Any]]]] = []
        self.touched: set[str] = set()

    def spoil(self, sort: str, world: Any = None) -> None:
        """Change a little that should not change, after an operation of a sort."""
        if self.fault == sort:
            world = self.world if world is None else world
            name = self.about.parameter
            world.do({name: np.nextafter(world[name], 0.0)})

    # --- operations ---------------------------------------------------------------------------

    @initialize(seed=st.integers(0, 5))
    def begin(self, seed: int) -> None:
        """Begin the first episode."""
        self.world.reset(seed=seed)
        self.done = [("reset", (seed, 0))]

    @rule(seed=st.integers(0, 5), episode=st.integers(0, 2))
    def reset(self, seed: int, episode: int) -> None:
        """Begin another episode."""
        self.world.reset(seed=seed, episode=episode)
        self.spoil("reset")
        self.done, self.touched = [("reset", (seed, episode))], set()

    @rule(share=st.floats(0.0, 1.0), times=st.integers(1, 3))
    def step(self, share: float, times: int) -> None:
        """Take control steps with an action in its range."""
        action = self.world.action_low + share * (self.world.action_high - self.world.action_low)
        for _ in range(times):
            self.world.step(action)
            self.done.append(("step", action))
        self.spoil("step")
        self.touched = set()

    def act(self, data: Any, name: str) -> Any:
        """Return an intervention on a variable."""
        acts = [Shift(1e-3), Scale(1.05), Shift(-2e-3)]
        if self.world.graph.declared(name).b is not None:
            acts += [Draw("A"), Draw("A"), Draw("B")]
        return data.draw(st.sampled_from(acts))

    @rule(data=st.data(), n=st.integers(1, 3))
    def do(self, data: Any, n: int) -> None:
        """Intervene on one or several variables; what is refused has changed nothing."""
        names = data.draw(st.permutations(self.about.settable))[:n]
        request = {name: self.act(data, name) for name in names}
        before = self.world.values()
        try:
            self.world.do(request)
        except InterventionError:
            assert same(self.world.values(), before)
            return
        self.done.append(("do", request))
        self.touched |= {*request}
        self.spoil("do")

    @precondition(lambda self: len(self.touched) < len(self.about.settable))
    @rule(data=st.data())
    def undo(self, data: Any) -> None:
        """Intervene and take it back at the same instant: that leaves no trace."""
        free = [name for name in self.about.settable if name not in self.touched]
        name = data.draw(st.sampled_from(free))
        before, held = self.world.values(), self.world.graph.interventions
        if any(isinstance(act, Draw) for act in held.values()):
            return  # equations hold the draw: to ask for it again is to draw again
        try:
            self.world.do({name: data.draw(st.sampled_from([Shift(1e-3), Scale(1.05)]))})
        except InterventionError:
            return
        graph = self.world.graph
        target = graph.target(name)
        if graph.declared(target).kind == "measured":
            back = {target: before[target]}
        else:  # what holds it may name its other coordinates
            back = {n: act for n, act in held.items() if graph.target(n) == target}
        self.world.do(back or {target: Natural()})
        self.spoil("undo")
        assert same(self.world.values(), before), name

    @rule(data=st.data())
    def refuse(self, data: Any) -> None:
        """Ask for what is impossible, alone or beside what is possible: nothing changes."""
        parameter, readout = self.about.parameter, self.about.readout
        wrong: dict[str, Any] = data.draw(
            st.sampled_from(
                [
                    {parameter: np.nan},
                    {parameter: -1e9},
                    {"no_such_variable": 1.0},
                    {parameter: self.about.values[0], "no_such_variable": 1.0},
                    {parameter: "Q"},
                    {readout: "Q"},
                ]
            )
        )
        before = self.world.values()
        with pytest.raises(InterventionError):
            self.world.do(wrong)
        self.spoil("refuse")
        assert same(self.world.values(), before)

    @rule()
    def wrong_action(self) -> None:
        """Take a step that is impossible: nothing changes."""
        with pytest.raises(ActionError):
            self.world.step(np.full(self.world.action_low.shape, np.nan))
        self.spoil("action")

    @rule()
    def snapshot(self) -> None:
        """Keep the present."""
        if self.fault == "snapshot":
            self.world.do({self.about.parameter: self.about.values[0]})
        self.kept.append((self.world.snapshot(), [*self.done], {*self.touched}))

    @precondition(lambda self: self.kept)
    @rule(data=st.data(), through_pickle=st.booleans())
    def restore(self, data: Any, through_pickle: bool) -> None:
        """Go back to what was kept."""
        saved, done, touched = data.draw(st.sampled_from(self.kept))
        saved = through(saved) if through_pickle else saved
        self.world.restore(saved)
        self.spoil("restore")
        self.done, self.touched = [*done], {*touched}

    @rule(continues=st.booleans())
    def branch(self, continues: bool) -> None:
        """Copy the world; it continues in the copy, or the copy is left somewhere else."""
        other = copy.deepcopy(self.world)
        self.spoil("branch", other)
        assert self.fault or same(other.values(), self.world.values())
        if continues:
            self.world = other
        else:
            other.step(other.action_high)

    @rule()
    def sent(self) -> None:
        """Write the world down and read it again."""
        self.world = through(self.world)
        self.spoil("pickle")

    # --- what must hold -----------------------------------------------------------------------

    @rule()
    def compare(self) -> None:
        """A twin that repeats what counts has the same values, and the same future."""
        twin = twin_of(self.kind)
        for what, how in self.done:
            if what == "reset":
                twin.reset(seed=how[0], episode=how[1])
            else:
                getattr(twin, what)(how)
        mine, its = self.world.values(), twin.values()
        differing = [name for name in its if not same({0: mine[name]}, {0: its[name]})]
        assert not differing, (differing, self.done)
        assert mine.keys() == its.keys()

    def teardown(self) -> None:
        """Take two more steps, with an intervention that draws, and compare at last."""
        if self.done:
            self.compare()
            self.step(0.7, 1)
            self.world.do({self.about.parameter: Draw("A")})
            self.done.append(("do", {self.about.parameter: Draw("A")}))
            self.step(0.4, 1)
            self.compare()


def histories(kind: str, fault: str | None = None) -> type[Histories]:
    """Return the machine of a kind, with a planted fault or none."""
    return type("Histories", (Histories,), {"kind": kind, "fault": fault})


def run(kind: str, fault: str | None, examples: int, steps: int) -> None:
    """Run random histories; the same ones every time."""
    run_state_machine_as_test(
        histories(kind, fault),
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            derandomize=True,
            database=None,
            deadline=None,
            report_multiple_bugs=False,
            phases=[Phase.generate] if fault else [Phase.generate, Phase.shrink],
            suppress_health_check=list(HealthCheck),
        ),
    )


@pytest.mark.parametrize("kind", KINDS)
def test_random_histories_are_those_of_a_twin(kind: str) -> None:
    """Do, undo, step, reset, snapshot, restore, branch, pickle, and refusals in random order."""
    run(kind, None, examples=15, steps=20)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_random_histories_are_those_of_a_twin(kind: str) -> None:
    """The same, longer."""
    run(kind, None, examples=200, steps=40)


PLANTED = [
    pytest.param(kind, fault, marks=[] if kind == "function" else pytest.mark.slow)
    for kind in KINDS
    for fault in FAULTS
]


@pytest.mark.parametrize(("kind", "fault"), PLANTED)
def test_a_planted_fault_is_found(kind: str, fault: str) -> None:
    """A parameter that moves by one bit after one sort of operation."""
    with pytest.raises(AssertionError):
        run(kind, fault, examples=300, steps=20)
