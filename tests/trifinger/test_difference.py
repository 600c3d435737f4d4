"""Facts about what a change of structure leaves as it is."""

from __future__ import annotations

import numpy as np
from robot_scenes import box_hull, busy_scene, other_value

from scm_world.models import Difference, Scene
from scm_world.models.scene import complete
from scm_world.tasks.trifinger.hardware import PRECISE
from scm_world.tasks.trifinger.system import trifinger


def changed_scene() -> Scene:
    """Give every parameter of the busy scene another value."""
    scene = busy_scene()
    other = {key: other_value(key, value) for key, value in scene.parameters.items()}
    return scene.with_(parameters=other)


def test_what_stays_keeps_everything() -> None:
    """When blocks and obstacles come, all that was there keeps parameters and state."""
    now = changed_scene()
    blocks = ("new", *now.structure.blocks)
    more = now.structure.with_(blocks=blocks, obstacles=("wall", "ledge"))
    change = complete(now, more, Difference(structure=more))
    assert set(change.parameters) == {row.key for row in more.parameters}
    for key, value in now.parameters.items():
        assert np.array_equal(change.parameters[key], value)
    assert change.state is not None
    assert np.array_equal(change.state.blocks[1:], now.state.blocks)
    default = more.default_scene().parameters
    assert np.array_equal(change.parameters["wall", "position"], default["wall", "position"])


def test_a_preset_is_a_structure() -> None:
    """Another preset is a change of structure in which every parameter and the state stay."""
    now = changed_scene()
    finer = now.structure.with_(preset=PRECISE)
    assert now.structure != finer
    change = complete(now, finer, Difference(structure=finer))
    assert change.state == now.state
    assert all(np.array_equal(change.parameters[k], v) for k, v in now.parameters.items())


def test_a_shape_is_a_structure() -> None:
    """A box that becomes a hull keeps its mass and its place, and loses its size."""
    now = changed_scene()
    hulls = (*now.structure.hulls, ("near", box_hull([0.03, 0.04, 0.05])))
    shaped = now.structure.with_(hulls=hulls)
    assert now.structure != shaped
    change = complete(now, shaped, Difference(structure=shaped))
    assert change.state == now.state
    assert set(now.parameters) - set(change.parameters) == {("near", "size")}
    assert change.parameters["near", "mass"] == now.parameters["near", "mass"]


def test_what_is_said_counts() -> None:
    """Parameters in the difference go before those that stay and before the defaults."""
    now = changed_scene()
    said = {("ledge", "friction"): np.array(0.9), ("wall", "size"): np.array([0.1, 0.2, 0.3])}
    more = now.structure.with_(obstacles=("ledge", "wall"))
    change = complete(now, more, Difference(more, said))
    assert all(np.array_equal(change.parameters[key], value) for key, value in said.items())


def test_default_parameters_specify_the_published_controller() -> None:
    """The controller of the default parameters is the published one."""
    parameters = trifinger().default_scene().parameters
    for name, value in (
        ("position_gains", (10.0, 10.0, 10.0)),
        ("velocity_gains", (0.1, 0.3, 0.001)),
        ("safety_damping", (0.08, 0.08, 0.04)),
        ("torque_limit", 0.36),
    ):
        np.testing.assert_array_equal(parameters["controller", name], value)
