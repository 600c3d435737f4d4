"""Each experiment of the laboratory runs on every engine and every preset."""

from collections.abc import Iterator

import pytest
from lab import ENGINES, Lab

from scm_world.backends import make_backend
from scm_world.tasks.trifinger.hardware import FAST, PRECISE


@pytest.fixture(
    params=[(name, preset) for name in ENGINES for preset in (FAST, PRECISE)],
    ids=lambda p: f"{p[0]}-{p[1].name}",
)
def lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    """Provide every engine with every preset."""
    name, preset = request.param
    backend = make_backend(name)
    yield Lab(backend, preset)
    backend.close()
