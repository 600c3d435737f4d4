"""What a backend without an engine of its own has in common: a scene in memory."""

from __future__ import annotations

from abc import ABC
from collections.abc import Iterable
from typing import Any

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Backend, Contact, EngineSnapshot
from scm_world.errors import SnapshotMismatch, UnknownOption, WrongShape
from scm_world.models.scene import Difference, ParameterKey, Parameters, Scene, complete
from scm_world.models.state import State


class InMemory(Backend, ABC):
    """What keeps a scene in memory: parameters in a dict, the state in a vector.

    Only ``step`` and ``inertia`` are left to a class that derives from it.
    """

    @property
    def version(self) -> str:
        """Version of the backend."""
        return "1"

    @property
    def structure(self) -> Any:
        """The structure of the scene."""
        return self._structure

    def build(self, scene: Scene) -> None:
        """Remember the scene."""
        self._structure, self._state = scene.structure, scene.structure.empty_state()
        self._parameters: dict[ParameterKey, Floats] = {}
        self._keep(scene.parameters)
        self._place(scene.state)

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time.

        Raises:
            UnknownOption: There is no such parameter. Nothing has changed.
            WrongShape: A parameter has another shape. Nothing has changed.
        """
        structure = difference.structure
        if structure is not None:
            now = Scene(self._structure, self._parameters, self._state)
            difference = complete(now, structure, difference)
            self._structure, self._state = structure, structure.empty_state()
            structure.carried(self._state, now)  # what is reported stays
            self._parameters = {}
        else:
            self._check(difference.parameters)
            for key, value in difference.parameters.items():
                if np.shape(value) != self._parameters[key].shape:
                    name, shape = ".".join(key).strip("."), self._parameters[key].shape
                    raise WrongShape(name, value, shape, np.shape(value))
        self._keep(difference.parameters)
        if difference.state is not None:
            self._place(difference.state)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Give the parameters that were set.

        Raises:
            UnknownOption: There is no such parameter.
        """
        keys = tuple(keys)
        self._check(keys)
        return {key: self._parameters[key].copy() for key in keys}

    def read(self, into: State) -> None:
        """Write the present state into an existing vector."""
        into.vector[:] = self._state.vector

    def contacts(self) -> tuple[Contact, ...]:
        """Nothing ever touches anything."""
        return ()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        scene = Scene(self._structure, dict(self._parameters), self._state.copy())
        return EngineSnapshot(f"{self.name} {self.version}", scene)

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine.
        """
        here = f"{self.name} {self.version}"
        if snapshot.engine != here:
            raise SnapshotMismatch(f"a snapshot of {snapshot.engine} cannot be restored by {here}")
        scene: Scene = snapshot.payload
        self._structure, self._state = scene.structure, scene.state.copy()
        self._parameters = {}
        self._keep(scene.parameters)

    def _keep(self, parameters: Parameters) -> None:
        for key, value in parameters.items():
            self._parameters[key] = np.array(value, dtype=np.float64)

    def _place(self, state: State) -> None:
        """Put everything where a state says; what is only reported stays."""
        np.copyto(self._state.vector, state.vector, where=self._state.layout.can_be_set)

    def _check(self, keys: Iterable[ParameterKey]) -> None:
        for key in keys:
            if key not in self._parameters:
                known = (".".join(known).strip(".") for known in self._parameters)
                raise UnknownOption("parameter", ".".join(key).strip("."), known)
