"""Many environments at once."""

from scm_world.env.batched.buffers import Buffers, Form
from scm_world.env.batched.executor import EnvExecutor
from scm_world.env.batched.loop import LoopExecutor
from scm_world.env.batched.vector_env import ScmWorldVectorEnv, VectorSnapshot

__all__ = ["Buffers", "EnvExecutor", "Form", "LoopExecutor", "ScmWorldVectorEnv", "VectorSnapshot"]
