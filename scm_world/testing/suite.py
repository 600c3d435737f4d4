"""How the parts of the conformance suite get their backends."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import ClassVar

import pytest

from scm_world._types import Floats
from scm_world.backends.base import Backend, EngineSnapshot
from scm_world.models.scene import Difference, ParameterKey, Parameters, Scene
from scm_world.tasks.trifinger.presets import FAST, Preset
from scm_world.testing.scenes import LONG, busy_scene, other_value, play


class Suite(ABC):
    """What the parts of the conformance suite share.

    Attributes:
        preset: Numerical settings under which the suite runs.
        long: Horizon of the longest comparison, in control steps.
    """

    preset: ClassVar[Preset] = FAST
    long: ClassVar[int] = LONG

    @abstractmethod
    def make(self) -> Backend:
        """Create a backend without a scene."""

    @pytest.fixture
    def scene(self) -> Scene:
        """Describe the busy scene."""
        return busy_scene(self.preset)

    @pytest.fixture
    def backend(self, scene: Scene) -> Iterator[Backend]:
        """Provide a backend in the middle of an episode."""
        with self.built(scene) as backend:
            play(backend, 2, seed=1)
            yield backend

    @contextmanager
    def built(self, scene: Scene) -> Iterator[Backend]:
        """Provide a new backend with a scene, and close it."""
        backend = self.make()
        backend.build(scene)
        try:
            yield backend
        finally:
            backend.close()

    def continued(self, backend: Backend, start: EngineSnapshot, steps: int = 10) -> Floats:
        """Go on from a snapshot."""
        backend.restore(start)
        return play(backend, steps)

    def change_and_undo(
        self, backend: Backend, keys: Iterable[ParameterKey], parameters: Parameters
    ) -> None:
        """Set parameters to something else and back."""
        for key in keys:
            backend.apply(Difference(parameters={key: other_value(key, parameters[key])}))
            backend.apply(Difference(parameters={key: parameters[key]}))
