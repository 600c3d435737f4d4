"""Facts about errors: what they say, what they carry, and that they travel."""

from __future__ import annotations

import copy
import inspect
import pickle
from typing import Any

import pytest

from scm_world import errors
from scm_world.errors import (
    ActionError,
    ClosesCycle,
    ConflictingTargets,
    CyclicModel,
    Diverged,
    EngineError,
    EngineFailure,
    EvaluationError,
    Forbidden,
    FunctionFailure,
    ImpossibleObservation,
    InexactEngine,
    Infeasible,
    InterventionError,
    MissingEngine,
    MissingExtra,
    ModelError,
    NotIntervenable,
    NotReset,
    OutOfBounds,
    ScmWorldError,
    SeveralProblems,
    SnapshotMismatch,
    UnknownOption,
    UnknownVariable,
    UnreadableFile,
    UnwritableFolder,
    WrongValue,
    nearest,
    raise_all,
)

CLASSES = [
    c
    for name, c in inspect.getmembers(errors, inspect.isclass)
    if issubclass(c, ScmWorldError) and not name.startswith("_")
]

EXAMPLES: list[tuple[ScmWorldError, str, dict[str, Any]]] = [
    (
        UnknownVariable("tool_blok.mass", ["floor_friction", "tool_block.mass"]),
        "no variable is named 'tool_blok.mass'; did you mean 'tool_block.mass'?",
        {"variable": "tool_blok.mass", "suggestion": "tool_block.mass"},
    ),
    (
        ImpossibleObservation("x", "no value of its noise gives what was observed"),
        "'x': no value of its noise gives what was observed",
        {"variable": "x"},
    ),
    (
        UnknownVariable("zzz", ["tool_block.mass"]),
        "no variable is named 'zzz'",
        {"suggestion": None},
    ),
    (
        NotIntervenable("tool_block.speed", "is measured, not set", ["tool_block.mass"]),
        "'tool_block.speed' is measured, not set; intervene on a cause of it instead: "
        "tool_block.mass",
        {"variable": "tool_block.speed", "causes": ("tool_block.mass",)},
    ),
    (
        WrongValue("block.size", 0.1, (3,), ()),
        "do(block.size): expected shape (3,), got ()",
        {"variable": "block.size", "value": 0.1, "expected": (3,), "actual": ()},
    ),
    (
        WrongValue("m", "x", "numbers"),
        "do(m): expected numbers, got 'x' of type str",
        {"value": "x", "expected": "numbers"},
    ),
    (
        WrongValue("m", float("inf")),
        "do(m): every number must be finite, got inf",
        {"variable": "m", "value": float("inf")},
    ),
    (
        OutOfBounds("m", 3.0, allowed="[0, 2]", nearest=2.0, unit="kg"),
        "do(m): 3.0 is outside [0, 2] [kg]; the nearest allowed value is 2.0",
        {"variable": "m", "value": 3.0, "allowed": "[0, 2]", "nearest": 2.0},
    ),
    (
        OutOfBounds("mu", 3.0, allowed="[0, 2]", nearest=2.0, unit="1"),
        "do(mu): 3.0 is outside [0, 2]; the nearest allowed value is 2.0",
        {},
    ),
    (
        OutOfBounds("m", 3.0, space="B", allowed="[1, 2]", nearest=2.0, unit="kg"),
        "do(m): 3.0 is outside space B = [1, 2] [kg]; the nearest allowed value is 2.0",
        {"space": "B", "allowed": "space B = [1, 2]", "nearest": 2.0},
    ),
    (
        ConflictingTargets(("p", "q"), "p"),
        "'p' and 'q' both set 'p'; give one of them",
        {"variable": "p", "names": ("p", "q")},
    ),
    (
        Infeasible("p", [0.0], ["'a' lies 3 mm deep in 'b'"], [1.0]),
        "do(p): [0.0] is not feasible: 'a' lies 3 mm deep in 'b'; the nearest feasible value is "
        "[1.0]",
        {"problems": ("'a' lies 3 mm deep in 'b'",), "nearest": [1.0]},
    ),
    (
        SeveralProblems([UnknownVariable("x", []), WrongValue("m", 1.0)]),
        "2 problems, nothing was changed:\n"
        "  - no variable is named 'x'\n"
        "  - do(m): every number must be finite, got 1.0",
        {"variable": "x"},
    ),
    (
        ModelError(["one", "two"]),
        "2 problems:\n  - one\n  - two",
        {"problems": ("one", "two")},
    ),
    (
        ClosesCycle("x", 1, ("x", "y")),
        "do(x): contemporaneous edges would form a cycle: x → y → x",
        {"variable": "x", "cycle": ("x", "y")},
    ),
    (
        CyclicModel([("x", "y")]),
        "contemporaneous edges form a cycle: x → y → x",
        {"cycles": (("x", "y"),)},
    ),
    (ActionError("an action is 9 numbers", 3), "an action is 9 numbers", {"action": 3}),
    (
        FunctionFailure("the policy 'mine' raised KeyError: 'x'"),
        "the policy 'mine' raised KeyError: 'x'",
        {"problems": ("the policy 'mine' raised KeyError: 'x'",), "row": None},
    ),
    (NotReset(), "the world has no episode yet; call reset() first", {"closed": False}),
    (
        UnknownOption("task", "pushin", ["reaching", "pushing"]),
        "no task is named 'pushin'; did you mean 'pushing'?; there are: reaching, pushing",
        {"option": "task", "value": "pushin", "choices": ("reaching", "pushing")},
    ),
    (
        Forbidden("set gravity", ["floor_friction"]),
        "this laboratory does not let you set gravity; allowed: floor_friction",
        {"what": "set gravity", "allowed": ("floor_friction",)},
    ),
    (
        UnreadableFile("p.zip", "it is no zip archive", "give another one"),
        "'p.zip' cannot be read: it is no zip archive; give another one",
        {"path": "p.zip", "reason": "it is no zip archive"},
    ),
    (
        UnwritableFolder("results", "No space left on device"),
        "'results' cannot be written to: No space left on device; its files are "
        "complete, and the same call goes on there once there is room, or the permission",
        {"path": "results", "reason": "No space left on device"},
    ),
    (
        MissingExtra("minari", "data"),
        "this needs the package 'minari'; install it with: pip install 'scm-world[data]'",
        {"package": "minari", "extra": "data"},
    ),
    (
        MissingEngine("bullet", "pip install pybullet", "no wheel"),
        "the bullet engine is not installed (no wheel); try: pip install pybullet",
        {"engine": "bullet", "install": "pip install pybullet"},
    ),
    (EngineFailure("lost", "fake"), "lost", {"engine": "fake"}),
    (
        InexactEngine("a replay", "warp", 1e-4, ["mujoco", "bullet"]),
        "a replay needs equal runs to be equal bit for bit, and on 'warp' they may be 0.0001 "
        "apart; use a backend that is exact: mujoco, bullet",
        {"engine": "warp", "question": "a replay", "floor": 1e-4, "exact": ("mujoco", "bullet")},
    ),
    (
        Diverged(4096),
        "the weights are not finite any more after 4,096 steps; the last checkpoint is from "
        "before; begin in another folder with a lower learning rate (rate.initial) or smaller "
        "rewards",
        {"steps": 4096},
    ),
    (
        EvaluationError({"protocol": "P2", "episode": 17}, "the policy gave NaN"),
        "protocol P2, episode 17: the policy gave NaN",
        {"place": {"protocol": "P2", "episode": 17}, "reason": "the policy gave NaN"},
    ),
    (SnapshotMismatch("another scene"), "another scene", {}),
]


def identify(value: Any) -> str | None:
    """Name an example by its class."""
    return type(value).__name__ if isinstance(value, ScmWorldError) else None


@pytest.mark.parametrize(("error", "message", "data"), EXAMPLES, ids=identify)
def test_errors_say_what_was_given_and_what_is_allowed(
    error: ScmWorldError, message: str, data: dict[str, Any]
) -> None:
    """The message is as promised, and the data are attributes."""
    assert str(error) == message
    assert {name: getattr(error, name) for name in data} == data


@pytest.mark.parametrize(("error", "message", "data"), EXAMPLES, ids=identify)
@pytest.mark.parametrize(
    "travel",
    [
        lambda e: pickle.loads(pickle.dumps(e)),  # noqa: S301
        copy.copy,
        lambda e: type(e)(e),  # as Gymnasium raises the errors of its processes again
    ],
)
def test_errors_travel_between_processes(
    error: ScmWorldError, message: str, data: dict[str, Any], travel: Any
) -> None:
    """An error that was pickled says and carries the same."""
    again = travel(error)
    assert type(again) is type(error)
    assert str(again) == message
    assert {name: getattr(again, name) for name in data} == data


def test_several_problems_travel_with_their_parts() -> None:
    """Each problem keeps its own data."""
    parts = [WrongValue("block.size", 0.1, (3,), ()), UnknownVariable("x", ["y"])]
    again = pickle.loads(pickle.dumps(SeveralProblems(parts)))  # noqa: S301
    assert [type(p) for p in again.problems] == [WrongValue, UnknownVariable]
    assert again.problems[0].expected == (3,)


def test_every_error_is_shown_here() -> None:
    """A new class needs an example above."""
    abstract = {ScmWorldError, InterventionError, EngineError}
    assert {type(error) for error, _, _ in EXAMPLES} == set(CLASSES) - abstract


@pytest.mark.parametrize("kind", CLASSES, ids=lambda c: c.__name__)
def test_every_error_is_documented(kind: type[ScmWorldError]) -> None:
    """It has a docstring, and is named as imported."""
    assert kind.__doc__
    assert f"{kind.__module__}.{kind.__qualname__}" == f"scm_world.errors.{kind.__name__}"


@pytest.mark.parametrize(
    ("kind", "builtin"),
    [
        (InterventionError, ValueError),
        (ModelError, ValueError),
        (ActionError, ValueError),
        (UnknownOption, ValueError),
        (NotReset, RuntimeError),
        (EngineError, RuntimeError),
        (MissingEngine, ImportError),
    ],
)
def test_errors_are_what_python_would_call_them(
    kind: type[Exception], builtin: type[Exception]
) -> None:
    """Code that knows nothing of this package catches the builtin class."""
    assert issubclass(kind, builtin)


def test_raise_all_raises_what_there_is() -> None:
    """Nothing, the one problem itself, or all of them."""
    one, other = WrongValue("a", 1.0), WrongValue("b", 1.0)
    raise_all([])
    with pytest.raises(WrongValue) as caught:
        raise_all([one])
    assert caught.value is one
    with pytest.raises(SeveralProblems) as several:
        raise_all([one, other])
    assert several.value.problems == (one, other)


def test_nothing_is_near_when_nothing_is_alike() -> None:
    """A suggestion is made only where it helps."""
    assert nearest("mass", []) is None
    assert nearest("qqq", ["mass"]) is None
