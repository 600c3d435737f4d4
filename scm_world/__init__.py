"""A block-building robot, written down as a structural causal model."""
