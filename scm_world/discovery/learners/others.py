"""Learners of other libraries, by name.

They are existing baselines behind our call. Each is imported when it is first used, and the call
names the extra to install if it is not there.
"""

from __future__ import annotations

from scm_world.discovery.learners.adapters.causal_learn import boss, ges, grasp, pc
from scm_world.discovery.learners.adapters.gies import gies
from scm_world.discovery.learners.adapters.tigramite import pcmci_plus
from scm_world.discovery.learners.registry import Learner, register

CAUSAL_LEARN = "causal-learn"

OTHERS = (
    Learner(
        "pc",
        pc,
        takes=("observational",),
        extra=CAUSAL_LEARN,
        package=CAUSAL_LEARN,
        doc="tests of partial correlation",
    ),
    Learner(
        "ges",
        ges,
        takes=("observational",),
        extra=CAUSAL_LEARN,
        package=CAUSAL_LEARN,
        doc="greedy search over equivalence classes by BIC",
    ),
    Learner(
        "boss",
        boss,
        takes=("observational",),
        extra=CAUSAL_LEARN,
        package=CAUSAL_LEARN,
        doc="best order by BIC, moving one column at a time",
    ),
    Learner(
        "grasp",
        grasp,
        takes=("observational",),
        extra=CAUSAL_LEARN,
        package=CAUSAL_LEARN,
        doc="sparsest order by BIC, by tucks",
    ),
    Learner(
        "gies",
        gies,
        takes=("observational", "interventional"),
        extra="discovery",
        package="gies",
        doc="greedy search over interventional equivalence classes by BIC",
    ),
    Learner(
        "pcmci+",
        pcmci_plus,
        takes=("observational",),
        temporal=True,
        extra="tigramite",
        package="tigramite",
        doc="tests of partial correlation over time, with edges within the instant",
    ),
)
"""All of them, in the order in which they are listed."""

for _learner in OTHERS:
    register(_learner)
