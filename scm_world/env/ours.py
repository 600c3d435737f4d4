"""Our own worlds and vector environments, as ``check`` asks them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, final

import numpy as np

from scm_world._types import ArrayLike, Floats, Mask, Value
from scm_world.backends.checkable import Checkable, commands
from scm_world.env.answers import TARGETS, at
from scm_world.env.batch import ScmWorldVectorEnv
from scm_world.errors import UnknownOption
from scm_world.queries.experiments.paired import coupling
from scm_world.variables import Draw, Scale, Shift
from scm_world.variables.distributions import Distribution
from scm_world.world.simulation import READ_BACK


@final
class OurWorlds(Checkable):
    """Our worlds: values are set by ``do``."""

    given = True  # whether somebody declared ranges

    def __init__(self, envs: Any) -> None:
        self.envs, self.is_env = envs, isinstance(envs, ScmWorldVectorEnv)
        self.one: Any = envs.envs[0].unwrapped.world if self.is_env else envs.one
        self.model, self.num_envs = self.one.model, envs.num_envs if self.is_env else len(envs)
        has_engine = self.one.backend is not None
        columns = [v for v in self.model.variables if v.name != "control_index"]
        columns = [v for v in columns if (v.is_simulated if has_engine else v.equation is not None)]
        self.read = [v.name for v in columns]
        self.steps = self.one.has_steps
        self.low, self.high = self.one.action_low, self.one.action_high
        if self.is_env:
            self.low, self.high = envs.single_action_space.low, envs.single_action_space.high
        self.n_actions = self.low.size
        task = getattr(self.one, "task", None)
        self.title = f"{task.name if task else 'equations'} on {self.one.engine.partition(' ')[0]}"

    def _world(self, index: int) -> Any:
        return self.envs.envs[index].unwrapped.world if self.is_env else self.envs.world(index)

    def declared(self, ranges: Mapping[str, Any] | None) -> dict[str, Any]:
        """Return ranges by the names of variables, which patterns stand for: no actions.

        If there are none, the spaces A of all variables that can be set and vary there.
        """
        model = self.model
        self.given = ranges is not None
        if ranges is None:
            usual = {v.name: v.a for v in model.variables if v.settable and v.role != "action"}
            return {
                n: a for n, a in usual.items() if a is not None and len({*self._tried(n, a)}) > 1
            }
        found = {}
        for given, one in ranges.items():
            for name in model.named({given: 0.0}):
                if model[name].role != "action":
                    found[name] = self._space(name, one)
                elif name in ranges:
                    raise UnknownOption("range", name, ("a variable that is no action",))
        return found

    def _space(self, name: str, given: Any) -> Any:
        """Return a range in which draws have a space in place of the name of a space."""
        relative = isinstance(given, Scale | Shift)
        act = given.by if relative else given
        if not isinstance(act, Draw):
            return given
        act = Draw(act.distribution(self.model.declared(name)))
        return type(given)(act) if relative else act

    def _tried(self, name: str, space: Distribution) -> Iterator[bytes]:
        shape, values = self.model[name].shape, self.values(0) if space.parents() else {}
        for u in TARGETS:
            yield at(space, u, shape, values).tobytes()

    def target(self, name: str) -> str:
        """Return the variable that is set: coordinates set a pose."""
        target: str = self.model.target(name)
        return target

    def values(self, world: int) -> Mapping[str, Value]:
        """Return the present values of one world."""
        found: Mapping[str, Value] = self._world(world).evaluate()
        return found

    def _read(self, names: Sequence[str]) -> list[Floats]:
        """Return variables of all worlds, each of shape (n, …); NaN where bodies are absent."""
        if not self.is_env:
            has_engine = self.one.backend is not None
            tables = map(self.envs.table, range(self.num_envs)) if has_engine else ()
            models = {id(table): table.compiled.model for table in tables}.values()
            if all(name in model for model in models for name in names):
                return [np.array(self.envs[name], dtype=np.float64) for name in names]
        worlds = [self._world(index) for index in range(self.num_envs)]
        absent = {name: np.full(self.model[name].shape, np.nan) for name in names}
        return [
            np.array([w[n] if n in w.model else absent[n] for w in worlds], dtype=np.float64)
            for n in names
        ]

    def get(self, name: str) -> Floats:
        """Return what worlds have, or what their engine has if that is something else."""
        (found,) = self._read([name])
        keys = getattr(getattr(self.one, "compiled", None), "parameter_keys", {})
        if self.one.backend is not None and name in keys:
            there = ~np.isnan(found).reshape(self.num_envs, -1).any(axis=1)
            for index in np.flatnonzero(there).tolist():
                engine = self._world(index).backend.parameters([keys[name]])[keys[name]]
                if not np.allclose(engine, found[index], READ_BACK, READ_BACK):
                    found[index] = engine
        return found

    def set(self, name: str, values: Floats, mask: Mask) -> None:
        """Intervene in some worlds."""
        kind = np.float64 if self.model[name].dtype == "real" else np.int64
        each = np.asarray(values).astype(kind)
        for index in np.flatnonzero(mask).tolist():
            if self.is_env:
                self.envs.do({index: {name: each[index]}})
            else:
                self.envs.do({name: each[index]}, where=np.arange(self.num_envs) == index)

    def reset(self, seed: int, mask: Mask) -> None:
        """Begin episodes in some worlds."""
        seeds = [*range(seed, seed + self.num_envs)]
        if self.is_env:
            self.envs.reset(seed=seeds, options={"reset_mask": mask})
        else:
            self.envs.reset(seed=seeds, where=mask)

    def step(self, actions: Floats) -> ArrayLike | None:
        """Advance all worlds."""
        found = self.envs.step(commands(actions, self.low, self.high))
        return None if found is None else found[2] | found[3]

    def observe(self) -> Floats:
        """Return all numbers that the engine, or the equations, compute."""
        parts = self._read(self.read)
        return np.concatenate([part.reshape(self.num_envs, -1) for part in parts], axis=1)

    def columns(self) -> list[tuple[str, str]]:
        """Return names and units of these numbers."""
        found = []
        for name in self.read:
            shape = self.model[name].shape
            places = [f"[{i}]" for i in range(int(np.prod(shape)))] if shape else [""]
            found += [(f"{name}{place}", self.unit(name)) for place in places]
        return found

    def unit(self, name: str) -> str:
        """Return the unit of a variable."""
        unit = self.model[name].unit
        return "" if unit == "1" else unit

    def rounding(self) -> ArrayLike:
        """Return how far bodies that do not touch move each number, by its value or one."""
        world = self._world(0)
        found = coupling(world, self.read) if world.backend is not None else {}
        sizes = [int(np.prod(self.model[name].shape)) for name in self.read]
        return np.repeat([found.get(name, 0.0) for name in self.read], sizes)

    def idle(self, name: str, *, ran: bool) -> str:
        """Return why no response is declared, or was seen of what acts in contacts alone."""
        here, targets = {*self.read}, self.model.targets(name)
        below = {*targets}.union(*map(self.model.descendants, targets))
        if not (below - {name}) & here:
            return "as it is declared, nothing that the engine computes depends on it"
        edges = [edge for edge in self.model.edges if edge.cause == name and edge.effect in here]
        if ran and edges and all(edge.when == "contact" for edge in edges):
            return "it acts in contacts, and on none of this run"  # such as a box that rests
        children = [child for child in self.model.children(name) if child not in here]
        if ran and not self.given and not edges and self._same(name, children):
            return f"nothing that follows from it changes here: {', '.join(children)}"
        return ""

    def _same(self, name: str, children: Sequence[str]) -> bool:
        """Return whether mechanisms give what follows from a variable the same values anyway."""
        now, space = self.values(0), self.model[name].a
        known = {n: v for n, v in now.items() if n not in children}
        for u in TARGETS if space else ():
            known[name] = at(space, u, self.model[name].shape, now)
            found = self.model.solve(known, only=children)
            if any(not np.array_equal(found[child], now[child]) for child in children):
                return False
        return bool(children)

    def stale(self, name: str) -> dict[str, float] | None:
        """Return derived constants that are not those of a fresh compilation; None without any."""
        del name
        found: dict[str, float] = {}
        for index in range(self.num_envs):
            realization = getattr(self._world(index).backend, "realization", None)
            if realization is None:
                return None
            from scm_world.backends.mujoco.adapters import stale

            found = stale(realization.model) | found
        return found
