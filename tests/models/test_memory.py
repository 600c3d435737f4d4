"""What a world holds in memory: one whole model, and of the rest what physics needs."""

from __future__ import annotations

import gc
import tracemalloc
from dataclasses import replace
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from model_files import QUICK, model_file
from scipy.spatial import ConvexHull

from scm_world.backends import read_model
from scm_world.backends.mujoco.reading import compiled
from scm_world.queries import World

SIZE = mujoco.mj_sizeModel


def looks(name: str = "looks", sensor: str = "") -> mujoco.MjSpec:
    """Write a ball with pixels and a fine mesh, which touches nothing, and a mesh that does."""
    text = f"""
    <mujoco model="{name}">
      <asset>
        <texture name="t" type="2d" builtin="checker" width="700" height="700"/>
        <material name="m" texture="t"/>
      </asset>
      <worldbody>
        <geom type="plane" size="1 1 1" material="m"/>
        <body name="ball" pos="0 0 .5"><freejoint/>
          <geom name="rough" type="mesh" mesh="rough"/>
          <geom name="fine" type="mesh" mesh="fine" contype="0" conaffinity="0" group="1"/>
        </body>
        <body name="eye" pos="0 0 1.5"><joint/><geom size=".01"/>
          <site name="eye" zaxis="0 .1 -1"/>
        </body>
      </worldbody>
      <sensor>{sensor}</sensor>
    </mujoco>"""
    spec = mujoco.MjSpec.from_string(text)
    points = np.random.default_rng(0).normal(size=(3000, 3))
    points /= 10.0 * np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices
    inside = np.linalg.det(points[faces]) < 0.0
    faces[inside] = faces[inside, ::-1]
    spec.add_mesh(name="fine", uservert=points.ravel(), userface=faces.ravel())
    spec.add_mesh(name="rough", uservert=points[:50].ravel())
    return spec


def held() -> dict[int, int]:
    """Return the sizes of models and of long bytes, by their identities, that anything holds."""
    gc.unfreeze()  # what there was before the tests may hold something, too
    gc.collect()
    seen = gc.get_referents(*gc.get_objects())
    seen += gc.get_referents(*(d for d in seen if type(d) is dict and not gc.is_tracked(d)))
    models = {id(one): SIZE(one) for one in seen if type(one) is mujoco.MjModel}
    found = models | {id(b): len(b) for b in seen if type(b) is bytes and len(b) > 10_000}
    gc.freeze()
    return found


def height(position: Any) -> float:
    """Reward what is high."""
    return float(position[2])


def test_a_world_holds_one_whole_model() -> None:
    """A world, and what it saves, hold at most 1.3 times what plain MuJoCo does."""
    spec, before = looks("world"), held()
    plain = SIZE(spec.compile())
    world = World(spec)
    world.reset(seed=0)
    world.do({"ball.mass": 2.0, "ball.cartesian_position": (0.0, 0.0, 1.0)})
    world.step([])
    snapshot = world.snapshot()
    assert plain < sum(size for one, size in held().items() if one not in before) < 1.3 * plain
    world.restore(snapshot)


def test_variables_of_a_crowd_are_small() -> None:
    """Each of thousands of variables, with all that a world has for it, takes a few kilobytes."""
    arm = "<body name='{i}_{k}' pos='{x} 0 .1'><joint/><geom size='.05'/>"
    arms = (
        "".join(arm.format(i=i, k=k, x=0.1 if k else i) for k in range(8)) + 8 * "</body>"
        for i in range(6)
    )
    spec = f"<mujoco><worldbody>{''.join(arms)}</worldbody></mujoco>"
    World(spec).reset(seed=0)  # what is imported and compiled counts for none
    tracemalloc.start()
    world = World(spec)
    world.reset(seed=0)
    gc.collect()
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size < 3000 * len(world.model)


def test_environments_share_what_pictures_show() -> None:
    """Sixteen environments, each with its own parameters, hold one whole model."""
    spec, before = looks("environments"), held()
    plain = SIZE(spec.compile())
    reward = (height, "ball.cartesian_position")
    envs: Any = gymnasium.make_vec("scm_world/Model-v0", num_envs=16, model=spec, reward=reward)
    envs.reset(seed=0, options={"do": [{"ball.mass": 1.0 + i} for i in range(16)]})
    envs.step(envs.action_space.sample())
    assert plain < sum(size for one, size in held().items() if one not in before) < 1.9 * plain
    envs.close()


@pytest.mark.parametrize("name", [*QUICK, "looks"])
def test_steps_are_those_of_the_whole_model(name: str) -> None:
    """What only pictures have changes no number of a step, to the bit."""
    source = read_model(looks() if name == "looks" else model_file(name)).source
    models = source.whole, source.lean()
    both = [mujoco.MjData(mj) for mj in models]
    controls = np.random.default_rng(0).uniform(-1.0, 1.0, (100, models[0].nu))
    for control in controls:
        for mj, data in zip(models, both, strict=True):
            data.ctrl[:] = control
            mujoco.mj_step(mj, data)
    for what in ("qpos", "qvel", "qacc", "sensordata", "xpos", "geom_xpos", "qfrc_constraint"):
        assert np.array_equal(getattr(both[0], what), getattr(both[1], what)), what
    assert both[0].ncon == both[1].ncon


def test_surfaces_that_are_measured_stay() -> None:
    """A range finder meets a mesh that touches nothing."""
    measured = '<rangefinder name="distance" site="eye"/>'
    source = read_model(looks(sensor=measured)).source
    found = []
    for mj in (source.whole, source.realized):
        data = mujoco.MjData(mj)
        mujoco.mj_forward(mj, data)
        found.append(float(data.sensordata[0]))
    assert 0.8 < found[0] == found[1] < 1.0
    assert len(source.realized.tex_data) == 0


def test_other_files_of_models_are_copied_as_they_are() -> None:
    """If MuJoCo wrote models otherwise, worlds would hold them whole."""
    model = read_model(looks())
    whole, lean = model.source.whole, compiled(model)
    assert 10 * SIZE(lean) < SIZE(whole)
    other = replace(model.source, head=bytes(len(model.source.head))).realized
    assert other is not whole
    assert SIZE(other) == SIZE(whole)
