"""One intervention in many rows has, bit for bit, the result of one world after another."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from worlds import NEEDS_BULLET

from benchmarks.fuzz import random_request
from scm_world import World
from scm_world.errors import (
    EngineFailure,
    InterventionError,
    OutOfBounds,
    UnknownOption,
    WrongValue,
)
from scm_world.tasks import StepTask
from scm_world.variables import (
    Action,
    Box,
    Categories,
    Derived,
    Draw,
    Exogenous,
    Function,
    Hard,
    Measured,
    Mechanism,
    Natural,
    Normal,
    Scale,
    Shift,
)
from scm_world.world import Batch

N = 6


def drag(mass: float, noise: float = 0.0) -> float:
    """Compute a parameter that follows another one."""
    return 0.5 * mass + noise


def raised(size: Any) -> Any:
    """Compute where a block stands on the floor."""
    return np.array([0.12, 0.03, 0.5 * size[2]])


class Cart(StepTask):
    """A cart: its drag follows its mass, and has noise of its own."""

    parameters = (
        Exogenous(
            name="mass",
            distribution=Box(1.0, 2.0),
            default=1.0,
            bounds=Box(0.1, 9.0),
            a=Box(1.0, 2.0),
            b=Box(2.0, 3.0),
        ),
        Exogenous(name="gain", default=1.0, bounds=Box(0.0, 5.0), a=Box(0.5, 1.5)),
        Derived(
            name="drag",
            parents=("mass",),
            mechanism=Function(reference="test_together:drag"),
            noise=Normal(0.0, 0.1),
            bounds=Box(-1.0, 2.2),
        ),
    )
    states = (Measured(name="speed", default=0.0, parents=("mass", "gain", "drag", "push")),)
    actions = (Action(name="push", bounds=Box(-1.0, 1.0)),)
    control_dt = 0.1

    @staticmethod
    def step(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
        """Push the cart."""
        force = parameters["gain"] * action["push"] - parameters["drag"] * state["speed"]
        return {"speed": state["speed"] + 0.1 * force / parameters["mass"]}


HINGE = """<mujoco><worldbody><body name='pole'><joint name='hinge' axis='0 1 0' damping='0.1'/>
<geom type='capsule' size='0.02' fromto='0 0 0 0 0 1'/></body></worldbody>
<actuator><motor name='motor' joint='hinge' ctrlrange='-1 1'/></actuator></mujoco>"""

MASSES: dict[str, tuple[Any, str | None, str, str]] = {
    "mujoco": ("pushing", "mujoco", "tool_block.mass", "floor_friction"),
    "bullet": ("pushing", "bullet", "tool_block.mass", "floor_friction"),
    "fake": ("pushing", "fake", "tool_block.mass", "floor_friction"),
    "file": (HINGE, None, "pole.mass", "hinge.damping"),
    "step": (Cart(), None, "mass", "gain"),
}
KINDS = [pytest.param(k, marks=NEEDS_BULLET if k == "bullet" else ()) for k in MASSES]


def same(worlds: Batch, alone: list[World]) -> None:
    """Assert that worlds hold what worlds by themselves hold: numbers, models and bases."""
    for row, world in enumerate(alone):
        one: Any = worlds.world(row)
        mine, other = one.values(), world.values()
        for name, value in other.items():
            np.testing.assert_array_equal(mine[name], value, f"{name}, {row}")
        assert [*one.graph.interventions.items()] == [*world.graph.interventions.items()]
        assert (one.base is None) == (world.base is None)
        if world.base is not None:
            assert one.base.pending == world.base.pending
            assert one.base.drawn == world.base.drawn
            kept = world.base.row.compiled.kept  # the columns that are not computed from others
            found, wanted = (each.base.row.numbers[kept] for each in (one, world))
            np.testing.assert_array_equal(found, wanted)
        assert one.requested.keys() == world.requested.keys()


def found_together(worlds: Any) -> list[bool]:
    """Return which worlds have done something together, the beginning of an episode included."""
    return [done is not None and bool(done.asked) for done in worlds._done]


def values_are_same(worlds: Batch, alone: list[World]) -> None:
    """Assert that rows hold the values of worlds by themselves, without asking a world alone."""
    found = worlds.values()
    for row, world in enumerate(alone):
        for name, value in world.values().items():
            np.testing.assert_array_equal(found[name][row], value, f"{name}, {row}")


def intervene(worlds: Any, alone: list[World], mask: Any, rng: Any, names: Any) -> bool:
    """Intervene or step in both kinds; return whether worlds took an intervention together."""
    mass, other, low, high = names
    value = low + (high - low) * rng.random(N)
    requests: list[Any] = [
        {mass: value},
        {mass: float(value[0])},
        {mass: Draw(low, high), other: Draw(0.2, 0.4)},
        {other: Hard(0.3), mass: Draw(low, high)},
        {mass: Shift(0.001)},
        {mass: Scale(1.1), other: value},
        {mass: Scale(Draw(1.0, 1.2)), other: Draw(0.2, 0.4)},
        {mass: Shift(Draw(0.0, 0.001))},
        {mass: Natural()},
    ]
    what = rng.integers(len(requests) + 1)
    if what == len(requests):
        action = rng.uniform(-1.0, 1.0, (N, alone[0].action_low.size))
        worlds.step(action, where=mask)
        for row in np.flatnonzero(mask):
            alone[row].step(action[row])
        return False
    request = requests[what]
    found = worlds.do(request, where=mask)
    together = any(found_together(worlds))
    for row in np.flatnonzero(mask):
        audit = alone[row].do(
            {n: v[row] if isinstance(v, np.ndarray) else v for n, v in request.items()}
        )
        if rng.random() < 0.3:  # an audit can be read at any time
            assert str(found[row]) == str(audit)
    return together


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_histories_are_those_of_single_worlds(kind: str, seed: int) -> None:
    """Steps, masks, values, draws, shifts and releases in any order; rows are used alone, too."""
    source, backend, mass, other = MASSES[kind]
    worlds: Any = World(source, backend=backend, num_worlds=N)
    alone = [World(source, backend=backend) for _ in range(N)]
    rng = np.random.default_rng(seed)
    low, high = (1.0, 2.0) if kind == "step" else (0.02, 0.09)
    worlds.reset(seed=seed)
    for row, world in enumerate(alone):
        world.reset(seed=seed + row)
    together = 0
    for turn in range(18):
        if turn in (6, 12):  # what a world has done alone keeps it apart until here
            worlds.reset(seed=seed + turn, do={mass: Draw(low, high)})
            for row, world in enumerate(alone):
                world.reset(seed=seed + turn + row, do={mass: Draw(low, high)})
        mask = rng.random(N) < 0.7
        mask[rng.integers(N)] = True
        together += intervene(worlds, alone, mask, rng, (mass, other, low, high))
        if rng.random() < 0.3:
            values_are_same(worlds, alone)
        if rng.random() < 0.1:  # a world of the batch is used alone
            row = int(rng.integers(N))
            for world in (worlds.world(row), alone[row]):
                world.do({other: 0.25})
    assert together > 0
    for row, world in enumerate(alone):  # a world that took part is restored and copied
        one = worlds.world(row)
        copy = pickle.loads(pickle.dumps(one.snapshot()))  # noqa: S301 # its own
        for _ in range(2):
            one.step(np.zeros(world.action_low.size))
        one.restore(copy)
    same(worlds, alone)
    for _ in range(3):
        worlds.step(np.zeros((N, alone[0].action_low.size)))
        for world in alone:
            world.step(np.zeros(world.action_low.size))
    same(worlds, alone)


BLOCK = "tool_block.cartesian_position"
MOVES: list[dict[str, Any]] = [
    {BLOCK: Draw("A")},
    {"tool_block.cylindrical_position": Draw("A"), "tool_block.mass": 0.05},
    {BLOCK: Shift((0.001, 0.0, 0.0))},
    {"tool_block.linear_velocity": np.linspace(0.0, 0.1, 3 * N).reshape(N, 3)},
    {BLOCK: np.array([[0.1 * np.cos(i), 0.1 * np.sin(i), 0.0325] for i in range(N)])},
    {"tool_block.size": [0.06, 0.05, 0.07]},
    {"tool_block.size": Draw("A"), BLOCK: Mechanism(raised, ("tool_block.size",))},
    {"tool_block.orientation": [0.0, 0.0, 0.6, 0.8]},
    {"tool_block.mass": Mechanism(drag, ("floor_friction",)), "floor_friction": Draw(0.2, 0.4)},
    {"floor_friction": Scale(1.1)},
    {"joint_positions": Draw("A")},
    {"tool_block.linear_velocity": Natural(), "tool_block.mass": Natural()},
    {"control_index": 7},
    {"action": np.full(9, 0.1)},
]


@pytest.mark.parametrize("backend", ["fake", "mujoco", pytest.param("bullet", marks=NEEDS_BULLET)])
@pytest.mark.parametrize("seed", range(3))
def test_histories_of_any_kind_are_those_of_single_worlds(backend: str, seed: int) -> None:
    """What moves bodies, mechanisms, draws again and refusals, at one instant or several."""
    worlds: Any = World("pushing", backend=backend, num_worlds=N)
    alone: list[Any] = [World("pushing", backend=backend) for _ in range(N)]
    rng = np.random.default_rng(seed)
    together = moved = refused = 0
    for turn in range(40):
        if turn % 10 == 0:
            worlds.reset(seed=seed + turn)
            for row, world in enumerate(alone):
                world.reset(seed=seed + turn + row)
        mask = rng.random(N) < 0.7
        mask[rng.integers(N)] = True
        if turn % 10 and rng.random() < 0.3:
            action = rng.uniform(-1.0, 1.0, (N, 9))
            worlds.step(action, where=mask)
            for row in np.flatnonzero(mask):
                alone[row].step(action[row])
            continue
        request = MOVES[rng.integers(len(MOVES)) if turn % 10 else turn // 10]
        if turn % 10 and rng.random() < 0.3:
            request = random_request(alone[int(np.argmax(mask))], rng)
        audits = worlds.do(request, where=mask, on_refusal="skip")
        done = [worlds._done[row] for row in np.flatnonzero(mask)]
        together += any(one is not None and one.asked for one in done)
        moved += any(one is not None and one.states is not None for one in done)
        for row in np.flatnonzero(mask).tolist():
            own = {
                n: v[row] if isinstance(v, np.ndarray) and v.ndim == 2 else v
                for n, v in request.items()
            }
            try:
                audit, problem = alone[row].do(own), ""
            except InterventionError as error:
                audit, problem = None, str(error)
            refused += bool(problem)
            assert str(audits.refused.get(row, "")) == problem
            if problem:
                continue
            assert row in audits
            if rng.random() < 0.2:  # an audit can be read at any time
                assert str(audits[row]) == str(audit)
        if rng.random() < 0.3:
            values_are_same(worlds, alone)
    assert together > 0
    assert moved > 0
    assert refused > 0
    same(worlds, alone)
    for _ in range(2):
        worlds.step(np.zeros((N, 9)))
        for world in alone:
            world.step(np.zeros(9))
    same(worlds, alone)


@pytest.mark.parametrize("kind", KINDS)
def test_a_reset_draws_in_all_rows(kind: str) -> None:
    """An intervention of a reset takes part in the beginning; a second draw is another one."""
    source, backend, mass, _ = MASSES[kind]
    worlds: Any = World(source, backend=backend, num_worlds=N)
    alone = [World(source, backend=backend) for _ in range(N)]
    for seed in (3, 40):
        worlds.reset(seed=seed, do={mass: Draw(1.0, 2.0)})
        first = worlds[mass]
        assert np.unique(first).size == N
        worlds.do({mass: Draw(1.0, 2.0)})
        assert (worlds[mass] != first).all()
        for row, world in enumerate(alone):
            world.reset(seed=seed + row, do={mass: Draw(1.0, 2.0)})
            world.do({mass: Draw(1.0, 2.0)})
        same(worlds, alone)
    mask = np.arange(N) % 2 == 0
    worlds.reset(seed=9, where=mask)
    for row in np.flatnonzero(mask):
        alone[row].reset(seed=9 + row)
    same(worlds, alone)


def test_draws_are_those_of_the_noise_itself() -> None:
    """The numbers are computed directly from the noise of each seed."""
    from scm_world.variables.distributions import Noise

    worlds: Any = World("pushing", backend="fake", num_worlds=4)
    worlds.reset(seed=[7, 1, 4, 2])
    worlds.step(np.zeros((4, 9)))
    worlds.do({"tool_block.mass": Draw(0.02, 0.08)})
    for row, seed in enumerate([7, 1, 4, 2]):
        uniform = Noise(seed).uniforms("tool_block.mass", n=1, step=1)[0, 0]
        assert worlds["tool_block.mass"][row] == 0.02 + (0.08 - 0.02) * uniform


def test_a_follower_is_computed_in_each_row_and_may_refuse() -> None:
    """A parameter that follows a target keeps the noise of its row; its bounds are checked."""
    worlds: Any = World(Cart(), num_worlds=N)
    worlds.reset(seed=0)
    noise = worlds["drag"] - 0.5 * worlds["mass"]
    masses = np.linspace(1.0, 4.8, N)
    before = worlds["drag"]
    with pytest.raises(OutOfBounds, match="world 5") as error:
        worlds.do({"mass": masses})
    assert error.value.variable == "drag"
    np.testing.assert_array_equal(worlds["drag"], before)
    found = worlds.do({"mass": masses}, on_refusal="skip")
    assert [*found] == [0, 1, 2, 3, 4]
    assert [*found.refused] == [5]
    assert isinstance(found.refused[5], OutOfBounds)
    np.testing.assert_allclose(worlds["drag"][:5], 0.5 * masses[:5] + noise[:5], rtol=1e-14)
    assert worlds["mass"][5] != masses[5]
    assert worlds["drag"][5] == before[5]
    table = found.table()
    assert table["world"].tolist() == [0, 1, 2, 3, 4]
    assert table["applied"].tolist() == masses[:5].tolist() == table["reported"].tolist()
    assert {*table["follows"]} == {("drag",)}
    assert "refused in 1 world: 5" in str(found)
    assert "mass: 1. to 4.04 in 5 worlds" in str(found)


def test_a_space_is_checked_in_each_row() -> None:
    """A value outside of the space is refused in its world; a draw from it is not."""
    worlds: Any = World(Cart(), num_worlds=N)
    worlds.reset(seed=0)
    worlds.do({"mass": Draw("A")}, space="A")
    with pytest.raises(OutOfBounds, match="world 3"):
        worlds.do({"mass": [1.1, 1.2, 1.3, 2.5, 1.4, 2.6]}, space="A")
    found = worlds.do({"mass": [1.1, 1.2, 1.3, 2.5, 1.4, 2.6]}, space="A", on_refusal="skip")
    assert [*found.refused] == [3, 5]
    with pytest.raises(UnknownOption, match="on_refusal"):
        worlds.do({"mass": 1.5}, on_refusal="ignore")


def test_labels_and_whole_numbers_are_one_for_each_world() -> None:
    """Categories are set by their labels, as in one world; wrong ones name their world."""

    class Seasons(Cart):
        parameters = (
            *Cart.parameters,
            Exogenous(
                name="season",
                dtype="categorical",
                default=0,
                bounds=Categories(labels=("dry", "wet")),
            ),
            Exogenous(name="crew", dtype="integer", default=1),
        )
        states = (Measured(name="speed", default=0.0, parents=("season", "crew", "push")),)

    worlds: Any = World(Seasons(), num_worlds=3)
    worlds.reset(seed=0)
    worlds.do({"season": ["wet", "dry", "wet"], "crew": [2.0, 3, np.int64(4)]})
    assert worlds["season"].tolist() == [1, 0, 1]
    assert worlds["crew"].tolist() == [2, 3, 4]
    assert all(found_together(worlds))
    with pytest.raises(WrongValue, match="world 2"):
        worlds.do({"crew": [2, 3, 2.5]})
    with pytest.raises(InterventionError, match="world 1"):
        worlds.do({"season": ["wet", "cold", "dry"]})
    assert worlds["crew"].tolist() == [2, 3, 4]


def test_values_of_some_worlds() -> None:
    """``values`` has the selected worlds in their order, under their names."""
    worlds: Any = World(Cart(), num_worlds=N)
    worlds.reset(seed=0)
    mask = np.array([False, True, True, False, False, True])
    found = worlds.values(where=mask)
    for name, value in worlds.world(2).values().items():
        np.testing.assert_array_equal(found[name][1], value)
        assert found[name].dtype == value.dtype
    assert found["mass"].shape == (3,)
    assert [*found] == [*worlds.world(0).values()]


@pytest.mark.parametrize("fault", ["refuses", "reports another value"])
def test_what_one_engine_does_not_take_over_is_undone_in_all(
    fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the engine of one world fails, no world has changed, and the error names it."""
    worlds: Any = World("pushing", backend="fake", num_worlds=N)
    worlds.reset(seed=0)
    worlds.world(4).do({"floor_friction": 0.3})  # this one takes no part in the others' row
    worlds.step(np.zeros((N, 9)))
    before = worlds.values()
    engine = worlds.world(3).backend
    if fault == "refuses":

        def refuse(difference: Any) -> None:
            raise EngineFailure("it is broken", "fake")

        monkeypatch.setattr(engine, "apply", refuse)
    else:
        reads = engine.parameters

        def other(keys: Any) -> Any:
            return {k: v if k[1] == "inertia" else v + 1.0 for k, v in reads(keys).items()}

        monkeypatch.setattr(engine, "parameters", other)
    said = "world 3: it is broken" if fault == "refuses" else "did not take over tool_block.mass"
    with pytest.raises(EngineFailure, match=said):
        worlds.do({"tool_block.mass": Draw("A")})
    monkeypatch.undo()
    for name, value in worlds.values().items():
        np.testing.assert_array_equal(value, before[name], name)
    for row in range(N):
        one = worlds.world(row)
        assert "tool_block.mass" not in one.graph.interventions
        key = one.compiled.parameter_keys["tool_block.mass"]
        assert one.backend.parameters([key])[key] == before["tool_block.mass"][row]


def test_worlds_that_differ_take_it_in_groups() -> None:
    """Worlds of another structure, or with interventions of their own, are in other groups."""
    worlds: Any = World("pushing", backend="fake", num_worlds=N)
    worlds.reset(seed=0)
    worlds.do({"floor_friction": [0.3] * N}, where=np.arange(N) < 3)
    assert found_together(worlds) == [True] * 3 + [False] * 3
    worlds.do({"tool_block.mass": 0.05})
    assert all(found_together(worlds))
    assert len({id(done) for done in worlds._done}) == 2
    assert worlds["floor_friction"][:3].tolist() == [0.3] * 3
    for row in range(N):
        held = worlds.world(row).graph.interventions
        assert ("floor_friction" in held) == (row < 3)
        assert held["tool_block.mass"] == Hard(0.05)


def test_an_unknown_name_is_an_error_of_the_first_world() -> None:
    """It is refused as in a single world."""
    worlds: Any = World("pushing", backend="fake", num_worlds=N)
    worlds.reset(seed=0)
    with pytest.raises(InterventionError, match="world 0"):
        worlds.do({"tool_block.masss": 0.05})


def test_many_interventions_at_one_instant_leave_no_chain() -> None:
    """Any number of them can be read, saved and gone on from, as in a world alone."""
    count = 1200  # more than Python nests calls
    worlds: Any = World(Cart(), num_worlds=2)
    alone = [World(Cart()) for _ in range(2)]
    worlds.reset(seed=0)
    for row, world in enumerate(alone):
        world.reset(seed=row)
    for world in (worlds, *alone):
        world.do({"gain": Shift(Draw(0.0, 0.1))})
    for _ in range(count):
        found = worlds.do({"mass": Draw("A")})
    for row, world in enumerate(alone):
        for _ in range(count):
            audit = world.do({"mass": Draw("A")})
        assert str(found[row]) == str(audit)
    assert all(found_together(worlds))
    worlds.restore(worlds.snapshot())
    same(worlds, alone)


def test_values_of_python_objects_are_numbers() -> None:
    """An array of Python numbers sets them, and refuses what is not one."""
    worlds: Any = World(Cart(), num_worlds=3)
    worlds.reset(seed=0)
    worlds.do({"mass": np.array([1.5, 2.5, 3.5], dtype=object)})
    assert worlds["mass"].tolist() == [1.5, 2.5, 3.5]
    with pytest.raises(InterventionError, match="world 1"):
        worlds.do({"mass": np.array([1.0, None, 2.0], dtype=object)})
    assert worlds["mass"].tolist() == [1.5, 2.5, 3.5]
