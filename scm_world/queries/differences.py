"""Pairs of runs: differences of episodes, consequences of interventions, and but-for causes.

Each result is a data frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from scm_world._arguments import MANY, one_of, real_number, typed, whole_number
from scm_world._patterns import as_names
from scm_world.errors import UnknownOption
from scm_world.queries.episodes import ALL, Episode, Unit
from scm_world.queries.experiments.effects import gap
from scm_world.queries.questions import SCM, Questions
from scm_world.queries.samples import Outcome, as_outcome, is_category, read
from scm_world.queries.twins import asked
from scm_world.queries.world import World
from scm_world.variables import Natural
from scm_world.variables.interventions import has_times
from scm_world.variables.kinds import SPACES, SpaceName

if TYPE_CHECKING:
    import pandas as pd

    from scm_world.queries.samples import AnyOutcome

# --- two episodes ---------------------------------------------------------------------------------


@final
@dataclass(frozen=True, eq=False)
class EpisodeDifference:
    """The difference of two episodes.

    Attributes:
        variables: The variables that differ, by name, the earliest first: the ``first`` instant of
            a difference, the ``largest`` difference of a component (1 where categories differ),
            its instant (``at``), and the difference at the end (``final``).
        contacts: Pairs of bodies that touch in one episode only: ``step``, ``bodies``, and ``"a"``
            or ``"b"`` for the ``episode``.
    """

    variables: pd.DataFrame
    contacts: pd.DataFrame

    @property
    def first(self) -> int | None:
        """The first instant with a difference; None without differences."""
        return int(self.variables["first"].min()) if len(self.variables) else None

    def __str__(self) -> str:
        if not len(self.variables):
            return "no difference"
        lines = [self.variables.drop(columns="final").to_string(float_format="{:.4g}".format)]
        if len(self.contacts):
            where, one = f"{len(self.contacts)} contacts in one only, first", self.contacts.iloc[0]
            lines.append(f"{where} {'–'.join(one.bodies)} in {one.episode} at {one.step}")
        return "\n".join(lines)


@typed
def compare(
    one: Episode, other: Episode, names: Iterable[str] | None = None, *, tolerance: float = 0.0
) -> EpisodeDifference:
    """Compute the difference of two episodes.

    Args:
        one: An episode.
        other: An episode with the same number of steps.
        names: Variables to compare; all common variables if None.
        tolerance: Largest difference that is ignored.

    Raises:
        UnknownOption: They are not episodes, or their lengths differ.
    """
    import pandas as pd

    for given in (one, other):
        _check_episode(given)
    tolerance = real_number("tolerance", tolerance, least=0.0)
    if one.steps != other.steps:
        raise UnknownOption("episode", other, (f"one of {one.steps} steps",))
    both = [name for name in one.names if name in set(other.names)]
    rows: dict[str, Any] = {}
    for name in both if names is None else as_names(names):
        values = np.asarray(one[name], float), np.asarray(other[name], float)
        if values[0].shape != values[1].shape:  # a body was added or removed in one of them
            rows[name] = 0, np.inf, 0, np.asarray(np.inf)
            continue
        apart = values[0] - values[1]
        if any(is_category(Outcome(name), era.compiled) for era in one.eras):
            apart = (apart != 0.0).astype(float)
        sizes = np.abs(apart).reshape(len(apart), -1).max(axis=1, initial=0.0)
        differs, at = sizes > tolerance, int(np.argmax(sizes))
        if differs.any():
            rows[name] = int(np.argmax(differs)), float(sizes[at]), at, np.asarray(apart[-1])
    columns = ["first", "largest", "at", "final"]
    found = pd.DataFrame([*rows.values()], index=[*rows], columns=columns, dtype=object)
    found = found.astype({"first": int, "largest": float, "at": int})
    touching = zip(one.replay().touching, other.replay().touching, strict=True)
    contacts = [
        (step, pair, episode)
        for step, (a, b) in enumerate(touching)
        for episode, alone in (("a", a - b), ("b", b - a))
        for pair in sorted(alone)
    ]
    return EpisodeDifference(
        found.sort_values("first", kind="stable"),
        pd.DataFrame(contacts, columns=["step", "bodies", "episode"]),
    )


def _check_episode(given: object) -> None:
    if not isinstance(given, Episode):
        raise UnknownOption("episode", given, ("an episode of rollout or counterfactual",))


# --- one intervention -----------------------------------------------------------------------------


class Consequences(NamedTuple):
    """The consequences of an intervention.

    Attributes:
        variables: A row for each variable that exists in both episodes, except targets without
            descendants: its ``unit``; whether it is a ``descendant`` of a target; whether it
            ``moved``, at once or by the end; its value ``before`` the intervention, ``right_after``
            it, ``after`` all steps, and after all steps ``without`` the intervention; the largest
            ``difference`` of a component of the last two, 0 or 1 for categories.
        plain: The episode without the intervention.
        done: The episode with the intervention.
        engine: Version of the physics engine, or ``"equations"``.
    """

    variables: pd.DataFrame
    plain: Episode
    done: Episode
    engine: str

    @property
    def audit(self) -> Any:
        """The audit of the intervention."""
        return self.done.audits[0]

    @property
    def astray(self) -> tuple[str, ...]:
        """Variables that moved without being descendants of a target: the graph is wrong."""
        table = self.variables
        return tuple(table.index[table["moved"] & ~table["descendant"]])


@typed
def consequences(
    system: World | SCM,
    request: Mapping[str, Any],
    *,
    steps: int = 25,
    seed: int = 0,
    space: SpaceName | None = None,
) -> Consequences:
    """Intervene at the start of an episode, and compare it with the episode without intervention.

    Both have the idle action and the same noise. The system itself does not change.

    Args:
        system: A world, or equations.
        request: The intervention, without a time.
        steps: Control steps afterwards; 0 without lagged edges.
        seed: Seed of the noise.
        space: For a world, the space in which all values must lie.

    Raises:
        UnknownOption: The space does not exist.
        InterventionError: The intervention is refused.
        InexactEngine: Equal runs differ on the engine, or bodies that do not touch change one
            another.

    Example:
        >>> found = consequences(World("pushing", backend="fake"), {"tool_block.mass": 0.05})
        >>> found.astray, bool(found.variables.descendant["tool_block.linear_velocity"])
        ((), True)
    """
    import pandas as pd

    one_of("space", space, (None, *SPACES))
    if not isinstance(system, Questions):
        raise UnknownOption("system", system, ("a World", "an SCM"))
    if has_times(request):
        raise UnknownOption("request", request, ("interventions without a time",))
    steps = whole_number("steps", steps, least=0, most=MANY) if system.graph.is_temporal else 0
    twins, unit = asked(system)[0], Unit(seed, 0, system.planned(None), None, steps, (ALL,))
    what = "a comparison of an episode with and without an intervention"
    twins.require_exact(what, independent=True)
    with twins.twin() as world:
        plain = unit.run(world, twins)
        if space is not None:
            Episode._of(twins, unit, world)._begin()
            world.do(request, space=space)
        done, engine = replace(unit, plan=system.planned(request)).run(world, twins), world.engine
    models = [episode.eras[0].compiled.model for episode in (plain, done)]
    targets = {models[0].target(name) for audit in done.audits.values() for name in audit.targets}
    follow = {
        name
        for model in models  # the intervention may add or remove bodies
        for target in targets & {*model}
        for name in model.descendants(target)
    }
    rows: dict[str, dict[str, Any]] = {}
    for name in models[0]:
        if name not in models[1] or (name in targets and name not in follow):
            continue
        variable, before, right_after = models[0].declared(name), plain[name][0], done[name][0]
        after, without = done.final(name), plain.final(name)
        difference = gap(after, without)
        rows[name] = {
            "unit": variable.unit,
            "descendant": name in follow,
            "moved": difference > 0.0 or gap(right_after, before) > 0.0,
            "before": before,
            "right_after": right_after,
            "after": after,
            "without": without,
            "difference": float(difference > 0) if variable.dtype == "categorical" else difference,
        }
    table = pd.DataFrame([*rows.values()], index=[*rows])
    return Consequences(table.astype({"descendant": bool, "moved": bool}), plain, done, engine)


# --- several causes -------------------------------------------------------------------------------


@typed
def but_for(
    episode: Episode,
    outcome: AnyOutcome,
    over: Iterable[str] | Mapping[str, Any] | None = None,
    *,
    at: int = 0,
    most: int = 1,
    workers: int | None = None,
) -> pd.DataFrame:
    """Test for each cause whether the outcome would have been the same without it.

    Args:
        episode: The factual episode.
        outcome: The name of a variable (its final value), an ``Outcome``, or a function.
        over: Causes, each with an alternative value. Names alone stand for the values without
            intervention, and must be targets of interventions in the episode. All targets if None.
        at: The control step at which the causes are replaced.
        most: Largest number of causes that are replaced together. Supersets of a set that matters
            are not tested.
        workers: Number of threads, see ``Setting``.

    Returns:
        A row for each set of ``causes``, the largest difference first: whether it ``mattered``,
        the largest difference of a component (``size``), the ``outcome``, and the outcome
        ``without`` them.

    Raises:
        UnknownOption: A cause without alternative value was not intervened on, or an argument is
            invalid.
        InexactEngine: Equal runs differ on the engine, or bodies that do not touch change one
            another.
    """
    import pandas as pd

    _check_episode(episode)
    episode.twins.require_exact("whether a cause mattered", independent=True)
    most, at = whole_number("most", most, least=1), whole_number("at", at, least=0)
    if isinstance(over, Mapping):
        contrasts = dict(over)
    else:
        done = episode.plan
        contrasts = dict.fromkeys(done if over is None else as_names(over), Natural())
        for name in contrasts:
            if name not in done:
                allowed = (*done, f"{{{name!r}: its alternative value}}")
                raise UnknownOption("cause", name, allowed)
    wanted = as_outcome(outcome)
    actual = read(wanted, episode)
    rows: list[tuple[Any, ...]] = []
    for size in range(1, most + 1):
        decisive = [set(causes) for causes, mattered, *_ in rows if mattered]
        groups = [
            group
            for group in combinations(contrasts, size)
            if not any(known <= set(group) for known in decisive)
        ]
        dos = [{name: contrasts[name] for name in group} for group in groups]
        others = episode.worlds(dos, at=at, workers=workers)
        for group, other in zip(groups, others, strict=True):
            value = read(wanted, other)
            reach = float(np.abs(actual - value).max(initial=0.0))
            rows.append((group, not np.array_equal(actual, value), reach, actual, value))
    columns = ["causes", "mattered", "size", "outcome", "without"]
    found = pd.DataFrame(rows, columns=columns).astype({"mattered": bool, "size": float})
    return found.sort_values("size", ascending=False, kind="stable", ignore_index=True)
