"""Values, interventions and systems as they are typed on the command line."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from scm_world.errors import ConflictingTargets, UnknownOption

if TYPE_CHECKING:
    from scm_world.queries import SCM, Outcome, World

HINT = "'NAME=VALUE...'"
WORDS = {"true": True, "false": False, "none": None}


def refused(text: str, why: str, hint: str = HINT) -> typer.BadParameter:
    """Return the error of a text that cannot be read."""
    return typer.BadParameter(f"{text!r}: {why}", param_hint=hint)


# --- values ---------------------------------------------------------------------------------------


def parse_value(text: str, hint: str = HINT) -> Any:
    """Return what a text means: an intervention, JSON, a list without brackets, or a word.

    Example:
        >>> parse_value("0.05"), parse_value("0, 0, -5"), parse_value("True"), parse_value("linear")
        (0.05, [0, 0, -5], True, 'linear')
        >>> parse_value("shift:0.1"), parse_value("scale:draw:0.8,1.2").by.source.describe()
        (Shift(kind='shift', by=0.1), '0.8 to 1.2')
        >>> parse_value("scale:shared:0.8,1.2").shared
        True
    """
    from scm_world.variables import Draw, Scale, Shift

    if not text.strip():
        raise refused(text, "there is no value", hint)
    *how, last = text.split(":")
    value = _plain(last)
    ends = value if isinstance(value, list) else [value]
    try:
        match [word.strip().lower() for word in how]:
            case ["draw"]:
                return Draw(*ends)
            case ["shift" | "scale" as kind]:
                return (Shift if kind == "shift" else Scale)(value)
            case ["shift" | "scale" as kind, "draw" | "shared" as drawn]:
                relative: Any = Shift if kind == "shift" else Scale
                return relative(Draw(*ends), shared=drawn == "shared")
    except (TypeError, ValueError):
        wanted = "draw:A, draw:B, draw:A|B or two ends, draw:0.8,1.2"
        if how[0].strip().lower() != "draw":
            wanted = "numbers, or two ends of a draw, as in scale:draw:0.8,1.2 (shared:0.8,1.2)"
        raise refused(text, f"expected {wanted}", hint) from None
    return _plain(text)


def _plain(text: str) -> Any:
    with suppress(ValueError):
        return json.loads(text)
    bare = text.strip()
    listed = bare.startswith("[") and bare.endswith("]")
    if listed or "," in bare:
        return [_plain(part) for part in (bare[1:-1] if listed else bare).split(",")]
    with suppress(ValueError):
        return float(bare)
    return WORDS.get(bare.lower(), bare)


def parse_assignments(
    texts: Iterable[str] | None,
    hint: str = HINT,
    read: Callable[[str, str], Any] = parse_value,
) -> dict[str, Any]:
    """Return the values of ``name=value`` texts by name; ``hint`` is their option, for messages."""
    request: dict[str, Any] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise refused(text, "expected name=value, for example floor_friction=0.4", hint)
        if name in request:
            raise ConflictingTargets((name, name), name)
        request[name] = read(value, hint)
    return request


def parse_outcome(text: str) -> Outcome:
    """Return the outcome of a text: ``name``, ``name[2]`` or ``how:name``.

    Example:
        >>> print(parse_outcome("reward"), parse_outcome("sum:gravity[2]"))
        final reward sum gravity[2]
    """
    from scm_world.queries import Outcome

    before, _, name = text.rpartition(":")
    component = re.fullmatch(r"(.+)\[(\d+)\]", name)
    if component is None:
        return Outcome(name, before or "final")
    return Outcome(component[1], before or "final", int(component[2]))


def split(text: str) -> list[str]:
    """Return the words of a text with commas between them, each once."""
    return list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


# --- systems --------------------------------------------------------------------------------------


def load_system(
    name: str,
    option: Sequence[str] | None = None,
    backend: str | None = None,
    *,
    is_task: bool = False,
) -> Any:
    """Return a task, or, unless only a task will do, a causal model; print the notes about a file.

    Example:
        >>> load_system("towers", ["number_of_blocks_in_tower=1,1,2"]).tools
        ('tool_level_0_col_0_row_0', 'tool_level_1_col_0_row_0')
    """
    from scm_world.discovery.problems import system_of
    from scm_world.tasks import ModelTask, make_task

    given = parse_assignments(option, "'--option'")
    lists = {key: tuple(value) for key, value in given.items() if isinstance(value, list)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they are among the notes
        made = (make_task if is_task else system_of)(name, **given | lists)
    for note in getattr(getattr(made, "system", None), "notes", ()):
        typer.echo(f"note: {note}", err=True)
    if isinstance(made, ModelTask):
        from scm_world.backends.mujoco.fidelity import fidelity

        found = fidelity(made.system, backend or "mujoco")
        lines = [*(f"note: {note}" for note in found.notes), f"fidelity: {found}"]
        typer.echo("\n".join(lines), err=True)
    return made


def open_system(
    name: str, option: Sequence[str] | None = None, **settings: str | None
) -> World | SCM:
    """Return a world with its settings, or a causal model, which has none."""
    from scm_world.queries import SCM, World

    made = load_system(name, option, settings.get("backend"))
    if not isinstance(made, SCM):
        return World(made, **settings)  # type: ignore[arg-type] # names are checked by the world
    refuse_settings(**settings)
    return made


def refuse_settings(**settings: str | None) -> None:
    """Refuse settings of a world for a causal model without a backend."""
    for setting, value in settings.items():
        if value is not None:
            allowed = ("left out: a causal model without a backend has none",)
            raise UnknownOption(f"--{setting}", value, allowed)


def engine_of(system: World | SCM) -> str:
    """Return name and version of the physics engine; ``"equations"`` where there is none."""
    return getattr(system, "engine", "equations")


def tag(name: str) -> str:
    """Return the name of a system in titles and folders: of a file, its stem.

    Example:
        >>> tag("pushing"), tag("models/cartpole.xml"), tag("my.worlds:cartpole")
        ('pushing', 'cartpole', 'my.worlds-cartpole')
    """
    home, colon, function = name.rpartition(":")
    if colon:
        return f"{Path(home).stem if home.endswith('.py') else home}-{function}"
    return Path(name).stem if name.lower().endswith((".xml", ".mjcf", ".urdf")) else name
