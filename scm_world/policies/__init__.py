"""Policies: networks in files, and the zoo of trained policies."""

from scm_world.policies.cards import PolicyAbout
from scm_world.policies.networks import (
    Layer,
    MlpPolicy,
    load_policy,
    load_sb2,
    save_policy,
)
from scm_world.policies.zoo import file_of

__all__ = [
    "Layer",
    "MlpPolicy",
    "PolicyAbout",
    "file_of",
    "load_policy",
    "load_sb2",
    "save_policy",
]
