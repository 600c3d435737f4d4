"""Compiled code where no folder can keep it."""

from __future__ import annotations

import pytest

from scm_world.geometry.numbers import UNCACHED, njit

SOURCE = "def twice(x):\n    return 2.0 * x\n"


@pytest.mark.parametrize("signature", [(), ("f8(f8)",)])
def test_a_function_is_compiled_without_a_cache(signature: tuple[str, ...]) -> None:
    """Numba caches no function whose file is not there; it computes the same, and is named."""
    there: dict[str, object] = {}
    exec(compile(SOURCE, "/nowhere/at/all.py", "exec"), there)  # noqa: S102
    twice = njit(*signature, cache=True)(there["twice"])  # type: ignore[type-var]
    assert twice(3.0) == 6.0
    assert "twice" in UNCACHED
    UNCACHED.discard("twice")
