"""Typed variables, their spaces, their noise, and what can be done to them."""

from scm_world.variables.bundles import bundle
from scm_world.variables.distributions import (
    Bernoulli,
    Continuous,
    Cylinder,
    Discrete,
    Distribution,
    Noise,
    Normal,
)
from scm_world.variables.interventions import (
    Draw,
    Hard,
    Intervention,
    Mechanism,
    Natural,
    Null,
)
from scm_world.variables.kinds import (
    Action,
    Derived,
    Exogenous,
    Fixed,
    Measured,
    Parent,
    Variable,
    names,
)
from scm_world.variables.mechanisms import Concatenation, Function, Linear, Table
from scm_world.variables.moments import Moment, NoiseKey
from scm_world.variables.soft import Scale, Shift, Soft
from scm_world.variables.spaces import (
    Affine,
    Box,
    Categories,
    Either,
    Integers,
    Rotations,
    Space,
    Switch,
)
from scm_world.variables.subsets import AB, A, B, Subset
from scm_world.variables.times import Contact, Reaches, Time

__all__ = [
    "AB",
    "A",
    "Action",
    "Affine",
    "B",
    "Bernoulli",
    "Box",
    "Categories",
    "Concatenation",
    "Contact",
    "Continuous",
    "Cylinder",
    "Derived",
    "Discrete",
    "Distribution",
    "Draw",
    "Either",
    "Exogenous",
    "Fixed",
    "Function",
    "Hard",
    "Integers",
    "Intervention",
    "Linear",
    "Measured",
    "Mechanism",
    "Moment",
    "Natural",
    "Noise",
    "NoiseKey",
    "Normal",
    "Null",
    "Parent",
    "Reaches",
    "Rotations",
    "Scale",
    "Shift",
    "Soft",
    "Space",
    "Subset",
    "Switch",
    "Table",
    "Time",
    "Variable",
    "bundle",
    "names",
]
