"""What it means that several scenes of an engine are stepped in one call."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.backends.base import Backend, EngineBatch, EngineSnapshot
from scm_world.errors import EngineFailure
from scm_world.models.scene import Difference, Scene
from scm_world.tasks.trifinger.hardware import REST
from scm_world.tasks.trifinger.state import BLOCK_SIZE, PhysicalState
from scm_world.testing.scenes import SUBSTEPS, Suite, other_value

COUNT = 4


class TogetherConformance(Suite):
    """Sentences about ``Backend.batch``."""

    @pytest.fixture
    def twice(self, scene: Scene) -> Iterator[tuple[list[Backend], list[Backend]]]:
        """Provide scenes that differ in a parameter each, two of each kind."""
        with ExitStack() as stack:

            def several() -> list[Backend]:
                return [stack.enter_context(self.built(_other(scene, i))) for i in range(COUNT)]

            yield several(), several()

    @pytest.mark.parametrize("threads", [1, 2, 4])
    def test_together_is_one_after_another(
        self, twice: tuple[list[Backend], list[Backend]], threads: int
    ) -> None:
        """Whoever is stepped together does, bit for bit, what it does alone."""
        alone, many = twice
        batch = type(many[0]).batch(many, threads)
        into = _table(many)
        for step, commands in enumerate(_commands(8)):
            which = np.arange(COUNT) if step % 3 else np.array([0, 2])
            batch.step(which, commands, SUBSTEPS, into)
            for index in which.tolist():
                alone[index].step(commands[index], SUBSTEPS)
                vector = alone[index].state().vector
                np.testing.assert_array_equal(into[index, : vector.size], vector)

    def test_each_can_be_used_alone_in_between(
        self, twice: tuple[list[Backend], list[Backend]]
    ) -> None:
        """Reading, changing, saving, restoring and stepping one alone fits in at any time."""
        alone, many = twice
        batch = type(many[0]).batch(many, 2)
        into = _table(many)
        saved = [(one.snapshot(), other.snapshot()) for one, other in zip(alone, many, strict=True)]
        for step, commands in enumerate(_commands(8)):
            batch.step(np.arange(COUNT), commands, SUBSTEPS, into)
            for index in range(COUNT):
                alone[index].step(commands[index], SUBSTEPS)
            for backend, start in ((alone[1], saved[1][0]), (many[1], saved[1][1])):
                _meddle(backend, step, start)
            for one, other in zip(alone, many, strict=True):
                np.testing.assert_array_equal(other.state().vector, one.state().vector)
            first, second = alone[step % COUNT].contacts(), many[step % COUNT].contacts()
            assert [c.bodies for c in first] == [c.bodies for c in second]
            assert [c.force for c in first] == [c.force for c in second]

    def test_bodies_may_come_and_go(
        self, twice: tuple[list[Backend], list[Backend]], scene: Scene
    ) -> None:
        """One of them may change its structure, and all continue as if alone."""
        alone, many = twice
        batch = type(many[0]).batch(many, 2)
        into = _table(many, extra=1)
        more = replace(scene.structure, blocks=(*scene.structure.blocks, "new"))
        changes = {2: more, 4: scene.structure}
        for step, commands in enumerate(_commands(6)):
            if step in changes:
                alone[2].apply(Difference(structure=changes[step]))
                many[2].apply(Difference(structure=changes[step]))
            batch.step(np.arange(COUNT), commands, SUBSTEPS, into)
            for index in range(COUNT):
                alone[index].step(commands[index], SUBSTEPS)
                vector = alone[index].state().vector
                np.testing.assert_array_equal(into[index, : vector.size], vector)

    def test_an_explosion_in_one_of_them_is_an_error(
        self,
        twice: tuple[list[Backend], list[Backend]],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """A state that is not finite is never returned from a batch."""
        monkeypatch.chdir(tmp_path)  # engines may write a log
        _, many = twice
        batch = type(many[0]).batch(many, 2)
        state = many[1].state()
        state.linear_velocities[0] = np.inf
        with pytest.raises(EngineFailure):
            _explode(batch, many, state)


def _explode(batch: EngineBatch, many: list[Backend], state: PhysicalState) -> None:
    many[1].apply(Difference(state=state))
    batch.step(np.arange(COUNT), next(_commands(1)), SUBSTEPS, _table(many))


def _other(scene: Scene, number: int) -> Scene:
    """Change one parameter of a scene; of the first one none."""
    keys = [("near", "mass"), ("floor", "friction"), ("world", "gravity")][:number][-1:]
    changed = {key: other_value(key, scene.parameters[key]) for key in keys}
    return scene.with_(parameters={**scene.parameters, **changed})


def _commands(steps: int) -> Iterator[Floats]:
    """Give random commands near the rest pose, shape (n, 9) each."""
    generator = np.random.default_rng(5)
    for _ in range(steps):
        yield np.array(REST) + generator.uniform(-0.2, 0.2, (COUNT, 9))


def _table(backends: list[Backend], extra: int = 0) -> Floats:
    width = max(backend.structure.layout.size for backend in backends) + extra * BLOCK_SIZE
    return np.full((len(backends), width), np.nan)


def _meddle(backend: Backend, step: int, start: EngineSnapshot) -> None:
    """Do something to one of them alone, each time something else."""
    match step % 4:
        case 0:
            backend.apply(Difference(parameters={("near", "mass"): np.array(0.05 + 0.01 * step)}))
        case 1:
            state = backend.state()
            state.positions[0, 2] += 0.01
            backend.apply(Difference(state=state))
        case 2:
            backend.step(np.array(REST), SUBSTEPS)
        case _:
            backend.restore(start)
