"""Many environments at once."""

from scm_world.env.batched.crew import Crew
from scm_world.env.batched.loop import LoopCrew
from scm_world.env.batched.sheet import Form, Sheet
from scm_world.env.batched.vector_env import ScmWorldVectorEnv, VectorSnapshot

__all__ = ["Crew", "Form", "LoopCrew", "ScmWorldVectorEnv", "Sheet", "VectorSnapshot"]
