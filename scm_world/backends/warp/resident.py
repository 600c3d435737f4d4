"""States of many worlds that stay on a device from step to step, as tensors of torch."""

from __future__ import annotations

from collections import Counter
from typing import Any, final

import numpy as np
import torch
import warp as wp

from scm_world._types import Integers
from scm_world.backends.mujoco.states import MOST, rotate
from scm_world.backends.warp.device import FATAL, GROWS
from scm_world.backends.warp.scenes import Group
from scm_world.errors import EngineFailure
from scm_world.geometry.tracing import Expressions, Trace
from scm_world.models.model import REPORTED


@final
class Resident:
    """Scenes of one structure whose states stay on the device; the host has old ones meanwhile.

    Args:
        group: All scenes of the structure.
        slots: Their numbers there, which follow one another.
        places: Where each number of MuJoCo's motion is in a state.
        turned: Places of quaternion and angular velocity of bodies in a state, shape (n, 7), which
            the motion has in the frame of the body.
        copies: Counts bytes that are copied.

    Attributes:
        device: The device, as torch calls it.
    """

    def __init__(
        self,
        group: Group,
        slots: Integers,
        places: Integers,
        turned: Integers,
        copies: Counter[str],
    ) -> None:
        self._group, self._slots = group, slots
        self._at = slice(int(slots[0]), int(slots[-1]) + 1)
        self._copies = copies
        self._tensors: dict[str, torch.Tensor] = {}
        self._data: Any = None
        self._bind()
        self.device = str(self._tensors["time"].device)
        forces = group.structure.places(REPORTED)
        self._places, self._forces = (self._indices(one) for one in (places, forces))
        trace, now = Trace(), dict[int, Any]()
        for numbers in turned.tolist():
            given = [np.array([*map(trace.column, part)]) for part in (numbers[:4], numbers[4:])]
            trace.call(rotate, [*given, 1.0])
            sign = trace.add("where", given[0][3] < 0.0, -1.0, 1.0)
            now |= zip(numbers, [*given[0] * sign, *given[1]], strict=True)
        self._turn = Expressions(trace, now, torch)
        self.write(slots)

    def _indices(self, numbers: Any) -> torch.Tensor:
        return torch.as_tensor(np.asarray(numbers), dtype=torch.int64, device=self.device)

    def _bind(self) -> None:
        """Find the arrays of the engine."""
        engine = self._group.synced()
        self._data = engine.data
        arrays = {name: one.array for name, one in engine.state.items()}
        self._tensors = {n: wp.to_torch(a).view(len(a), -1) for n, a in arrays.items()}

    def write(self, slots: Integers) -> None:
        """Copy the states of some scenes from the host to the device."""
        where = self._indices(slots)
        for name, values in self._group.numbers(slots).items():
            self._tensors[name][where] = torch.as_tensor(values, device=self.device)
            self._copies["episodes to the device"] += values.nbytes

    def collect(self, slots: Integers) -> None:
        """Copy the states of some scenes from the device to the host."""
        where = self._indices(slots)
        names = self._group.numbers(slots[:0])
        found = {name: self._tensors[name][where].cpu().numpy() for name in names}
        self._group.adopt_step(slots, found)
        self._copies["episodes to the host"] += sum(values.nbytes for values in found.values())

    def _motion(self) -> torch.Tensor:
        parts = [self._tensors[n] for n in ("qpos", "qvel", "act") if n in self._tensors]
        return torch.cat([part[self._at] for part in parts], dim=1)

    def read(self) -> torch.Tensor:
        """Return the states of all scenes, shape (size, n), 64-bit."""
        motion, size = self._motion(), self._group.structure.layout.size
        found = torch.empty((size, len(motion)), dtype=torch.float64, device=self.device)
        found[self._places] = motion.T.double()
        if len(self._forces[0]):
            own = self._tensors["qfrc_actuator"][self._at].T.double()
            found[self._forces[1]] = own[self._forces[0]]
        self._turn(found)
        return found

    def step(self, commands: torch.Tensor, substeps: int) -> dict[int, str]:
        """Hold commands, shape (n_commands, n), for some physics steps.

        Where something goes wrong, the step is taken again from the host, where memory grows and
        lost states are found.

        Returns:
            Why scenes are lost, by number.

        Raises:
            EngineFailure: Scenes were added meanwhile, and the states are gone.
        """
        engine, tensors = self._group.synced(), self._tensors
        if engine.data is not self._data:
            raise EngineFailure("scenes were added while states stayed on the device", "warp")
        before = {name: tensors[name].clone() for name in self._group.numbers(self._slots[:0])}
        tensors["overflow"].zero_()
        if "ctrl" in tensors:
            tensors["ctrl"].zero_()
            tensors["ctrl"][self._at, : len(commands)] = commands.T.float()
        self._wait()
        engine.launch(substeps)
        self._wait()
        full = (tensors["overflow"][self._at] & (GROWS | FATAL)).any()
        sound = (self._motion().abs() <= MOST).all() & ~full
        self._copies["flags to the host"] += sound.nbytes
        if sound.item():
            return {}
        every = {name: one[self._at].cpu().numpy() for name, one in before.items()}
        given = commands.T.cpu().numpy()
        sizes = [one.nbytes for one in (*every.values(), given)]
        self._copies["steps taken again to the host"] += sum(sizes)
        self._group.adopt_step(self._slots, every)
        _, reasons = self._group.step(self._slots, given, substeps)
        self._group.adopt_step(self._slots, self._group.numbers(self._slots))
        self._bind()
        self.write(self._slots)
        return reasons

    def _wait(self) -> None:
        """Wait for Warp and torch, which have separate queues on a GPU."""
        if self.device != "cpu":
            torch.cuda.synchronize(self.device)
