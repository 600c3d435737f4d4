"""Which body acts on which in one control step, by paired experiments.

From one scene, with one command, the state or a parameter of one body is changed a little and
everything else is kept. Whatever other body then ends elsewhere, or faster, is an effect.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.backends.base import Contact
from scm_world.errors import UnknownOption
from scm_world.models import ControlMode, Scene, State
from scm_world.tasks.composition import Mover
from scm_world.variables import Noise
from scm_world.world import World

Pair = tuple[str, str]
"""Two bodies; of an edge first the cause, then the effect."""

THRESHOLD = 1e-10  # [m], [rad], [m/s] or [rad/s] an effect must exceed it; the floor is 0.0
OFFSET = 1e-5  # [m] or [rad] by which a state is changed: small, so that what touches stays
PUSH = 1e-4  # [m/s] or [rad/s]
SHARE = 1e-3  # of a parameter, by which it is changed
DIRECTIONS = 2  # each with both signs


def movers(world: World) -> tuple[str, ...]:
    """Name the bodies that can move: of the robot's tasks the fingers, then the blocks.

    Raises:
        UnknownOption: It is a world of something else.
    """
    found = tuple(mover.name for mover in world.composition.movers())
    if not found:
        allowed = ("a world of the block-building robot",)
        raise UnknownOption("world of local graphs", world.task.name, allowed)
    return found


@final
class Listener:
    """Stands in for an engine: takes physics steps one by one, and notes what touches in each.

    Args:
        backend: The engine.

    Attributes:
        mode: How the engine was commanded last.
        command: The last one, shape (9,) [rad] or [N m].
        contacts: Of each physics step since then.
    """

    def __init__(self, backend: Any) -> None:
        self._backend = backend
        self.mode = ControlMode.JOINT_POSITIONS
        self.command: Floats = np.zeros(9)
        self.contacts: list[tuple[Contact, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def step(self, mode: ControlMode, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps."""
        self.mode, self.command, self.contacts = mode, np.array(command), []
        for _ in range(substeps):
            self._backend.step(mode, command, 1)
            self.contacts.append(self._backend.contacts())


@contextmanager
def listening(world: World) -> Iterator[Listener]:
    """Note the contacts of every physics step that a world takes in this block.

    An engine lists the contacts of its last physics step only.
    """
    engine: Any = world.backend
    listener: Any = Listener(engine)
    world.backend = listener
    try:
        yield listener
    finally:
        world.backend = engine


def rehearse(world: World, action: ArrayLike) -> Listener:
    """Take a control step and take it back; the world is bit for bit as it was."""
    before = world.snapshot()
    try:
        with listening(world) as heard:
            world.step(action)
    finally:
        world.restore(before)
    return heard


@final
@dataclass(frozen=True)
class LocalTruth:
    """What paired experiments found out about one control step.

    Attributes:
        edges: Pairs of different bodies, sorted: the first acts on the second.
        effects: The largest change seen on every ordered pair, [m], [rad], [m/s] or [rad/s].
        floor: The largest change where nothing was changed; 0.0.
        rollouts: Control steps that were simulated.
        contacts: Of each physics step where nothing was changed. They are not compared.
    """

    edges: tuple[Pair, ...]
    effects: Mapping[Pair, float] = field(default_factory=dict)
    floor: float = 0.0
    rollouts: int = 0
    contacts: tuple[tuple[Contact, ...], ...] = field(default=(), compare=False, repr=False)


def paired_truth(world: World, action: ArrayLike) -> LocalTruth:
    """Find by experiment which body acts on which in the coming control step.

    Every experiment builds the present scene anew: what an engine remembers beside the scene
    (the contact caches of Bullet) cannot be kept while a state is set, so it is the same, namely
    nothing, in all of them. The command to the joints is kept too.

    Args:
        world: It is left as it is, bit for bit.
        action: Of the coming control step.
    """
    heard, scene, before = rehearse(world, action), world.scene(), world.snapshot()
    listener: Any = Listener(world.backend)

    def after(start: Scene, engine: Any = world.backend) -> State:
        world.backend.build(start)
        engine.step(heard.mode, heard.command, len(heard.contacts))
        found: State = world.backend.state()
        return found

    movers(world)  # or an error
    bodies = world.composition.movers()
    effects, rollouts = dict[Pair, float](), 2
    try:
        factual = after(scene, listener)
        floor = max(_changes(bodies, factual, after(scene)).values())
        for cause in bodies:
            for other in variations(scene, cause):
                rollouts += 1
                for effect, size in _changes(bodies, factual, after(other)).items():
                    if effect != cause.name:
                        pair = (cause.name, effect)
                        effects[pair] = max(size, effects.get(pair, 0.0))
    finally:
        world.restore(before)
    edges = tuple(sorted(pair for pair, size in effects.items() if size > THRESHOLD))
    return LocalTruth(edges, effects, floor, rollouts, tuple(listener.contacts))


def variations(scene: Scene, body: Mover) -> Iterator[Scene]:
    """Change the state of one body in some directions, then each of its parameters."""
    for direction in range(DIRECTIONS):
        for sign in (1.0, -1.0):
            yield scene.with_(state=_moved(scene.state, body, direction, sign))
    for keys in body.parameters:
        for sign in (1.0, -1.0):
            factor = 1.0 + sign * SHARE
            changed = {key: scene.parameters[key] * factor for key in keys}
            yield scene.with_(parameters={**scene.parameters, **changed})


def _moved(state: State, body: Mover, direction: int, sign: float) -> State:
    """Change every number of the state of one body, in a direction that is always the same."""
    moved: State = state.copy()
    unit = 2.0 * Noise(0).uniforms(body.name, n=13, step=direction)[0] - 1.0
    unit = sign * (unit + np.copysign(0.2, unit))  # no number is left out
    positions, velocities = moved.vector[body.positions], moved.vector[body.velocities]
    positions += OFFSET * unit[: len(positions)]
    if body.rotation is not None:
        moved.vector[body.rotation] /= np.linalg.norm(moved.vector[body.rotation])
    velocities += PUSH * unit[len(positions) :][: len(velocities)]
    return moved


def _changes(bodies: Sequence[Mover], one: State, other: State) -> dict[str, float]:
    """Say how far the state of each body is from another one, the largest of its numbers."""
    apart = np.abs(one.vector - other.vector)
    return {
        body.name: float(max(apart[body.positions].max(), apart[body.velocities].max()))
        for body in bodies
    }
