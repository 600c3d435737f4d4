"""A laboratory: tools for an agent, a budget, and a score without a judge."""

from __future__ import annotations

import inspect
import json
import threading
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from os import PathLike
from pathlib import Path
from typing import Any, final

from scm_world._arguments import one_of, real_number, typed, whole_number
from scm_world.backends.renderer import automatic_camera, png, render, shapes_of
from scm_world.errors import Forbidden, ModelError, ScmWorldError, UnknownOption, reading
from scm_world.evaluation.statistics import Interval, mean_interval
from scm_world.lab.questions import PASSED, Question
from scm_world.models.shapes import Shapes
from scm_world.queries.experiments.versions import versions
from scm_world.runs.files import read_text, write_whole

FORMAT = "scm_world/lab/1"
TOOLS = ("describe", "observe", "experiment", "look", "note", "submit")
NOTES, LONGEST, LOOKS = 1000, 2000, 100
"""How many notes a run keeps, characters of a note, and how many episodes are looked at."""
SIZE = 240, 320
"""Height and width of a picture [pixels]."""
ROWS = 200
"""The most episodes of one call."""


@final
class Laboratory:
    """A question, and what an agent may do to answer it.

    A refused call costs and changes nothing, and says why. Calls from several threads happen one
    after another.

    Args:
        question: The question.

    Attributes:
        spent: How many episodes have been used.
        calls: The calls so far, with their results.
        score: The score, once there is a submission.
    """

    def __init__(self, question: Question) -> None:
        if not isinstance(question, Question):
            raise UnknownOption("question", question, ("a Question, as lab.question returns it",))
        self.question, self._view = question, question.view.fresh()
        self.spent, self.calls = 0, list[dict[str, Any]]()
        self._shown = list[tuple[dict[str, Any], int, int]]()  # what was done, when, which unit
        self.score: dict[str, float] | None = None
        self._lock = threading.RLock()

    @property
    def remaining(self) -> int:
        """How many episodes are left."""
        return self.question.budget - self.spent

    @property
    def finished(self) -> bool:
        """Whether an answer was submitted."""
        return self.score is not None

    # --- tools ------------------------------------------------------------------------------------

    def describe(self) -> dict[str, Any]:
        """Return the variables, what may be set, the budget, the form of an answer, the question.

        A question that is asked after the exploration is shown when the budget is spent.
        """
        return self._done("describe", {}, self._described)

    def observe(self, n: int = 1) -> dict[str, Any]:
        """Observe n new episodes, in which nothing is set; return readings by variable."""
        return self._done("observe", {"n": n}, lambda: self._run({}, 0, n))

    def experiment(self, do: dict[str, Any], at: int = 0, n: int = 1) -> dict[str, Any]:
        """Set variables in n new episodes, from step at on; return readings by variable.

        A value is a number, or a pair of numbers: it is drawn between them in each episode.
        """
        arguments = {"do": do, "at": at, "n": n}
        return self._done("experiment", arguments, lambda: self._run(self._settings(do), at, n))

    def look(self, episode: int, frames: int = 3) -> dict[str, Any]:
        """Return pictures (PNG, base64) of an episode that was run, from its beginning to its end.

        It costs no episode. Episodes are the rows of all readings so far, counted from 0. There are
        pictures of worlds with bodies, at the levels L1 and L2: they would unmask names.
        """
        arguments = {"episode": episode, "frames": frames}
        return self._done("look", arguments, lambda: self._seen(episode, frames))

    def note(self, text: str) -> dict[str, Any]:
        """Keep a remark in the record of the run; it is not scored."""
        return self._done("note", {"text": text}, lambda: self._noted(text))

    def submit(self, answer: Any, confidence: float) -> dict[str, Any]:
        """Submit the answer, once, with a probability in [0, 1] that it is right."""
        arguments = {"answer": answer, "confidence": confidence}
        return self._done("submit", arguments, lambda: self._submitted(answer, confidence))

    def call(self, tool: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Call a tool by name; a refusal is ``{"refused": why}``, not an error."""
        try:
            one_of("tool", tool, TOOLS)
            if not isinstance(arguments, Mapping | None):
                raise UnknownOption("arguments", arguments, ("a mapping by name",))
            method = getattr(self, tool)
            given, known = dict(arguments or {}), inspect.signature(method).parameters
            for name in given:
                one_of(f"argument of {tool}", name, tuple(known))
            for name, one in known.items():
                if one.default is one.empty and name not in given:
                    raise UnknownOption(f"arguments of {tool}", [*given], (f"with {name}",))
            return method(**given)  # type: ignore[no-any-return]
        except ScmWorldError as error:
            return {"refused": str(error)}

    # --- what they do -----------------------------------------------------------------------------

    def _done(
        self, tool: str, arguments: Mapping[str, Any], act: Callable[[], dict[str, Any]]
    ) -> dict[str, Any]:
        with self._lock:
            if self.finished:
                raise Forbidden(f"{tool} after the answer was submitted", ("a new laboratory",))
            plain = _plain(arguments)
            found = act()
            self.calls.append({"tool": tool, "arguments": plain, "result": found})
            return found

    def _described(self) -> dict[str, Any]:
        found = self.question.describe() | {"remaining": self.remaining}
        if self.question.late and self.remaining:
            found |= {"question": "It is asked when the budget is spent.", "query": None}
        return found

    def _settings(self, do: Any) -> dict[str, Any]:
        view = self._view
        settable = {name for name, one in view.quantities.items() if one.sets}
        if not isinstance(do, Mapping) or not do:
            raise UnknownOption("do", do, ("values by name", *sorted(settable)))
        found = {}
        for name, value in do.items():
            one_of("variable to set", name, sorted(settable))
            low, high = view.ends(name)
            many = value if isinstance(value, list | tuple) else [value]
            if not 1 <= len(many) <= 2:
                raise UnknownOption(f"value of {name}", value, ("a number", "a pair of numbers"))
            slack = 1e-9 * (high - low)
            found[name] = [
                real_number(f"value of {name}", one, least=low - slack, most=high + slack)
                for one in many
            ]
            if len(many) == 2 and not found[name][0] < found[name][1]:
                raise UnknownOption(f"value of {name}", value, ("a pair, the lower end first",))
        return found

    def _run(self, do: dict[str, Any], at: Any, n: Any) -> dict[str, Any]:
        n = whole_number("n", n, least=1, most=ROWS)
        steps = self._view.testbed.setting.get("steps", 1)
        at = whole_number("at", at, least=0, most=steps - 1)
        if n > self.remaining:
            raise Forbidden(f"run {n} more episodes", (f"{self.remaining} episodes",))
        table, first = self._view.run(do, n, at), self.spent
        self.spent += n
        keep = [*range(n)]
        if self._view.knobs.selection and not do:
            name = self._view.readable[0]
            keep = [i for i in keep if table[name][i] > self._view.middle[name]]
        self._shown += [(do, at, first + i) for i in keep]
        columns = {name: [float(column[i]) for i in keep] for name, column in table.items()}
        return {"columns": columns, "remaining": self.remaining}

    def _seen(self, episode: Any, frames: Any) -> dict[str, Any]:
        level = self.question.level
        if level not in ("L1", "L2") or self.question.world == "equations":
            allowed = ("levels L1 and L2 of all worlds but equations",)
            raise Forbidden(f"look at {self.question.world} at level {level}", allowed)
        if not self._shown:
            raise Forbidden("look at an episode before any was run", ("observe", "experiment"))
        row = whole_number("episode", episode, least=0, most=len(self._shown) - 1)
        steps = self._view.testbed.setting.get("steps", 1)
        n = whole_number("frames", frames, least=2, most=steps + 1)
        if sum(one["tool"] == "look" for one in self.calls) >= LOOKS:
            raise Forbidden("look again", (f"{LOOKS} looks",))
        run = self._view.episode(*self._shown[row])
        times = [round(i * steps / (n - 1)) for i in range(n)]
        scenes = [run.scene(step)[0] for step in times]
        camera = automatic_camera(reduce(Shapes.joined, map(shapes_of, scenes)), SIZE)
        taken = [png(render(scene, camera, samples=2).rgb) for scene in scenes]
        return {"steps": times, "pictures": [b64encode(one).decode() for one in taken]}

    def _noted(self, text: Any) -> dict[str, Any]:
        if not isinstance(text, str) or len(text) > LONGEST:
            raise UnknownOption("text", str(text)[:40], (f"a text of up to {LONGEST} characters",))
        if sum(one["tool"] == "note" for one in self.calls) >= NOTES:
            raise Forbidden("keep another note", (f"{NOTES} notes",))
        return {"kept": True}

    def _submitted(self, answer: Any, confidence: Any) -> dict[str, Any]:
        sure = real_number("confidence", confidence, least=0.0, most=1.0)
        grade = self.question.grade(answer)
        self.score = {
            "score": grade,
            "budget": self.spent / self.question.budget,
            "confidence": sure,
            "brier": brier(sure, grade),
        }
        return dict(self.score)

    # --- the record of a run ----------------------------------------------------------------------

    def record(self) -> dict[str, Any]:
        """Return the run as plain data: question, calls with results, score and versions."""
        engine = getattr(self.question.view.testbed.world, "engine", "")
        return {
            "format": FORMAT,
            "question": self.question.spec,
            "digest": self.question.digest,
            "calls": self.calls,
            "score": self.score,
            "versions": versions(str(engine)),
        }

    def save(self, path: str | PathLike[str]) -> Path:
        """Write the run to a JSON file."""
        write_whole(Path(path), json.dumps(self.record(), indent=1, allow_nan=False) + "\n")
        return Path(path)


def _plain(arguments: Mapping[str, Any]) -> Any:
    """Return arguments as JSON has them; refuse what it has not, and what is too long."""
    try:
        text = json.dumps(arguments, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        raise UnknownOption(
            "arguments", [*arguments], ("finite numbers, texts, lists, names",)
        ) from None
    if len(text) > 4 * LONGEST:
        raise UnknownOption("arguments", text[:40], (f"at most {4 * LONGEST} characters",))
    return json.loads(text)


def brier(confidence: float, grade: float) -> float:
    """Return the squared error of a confidence that an answer is right.

    Source:
        Brier, *Verification of forecasts expressed in terms of probability*, Monthly Weather Review
        1950.
    """
    return float((confidence - float(grade >= PASSED)) ** 2)


def tools() -> list[dict[str, Any]]:
    """Return name, description and JSON schema of the arguments of each tool."""
    kinds = {"int": "integer", "float": "number", "str": "string", "dict[str, Any]": "object"}
    found = []
    for name in TOOLS:
        method = getattr(Laboratory, name)
        arguments = [*inspect.signature(method).parameters.values()][1:]
        schema = {
            "type": "object",
            "properties": {
                one.name: {"type": kinds[one.annotation]} if one.annotation in kinds else {}
                for one in arguments
            },
            "required": [one.name for one in arguments if one.default is one.empty],
            "additionalProperties": False,
        }
        text = inspect.cleandoc(method.__doc__ or "")
        found.append({"name": name, "description": text, "input_schema": schema})
    return found


@typed
def replay(path: str | PathLike[str], key: str | None = None) -> list[str]:
    """Repeat a saved run, and return what differs: nothing, where it is bit-identical.

    Args:
        path: The file that ``Laboratory.save`` wrote.
        key: The key of a private question.

    Raises:
        UnreadableFile: It is not such a file.
    """
    return repeated(path, key)[1]


def repeated(path: str | PathLike[str], key: str | None = None) -> tuple[Laboratory, list[str]]:
    """Repeat a saved run; return its laboratory after the last call, and what differs."""
    with reading(path, "give a file that Laboratory.save or scm-world lab run wrote"):
        run = json.loads(read_text(str(path)))
        if run["format"] != FORMAT:
            raise ValueError(f"its format is {run['format']}, not {FORMAT}")
        spec = run["question"]
        calls = [(one["tool"], one["arguments"], one["result"]) for one in run["calls"]]
    room, found = Laboratory(Question.of(spec, key)), list[str]()
    if room.question.digest != run.get("digest"):
        found.append("the question, or its answer")
    for number, (tool, arguments, result) in enumerate(calls):
        if room.call(tool, arguments) != result:
            found.append(f"call {number}: {tool}")
    if room.score != run.get("score"):
        found.append("the score")
    if found and run.get("versions") != room.record()["versions"]:
        found.append(f"versions: {run.get('versions')} then, {room.record()['versions']} now")
    return room, found


@typed
def scores(runs: Iterable[Laboratory]) -> dict[str, dict[str, Interval]]:
    """Return means over questions by kind: of score, share of the budget, and Brier score."""
    by_kind: dict[str, list[dict[str, float]]] = {}
    for room in runs:
        if room.score is None:
            raise ModelError(["a run has no submission, and so no score: submit an answer"])
        for kind in (room.question.kind, "all"):
            by_kind.setdefault(kind, []).append(room.score)
    return {
        kind: {
            what: mean_interval([one[what] for one in many], proportion=True)
            for what in ("score", "budget", "brier")
        }
        for kind, many in sorted(by_kind.items())
    }
