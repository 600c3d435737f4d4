"""The learners that have a name: ours, and those of other libraries."""

from __future__ import annotations

from functools import partial

from scm_world.discovery.learners import libraries, trivial
from scm_world.discovery.learners.do_gp import do_gp
from scm_world.discovery.learners.do_order import do_order
from scm_world.discovery.learners.paired import paired
from scm_world.discovery.learners.registry import Learner, register

OURS = (
    Learner(
        "paired", paired, ("paired",),
        doc="oracle with the simulator: one variable at a time, same noise, exact",
    ),
    Learner(
        "do_order", do_order, ("interventional",), doc="order by invariance, edges by regression"
    ),
    Learner(
        "do_gp", do_gp, ("observational", "interventional"),
        doc="curves: best score of Gaussian processes, one for all regimes",
    ),
    Learner(
        "do_order_ranks", partial(do_order, features=2, ranks=True, spread=True),
        ("interventional",), doc="do_order for curves, outliers, and causes of spread",
    ),
)  # fmt: skip
_causal_learn = partial(Learner, takes=("observational",), extra="learn", package="causal-learn")
_tigramite = partial(
    Learner, takes=("observational",), temporal=True, extra="learn", package="tigramite"
)
OTHERS = (
    _causal_learn("pc", libraries.pc, doc="tests of partial correlation"),
    _causal_learn("ges", libraries.ges, doc="greedy search over equivalence classes by BIC"),
    _causal_learn("boss", libraries.boss, doc="best order by BIC, moving one column at a time"),
    _causal_learn("grasp", libraries.grasp, doc="sparsest order by BIC, by tucks"),
    _causal_learn(
        "fci", libraries.fci, marked=True, doc="tests of partial correlation; causes may be hidden"
    ),
    Learner(
        "gies", libraries.gies, ("observational", "interventional"), extra="learn",
        package="gies", doc="greedy search over interventional equivalence classes by BIC",
    ),
    Learner(
        "gies_shared", partial(libraries.gies, intercept="shared"),
        ("observational", "interventional"), extra="learn", package="gies",
        doc="gies with one intercept in all regimes: means count",
    ),
    Learner(
        "permscore", libraries.permscore, ("interventional",), extra="learn",
        package="permscore", doc="best order by BIC, and unknown targets",
    ),
    _tigramite(
        "pcmci+", libraries.pcmci_plus,
        doc="tests of partial correlation over time, with edges within the instant",
    ),
    _tigramite(
        "j-pcmci+", libraries.jpcmci_plus,
        doc="pcmci+ for episodes whose circumstances differ and may be hidden",
    ),
    _tigramite(
        "lpcmci", libraries.lpcmci, marked=True,
        doc="tests of partial correlation over time; causes may be hidden",
    ),
)  # fmt: skip
"""Existing baselines behind our call. Without its library a learner names the extra to install."""

_baseline = partial(Learner, baseline=True)
BASELINES = (
    _baseline("empty", trivial.empty, doc="baseline: no edge"),
    _baseline("complete", trivial.complete, marked=True, doc="baseline: all pairs o-o"),
    _baseline("bipartite", trivial.bipartite, doc="baseline: every cause on every outcome"),
    _baseline("roles", trivial.roles, doc="baseline: the same, but colors on nothing"),
    _baseline(
        "all_or_nothing", trivial.all_or_nothing,
        doc="baseline: a cause acts on all outcomes if it is correlated with one",
    ),
    _baseline("correlation", trivial.correlation, doc="baseline: correlated pairs"),
    _baseline("sort_regress", trivial.sort_regress, doc="baseline: in the order of variance"),
)  # fmt: skip
"""Trivial ones, to stand beside every score."""

for _learner in (*OURS, *OTHERS, *BASELINES):
    register(_learner)
