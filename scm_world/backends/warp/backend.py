"""mujoco-warp as a backend."""

from __future__ import annotations

from typing import ClassVar, final

import mujoco_warp as mjw
import numpy as np

from scm_world.backends.base import Capabilities, OneScene, Scenes
from scm_world.backends.warp.device import resolve
from scm_world.backends.warp.scenes import WarpScenes


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
    capabilities: ClassVar[Capabilities] = Capabilities()

    def __init__(self, device: str = "") -> None:
        self.device = resolve(device)
        self.name = f"warp:{self.device}"
        self.scenes, self.which = WarpScenes(1, 1, self.device), np.array([0])
        self._is_built = False
