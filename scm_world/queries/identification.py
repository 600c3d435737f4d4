"""What can be learnt by watching alone, held against what happens when one acts."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, final

import networkx as nx
import numpy as np

from scm_world._types import Floats
from scm_world.errors import MissingExtra, ModelError, UnknownOption
from scm_world.graph import SCM, episode_outcome
from scm_world.graph.evaluate import AppliedIntervention, source_of
from scm_world.queries.estimates import CONFIDENCE, Effect
from scm_world.queries.outcomes import Outcome, as_outcome
from scm_world.queries.plans import Plan
from scm_world.variables import Draw, Mechanism


@final
@dataclass(frozen=True)
class Identification:
    """Which variables have to be watched so that watching tells what acting would do.

    Attributes:
        treatment: The cause.
        outcome: The effect.
        graph: Of one episode, with what nature does.
        backdoor: A smallest set of observed variables that blocks every back door; None if there
            is none.
        frontdoor: Sets of observed variables through which the whole effect runs; found by pgmpy.
    """

    treatment: str
    outcome: str
    graph: nx.DiGraph
    backdoor: tuple[str, ...] | None
    frontdoor: tuple[tuple[str, ...], ...] = ()


def nature_graph(
    model: SCM, nature: Mapping[str, Any] | None, outcomes: Iterable[str]
) -> nx.DiGraph:
    """Give the static graph of an episode in which nature does something at the beginning.

    Args:
        model: Of the world.
        nature: What varies by itself; a ``Mechanism`` adds its edges, and so does a ``Draw`` from
            a space that follows other variables.
        outcomes: What the episode ends with.

    Raises:
        ModelError: Nature does something later than at the beginning.
    """
    plan = Plan(nature)
    acts = plan.at_first()
    late = sorted(
        {name for name in plan if name not in acts} | {n for n in plan if len(plan[n]) > 1}
    )
    if late:
        raise ModelError(
            [f"what nature does to {name!r} has to happen at the beginning" for name in late]
        )
    moved = [name for name in acts if model.declared(model.target(name)).role == "state"]
    states = [target for name in moved for target in model.targets(name)]
    held = model.do({name: act for name, act in acts.items() if name not in moved})
    graph = episode_outcome(held, outcomes, starts=states)
    for name in moved:
        followed = sorted(_followed(model, name, acts[name]))
        causes = [n if n in graph else f"{n}@0" for n in followed]
        for target in model.targets(name):
            graph.add_edges_from((cause, f"{target}@0") for cause in causes)
    return graph


def _followed(model: SCM, name: str, act: Any) -> frozenset[str]:
    """Name what a state follows at the beginning: parents of a mechanism or of a space."""
    if isinstance(act, Mechanism):
        return frozenset(parent.name for parent in act.parents)
    if isinstance(act, Draw):
        return source_of(AppliedIntervention(act, model.declared(name))).parents()
    return frozenset()


def identify(
    graph: nx.DiGraph,
    treatment: str,
    outcome: str,
    *,
    observed: Iterable[str] | None = None,
    frontdoor: bool = False,
) -> Identification:
    """Find the variables to adjust for.

    Args:
        graph: Directed and acyclic.
        treatment: A node.
        outcome: A node.
        observed: The nodes that are watched; all if None.
        frontdoor: Whether to look for front doors too, with pgmpy.

    Raises:
        UnknownOption: There is no such node, or both are one.
        ModelError: The graph has a cycle, or no directions.
        MissingExtra: pgmpy is not installed.

    Source:
        Pearl, *Causality*, 2nd edition, 3.3; the smallest separator is that of networkx (van der
        Zander, Liśkiewicz and Textor, 2019).

    Example:
        >>> graph = nx.DiGraph([("z", "x"), ("z", "y"), ("x", "y"), ("w", "y")])
        >>> identify(graph, "x", "y").backdoor
        ('z',)
        >>> identify(graph, "x", "y", observed=["x", "y", "w"]).backdoor is None
        True
    """
    if not (graph.is_directed() and nx.is_directed_acyclic_graph(graph)):
        raise ModelError(["the graph has to be directed and acyclic"])
    seen = tuple(graph) if observed is None else tuple(observed)
    for node in (treatment, outcome, *seen):
        if node not in graph:
            raise UnknownOption("node", node, tuple(map(str, graph)))
    if treatment == outcome:
        raise UnknownOption("outcome", outcome, ("another node than the treatment",))
    watched = set(seen) - {treatment, outcome}
    allowed = watched - nx.descendants(graph, treatment)
    behind = graph.copy()
    behind.remove_edges_from(list(graph.out_edges(treatment)))
    found = nx.find_minimal_d_separator(behind, {treatment}, {outcome}, restricted=allowed)
    backdoor = None if found is None else tuple(sorted(found))
    doors = tuple(_front_doors(graph, treatment, outcome, watched)) if frontdoor else ()
    return Identification(treatment, outcome, graph, backdoor, doors)


def _front_doors(
    graph: nx.DiGraph, treatment: str, outcome: str, watched: set[str]
) -> Iterator[tuple[str, ...]]:
    try:
        base = importlib.import_module("pgmpy.base")
        doors = importlib.import_module("pgmpy.identification")
    except ImportError as error:
        raise MissingExtra("pgmpy", "pgmpy") from error
    kept = nx.ancestors(graph, outcome) | nx.ancestors(graph, treatment) | {outcome, treatment}
    between = nx.descendants(graph, treatment) & nx.ancestors(graph, outcome) & watched
    part = graph.subgraph(kept)
    dag = base.DAG(
        list(part.edges),
        latents=set(part) - between - {treatment, outcome},
        roles={"exposures": treatment, "outcomes": outcome},
    )
    found, is_there = doors.Frontdoor(variant="all").identify(dag)
    if is_there:
        yield from sorted(tuple(sorted(one.get_role("frontdoor"))) for one in found)


@final
@dataclass(frozen=True)
class AdjustmentCheck:
    """An effect as watching tells it, beside the one that acting shows.

    Attributes:
        identification: What was adjusted for.
        adjusted: The effect, standardised over what was adjusted for: mean and interval.
        naive: The same without adjustment.
        simulated: What acting showed.
        n: How many episodes were watched.
    """

    identification: Identification
    adjusted: tuple[float, float, float]
    naive: tuple[float, float, float]
    simulated: Effect
    n: int

    @property
    def agrees(self) -> bool:
        """Whether the intervals of the adjusted and of the simulated effect meet."""
        _, low, high = self.adjusted
        return bool(low <= float(self.simulated.high) and float(self.simulated.low) <= high)

    @property
    def is_confounded(self) -> bool:
        """Whether the interval without adjustment misses that of the simulated effect."""
        _, low, high = self.naive
        return bool(high < float(self.simulated.low) or float(self.simulated.high) < low)

    def __str__(self) -> str:
        def show(numbers: tuple[float, float, float]) -> str:
            return "{:.4g} [{:.4g}, {:.4g}]".format(*numbers)

        acted = tuple(
            float(x) for x in (self.simulated.mean, self.simulated.low, self.simulated.high)
        )
        found = self.identification
        return (
            f"{found.treatment} → {found.outcome}: watching {show(self.adjusted)} adjusted for "
            f"{', '.join(found.backdoor or ()) or 'nothing'}; {show(self.naive)} unadjusted; "
            f"acting {show((acted[0], acted[1], acted[2]))}"
        )


def check_backdoor(
    world: Any,
    treatment: str,
    outcome: Any,
    *,
    values: tuple[float, float],
    nature: Mapping[str, Any],
    observed: Iterable[str] | None = None,
    n: int = 200,
    units: int = 50,
    **setting: Any,
) -> AdjustmentCheck:
    """Estimate an effect from episodes that are only watched, and check it by acting.

    The estimate is standardised: a quadratic model of the outcome, given the treatment and the
    variables of the back door, is averaged over these variables with the treatment at both values.

    Args:
        world: A ``scm_world.queries.World``.
        treatment: A parameter that nature varies.
        outcome: The name of a variable or an ``Outcome``, one number.
        values: Of the treatment: the effect is that of the second against the first.
        nature: What varies by itself.
        observed: What is watched; everything if None.
        n: How many episodes are watched.
        units: In how many units the effect is simulated.
        setting: See ``World.sample``.

    Raises:
        ModelError: The effect cannot be told from watching.
        UnknownOption: The outcome is no variable.
    """
    wanted = as_outcome(outcome)
    if world.model.declared(treatment).shape or np.shape(values) != (2,):
        raise UnknownOption("treatment", (treatment, values), ("one number, with two values",))
    if not isinstance(wanted, Outcome):
        raise UnknownOption("outcome", outcome, ("the name of a variable", "Outcome(name, how)"))
    graph = nature_graph(world.model, world.plan.do(nature), [wanted.name])
    found = identify(graph, treatment, wanted.name, observed=observed)
    if found.backdoor is None:
        raise ModelError(
            [f"the effect of {treatment!r} cannot be told by watching {sorted(observed or graph)}"]
        )
    names = (treatment, *(name.removesuffix("@0") for name in found.backdoor))
    read = [Outcome(name, "first") for name in names]
    seen = world.see(n, outcomes=[*read, wanted], nature=nature, **setting)
    *causes, effect = (np.asarray(column, float).reshape(n, -1) for column in seen.values())
    if effect.shape[1] != 1:
        raise UnknownOption("outcome", outcome, ("one number: Outcome(name, how, component)",))
    simulated = world.effect(
        wanted,
        do={treatment: values[1]},
        versus={treatment: values[0]},
        n=units,
        nature={name: act for name, act in nature.items() if name != treatment},
        **setting,
    )
    adjusted = _standardised(np.hstack(causes), effect[:, 0], values)
    return AdjustmentCheck(
        found, adjusted, _standardised(causes[0], effect[:, 0], values), simulated, n
    )


def _standardised(
    causes: Floats, effect: Floats, values: tuple[float, float]
) -> tuple[float, float, float]:
    """Estimate an effect by standardisation over a quadratic model, with its interval.

    Args:
        causes: The treatment in the first column, shape (n, k).
        effect: Shape (n,).
        values: Of the treatment.

    Source:
        Hernán and Robins, *Causal inference: what if*, 13; the interval is that of a linear
        combination of ordinary least squares coefficients.
    """
    terms = (causes.shape[1] + 1) * (causes.shape[1] + 2) // 2
    if len(effect) < 2 * terms:
        raise ModelError(
            [f"{len(effect)} episodes are too few for {terms} coefficients; watch {2 * terms}"]
        )
    if not causes[:, 0].std() > 0.0:
        raise ModelError(["the treatment does not vary: let nature draw it, or give it a cause"])
    middle, scale = causes.mean(axis=0), causes.std(axis=0) + 1e-300

    def design(rows: Floats) -> Floats:
        z = (rows - middle) / scale
        pairs = [z[:, i] * z[:, j] for i in range(z.shape[1]) for j in range(i + 1)]
        return np.column_stack([np.ones(len(z)), z, *pairs])

    from scipy.special import stdtrit

    table = design(causes)
    inverse = np.linalg.pinv(table.T @ table)
    slopes = inverse @ table.T @ effect
    degrees = max(len(effect) - int(np.linalg.matrix_rank(table)), 1)
    spread = float(((effect - table @ slopes) ** 2).sum()) / degrees
    sides = [causes.copy(), causes.copy()]
    for side, value in zip(sides, values, strict=True):
        side[:, 0] = value
    each = design(sides[1]) - design(sides[0])
    apart = each.mean(axis=0)
    mean, variance = float(apart @ slopes), spread * float(apart @ inverse @ apart)
    variance += float((each @ slopes).var(ddof=1)) / len(effect)  # units are a sample, too
    half = float(stdtrit(degrees, 0.5 + 0.5 * CONFIDENCE)) * float(np.sqrt(variance))
    return mean, mean - half, mean + half
