"""Structural causal models over typed variables. Nothing here knows any physics."""

from scm_world.graph.evaluate import NoiseKey
from scm_world.graph.files import from_dict, from_json, to_dict, to_json
from scm_world.graph.scm import SCM, flatten
from scm_world.graph.structure import Edge, EdgeIndex
from scm_world.graph.views import d_separated, episode_outcome, unrolled

__all__ = [
    "SCM",
    "Edge",
    "EdgeIndex",
    "NoiseKey",
    "d_separated",
    "episode_outcome",
    "flatten",
    "from_dict",
    "from_json",
    "to_dict",
    "to_json",
    "unrolled",
]
