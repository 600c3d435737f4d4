"""The description of any articulated system: typed tables of what can be set, read and commanded.

Engine-free. ``backends.mujoco.reading`` makes it from a file, for every backend; a backend realises
it. The tables say on which kinematic trees each quantity acts, always or
while there is contact: the causal graph follows from them and from nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from sys import intern
from typing import Any, Literal, final

import numpy as np

from scm_world._types import Integers
from scm_world.errors import ModelError, UnknownOption
from scm_world.models.camera import Views
from scm_world.models.scene import BodyRow, ParameterKey, Parameters, StateLayout, Structure

Numbers = float | tuple[float, ...]
"""One number, or one for each component."""


REPORTED = "qfrc_actuator"
"""The array of what engines report and what cannot be set: torques and forces of actuators."""


HELD = "held"
"""The array of states that no engine has: the world keeps them from step to step."""

NOT_EXPOSED = "is not exposed; name it in expose=[…]"
"""Why a parameter that can be set is not a variable."""

Refusals = tuple[tuple[str, str, tuple[str, ...]], ...]
"""Attributes, each with a reason and with elements: there are more than parameters."""

SCALED = ("mass", "inertia")
"""What the factor of a body multiplies; see ``Model.scales``."""


@dataclass(frozen=True)
class ModelRow:
    """A named quantity.

    Attributes:
        name: ``"<element>.<attribute>"``, unique in the model.
        unit: SI unit; ``"1"`` without one.
        shape: Of one value.
        default: In the model as it was given.
        low: Lower bound, of all components or of each; ``-inf`` without a bound.
        high: Upper bound.
        doc: One sentence.
        always: Numbers of the trees on whose states it acts in every step.
        contact: Numbers of the trees on which it acts while bodies touch.
    """

    name: str
    unit: str
    shape: tuple[int, ...]
    default: Numbers
    low: Numbers
    high: Numbers
    doc: str
    always: frozenset[int] = frozenset()
    contact: frozenset[int] = frozenset()


@final
@dataclass(frozen=True)
class Parameter(ModelRow):
    """A property of an element that holds until it is set again.

    Attributes:
        slot: Finds where the value stands, given MuJoCo's model and data; it can be pickled. None
            for what cannot be written.
        kind: ``"real"``, ``"rotation"`` (unit quaternion), ``"inertia"`` (principal moments, which
            obey the triangle inequality) or ``"switch"`` (0 or 1).
        visual: Whether it acts on pictures only.
        body: Number of the body whose mass, place or shape it belongs to; -1 if to none.
        usual: Whether it is exposed unless something else is asked for.
        refusal: Why it cannot be set, to be read after its name; empty if it can.
        key: The element and the property, as backends know it.
    """

    slot: Callable[[Any, Any], Any] | None = field(default=None, repr=False, compare=False)
    kind: Literal["real", "rotation", "inertia", "switch"] = "real"
    visual: bool = False
    body: int = -1
    usual: bool = True
    refusal: str = ""
    key: ParameterKey = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise UnknownOption("name", self.name, ("a text, such as 'pole.mass'",))
        element, _, attribute = self.name.rpartition(".")
        object.__setattr__(self, "key", (intern(element), intern(attribute)))


@final
@dataclass(frozen=True)
class StateRow(ModelRow):
    """Something that physics moves, or that it reports. Its own trees are in ``always``.

    Attributes:
        trees: Numbers of the kinematic trees it belongs to.
        kind: ``"rotation"`` for a unit quaternion (x, y, z, w).
        array: The array of MuJoCo's data it is kept in: ``"qpos"``, ``"qvel"`` or ``"act"``, or
            ``"qfrc_actuator"`` for a reported value.
        numbers: Its places in that array, in order.
        frame: ``"world"`` for the orientation and the angular velocity of a free body whose
            quaternion has w >= 0 and whose angular velocity is given in the world.
        follows: How it follows others where they are set; None if it does not. Called with the
            values of the states and parameters called ``names``, it returns its own. Its ``carry``
            takes the present value, and theirs before and after they were set; ``among`` returns it
            for a model without some of the parameters. It can be pickled.
    """

    trees: frozenset[int] = frozenset()
    kind: Literal["real", "rotation"] = "real"
    array: str = ""
    numbers: tuple[int, ...] = ()
    frame: Literal["body", "world"] = "body"
    follows: Any = field(default=None, repr=False, compare=False)

    @property
    def reported(self) -> bool:
        """Whether the engine computes it in every step, so that it cannot be set."""
        return self.array == REPORTED


@final
@dataclass(frozen=True)
class Readout:
    """A quantity that follows from states and parameters at lag 0, such as the place of a site.

    Attributes:
        name: ``"<element>.<attribute>"``.
        unit: SI unit.
        shape: Of one value.
        parents: Names of the states and parameters that it is a function of.
        function: Takes their values in that order, and gives the value. It can be pickled.
        doc: One sentence.
    """

    name: str
    unit: str
    shape: tuple[int, ...]
    parents: tuple[str, ...]
    function: Callable[..., Any]
    doc: str


def grouped(refused: Iterable[tuple[ParameterKey, str]]) -> Refusals:
    """Group refused attributes by attribute and reason."""
    found: dict[tuple[str, str], list[str]] = {}
    for (element, attribute), reason in refused:
        found.setdefault((attribute, reason), []).append(element)
    return tuple((*key, tuple(elements)) for key, elements in found.items())


@dataclass(frozen=True, eq=False)
class Model(Structure):
    """A system: what a backend compiles, and the tables of what there is.

    Two models are equal if their backends would compile the same from them.

    Attributes:
        name: Name of the system.
        digest: Hash of everything that decides the compiled model.
        source: What a backend compiles: only the reader and its backend look into it.
        timestep: Physics step [s].
        parameters: What can be set and holds.
        states: What moves, in the order of the state vector.
        inputs: The components of a command, in order; their bounds are the ranges of actuators.
        scales: Factors of the mass and the inertia of bodies, where they are exposed. A task
            derives both parameters from them; backends do not know them.
        readouts: What follows at lag 0 from the others; those that were asked for.
        trees: Names of the kinematic trees (bodies with one root), by number; after them, those of
            inner states of actuators on which no tree acts.
        refusals: Attributes that cannot be set or exposed, each with the reason, and of which
            elements; see ``grouped``.
        notes: What acts without having a variable (plugins, flex), one sentence each.
        staged: Whether its physics steps have stages (Runge-Kutta), in each of which bodies may
            touch, while a backend lists the contacts of the last one alone.
        bodies: All bodies, parents before their children; the first is the world.
        owners: Name of the body of each shape, and of each flex, as contacts list it.
        keyframes: Names of the keyframes of its file; one without a name has its number.
        exact: Whether a state is all that decides its future; if not, the solver has a memory.
        instead: Makes the model that Bullet realises in place of this one, where that is another
            one. It can be pickled.
        fidelity: How far it is from plain MuJoCo with its file, where that was measured.
    """

    name: str
    digest: str
    source: Any = field(repr=False)
    timestep: float
    parameters: tuple[Parameter, ...]
    states: tuple[StateRow, ...]
    inputs: tuple[ModelRow, ...]
    scales: tuple[Parameter, ...] = ()
    readouts: tuple[Readout, ...] = ()
    trees: tuple[str, ...] = ()
    refusals: Refusals = ()
    notes: tuple[str, ...] = ()
    staged: bool = False
    bodies: tuple[BodyRow, ...] = field(default=(), repr=False)
    owners: tuple[str, ...] = field(default=(), repr=False)
    keyframes: tuple[str, ...] = ()
    exact: bool = True
    instead: Callable[[], Model] | None = field(default=None, repr=False)
    views: Views | None = field(default=None, repr=False)
    fidelity: Any = field(default=None, repr=False)

    @classmethod
    def of(cls, structure: Structure, engine: str) -> Model:
        """Return a structure that is a model.

        Raises:
            ModelError: It is not, and the engine of this name realises nothing else.
        """
        if isinstance(structure, Model):
            return structure
        kind = type(structure).__name__
        raise ModelError([f"{engine} cannot realise a {kind}; it takes models"])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Model) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __fingerprint__(self) -> str:
        return self.digest

    def hidden(self) -> list[dict[str, Any]]:
        """List the attributes that are no variables, those of a kind and a reason in one row.

        Each has the name of the ``attribute``, the ``elements`` that have it, the pattern that
        would ``expose`` it (empty where it cannot be set), and the ``reason``.
        """
        found = []
        for attribute, reason, elements in self.refusals:
            can, pattern = reason == NOT_EXPOSED, f"*.{attribute}" if elements[0] else attribute
            row = {"attribute": attribute, "elements": [*elements], "expose": pattern * can}
            found.append({**row, "reason": "" if can else reason})
        return found

    @property
    def refused(self) -> dict[str, str]:
        """What cannot be set or exposed, by name, with the reason."""
        return {
            f"{element}.{attribute}" if element else attribute: reason
            for attribute, reason, elements in self.refusals
            for element in elements
        }

    @property
    def n_commands(self) -> int:
        """How many numbers a command has."""
        return len(self.inputs)

    @cached_property
    def layout(self) -> StateLayout:
        """Where each state stands in the vector."""
        sizes = tuple(int(np.prod(row.shape)) for row in self.states)
        start = [np.broadcast_to(row.default, row.shape).ravel() for row in self.states]
        return StateLayout(
            tuple(row.name for row in self.states),
            sizes,
            tuple(np.concatenate([*start, np.empty(0)]).tolist()),
            frozenset(row.name for row in self.states if row.reported),
            frozenset(row.name for row in self.states if row.array == HELD),
        )

    @cached_property
    def rows(self) -> dict[ParameterKey, Parameter]:
        """The parameters, by key."""
        return {row.key: row for row in self.parameters}

    def places(self, array: str) -> Integers:
        """Return places in an array of MuJoCo's data, in order, and in the vector, shape (2, n)."""
        starts = self.layout.slices
        pairs = sorted(
            (number, place)
            for row in self.states
            if row.array == array
            for place, number in enumerate(row.numbers, starts[row.name].start)
        )
        return np.ascontiguousarray(np.array(pairs, dtype=np.int64).reshape(-1, 2).T)

    def slots(self, mj: object, data: object) -> dict[ParameterKey, Any]:
        """Find the places of all parameters in MuJoCo's model and data."""
        return {row.key: row.slot(mj, data) for row in self.parameters if row.slot is not None}

    @cached_property
    def defaults(self) -> Parameters:
        """The default of every parameter, by key."""
        return {
            row.key: np.array(np.broadcast_to(row.default, row.shape), dtype=np.float64)
            for row in self.parameters
        }
