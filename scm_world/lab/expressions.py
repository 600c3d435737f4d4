"""Expressions of an agent: parsed, never run as code."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from scm_world._arguments import typed
from scm_world._types import Floats
from scm_world.errors import UnknownOption

LONGEST, MOST, STEEPEST = 600, 200, 10.0
"""Characters and nodes of an expression, and the largest exponent."""

FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    name: getattr(np, name) for name in ("sin", "cos", "tanh", "exp", "log", "sqrt", "abs", "sign")
} | {"min": np.minimum, "max": np.maximum}
OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
FORM = (
    f"numbers, the variable, + - * / **, and {', '.join(FUNCTIONS)}, in at most {LONGEST} "
    f"characters, with constant exponents up to {STEEPEST:g}"
)


@typed
def evaluate(text: str, values: Mapping[str, Any]) -> Floats:
    """Compute an expression of variables.

    Args:
        text: The expression, such as ``"2 * x ** 3 - abs(x)"``; names may have dots.
        values: Numbers of each variable, shape (n,).

    Returns:
        The values of the expression, shape (n,); not finite where it is not defined.

    Raises:
        UnknownOption: The text is no expression, is too long, or contains something else than
            numbers, the variables, arithmetic and the listed functions.

    Example:
        >>> evaluate("2 * x ** 2", {"x": [1.0, 3.0]})
        array([ 2., 18.])
    """
    known = {name: np.asarray(value, dtype=np.float64) for name, value in values.items()}

    def refused(part: str) -> UnknownOption:
        return UnknownOption("expression", part[:80], (FORM, *known))

    def of(node: ast.AST) -> Any:
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return np.float64(number)
            case ast.Name() | ast.Attribute() if ast.unparse(node) in known:
                return known[ast.unparse(node)]
            case ast.BinOp(op=ast.Pow(), right=right):
                if any(isinstance(part, ast.Name) for part in ast.walk(right)):
                    raise refused(ast.unparse(node))
                exponent = of(right)
                if not abs(exponent) <= STEEPEST:
                    raise refused(ast.unparse(node))
                return of(node.left) ** exponent
            case ast.BinOp() if type(node.op) in OPERATORS:
                return OPERATORS[type(node.op)](of(node.left), of(node.right))
            case ast.UnaryOp() if type(node.op) in OPERATORS:
                return OPERATORS[type(node.op)](of(node.operand))
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in FUNCTIONS:
                if len(args) != (2 if name in ("min", "max") else 1):
                    raise refused(ast.unparse(node))
                return FUNCTIONS[name](*map(of, args))
        raise refused(ast.unparse(node))

    try:
        if len(text) > LONGEST:
            raise ValueError
        tree = ast.parse(text.strip(), mode="eval").body
        if sum(1 for _ in ast.walk(tree)) > MOST:
            raise ValueError
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise refused(text) from None
    with np.errstate(all="ignore"):
        n = len(next(iter(known.values())))
        return np.broadcast_to(np.asarray(of(tree), dtype=np.float64), (n,)).copy()
