"""How Bullet realizes a ``Model``."""
