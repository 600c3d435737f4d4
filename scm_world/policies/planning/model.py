"""The model of a planner: copies of the world, stepped together; and scores of rollouts."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, final

import numpy as np

from scm_world._arguments import real_number, typed, whole_number
from scm_world._types import Floats
from scm_world.errors import ActionError, ModelError, UnknownOption, blamed
from scm_world.runs.processes import cores
from scm_world.tasks import Task
from scm_world.world import Simulation, Snapshot
from scm_world.world.batch import Batch

STREAM = "what a planner expects"
"""The stream from which the noise of a model that does not foresee it is seeded."""


@final
class PlanningModel:
    """Copies of a world in which sequences of actions are tried out; the world is not touched.

    Args:
        world: The modelled world.
        n: How many sequences are tried out together.
        names: Variables that are wanted after every control step.
        backend: The backend of the copies, by name; that of the world if None. Where it is another
            one, the physical state is carried over, but no memory of contacts.
        do: What the model believes to be different, as in ``World.do``: the true model if None.
        foresees: Whether the copies have the noise of the world, and so know what will be drawn.
        threads: Threads of the backend; as many as there are cores if None.

    Attributes:
        do: As above; it may be replaced.
        names: As above, each once.

    Raises:
        UnknownOption: The backend is unknown, or a number is wrong.
        UnknownVariable: A name does not exist.

    Example:
        >>> world = Simulation("pushing", backend="fake")
        >>> world.reset(seed=0)
        >>> model = PlanningModel(world, 2, ["reward"])
        >>> values = model.rollouts(model.present(world), np.zeros((2, 5, 9)))
        >>> values["reward"].shape, world.index
        ((2, 5), 0)
    """

    @typed
    def __init__(
        self,
        world: Simulation,
        n: int,
        names: Iterable[str],
        *,
        backend: str | None = None,
        do: Mapping[str, Any] | None = None,
        foresees: bool = False,
        threads: int | None = None,
    ) -> None:
        count = whole_number("samples", n, least=1)
        _, (_, task, given, _), *_ = world.__reduce__()
        options = {**given, "backend": backend or world.backend.name}
        options["variables_space"] = None  # beliefs may lie anywhere
        first = Simulation(copy.copy(task), **options)
        self._copies = [first, *(Simulation(first.structures, **options) for _ in range(count - 1))]
        self._is_foreign = first.engine != world.engine
        self.do, self._foresees = dict(do or {}), foresees
        self.names = tuple(dict.fromkeys(names))
        self._shapes = {name: world.model.declared(name).shape for name in self.names}
        share = cores() if threads is None else threads
        self._batch = Batch(self._copies, threads=share, names=self.names)

    def present(self, world: Simulation) -> Snapshot:
        """Return where the rollouts begin, if a world is as it is now.

        Args:
            world: It is only looked at.

        Raises:
            InterventionError: ``do`` cannot be done to the present.
        """
        snapshot = world.snapshot()
        if self._is_foreign:
            engine = self._batch.world(0).backend  # it realises the present, too
            engine.build(world.scene())
            snapshot = replace(snapshot, engine=engine.snapshot())
        if not self._foresees:
            drawn = world.noise.uniforms(STREAM, n=1, episode=world.episode, step=world.index)
            snapshot = replace(snapshot, seed=int(drawn[0, 0] * 2.0**53))
        if not self.do:
            return snapshot
        believed = self._batch.world(0)
        believed.restore(snapshot)
        believed.do(self.do)
        return believed.snapshot()

    def rollouts(self, start: Snapshot, actions: Floats) -> dict[str, Floats]:
        """Try sequences of actions out.

        Args:
            start: As ``present`` gives it.
            actions: Shape (n, steps, n_actions) in the units of the action mode, in their range;
                as many as there are copies, or fewer.

        Returns:
            By name, the values after each control step, shape (n, steps, *shape).

        Raises:
            ActionError: Actions have another shape.
            EngineFailure: The backend lost a state.
        """
        size = self._copies[0].compiled.n_actions
        if actions.ndim != 3 or actions.shape[2] != size or len(actions) > len(self._copies):
            allowed = f"(n, steps, {size}), with n up to {len(self._copies)}"
            raise ActionError(f"actions have shape {allowed}, got {actions.shape}", actions)
        n, steps = actions.shape[:2]
        which = np.arange(len(self._copies)) < n
        commands = np.zeros((len(which), steps, size))
        commands[:n] = actions
        for row in range(n):
            self._batch.world(row).restore(start)
        found = {name: np.empty((n, steps, *shape)) for name, shape in self._shapes.items()}
        for step in range(steps):
            self._batch.advance(commands[:, step], which)
            table = self._batch.table(0)
            for name in self._shapes:
                found[name][:, step] = table[name][:n]
        return found

    def close(self) -> None:
        """Free the engines."""
        self._batch.close()


@typed
@final
@dataclass(frozen=True)
class Score:
    """A function of the values of some variables, for many rollouts together.

    Attributes:
        names: Names of the variables.
        function: Takes the values in this order, each of shape (..., *shape) of its variable, and
            returns numbers of shape (...), the higher the better. It can be pickled if it has a
            name.
        sums: Whether it is given the sum of a variable with several numbers instead, where it is
            known which axes are those of the variable.

    Example:
        >>> import numpy as np
        >>> heavy = Score(("tool_block.mass",), np.negative)
        >>> heavy.of({"tool_block.mass": np.array([[0.02, 0.08]])})
        array([[-0.02, -0.08]])
    """

    names: tuple[str, ...]
    function: Callable[..., Any]
    sums: bool = False

    def of(self, values: Mapping[str, Floats], shape: tuple[int, ...] | None = None) -> Floats:
        """Compute it.

        Args:
            values: By name, shape (..., *shape).
            shape: That what comes out must have; it is not checked if None.

        Returns:
            Shape (...).

        Raises:
            ModelError: The function gave something else, or numbers that are not finite.
        """
        given = [values[name] for name in self.names]
        if self.sums and shape is not None:
            given = [value.reshape(*shape, -1).sum(axis=-1) for value in given]
        with blamed("the score of a plan"):
            found = np.asarray(self.function(*given), dtype=np.float64)
        if not np.isfinite(found).all():
            names = ", ".join(self.names)
            raise ModelError([f"the score of a plan is not finite; it is a function of {names}"])
        if shape is not None and found.shape != shape:
            problem = f"the score of a plan has shape {found.shape}, not {shape}: one number each"
            raise ModelError([f"{problem}; values have shape (rollouts, steps, ...)"])
        return found


def as_score(given: str | Mapping[str, float] | Score) -> Score:
    """Read a score.

    Args:
        given: The name of a variable, weights by name, or a ``Score``. Of a variable with several
            numbers their sum counts.

    Example:
        >>> import numpy as np
        >>> score = as_score({"reward": 1.0, "joint_velocities": -0.1})
        >>> score.of({"reward": np.ones(2), "joint_velocities": np.ones((2, 9))}, (2,)).round(3)
        array([0.1, 0.1])
    """
    allowed = ("the name of a variable", "weights by name", "a Score")
    if isinstance(given, Score):
        return given
    if isinstance(given, str):
        return as_score({given: 1.0})
    if not isinstance(given, Mapping) or not given:
        raise UnknownOption("objective", given, allowed)
    for name in given:
        if not isinstance(name, str):
            raise UnknownOption("objective", given, allowed)
    weights = tuple(real_number(f"weight of {name}", one) for name, one in given.items())
    return Score(tuple(given), partial(_weighted, weights), sums=True)


def _weighted(weights: tuple[float, ...], *values: Floats) -> Floats:
    """Add values up."""
    shares = [weight * value for weight, value in zip(weights, values, strict=True)]
    return np.asarray(sum(shares))


@typed
def nearness(task: Task) -> Score:
    """Return the score that counts how near everything is to its goal, in minus meters.

    Of blocks that is the mean distance of the eight corners of each block from those of its goal,
    so that turning counts, and a tenth of the mean distance of the fingertips from the block; of
    a task without blocks the distance of the achieved from the desired goal. Of a task without
    goals it is the reward.

    Args:
        task: Task of the world.
    """
    goal = task.goal
    have, want = goal.achieved, goal.desired
    if not have and not task.weights:
        allowed = ("the name of a variable", "weights by name", "a Score")
        raise UnknownOption(f"objective of {task.name!r}, without goals and reward", None, allowed)
    if not have:
        return as_score("reward")
    if goal.closeness is not None:
        return Score(*goal.closeness)
    return Score((*have, *want), partial(_apart, len(have)))


def _apart(count: int, *values: Floats) -> Floats:
    have, want = (np.concatenate(part, axis=-1) for part in (values[:count], values[count:]))
    return -np.asarray(np.linalg.norm(have - want, axis=-1))
