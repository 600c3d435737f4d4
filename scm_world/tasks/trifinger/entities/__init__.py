"""What the variables of the TriFinger tasks are: robot, stage, blocks, obstacles, goals."""
