"""What one can look up in an environment, or look at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scm_world.env.observer import Observer
from scm_world.scene.camera import OVERVIEW, Camera
from scm_world.world import World


class Looks:
    """Layouts, modes and measured pictures of an environment.

    Attributes:
        world: That is observed.
    """

    world: World
    _observer: Observer
    _modes: tuple[str, str]

    @property
    def observation_mode(self) -> str:
        """What is observed; chosen when the environment is made."""
        return self._modes[0]

    @property
    def action_mode(self) -> str:
        """What an action means; chosen when the environment is made."""
        return self._modes[1]

    @property
    def layout(self) -> dict[str, slice]:
        """Where each variable stands in the vector that is observed; empty for pictures."""
        return dict(self._observer.layouts.get("observation", {}))

    @property
    def context_layout(self) -> dict[str, slice]:
        """Where each variable stands in the privileged context; empty without one."""
        return dict(self._observer.layouts.get("context", {}))

    def depth(self, camera: Camera = OVERVIEW) -> NDArray[np.float32]:
        """Measure how far away everything is, shape (h, w) [m]."""
        from scm_world.backends.renderer import depth_and_segmentation

        found: NDArray[np.float32] = depth_and_segmentation(self.world.scene(), (camera,))[0][0]
        return found

    def segmentation(self, camera: Camera = OVERVIEW) -> tuple[NDArray[np.int32], tuple[str, ...]]:
        """Tell which body every pixel shows.

        Returns:
            Shape (h, w): an index into the names of the bodies, -1 where there is nothing; and
            these names.
        """
        from scm_world.backends.renderer import body_names, depth_and_segmentation

        scene = self.world.scene()
        return depth_and_segmentation(scene, (camera,))[1][0], body_names(scene.structure)
