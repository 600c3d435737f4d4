"""How Bullet realizes the TriFinger."""
