"""Policies: what others have trained, ready to be run here."""

from scm_world.evaluation.policies.mlp import MlpPolicy
from scm_world.evaluation.policies.sb2 import load_sb2

__all__ = ["MlpPolicy", "load_sb2"]
