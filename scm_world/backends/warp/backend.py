"""mujoco-warp as a backend."""

from __future__ import annotations

from typing import Any, ClassVar, final

import mujoco_warp as mjw
import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Capabilities, OneScene, Scenes
from scm_world.backends.warp.device import resolve
from scm_world.backends.warp.scenes import WarpScenes, prepared
from scm_world.models.model import Model
from scm_world.models.scene import Parameters, Structure

EPSILON = float(np.finfo(np.float32).eps)
LOST = 10.0  # last places of a number that a control step may lose


@final
class WarpBackend(OneScene):
    """mujoco-warp on a GPU or on Warp's CPU device.

    Args:
        device: ``"cpu"``, ``"cuda"``, one of several as ``"cuda:1"``; a GPU if Warp sees one and
            else the CPU, if it is empty.

    Attributes:
        device: Name of the device.
        name: Name of the engine with its device.

    Raises:
        UnknownOption: Warp does not see such a device.
    """

    name: str = "warp"  # type: ignore[misc] # each device has its own
    batch: ClassVar[type[Scenes]] = WarpScenes
    version = mjw.__version__

    def __init__(self, device: str = "") -> None:
        self.device = resolve(device)
        self.name = f"warp:{self.device}"
        self.scenes, self.which = WarpScenes(1, 1, self.device), np.array([0])
        self._is_built = False

    @property
    def capabilities(self) -> Capabilities:  # type: ignore[override] # nothing sets it
        """Nothing but exact runs on the CPU; on a GPU, runs as far apart as was measured.

        Before there is a scene, that is the precision of a number.
        """
        scenes = None if self.device == "cpu" else 16_384
        return Capabilities(
            floor=self._floor(), rounding=_rounding, scenes=scenes, remarks=_remarks
        )

    def _floor(self) -> float:
        if self.device == "cpu":
            return 0.0
        scenes: Any = self.scenes
        return scenes.floor(self.which[0]) if self._is_built else EPSILON


def _rounding(backend: WarpBackend, structure: Structure, substeps: int) -> Floats:
    model = Model.of(structure, "mujoco-warp")
    base, _ = prepared(model, backend.device)
    return np.maximum(base.coupling(model, substeps), LOST * EPSILON)


def _remarks(backend: WarpBackend, before: Parameters) -> tuple[str, ...]:
    scenes: Any = backend.scenes
    found: tuple[str, ...] = scenes.remarks(backend.which[0], before)
    return found
