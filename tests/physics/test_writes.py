"""A write changes one parameter, and no control step changes any: laws of our adapters."""

import numpy as np
import pytest

from scm_world.queries import World

SYSTEMS = ["pushing", "towers"]


def world_of(system: str, backend: str) -> World:
    """Return a world at the beginning of an episode."""
    if backend == "bullet":
        pytest.importorskip("pybullet")
    world = World(system, backend=backend)
    world.reset(seed=0)
    return world


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_a_write_changes_one_parameter(backend: str) -> None:
    """The backend reports the others as they were, and all of them when it is put back."""
    world = world_of("pushing", backend)
    keys = {key: name for name, key in world.compiled.parameter_keys.items()}
    before = world.backend.parameters(keys)
    for name in ("floor_friction", "gravity", "joint_damping", "tool_block.mass", "restitution"):
        present = world[name]
        audit = world.do({name: 0.9 * present + 0.01})
        others = {key: n for key, n in keys.items() if n != name and n not in audit.followed}
        found = world.backend.parameters(others)
        assert all(np.array_equal(found[key], before[key]) for key in others), name
        world.do({name: present})
    found = world.backend.parameters(keys)
    assert all(np.array_equal(found[key], before[key]) for key in keys)


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
@pytest.mark.parametrize("system", SYSTEMS)
def test_parameters_stay_while_the_world_steps(system: str, backend: str) -> None:
    """After five control steps the backend reports every parameter as it was."""
    world = world_of(system, backend)
    keys = tuple(world.compiled.parameter_keys.values())
    before = world.backend.parameters(keys)
    for _ in range(5):
        world.step(world.action_low)
    after = world.backend.parameters(keys)
    assert all(np.array_equal(after[key], before[key]) for key in keys)
