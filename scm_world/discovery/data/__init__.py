"""Data from interventions: tables with regimes, and how to collect them."""

from scm_world.discovery.data.dataset import Column, Dataset, Regime

__all__ = ["Column", "Dataset", "Regime"]
