"""Causal queries: interventions, counterfactuals, effects, and verification of the graph."""

from scm_world.policies.scripted import Random
from scm_world.queries.abduction import Counterfactuals
from scm_world.queries.comparison import Comparison
from scm_world.queries.differences import (
    Consequences,
    EpisodeDifference,
    but_for,
    compare,
    consequences,
)
from scm_world.queries.episode_files import load_episode, save_episode
from scm_world.queries.episodes import Episode
from scm_world.queries.identification import (
    Identification,
    NoEffect,
    estimate,
    identify,
    nature_graph,
)
from scm_world.queries.laboratory import Laboratory
from scm_world.queries.plans import Plan, do
from scm_world.queries.questions import SCM
from scm_world.queries.samples import Effect, Outcome, Samples, Setting
from scm_world.queries.verification import Verification, verify
from scm_world.queries.world import World

__all__ = [
    "SCM",
    "Comparison",
    "Consequences",
    "Counterfactuals",
    "Effect",
    "Episode",
    "EpisodeDifference",
    "Identification",
    "Laboratory",
    "NoEffect",
    "Outcome",
    "Plan",
    "Random",
    "Samples",
    "Setting",
    "Verification",
    "World",
    "but_for",
    "compare",
    "consequences",
    "do",
    "estimate",
    "identify",
    "load_episode",
    "nature_graph",
    "save_episode",
    "verify",
]
