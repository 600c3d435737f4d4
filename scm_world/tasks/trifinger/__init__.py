"""The TriFinger: its hardware, arena, blocks and goals, and nine goal families."""
