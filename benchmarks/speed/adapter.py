"""What the adapter to Stable-Baselines3 adds to a step of a world."""

from __future__ import annotations

import importlib.util
import sys
from typing import Any

from benchmarks.speed.subprocesses import asked
from benchmarks.speed.timing import Settings

LIBRARY = "stable_baselines3"


def adapting(settings: Settings) -> dict[str, Any]:
    """Measure with the interpreter that has the library; nothing if none has it."""
    python = settings.sb3
    if python is None and importlib.util.find_spec(LIBRARY) is not None:
        python = sys.executable
    if python is None:
        print("the adapter is left out: --sb3 PYTHON names an interpreter with the library")
        return {}
    found: dict[str, Any] = asked("adapter_turns", int(settings.quick), python=python)
    return found
