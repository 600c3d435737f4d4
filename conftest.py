"""Tests run with one thread each; modules whose extra is not installed are not collected."""

import os
import sys
from importlib.util import find_spec

# Before numpy is imported: threads of its BLAS in several workers mostly wait for one another.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# Tests start a hundred processes that import the package: only the first compiles it. And pytest
# takes ten seconds to rewrite the assertions of all tests, if it may not keep what it wrote.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

NEEDS = {
    "stable_baselines3": ["scm_world/training/algorithms.py", "scm_world/training/sb3.py"],
    "rsl_rl": ["scm_world/training/many.py"],
    "starlette": ["scm_world/studio/server.py"],
    "mujoco_warp": ["scm_world/backends/warp"],
}

collect_ignore = [path for name, paths in NEEDS.items() if not find_spec(name) for path in paths]
