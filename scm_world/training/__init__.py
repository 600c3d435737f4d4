"""Policies: what others have trained, ready to be run here."""

from scm_world.policies import MlpPolicy, load_sb2

__all__ = ["MlpPolicy", "load_sb2"]
