"""Our own worlds and vector environments, as ``check`` asks them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, final

import numpy as np

from scm_world._types import ArrayLike, Floats, Mask, Value
from scm_world.env.answers import TARGETS, at
from scm_world.env.batch import ScmWorldVectorEnv
from scm_world.errors import UnknownOption
from scm_world.variables import Draw
from scm_world.variables.distributions import Distribution
from scm_world.world.simulation import READ_BACK


@final
class OurWorlds:
    """Our worlds: values are set by ``do``."""

    by = "set"

    def __init__(self, envs: Any) -> None:
        self.envs, self.is_env = envs, isinstance(envs, ScmWorldVectorEnv)
        self.one: Any = envs.envs[0].unwrapped.world if self.is_env else envs.one
        self.model, self.num_envs = self.one.model, envs.num_envs if self.is_env else len(envs)
        has_engine = self.one.backend is not None
        columns = [v for v in self.model.variables if v.name != "control_index"]
        columns = [v for v in columns if (v.is_simulated if has_engine else v.equation is not None)]
        self.read = [v.name for v in columns]
        self.has_steps, space = self.one.has_steps, self.one.action_space
        self.low, self.high = self.one.action_low, self.one.action_high
        if self.is_env:
            space = envs.single_action_space
            self.low, self.high = space.low, space.high
        self.n_actions = self.low.size
        task = getattr(self.one, "task", None)
        self.title = f"{task.name if task else 'equations'} on {self.one.engine.partition(' ')[0]}"

    def _world(self, index: int) -> Any:
        return self.envs.envs[index].unwrapped.world if self.is_env else self.envs.world(index)

    def usual(self) -> dict[str, Distribution]:
        """Return the spaces A of all variables that can be set and vary there."""
        inside = {v.name: v.a for v in self.model.variables if v.settable and v.a is not None}
        inside = {name: one for name, one in inside.items() if self.model[name].role != "action"}
        return {n: one for n, one in inside.items() if len(set(self._ends(n, one))) > 1}

    def _ends(self, name: str, space: Distribution) -> Iterator[bytes]:
        shape, values = self.model[name].shape, self.values() if space.parents() else {}
        for u in TARGETS:
            yield at(space, u, shape, values).tobytes()

    def named(self, ranges: Mapping[str, Any]) -> dict[str, Any]:
        """Return ranges by the names of variables, which patterns stand for: no actions."""
        names = {given: [*self.model.named({given: 0.0})] for given in ranges}
        found = {name: one for given, one in ranges.items() for name in names[given]}
        for name in [name for name in found if self.model[name].role == "action"]:
            if name in ranges:
                raise UnknownOption("range", name, ("a variable that is no action",))
            del found[name]
        return found

    def space(self, name: str, act: Draw) -> Any:
        """Return the space of a draw."""
        return act.distribution(self.model.declared(name))

    def target(self, name: str) -> str:
        """Return the variable that is set: coordinates set a pose."""
        target: str = self.model.target(name)
        return target

    def values(self) -> Mapping[str, Value]:
        """Return the present values of world 0."""
        found: Mapping[str, Value] = self._world(0).evaluate()
        return found

    def _read(self, name: str) -> Floats:
        """Return a variable of all worlds, shape (n, …); NaN where bodies are absent."""
        if self.one.backend is None:
            return np.array(self.envs[name], dtype=np.float64)
        worlds = [self._world(index) for index in range(self.num_envs)]
        there = [name in world.model for world in worlds]
        if all(there) and not self.is_env:
            return np.array(self.envs[name], dtype=np.float64)
        absent = np.full(self.model[name].shape, np.nan)
        each = zip(worlds, there, strict=True)
        return np.array([w[name] if has else absent for w, has in each], dtype=np.float64)

    def get(self, name: str) -> Floats:
        """Return what worlds have, or what their engine has if that is something else."""
        found = self._read(name)
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
        low, high = np.maximum(self.low, -1e3), np.minimum(self.high, 1e3)
        commands = low + (actions + 1.0) / 2.0 * (high - low)
        found = self.envs.step(commands)
        return None if found is None else found[2] | found[3]

    def observe(self) -> Floats:
        """Return all numbers that the engine, or the equations, compute."""
        parts = [self._read(name).reshape(self.num_envs, -1) for name in self.read]
        return np.concatenate(parts, axis=1)

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

    def why(self, name: str) -> str:
        """Return why no response is declared, or nothing."""
        targets = self.model.targets(name)
        below = {*targets}.union(*map(self.model.descendants, targets))
        if not (below - {name}) & {*self.read}:
            return "as it is declared, nothing that the engine computes depends on it"
        return ""

    def untouched(self, name: str) -> str:
        """Return why no response was seen of what acts in contacts alone, or nothing."""
        here = {*self.read}
        edges = [edge for edge in self.model.edges if edge.cause == name and edge.effect in here]
        if edges and all(edge.when == "contact" for edge in edges):
            return "it acts in contacts, and on none of this run"  # such as a box that rests
        return ""

    def stale(self, name: str) -> dict[str, float] | None:
        """Return derived constants that are not those of a fresh compilation; None without any."""
        del name
        realization = getattr(self._world(0).backend, "realization", None)
        if realization is None:
            return None
        from scm_world.backends.mujoco.adapters import stale

        return stale(realization.model)
