"""Models that nobody here wrote, in the packages that are installed, and small ones."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest

GYMNASIUM = "gymnasium/envs/mujoco/assets/"
SUITE = "dm_control/suite/"
ROBOTS = "robosuite/models/assets/robots/"
URDFS = "pybullet_data/"

QUICK = (
    *(f"{GYMNASIUM}{name}.xml" for name in ("ant", "half_cheetah", "pusher_v5", "reacher")),
    f"{GYMNASIUM}inverted_double_pendulum.xml",
    *(f"{SUITE}{name}.xml" for name in ("ball_in_cup", "cartpole", "cheetah", "finger", "fish")),
    *(f"{URDFS}{name}.urdf" for name in ("cartpole", "kuka_iiwa/model", "franka_panda/panda")),
)
LONG = (
    *(f"{GYMNASIUM}{name}.xml" for name in ("hopper", "humanoid", "humanoidstandup", "point")),
    *(f"{GYMNASIUM}{name}.xml" for name in ("inverted_pendulum", "pusher", "swimmer", "walker2d")),
    f"{GYMNASIUM}walker2d_v5.xml",
    *(f"{SUITE}{name}.xml" for name in ("acrobot", "dog", "hopper", "humanoid", "humanoid_CMU")),
    *(f"{SUITE}{name}.xml" for name in ("manipulator", "pendulum", "point_mass", "quadruped")),
    *(f"{SUITE}{name}.xml" for name in ("reacher", "stacker", "swimmer", "walker")),
    *(f"{ROBOTS}{name}/robot.xml" for name in ("baxter", "gr1", "iiwa", "jaco", "kinova3")),
    *(f"{ROBOTS}{name}/robot.xml" for name in ("panda", "sawyer", "spot", "spot_arm", "tiago")),
    *(f"{ROBOTS}{name}/robot.xml" for name in ("ur5e", "xarm7")),
    *(f"{URDFS}{name}.urdf" for name in ("a1/a1", "aliengo/aliengo", "humanoid/humanoid", "r2d2")),
    *(f"{URDFS}{name}.urdf" for name in ("laikago/laikago", "pendulum5", "racecar/racecar")),
    *(f"{URDFS}{name}.urdf" for name in ("mini_cheetah/mini_cheetah", "quadruped/minitaur")),
    *(f"{URDFS}{name}.urdf" for name in ("xarm/xarm6_with_gripper", "differential/diff_ring")),
)

PENDULUM = """
<mujoco model="pendulum">
  <worldbody>
    <body name="pole" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" range="-90 90" limited="true" damping="0.1"/>
      <geom name="rod" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5"/>
      <site name="tip" pos="0 0 -0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-2 2"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/><touch name="touch" site="tip"/></sensor>
</mujoco>
"""

_MACHINES = """
<option gravity="0 0 -2" integrator="implicitfast"/>
<worldbody>
  <geom name="floor" type="plane" size="9 9 .1"/><site name="world" pos="0 0 2"/>
  <body name="drone" pos="0 0 .3"><freejoint/>
    <geom type="box" size=".1 .1 .03" mass="1"/>
    <site name="rotor" pos=".1 .1 0"/><site name="left" pos="-.1 -.1 .05"/>
  </body>
  <body name="arm" pos="2 0 1"><joint name="shoulder" axis="0 1 0" damping=".1"/>
    <geom type="capsule" size=".03 .2" mass=".5"/><site name="elbow" pos="0 0 .2"/>
    <body name="hand" pos="0 0 .3"><joint name="wrist" type="ball"/>
      <geom size=".05" mass=".2"/><site name="tip" pos="0 .1 .2"/>
    </body>
  </body>
  <body name="piston" pos="-2 0 1"><joint name="slide" type="slide" axis="1 0 0"/>
    <geom size=".05" mass=".3"/><site name="rod"/>
  </body>
  <body name="wheel" pos="-2 1 1"><joint name="turn" axis="0 0 1"/>
    <geom size=".05" mass=".3" pos=".1 0 0"/><site name="crank" pos=".1 0 0"/>
  </body>
</worldbody>
"""
_ROPE = '<spatial name="rope"><site site="left"/><site site="elbow"/></spatial>'
_BELT = '<fixed name="belt"><joint joint="slide" coef="1"/><joint joint="turn" coef=".3"/></fixed>'
_SO3 = 'gaintype="so3" biastype="so3" gainprm="5" biasprm="0 -5 -1"'
TRANSMISSIONS = {
    "site": ('<motor name="m" site="rotor" gear="0 0 1 0 0 .1"/>', "drone"),
    "refsite": ('<position name="m" site="tip" refsite="world" gear="1 0 0 0 0 0"/>', "arm"),
    "two sites": (
        '<position name="m" site="rotor" refsite="tip" gear="1 0 0 0 .1 0"/>',
        "drone arm",
    ),
    "rope": ('<motor name="m" tendon="rope" gear="2"/>', "drone arm"),
    "belt": ('<position name="m" tendon="belt" kp="3"/>', "piston wheel"),
    "muscle": ('<muscle name="m" tendon="belt" force="9" lengthrange="0 1"/>', "piston wheel"),
    "damper": ('<damper name="m" tendon="belt" kv="3" ctrlrange="0 1"/>', "piston wheel"),
    "crank": (
        '<motor name="m" cranksite="crank" slidersite="rod" cranklength="1.5"/>',
        "piston wheel",
    ),
    "joint": ('<intvelocity name="m" joint="slide" actrange="-1 1"/>', "piston"),
    "ball": ('<motor name="m" joint="wrist" gear="1 .5 0"/>', "arm"),
    "parent": ('<motor name="m" jointinparent="wrist" gear="1 .5 0"/>', "arm"),
    "adhesion": ('<adhesion name="m" body="drone" gain="5" ctrlrange="0 1"/>', ""),
    "orientation": (f'<general name="m" joint="wrist" {_SO3}/>', "arm"),
    "orientation of a site": (
        f'<general name="m" site="tip" refsite="rotor" {_SO3}/>',
        "drone arm",
    ),
    "general site": (
        '<general name="m" site="rotor" gear="1 0 0 0 0 0" dyntype="filter" dynprm=".1" '
        'gainprm="3" biastype="affine" biasprm="0 -1 -.1"/>',
        "drone",
    ),
    "general crank": (
        '<general name="m" cranksite="crank" slidersite="rod" cranklength="1.5" gainprm="3"/>',
        "piston wheel",
    ),
}
"""An actuator of every transmission, and the trees that it acts on without contact."""


def driven(kind: str) -> str:
    """Write a model with a drone, an arm, a piston and a wheel, and one actuator called ``m``."""
    actuator = TRANSMISSIONS[kind][0]
    tendons = _ROPE * ("rope" in actuator) + _BELT * ("belt" in actuator)
    return f"<mujoco>{_MACHINES}<tendon>{tendons}</tendon><actuator>{actuator}</actuator></mujoco>"


def model_file(name: str) -> Path:
    """Find a file in an installed package, without importing it."""
    package, _, inside = name.partition("/")
    found = importlib.util.find_spec(package)
    if found is None:
        pytest.skip(f"{package} is not installed")
    return Path(next(iter(found.submodule_search_locations))) / inside


def arrays(mj: mujoco.MjModel) -> dict[str, bytes]:
    """Copy all numbers of a compiled model but the paths of its files, as bytes."""
    parts = {"": mj, "opt.": mj.opt, "stat.": mj.stat}
    return {
        f"{prefix}{name}": np.asarray(getattr(part, name)).tobytes()
        for prefix, part in parts.items()
        for name in dir(part)
        if not name.startswith("_")
        and name not in ("signature", "nbuffer")
        and "path" not in name
        and isinstance(getattr(part, name), np.ndarray | float | int)
    }


def pile(n: int = 4, options: str = "") -> str:
    """Write bodies of different shapes that lie on one another."""
    shapes = ("box", "sphere", "capsule", "cylinder", "ellipsoid")
    bodies = "".join(
        f'<body name="b{i}" pos="{0.05 * i} {0.03 * (i % 2)} {0.12 + 0.21 * i}"><freejoint/>'
        f'<geom name="g{i}" type="{shapes[i % 5]}" size="0.1 0.1 0.1"/></body>'
        for i in range(n)
    )
    floor = '<geom name="floor" type="plane" size="5 5 0.1"/>'
    return f"<mujoco>{options}<worldbody>{floor}{bodies}</worldbody></mujoco>"
