"""Structural causal models over typed variables. Nothing here knows any physics."""

from scm_world.graph.files import from_json, to_json
from scm_world.graph.scm import SCM, flatten
from scm_world.graph.structure import Edge
from scm_world.graph.views import episode_outcome, to_dag, to_digraph, unrolled
from scm_world.variables import NoiseKey

__all__ = [
    "SCM",
    "Edge",
    "NoiseKey",
    "episode_outcome",
    "flatten",
    "from_json",
    "to_dag",
    "to_digraph",
    "to_json",
    "unrolled",
]
