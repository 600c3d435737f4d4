"""The TriFinger Pro, through the interface of the real robot, as a backend for evaluation.

``trifinger_simulation.TriFingerPlatform`` has the methods of the real robot's front end: desired
actions are appended, observations are read by time index, and the pose of the cube comes from
cameras, ten times a second and late. The bodies are those of the TriFinger Pro, with other
shapes, limits and links than the robot of this package. What both have in common are the
fingertips: a command is sent as the joint positions that bring the tips of the Pro to where those
of this package's robot would be, and its joints are reported as those of this package's robot with
the same tips.

Source:
    Wüthrich et al., *TriFinger: An Open-Source Robot for Learning Dexterity*, CoRL 2020;
    ``trifinger_simulation`` 2.0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.backends.base import EngineSnapshot, InMemory
from scm_world.errors import EngineFailure, MissingEngine, UnknownOption
from scm_world.geometry.rotations import quaternion_product, to_rotation_vector
from scm_world.models.scene import Difference, Parameters, Scene
from scm_world.tasks.trifinger.grasping.bodies import turn_about_z
from scm_world.tasks.trifinger.hardware import N_JOINTS
from scm_world.tasks.trifinger.kinematics import forward, inverse
from scm_world.tasks.trifinger.system import PhysicalState, TriFinger

TURN = math.radians(-48.0)  # of this package's world about z, so that the fingers lie alike
NEAR, SMALL = 1e-4, 1e-6  # [m] of inverse kinematics, [rad] of derivatives
OWN: Mapping[str, Any] = {
    "tool_block.mass": 0.094,
    "position_gains": (15.0, 15.0, 9.0),
    "velocity_gains": (0.5, 0.5, 0.5),
    "torque_limit": 0.396,
    "finger_friction": 0.1,
}
"""Values of variables that the platform has by itself (its second velocity gain is 1, which is out
of bounds here): an intervention that sets them, on any backend, tells how much they matter."""


@final
class TriFingerPlatform(InMemory):
    """One cube and the TriFinger Pro, for playing policies.

    It takes joint positions only. Parameters that the platform cannot change must keep their
    defaults, among them the size of the cube (65 mm) and masses of links; they are reported as
    such, though links differ. States can be set, as an experimenter does by hand: the platform
    begins anew then, and so it does when a parameter is set; all is at rest, whatever moved, and
    velocities that are set are not used. Torques are mapped by the Jacobians of both robots.
    Velocities of the cube are differences of the poses that the cameras saw. No contacts are
    reported.
    """

    name: ClassVar[str] = "trifinger_platform"
    structure: TriFinger
    _state: PhysicalState
    _platform: Any
    _played: tuple[tuple[Floats, int], ...]

    def __init__(self) -> None:
        if find_spec("trifinger_simulation") is None:
            raise MissingEngine(self.name, "pip install 'scm-world[trifinger]'")
        self.version = version("trifinger_simulation")

    def build(self, scene: Scene) -> None:
        """Keep the scene; the platform is started with the first step.

        Raises:
            UnknownOption: It is not a scene with one cube, or a value is not the platform's.
        """
        has = scene.structure
        if not isinstance(has, TriFinger) or len(has.blocks) != 1 or has.obstacles or has.hulls:
            raise UnknownOption("scene of the TriFinger platform", has, ("one cube",))
        self._fits(has, scene.parameters)
        super().build(scene)
        self._begin()

    def apply(self, difference: Difference) -> None:
        """Change parameters and state; the platform begins anew.

        Raises:
            UnknownOption: The platform cannot have a value. Nothing has changed.
        """
        if difference.structure is not None:
            raise UnknownOption("scene of the TriFinger platform", "another one", ("one cube",))
        self._fits(self.structure, difference.parameters)
        super().apply(difference)
        if difference:
            self._begin()

    def step(self, command: Floats, substeps: int) -> None:
        """Move the fingertips to where a command would bring those of this package's robot.

        Raises:
            EngineFailure: Torques are commanded, or a number is not finite.
        """
        if self.structure.torques:
            advice = "use action_mode='joint_positions', or relative to them"
            raise EngineFailure(f"the platform takes joint positions only; {advice}", self.name)
        if self._platform is None:
            self._start()
            for earlier in self._played:
                self._play(*earlier)
        self._played += ((np.array(command), substeps),)
        self._play(command, substeps)
        if not np.isfinite(self._state.vector).all():
            raise EngineFailure("a number is not finite", self.name)

    def snapshot(self) -> EngineSnapshot:
        """Save where the platform began, and all commands since."""
        return EngineSnapshot.of(self, (super().snapshot(), self._first, self._played))

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore a snapshot; the commands before it are repeated with the next step."""
        scene, first, played = snapshot.opened(self)
        super().restore(scene)
        self._platform, self._first, self._played = None, first, played

    def close(self) -> None:
        """Disconnect the platform's simulation; a step would begin it again."""
        self._platform = None

    # --- the platform ------------------------------------------------------------------------

    def _fits(self, structure: TriFinger, parameters: Parameters) -> None:
        """Refuse values of parameters that the platform cannot change."""
        usual = structure.defaults
        for key, value in parameters.items():
            body, name = key
            free = name == "color" or body == "controller" or key == ("world", "gravity")
            free |= body in structure.blocks and name in ("mass", "friction")
            free |= name == "friction" and body in ("floor", "stage", "robot")
            if not free and not np.array_equal(value, usual[key]):
                asked, only = f"{body}.{name} on the TriFinger platform", usual[key].tolist()
                raise UnknownOption(asked, np.asarray(value).tolist(), (str(only),))

    def _begin(self) -> None:
        self._platform, self._first, self._played = None, self._state.copy(), ()

    def _start(self) -> None:
        """Make the platform as the first state and the parameters say."""
        import pybullet
        from trifinger_simulation import TriFingerPlatform as Platform
        from trifinger_simulation.tasks.move_cube import Pose

        first: PhysicalState = self._first
        pose = Pose(turned(first.positions[0], 1), turned_orientations(first.orientations[0], 1))
        self._platform = Platform(initial_object_pose=pose)
        robot = self._platform.simfinger
        self._joints = self._posed(first.joint_positions, Platform.spaces.robot_position.default)
        robot.reset_finger_positions_and_velocities(self._joints)
        self._seen: tuple[float, Floats, Floats] | None = None
        found, client = self._parameters, robot._pybullet_client_id

        def write(bodies: Iterable[tuple[Any, int]], name: str, **more: float) -> None:
            more["lateralFriction"] = float(found[name, "friction"])
            for body, link in bodies:
                pybullet.changeDynamics(body, link, physicsClientId=client, **more)

        block, table = self.structure.blocks[0], robot._table_id
        write([(self._platform.cube._object_id, -1)], block, mass=float(found[block, "mass"]))
        write([(getattr(table, "_object_id", table), -1)], "floor")
        write([(robot._containment_id, -1)], "stage")
        write([(robot.finger_id, link) for link in robot.pybullet_link_indices], "robot")
        pybullet.setGravity(*turned(found["world", "gravity"], 1), physicsClientId=client)
        law = {key[1]: value for key, value in found.items() if key[0] == "controller"}
        robot.position_gains = np.tile(law["position_gains"], 3)
        robot.velocity_gains = np.tile(law["velocity_gains"], 3)
        robot.safety_kd = np.tile(law["safety_damping"], 3)
        robot.max_motor_torque = float(law["torque_limit"])

    def _play(self, command: Floats, substeps: int) -> None:
        """Hold a command, and read what the platform observes then."""
        platform = self._platform
        wanted = platform.Action(position=self._posed(command, self._joints))
        for _ in range(round(substeps * self.structure.timestep / platform.get_time_step())):
            at = platform.append_desired_action(wanted)
        robot, seen = platform.get_robot_observation(at), platform.get_camera_observation(at)
        self._joints = np.array(robot.position)
        state = self._state
        here = self._ours(self._joints, state.joint_positions)
        moved = (self._ours(self._joints + SMALL * unit, here) for unit in np.eye(N_JOINTS))
        slopes = np.column_stack([(other - here) / SMALL for other in moved])
        state.joint_positions[:] = here
        state.joint_velocities[:] = slopes @ np.array(robot.velocity)
        state.joint_torques[:] = np.linalg.lstsq(slopes.T, np.array(robot.torque), rcond=None)[0]
        pose, time = seen.filtered_object_pose, 1e-3 * seen.cameras[0].timestamp
        place, facing = turned(pose.position, -1), turned_orientations(pose.orientation, -1)
        if self._seen is not None and time > self._seen[0]:
            elapsed, undone = time - self._seen[0], self._seen[2] * (-1.0, -1.0, -1.0, 1.0)
            state.linear_velocities[0] = (place - self._seen[1]) / elapsed
            turn = to_rotation_vector(quaternion_product(facing, undone))
            state.angular_velocities[0] = turn / elapsed
        if self._seen is None or time > self._seen[0]:
            self._seen = (time, place, facing)
        state.positions[0], state.orientations[0] = place, facing

    def _posed(self, joints: Floats, near: Floats) -> Floats:
        """Return the platform's joint positions with the tips of those of this package's robot."""
        from trifinger_simulation.trifingerpro_limits import robot_position as limits

        kinematics = self._platform.simfinger.kinematics
        found = np.array(near, dtype=np.float64)
        tips = forward(joints, float(self._parameters["robot", "height"])).reshape(3, 3)
        for finger, tip in enumerate(tips):
            part = slice(3 * finger, 3 * finger + 3)
            near_, _ = kinematics.inverse_kinematics_one_finger(
                finger, turned(tip, 1), found, tolerance=NEAR, max_iterations=100
            )
            found[part] = np.clip(near_[part], limits.low[part], limits.high[part])
        return found

    def _ours(self, joints: Floats, near: Floats) -> Floats:
        """Return the joint positions of this package's robot with the tips of the platform."""
        tips = np.array(self._platform.forward_kinematics(joints))
        height = float(self._parameters["robot", "height"])
        return inverse(turned(tips, -1).ravel(), height, near).joint_positions


def turned(points: ArrayLike, sign: int) -> Floats:
    """Turn points about z: 1 to the platform's world, -1 back."""
    return np.asarray(points) @ turn_about_z(sign * TURN).T


def turned_orientations(orientations: ArrayLike, sign: int) -> Floats:
    """Turn orientations about z likewise, with w >= 0."""
    turn = np.array([0.0, 0.0, sign * math.sin(TURN / 2), math.cos(TURN / 2)])
    found = quaternion_product(turn, np.asarray(orientations, dtype=np.float64))
    return np.where(found[..., 3:] >= 0.0, found, -found)
