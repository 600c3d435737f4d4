"""How MuJoCo realizes the TriFinger."""
