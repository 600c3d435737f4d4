"""``World(model, num_worlds=n)``: each of many equations is, bit for bit, as it is alone."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Draw, World
from scm_world.errors import (
    ActionError,
    FunctionFailure,
    InterventionError,
    ModelError,
    NotReset,
    OutOfBounds,
    SnapshotMismatch,
    UnknownOption,
    UnknownVariable,
)
from scm_world.variables import (
    Action,
    Box,
    Categories,
    Derived,
    Exogenous,
    Hard,
    Integers,
    Linear,
    Normal,
    Parent,
    Reaches,
    Shift,
)
from scm_world.world import CompiledModel, Equations

N = 5


def _alone(x: Any, z: Any) -> Any:
    """Add numbers; a batch of them is refused."""
    return float(x) + 0.5 * float(z)


def model(*, vectorised: bool = True) -> SCM:
    """A model with noise of all kinds, a vector, an integer, an action and lags."""
    last = {"mechanism": Linear(weights=(0.5, 1.0, 1.0))}
    return SCM(
        [
            Exogenous(name="kept", distribution=Normal(), a=Box(0.0, 1.0)),
            Exogenous(name="x", distribution=Normal(), per="step", a=Box(0.0, 1.0)),
            Exogenous(name="pair", shape=(2,), default=(1.0, 2.0), distribution=Box(0.0, 3.0)),
            Exogenous(name="count", dtype="integer", default=1, bounds=Integers(0, 9)),
            Action(name="push", bounds=Box(-1.0, 1.0)),
            Derived(
                name="y",
                parents=("x", "count"),
                mechanism=Linear(weights=(2.0, 1.0)),
                noise=Normal(),
            ),
            Derived(name="z", parents=(Parent("z", 1), Parent("push", 1), "y"), **last),
            Derived(
                name="late",
                parents=(Parent("kept", 2), Parent("z", 1)),
                mechanism=Linear(weights=(1.0, 1.0)),
            ),
            *(
                []
                if vectorised
                else [Derived(name="own", parents=("x", Parent("z", 1)), mechanism=_alone)]
            ),
        ]
    )


def of_row(act: Any, row: int) -> Any:
    """Return what an intervention, or one value for each world, is in one world."""
    if isinstance(act, Hard) and np.shape(act.value) == (N,):
        return act.model_copy(update={"value": act.value[row]})
    return act[row] if isinstance(act, list | np.ndarray) else act


def alike(worlds: Any, alone: list[Any]) -> None:
    """Assert that all values are those of worlds by themselves, bit for bit."""
    found = worlds.values()
    for name in alone[0].model:
        wanted = [world[name] for world in alone]
        np.testing.assert_array_equal(worlds[name], wanted, name)
        np.testing.assert_array_equal(found[name], wanted, name)
        assert found[name].dtype == alone[0][name].dtype
    np.testing.assert_array_equal(worlds.index, [world.index for world in alone])


@pytest.mark.parametrize("vectorised", [True, False])
def test_each_is_the_world_alone(vectorised: bool) -> None:
    """Masks, values of each world, draws, shifts, worlds used alone, and partial resets."""
    scm = model(vectorised=vectorised)
    worlds: Any = World(scm, num_worlds=N)
    alone: list[Any] = [World(scm) for _ in range(N)]
    assert alone[0].compiled.is_vectorised == vectorised
    assert len(worlds.systems) == (1 if vectorised else N)
    with pytest.raises(NotReset):
        worlds["x"]
    worlds.reset(seed=7, do={"count": [0, 1, 2, 3, 4]})
    for seed, world in enumerate(alone):
        world.reset(seed=7 + seed, do={"count": seed})
    alike(worlds, alone)
    rng = np.random.default_rng(0)
    for step in range(10):
        where = rng.uniform(size=N) < 0.6
        where[step % N] = True
        rows, given = np.flatnonzero(where).tolist(), rng.uniform(-2.0, 2.0, (N, 1))
        worlds.step(given, where=where)
        for row in rows:
            alone[row].step(given[row])
        alike(worlds, alone)
        each: Any = rng.uniform(size=N)
        requests: dict[int, Any] = {
            2: {"x": each},
            3: {"x": Draw("A"), "z": Shift(1.0)},
            4: {"push": Hard(each.tolist()), "pair": rng.uniform(size=(N, 2))},
            5: {"x": Draw("A")},
            6: {"count": [4, 3, 2, 1, 0]},
        }
        if step in requests:
            audits = worlds.do(requests[step], where=where)
            assert [*audits] == rows
            for row in rows:
                own = {name: of_row(act, row) for name, act in requests[step].items()}
                assert str(audits[row]) == str(alone[row].do(own))
        if step == 7:
            worlds.world(2).step([1.0])
            alone[2].step([1.0])
            assert worlds.world(2) is worlds.world(2)
        if step == 8:
            worlds.reset(seed=[None, 3, None, None, None], where=np.arange(N) < 2)
            alone[0].reset()
            alone[1].reset(seed=3)
        alike(worlds, alone)


@pytest.mark.parametrize(
    "plan",
    [
        {"x": Hard(0.25, at=2), "z": Shift(1.0), "count": Hard(3, during=(1, 3))},
        {"x": Hard(0.25, when=Reaches("z", above=0.0))},
        {"x": Hard(0.25, at=2), "count": [0, 1, 2, 3, 4], "pair": [[0.5, 1.0]] * N},
    ],
    ids=["times", "event", "values of each"],
)
@pytest.mark.parametrize("context", [None, {"kept": Shift(0.5), "y": Hard(1.0, at=3)}])
def test_plans_and_contexts_act_as_in_one_world(plan: Any, context: Any) -> None:
    """They hold in every episode; an event occurs in each world at its own time."""
    scm = model()
    worlds: Any = World(scm, num_worlds=N)
    alone: list[Any] = [World(scm) for _ in range(N)]
    if context is not None:
        worlds, alone = worlds.given(context), [world.given(context) for world in alone]
    for start in (1, 11):
        worlds.reset(seed=start, do=plan)
        for row, world in enumerate(alone):
            own = {name: of_row(act, row) for name, act in plan.items()}
            world.reset(seed=start + row, do=own)
        for step in range(5):
            alike(worlds, alone)
            worlds.step(np.full((N, 1), 0.1 * step))
            for world in alone:
                world.step([0.1 * step])
        worlds.do({"kept": Shift(0.25)})
        for world in alone:
            world.do({"kept": Shift(0.25)})
        alike(worlds, alone)
    again = worlds.given({"x": 0.5})  # within an episode
    alike(again, [world.given({"x": 0.5}) for world in alone])
    alike(worlds, alone)


def test_a_refusal_changes_nothing_anywhere() -> None:
    """The error is that of a single world, and says which one; no world has changed."""
    worlds: Any = World(model(), num_worlds=N)
    worlds.reset(seed=0)
    worlds.step(np.zeros((N, 1)))
    before = worlds.values()
    with pytest.raises(OutOfBounds, match="world 2: do\\(push\\)"):
        worlds.do({"x": 0.5, "push": [0.0, 0.0, 3.0, 0.0, 4.0]})
    with pytest.raises(InterventionError, match="world 1"):
        worlds.do({"count": [0, 1.5, 2, 3, 4]})
    with pytest.raises(OutOfBounds, match="world 3"):
        worlds.do({"x": [0.0, 0.1, 0.2, 7.0, 0.3]}, space="A")
    with pytest.raises(UnknownVariable):
        worlds.do({"q": 1.0})
    with pytest.raises(ActionError, match="world 1"):
        worlds.step([[0.0], [np.nan], [0.0], [0.0], [0.0]])
    for given in (np.zeros((N, 2)), np.zeros(N), [["a"]] * N):
        with pytest.raises(ActionError, match="worlds have shape"):
            worlds.step(given)
    for where in ([True] * N, np.zeros(N, bool), np.ones(2, bool)):
        with pytest.raises(UnknownOption, match="truth values"):
            worlds.do({"x": 0.4}, where=where)
    for name, value in worlds.values().items():
        np.testing.assert_array_equal(value, before[name], name)
    audits = worlds.do({"push": [0.0, 0.1, 3.0, 0.3, 4.0]}, on_refusal="skip")
    assert ([*audits], [*audits.refused]) == ([0, 1, 3], [2, 4])
    worlds.step(np.zeros((N, 1)))
    assert worlds["push"].ravel().tolist() == [0.0, 0.1, 0.0, 0.3, 0.0]
    with pytest.raises(OutOfBounds, match="world 1"):
        worlds.reset(seed=3, do={"push": [0.0, 2.0, 0.0, 0.0, 0.0]})
    assert worlds.index.tolist() == [0] * N  # the episodes have begun without it
    for n in (0, 1.5, "3"):
        with pytest.raises(UnknownOption, match="num_worlds"):
            World(model(), num_worlds=n)  # type: ignore[arg-type]
    with pytest.raises(UnknownOption, match="threads"):
        World(model(), num_worlds=2, threads=2)


def test_a_function_that_fails_in_one_world_names_it() -> None:
    """All worlds are as they were."""

    def root(x: Any) -> Any:
        return np.sqrt(x - np.where(x > 4.0, np.nan, 0.0))

    worlds: Any = World(
        SCM(
            [
                Exogenous(name="x", default=1.0),
                Derived(
                    name="y", parents=(Parent("y", 1), "x"), mechanism=lambda y, x: y + root(x)
                ),
            ]
        ),
        num_worlds=3,
    )
    worlds.reset(seed=0)
    worlds.step(np.zeros((3, 0)))
    with pytest.raises(FunctionFailure, match="world 1: the function of 'y' gives NaN"):
        worlds.do({"x": [1.0, 9.0, 4.0]})
    worlds.do({"x": [1.0, 2.25, 4.0]})
    assert worlds["y"].tolist() == [1.0, 1.5, 2.0]


def test_snapshots_pickles_and_undo() -> None:
    """The future after going back is the same, bit for bit, also in a copy."""
    worlds: Any = World(model(), num_worlds=N)
    worlds.reset(seed=3, do={"kept": Hard(0.5, at=4)})
    worlds.do({"x": np.arange(N) / 10})
    worlds.step(np.ones((N, 1)))
    worlds.world(1).do({"y": 1.0})
    saved, other = worlds.snapshot(), pickle.loads(pickle.dumps(worlds))  # noqa: S301 # our own
    stored = pickle.loads(pickle.dumps(saved))  # noqa: S301 # our own
    ends = []
    for one, snapshot in ((worlds, None), (worlds, saved), (worlds, stored), (other, None)):
        if snapshot is not None:
            one.restore(snapshot)
        with one.unchanged():
            one.reset(seed=9)
        for _ in range(4):
            one.step(np.full((N, 1), 0.5))
        ends.append({name: value.tobytes() for name, value in one.values().items()})
    assert all(end == ends[0] for end in ends)
    with pytest.raises(SnapshotMismatch):
        worlds.restore(saved[:2])
    with pytest.raises(SnapshotMismatch):
        World(SCM([Exogenous(name="x")]), num_worlds=N).restore(saved)  # type: ignore[arg-type]
    assert {name: value.tobytes() for name, value in worlds.values().items()} == ends[0]


def test_seeds_count_up_and_episodes_follow() -> None:
    """Without a seed the next episode of each world begins; a first one has a seed of its own."""
    scm = model()
    worlds: Any = World(scm, num_worlds=3)
    worlds.reset()
    assert len({*worlds["kept"].tolist()}) == 3
    worlds.reset(seed=[4, 4, 6])
    worlds.reset(where=np.array([False, True, True]))
    alone: list[Any] = [World(scm) for _ in range(3)]
    for world, (seed, episode) in zip(alone, ((4, 0), (4, 1), (6, 1)), strict=True):
        world.reset(seed=seed, episode=episode)
    alike(worlds, alone)
    for seed in ([1, 2], "abc", -1):
        with pytest.raises(UnknownOption, match="seed"):
            worlds.reset(seed=seed)
    timeless: Any = World(SCM([Exogenous(name="x")]), num_worlds=2)
    timeless.reset(seed=0)
    with pytest.raises(ModelError, match="one instant"):
        timeless.step(np.zeros((2, 0)))


def test_categories_of_each_world() -> None:
    """Labels and numbers of categories are values of each world, too."""
    scm = SCM([Exogenous(name="c", dtype="categorical", bounds=Categories((0, 1, 2)), default=0)])
    worlds: Any = World(scm, num_worlds=3)
    worlds.reset(seed=0, do={"c": [2, 0, 1]})
    assert worlds["c"].tolist() == [2, 0, 1]
    with pytest.raises(InterventionError, match="world 2"):
        worlds.do({"c": [0, 1, 7]})


def test_worlds_that_meet_again_keep_their_places() -> None:
    """Worlds that were at different instants are solved together again, each in its row."""
    scm = model()
    worlds: Any = World(scm, num_worlds=N)
    alone: list[Any] = [World(scm) for _ in range(N)]
    worlds.reset(seed=0)
    for seed, world in enumerate(alone):
        world.reset(seed=seed)
    actions = np.linspace(-1.0, 1.0, N)[:, None]
    first = np.array([False, True, False, True, True])
    for where in (first, ~first, None):
        worlds.step(actions, where=where)
    for row, world in enumerate(alone):
        for _ in range(2):
            world.step(actions[row])
    assert len(worlds.systems) == 1
    alike(worlds, alone)


def test_an_action_of_several_numbers_differs_between_worlds() -> None:
    """Their bounds have one end for each number."""
    scm = SCM(
        [
            Action(name="pull", shape=(2,), bounds=Box((-1.0, -2.0), (1.0, 2.0))),
            Derived(name="area", parents=("pull",), mechanism=lambda p: p[..., 0] * p[..., 1]),
        ]
    )
    worlds: Any = World(scm, num_worlds=3)
    worlds.reset(seed=0, do={"pull": [[0.5, 1.0], [1.0, -2.0], [-1.0, 0.5]]})
    assert worlds["area"].tolist() == [0.5, -2.0, -0.5]
    with pytest.raises(OutOfBounds, match="world 1"):
        worlds.do({"pull": [[0.5, 1.0], [1.5, -2.0], [-1.0, 0.5]]})


def test_audits_say_what_acts_in_each_world() -> None:
    """A soft intervention says on what it acts, and a second draw which one it is."""
    scm = model()
    context = {"push": Shift(0.1)}
    worlds: Any = World(scm, num_worlds=2).given(context)
    world: Any = World(scm).given(context)
    worlds.reset(seed=0)
    world.reset(seed=0)
    for _ in range(2):
        asked = {"push": Shift(Draw(-0.1, 0.1)), "x": Draw("A")}
        assert str(worlds.do(asked)[0]) == str(world.do(asked))


def test_the_next_episodes_of_equations_solved_together() -> None:
    """A reset without a seed begins the next episode of each, also at the same instant."""
    compiled = CompiledModel(model())
    together = Equations(compiled, 2)
    together.reset(seed=[4, 9], episode=[0, 3])  # type: ignore[arg-type] # of several
    for number in (0, 1):
        for row, (seed, first) in enumerate(((4, 0), (9, 3))):
            alone = Equations(compiled)
            alone.reset(seed=seed, episode=first + number)
            np.testing.assert_array_equal(together["kept"][row], alone["kept"])
        together.reset()
