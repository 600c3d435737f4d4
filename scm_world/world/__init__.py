"""The world: a causal model and an engine, one thing to reset, step and intervene on."""

from scm_world.world.audit import Applied, Audit
from scm_world.world.batch import Batch
from scm_world.world.snapshot import WorldSnapshot
from scm_world.world.world import World

__all__ = ["Applied", "Audit", "Batch", "World", "WorldSnapshot"]
