"""Rows read off the episodes of a world, of equations, or through a laboratory."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import groupby
from typing import Any, final

import numpy as np

from scm_world._arguments import typed
from scm_world._fingerprint import fingerprint
from scm_world._types import Floats
from scm_world.discovery.data.dataset import Column, Dataset, Regime, Row, columns_of
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.pictures import Pictures
from scm_world.discovery.data.pictures import Row as Picture
from scm_world.discovery.data.recorded import (
    columns_of_outcome,
    default_causes,
    default_outcomes,
    is_state,
    labelled,
    reached,
    settable,
)
from scm_world.discovery.data.sources import FORMAT, SourceRows, Tell
from scm_world.discovery.data.truth import (
    truth_of_episodes,
    truth_of_model,
    truth_of_steps,
)
from scm_world.env.observer import published
from scm_world.env.vector import WIDE, bounds, spread
from scm_world.errors import Forbidden, InterventionError, ModelError, UnknownOption
from scm_world.graph.structure import Edge
from scm_world.policies.scripted import Sequence as Given
from scm_world.queries.episodes import Episode, Unit
from scm_world.queries.equations import Equations, System
from scm_world.queries.experiments.versions import versions
from scm_world.queries.laboratory import Laboratory
from scm_world.queries.local import contact_terms
from scm_world.queries.outcomes import Outcome, as_outcomes
from scm_world.queries.plans import Plan
from scm_world.queries.samples import Setting
from scm_world.queries.twins import Result, Twins
from scm_world.variables import Noise, Normal
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.world import Simulation
from scm_world.world.interventions import merged

STREAM = "sensor of"
"""Begins the names of the streams; draws of ``sensor_noise`` itself have another one."""

NORMAL = Normal()


@typed
@final
class WorldSource:
    """Episodes of a world or of equations, under a design.

    A row is an episode: causes as they are at its beginning, and outcomes. With ``every_step`` it
    is a control step: everything as it is when the action is chosen, and the action. Sensors have
    noise with the standard deviation ``sensor_noise``, as a fraction of half the range of a number,
    as in the observations of the environment. It reaches real states and readouts that have
    bounds: no parameters, no actions, no counts.

    Args:
        twins: Where the episodes are run; see ``asked``.
        world: Is not touched; what is given to it holds in every episode.
        design: What is done at the beginning.
        causes: Patterns of the parameters to write down; ``default_causes`` if None. The targets
            of the design are among them.
        outcomes: Names of variables or ``Outcome``; ``default_outcomes`` if None.
        every_step: One row for each control step in place of one for each episode.
        setting: Who acts, what varies by itself, how long, and the seed.
        pictures: To take at each control step, or at the beginning and at the end; none if None.
        contacts: Whether to record which bodies touch.

    Raises:
        InterventionError: A target, or what varies, cannot be set to its values.
        UnknownVariable: No variable has this name.
        UnknownOption: An outcome is a function, sums up an episode with ``every_step``, or is
            written down as a cause already; or there is no such camera.
    """

    at_once = False
    uneven = False

    def __init__(
        self,
        twins: Twins,
        world: System,
        design: Design,
        *,
        causes: Iterable[str] | None,
        outcomes: Iterable[Any] | None,
        every_step: bool,
        setting: Setting,
        pictures: Pictures | None = None,
        contacts: bool = False,
    ) -> None:
        self._pictures, self._contacts = pictures, contacts and isinstance(world, Simulation)
        if pictures is not None:
            with twins.twin() as twin:  # a camera that does not exist is refused now
                seen: Any = twin
                seen.reset(seed=setting.seed)
                pictures.take(seen.scene(), seen.cameras())
        self._world, self._twins, self._design = world, twins, design
        self._setting, self._given = setting, getattr(world, "plan", Plan())
        self._every_step, model = every_step, world.model
        for name, act in (*design.acts.items(), *Plan(setting.nature).acts()):
            model.accept(name, act)
        chosen = default_causes(world) if causes is None else settable(world, causes)
        varied = tuple(dict.fromkeys((*chosen, *design.targets)))
        if outcomes is None:
            usual = default_outcomes(world, every_step=every_step)
            outcomes = [o for o in usual if is_state(model, o.name) or o.name not in varied]
        measured = _outcomes(outcomes, every_step=every_step)
        self._actions = {*world.compiled.commanded}
        actions = tuple(world.compiled.actions) if every_step else ()
        self._watched = tuple(dict.fromkeys((*varied, *(o.name for o in measured), *actions)))
        # At an instant a system still has the action of the step before.
        starts = (Outcome(n, "final" if n in self._actions else "first") for n in varied)
        self._read = (*starts, *measured)
        if every_step:
            parts = [columns_of(model.declared(name)) for name in self._watched]
        else:
            parts = [
                *(labelled(columns_of(model.declared(n), "first"), "first" * is_state(model, n))
                  for n in varied),
                *(columns_of_outcome(model.declared(o.name), o) for o in measured),
            ]  # fmt: skip
        self.columns: tuple[Column, ...] = tuple(column for part in parts for column in part)
        there = [column.name for column in self.columns]
        twice = sorted({name for name in there if there.count(name) > 1})
        if twice:  # before episodes are run for them
            allowed = ("what is no cause: those have a column already",)
            raise UnknownOption("outcomes", ", ".join(twice), allowed)
        self._half: dict[str, Floats] = {}
        if isinstance(world, Simulation) and SENSOR_NOISE in model:
            self._half = {name: half_range(world, name) for name in self._watched}
        self.edges: tuple[Edge, ...] | None = model.edges
        self.about: dict[str, Any] = {
            "format": FORMAT,
            **_system(world, twins),
            "fingerprint": fingerprint(
                {
                    **(world.model if isinstance(world, Equations) else world).__fingerprint__(),
                    "policy": setting.policy,
                    "given": list(self._given.acts()),
                    "nature": list(Plan(setting.nature).acts()),
                    "design": design.acts,
                }
            ),
            "given": self._given.as_dict()["do"],
            "seed": setting.seed,
            "steps": setting.steps,
            "policy": policy_name(setting.policy),
            "nature": Plan(setting.nature).as_dict()["do"],
            "design": design.as_dict(),
            "engine": "equations" if isinstance(world, Equations) else world.backend.name,
            **({} if pictures is None else {"pictures": asdict(pictures)}),
            **({"contacts": "steps" if every_step else "episodes"} if self._contacts else {}),
            "truth": self._truth(varied, measured),
            "versions": versions("" if isinstance(world, Equations) else world.engine),
        }

    def _truth(self, varied: Sequence[str], measured: Sequence[Outcome]) -> dict[str, Any] | None:
        """Write the graph over the columns; None where nature acts later than at the beginning."""
        world, model = self._world, self._world.model
        if isinstance(world, Equations) and (self._every_step or not model.is_temporal):
            return truth_of_model(model)
        terms: Any = (
            contact_terms(world) if self._contacts and isinstance(world, Simulation) else {}
        )
        if self._every_step:
            bundles = getattr(world.compiled, "bundles", {})
            return truth_of_steps(model, self._watched, bundles, terms)
        labels = {o: columns_of_outcome(model.declared(o.name), o)[0].variable for o in measured}
        nature = merged(model, self._given, Plan(self._setting.nature))
        try:
            return truth_of_episodes(model, nature, varied, measured, labels, terms)
        except ModelError:
            return None

    def __getstate__(self) -> dict[str, Any]:
        """Go elsewhere, where workers share the cores: an engine has one thread there."""
        setting = replace(self._setting, workers=self._setting.workers or 1)
        return {**self.__dict__, "_setting": setting}

    def part(self, numbers: range, tell: Tell) -> SourceRows:
        """Run some episodes; those that are refused are left out."""
        chosen = self._design.chosen(self._setting.seed, numbers.start, len(numbers))
        regimes = [self._design.regime_of(kind) for kind in chosen]

        seen: dict[int, list[Picture]] = {}
        touching: dict[int, Any] = {}

        def finish(place: int, result: Result) -> Floats | str:
            if isinstance(result, Exception) and not isinstance(result, InterventionError):
                raise result
            found: Floats | str
            if isinstance(result, Exception):
                found = str(result)
            else:
                found = self._row(result)
                if self._contacts:
                    touching[numbers[place]] = _runs(result.touched)
                if self._pictures is not None:
                    seen[place] = self._look(self._pictures, result)
            tell(1)
            return found

        kept = {*self._world.compiled.slices, *self._world.static_names}
        written = tuple(name for name in self._watched if name not in kept)
        units: list[Unit] = []
        for number, done in zip(numbers, regimes, strict=True):
            given = Plan(merged(self._world.model, self._given, done.plan))
            unit = self._setting.unit(self._world, given, number, written)
            units.append(replace(unit, listens=self._contacts))
        found = self._twins.run(units, finish, self._setting.workers)
        rows: list[Row] = []
        refused: list[tuple[int, str]] = []
        for number, done, values in zip(numbers, regimes, found, strict=True):
            if isinstance(values, str):
                refused.append((number, values))
                continue
            for step, row in enumerate(values):
                named = replace(done, targets=self._targets(done.targets, step))
                rows.append((number, step, named, row))
        table = Dataset.stacked(self.columns, rows, self.about)
        shots = [shot for place in sorted(seen) for shot in seen[place]]
        keys = [f"{shot['episode']:08d}-{shot['step']:06d}" for shot in shots]
        pictures = b"" if self._pictures is None else self._pictures.encoded(shots, keys)
        touched = {str(number): touching[number] for number in sorted(touching)}
        return SourceRows(table, tuple(refused), pictures, touched)

    def _look(self, pictures: Pictures, episode: Episode) -> list[Picture]:
        """Take the pictures of an episode, one row of them for each of its rows."""
        if self._every_step:
            return [
                {"episode": episode.number, "step": t, **pictures.take(*episode.scene(t))}
                for t in range(episode.steps)
            ]
        first = pictures.take(*episode.scene(0), "first_image")
        return [
            {"episode": episode.number, "step": 0, **first}
            | pictures.take(*episode.scene(episode.steps))
        ]

    def _targets(self, names: Iterable[str], step: int) -> tuple[str, ...]:
        """Name the columns' variables that are set in a row; a state is at the first step only."""
        model, whole = self._world.model, not self._every_step
        there = reached(model, names, self.columns, first=whole)
        return tuple(n for n in there if whole or step == 0 or not is_state(model, n))

    def _row(self, episode: Episode) -> Floats:
        """Read an episode, shape (rows, p)."""
        last = episode.steps
        if self._every_step:
            parts = [
                np.asarray(episode[name], float)[1:]
                if name in self._actions
                else self._sensed(episode, name, range(last + 1))[:-1]
                for name in self._watched
            ]
            return np.concatenate([part.reshape(last, -1) for part in parts], axis=1)
        ends = {"final": (last,), "first": (0,), "change": (0, last)}
        values = []
        for outcome in self._read:
            steps = ends.get(outcome.how, range(1, last + 1))
            seen: Any = {outcome.name: self._sensed(episode, outcome.name, steps)}
            values.append(outcome.of(seen))
            if not np.isfinite(values[-1]).all():
                raise UnknownOption(f"value of {outcome}", values[-1], ("finite numbers",))
        return np.concatenate([np.ravel(value) for value in values])[None]

    def _sensed(self, episode: Episode, name: str, steps: Iterable[int]) -> Floats:
        """Read a variable at every instant, with sensor noise at some instants."""
        values, half = np.array(episode[name], dtype=np.float64), self._half.get(name)
        if half is None or not half.any() or not np.any(episode[SENSOR_NOISE]):
            return values
        noise, strength = Noise(episode.seed), episode[SENSOR_NOISE]
        stream, shape = f"{STREAM} {name}", values.shape[1:]
        for step in steps:
            drawn = noise.draw(NORMAL, stream, shape, {}, episode=episode.number, step=step)
            values[step] += float(strength[step]) * half.reshape(shape) * drawn[0]
        return values


def _runs(steps: Sequence[frozenset[tuple[str, str]]]) -> dict[str, Any]:
    """Write what touched in each control step.

    Example:
        >>> _runs([frozenset({("a", "b")}), frozenset({("a", "b")}), frozenset()])
        {'pairs': [['a', 'b']], 'runs': [[2, [0]], [1, []]]}
    """
    pairs = sorted(frozenset[tuple[str, str]]().union(*steps))
    runs = [
        [len([*same]), [pairs.index(p) for p in sorted(which)]] for which, same in groupby(steps)
    ]
    return {"pairs": [list(pair) for pair in pairs], "runs": runs}


def _system(world: System, twins: Twins) -> dict[str, Any]:
    if twins.model is not None:
        return {"system": "model"}
    return {"system": twins.task.name, "options": plain_options(twins.options)}


def half_range(world: Simulation, name: str) -> Floats:
    """Give half the range of each number of a variable that a sensor measures, shape (k,).

    It is that of the environment's observations. 0 where there is none, or no sensor.
    """
    variable = world.model.declared(name)
    if variable.role not in ("state", "readout") or variable.dtype != "real":
        return np.zeros(int(np.prod(variable.shape)))
    low, high = bounds(world.model, name)
    observed = published(world, world.compiled).get(name)
    if observed is not None and observed.low is not None:
        low, high = spread(observed.low, variable.shape), spread(observed.high, variable.shape)
    return np.where((low > -WIDE) & (high < WIDE), (high - low) / 2.0, 0.0)


def _outcomes(given: Iterable[Any], *, every_step: bool) -> tuple[Outcome, ...]:
    found = tuple(dict.fromkeys(as_outcomes(given)))
    for outcome in found:
        if not isinstance(outcome, Outcome):
            allowed = ("the name of a variable", "Outcome(name, how)")
            raise UnknownOption("outcome of a dataset", outcome, allowed)
        if every_step and outcome != Outcome(outcome.name):
            names = ("names of variables with every_step=True",)
            raise UnknownOption("outcome", str(outcome), names)
    return found


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Name the engine of a world among its options, where it was given as an object."""
    backend = options["backend"]
    name = backend if isinstance(backend, str) else type(backend).__qualname__
    return {**options, "backend": name}


def policy_name(policy: Any) -> str:
    """Name who acts, the same way in every process.

    Example:
        >>> policy_name("random"), policy_name(None), policy_name(len)
        ('random', 'still', 'builtins:len')
    """
    if policy is None:
        return "still"
    if isinstance(policy, str):
        return policy
    if hasattr(policy, "__qualname__"):
        return f"{policy.__module__}:{policy.__qualname__}"
    if callable(policy):
        kind = type(policy)
        text = repr(policy) if hasattr(kind, "__dataclass_fields__") else ""
        return f"{kind.__module__}:{text or kind.__qualname__}"
    actions = Given(policy).actions
    digest = hashlib.sha256(np.ascontiguousarray(actions).tobytes()).hexdigest()
    return f"actions of shape {actions.shape}, sha256 {digest}"


# --- through a laboratory -------------------------------------------------------------------------


@final
class Experiments:
    """Experiments of one episode each, through ``see`` and ``do`` of a laboratory.

    Its permissions and its budget hold, and its errors are raised. A row has its outcomes as it
    reports them; its number of the unit is the number of the episode.

    Args:
        laboratory: Says who acts, what varies, and what is measured.
        design: What is done.
        n: How many experiments there will be.
        seed: Of what the design draws by lot.

    Raises:
        Forbidden: Fewer episodes are left.
    """

    at_once = False
    uneven = False
    edges: tuple[Edge, ...] | None = None

    def __init__(self, laboratory: Laboratory, design: Design, n: int, *, seed: int) -> None:
        left = laboratory.remaining
        if left is not None and n > left:
            raise Forbidden(f"run {n} more episodes", [f"{left} episodes"])
        self._laboratory, self._design, self._seed = laboratory, design, seed
        # For units and shapes only; it is private, since it would show the graph.
        self._model = laboratory._world.model
        declared = self._model.declared
        self.columns: tuple[Column, ...] = tuple(
            c for o in laboratory.outcomes for c in columns_of_outcome(declared(o.name), o)
        )
        terms = laboratory.terms()
        self.about: dict[str, Any] = {
            "format": FORMAT,
            "system": "laboratory",
            "terms": {**terms, "options": plain_options(terms["options"])},
            "seed": seed,
            "design": design.as_dict(),
        }

    def part(self, numbers: range, tell: Tell) -> SourceRows:
        """Carry out some experiments; those that are refused cost their episode."""
        rows: list[Row] = []
        refused: list[tuple[int, str]] = []
        for number in numbers:
            regime = self._design.regime(number, seed=self._seed)
            try:
                found = (
                    self._laboratory.do(regime.plan) if regime.targets else self._laboratory.see(1)
                )
            except InterventionError as problem:
                refused.append((number, str(problem)))
            else:
                row = np.concatenate([np.ravel(values) for values in found.values()])
                rows.append((found.numbers[0], 0, self._named(regime), row))
            tell(1)
        return SourceRows(Dataset.stacked(self.columns, rows, self.about), tuple(refused))

    def _named(self, regime: Regime) -> Regime:
        names = reached(self._model, regime.targets, self.columns, first=True)
        return replace(regime, targets=names)
