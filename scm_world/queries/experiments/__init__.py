"""Paired experiments: one variable changed, and everything else kept."""
