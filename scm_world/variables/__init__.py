"""Typed variables, their spaces, their noise, and what can be done to them."""

from scm_world.variables.bundles import bundle, divided, part_of, whole_of
from scm_world.variables.distributions import Cylinder, Distribution, Normal
from scm_world.variables.interventions import (
    SOFT,
    Draw,
    Hard,
    Intervention,
    Mechanism,
    Natural,
    Null,
    Scale,
    Shift,
)
from scm_world.variables.kinds import (
    Action,
    AnyVariable,
    Derived,
    Exogenous,
    Fixed,
    Measured,
    Parent,
    Variable,
    names,
)
from scm_world.variables.mechanisms import Concatenation, Equation, Function, Linear
from scm_world.variables.noise import Noise
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

__all__ = [
    "AB",
    "SOFT",
    "A",
    "Action",
    "Affine",
    "AnyVariable",
    "B",
    "Box",
    "Categories",
    "Concatenation",
    "Cylinder",
    "Derived",
    "Distribution",
    "Draw",
    "Either",
    "Equation",
    "Exogenous",
    "Fixed",
    "Function",
    "Hard",
    "Integers",
    "Intervention",
    "Linear",
    "Measured",
    "Mechanism",
    "Natural",
    "Noise",
    "Normal",
    "Null",
    "Parent",
    "Rotations",
    "Scale",
    "Shift",
    "Space",
    "Subset",
    "Switch",
    "Variable",
    "bundle",
    "divided",
    "names",
    "part_of",
    "whole_of",
]
