"""Vectorised environments."""

from scm_world.env.batched.buffers import Buffers, Form
from scm_world.env.batched.loop import LoopExecutor
from scm_world.env.batched.vector_env import ScmWorldVectorEnv, VectorSnapshot

__all__ = ["Buffers", "Form", "LoopExecutor", "ScmWorldVectorEnv", "VectorSnapshot"]
