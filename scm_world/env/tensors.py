"""Many environments whose control steps are computed on the device of the engine, as tensors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, final

import numpy as np
from gymnasium.vector import VectorEnv

from scm_world._arguments import load
from scm_world._types import Integers, Mask
from scm_world.env.actions import JOINTS
from scm_world.env.batch import ScmWorldVectorEnv
from scm_world.env.observer import FAILED
from scm_world.env.vector import STREAM, Vector
from scm_world.errors import EngineFailure, ScmWorldError
from scm_world.tasks.model import REWARD
from scm_world.tasks.rewards import FRACTION, one_number
from scm_world.variables import Normal
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.world.batch import located
from scm_world.world.philox import uniforms, words_of
from scm_world.world.tensors import TensorRows

if TYPE_CHECKING:
    from torch import Tensor

SUCCESS = "is_success"


class TensorStep(NamedTuple):
    """What a control step led to in n environments; those whose episode is over have begun anew.

    Attributes:
        seen: Observations, shape (n, k), 32-bit.
        rewards: Shape (n,), 64-bit.
        terminated: Shape (n,), bool.
        truncated: Shape (n,), bool.
        rows: The environments whose episode is over, shape (m,), on the host.
        last: Their last observations, shape (m, k).
        facts: Their ``is_success``, ``fractional_success`` and ``failed``, shape (m,), on the host.
    """

    seen: Any
    rewards: Tensor
    terminated: Tensor
    truncated: Tensor
    rows: Integers
    last: Tensor
    facts: Mapping[str, Any]


@final
class HostEnvs:
    """The same for environments that are stepped on the host, whatever their engine is."""

    why_not, on_host = "", ()

    def __init__(self, envs: VectorEnv[Any, Any, Any], seen: Any) -> None:
        self._torch, self._envs = load("torch", "torch", "train"), envs
        self.seen = self._torch.as_tensor(seen)

    def step(self, actions: Tensor) -> TensorStep:
        """Advance all environments a control step; see ``TensorEnvs.step``."""
        seen, *flags, infos = self._envs.step(actions.cpu().numpy())
        rewards, terminated, truncated = map(self._torch.as_tensor, flags)
        self.seen = self._torch.as_tensor(seen)
        rows = np.flatnonzero(flags[1] | flags[2])
        last, facts = self.seen[rows], {FAILED: np.zeros(len(rows), bool)}
        if len(rows):
            last = self._torch.as_tensor(np.stack([*infos["final_obs"][rows]]))
            about = infos["final_info"]
            facts |= {n: about[n][rows] for n in (SUCCESS, FRACTION, FAILED) if n in about}
        return TensorStep(self.seen, rewards, terminated, truncated, rows, last, facts)

    def reset(self, which: Mask) -> None:
        """Begin an episode in some environments."""
        self.seen = self._torch.as_tensor(self._envs.reset(options={"reset_mask": which})[0])

    def leave(self) -> None:
        """Do nothing: the environments are up to date."""


def has_device(envs: Any) -> bool:
    """Return whether the engine of environments has states on a device."""
    batch = getattr(envs, "_batch", None)
    return batch is not None and batch._engine.stays


@final
class TensorEnvs:
    """Takes the place of the control steps of environments, after their reset.

    Between two steps everything stays on the device. On the host are the episodes that begin: what
    is drawn, and audited, there, is copied to the device; before, everything of the episode that is
    over is copied to the host.

    Args:
        envs: The environments, in each of which an episode has begun. They are stepped here, until
            ``leave``.

    Attributes:
        seen: The present observations, shape (n, k), 32-bit.
        why_not: Why the next step cannot be computed on the device; empty if it can.
        copies: Number of bytes copied so far, by reason and direction.
    """

    def __init__(self, envs: ScmWorldVectorEnv) -> None:
        torch = load("torch", "torch", "train")
        self._torch, self._envs, self._all = torch, envs, np.arange(envs.num_envs)
        self.copies: Counter[str] = Counter()
        shown = envs._shown()
        self._host_has = self._all
        self.seen: Any = shown if isinstance(shown, dict) else torch.as_tensor(shown)
        self._kinds = envs._batch._groups(self._all)
        self.why_not = self._reason(self._all)
        if self.why_not:
            return
        try:
            self._engine = envs._batch._engine.resident(self._all, self.copies)
        except EngineFailure as error:
            self.why_not = str(error)
            return
        lead, (compiled, self._substeps) = envs._inner[0], self._kinds[0][0]
        table = envs._batch._tables[compiled]
        self._rows = TensorRows(table, envs._names, self._engine.device, self.copies)
        observer, where = lead.observer, compiled.where

        def made(numbers: Any) -> Any:
            return torch.as_tensor(np.asarray(numbers), device=self._engine.device)

        vector: Any = observer.parts["observation"]
        self._observe: Any = vector.on_columns(made)
        self._limit, self._scale = lead.limit, lead.reward_scale
        self._actions = lead.actions.with_arrays(made)
        self._every, self._history = made(self._all), None
        if envs._history is not None:
            self._history = envs._history.on(made(envs._history.rows).clone())
        self._state, self._clock = compiled.state_size, compiled.clock
        self._reward, self._ended, *about = observer.outcomes
        facts = zip((SUCCESS, FRACTION), about, strict=True)
        self._facts = {name: place for name, place in facts if place is not None}
        reads = lead.actions.reads
        self._commands = compiled.action_columns
        self._origin_at = self._commands if reads is None else where[reads]
        put = reads is None and lead.world.options.action_mode == JOINTS
        self._put_at = where[JOINTS] if put and lead.actions.relative else None
        sizes = {STREAM: len(vector.space.low)}
        columns = {STREAM: where[SENSOR_NOISE]} if SENSOR_NOISE in where else {}
        commands = compiled.composition.commands
        self._sent = ""
        if commands is not None and commands.added is not None:
            scaled, self._sent, spread = commands.added
            columns[self._sent], sizes[self._sent] = where[scaled], len(spread)
            self._spread = made(spread[:, None])
        # Of each stream of noise: the column of its scale, how many numbers, whether there is any.
        self._noises = {n: [at.start, sizes[n], False] for n, at in columns.items()}
        self._where = np.zeros((envs.num_envs, 3), dtype=np.uint64)  # see ``uniforms``
        self._host_has = self._all[:0]
        self._look(self._all)

    @property
    def on_host(self) -> tuple[str, ...]:
        """The variables that are computed on the host in each step."""
        return tuple(self._rows.on_host)

    def _reason(self, rows: Integers) -> str:
        """Return why some environments cannot be stepped on the device."""
        envs = self._envs
        observer = envs._inner[0].observer
        kinds = envs._batch._groups(rows)
        part = observer.parts["observation"]
        if len(kinds) > 1 or kinds[0][0] != self._kinds[0][0]:
            return "worlds have different bodies"
        if len(observer.parts) > 1 or hasattr(observer.space, "spaces"):
            return "observations have parts"
        if not isinstance(part, Vector) or part.on_columns(np.asarray) is None:
            return "observations are pictures, views of hands, or the predecessor's"
        compiled, worlds = kinds[0][0][0], [envs._inner[row].world for row in rows.tolist()]
        commands = compiled.composition.commands
        alone = commands is not None and commands.added is None
        if any(world.acts_alone and (alone or world.holds_actions) for world in worlds):
            return "commands are computed from states, or actions are held"
        if any(world.is_planned and world.plan_end > 0.0 for world in worlds):
            return "interventions are planned within episodes"
        return ""

    def _look(self, rows: Integers) -> None:
        """Observe environments of which an episode has begun, and where their actions begin."""
        table, actions = self._rows.table, self._rows.table[self._origin_at]
        for row in rows.tolist():
            world = self._envs._inner[row].world
            key = world.noise_key(world.index)
            self._where[row] = key.noise.key, key.episode, key.step
        numbers = self._envs._batch._tables[self._kinds[0][0][0]].numbers
        for noise in self._noises.values():
            noise[2] = bool(numbers[:, noise[0]].any())
        seen = self._observe(table[:, rows], self._drawn(STREAM, rows)).float()
        if self._history is not None:
            self._history.rows[rows, : seen.shape[1]] = seen
            seen = self._history.rows[rows]
        if len(rows) == len(self._all):
            self.seen, self._origin = seen, actions.clone()
        else:
            self.seen[rows] = seen
            self._origin[:, rows] = actions[:, rows]
        if self._put_at is not None:
            put = [row for row in rows.tolist() if self._envs._inner[row].actions.is_set()]
            self._origin[:, put] = table[self._put_at][:, put]

    def _drawn(self, stream: str, rows: Integers) -> Any:
        """Draw normal numbers of some environments at this step, shape (m, k); None without noise.

        They are drawn on the host, as ``NoiseKey.draw`` does in each of them.
        """
        _, size, is_there = self._noises.get(stream, (0, 0, False))
        if not is_there:
            return None
        normal, words = Normal(), words_of(stream, None, range(1))
        numbers = uniforms(self._where[rows], words, normal.n_uniforms((size,)))[:, 0]
        drawn = np.asarray(normal.transform(numbers, (size,), {}))
        self.copies["noise to the device"] += drawn.nbytes
        return self._torch.as_tensor(drawn, device=self._rows.table.device)

    def step(self, actions: Tensor) -> TensorStep:
        """Advance all environments a control step; episodes that are over begin anew.

        Args:
            actions: Shape (n, n_actions), finite.

        Raises:
            ModelError, EngineFailure: A reward is not finite; the message names the environment.
        """
        torch, rows, table = self._torch, self._rows, self._rows.table
        given, how = actions.to(table.device, torch.float64), self._actions
        taken = how.in_space(given).float()
        if how.relative:
            given = how.moved(given, self._origin.T)
        summand, factor, low, high = how.scale
        commands = (summand + factor * given).clip(low, high).T
        sent, drawn = commands, self._drawn(self._sent, self._all)
        if drawn is not None:
            sent = commands + table[self._noises[self._sent][0]] * self._spread * drawn.T
        reasons = self._engine.step(sent, self._substeps)
        failed = torch.tensor([*reasons], dtype=torch.int64, device=table.device)
        before = table[:, failed]
        rows.begin_step(commands)
        table[: self._state] = self._engine.read()
        table[:, failed] = before
        rows.evaluate()
        self._origin = table[self._origin_at].clone()
        rewards = self._scale * table[self._reward]
        terminated = torch.zeros(len(rewards), dtype=torch.bool, device=table.device)
        if self._ended is not None:
            terminated = table[self._ended] != 0.0
        truncated = table[self._clock] >= self._limit
        rewards[failed], terminated[failed], truncated[failed] = 0.0, False, True
        self._where[np.setdiff1d(self._all, [*reasons]), 2] += np.uint64(1)
        self.seen = self._observe(table, self._drawn(STREAM, self._all)).float()
        if self._history is not None:
            moved = self._every
            if reasons:
                moved = torch.as_tensor(np.setdiff1d(self._all, [*reasons]), device=table.device)
            self._history.push(moved, taken[moved])
            self._history.rows[:, : self._history.size] = self.seen
            self.seen = self._history.rows.clone()
        over, sound = terminated | truncated, rewards.isfinite()
        flags = torch.stack([over.any(), ~sound.all()])
        self.copies["flags to the host"] += flags.nbytes
        some_over, some_wrong = flags.tolist()
        if some_wrong:
            self._refuse(np.flatnonzero(~sound.cpu().numpy()))
        ended = np.empty(0, dtype=int)
        last, facts = self.seen[ended], dict[str, Any]()
        if some_over:
            self.copies["flags to the host"] += over.nbytes
            ended = np.flatnonzero(over.cpu().numpy())
            last, facts = self.seen[ended].clone(), self._over(ended, {*reasons})
        return TensorStep(self.seen, rewards, terminated, truncated, ended, last, facts)

    def _refuse(self, wrong: Integers) -> NoReturn:
        """Raise the error of a reward that is not finite."""
        self.leave()
        row = int(wrong[0])
        env = self._envs._inner[row]
        try:
            one_number(env._look(), REWARD, env.world.task.weights)
        except ScmWorldError as error:
            raise located(error, row, "environment") from error.__cause__
        said = f"{REWARD} is finite on the host, and not on the device; step on the host"
        raise located(EngineFailure(said, env.world.backend.name), row, "environment")

    def _over(self, ended: Integers, failed: set[int]) -> dict[str, Any]:
        """Begin the next episode where one is over; return what came of it."""
        envs, numbers = self._envs, self._envs._batch._tables[self._kinds[0][0][0]].numbers
        self._to_host(ended)
        facts: dict[str, Any] = {n: numbers[ended, at].copy() for n, at in self._facts.items()}
        facts[FAILED] = np.isin(ended, [*failed])
        if SUCCESS in facts:
            facts[SUCCESS] = (facts[SUCCESS] != 0.0) & ~facts[FAILED]
        if envs._counting:
            success = facts.get(SUCCESS, np.zeros(len(ended), bool))
            for row, is_one in zip(ended.tolist(), success.tolist(), strict=True):
                envs.envs[row].get_wrapper_attr("over")(success=is_one)
        envs._reset({row: {} for row in ended.tolist()})
        self._to_device(ended)
        return facts

    def reset(self, which: Mask) -> None:
        """Begin an episode in some environments."""
        rows = np.flatnonzero(which)
        self._to_host(rows)
        self._envs.reset(options={"reset_mask": which})
        self._to_device(rows)

    def _to_host(self, rows: Integers) -> None:
        self._rows.to_host(rows)
        self._engine.collect(rows)
        if self._history is not None and self._envs._history is not None:
            past = self._history.rows[rows].cpu().numpy()
            self._envs._history.rows[rows] = past
            self.copies["histories to the host"] += past.nbytes

    def _to_device(self, rows: Integers) -> None:
        self.why_not = self._reason(rows)
        if self.why_not:
            self._host_has = rows
            self.seen[rows] = self.seen.new_tensor(self._envs._observations[rows])
            return
        self._rows.to_device(rows)
        self._engine.write(rows)
        if self._history is not None and self._envs._history is not None:
            past = self._envs._history.rows[rows]
            self._history.rows[rows] = self._torch.as_tensor(past, device=self._rows.table.device)
            self.copies["histories to the device"] += past.nbytes
        self._look(rows)

    def leave(self) -> None:
        """Write everything back into the environments, which can be stepped again."""
        if len(there := np.setdiff1d(self._all, self._host_has)):
            self._to_host(there)
        self._envs._read_alone(self._all)
