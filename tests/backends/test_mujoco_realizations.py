"""A scene with the parameters of the first one of its structure copies what that computed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world import World
from scm_world.backends.mujoco.backend import MujocoBackend
from scm_world.backends.mujoco.realization import OF_DATA, Realization
from scm_world.models import Difference, Scene

MANY = """<mujoco><option gravity="0 0 -5"/><worldbody>
  <geom name="floor" type="plane" size="1 1 1" friction=".5 .01 .001"/>
  <body name="hand" mocap="true" pos=".3 0 .4"><geom size=".02" mass=".1"/></body>
  <body name="box" pos="0 0 .2"><freejoint/><geom type="box" size=".1 .1 .1" mass=".3"/></body>
  <body name="arm" pos="1 0 1"><joint name="hinge" axis="0 1 0" ref=".2" damping=".1"/>
    <geom size=".05" pos="0 0 -.3"/></body></worldbody>
  <equality><weld name="held" body1="hand" body2="box" active="false"/></equality>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""


def scene_of(system: Any, **options: Any) -> Scene:
    """Return the first scene of a world, with every parameter that there is."""
    world = World(system, **options)
    world.reset(seed=0)
    return world.scene()


def content(mj: Any) -> dict[str, bytes]:
    """Return all arrays of a model or of data, by name."""
    found: dict[str, bytes] = {}
    for name in dir(mj):
        array = None if name.startswith("_") else getattr(mj, name, None)
        if isinstance(array, np.ndarray):
            found[name] = array.tobytes()
    return found


SCENES = [
    pytest.param("pushing", {}, id="robot"),
    pytest.param(MANY, {"expose": "*"}, id="model"),
]


@pytest.mark.parametrize(("system", "options"), SCENES)
def test_a_copy_is_what_would_be_computed(system: str, options: dict[str, Any]) -> None:
    """All arrays of the model and of its data, and the parameters in their order."""
    scene = scene_of(system, **options)
    structure, parameters = scene.structure, dict(scene.parameters)
    vars(structure).pop("_usual", None)
    written = {("hand", "position"): [0.3, 0.1, 0.4], ("held", "active"): 1.0}  # into the data
    parameters |= {k: np.array(v) for k, v in written.items() if k in parameters}
    first = Realization(structure, parameters)
    assert vars(structure)["_usual"][1] is not first.model
    again = Realization(structure, parameters)
    assert not again._slots
    assert again.model is not first.model
    assert content(again.model) == content(first.model)
    assert content(again.data) == content(first.data)
    assert again.fingerprint() == first.fingerprint()
    assert {*OF_DATA} <= {*content(again.data)}


@pytest.mark.parametrize(("system", "options"), SCENES)
def test_other_parameters_are_computed(system: str, options: dict[str, Any]) -> None:
    """One number differs, and what the first scene does later changes nothing in the next one."""
    scene = scene_of(system, **options)
    key = next(key for key in scene.parameters if key[1] == "mass" and scene.parameters[key] > 0.0)
    heavy = {**scene.parameters, key: 2.0 * scene.parameters[key]}
    usual, heavier = MujocoBackend(), MujocoBackend()
    usual.build(scene)
    heavier.build(Scene(scene.structure, heavy, scene.state))
    assert heavier.parameters([key])[key] == heavy[key]
    usual.apply(Difference(None, {key: heavy[key]}))
    third = MujocoBackend()
    third.build(scene)
    assert third.parameters([key])[key] == scene.parameters[key]
    command = np.zeros(scene.structure.n_commands)
    for backend in (usual, heavier):
        backend.step(command, 10)
    assert usual.read().vector.tobytes() == heavier.read().vector.tobytes()
