"""Evaluation: protocols, episodes, scores with intervals, explanations.

An evaluation is one call::

    found = evaluate({"mine": policy, "random": "random"}, task="pushing", n=200)
    print(found.score("P6", agent="mine"))
    print(found.causes("P6", agent="mine"))
    found.save("results")
"""

from scm_world.evaluation.adaptive import Adaptive
from scm_world.evaluation.episodes import METRICS, Hook, in_world, play
from scm_world.evaluation.explanation import Explanation, Otherwise, why
from scm_world.evaluation.inference import inferred
from scm_world.evaluation.pipeline import evaluate
from scm_world.evaluation.protocols import Protocol, protocols_of
from scm_world.evaluation.recording import Recorder, Recording, record
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Causes, Interval
from scm_world.evaluation.verdicts import CauseProbe, Change, Inferred

__all__ = [
    "METRICS",
    "Adaptive",
    "CauseProbe",
    "Causes",
    "Change",
    "Evaluation",
    "Explanation",
    "Hook",
    "Inferred",
    "Interval",
    "Otherwise",
    "Protocol",
    "Recorder",
    "Recording",
    "evaluate",
    "in_world",
    "inferred",
    "play",
    "protocols_of",
    "record",
    "why",
]
