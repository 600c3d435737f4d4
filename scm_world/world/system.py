"""An episode of a causal model: the base class of worlds and equations."""

from __future__ import annotations

import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np

from scm_world._arguments import EPISODES, whole_number
from scm_world._types import Floats, Value, Values
from scm_world.backends import EQUATIONS, Backend
from scm_world.backends.base import ContactPoint
from scm_world.errors import ModelError, NotReset, UnknownOption
from scm_world.graph import SCM
from scm_world.graph.scm import request_of
from scm_world.models import Scene
from scm_world.models.camera import Camera
from scm_world.variables.subsets import AnyRegion
from scm_world.world.audit import Audit
from scm_world.world.compiled_task import Vectors
from scm_world.world.philox import CompiledNoise
from scm_world.world.snapshot import Snapshot


class CausalSystem(ABC):
    """A causal model that is reset, stepped and intervened on.

    Attributes:
        backend: The physics engine; None for equations.
        compiled: Its variables, and the place of each in vectors.
        graph: The causal model with the interventions in force.
        keeps_draws: Whether an intervention draws once, and what it drew stays.
        deciding: Names of the variables that determine which bodies exist.
        policies: Scripted policies, by name, beside those of any system.
        noise: The noise of the seed.
        episode: Number of the episode.
        draws: Number of the episode whose draws hold; None for its own.
        version: Number of changes so far, apart from those by control steps.
        has_begun: Whether an episode has begun.
    """

    backend: Backend | None = None
    compiled: Vectors
    graph: SCM
    noise: CompiledNoise
    episode: int
    draws: int | None = None
    version: int = 0
    has_begun = False
    keeps_draws = False
    deciding: frozenset[str] = frozenset()
    policies: Mapping[str, Callable[[], Any]] = {}
    requested: Mapping[str, Any] = {}  # what the last intervention was
    _closed = False
    _lost = ""  # why the state is not known any more

    # --- reports ------------------------------------------------------------------------------

    @property
    def model(self) -> SCM:
        """The causal model, without the interventions of this episode."""
        return self.compiled.model

    @property
    def one(self) -> CausalSystem:
        """The system that questions are about: itself, or one of many worlds alike."""
        return self

    @property
    def natural_model(self) -> SCM:
        """The causal model at the beginning of an episode, whatever bodies there are now."""
        return self.model

    @property
    def settings(self) -> dict[str, Any]:
        """The options that it was made with, as far as they are not the usual ones of its task."""
        return {}

    @property
    @abstractmethod
    def engine(self) -> str:
        """Name and version of the physics engine; ``"equations"`` without one."""

    @property
    def engine_name(self) -> str:
        """Name of the physics engine; ``"equations"`` without one."""
        return EQUATIONS if self.backend is None else self.backend.name

    @property
    def has_scene(self) -> bool:
        """Whether there are bodies, which can be drawn."""
        return self.backend is not None

    @property
    def has_steps(self) -> bool:
        """Whether an episode has control steps; without, an instant is all there is."""
        return True

    @abstractmethod
    def length(self, steps: int | None) -> int:
        """Return the checked number of control steps of an episode; the usual one if None."""

    @abstractmethod
    def usual_setting(self) -> dict[str, Any]:
        """Return what a question about episodes takes by default, apart from the usual options."""

    @abstractmethod
    def usual_outcomes(self) -> tuple[str, ...]:
        """List the variables that a question about episodes reads by default."""

    @abstractmethod
    def usual_columns(self, *, every_step: bool = False) -> tuple[str, ...]:
        """List the variables that a dataset has by default, beside its causes."""

    @property
    def tools(self) -> tuple[str, ...]:
        """The names of the boxes that should be moved."""
        return ()

    @abstractmethod
    def idle(self) -> Floats:
        """Return the idle action, shape (n_actions,): zero, or the nearest one in the range."""

    def contacts(self) -> tuple[ContactPoint, ...]:
        """Return the contacts of the present instant; there are none without bodies."""
        return ()

    def scene(self) -> Scene:
        """Build the present scene, for rendering or for another engine."""
        raise needs_engine("scene")

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras whose poses are variables."""
        raise needs_engine("cameras")

    def _require_engine(self, name: str) -> None:
        """Refuse what only a world with an engine has."""
        if self.backend is None:
            raise needs_engine(name)

    def may_have(self, name: str) -> bool:
        """Return whether there is a variable or a body of a name, or there may be one."""
        return name in self.model

    def is_set_at_once(self, name: str) -> bool:
        """Return whether a variable is set at an instant, and physics continues from there."""
        return False

    @abstractmethod
    def maker(self) -> Callable[..., Any]:
        """Return a function that makes systems like this one; it can be pickled."""

    @property
    @abstractmethod
    def index(self) -> int:
        """Number of finished control steps of the episode."""

    @property
    def is_lost(self) -> bool:
        """Whether the backend has lost the state, so that a reset or a snapshot is needed."""
        return bool(self._lost)

    @property
    def observed(self) -> tuple[str, ...]:
        """The names of the variables in ``observation_space``: all of them."""
        return tuple(self.model)

    @property
    def action_low(self) -> Floats:
        """Lower end of all actions, shape (n_actions,)."""
        return self.compiled.action_bounds[0]

    @property
    def action_high(self) -> Floats:
        """Upper end of all actions, shape (n_actions,)."""
        return self.compiled.action_bounds[1]

    @property
    def action_space(self) -> gymnasium.spaces.Box:
        """The space of actions in SI units."""
        return gymnasium.spaces.Box(*self.compiled.action_bounds, dtype=np.float64)

    @property
    def observation_space(self) -> gymnasium.spaces.Dict:
        """The space of the observed variables by name, in SI units; nothing is clipped."""
        box, shapes = gymnasium.spaces.Box, {n: self.model.declared(n).shape for n in self.observed}
        return gymnasium.spaces.Dict(
            {name: box(-np.inf, np.inf, shape, np.float64) for name, shape in shapes.items()}
        )

    def __getitem__(self, name: str) -> Value:
        """Return the present value of one variable.

        Raises:
            UnknownVariable: No variable has this name.
            NotReset: No episode has begun.
        """
        self.model.declared(name)
        return np.array(self.evaluate((name,))[name])

    def values(self) -> dict[str, Value]:
        """Return the present value of every variable, as copies."""
        now = self.evaluate()
        return {name: np.array(now[name]) for name in self.model}

    @abstractmethod
    def evaluate(self, names: tuple[str, ...] | None = None) -> Values:
        """Compute some variables, all if None, and return all present values without copying them.

        For loops that cannot wait; the values change with the next step.

        Raises:
            NotReset: No episode has begun.
        """

    # --- episodes -----------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | None = None,
        episode: int = 0,
        do: Mapping[str, Any] | None = None,
        space: AnyRegion | None = None,
        draws: int | None = None,
    ) -> Audit | None:
        """Begin an episode. No intervention of the last episode remains.

        Args:
            seed: Seed of the noise. Without it the next episode of the same seed begins, or of a
                fresh seed if there was none.
            episode: Number of the episode, with a seed.
            do: An intervention that takes part in the beginning: a block of another size stands
                on the floor. It holds until the next reset.
            space: In which every target of it must lie; see ``do``.
            draws: Number of the episode whose draws hold: what interventions draw, and which
                parameters nature draws. The start states and all other noise are those of the
                episode itself. Those of the episode if None.

        Returns:
            The audit of the intervention, or None if there was none.

        Raises:
            InterventionError: The intervention was refused. The episode has begun without it.
        """
        request = request_of(do)
        if draws is not None and self.backend is None:
            raise UnknownOption("draws", draws, ("None: equations draw by their own episode",))
        drawn = None if draws is None else whole_number("draws", draws, least=0)
        if seed is not None:
            self.noise, self.episode = self._noise_of(seed, episode)
        elif not self.has_begun:
            self.noise, self.episode = CompiledNoise(secrets.randbits(63)), 0
        else:
            self.episode = self.episode + 1
        self.draws = drawn
        self._begin()
        self.requested = {}
        return self.do(request, space=space) if request else None

    def _noise_of(self, seed: Any, episode: Any) -> tuple[Any, Any]:
        """Return the noise of a seed, and the checked number of the episode."""
        return CompiledNoise(seed), whole_number("episode", episode, least=0, most=EPISODES)

    @abstractmethod
    def _begin(self) -> None:
        """Begin the episode of ``noise`` and ``episode``."""

    @abstractmethod
    def _have_no_episode(self) -> None:
        """Return to the condition before the first reset."""

    @abstractmethod
    def do(self, request: Mapping[str, Any], *, space: AnyRegion | None = None) -> Audit:
        """Intervene now, without advancing time. A refused request changes nothing."""

    @abstractmethod
    def snapshot(self) -> Snapshot:
        """Return everything that determines the future."""

    @abstractmethod
    def restore(self, snapshot: Snapshot) -> None:
        """Restore a snapshot bit-identically."""

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Restore the present bit-identically afterwards, also after an error or Ctrl-C.

        A world without an episode has none afterwards. One whose backend has lost the state still
        needs a reset or a snapshot.

        Example:
            >>> from scm_world.world import Simulation
            >>> world = Simulation("pushing", backend="fake")
            >>> world.reset(seed=5)
            >>> with world.unchanged():
            ...     world.reset(seed=0)
            ...     world.step(np.zeros(9))
            >>> world.noise.seed, world.index
            (5, 0)
        """
        back = self.way_back()
        try:
            yield
        finally:
            back()

    def way_back(self) -> Callable[[], None]:
        """Return a function that restores the present bit-identically; see ``unchanged``."""
        started, lost, noise = self.has_begun, self._lost, (self.noise, self.episode)
        asked = self.requested
        before = self.snapshot() if started and not lost else None

        def back() -> None:
            if before is not None:
                self.restore(before)
            elif not started:
                self._have_no_episode()
            else:
                self._lost, (self.noise, self.episode) = lost, noise
            self.requested = asked

        return back

    def require_exact(  # noqa: B027 # equations are
        self, question: str, *, independent: bool = False
    ) -> None:
        """Refuse a question that compares equal runs bit for bit, if they may differ.

        Raises:
            InexactEngine: It names the engines that can answer.
        """

    def _require_episode(self) -> None:
        if not self.has_begun:
            raise NotReset(closed=self._closed)


def needs_engine(name: str) -> ModelError:
    """Return the error for what only a world with an engine has."""
    return ModelError([f"a world of equations has no {name}: no engine moves bodies in it"])
