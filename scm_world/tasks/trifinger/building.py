"""What all tasks have in common in which blocks should fill goals."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numba import njit

from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.geometry.arrays import compact
from scm_world.geometry.filling import overlap_fraction_kernel
from scm_world.geometry.overlap import aabb_overlap_fraction
from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks.base import Observed
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import FRACTION, FULFILLED, UNIT, reward, succeeded
from scm_world.tasks.trifinger import hardware, kernels
from scm_world.tasks.trifinger.base import (
    TriFingerTask,
    observe_goal,
    observe_obstacle,
    observe_tool,
)
from scm_world.tasks.trifinger.feasibility import fingers_reach
from scm_world.tasks.trifinger.symmetry import swapped, turned
from scm_world.tasks.trifinger.views import SIZE, view
from scm_world.variables import Function, Measured, Variable
from scm_world.variables.mechanisms import Stacked

SECONDS_PER_BLOCK = 10.0
BOX = 10  # numbers of a box in a goal vector: size (3), position (3), quaternion (4)
TIPS = "end_effector_positions"

NEAR = 0.1
"""What a meter between fingertips and block counts beside one between block and goal."""

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Of a cube with edges of length one, shape (8, 3)."""

_POSE = ("size", "cartesian_position", "orientation")


def gathered(*parents: Floats, tools: float) -> tuple[Floats, ...]:
    """Stack sizes, positions and quaternions of blocks, then those of goals.

    Args:
        parents: Size, position and quaternion of each block, then of each goal.
        tools: How many blocks there are.
    """
    n = 3 * int(tools)
    groups = (parents[:n], parents[n:])
    return tuple(np.array(group[i::3]) for group in groups for i in range(3))


@Stacked
@njit(cache=True)
def filled(numbers: Floats, tools: float) -> float:
    """Compute the fraction of the volume of all goals that the blocks fill, in [0, 1].

    Args:
        numbers: Size, position and quaternion of each block, then of each goal, shape (10 n,).
        tools: How many blocks there are.
    """
    n = len(numbers) // BOX
    size, position, turn = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    for i in range(n):
        for k in range(3):
            size[i, k], position[i, k] = numbers[BOX * i + k], numbers[BOX * i + 3 + k]
        for k in range(4):
            turn[i, k] = numbers[BOX * i + 6 + k]
    of = int(tools)
    return overlap_fraction_kernel(
        size[:of], position[:of], turn[:of], size[of:], position[of:], turn[of:]
    )


def aligned(*parents: Floats, tools: float) -> float:
    """Compute the predecessor's overlap: of the axis-aligned hulls, not capped."""
    return aabb_overlap_fraction(*gathered(*parents, tools=tools))


class Building(TriFingerTask):
    """A task in which blocks should fill goals.

    Attributes:
        interleaved: Whether block and goal alternate in the observation.
    """

    interleaved: ClassVar[bool] = False

    @abstractmethod
    def tools(self) -> tuple[str, ...]:
        """Name the blocks."""

    @abstractmethod
    def targets(self) -> dict[str, str]:
        """Name the goals, each with the block that its solution puts there."""

    def closeness(self) -> tuple[tuple[str, ...], Callable[..., Any]]:
        """Return minus the distance of blocks from goals, and a little of fingers from blocks."""
        have, want = self.goal_names()
        return (TIPS, *have, *want), boxes_apart

    def obstacles(self) -> tuple[str, ...]:
        """Name the obstacles."""
        return ()

    @abstractmethod
    def entities(self) -> Iterable[Entity]:
        """List blocks, goals and obstacles."""

    def dense(self) -> Iterable[Variable]:
        """Declare the dense reward terms."""
        return ()

    @property
    def seconds(self) -> float:
        """Ten seconds for each block [s]."""
        still = len(self.obstacles()) if self.conventions.static_counts else 0
        return SECONDS_PER_BLOCK * (len(self.tools()) + still)

    def readouts(self) -> Iterable[Variable]:
        """Declare reward terms and success."""
        yield from self.dense()
        yield self.fractional_success()
        yield succeeded()
        yield from self.terms
        yield reward(self.weights)

    def fractional_success(self) -> Measured:
        """Declare how much of the goals is filled."""
        tools, goals = self.tools(), tuple(self.targets())
        exact = not self.conventions.aligned_boxes
        if exact and len(tools) == len(goals) == 1:
            mechanism = Function(kernels.filled)
        else:
            constants = {"tools": float(len(tools))}
            mechanism = Function(filled if exact else aligned, constants=constants)
        return Measured(
            name=FRACTION,
            bounds=UNIT if exact else None,
            parents=tuple(f"{body}.{part}" for body in (*tools, *goals) for part in _POSE),
            mechanism=mechanism,
            doc="Fraction of the volume of all goals that the blocks fill.",
        )

    def observed(self) -> Iterable[Observed]:
        """Observe blocks, goals and obstacles."""
        targets = {tool: goal for goal, tool in self.targets().items()}
        for tool in self.tools():
            yield from observe_tool(tool)
            if self.interleaved and tool in targets:
                yield from observe_goal(targets[tool])
        for goal in () if self.interleaved else targets.values():
            yield from observe_goal(goal)
        for obstacle in self.obstacles():
            yield from observe_obstacle(obstacle)

    def goal_names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Name size, position and quaternion of each goal's block and of each goal."""

        def boxes(names: Iterable[str]) -> tuple[str, ...]:
            return tuple(f"{name}.{part}" for name in names for part in _POSE)

        targets = self.targets()
        return boxes(targets.values()), boxes(targets)

    def fraction(self, achieved: ArrayLike, desired: ArrayLike) -> Floats:
        """Compute how much of the desired boxes the achieved ones fill, shape (...)."""
        return self._fraction(achieved, desired, aligned=self.conventions.aligned_boxes)

    def view(self) -> tuple[tuple[str, ...], int, Callable[[Values], Floats]] | None:
        """Describe what a hand sees of the blocks that have goals, in their own frames."""
        parts = [
            (TIPS, *(f"{tool}.{part}" for part in _POSE), *(f"{goal}.{p}" for p in _POSE[1:]))
            for goal, tool in self.targets().items()
        ]

        def seen(values: Values) -> Floats:
            return np.concatenate([view(*(values[name] for name in names)) for names in parts])

        return tuple(dict.fromkeys(itertools.chain(*parts))), SIZE * len(parts), seen

    def symmetries(
        self, values: Values, names: Iterable[str]
    ) -> Iterable[tuple[Values, Sequence[int]]]:
        """Turn the scene by one and by two thirds of a turn; actions are of joints.

        There are none where there is a wall, which always stands in the same place.
        """
        for thirds in (1, 2) if not self.obstacles() else ():
            order = swapped(np.arange(float(hardware.N_JOINTS)), thirds).astype(int).tolist()
            yield turned(values, names, thirds), order

    def published_overlap(self, values: Values) -> float | None:
        """Compute the overlap of the axis-aligned boxes around blocks and around goals."""
        return float(self._fraction(*self.goals(values), aligned=True))

    def _fraction(self, achieved: ArrayLike, desired: ArrayLike, *, aligned: bool) -> Floats:
        have, want = np.asarray(achieved, dtype=float), np.asarray(desired, dtype=float)
        shape = np.broadcast_shapes(have.shape[:-1], want.shape[:-1])
        overlap = aabb_overlap_fraction if aligned else _exact
        rows = [
            np.broadcast_to(boxes, (*shape, boxes.shape[-1])).reshape(
                -1, boxes.shape[-1] // BOX, BOX
            )
            for boxes in (have, want)
        ]
        found = [overlap(*_split(mine), *_split(its)) for mine, its in zip(*rows, strict=True)]
        return np.array(found, dtype=float).reshape(shape)

    def fulfilled(self, fraction: ArrayLike) -> Value:
        """Tell whether more than nine tenths are filled."""
        return np.asarray(fraction) > FULFILLED

    def solution(self, values: Values) -> dict[str, Value]:
        """Put each block where its goal is, and fingers that are in the way to the side."""
        found = {
            f"{tool}.{part}": values[f"{goal}.{part}"]
            for goal, tool in self.targets().items()
            for part in _POSE[1:]
        }
        joints, height = values["joint_positions"], float(values["robot_height"])
        boxes = [[values[f"{goal}.{part}"] for part in _POSE] for goal in self.targets()]
        if any(fingers_reach(b[0], b[1], b[2], joints, height) for b in boxes):
            found["joint_positions"] = np.array(hardware.ASIDE)
        return found


class Assembly(Building):
    """A building of parts: blocks that begin on the floor, each with its place in it.

    The fingers begin raised, out of their way.
    """

    default_weights: ClassVar[Mapping[str, float]] = {FRACTION: 1.0}
    rest = hardware.RAISED

    @abstractmethod
    def parts(self) -> Iterable[tuple[str, dict[str, float]]]:
        """Name the parts, each with what says which it is."""

    @abstractmethod
    def piece(self, name: str, which: Mapping[str, float]) -> tuple[Entity, Entity]:
        """Describe the block of a part, and its goal."""

    def wanted(self, which: Mapping[str, float]) -> bool:
        """Tell whether a part has a goal."""
        return True

    def tools(self) -> tuple[str, ...]:
        """Name the blocks, part by part."""
        return tuple(f"tool_{name}" for name, _ in self.parts())

    def targets(self) -> dict[str, str]:
        """Name the goals, part by part."""
        return {
            f"goal_{name}": f"tool_{name}" for name, which in self.parts() if self.wanted(which)
        }

    def causes(self) -> Iterable[Entity]:
        """List what the places of the parts follow from, besides shared variables."""
        return ()

    def entities(self) -> Iterable[Entity]:
        """A block, and perhaps a goal, for each part."""
        pieces = [(self.piece(name, which), which) for name, which in self.parts()]
        yield from (tool for (tool, _), _ in pieces)
        yield from self.causes()
        yield from (goal for (_, goal), which in pieces if self.wanted(which))


def _split(boxes: Floats) -> tuple[Floats, Floats, Floats]:
    parts = (boxes[:, :3], boxes[:, 3:6], boxes[:, 6:])
    size, position, orientation = (compact(part) for part in parts)
    return size, position, orientation


def _exact(*boxes: Floats) -> float:
    return float(overlap_fraction_kernel(*boxes))


def boxes_apart(tips: Floats, *values: Floats) -> Floats:
    """Compute minus the distances of boxes, given as size, position and quaternion each."""
    half = len(values) // 2
    total = np.zeros(tips.shape[:-1])
    fingers = tips.reshape(*tips.shape[:-1], 3, 3)
    for first in range(0, half, 3):
        box, goal = (values[at : at + 3] for at in (first, half + first))
        gaps = np.linalg.norm(corners(*box) - corners(*goal), axis=-1)
        reach = np.linalg.norm(fingers - box[1][..., None, :], axis=-1)
        total += gaps.mean(axis=-1) + NEAR * reach.mean(axis=-1)
    return -total / (half // 3)


def corners(size: Floats, position: Floats, orientation: Floats) -> Floats:
    """Give the corners of boxes.

    Args:
        size: Edges, shape (..., 3) [m].
        position: Of the centers, shape (..., 3) [m].
        orientation: Quaternions, shape (..., 4).

    Returns:
        Shape (..., 8, 3) [m].
    """
    body = CORNERS * size[..., None, :]
    found: Floats = position[..., None, :] + body @ np.swapaxes(
        rotation_matrix(orientation), -1, -2
    )
    return found
