"""Modules whose examples need an extra that is not installed are not collected."""

from importlib.util import find_spec

collect_ignore = (
    []
    if find_spec("stable_baselines3")
    else ["scm_world/training/agents.py", "scm_world/training/sb3.py"]
)
