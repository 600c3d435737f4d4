"""Many environments behind Gymnasium's vector interface, whoever simulates them."""

from __future__ import annotations

import operator
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array

from scm_world._types import Floats
from scm_world.env.arguments import RESETS, limited, reset_options
from scm_world.env.environment import EnvSnapshot
from scm_world.errors import (
    ActionError,
    InterventionError,
    NotReset,
    SnapshotMismatch,
    UnknownOption,
)
from scm_world.variables.subsets import AnyRegion
from scm_world.world import Audit
from scm_world.world.batch import Mask, located, read_actions, read_mask, read_seeds

MASK = "reset_mask"

SPACE = ""
"""The key of the space among the shapes of a member."""

SHOWN = ("reset", "present")
"""Methods whose answer is an observation and an info."""

Stepped = tuple[Any, Floats, Mask, Mask, dict[str, Any]]


class ScmWorldVectorEnv(VectorEnv[Any, Any, Any]):
    """Vectorised environments, each with its own parameters, noise and clock.

    Each is bit-identical to an environment alone. ``reset``, ``do`` and ``restore`` take effect in
    all environments that are named or in none, and the message of an error names the environment.
    Environments of one batch are observed alike: what would change which bodies exist in one of
    them is refused.

    Subclasses simulate: ``NativeVectorEnv`` in this process, ``ProcessVectorEnv`` in several.

    Args:
        num_envs: How many.
        observation_space: Of one of them.
        action_space: Likewise.
        metadata: Likewise.
        render_mode: Likewise.
        autoreset_mode: When one that is done is reset: ``"NextStep"``, ``"SameStep"`` or
            ``"Disabled"``, as in Gymnasium.
        copy: Give observations that are yours; else the next step overwrites them.

    Raises:
        UnknownOption: There is no such mode.
    """

    def __init__(
        self,
        num_envs: int,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        *,
        metadata: Mapping[str, Any],
        render_mode: str | None,
        autoreset_mode: AutoresetMode | str,
        copy: bool,
    ) -> None:
        self.num_envs, self.copy = num_envs, copy
        self.autoreset_mode = read_mode(autoreset_mode)
        self.metadata = {**metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self.single_observation_space = observation_space
        self.single_action_space = action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self._action_size = int(np.prod(action_space.shape or ()))
        self._everyone = np.ones(num_envs, bool)
        self._begun = np.zeros(num_envs, bool)
        self._ended = np.zeros(num_envs, bool)
        # The present of all environments; ``infos`` has columns from the first reset on.
        self._seen: Any = create_empty_array(observation_space, num_envs, np.zeros)
        self._rewards = np.zeros(num_envs)
        self._terminations = np.zeros(num_envs, bool)
        self._truncations = np.zeros(num_envs, bool)
        self._known: dict[str, Any] = {}

    # --- what subclasses do -----------------------------------------------------------------------

    @abstractmethod
    def _advance(self, which: Mask, actions: Floats) -> None:
        """Step some environments, and write what they say into their rows.

        If one fails, all others are one step further, and the first error is raised.
        """

    @abstractmethod
    def _act(self, method: str, given: Mapping[int, Mapping[str, Any]]) -> dict[int, Any]:
        """Call a method that changes environments, in all that are named or in none."""

    @abstractmethod
    def call_in(self, indices: Iterable[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some environments; return what cannot be called as it is."""

    @abstractmethod
    def _assign(self, name: str, values: Sequence[Any]) -> None:
        """Set an attribute of every environment."""

    def _write(self, rows: Any, observation: Any, info: Mapping[str, Any]) -> None:
        """Write what one environment shows into its row, or several into theirs."""
        if not self._known:
            self._known = _columns(info, self.num_envs, several=np.ndim(rows) > 0)
        if observation is not None:
            _put(self._seen, rows, observation)
        _put(self._known, rows, info)

    # --- Gymnasium's part -------------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all environments, or in some; all of those are reset, or none.

        Args:
            seed: Of the first environment, the next one gets the next number; or a list.
            options: ``"reset_mask"``: which ones, shape (n,), bool; ``"do"`` and ``"episode"``
                as in ``ScmWorldEnv.reset``: one for all, a list, or a mapping by index.

        Raises:
            UnknownOption: Another key, or something of the wrong length.
            InterventionError: The intervention was refused.
        """
        given = reset_options(options, (*RESETS, MASK))
        which = read_mask(MASK, given.pop(MASK, None), self.num_envs)
        seeds = read_seeds(seed, self.num_envs)
        asked: dict[int, dict[str, Any]] = {
            int(index): {"seed": seeds[index], "options": {}} for index in np.flatnonzero(which)
        }
        for name, value in given.items():
            for index, one in spread(name, value, self.num_envs, asked).items():
                asked[index]["options"][name] = one
        self._reset(asked)
        return self._observations(), self._infos(which)

    def _reset(self, asked: Mapping[int, Mapping[str, Any]]) -> None:
        self._act("reset", asked)
        self._begun[[*asked]], self._ended[[*asked]] = True, False

    def step(self, actions: Any) -> Stepped:
        """Advance all environments one control step.

        If an action is refused, none moves. If one environment fails as it is stepped, all others
        are one step further; ``present`` shows them.

        Args:
            actions: Shape (n, n_actions).

        Raises:
            ActionError: Another shape, a number that is not finite, or one of them is done and
                nothing resets it.
            NotReset: One of them has no episode yet.
        """
        stepping = self._stepping(actions)
        given = read_actions(actions, stepping, self._action_size, "environment")
        begun = ~stepping  # the next episode takes the place of a step
        if begun.any():
            self._reset({int(index): {} for index in np.flatnonzero(begun)})
        self._advance(stepping, given)
        if begun.any():
            self._rewards[begun] = 0.0
            self._terminations[begun] = self._truncations[begun] = False
        ended = self._terminations | self._truncations
        infos: dict[str, Any] = {}
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = ended
        elif ended.any():
            infos = self._final(ended)
            self._reset({int(index): {} for index in np.flatnonzero(ended)})
        flags = self._terminations.copy(), self._truncations.copy()
        infos |= self._infos(self._everyone)
        return self._observations(), self._rewards.copy(), *flags, infos

    def _stepping(self, actions: Any) -> Mask:
        """Return which environments take a step."""
        if not self._begun.all():
            raise located(NotReset(), int(np.argmin(self._begun)), "environment")
        if not self._ended.any():
            return self._everyone
        if self.autoreset_mode is AutoresetMode.DISABLED:
            done = ", ".join(map(str, np.flatnonzero(self._ended)))
            advice = "reset them first with options={'reset_mask': terminations | truncations}"
            raise ActionError(f"environments that are done take no step: {done}; {advice}", actions)
        return ~self._ended

    def _final(self, ended: Mask) -> dict[str, Any]:
        """Return the last observations and infos of episodes that ended."""
        shown = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(ended).tolist():
            shown[index] = row_of(self._seen, index)
        return {
            "final_obs": shown,
            "_final_obs": ended.copy(),
            "final_info": self._infos(ended),
            "_final_info": ended.copy(),
        }

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification; ``max_episode_steps`` is the length of the episodes."""
        return self.__dict__.get("spec")

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self.__dict__["spec"] = limited(spec, self.get_attr("limit")[0])

    def render(self) -> tuple[Any, ...]:
        """Draw every environment."""
        return self.call("render")

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every environment; return what cannot be called as it is."""
        return tuple(self.call_in(range(self.num_envs), name, *args, **kwargs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of every environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every environment.

        Args:
            name: Of the attribute.
            values: A list or tuple with one for each, or one for all.

        Raises:
            UnknownOption: A list of another length.
        """
        given = values if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(given) != self.num_envs:
            raise UnknownOption(f"list for {name}", values, (f"one of length {self.num_envs}",))
        self._assign(name, given)

    @property  # type: ignore[misc] # read only in Gymnasium's own kinds too
    def np_random(self) -> Any:
        """Gymnasium's generators of the environments, a tuple."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> Any:
        """Gymnasium's seeds of the environments, a tuple."""
        return self.get_attr("np_random_seed")

    def _observations(self) -> Any:
        return deepcopy(self._seen) if self.copy else self._seen

    def _infos(self, which: Mask) -> dict[str, Any]:
        return masked_infos(self._known, which)

    # --- interventions and snapshots --------------------------------------------------------------

    def do(self, requests: Any, *, space: AnyRegion | None = None) -> dict[int, Audit]:
        """Intervene now, in all environments that are named or in none.

        Args:
            requests: An intervention for all of them, a list with one or None for each, or a
                mapping by index.
            space: In which every target must lie.

        Returns:
            What it did, by the index of the environment. ``present`` shows how they look then.

        Raises:
            InterventionError: One of them refused; the message says which. Nothing has changed.
        """
        asked = spread("do", requests, self.num_envs)
        return self._act("do", {i: {"request": one, "space": space} for i, one in asked.items()})

    def present(self) -> tuple[Any, dict[str, Any]]:
        """Return observations and infos of the present, as after an intervention.

        Raises:
            NotReset: One of them has no episode yet.
        """
        if not self._begun.all():
            raise located(NotReset(), int(np.argmin(self._begun)), "environment")
        return self._observations(), self._infos(self._everyone)

    def snapshot(self) -> tuple[EnvSnapshot, ...]:
        """Save everything that decides the future of the episodes: a snapshot of each.

        Raises:
            NotReset: One of them has no episode yet.
        """
        return tuple(self._snapshots(range(self.num_envs)))

    def _snapshots(self, indices: Iterable[int]) -> list[EnvSnapshot]:
        for index in indices:
            if not self._begun[index]:
                raise located(NotReset(), index, "environment")
        found = zip(indices, self.call_in(indices, "snapshot"), strict=True)
        return [replace(one, ended=bool(self._ended[index])) for index, one in found]

    def restore(self, snapshot: Sequence[EnvSnapshot] | Mapping[int, EnvSnapshot]) -> None:
        """Go back to a snapshot, bit for bit.

        Args:
            snapshot: Of as many environments; or those of single ones, by the index of the
                environment that goes there.

        Raises:
            SnapshotMismatch: It is none, or one of another task or backend, or of another number.
        """
        given: Any = dict(enumerate(snapshot)) if isinstance(snapshot, tuple | list) else snapshot
        if not isinstance(given, Mapping) or not all(
            isinstance(one, EnvSnapshot) for one in given.values()
        ):
            raise SnapshotMismatch(f"{snapshot!r} is no snapshot; give what snapshot() returned")
        if given is not snapshot and len(given) != self.num_envs:
            text = f"it is one of {len(given)} environments, and here are {self.num_envs}"
            raise SnapshotMismatch(text)
        wanted = {index_of(key, self.num_envs): one for key, one in given.items()}
        self._act("restore", {index: {"snapshot": one} for index, one in wanted.items()})
        for index, one in wanted.items():
            self._begun[index], self._ended[index] = True, one.ended

    def branch(self, source: int, into: Any = None) -> None:
        """Copy the state of one environment into others: from here on they are its counterfactuals.

        They have its noise too, so that they differ by nothing but what is done to them. Reset
        with a seed, they have one of their own again.

        Args:
            source: Index of the one that is copied.
            into: Indices, or a mask of shape (n,), of those that become like it; all if None.

        Raises:
            NotReset: It has no episode.
            UnknownOption: There is no such environment.
        """
        number = index_of(source, self.num_envs)
        chosen = np.asarray(self._everyone if into is None else into)
        if chosen.dtype == np.bool_:
            chosen = np.flatnonzero(read_mask(MASK, chosen, self.num_envs))
        others = {index_of(one, self.num_envs) for one in np.atleast_1d(chosen).tolist()}
        (snapshot,) = self._snapshots([number])
        self.restore(dict.fromkeys(sorted(others - {number}), snapshot))


# --- what all kinds do to one environment ---------------------------------------------------------


def act(
    env: gymnasium.Env[Any, Any],
    shapes: Mapping[str, Any],
    method: str,
    given: Mapping[str, Any],
) -> tuple[Any, tuple[Any, dict[str, Any]]]:
    """Call a method that changes one environment of several.

    Args:
        env: The environment.
        shapes: Of all of them; see ``member_shapes``.
        method: Its name.
        given: Its arguments.

    Returns:
        The answer; and the observation and the info afterwards.

    Raises:
        InterventionError: It would be observed unlike the others then.
    """
    answer = env.get_wrapper_attr(method)(**given)
    inner: Any = env.unwrapped
    shown = answer if method in SHOWN else inner.present()
    here = shapes if env.observation_space is shapes[SPACE] else member_shapes(env)
    if here != shapes:
        request = given.get("request") or (given.get("options") or {}).get("do") or {}
        variable = next(iter(request), f"the {next(iter(given), method)}")
        changes = [
            f"{name} from shape {shape} to shape {here[name]}"
            for name, shape in shapes.items()
            if name != SPACE and shape != here[name]
        ]
        raise InterventionError(
            f"{variable} changes which bodies exist, and with them what is observed: "
            f"{'; '.join(changes) or 'the bounds of observations'}; environments in a batch are "
            "all observed alike: set it for all of them with start={…} when they are made, leave "
            "it out of a curriculum (besides=…), or use single environments",
            variable=variable,
        )
    return (None if method in SHOWN else answer), shown


def member_shapes(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return the space and the shapes of what is observed, and those of the infos."""
    space: Any = env.observation_space
    parts = dict(space) if isinstance(space, gymnasium.spaces.Dict) else {"observation": space}
    shapes = {name: part.shape for name, part in parts.items()}
    return {**env.get_wrapper_attr("info_shapes"), **shapes, SPACE: space}


# --- rows -----------------------------------------------------------------------------------------


def _columns(info: Mapping[str, Any], size: int, *, several: bool) -> dict[str, Any]:
    """Build the columns of all environments from the info of one, or of several."""
    return {
        name: _columns(value, size, several=several)
        if isinstance(value, Mapping)
        else np.zeros((size, *np.shape(value)[several:]), np.asarray(value).dtype)
        for name, value in info.items()
    }


def _put(columns: Any, rows: Any, values: Any) -> None:
    if not isinstance(columns, dict):
        columns[rows] = values
        return
    for name, column in columns.items():
        _put(column, rows, values[name])


def row_of(columns: Any, row: int) -> Any:
    """Copy the row of one environment."""
    if isinstance(columns, dict):
        return {name: row_of(column, row) for name, column in columns.items()}
    return columns[row].copy()


def masked_infos(columns: Mapping[str, Any], which: Mask) -> dict[str, Any]:
    """Copy the infos of some environments, in Gymnasium's form.

    Args:
        columns: Of all of them.
        which: Those that are meant, shape (n,).

    Returns:
        Every column, zeros elsewhere; and beside each, after a ``_``, which ones are meant.

    Example:
        >>> masked_infos({"x": np.array([1.0, 2.0])}, np.array([False, True]))
        {'x': array([0., 2.]), '_x': array([False,  True])}
    """
    found: dict[str, Any] = {}
    others = None if which.all() else ~which
    for name, column in columns.items():
        if isinstance(column, dict):
            found[name] = masked_infos(column, which)
        else:
            found[name] = column.copy()
            if others is not None:
                found[name][others] = 0
        found[f"_{name}"] = which.copy()
    return found


# --- arguments ------------------------------------------------------------------------------------


def read_mode(given: AutoresetMode | str) -> AutoresetMode:
    """Read when an environment that is done is reset."""
    try:
        return AutoresetMode(given)
    except ValueError:
        modes = [mode.value for mode in AutoresetMode]
        raise UnknownOption("autoreset_mode", given, modes) from None


def spread(what: str, given: Any, size: int, among: Iterable[int] | None = None) -> dict[int, Any]:
    """Return what is asked of each environment.

    Example:
        >>> spread("do", [None, {"floor_friction": 0.4}], 2)
        {1: {'floor_friction': 0.4}}
        >>> spread("do", {"floor_friction": 0.4}, 2)
        {0: {'floor_friction': 0.4}, 1: {'floor_friction': 0.4}}
    """
    known = [*range(size)] if among is None else [*among]
    if isinstance(given, Mapping) and any(not isinstance(key, str) for key in given):
        found = {index_of(key, size): one for key, one in given.items() if one is not None}
        if not found.keys() <= {*known}:
            raise UnknownOption(f"environments for {what}", [*found], ("those that are reset",))
        return found
    if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str):
        return {} if given is None else dict.fromkeys(known, given)
    if len(given) != size:
        raise UnknownOption(f"list for {what}", given, (f"one of length {size}",))
    return {index: given[index] for index in known if given[index] is not None}


def index_of(index: Any, size: int) -> int:
    """Read the index of an environment."""
    try:
        number = operator.index(index)
    except TypeError:
        number = -1
    if isinstance(index, bool) or not 0 <= number < size:
        raise UnknownOption("environment", index, (f"any whole number from 0 to {size - 1}",))
    return number
