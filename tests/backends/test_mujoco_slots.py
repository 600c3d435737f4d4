"""Scenes of models in a batch: what they say of the last step when they leave it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from scm_world import World
from scm_world.world.batch import Batch

BOX = """<mujoco><option timestep="0.002"{}/><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body name="box" pos="0 0 0.1"><freejoint/><geom name="box" type="box" size=".1 .1 .1"/></body>
  <body name="arm" pos="1 0 1"><joint name="hinge" axis="0 1 0"/><geom size=".05" pos="0 0 -.3"/>
  </body></worldbody><actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
  </mujoco>"""


def contacts(world: World) -> list[tuple[object, ...]]:
    """Give the contacts of the last physics step."""
    return [
        (one.bodies, one.position.tolist(), one.normal.tolist(), one.depth, one.force)
        for one in world.backend.contacts()
    ]


@pytest.mark.parametrize("option", ["", ' integrator="RK4"'])
@pytest.mark.parametrize("substeps", [1, 5])
def test_contacts_are_those_of_a_scene_alone(option: str, substeps: int) -> None:
    """Asked for at once, after an intervention, and through a snapshot of another process."""
    make = World, BOX.format(option)
    worlds = [make[0](make[1], frame_skip=substeps) for _ in range(4)]
    for seed, world in enumerate(worlds):
        world.reset(seed=seed)
    worlds[2].do({"box.mass": 3.0})
    alone = pickle.loads(pickle.dumps(worlds))  # noqa: S301 # our own
    batch = Batch(worlds, threads=2)
    for _ in range(20):
        batch.advance(np.full((4, 1), 0.5))
        for world in alone:
            world.step(np.full(1, 0.5))
    expected = [contacts(world) for world in alone]
    assert expected[0]
    assert expected[2] != expected[0]
    assert contacts(batch.world(0)) == expected[0]
    saved = pickle.loads(pickle.dumps(batch.world(1).snapshot()))  # noqa: S301 # our own
    alone[3].restore(saved)
    assert contacts(alone[3]) == expected[1]
    batch.world(2).do({"box.mass": 1.0})
    assert contacts(batch.world(2)) == expected[2]


def test_scenes_that_are_alike_share_a_model_until_one_is_not() -> None:
    """Each goes its own way, bit for bit, and comes back to the shared one."""
    worlds = [World(BOX.format("")) for _ in range(3)]
    for world in worlds:
        world.reset(seed=0)
    alone = World(BOX.format(""))
    alone.reset(seed=0)
    batch = Batch(worlds, threads=1)
    for damping in (0.0, 0.7, 0.0):
        batch.world(1).do({"hinge.damping": damping})
        alone.do({"hinge.damping": damping})
        for _ in range(5):
            batch.advance(np.ones((3, 1)))
            alone.step(np.ones(1))
        expected = alone["hinge.velocity"]
        assert batch.world(1)["hinge.velocity"] == expected
        if damping:
            assert batch.world(0)["hinge.velocity"] != expected
