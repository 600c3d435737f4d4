"""The suite of backends finds faults that were planted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from faulty_backends import FAULTS

FILE = Path(__file__).parent / "faulty_backends.py"


class Watch:
    """Collects the classes of which a test fails."""

    def __init__(self) -> None:
        self.failed: set[str] = set()

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note a test that did not pass."""
        if report.failed:
            self.failed.add(report.nodeid.split("::")[-2])


def test_planted_faults_are_found() -> None:
    """Of each backend with a fault, the test of the promise that it breaks fails."""
    watch = Watch()
    chosen = [f"{FILE}::Test{fault.__name__}::{test}" for fault, test in FAULTS.items()]
    pytest.main(["-q", "-p", "no:cacheprovider", "--tb=no", *chosen], plugins=[watch])
    assert watch.failed == {f"Test{fault.__name__}" for fault in FAULTS}
