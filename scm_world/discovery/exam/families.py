"""Named families of random causal models without physics, to examine learners on."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Value
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.variables import Derived, Function, Linear, Parent
from scm_world.variables.distributions import Normal

WEAKEST, STRONGEST = 0.5, 2.0  # absolute weights, uniform between them; the sign is drawn
PER_NODE = 2  # edges per node of the static families
MOST = 1000  # variables
DONE = Normal(mean=2.0, std=1.0)
"""What ``do`` draws in these models, unless it is said otherwise: one mean off, same spread."""


@final
@dataclass(frozen=True)
class Family:
    """A family of models of any size.

    Attributes:
        name: As in ``"er2:20"``.
        build: Makes the model of a size and a seed.
        doc: In one line.
    """

    name: str
    build: Callable[[int, int], SCM]
    doc: str


def model(name: str, seed: int = 0) -> SCM:
    """Draw a model of a family.

    Args:
        name: ``"family:n"`` with n variables, such as ``"er2:20"``.
        seed: Which model of the family.

    Raises:
        UnknownOption: There is no such family or size.

    Example:
        >>> drawn = model("er2:20", seed=0)
        >>> len(list(drawn)), len(drawn.edges) == len(model("er2:20", seed=0).edges)
        (20, True)
    """
    check_family(name)
    kind, _, size = name.partition(":")
    return FAMILIES[kind].build(int(size), seed)


def check_family(name: str) -> None:
    """Refuse what is no family with a size.

    Raises:
        UnknownOption: There is no such family or size.
    """
    kind, _, size = name.partition(":")
    if kind not in FAMILIES or not re.fullmatch(r"[0-9]+", size) or not 2 <= int(size) <= MOST:
        shown = tuple(f"{family}:N" for family in FAMILIES)
        raise UnknownOption("family of models", name, (*shown, f"with N from 2 to {MOST}"))


def is_family(name: str) -> bool:
    """Tell whether a name is one of a family, of whatever size."""
    return name.partition(":")[0] in FAMILIES


def _names(n: int) -> list[str]:
    width = len(str(n - 1))
    return [f"x{i:0{width}d}" for i in range(n)]


def _shuffled(upper: NDArray[np.bool_], rng: np.random.Generator) -> Floats:
    """Give edges of a causal order weights, and forget the order."""
    n = len(upper)
    size = rng.uniform(WEAKEST, STRONGEST, (n, n)) * rng.choice([-1.0, 1.0], (n, n))
    places = rng.permutation(n)
    weights = np.zeros((n, n))
    weights[np.ix_(places, places)] = np.where(upper, size, 0.0)
    return weights


def _linear(weights: Floats) -> SCM:
    """Make a linear model with unit Gaussian noise; weights[i, j] is that of i on j."""
    names = _names(len(weights))
    made = []
    for j, name in enumerate(names):
        causes = np.flatnonzero(weights[:, j]).tolist()
        mechanism = Linear(weights=tuple(weights[causes, j].tolist()))
        parents = tuple(names[i] for i in causes)
        made.append(
            Derived(
                name=name, parents=parents, mechanism=mechanism, noise=Normal(mean=0.0, std=1.0)
            )
        )
    return SCM(made)


def _erdos_renyi(n: int, seed: int) -> SCM:
    rng = np.random.default_rng([seed, n, 1])
    chance = min(1.0, 2.0 * PER_NODE / (n - 1))
    upper = np.triu(rng.random((n, n)) < chance, 1)
    return _linear(_shuffled(upper, rng))


def _scale_free(n: int, seed: int) -> SCM:
    rng = np.random.default_rng([seed, n, 2])
    drawn = nx.barabasi_albert_graph(n, min(PER_NODE, n - 1), seed=int(rng.integers(2**31)))
    upper = np.zeros((n, n), bool)
    for one, other in drawn.edges:
        upper[min(one, other), max(one, other)] = True  # hubs come early: they cause much
    return _linear(_shuffled(upper, rng))


def tanh_of_sum(*parents: Value, noise: Value | float = 0.0, weights: Floats) -> Any:
    """Compute the hyperbolic tangent of a weighted sum, plus noise."""
    total = sum(w * parent for w, parent in zip(weights, parents, strict=True))
    return np.tanh(total) + noise


def _one_step(n: int, seed: int) -> SCM:
    """Make a nonlinear dynamic model: each variable follows from up to four, one step ago."""
    rng = np.random.default_rng([seed, n, 3])
    names, made = _names(n), []
    for name in names:
        causes = rng.choice(n, size=int(rng.integers(1, min(4, n) + 1)), replace=False)
        weights = rng.uniform(WEAKEST, STRONGEST, len(causes)) * rng.choice(
            [-1.0, 1.0], len(causes)
        )
        made.append(
            Derived(
                name=name,
                parents=tuple(Parent(names[i], 1) for i in causes),
                mechanism=Function(tanh_of_sum, constants={"weights": tuple(weights.tolist())}),
                noise=Normal(mean=0.0, std=0.1),
            )
        )
    return SCM(made)


FAMILIES = {
    family.name: family
    for family in (
        Family("er2", _erdos_renyi, "Erdős–Rényi DAG, 2 edges per node, linear Gaussian"),
        Family("sf2", _scale_free, "scale-free DAG (Barabási–Albert, 2 per node), linear Gaussian"),
        Family("tanh4", _one_step, "one control step, at most 4 causes each, tanh of a sum"),
    )
}
"""By name. Weights are uniform in ±[0.5, 2], noise has standard deviation 1 (0.1 for ``tanh4``).

Source:
    Zheng et al., *DAGs with NO TEARS*, NeurIPS 2018, section 5.1, for weights and densities;
    Barabási and Albert, *Emergence of scaling in random networks*, Science 1999.
"""
