"""Where rows come from: what a source is, and the rows of some episodes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, final

import numpy as np

from scm_world.discovery.data.dataset import Column, Dataset
from scm_world.graph.structure import Edge
from scm_world.policies.scripted import Sequence as Given

FORMAT = "scm_world/dataset/1"

Tell = Callable[[int], None]
"""Told how many further episodes are done."""


@final
@dataclass(frozen=True)
class SourceRows:
    """The rows of some episodes.

    Attributes:
        table: The rows.
        refused: Numbers of the episodes that could not be, and why.
    """

    table: Dataset
    refused: tuple[tuple[int, str], ...] = ()


class DataSource(Protocol):
    """Something that has episodes; the rows of episode i depend on the seed and on i only.

    Attributes:
        columns: What stands in a row.
        about: Everything that decides the rows, as plain data.
        edges: The declared graph; None where it may not be known.
        at_once: Whether any number of episodes takes one piece of work.
        uneven: Whether some episodes say little of the others: that most of them are refused is
            known only when all are done.
    """

    columns: tuple[Column, ...]
    about: dict[str, Any]
    edges: tuple[Edge, ...] | None
    at_once: bool
    uneven: bool

    def part(self, numbers: range, tell: Tell) -> SourceRows:
        """Let some episodes happen."""


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
