"""The values of many worlds as columns of a tensor, and their mechanisms on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any, final

import numpy as np

from scm_world._arguments import load
from scm_world._types import Integers
from scm_world.geometry.tracing import Expressions, Symbol, Trace, Untraceable
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.kernels import run
from scm_world.world.mechanisms import PythonStep, Rows, Step, places, program_of


@final
class TensorRows:
    """The rows of all worlds of one structure, as columns on a device.

    What can be traced is computed there; a mechanism that cannot is computed on the host, by the
    same compiled function as ever, for which its inputs are copied, and its result back.

    Args:
        rows: The rows on the host, of which every column is up to date.
        names: Variables to compute.
        device: Of torch.
        copies: Counts bytes that are copied.

    Attributes:
        table: The values, shape (width, n), 64-bit.
        on_host: The variables that are computed on the host.
    """

    def __init__(self, rows: Rows, names: Iterable[str], device: str, copies: Counter[str]) -> None:
        torch = load("torch", "torch", "train")
        self._torch, self._rows, self._device = torch, rows, device
        self.table = torch.as_tensor(rows.numbers.T.copy(), device=device)
        self._copies = copies
        compiled = rows.compiled
        self._parts, self.on_host = _parts(compiled, names, torch)
        memory = compiled.stepped[2:]
        self._now, self._before = (torch.as_tensor(m, device=device) for m in memory.T.copy())
        self._all = np.arange(self.table.shape[1])

    def evaluate(self) -> None:
        """Compute the variables in all worlds."""
        for part in self._parts:
            if isinstance(part, Expressions):
                part(self.table)
            else:
                self._on_host(*part)

    def _on_host(self, inputs: Integers, program: list[Any], outputs: Integers) -> None:
        numbers = self._rows.numbers
        given = self.table[inputs].cpu().numpy()
        numbers[:, inputs] = given.T
        for step in program:
            if isinstance(step, np.ndarray):
                run(numbers, self._all, step)
            else:
                step(numbers, self._all)
        found = np.ascontiguousarray(numbers[:, outputs].T)
        self.table[outputs] = self._torch.as_tensor(found, device=self._device)
        self._copies["mechanisms to the host"] += given.nbytes
        self._copies["mechanisms to the device"] += found.nbytes

    def begin_step(self, commands: Any) -> None:
        """Begin a control step: remember, take commands, shape (n_actions, n), move the clock."""
        compiled = self._rows.compiled
        self.table[self._before] = self.table[self._now]
        self.table[compiled.action_columns] = commands
        self.table[compiled.clock] += 1.0

    def to_host(self, which: Integers) -> None:
        """Write the values of some worlds into the rows on the host."""
        found = self.table[:, which].cpu().numpy()
        self._rows.numbers[which] = found.T
        self._copies["episodes to the host"] += found.nbytes

    def to_device(self, which: Integers) -> None:
        """Read the values of some worlds from the rows on the host."""
        found = np.ascontiguousarray(self._rows.numbers[which].T)
        self.table[:, which] = self._torch.as_tensor(found, device=self._device)
        self._copies["episodes to the device"] += found.nbytes


def _parts(compiled: CompiledTask, names: Iterable[str], torch: Any) -> tuple[list[Any], list[str]]:
    """Split a program into expressions, and what is computed on the host; name the latter.

    That is described by the columns that it reads and that move, by a program of ``Rows``, and by
    the columns that it writes.
    """
    parts: list[Any] = []
    on_host: list[str] = []
    constants, static = compiled.constants, [compiled.where[n] for n in compiled.static_names]
    trace, now = Trace(), dict[int, Any](constants)

    def written(values: dict[int, Any]) -> Expressions:
        return Expressions(trace, {n: v for n, v in values.items() if n not in constants}, torch)

    for name in compiled.needed(names):
        steps, then = compiled.steps_of(name), dict(now)
        try:
            for step in steps:
                _trace(step, trace, now)
        except Untraceable:
            on_host.append(name)
            parts.append(written(then))
            trace, now = Trace(), dict(constants)
            both = zip(*map(_touched, steps), strict=True)
            reads, writes = (np.concatenate(side) for side in both)
            moving = np.setdiff1d(reads, [*constants, *places(static), *writes])
            parts.append((moving, program_of(steps), places([compiled.where[name]])))
    parts.append(written(now))
    return parts, on_host


def _trace(step: Step, trace: Trace, now: dict[int, Any]) -> None:
    """Trace a step of a program; ``now`` has what columns are, if it is known, and is changed."""
    if isinstance(step, PythonStep):
        raise Untraceable("it is not compiled")

    def read(start: int, stop: int) -> Any:
        values = [now[at] if at in now else trace.column(at) for at in range(start, stop)]
        symbolic = any(isinstance(one, Symbol) for one in values)
        found = np.empty(len(values), dtype=object if symbolic else float)
        found[:] = values
        return found

    if step.addresses == (0, 0):
        now.update({to: read(at, at + 1)[0] for at, to in step.where.tolist()})
        return
    *inputs, (first, last) = step.where.tolist()
    given = [read(*place) for place in inputs]
    kinds = step.vectors[:-1]
    arguments = [one if is_vector else one[0] for one, is_vector in zip(given, kinds, strict=True)]
    found = np.asarray(trace.call(step.function, arguments), dtype=object).reshape(-1)
    if len(found) != last - first:
        raise Untraceable("it gives a vector of another length")
    now.update(zip(range(first, last), found, strict=True))


def _touched(step: Step) -> tuple[Integers, Integers]:
    """List the columns that a step reads, and those that it writes."""
    if isinstance(step, PythonStep):
        return places(step.reads), places([step.writes])
    if step.addresses == (0, 0):
        return step.where[:, 0], step.where[:, 1]
    ranges = [slice(*place) for place in step.where.tolist()]
    return places(ranges[:-1]), places(ranges[-1:])
