"""Measurements that need a process of their own: it prints one line of JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


def asked(module: str, *arguments: object, python: str = sys.executable) -> Any:
    """Run a module of this folder in a fresh process, and read what it prints last."""
    command = [python, "-m", f"benchmarks.speed.{module}", *map(str, arguments)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, cwd=ROOT)  # noqa: S603 # our own module
    return json.loads(done.stdout.splitlines()[-1])


def answer(found: Any) -> None:
    """Print what was found, for ``asked``."""
    print(json.dumps(found))
