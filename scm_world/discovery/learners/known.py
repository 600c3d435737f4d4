"""The learners that have a name: ours, and those of other libraries."""

from __future__ import annotations

from functools import partial

from scm_world.discovery.learners import libraries, trivial
from scm_world.discovery.learners.do_gp import do_gp
from scm_world.discovery.learners.do_order import do_order
from scm_world.discovery.learners.paired import paired
from scm_world.discovery.learners.registry import Learner, register

OURS = (
    Learner("paired", paired, ("paired",)),
    Learner("do_order", do_order, ("interventional",)),
    Learner("do_gp", do_gp),
)
_other = partial(Learner, extra="learn")
_causal_learn = partial(_other, takes=("observational",), package="causal-learn")
_tigramite = partial(_other, takes=("observational",), temporal=True, package="tigramite")
OTHERS = (
    _causal_learn("pc", libraries.pc),
    _causal_learn("ges", libraries.ges),
    _causal_learn("boss", libraries.boss),
    _causal_learn("grasp", libraries.grasp),
    _causal_learn("fci", libraries.fci, marked=True),
    _other("gies", libraries.gies, package="gies"),
    _other(
        "gies_shared",
        partial(libraries.gies, intercept="shared"),
        package="gies",
        doc="gies with one intercept in all regimes: means count",
    ),
    _other("permscore", libraries.permscore, ("interventional",), package="permscore"),
    _tigramite("pcmci+", libraries.pcmci_plus),
    _tigramite("j-pcmci+", libraries.jpcmci_plus),
    _tigramite("lpcmci", libraries.lpcmci, marked=True),
)
"""Existing baselines behind our call. Without its library a learner names the extra to install."""

_baseline = partial(Learner, baseline=True)
BASELINES = (
    _baseline("empty", trivial.empty),
    _baseline("complete", trivial.complete, marked=True),
    _baseline("bipartite", trivial.bipartite),
    _baseline("roles", trivial.roles),
    _baseline("all_or_nothing", trivial.all_or_nothing),
    _baseline("correlation", trivial.correlation),
    _baseline("sort_regress", trivial.sort_regress),
)
"""Trivial ones, to stand beside every score."""

for _learner in (*OURS, *OTHERS, *BASELINES):
    register(_learner)
