"""The Bullet engine. It is imported when the first backend is made, and only then."""

from scm_world.backends.bullet.backend import BulletBackend

__all__ = ["BulletBackend"]
