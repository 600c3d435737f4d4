"""What holds for models that nobody here wrote: the rows of ``benchmarks.models.proof``."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))
from benchmarks.models.proof import MODELS, ON_BULLET, file_of, prove  # from there

FAST = "gymnasium/envs/mujoco/assets/inverted_pendulum.xml"
CASES = (*((name, "mujoco") for name in MODELS), *((name, "bullet") for name in ON_BULLET))


@pytest.mark.filterwarnings("ignore")  # of the packages whose models these are
@pytest.mark.parametrize(
    ("name", "backend"),
    [pytest.param(*case, marks=() if case[0] == FAST else pytest.mark.slow) for case in CASES],
)
def test_all_promises_hold_for_models_of_others(name: str, backend: str) -> None:
    """Undoing leaves 0.0, a refusal no trace, nothing shows without an edge, copies are exact."""
    path = file_of(name)
    if path is None or not path.exists():
        pytest.skip(f"{name.partition('/')[0]} with this model is not installed")
    found = prove(path, backend)
    assert found["undone"] > 0
    assert found["fired"] > 0
    assert (found["left"], found["floor"], found["undeclared"]) == ("0", "0", 0)
