"""Rewards: terms, weights, and the node of the graph that sums them up."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypedDict

import numpy as np

from scm_world._arguments import one_of, real_number, true_or_false, typed
from scm_world._types import Value, Values
from scm_world.errors import ModelError, UnknownOption
from scm_world.geometry.numbers import njit, scalar
from scm_world.variables import Box, Function, Integers, Linear, Measured, Parent, Variable

FRACTION = "fractional_success"
SUCCESS = "success"
TERMINATED = "terminated"
FULFILLED = 0.9  # the fraction of the goal that counts as success
UNIT = Box(0.0, 1.0)

PREFIX = "reward."

Declaration = Variable | tuple[Any, ...] | str | None
"""A variable, its name, or ``(function, "parent", …)``: a function of the values of its parents."""


class Common(TypedDict, total=False):
    """Options that every task has.

    Attributes:
        weights: ``"default"``, ``"paper"``, ``"sparse"`` (1 for success), ``"none"``
            (reward-free), or a dictionary: the terms in it get these weights, the others keep
            the default ones.
        fractional_reward_weight: Weight of the fractional success.
        dense_reward_weights: Weights of the dense terms, in their order.
        activate_sparse_reward: The same as ``weights="sparse"``.
        terms: Further reward terms: names of ``ready_terms`` of the task, or custom terms,
            ``Measured`` variables with a mechanism, whose names begin with ``reward.``; their
            weights stand in ``weights``.
        joint_positions: Where the robot begins, shape (9,) [rad].
        success: What counts in place of the usual goal: ``(function, "parent", …)``, a function of
            variables of the task that gives a number in [0, 1], or 0 and 1. It becomes
            ``fractional_success``, and more than 0.9 of it is ``success``.
        terminated: When an episode ends before its time: ``(function, "parent", …)``, a function
            of variables of the task that gives 0 or 1. It becomes ``terminated``.
    """

    weights: str | Mapping[str, float]
    fractional_reward_weight: float | None
    dense_reward_weights: Sequence[float] | None
    activate_sparse_reward: bool
    terms: Iterable[Measured | str]
    joint_positions: Sequence[float] | None
    success: Declaration
    terminated: Declaration


def resolve(
    default: Mapping[str, float],
    paper: Mapping[str, float],
    options: Common,
    terms: Iterable[Measured] = (),
) -> dict[str, float]:
    """Compute the weight of every term, the further ones, too.

    Default weights are those of the dense terms of the task in their order, and of the fractional
    success; ``paper`` has those of the published training runs, where they differ.
    """
    weights = {**default, **{term.name: 0.0 for term in terms}}
    none: dict[str, float] = dict.fromkeys(weights, 0.0)
    sparse = {**none, SUCCESS: 1.0}
    presets = {"default": {}, "paper": dict(paper), "sparse": sparse, "none": none}
    asked: Any = options.get("weights", "default")
    option = "activate_sparse_reward"
    asked = "sparse" if true_or_false(option, options.get(option, False)) else asked
    if isinstance(asked, Mapping):
        for name in asked:
            one_of("reward term", name, sparse)
        changed = {name: real_number(f"weight of {name}", asked[name]) for name in asked}
    elif isinstance(asked, str) and asked in presets:
        changed = presets[asked]
    else:
        dictionary = () if isinstance(asked, str) else ("a dictionary of terms and numbers",)
        raise UnknownOption("weights", asked, (*presets, *dictionary))
    own: dict[str, float] = {}
    if (given := options.get("dense_reward_weights")) is not None:
        dense = [name for name in default if name != FRACTION]
        if np.shape(given) != (len(dense),):
            raise UnknownOption("dense_reward_weights", given, (f"{len(dense)} numbers", *dense))
        own = {n: real_number(f"weight of {n}", w) for n, w in zip(dense, given, strict=True)}
    if (fraction := options.get("fractional_reward_weight")) is not None:
        own[FRACTION] = real_number("fractional_reward_weight", fraction)
    if asked == "sparse" and any(own.values()):
        named = {name: weight for name, weight in own.items() if weight}
        raise UnknownOption("weights of a sparse reward", named, ("none: it is 1 for success",))
    return {**weights, **changed, **own}


def further_terms(
    asked: Any, known: Iterable[str], ready: Iterable[Measured]
) -> tuple[Measured, ...]:
    """Check reward terms besides the known ones of a task; a name stands for a ready one."""
    single = isinstance(asked, str | Mapping) or not isinstance(asked, Iterable)
    offered = {term.name: term for term in ready}
    names = [*known, SUCCESS]
    found: list[Measured] = []
    for one in (asked,) if single else tuple(asked):
        own = offered.get(one) if isinstance(one, str) else one
        if not isinstance(own, Measured) or own.mechanism is None or own.shape:
            allowed = "a Measured variable of shape () with a mechanism"
            raise UnknownOption("terms", one, (*offered, allowed))
        if not own.name.startswith(PREFIX) or own.name in names:
            allowed = f"a new name that begins with {PREFIX!r}"
            raise UnknownOption("name of a reward term", own.name, (allowed,))
        names.append(own.name)
        found.append(own)
    return tuple(found)


def one_number(values: Values, name: str, terms: Iterable[str]) -> float:
    """Return the value of a variable as a number, or blame the terms that it is computed from."""
    try:
        number = float(values[name])
    except (TypeError, ValueError):
        number = math.nan
    if math.isfinite(number):
        return number
    blamed = {term: values[term] for term in terms if term in values}
    wrong = {t: v for t, v in blamed.items() if np.shape(v) or not np.isfinite(v).all()}
    raise ModelError(
        [f"{name} is not a finite number, because of {wrong}; their mechanisms must give one each"]
    )


@typed
def term(
    name: str,
    function: Callable[..., Any] | Function,
    parents: Iterable[str | Parent],
    doc: str | None = None,
) -> Measured:
    """Declare a reward term.

    Args:
        name: It begins with ``reward.``.
        function: Its mechanism.
        parents: Its causes.
        doc: One sentence; that of the function, without "Compute", if None.
    """
    mechanism = function if isinstance(function, Function) else Function(function)
    if doc is None:
        text = (mechanism.resolve().__doc__ or "").partition("\n")[0].removeprefix("Compute ")
        doc = text[:1].upper() + text[1:]
    return Measured(name=name, parents=tuple(parents), mechanism=mechanism, doc=doc)


def weighted(
    *rows: tuple[Any, ...], fraction: float
) -> tuple[Mapping[str, float], tuple[Measured, ...]]:
    """Return default weights, and the dense terms that they are for.

    A row has the default weight of a term, its name without the prefix, and the other arguments of
    ``term``; ``fraction`` is the default weight of the fractional success.
    """
    weights = {f"{PREFIX}{name}": weight for weight, name, *_ in rows}
    terms = tuple(term(f"{PREFIX}{name}", *row) for _, name, *row in rows)
    return {**weights, FRACTION: fraction}, terms


def reward(weights: Mapping[str, float]) -> Variable:
    """Declare the reward: the weighted sum of the terms whose weight is not zero."""
    used = {name: weight for name, weight in weights.items() if weight != 0.0}
    return Measured(
        name="reward",
        parents=tuple(used),
        mechanism=Linear(weights=tuple(used.values())),
        doc="Weighted sum of the reward terms.",
    )


def declared(name: str, given: Declaration) -> Variable:
    """Declare reward, success or the end of an episode.

    Given is ``(function, "parent", …)``, the name of a variable whose value it is, or itself.
    """
    if isinstance(given, Variable) and given.equation is not None and given.name == name:
        return given
    if isinstance(given, str):
        given = Linear(weights=(1.0,)), given
    function, *parents = given if isinstance(given, tuple | list) and given else (given,)
    if not (callable(function) or isinstance(function, Function | Linear)) or not parents:
        raise ModelError(
            [
                f"{name}={given!r} is not a declaration: give a function and the names of its "
                f"parents, ({name}_of, 'hinge.position'), the name of a variable, or "
                f"sw.Measured(name={name!r}, …)"
            ]
        )
    form: dict[str, Any] = {"dtype": "integer", "bounds": Integers(0, 1)}
    form = {"reward": {}, FRACTION: {"bounds": UNIT}}.get(name, form)
    return Measured(name=name, parents=tuple(parents), mechanism=function, **form)


def succeeded() -> Variable:
    """Declare success: more than nine tenths of the fractional success."""
    above_most = Function(above, constants={"threshold": FULFILLED})
    doc = "1 where more than nine tenths of the goal are filled."
    return declared(SUCCESS, (above_most, FRACTION)).model_copy(update={"doc": doc})


@njit(cache=True)
def above(value: Value, threshold: Value) -> int:
    """Return whether a number lies above a threshold, as 0 or 1."""
    return int(scalar(value) > scalar(threshold))
