"""Structural causal models over typed variables. Nothing here knows any physics."""

from scm_world.graph.evaluate import Moment
from scm_world.graph.files import (
    from_dict,
    from_json,
    from_networkx,
    to_dict,
    to_dot,
    to_json,
    to_networkx,
)
from scm_world.graph.scm import SCM, flatten
from scm_world.graph.structure import Edge, Structure
from scm_world.graph.views import (
    contemporaneous,
    d_separated,
    episode_outcome,
    summary,
    two_slice,
    unrolled,
)

__all__ = [
    "SCM",
    "Edge",
    "Moment",
    "Structure",
    "contemporaneous",
    "d_separated",
    "episode_outcome",
    "flatten",
    "from_dict",
    "from_json",
    "from_networkx",
    "summary",
    "to_dict",
    "to_dot",
    "to_json",
    "to_networkx",
    "two_slice",
    "unrolled",
]
