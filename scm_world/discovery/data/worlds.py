"""Rows of episodes of a world, of equations, or of a causal model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import repeat
from typing import Any, final

import numpy as np

from scm_world._arguments import true_or_false
from scm_world._fingerprint import fingerprint
from scm_world._types import Floats
from scm_world.discovery.data.dataset import CHOSEN, Dataset, EpisodePart, Regime
from scm_world.discovery.data.designs import Design, Grid
from scm_world.discovery.data.pictures import Pictures, encoded_pictures
from scm_world.discovery.data.pictures import Row as Picture
from scm_world.discovery.data.recorded import (
    columns_of,
    columns_of_outcome,
    default_causes,
    default_outcomes,
    is_state,
    reached,
    settable,
)
from scm_world.discovery.data.truth import truth_of_episodes, truth_of_model, truth_of_steps
from scm_world.env.observer import published
from scm_world.env.vector import WIDE, bounds, spread
from scm_world.errors import InterventionError, UnknownOption
from scm_world.graph import SCM
from scm_world.queries.episodes import Episode, Unit
from scm_world.queries.experiments.given import EVERYTHING, Present, may_be_absent, present
from scm_world.queries.experiments.versions import versions
from scm_world.queries.identification import in_force
from scm_world.queries.local import contact_terms
from scm_world.queries.plans import Plan
from scm_world.queries.samples import Outcome, Setting, named_outcomes
from scm_world.queries.together import EpisodeBatch
from scm_world.queries.twins import asked
from scm_world.variables import Normal
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.world import CausalSystem, Simulation
from scm_world.world.philox import NoiseOfRows

STREAM = "sensor of"
"""Begins the names of the streams; draws of ``sensor_noise`` itself have another one."""

NORMAL = Normal()


@final
class EpisodeRows:
    """Episodes of a world, or of a causal model without a backend, as rows.

    A row is an episode: its causes at the beginning, and its outcomes. With ``every_step`` it is a
    control step: all values when the action is chosen, and the action. Sensors have noise with the
    standard deviation ``sensor_noise``, as a fraction of half the range of a number, as in the
    observations of the environment. Only real states and readouts with bounds have such noise.

    With ``every_step`` a row of a causal model has all variables at an instant; that of a model
    without lagged edges is ``model.do(regime(i).plan.at_start()).draw(1, seed=seed, first=i)``.

    Interventions given to the system hold in every episode; the targets of the design have columns
    in any case. Arguments are those of ``collect``.

    Attributes:
        columns: Those of a row.
        about: Plain data that decide all rows.
        shard: How many episodes a file has by default.
    """

    def __init__(
        self,
        system: CausalSystem | SCM,
        design: Design | Grid,
        setting: Setting,
        *,
        causes: Iterable[str] | None = None,
        outcomes: Iterable[Any] | None = None,
        every_step: bool = False,
        pictures: Pictures | None = None,
        contacts: bool = False,
    ) -> None:
        every_step = true_or_false("every_step", every_step)
        contacts = true_or_false("contacts", contacts)
        self._twins, world = asked(system)
        self._pure = world.backend is None
        # The last row of equations has a command, which a further control step chooses.
        chosen = self._pure and every_step and world.model.is_temporal and world.compiled.actions
        self._further = int(bool(chosen))
        self.shard = usual_shard(system)
        world.length(setting.steps)
        setting = setting.named(world.model)
        design = design.named(world.model) if isinstance(design, Design) else design
        self._world, self._design, self._setting = world, design, setting
        self._pictures, self._contacts = pictures, contacts and not self._pure
        if pictures is not None:
            with self._twins.twin() as twin:  # a camera that does not exist is refused now
                twin.reset(seed=setting.seed)
                pictures.take(twin.scene(), twin.cameras())
        self._given: Plan = getattr(world, "plan", Plan())
        self._every_step, model = every_step, world.model
        for name, act in (*design.interventions(), *Plan(setting.nature).acts()):
            model.accept(name, act)
        varied, measured = tuple[str, ...](), tuple[Outcome, ...]()
        if self._pure and every_step:
            self._watched = tuple(model)
        else:
            chosen = default_causes(world) if causes is None else settable(world, causes)
            varied = tuple(dict.fromkeys((*chosen, *design.targets)))
            if outcomes is None:
                usual = default_outcomes(world, every_step=every_step)
                outcomes = [o for o in usual if is_state(model, o.name) or o.name not in varied]
            measured = named_outcomes(outcomes, "outcome of a dataset")
            for outcome in measured:
                if every_step and outcome != Outcome(outcome.name):
                    allowed = ("names of variables with every_step=True",)
                    raise UnknownOption("outcome", str(outcome), allowed)
            actions = tuple(world.compiled.actions) if every_step else ()
            names = (*varied, *(o.name for o in measured), *actions)
            self._watched = tuple(dict.fromkeys(names))
        self._read = (*(Outcome(n, "first") for n in varied), *measured)
        if every_step:
            parts = [columns_of(model.declared(name)) for name in self._watched]
        else:
            firsts = {name: "first" if is_state(model, name) else "" for name in varied}
            parts = [columns_of(model.declared(n), "first", label) for n, label in firsts.items()]
            parts += [columns_of_outcome(model.declared(o.name), o) for o in measured]
        self.columns = tuple(column for part in parts for column in part)
        there = [column.name for column in self.columns]
        twice = sorted({name for name in there if there.count(name) > 1})
        if twice:  # before episodes are run for them
            allowed = ("other variables than the causes, which have a column already",)
            raise UnknownOption("outcomes", ", ".join(twice), allowed)
        self._half: dict[str, Floats] = {}
        if not self._pure and SENSOR_NOISE in model:
            seen = [name for name in self._watched if name not in world.compiled.commanded]
            self._half = {name: half_range(world, name) for name in seen}
        self.about = self._about(varied, measured)

    def _about(self, varied: Sequence[str], measured: Sequence[Outcome]) -> dict[str, Any]:
        world, setting, nature = self._world, self._setting, Plan(self._setting.nature)
        pure = self._pure
        system = (world.model if pure else world).__fingerprint__() | {
            "policy": setting.policy,
            "given": list(self._given.acts()),
            "nature": list(nature.acts()),
            "design": list(self._design.interventions()),
        }
        found: dict[str, Any] = {"system": "model"}
        if not pure:
            options = dict(world.made_with)
            if not isinstance(backend := options["backend"], str):
                options["backend"] = type(backend).__qualname__
            found = {"system": world.structures.task.name, "options": options}
        if self._pictures is not None:
            found["pictures"] = asdict(self._pictures)
        if self._every_step:
            found["commands"] = CHOSEN
        if not self._twins.is_exact:
            found["floor"] = world.backend.capabilities.floor
        if self._contacts:
            found["contacts"] = "steps" if self._every_step else "episodes"
        return {
            **found,
            "fingerprint": fingerprint(system),
            "given": self._given.as_dict()["do"],
            "seed": setting.seed,
            "steps": setting.steps,
            "policy": policy_name(setting.policy),
            "nature": nature.as_dict()["do"],
            "design": self._design.as_dict(),
            "engine": "equations" if pure else world.backend.name,
            "truth": self._truth(varied, measured),
            "versions": versions("" if pure else world.engine),
        }

    def _truth(self, varied: Sequence[str], measured: Sequence[Outcome]) -> dict[str, Any] | None:
        """Return the graph over the columns; None where the context changes during an episode."""
        world, model = self._world, self._world.model
        context = Plan().over(self._given, "given").over(self._setting.nature, "nature")
        if self._pure and (self._every_step or not model.is_temporal):
            first, more = in_force(model, context)
            return None if more else truth_of_model(first)
        terms, there = contact_terms(world) if self._contacts else {}, self._present()
        if self._every_step:
            bundles = getattr(world.compiled, "bundles", {})
            return truth_of_steps(model, context, self._watched, bundles, terms, there)
        labels = {o: columns_of_outcome(model.declared(o.name), o)[0].variable for o in measured}
        if any(act.time.start for _, act in context.timed()):
            return None
        nature = context.composed(model)
        return truth_of_episodes(model, nature, varied, measured, labels, terms, there)

    def _present(self) -> Present:
        """Return which edges act at the parameters of the table."""
        if self._pure or not (self._every_step or may_be_absent(self._world)):
            return EVERYTHING
        acts = (*self._design.interventions(), *Plan(self._setting.nature).acts())
        model, seed = self._world.model, self._setting.seed
        names = {name for name, _ in (*acts, *self._given.acts())}
        held = {target for name in names for target in (name, *model.targets(name))}
        with self._twins.twin() as twin:

            def begin(episode: int) -> None:
                for _, unit, regime in self._design.cases(seed, range(episode, episode + 1)):
                    Episode._of(self._twins, self._unit(regime, unit), twin)._begin()

            return present(twin, begin, 0, held & {*self._world.compiled.actions})

    def __getstate__(self) -> dict[str, Any]:
        """Use one thread in other processes, where workers share the cores."""
        setting = replace(self._setting, workers=self._setting.workers or 1)
        return {**self.__dict__, "_setting": setting}

    def _unit(self, regime: Regime, number: int, names: Iterable[str] = ()) -> Unit:
        plan = regime.plan.over(self._given, "given")
        return self._setting.unit(self._world, plan, number, names)

    def rows(self, numbers: range) -> tuple[Dataset, bytes]:
        """Run some episodes, and return their table and the file of their pictures.

        Rows of episode i depend on the seed and on i only. The ``about`` of the table has which
        episodes were ``"refused"``, and why, and which bodies were ``"touching"``.
        """
        world, seed = self._world, self._setting.seed
        episodes: list[EpisodePart] = []
        shots: list[Picture] = []
        refused: dict[str, str] = {}
        touching: dict[str, Any] = {}

        def finish(ran: EpisodeBatch) -> Iterator[Any]:
            looks = map(self._look, ran) if self._pictures else repeat([])
            both = map(_touched, ran) if self._contacts else repeat(None)
            return zip(self._values(ran), looks, both, strict=False)

        written = {*self._watched} - {*world.compiled.slices, *world.static_names}
        names = tuple(name for name in self._watched if name in written)
        whole = self._every_step or not {o.how for o in self._read} <= {"final", "first", "change"}
        ends = not (self._pure or whole) and world.compiled.decided.isdisjoint(names)
        how: Any = {"ends": ends, "listens": self._contacts}
        cases = [*self._design.cases(seed, numbers)]
        kinds: dict[int, tuple[Unit, list[Regime]]] = {}
        for *_, regime in cases:
            if id(regime) not in kinds:
                unit = self._unit(regime, 0, names)
                rows = [replace(regime, targets=self._targets(regime.targets, t)) for t in (0, 1)]
                steps = unit.steps + self._further
                kinds[id(regime)] = replace(unit, **how, steps=steps), rows
        units = [replace(kinds[id(regime)][0], number=number) for _, number, regime in cases]
        found = self._twins.run(units, finish, self._setting.workers, InterventionError)
        for (number, _, regime), result in zip(cases, found, strict=True):
            if isinstance(result, InterventionError):
                refused[str(number)] = str(result)
                continue
            values, seen, touched = result
            episodes.append((number, *kinds[id(regime)][1], values))
            shots += ({"episode": number, **shot} for shot in seen)
            touching |= {str(number): touched} if self._contacts else {}
        about = {"refused": refused, "touching": touching}
        table = Dataset._of_episodes(self.columns, episodes, about)
        return table, b"" if self._pictures is None else encoded_pictures(shots)

    def _look(self, episode: Episode) -> list[Picture]:
        """Take the pictures of an episode, one row of them for each of its rows."""
        take = self._pictures and self._pictures.take
        if take is None:
            return []
        if self._every_step:
            return [{"step": t, **take(*episode.scene(t))} for t in range(episode.steps)]
        first = take(*episode.scene(0), "first_image")
        return [{"step": 0, **first, **take(*episode.scene(episode.steps))}]

    def _targets(self, names: Iterable[str], step: int) -> tuple[str, ...]:
        """Return the variables that are set in a row; a state is at the first step only."""
        model, whole = self._world.model, not self._every_step
        there = reached(model, names, self.columns, first=whole)
        return tuple(n for n in there if whole or step == 0 or not is_state(model, n))

    def _values(self, episodes: EpisodeBatch) -> Floats:
        """Return the rows of each episode, shape (n, rows, p)."""
        n, last = len(episodes), episodes.steps
        if self._pure and self._every_step:  # the first step reads the first instant
            return episodes.vectors[:, min(last, 1) : last + 1 - self._further]
        if self._every_step:
            parts = [self._sensed(episodes, name, range(last))[:, :-1] for name in self._watched]
            return np.concatenate([part.reshape(n, last, -1) for part in parts], axis=2)
        ends = {"final": (last,), "first": (0,), "change": (0, last)}
        values, decided = [], self._world.compiled.decided
        for outcome in self._read:
            steps = ends.get(outcome.how, range(1, last + 1))
            seen = self._sensed(episodes, outcome.name, steps)
            values.append(outcome._of_many(seen, outcome.name in decided).reshape(n, 1, -1))
            wrong = ~np.isfinite(values[-1]).all(axis=(1, 2))
            if wrong.any():
                raise UnknownOption(
                    f"value of {outcome}", values[-1][wrong][0], ("finite numbers",)
                )
        return np.concatenate(values, axis=2)

    def _sensed(self, episodes: EpisodeBatch, name: str, steps: Iterable[int]) -> Floats:
        """Return a variable at every instant, with sensor noise at some instants."""
        values, half = episodes.read(name).astype(np.float64), self._half.get(name)
        if half is None or not half.any():
            return values
        strength, shape = episodes.read(SENSOR_NOISE), values.shape[2:]
        noisy = np.flatnonzero(strength.any(axis=1))
        if not noisy.size:
            return values
        units = [episodes.units[place] for place in noisy.tolist()]
        noise = NoiseOfRows([unit.seed for unit in units], len(units))
        numbers = np.array([unit.number for unit in units], dtype=np.uint64)
        for step in steps:
            how: dict[str, Any] = {"episode": numbers, "step": step, "count": len(units)}
            drawn = noise.draw(NORMAL, f"{STREAM} {name}", shape, {}, **how)
            scale = strength[noisy, step].reshape(-1, *[1] * len(shape)) * half.reshape(shape)
            instants = values.shape[1]  # two, if only the ends were recorded
            values[noisy, step if instants > episodes.steps else min(step, 1)] += scale * drawn
        return values


def _touched(episode: Episode) -> list[Any]:
    return [[list(pair) for pair in sorted(step)] for step in episode.touched]


def half_range(world: Simulation, name: str) -> Floats:
    """Return half the range of each number of a variable that a sensor measures, shape (k,).

    The range is that of the environment's observations; without a range or a sensor it is 0.
    """
    variable = world.model.declared(name)
    if variable.role not in ("state", "readout") or variable.dtype != "real":
        return np.zeros(int(np.prod(variable.shape)))
    low, high = bounds(world.model, name)
    observed = published(world, world.compiled).get(name)
    if observed and observed.low is not None and observed.high is not None:
        low, high = spread(observed.low, variable.shape), spread(observed.high, variable.shape)
    return np.where((low > -WIDE) & (high < WIDE), (high - low) / 2.0, 0.0)


def usual_shard(system: CausalSystem | SCM) -> int:
    """Return how many episodes a file has: at least as many as an engine steps best together."""
    twins, world = asked(system)
    return 10_000 if world.backend is None else max(500, twins.scenes or 0)


def policy_name(policy: object) -> str:
    """Return the name of a policy; its fingerprint tells it from others of this name."""
    if policy is None or isinstance(policy, str):
        return policy or "still"
    named = policy if hasattr(policy, "__qualname__") else type(policy)
    return f"{named.__module__}:{named.__qualname__}"
