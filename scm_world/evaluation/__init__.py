"""Measuring policies: where an agent generalises, and how sure that is."""
