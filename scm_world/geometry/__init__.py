"""Rotations, coordinates, and the volumes that solids share: numbers only."""
