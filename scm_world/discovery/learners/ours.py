"""Our own learners, by name."""

from __future__ import annotations

from functools import partial

from scm_world.discovery.learners.bodies import learn_local
from scm_world.discovery.learners.moving import paired, sparse_pooled, verified
from scm_world.discovery.learners.nulls import learn_null
from scm_world.discovery.learners.order import do_order
from scm_world.discovery.learners.registry import Learner, register

PAIRED = register(
    Learner("paired", paired, ("paired",), doc="one variable at a time, same noise: exact")
)
POOLED = register(
    Learner(
        "pooled",
        sparse_pooled,
        ("paired",),
        "models",
        doc="all numbers at once: few causes each",
    )
)
COLORING = register(
    Learner(
        "coloring",
        verified,
        ("paired",),
        "models",
        claims=True,
        doc="checks a graph, color by color",
    )
)
DO_ORDER = register(
    Learner(
        "do_order", do_order, ("interventional",), doc="order by invariance, edges by regression"
    )
)
DO_ORDER_RANKS = register(
    Learner(
        "do_order_ranks",
        partial(do_order, features=2, ranks=True, spread=True),
        ("interventional",),
        doc="do_order for curves, outliers, and causes of spread",
    )
)
LOCAL = register(
    Learner(
        "local",
        learn_local,
        ("paired",),
        "worlds",
        doc="bodies: who acted on whom, and when",
    )
)
NULL = register(
    Learner(
        "null",
        learn_null,
        ("paired",),
        "worlds",
        doc="bodies: one is taken away at a time",
    )
)
