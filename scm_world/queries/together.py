"""Episodes that happen together, in the rows of a batch, and are read as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Floats, Integers, Mask, Value
from scm_world.errors import ScmWorldError, blamed
from scm_world.policies.scripted import OpenLoopPolicy, as_policy
from scm_world.queries.episodes import ALL, Episode, Era, Unit, run, who
from scm_world.variables.distributions import word_of
from scm_world.world.audit import Audits
from scm_world.world.batch import Batch
from scm_world.world.mechanisms import Rows

if TYPE_CHECKING:
    from scm_world.queries.twins import Twins


@final
class EpisodeBatch(Sequence[Episode]):
    """Finished episodes of equal length, read as arrays with a leading axis, or one by one.

    Args:
        units: Their units, n of them.
        many: The record of all: its arrays have an axis of episodes after that of the instants.
        acted: By the instant of an era: the episodes in which it begins, shape (n,); all of them
            where there is no entry.
        audits: By instant: the audits of each intervention there, by episode.
        places: Which episodes of the record these are, shape (n,); all if None.
    """

    def __init__(
        self,
        units: Sequence[Unit],
        many: Episode,
        acted: Mapping[int, Mask] | None = None,
        audits: Mapping[int, Sequence[Audits]] | None = None,
        places: Integers | None = None,
    ) -> None:
        self.units, self._many, self._places, self._one = units, many, places, False
        self._acted, self._audits = acted or {}, audits or {}

    @classmethod
    def of(cls, episode: Episode) -> EpisodeBatch:
        """Return an episode that ran alone."""
        made = cls([episode.unit], episode)
        made._one = True
        return made

    def __len__(self) -> int:
        return len(self.units)

    @property
    def steps(self) -> int:
        """Number of finished control steps of each."""
        return self._many.steps

    @property
    def compiled(self) -> Any:
        """The compiled system of the first instant."""
        return self._many.eras[0].compiled

    @property
    def vectors(self) -> Floats:
        """The states at every instant, shape (n, steps + 1, size)."""
        return self._by_episode(self._many.vectors)

    def read(self, name: str) -> Value:
        """Return a variable at every instant, shape (n, steps + 1, *shape); see ``Episode``.

        Of units that record only the ends, these are the two instants of a recorded variable.
        """
        return self._by_episode(self._many[name])

    def _by_episode(self, found: Any) -> Value:
        array = np.asarray(found)
        by_episode: Value = array[None] if self._one else np.moveaxis(array, 1, 0)
        return by_episode if self._places is None else by_episode[self._places]

    def __getitem__(self, place: Any) -> Any:
        """Return one of the episodes."""
        if self._one:
            return [self._many][place]
        many, unit = self._many, self.units[place]
        place = place if self._places is None else int(self._places[place])

        def own(of_all: Any) -> list[Any]:
            return [*np.array([one[place] for one in of_all])]

        found = Episode(many.twins, unit, vectors=own(many.vectors), taken=own(many.taken))
        found.values = {name: own(values) for name, values in many.values.items()}
        for step, compiled, statics in many.eras:
            if step not in self._acted or self._acted[step][place]:
                here = {name: values[place] for name, values in statics.items()}
                found.eras.append(Era(step, compiled, here))
        for step, audits in self._audits.items():
            for one in audits:
                if place in one:
                    found.audits[step] = one[place]
        found.remembers = not any(act.has_draw for _, act in unit.plan.acts())
        return found


Result = tuple[Sequence[int], EpisodeBatch | Exception]
"""Places of units, and their episodes, or the exception that stopped one of them."""


def is_known(unit: Unit) -> bool:
    """Return whether a unit can be in a batch: its actions are known beforehand."""
    return isinstance(as_policy(unit.policy), OpenLoopPolicy) and ALL not in unit.names


def run_together(
    batch: Batch, units: Sequence[Unit], twins: Twins | None = None
) -> Iterator[Result]:
    """Run units in the rows of a batch, which has at least as many worlds.

    They have equal instants, names that the batch computes, and one open-loop policy. Those that
    begin anew, and whose plans ask the same of every episode, act in all rows at once; any other
    acts in a world of its own, which is stepped with the others. A refusal stops its own unit only;
    a backend that loses a state stops all of them.
    """
    running = _Together(batch, units, twins)
    run(running, units[0].first, units[0].steps)
    return running.results()


@final
class _Together:
    """Units in the rows of a batch: first those that act together, last those with own worlds."""

    def __init__(self, batch: Batch, units: Sequence[Unit], twins: Twins | None) -> None:
        self._batch, self._twins = batch, twins
        self._first, self._steps = units[0].first, units[0].steps
        self._names, self._ends = units[0].names, units[0].ends
        first, n = batch.first, len(batch)
        self._errors: dict[int, Exception] = {}  # by row
        self._commands = np.zeros((self._steps, n, first.compiled.n_actions))
        asked = self._asked_of_all(units)
        self._shared = [i for i, one in enumerate(asked) if one is not None]
        self._rows: dict[int, tuple[int, Episode]] = {}  # the units with worlds of their own
        for place in (i for i, one in enumerate(asked) if one is None):
            row = n - 1 - len(self._rows)
            self._rows[row] = place, Episode._of(twins, units[place], batch._alone(row))
        self._mine = np.arange(n) < len(self._shared)
        self._goes_on = self._mine | np.isin(np.arange(n), [*self._rows])
        self._pending = np.zeros(n, dtype=np.bool_)  # of these: stepped, and not recorded
        if self._shared:
            self._begin([units[place] for place in self._shared], asked)
        for row in self._rows:
            self._alone(row, self._first)

    def _asked_of_all(self, units: Sequence[Unit]) -> list[dict[int, dict[str, Any]] | None]:
        """Return what each unit asks for, by instant; None of one with a world of its own."""
        first, policy, can = self._batch.first, units[0].policy, False
        with suppress(ScmWorldError):  # in a world of its own, each unit says what is wrong
            known: Any = as_policy(policy, first)
            if hasattr(known, "together") and self._batch.begins_alike():
                known.together(first, np.zeros((1, 2), dtype=np.uint64), 0, 1)
                can = True
        plans = {id(unit.plan): unit.plan for unit in units if can}
        asked = {key: plan._asked_of_all(first, self._steps) for key, plan in plans.items()}
        return [
            None
            if u.past is not None or u.start is not None or u.policy is not policy
            else asked.get(id(u.plan))
            for u in units
        ]

    def _begin(self, units: list[Unit], asked: Sequence[Any]) -> None:
        """Begin the episodes that act together, and get their actions."""
        batch, first, n = self._batch, self._batch.first, len(units)
        self._units = units
        plans: dict[int, tuple[Any, list[int]]] = {}
        for row, place in enumerate(self._shared):
            plans.setdefault(id(asked[place]), (asked[place], []))[1].append(row)
        self._asked = [(one, np.isin(np.arange(len(batch)), rows)) for one, rows in plans.values()]
        every = [units[min(row, n - 1)] for row in range(len(batch))]
        seeds, numbers = [unit.seed for unit in every], [unit.number for unit in every]
        batch.reset(seed=seeds, episode=numbers, where=self._mine)
        keys = [word_of(f"seed {seed}") for seed in seeds[:n]]
        policy: Any = as_policy(units[0].policy, first)
        noise = np.array([keys, numbers[:n]], dtype=np.uint64).T
        actions = policy.together(first, noise, 0, self._steps)
        low, high = first.compiled.action_bounds
        self._commands[:, :n] = np.moveaxis(np.clip(actions, low, high), 1, 0)
        many: Any = Episode(self._twins, units[0])  # its lists are arrays
        many.vectors = np.empty((self._steps + 1, n, first.compiled.state_size))
        many.taken = np.moveaxis(actions, 1, 0)
        self._many = many
        self._acted: dict[int, Mask] = {}
        self._audits: dict[int, list[Audits]] = {}
        self._act_together(0)

    def _act_together(self, step: int) -> None:
        """Apply the interventions of an instant in the rows that act together."""
        acted = self._mine & (step == 0)
        for request, rows in self._asked:
            where = rows & self._goes_on
            if step in request and where.any():
                audits = self._batch.do(request[step], where=where, on_refusal="skip")
                self._errors |= audits.refused
                self._goes_on[[*audits.refused]] = False
                self._audits.setdefault(step, []).append(audits)
                acted |= where
        if acted.any():
            table, n = self._table(), len(self._units)
            now = Rows(table.compiled, table.numbers[:n].copy())
            statics = {name: now[name] for name in table.compiled.static_names}
            self._many.eras.append(Era(step, table.compiled, statics))
            self._acted[step] = acted[:n]

    def _table(self) -> Rows:
        """Return the rows of those that act together, which keep the structure they begin with."""
        ((table, _),) = self._batch.by_structure(np.arange(len(self._units)))
        return table

    def _intervene(self, step: int) -> None:
        if self._shared:
            self._act_together(step)
        for row, (_, one) in self._rows.items():
            if self._goes_on[row] and one.plan._concerns(one.world, step, one.memory):
                self._alone(row, step)

    def _record(self, step: int) -> None:
        """Record an instant, if that was not done after an intervention."""
        if self._shared:
            table, many, n = self._table(), self._many, len(self._units)
            many.vectors[step] = table.numbers[:n, : table.compiled.state_size]
            if not (self._ends and 0 < step < self._steps):
                self._write(step, [name for name in self._names if name in table.compiled.model])
        for row, (_, one) in self._rows.items():
            if self._pending[row]:
                one._note(step, ready=True)

    def _write(self, step: int, names: Iterable[str]) -> None:
        """Write the present values of variables into the record of the rows that act together."""
        table, n = self._table(), len(self._units)
        instants, at = (2, min(step, 1)) if self._ends else (self._steps + 1, step)
        for name in names:
            now = table[name][:n]
            there = self._many.values.get(name)
            if there is None:
                there = np.empty((instants, *now.shape), now.dtype)
                self._many.values[name] = there
            there[at] = now

    def _act(self, step: int) -> None:
        if self._ends:  # nothing is computed for the instants between
            self._batch.names = self._names if step == self._steps - 1 else ()
        if self._goes_on.any():
            self._batch.advance(self._commands[step], self._goes_on)
        if self._shared:
            commanded = self._batch.first.compiled.commanded
            self._write(step, [name for name in self._many.values if name in commanded])
        for row, (_, one) in self._rows.items():
            if self._goes_on[row]:
                one._complete()
        self._pending[:] = self._goes_on

    def results(self) -> Iterator[Result]:
        """Yield the errors, in the order of the units, and then the episodes."""
        places = dict(enumerate(self._shared)) | {row: at for row, (at, _) in self._rows.items()}
        for row in sorted(self._errors, key=lambda row: places[row]):
            yield [places[row]], self._errors[row]
        for row, (place, one) in self._rows.items():
            if row not in self._errors:
                yield [place], EpisodeBatch.of(one._ended())
        kept = [row for row in range(len(self._shared)) if row not in self._errors]
        if kept:
            units = [self._units[row] for row in kept]
            which = None if len(kept) == len(self._shared) else np.array(kept)
            many = EpisodeBatch(units, self._many, self._acted, self._audits, which)
            yield [self._shared[row] for row in kept], many

    def _alone(self, row: int, step: int) -> None:
        """Begin or intervene in one world, record the instant, and get its further actions."""
        _, one = self._rows[row]
        self._pending[row] = False
        try:
            if step == self._first:
                one._begin()
            else:
                one._intervene(step)
            one._note(step)
            with blamed(lambda: who(one.policy, one.world)):
                given = one.policy.ahead(one.world, one.world.index, self._steps - step)
            for command, action in zip(self._commands[step:, row], given, strict=True):
                command[:] = one.world.compiled.clipped(action)
            one.taken[step:] = np.array(given)
        except Exception as error:  # ends this unit only
            self._errors[row] = error
            self._goes_on[row] = False
