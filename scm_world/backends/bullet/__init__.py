"""The Bullet engine. It is imported when the first backend is made, and only then."""

from scm_world.backends.bullet.backend import BulletBackend
from scm_world.backends.bullet.model.support import (
    deviations,
    parameters_without,
    supports,
    unsupported,
)

__all__ = ["BulletBackend", "deviations", "parameters_without", "supports", "unsupported"]
