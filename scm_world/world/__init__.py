"""A causal model with a physics backend: reset, step, intervene, restore."""

from scm_world.world.audit import Applied, Audit, Audits
from scm_world.world.batch import Batch
from scm_world.world.equation_rows import EquationBatch
from scm_world.world.equations import CompiledModel, Equations
from scm_world.world.simulation import Simulation
from scm_world.world.snapshot import Snapshot
from scm_world.world.system import CausalSystem

__all__ = [
    "Applied",
    "Audit",
    "Audits",
    "Batch",
    "CausalSystem",
    "CompiledModel",
    "EquationBatch",
    "Equations",
    "Simulation",
    "Snapshot",
]
