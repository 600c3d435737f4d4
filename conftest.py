"""Modules whose examples need an extra that is not installed are not collected."""

from importlib.util import find_spec

NEEDS = {
    "stable_baselines3": ["scm_world/training/agents.py", "scm_world/training/sb3.py"],
    "starlette": ["scm_world/studio/server.py"],
}

collect_ignore = [path for name, paths in NEEDS.items() if not find_spec(name) for path in paths]
