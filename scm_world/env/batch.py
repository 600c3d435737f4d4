"""Many environments that the backend steps in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate

from scm_world._arguments import one_of, true_or_false, typed, whole_number
from scm_world._types import ArrayLike, Floats, Integers, Mask, Observation
from scm_world.env.actions import JOINTS
from scm_world.env.arguments import RESETS, reset_options
from scm_world.env.environment import EnvSnapshot, ScmWorldEnv, unwrapped_env
from scm_world.errors import (
    ActionError,
    EngineFailure,
    FunctionFailure,
    InterventionError,
    NotReset,
    ScmWorldError,
    UnknownOption,
    blamed,
)
from scm_world.tasks.model import REWARD
from scm_world.tasks.rewards import one_number
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.variables.subsets import AnyRegion
from scm_world.world import Audit
from scm_world.world.batch import located, read_actions, read_mask, read_seeds
from scm_world.world.mechanisms import Rows

WHOLE = slice(None)
"""All rows."""

Places = int | Integers | slice
"""One row, or several."""

Seeds = int | Sequence[int | None] | None
"""A seed that counts up, or one for each."""

OfEach = Mapping[Any, Any] | Sequence[Any]
"""One for each in a list, or some by index; or one mapping for all."""

Stepped = tuple[Any, Floats, Mask, Mask, dict[str, Any]]


def mode_of(given: AutoresetMode | str) -> str:
    """Return the name of a mode in which members that are done are reset."""
    mode = getattr(given, "value", given)
    one_of("autoreset_mode", mode, [one.value for one in AutoresetMode])
    return str(mode)


@final
class ScmWorldVectorEnv(SyncVectorEnv):
    """Environments in one process, each with its own parameters, noise and clock.

    It is Gymnasium's ``SyncVectorEnv``, bit for bit, but the backend steps all of them in one call
    (MuJoCo in threads), and they are read in compiled loops. Pictures, the views of hands and
    the noise of sensors are read in one environment after another.

    ``do`` and ``restore`` take effect in all environments that are named or in none; so does the
    ``do`` of a reset, without which all episodes begin if it is refused in one. The message of an
    error names the environment. Environments of one batch are observed alike:
    what would change which bodies exist in one of them is refused.

    Args:
        num_envs: How many.
        autoreset_mode: When one that is done is reset, as in Gymnasium.
        copy: Give observations that are yours; else the next step overwrites them.
        threads: Threads of the backend; as many as there are cores if None. Results do not
            depend on it.
        member: Makes one of them from the options: a ``ScmWorldEnv``, or one in a
            ``CurriculumEnv``, whose ``over`` is called where an episode ends.
        options: Of ``ScmWorldEnv``.

    Raises:
        UnknownOption: An option does not exist, or does not go with the others.
    """

    @typed
    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        threads: int | None = None,
        member: Callable[..., gymnasium.Env[Any, Any]] = ScmWorldEnv,
        **options: Any,
    ) -> None:
        count, copy = whole_number("num_envs", num_envs, least=1), true_or_false("copy", copy)
        self._how: dict[str, Any] = {"num_envs": count, "copy": copy, "threads": threads}
        self._how |= {"autoreset_mode": mode_of(autoreset_mode), "member": member, **options}
        with blamed("member"):
            first = member(**options)
            lead = unwrapped_env(first, "a batch")
        # They share declarations, and each can be made again by itself.
        shared = {**options, "task": lead.world.structures, "task_options": None}
        makers: list[Any] = [lambda: first, *[partial(member, **shared)] * (count - 1)]
        super().__init__(makers, copy=copy, autoreset_mode=self._how["autoreset_mode"])
        self._inner: list[ScmWorldEnv] = [unwrapped_env(env, "a batch") for env in self.envs]
        for inner in self._inner:
            inner._ezpickle_kwargs = lead._ezpickle_kwargs
        self._shapes = _shapes(first)
        self._known: dict[str, Any] = {}  # a column of all environments for each entry of ``info``
        reads = lead.actions.reads
        self._names = (*lead.observer.needed, *(() if reads is None else (reads,)))
        worlds: list[Any] = [inner.world for inner in self._inner]
        self._batch = worlds[0].batched(worlds, threads=threads, names=self._names)
        self._counting = hasattr(first, "over")
        self._history = None
        if lead.history is not None:  # one for all of them, of which each has its row
            self._history = lead.history.on(lead.history.rows.repeat(count, axis=0))
            for row, inner in enumerate(self._inner):
                inner.history = self._history.on(self._history.rows[row : row + 1])

    # --- episodes ---------------------------------------------------------------------------------

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all environments, or in some; all of those are reset, or none.

        Args:
            seed: Seed of the first environment, the next one gets the next number; or a list.
            options: ``"reset_mask"``: which ones, shape (n,), bool; those of ``ScmWorldEnv.reset``:
                one for all, a list, or a mapping by index.
        """
        given = reset_options(options, (*RESETS, "reset_mask"))
        which = read_mask("reset_mask", given.pop("reset_mask", None), self.num_envs)
        seeds = read_seeds(seed, self.num_envs)
        asked: dict[int, dict[str, Any]] = {
            index: {"seed": seeds[index], "options": {}} for index in np.flatnonzero(which).tolist()
        }
        for name, value in given.items():
            for index, one in spread(name, value, self.num_envs, asked).items():
                asked[index]["options"][name] = one
        self._reset(asked)
        return self._shown(), infos_of(self._known, which)

    def _reset(self, asked: Mapping[int, Mapping[str, Any]]) -> None:
        try:
            self._act("reset", asked)
        except InterventionError:
            given = [one.get("options", {}).pop("do", None) for one in asked.values()]
            if any(one is not None for one in given):  # the episodes begin without it
                with suppress(InterventionError):  # what is done at every reset may be refused, too
                    self._reset(asked)
            raise
        self._autoreset_envs[[*asked]] = False

    def step(self, actions: ArrayLike) -> Stepped:
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
        self._require_episodes()
        begun = self._autoreset_envs.nonzero()[0]  # the next episode takes the place of a step
        if len(begun) and self.autoreset_mode is AutoresetMode.DISABLED:
            done = ", ".join(map(str, begun))
            advice = "reset them first with options={'reset_mask': terminations | truncations}"
            raise ActionError(f"environments that are done take no step: {done}; {advice}", actions)
        stepping = ~self._autoreset_envs if len(begun) else None
        lead = self._inner[0]
        shape = self.num_envs, lead.world.compiled.n_actions
        given = read_actions(lead.actions.chosen(actions), stepping, shape, "environment")
        if len(begun):
            self._reset({index: {} for index in begun.tolist()})
            self._rewards[begun] = 0.0
            self._terminations[begun] = self._truncations[begun] = False
        self._advance(stepping, given)
        ended = self._terminations | self._truncations
        infos: dict[str, Any] = {}
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._autoreset_envs = ended
        elif ended.any():
            last = np.full(self.num_envs, None, dtype=object)
            each = [*iterate(self.observation_space, self._observations)]  # views
            for row in np.flatnonzero(ended).tolist():
                last[row] = deepcopy(each[row])
            infos = {"final_obs": last, "final_info": infos_of(self._known, ended)}
            infos |= {f"_{name}": ended.copy() for name in infos}
            self._reset({index: {} for index in np.flatnonzero(ended).tolist()})
        flags = self._terminations.copy(), self._truncations.copy()
        infos |= infos_of(self._known, np.ones(self.num_envs, bool))
        return self._shown(), self._rewards.copy(), *flags, infos

    def _require_episodes(self) -> None:
        for row, inner in enumerate(self._inner):
            if not inner.world.has_begun:
                raise located(NotReset(closed=inner.world._closed), row, "environment")

    def _shown(self) -> Any:
        shown = self._observations
        if not self.copy:
            return shown
        return deepcopy(shown) if isinstance(shown, dict) else shown.copy()

    # --- a control step ---------------------------------------------------------------------------

    def _advance(self, which: Mask | None, actions: Floats) -> None:
        """Step some environments, all if None. If one fails, all others are one step further."""
        rows = np.arange(self.num_envs) if which is None else np.flatnonzero(which)
        if not len(rows):
            return
        commands = self._commanded(rows, actions)
        for row in rows.tolist() if self._history is not None else ():
            self._inner[row].update_history()
        indices = self._indices(rows)
        before = self._batch.by_structure(rows) if self._inner[0].truncates_failures else []
        kept = [table.numbers[members] for table, members in before]
        moved = rows
        try:
            self._batch.advance(commands, which)
        except (FunctionFailure, EngineFailure) as error:
            if not (kept and isinstance(error, EngineFailure) and error.diverged):
                self._remember(rows, indices, actions)
                self._read_alone(rows.tolist())
                raise located(error, error.row or 0, "environment") from error.__cause__
            failed = np.union1d(error.lost, error.unmoved).astype(int)
            for (table, members), numbers in zip(before, kept, strict=True):
                ended = np.isin(members, failed)
                table.numbers[members[ended]] = numbers[ended]
            for row in failed.tolist():
                self._write(row, *self._inner[row].present_of_failure())
            self._rewards[failed] = 0.0
            self._terminations[failed], self._truncations[failed] = False, True
            moved = np.setdiff1d(rows, failed)
        self._remember(rows, indices, actions)
        for table, members in self._batch.by_structure(moved):
            if moved is not rows:
                table.evaluate(self._names, members)
            self._take(table, members)
        ended = self._terminations | self._truncations
        for row in rows.tolist():
            if self._inner[row].world.is_planned and not ended[row]:
                self._follow_plan(row)
        if self._counting and ended.any():
            success = self._known.get("is_success", np.zeros(self.num_envs, bool))
            for row in rows[ended[rows]].tolist():
                self.envs[row].get_wrapper_attr("over")(success=bool(success[row]))

    def _indices(self, rows: Integers) -> Integers:
        """Return the control steps of some environments with a history."""
        found = np.zeros(self.num_envs, int)
        for table, members in self._batch.by_structure(rows) if self._history is not None else ():
            found[members] = table.numbers[members, table.compiled.clock]
        return found[rows]

    def _remember(self, rows: Integers, indices: Integers, actions: Floats) -> None:
        """Add a pair to the histories of those environments that have taken a step since."""
        if self._history is not None:
            which = rows[self._indices(rows) > indices]
            self._history.push(which, self._inner[0].actions.in_space(actions[which]))

    def _take(self, table: Rows, rows: Integers) -> None:
        """Write what a step led to in environments of one structure."""
        lead, now = self._inner[int(rows[0])], table
        place: Places = WHOLE
        if len(rows) < self.num_envs:
            now, place = Rows(table.compiled, table.numbers[rows]), rows
        lead.follow()
        rewards, ended, info = lead.observer.outcome(now)
        for row in rows[~np.isfinite(rewards)].tolist():
            env = self._inner[row]
            try:  # raises the error that this environment would raise alone
                one_number(env._look(), REWARD, env.world.task.weights)
            except ScmWorldError as error:
                raise located(error, row, "environment") from error.__cause__
        self._rewards[place] = lead.reward_scale * rewards
        self._terminations[place] = ended
        self._truncations[place] = now.numbers[:, now.compiled.clock] >= lead.limit
        observation = lead.observer.observe(now) if lead.observer.together else None
        if self._history is not None and observation is not None:
            observation = self._history.observe(observation, rows)
            for row in rows.tolist():
                self._inner[row].note_observed()
        self._write(place, observation, info)
        alone = rows if observation is None else rows[:0]
        if SENSOR_NOISE in now and observation is not None:
            alone = rows[now[SENSOR_NOISE] != 0.0]
        for row in alone.tolist():
            self._write(row, *self._inner[row].present())

    def _commanded(self, rows: Integers, actions: Floats) -> Floats:
        """Return the commands of some environments, shape (n, n_actions)."""
        how = self._inner[0].actions
        if how.relative:
            actions = np.array(actions)
            for table, members in self._batch.by_structure(rows):
                offset = (table.actions if how.reads is None else table[how.reads])[members]
                if how.reads is None and self._inner[0].world.options.action_mode == JOINTS:
                    # Where joints were put since the last command, actions are relative to them.
                    put = np.array([self._inner[row].actions.is_set() for row in members.tolist()])
                    offset = np.where(put[:, None], table[JOINTS][members], offset)
                actions[members] = how.moved(actions[members], offset)
        return how.commands(actions)

    def _follow_plan(self, row: int) -> None:
        """Do what the plan of one environment contains after a control step."""
        if not self._inner[row].world._may_act(self._inner[row].world.index):
            return
        terms = self._known["reward_terms"]
        earned = {name: column[row] for name, column in terms.items()}
        try:
            self._change(row, "act", {})
        except ScmWorldError as error:
            raise located(error, row, "environment") from error.__cause__
        for name, value in earned.items():
            terms[name][row] = value  # of the step: an intervention earns nothing

    # --- what changes single environments ---------------------------------------------------------

    def _act(self, method: str, given: Mapping[int, Mapping[str, Any]]) -> dict[int, Any]:
        """Call a method that changes environments, in all that are named or in none."""
        answers, index = dict[int, Any](), 0
        back: dict[int, Callable[[], None]] = {}
        try:
            for index, arguments in given.items():
                world, attribute = self._inner[index].world, self.envs[index].get_wrapper_attr
                if world.has_begun and not world.is_lost:
                    back[index] = partial(attribute("restore"), attribute("snapshot")())
                else:
                    back[index] = world.way_back()
                answers[index] = self._change(index, method, arguments)
        except BaseException as error:
            for undo in back.values():
                undo()
            self._read_alone(back)
            if isinstance(error, ScmWorldError):
                located(error, index, "environment")
            raise
        return answers

    def _change(self, row: int, method: str, arguments: Mapping[str, Any]) -> Any:
        """Call a method that changes one environment; refuse one that is observed unlike others."""
        env = self.envs[row]
        answer = env.get_wrapper_attr(method)(**arguments)
        shown = answer if method == "reset" else self._inner[row].present()
        here = _shapes(env)
        if here != self._shapes or env.observation_space != self.single_observation_space:
            request = arguments.get("request") or arguments.get("options", {}).get("do") or {}
            variable = next(iter(request), f"the {next(iter(arguments), method)}")
            raise InterventionError(
                f"{variable} changes which bodies exist, and with them what is observed, from "
                f"{self._shapes} to {here}; environments in a batch are all observed alike: set it "
                "for all of them with start={…} when they are made, leave it out of a curriculum "
                "(besides=…), or use single environments",
                variable=variable,
            )
        self._write(row, *shown)
        return answer

    def _write(
        self, rows: Places, observation: Observation | None, info: Mapping[str, Any]
    ) -> None:
        if isinstance(observation, dict):
            _put(self._observations, rows, observation, self.num_envs)
        elif observation is not None:
            self._observations[rows] = observation
        _put(self._known, rows, info, self.num_envs)

    def _read_alone(self, rows: Iterable[int]) -> None:
        """Read environments one by one; the row of one that cannot be read stays as it is."""
        for row in rows:
            with suppress(ScmWorldError):
                self._write(row, *self._inner[row].present())

    def present(self) -> tuple[Any, dict[str, Any]]:
        """Return observations and infos of the present, as after an intervention."""
        self._require_episodes()
        self._read_alone(range(self.num_envs))
        return self._shown(), infos_of(self._known, np.ones(self.num_envs, bool))

    def do(self, requests: OfEach, *, space: AnyRegion | None = None) -> dict[int, Audit]:
        """Intervene now, in all environments that are named or in none; see ``ScmWorldEnv.do``.

        Args:
            requests: An intervention for all of them, a list with one or None for each, or a
                mapping by index.
            space: In which every target must lie.

        Returns:
            The audits, by the index of the environment. ``present`` shows how they look then.
        """
        asked = spread("do", requests, self.num_envs)
        return self._act("do", {i: {"request": one, "space": space} for i, one in asked.items()})

    def snapshot(self) -> tuple[EnvSnapshot, ...]:
        """Save everything that decides the future of the episodes: a snapshot of each."""
        return tuple(map(self._snapshot, range(self.num_envs)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts for copying and pickling: the options, and a snapshot of each."""
        worlds = enumerate(inner.world for inner in self._inner)
        alive = [row for row, world in worlds if world.has_begun and not world.is_lost]
        saved = {row: self._snapshot(row) for row in alive}
        return _copied, (self._how, saved, self.__dict__.get("spec"))

    def _snapshot(self, index: int) -> EnvSnapshot:
        if not self._inner[index].world.has_begun:
            raise located(NotReset(), index, "environment")
        found: EnvSnapshot = self.envs[index].get_wrapper_attr("snapshot")()
        return replace(found, ended=bool(self._autoreset_envs[index]))

    def restore(self, snapshot: EnvSnapshot | OfEach) -> None:
        """Restore a snapshot, bit for bit; see ``ScmWorldEnv.restore``.

        Args:
            snapshot: One for each environment; or some, by the index of the environment that goes
                there; or one for all of them.
        """
        wanted = spread("restore", snapshot, self.num_envs)
        self._act("restore", {index: {"snapshot": one} for index, one in wanted.items()})
        for index, one in wanted.items():
            self._autoreset_envs[index] = one.ended

    def branch(self, source: int, into: int | Iterable[int] | None = None) -> None:
        """Copy the state of one environment into others: from here on they are its counterfactuals.

        They have its noise too, so that they differ by interventions and actions only. Reset
        with a seed, they have one of their own again.

        Args:
            source: Index of the one that is copied.
            into: Index or indices of those that become like it; all if None.
        """
        saved = self._snapshot(numbered(source, self.num_envs))
        given = range(self.num_envs) if into is None else into
        others: list[Any] = [*given] if isinstance(given, Iterable) else [given]
        if others:
            self.restore({numbered(one, self.num_envs): saved for one in others})


def _copied(
    how: Mapping[str, Any], saved: Mapping[int, EnvSnapshot], spec: EnvSpec | None
) -> ScmWorldVectorEnv:
    made = ScmWorldVectorEnv(**how)
    made.spec = spec
    if saved:
        made.restore(saved)
    return made


# --- rows -----------------------------------------------------------------------------------------


def _shapes(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return the shapes of the observation of an environment, and those of its infos."""
    space = env.observation_space
    parts = dict(space) if isinstance(space, gymnasium.spaces.Dict) else {"observation": space}
    return {**env.get_wrapper_attr("info_shapes"), **{n: part.shape for n, part in parts.items()}}


def _put(columns: dict[str, Any], rows: Places, values: Mapping[str, Any], size: int) -> None:
    """Write one row of columns, or several; columns that are missing begin as zeros."""
    for name, value in values.items():
        if isinstance(value, dict):
            _put(columns.setdefault(name, {}), rows, value, size)
            continue
        if name not in columns:
            shape = np.shape(value)[np.ndim(np.arange(size)[rows]) :]
            columns[name] = np.zeros((size, *shape), np.asarray(value).dtype)
        columns[name][rows] = value


def infos_of(columns: Mapping[str, Any], which: Mask) -> dict[str, Any]:
    """Copy columns of some environments, zeros elsewhere, in Gymnasium's form: beside each ``_…``.

    Example:
        >>> infos_of({"x": np.array([1.0, 2.0])}, np.array([False, True]))
        {'x': array([0., 2.]), '_x': array([False,  True])}
    """
    found: dict[str, Any] = {}
    others = None if which.all() else ~which
    for name, column in columns.items():
        found[name] = infos_of(column, which) if isinstance(column, dict) else column.copy()
        if others is not None and not isinstance(column, dict):
            found[name][others] = 0
        found[f"_{name}"] = which.copy()
    return found


# --- arguments ------------------------------------------------------------------------------------


def numbered(index: object, size: int) -> int:
    """Return the checked index of an environment."""
    return whole_number("environment", index, least=0, most=size - 1)


def spread(
    what: str, given: object, size: int, among: Iterable[int] | None = None
) -> dict[int, Any]:
    """Return the request for each environment.

    Example:
        >>> spread("do", [None, {"floor_friction": 0.4}], 2)
        {1: {'floor_friction': 0.4}}
        >>> spread("do", {"floor_friction": 0.4}, 2)
        {0: {'floor_friction': 0.4}, 1: {'floor_friction': 0.4}}
    """
    known = [*range(size)] if among is None else [*among]
    if isinstance(given, Mapping) and any(not isinstance(key, str) for key in given):
        asked = ((index, one) for index, one in given.items() if one is not None)
        found = {numbered(index, size): one for index, one in asked}
        if not found.keys() <= {*known}:
            raise UnknownOption(f"environments for {what}", [*found], ("those that are reset",))
        return found
    if given is None and among is None:
        raise UnknownOption(what, None, ("one for all", "a list", "a dictionary by index"))
    if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str):
        return {} if given is None else dict.fromkeys(known, given)
    if len(given) != size:
        raise UnknownOption(f"list for {what}", given, (f"one of length {size}",))
    return {index: given[index] for index in known if given[index] is not None}
