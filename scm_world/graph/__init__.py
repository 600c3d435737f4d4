"""Structural causal models over typed variables. Nothing here knows any physics."""

from scm_world.graph.evaluate import NoiseKey
from scm_world.graph.files import from_dict, from_json, to_dict, to_json
from scm_world.graph.scm import SCM, flatten
from scm_world.graph.structure import Edge, EdgeIndex
from scm_world.graph.views import episode_outcome, to_dag, unrolled

__all__ = [
    "SCM",
    "Edge",
    "EdgeIndex",
    "NoiseKey",
    "episode_outcome",
    "flatten",
    "from_dict",
    "from_json",
    "to_dag",
    "to_dict",
    "to_json",
    "unrolled",
]
