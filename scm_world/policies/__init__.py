"""Agents: policies of every form, networks in files, and the zoo of trained policies."""

from scm_world.policies.agents import Agent, WorldPolicy, agent_from, as_agent
from scm_world.policies.cards import PolicyAbout
from scm_world.policies.networks import Layer, MlpPolicy, load_policy, load_sb2, save_policy
from scm_world.policies.zoo import file_of

__all__ = [
    "Agent",
    "Layer",
    "MlpPolicy",
    "PolicyAbout",
    "WorldPolicy",
    "agent_from",
    "as_agent",
    "file_of",
    "load_policy",
    "load_sb2",
    "save_policy",
]
