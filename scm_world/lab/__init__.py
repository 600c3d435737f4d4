"""Laboratories for agents: certified causal questions, tools, and scores without a judge."""

from scm_world.lab.agents import AGENTS, certify, play
from scm_world.lab.environment import LabEnv
from scm_world.lab.laboratory import Laboratory, replay, scores, tools
from scm_world.lab.questions import KINDS, LEVELS, Question, offers, question
from scm_world.lab.suites import SUITES, Made, Suite, suite
from scm_world.lab.worlds import LAWS, WORLDS, Knobs

__all__ = [
    "AGENTS",
    "KINDS",
    "LAWS",
    "LEVELS",
    "SUITES",
    "WORLDS",
    "Knobs",
    "LabEnv",
    "Laboratory",
    "Made",
    "Question",
    "Suite",
    "certify",
    "offers",
    "play",
    "question",
    "replay",
    "scores",
    "suite",
    "tools",
]
