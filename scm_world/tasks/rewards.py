"""What a step is worth: terms, weights, and the node of the graph that sums them up."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypedDict

import numpy as np

from scm_world.errors import UnknownOption
from scm_world.tasks.arguments import checked_weight
from scm_world.variables import Box, Function, Linear, Measured, Parent, Variable

FRACTION = "fractional_success"
SUCCESS = "success"
FULFILLED = 0.9  # the fraction of the goal that counts as success
UNIT = Box(0.0, 1.0)

PRESETS = ("default", "paper", "sparse", "none")
"""The weights that every task knows by name."""


class Common(TypedDict, total=False):
    """Options that every task has.

    Attributes:
        weights: ``"default"``, ``"paper"``, ``"sparse"`` (1 for success), ``"none"``
            (reward-free), or a dictionary: the terms in it get these weights, the others keep
            the default ones.
        fractional_reward_weight: Weight of the fractional success.
        dense_reward_weights: Weights of the dense terms, in their order.
        activate_sparse_reward: The same as ``weights="sparse"``.
        terms: Reward terms of one's own: ``Measured`` variables with a mechanism, whose names
            begin with ``reward.``; their weights stand in ``weights``.
        joint_positions: Where the robot begins, shape (9,) [rad].
    """

    weights: str | Mapping[str, float]
    fractional_reward_weight: float | None
    dense_reward_weights: Sequence[float] | None
    activate_sparse_reward: bool
    terms: Iterable[Measured]
    joint_positions: Sequence[float] | None


def resolve(
    default: Mapping[str, float], paper: Mapping[str, float], options: Common
) -> dict[str, float]:
    """Work out the weight of every term.

    Args:
        default: Of every dense term of the task in its order, and of the fractional success.
        paper: Where the published training runs differ.
        options: What the user asked for.

    Raises:
        UnknownOption: A preset or a term that does not exist, a wrong number of weights, or one
            that is no finite number.
    """
    asked = options.get("weights", "default")
    own = {term.name: 0.0 for term in options.get("terms", ())}
    weights = {**default, **own}
    if isinstance(asked, str):
        if asked not in PRESETS:
            raise UnknownOption("weights", asked, PRESETS)
        weights.update(paper if asked == "paper" else {})
    elif isinstance(asked, Mapping):
        unknown = set(asked) - {*weights, SUCCESS}
        if unknown:
            raise UnknownOption("reward term", min(unknown), (*weights, SUCCESS))
        weights.update({name: checked_weight(name, weight) for name, weight in asked.items()})
    else:
        raise UnknownOption("weights", asked, (*PRESETS, "a dictionary of terms and numbers"))
    sparse = asked == "sparse" or options.get("activate_sparse_reward", False)
    if sparse or asked == "none":
        weights = dict.fromkeys(weights, 0.0)
    own_weights = _in_order([n for n in default if n != FRACTION], options)
    if (fraction := options.get("fractional_reward_weight")) is not None:
        own_weights[FRACTION] = checked_weight("fractional_reward_weight", fraction)
    if sparse and any(own_weights.values()):
        named = {name: weight for name, weight in own_weights.items() if weight}
        raise UnknownOption("weights of a sparse reward", named, ("none: it is 1 for success",))
    weights.update(own_weights)
    return {**weights, SUCCESS: 1.0} if sparse else weights


def _in_order(dense: Sequence[str], options: Common) -> dict[str, float]:
    given = options.get("dense_reward_weights")
    if given is None:
        return {}
    if np.shape(given) != (len(dense),):
        raise UnknownOption("dense_reward_weights", given, (f"{len(dense)} numbers", *dense))
    return {name: checked_weight(name, weight) for name, weight in zip(dense, given, strict=True)}


def term(
    name: str,
    function: Callable[..., Any] | Function,
    parents: Iterable[str | Parent],
    doc: str,
) -> Measured:
    """Declare a reward term."""
    mechanism = function if isinstance(function, Function) else Function(function)
    return Measured(name=name, parents=tuple(parents), mechanism=mechanism, doc=doc)


def reward(weights: Mapping[str, float]) -> Variable:
    """Declare the reward: the weighted sum of the terms whose weight is not zero."""
    used = {name: weight for name, weight in weights.items() if weight != 0.0}
    return Measured(
        name="reward",
        parents=tuple(used),
        mechanism=Linear(weights=tuple(used.values())),
        doc="Weighted sum of the reward terms.",
    )


def above(value: float, *, threshold: float) -> int:
    """Tell whether a number lies above a threshold, as 0 or 1."""
    return int(value > threshold)
