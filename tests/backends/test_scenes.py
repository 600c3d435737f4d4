"""An engine that holds many scenes by itself: parameters and states in arrays, no backend each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import numpy as np

import scm_world as sw
from scm_world.backends import Backend, Capabilities, EngineSnapshot, OneScene, Scenes, register
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.models import ParameterKey, Parameters, Scene
from scm_world.testing.backend import BackendConformance
from scm_world.world import Batch, Simulation


class Table(Scenes):
    """The fake of many scenes: a dict of parameters and a vector for each, and a list of calls."""

    def __init__(self, n: int, threads: int) -> None:
        self.rows: list[Any] = [None] * n
        self.calls: list[str] = []

    def __len__(self) -> int:
        return len(self.rows)

    def structure(self, index: int) -> Any:
        """Return the structure of a row."""
        return self.rows[index][0]

    def build(self, which: Any, scene: Scene) -> None:
        """Fill rows."""
        self.calls.append("build")
        for index in which.tolist():
            given = {key: np.array(value) for key, value in scene.parameters.items()}
            self.rows[index] = scene.structure, given, scene.state.vector.copy()

    def apply(
        self, which: Any, parameters: Parameters, states: Any = None, structure: Any = None
    ) -> None:
        """Change rows, except those that lack a parameter."""
        self.calls.append("apply")
        refused, first = [], None
        for place, index in enumerate(which.tolist()):
            now, known, vector = self.rows[index]
            if structure is not None:
                new = structure.default_scene()
                old = now.empty_state().with_vector(vector)
                new.state.carry(old)
                stays = {k: v for k, v in known.items() if k in new.parameters}
                now, known, vector = structure, {**new.parameters, **stays}, new.state.vector
            missing = [key for key in parameters if key not in known]
            if missing:
                refused.append(index)
                first = first or UnknownOption("parameter", ".".join(missing[0]), ())
                continue
            here = {k: np.array(v[place % len(v)]) for k, v in parameters.items()}
            if states is not None:
                vector = np.where(now.layout.can_be_set, states[place], vector)
                if hasattr(now, "settle"):
                    now.settle(now.empty_state().with_vector(vector))
            self.rows[index] = now, {**known, **here}, vector
        if first is not None:
            first.scenes = tuple(refused)
            raise first

    def parameters(
        self, which: Any, keys: Iterable[ParameterKey]
    ) -> dict[ParameterKey, np.ndarray[Any, Any]]:
        """Stack the parameters of rows."""
        self.calls.append("parameters")
        return {key: np.stack([self._value(i, key) for i in which.tolist()]) for key in keys}

    def _value(self, index: int, key: ParameterKey) -> Any:
        structure, known, _ = self.rows[index]
        if key in known:
            return known[key]
        if key[1] == "inertia" and hasattr(structure, "inertia"):
            return structure.inertia(known, key[0])
        raise UnknownOption("parameter", ".".join(key), ())

    def read(self, which: Any) -> Any:
        """Stack the states of rows."""
        return np.stack([self.rows[i][2] for i in which.tolist()])

    def step(self, which: Any, commands: Any, substeps: int, into: Any) -> None:
        """Let the structure move, and refuse numbers that are not finite."""
        self.calls.append("step")
        for index in which.tolist():
            structure, known, vector = self.rows[index]
            if hasattr(structure, "move"):
                state = structure.empty_state().with_vector(vector.copy())
                command = commands[index, : structure.n_commands]
                structure.move(state, command, substeps * structure.timestep)
                vector = state.vector
                self.rows[index] = structure, known, vector
            into[index, : vector.size] = vector
        lost = [i for i in which.tolist() if not np.isfinite(self.rows[i][2]).all()]
        if lost:
            failed = EngineFailure("a number is not finite", "table")
            failed.row, failed.lost = lost[0], tuple(lost)
            raise failed

    def contacts(self, which: Any) -> Any:
        """Nothing touches."""
        return ((),) * len(which)

    def snapshot(self, which: Any) -> tuple[EngineSnapshot, ...]:
        """Copy rows, which are never changed in place."""
        return tuple(EngineSnapshot("table 1", self.rows[i]) for i in which.tolist())

    def restore(self, which: Any, snapshots: Sequence[EngineSnapshot]) -> None:
        """Write rows back."""
        found = [one.opened(OneTable()) for one in snapshots]
        for place, index in enumerate(which.tolist()):
            self.rows[index] = found[place % len(found)]

    def close(self) -> None:
        """Forget everything."""


class OneTable(OneScene):
    """One row of a table."""

    name: ClassVar[str] = "table"
    version = "1"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False)
    batch: ClassVar[type[Scenes]] = Table


class TestTable(BackendConformance):
    """The suite, on a row of a table and on many rows."""

    def make(self) -> Backend:
        """Create it."""
        return OneTable()


def test_worlds_that_begin_elsewhere_move_into_one_engine() -> None:
    """A batch moves begun episodes into one engine, which steps all in one call."""
    first = Simulation("pushing", backend=OneTable())
    worlds = [first, *(Simulation(first.structures, backend=OneTable()) for _ in range(2))]
    alone = [Simulation("pushing", backend="fake") for _ in range(3)]
    for seed, other in enumerate(alone):
        other.reset(seed=seed)
    worlds[0].reset(seed=0)
    worlds[2].reset(seed=2)
    batch = Batch(worlds, threads=1)
    batch.reset(seed=[None, 1, None], where=np.array([False, True, False]))
    engine: Any = worlds[0].backend
    engines = {id(world.backend.scenes) for world in worlds}  # type: ignore[attr-defined]
    assert engines == {id(engine.scenes)}
    batch.do({"tool_block.mass": np.array([0.03, 0.04, 0.05])})
    engine.scenes.calls.clear()
    batch.step(np.zeros((3, 9)))
    assert engine.scenes.calls.count("step") == 1
    assert batch["tool_block.mass"].tolist() == [0.03, 0.04, 0.05]
    for world, other, mass in zip(worlds, alone, (0.03, 0.04, 0.05), strict=True):
        other.do({"tool_block.mass": mass})
        other.step(np.zeros(9))
        assert world.vector.tobytes() == other.vector.tobytes()


def test_many_worlds_are_rows_of_one_engine() -> None:
    """Opened together, they are built, reset, changed and stepped in one call of the engine."""
    register(OneTable)
    worlds: Any = sw.World("pushing", backend="table", num_worlds=4)
    alone = [sw.World("pushing", backend="fake") for _ in range(4)]
    calls, mask = worlds._engine.calls, np.array([True, False, True, True])
    worlds.reset(seed=0)
    assert calls == ["build"]
    calls.clear()
    worlds.reset(seed=5, where=mask, do={"tool_block.mass": sw.Draw("A")})
    worlds.step(np.zeros((4, 9)))
    assert [calls.count(call) for call in ("build", "apply", "step")] == [0, 1, 1]
    one = worlds.world(2)  # which is the same row of the engine
    one.do({"floor_friction": 0.25})
    worlds.step(np.zeros((4, 9)), where=mask)
    for row, world in enumerate(alone):
        world.reset(seed=5 + row if mask[row] else row)
        if mask[row]:
            world.do({"tool_block.mass": sw.Draw("A")})
        world.step(np.zeros(9))
        if row == 2:
            world.do({"floor_friction": 0.25})
        if mask[row]:
            world.step(np.zeros(9))
        for name, value in world.values().items():
            np.testing.assert_array_equal(worlds[name][row], value, name)
    worlds.close()


def test_what_is_built_keeps_its_scene_when_it_moves() -> None:
    """What is not built yet moves without one."""
    backends, world = [OneTable() for _ in range(2)], Simulation("pushing", backend="fake")
    world.reset(seed=0)
    backends[1].build(world.scene())
    engine = Table.of(backends, 1)
    assert engine.calls == []
    assert engine.read(np.array([1]))[0].tobytes() == world.vector.tobytes()
    backends[0].build(world.scene())
    assert engine.calls == ["build"]
    assert backends[0].read() == backends[1].read()
