"""Suites: tables and questions that a manifest of a few kilobytes rebuilds anywhere.

A manifest has the recipe of each part (generator, seed, number of rows), the versions it was
written with, the SHA-256 of each public part, and the scores of trivial answers.
"""

from __future__ import annotations

import hashlib
import hmac
import io
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata, resources
from typing import TYPE_CHECKING, Any, NamedTuple, cast, final

from scm_world._arguments import one_of, real_number, typed
from scm_world.discovery.data import Dataset, as_frame, as_huggingface, collect, load, save
from scm_world.discovery.problems import TaskView, problem
from scm_world.errors import ModelError, ScmWorldError, UnknownOption, reading
from scm_world.evaluation.statistics import mean_interval
from scm_world.lab.laboratory import brier
from scm_world.lab.questions import (
    LEVELS,
    Question,
    Unusable,
    check_key,
    graph_pairs,
    question,
)
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.runs.files import Location, located, read_bytes, remove, write_whole
from scm_world.runs.pool import Pool, pool_of
from scm_world.runs.study import Study
from scm_world.tasks import ModelTask

if TYPE_CHECKING:
    import pandas

KIND = "suite"
SUITES = ("lab-1", "physics-1")
"""The names of all suites."""
MANIFESTS = resources.files("scm_world.lab") / "manifests"
ANSWER, CONFIDENCE, ID = "answer", "confidence", "question"
"""The columns of a file of answers."""
SEEDS, NEXT = 5, 10_000
"""How many seeds are tried where one has no question, and the distance of the next one."""


def boxes() -> ModelTask:
    """Return three boxes on one line, each with a motor; the third one is out of reach."""
    places = (0.0, 0.15, 3.0)  # [m]
    bodies = "".join(
        f'<body name="box{i}" pos="{x} 0 0.05"><joint name="box{i}" type="slide" axis="1 0 0" '
        f'stiffness="2" damping="0.2"/><geom name="box{i}" type="box" size="0.05 0.05 0.05" '
        f'mass="0.2"/></body>'
        for i, x in enumerate(places)
    )
    motors = "".join(
        f'<motor name="push{i}" joint="box{i}" ctrlrange="-1 1"/>' for i in range(len(places))
    )
    xml = (
        '<mujoco model="boxes"><option timestep="0.005" gravity="0 0 0"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    spaces = {f"box{i}.mass": {"a": (0.1, 0.3), "b": (0.3, 0.6)} for i in range(len(places))}
    return ModelTask(xml, expose="*.mass", control_dt=0.1, seconds=2.5, spaces=spaces)


@typed
def suite(name: str) -> Suite:
    """Return a suite.

    Raises:
        UnknownOption: No suite has this name; the error lists them.

    Example:
        >>> suite("physics-1").manifest["parts"]["servo-5-paired"]["source"]
        'servo:5'
    """
    one_of("suite", name, SUITES)
    return Suite(name, json.loads((MANIFESTS / f"{name}.json").read_text("utf-8")))


class Made(NamedTuple):
    """What ``Suite.make`` wrote.

    Attributes:
        parts: Of each part the number of its rows and its SHA-256; of a table the true graph; of
            questions their seeds, their draws, and how many seeds were skipped, as without a
            question.
        differ: The parts whose content is not that of the manifest.
        versions: The versions that are not those of the manifest, such as ``"mujoco 3.3.0, here
            3.4.0"``.
    """

    parts: dict[str, dict[str, Any]]
    differ: tuple[str, ...]
    versions: tuple[str, ...]


@final
@dataclass(frozen=True)
class Suite:
    """Tables, or questions to laboratories, that are made anew from their recipes.

    Attributes:
        name: Its name, which ends with its version.
        manifest: Title, what it measures and does not show, versions, and a recipe for each part.
    """

    name: str
    manifest: Mapping[str, Any]

    @typed
    def make(
        self,
        out: Location | str,
        *,
        key: str | None = None,
        workers: int | None = None,
        engine: Pool | str | None = None,
        progress: Progress | None = None,
    ) -> Made:
        """Make all parts in a folder, and compare them with the manifest.

        An interrupted call resumes when it is repeated. The folder is a dataset of Hugging Face:
        Parquet files, a card and a Croissant description. A JSON file of each part has its hash,
        and of a table its true graph. Private questions are made only with a key, and no file has
        their answers.

        Args:
            out: A folder, or a URL: new, empty, or one in which this suite was begun.
            key: A secret of at least 16 characters, which decides the private questions.
            workers: How many parts are made at the same time.
            engine: The executor; see ``collect``.
            progress: Called with how many parts are done, and how many there are.

        Raises:
            UnknownOption: The key is too short.
            UnreadableFile: The folder holds something else, was made by other versions, or has a
                part that was changed or is of another key.
        """
        parts, folder = self.parts(key), located(out)
        made = self._made(parts, folder, key, workers, engine, progress)
        about = {"name": self.name, "license": "MIT", "version": self.name.rpartition("-")[2]}
        as_huggingface(folder, description=self.card, **about)
        differ = [n for n, r in parts.items() if "sha256" in r and r["sha256"] != made[n]["sha256"]]
        then, now = self.manifest["versions"], _here()
        other = [f"{n} {then[n]}, here {now.get(n)}" for n in then if then[n] != now.get(n)]
        return Made(made, tuple(differ), tuple(other))

    def parts(self, key: str | None = None) -> dict[str, dict[str, Any]]:
        """Return the recipes by the name of their part; those of private ones only with a key."""
        check_key(key)
        found = self.manifest["parts"].items()
        return {name: recipe for name, recipe in found if key or not recipe.get("private")}

    def _made(
        self,
        parts: Mapping[str, dict[str, Any]],
        folder: Location | None,
        key: str | None,
        workers: int | None,
        engine: Pool | str | None,
        progress: Progress | None,
    ) -> dict[str, dict[str, Any]]:
        """Make parts, or read those that are in the folder; return what is known of each."""
        known = ("sha256", "trivial", "skipped")  # afterwards: they decide nothing
        recipes = {
            name: {what: one for what, one in recipe.items() if what not in known}
            for name, recipe in self.manifest["parts"].items()
        }
        settings = {"suite": self.name, "recipes": recipes, "versions": _here()}
        cells = {f"{name}.json": (name, recipe) for name, recipe in parts.items()}
        work, read = partial(_part, folder, key), partial(_checked, folder, key)
        with Study(folder, KIND, settings) as study, pool_of(engine, workers) as pool:
            how: dict[str, Any] = {"read": read, "write": lambda one: json.dumps(one).encode()}
            found = dict(study.map(cells, work, pool=pool, progress=progress, **how))
        return {name: found[f"{name}.json"] for name in parts}

    @typed
    def score(
        self,
        answers: pandas.DataFrame | Location | str,
        *,
        made: Location | str | None = None,
        key: str | None = None,
        workers: int | None = None,
        engine: Pool | str | None = None,
        progress: Progress | None = None,
    ) -> pandas.DataFrame:
        """Grade answers to all questions of the suite.

        Args:
            answers: A frame, or a file: Parquet, CSV or JSONL, with the columns ``question`` (an
                id of the suite), ``answer`` (JSON) and, if there is one, ``confidence`` in [0, 1].
                The answer to a table is its graph, ``{"edges": [[cause, effect], …], "hidden":
                [[name, name], …]}``, at any lag.
            made: The folder that ``make`` wrote; the parts with answers are made anew if None.
            key: The key of the private questions; without it they are not graded.
            workers: How many parts are graded at the same time.
            engine: The executor; see ``collect``.
            progress: Called with how many parts are done, and how many there are.

        Returns:
            A row for each kind and level, and one for each kind (level ``"all"``): the mean score
            in [0, 1] with its 95 % interval, over ``questions``, of which ``answered`` have an
            answer and ``refused`` one of another form. A question without a right form counts 0.
            ``brier`` is the mean square of confidence minus success (a score of .95), ``trivial``
            the best mean score of a trivial answer.

        Raises:
            UnknownOption: A column is missing, an id is not of this suite, two rows have one, or a
                confidence is no number in [0, 1].
        """
        import pandas

        table = answers if isinstance(answers, pandas.DataFrame) else _frame(located(answers))
        parts = self.parts(key)
        given = _answers(table, {i for n, recipe in parts.items() for i in _ids(n, recipe)})
        asked = {n: r for n, r in parts.items() if any(i in given for i in _ids(n, r))}
        folder = None if made is None else located(made)
        found = self._made(asked, folder, key, workers, engine, progress)
        jobs = [
            (recipe, found[name], {i: given[i] for i in _ids(name, recipe) if i in given})
            for name, recipe in asked.items()
        ]
        with pool_of(engine, workers) as pool:
            graded = {i: s for _, part in pool.run(partial(_graded, key), jobs) for i, s in part}
        rows = []
        for name, recipe in parts.items():
            trivial = {f"trivial {n}": s for n, s in recipe.get("trivial", {}).items()}
            for number, i in enumerate(_ids(name, recipe)):
                (_, sure), score = given.get(i, (None, None)), graded.get(i)
                row = {"kind": recipe["kind"], "level": _level(recipe, number), **trivial}
                row |= {"answered": i in given, "refused": i in given and score is None}
                row["brier"] = None if sure is None or score is None else brier(sure, score)
                rows.append({**row, "score": score or 0.0})
        return _summary(pandas.DataFrame(rows))

    @property
    def card(self) -> str:
        """The card of the dataset: what it measures, trivial answers, and what it does not show."""
        about, lines = self.manifest, ["| part | trivial answer | score |", "|---|---|---|"]
        for name, recipe in about["parts"].items():
            scores = recipe.get("trivial", {}).items()
            lines += [f"| {name} | {answer} | {score:.2f} |" for answer, score in scores]
        made = f"Made by `scm-world suite make {self.name}`; the same command checks the hashes."
        parts = (
            *(about["title"], "## What it measures", about["measures"]),
            *("## Trivial answers", "\n".join(lines)),
            *("## What it does not show", about["limits"], made),
        )
        return "\n\n".join(parts)


def _here() -> dict[str, str]:
    """Return the versions on which the content of a suite depends."""
    return versions(f"mujoco {metadata.version('mujoco')}")


# --- parts ----------------------------------------------------------------------------------------


def _ids(name: str, recipe: Mapping[str, Any]) -> list[str]:
    """Return the ids of the questions of a part; a table is one question."""
    return [name] if "source" in recipe else [f"{name}-{i:03d}" for i in range(recipe["n"])]


def _level(recipe: Mapping[str, Any], number: int) -> str:
    return str(recipe.get("level", [*LEVELS][number % len(LEVELS)]))


def _part(
    folder: Location | None, key: str | None, job: tuple[str, dict[str, Any]]
) -> dict[str, Any]:
    """Make a part; write it to the folder, and return what is known of it."""
    name, recipe = job
    if "source" in recipe:
        table, about = _table(recipe)
        frame = as_frame(table)
        if folder is not None:
            place = folder / name
            for file in place.iterdir() if place.is_dir() else ():  # of a process that was killed
                remove(file)
            save(table, place)
    else:
        frame, about = _questions(name, recipe, key)
        if folder is not None:
            write_whole(folder / _file(name, recipe), frame.to_parquet(None, index=False))
    return {"part": name, "rows": len(frame), "sha256": _sha256(frame), **about}


def _file(name: str, recipe: Mapping[str, Any]) -> str:
    return f"{'private' if recipe.get('private') else 'questions'}-{name}.parquet"


def _sha256(frame: pandas.DataFrame) -> str:
    """Return the SHA-256 of a table as CSV, whose numbers have all their digits."""
    return hashlib.sha256(frame.to_csv(index=False).encode()).hexdigest()


def _checked(folder: Location | None, key: str | None, data: bytes) -> dict[str, Any]:
    """Read what is known of a part, and compare its data with it."""
    import pandas

    found: dict[str, Any] = json.loads(data)
    folder, name = cast("Location", folder), found["part"]  # there is a file to read
    if found.get("key", _mark(key)) != _mark(key):
        raise ValueError("its questions are of another key")
    if "edges" in found:
        frame = as_frame(load(folder / name))
    else:
        content = read_bytes(folder / _file(name, {"private": "key" in found}))
        frame = pandas.read_parquet(io.BytesIO(content))
    if _sha256(frame) != found["sha256"]:
        raise ValueError(f"the rows of {name} were changed")
    return found


def _mark(key: str | None) -> str:
    """Return a mark by which a folder knows its key, and which tells nothing of it."""
    return hmac.new((key or "").encode(), b"suite", hashlib.sha256).hexdigest()


# --- tables ---------------------------------------------------------------------------------------


def _table(recipe: Mapping[str, Any]) -> tuple[Dataset, dict[str, Any]]:
    """Collect a table, with its true graph.

    The rows of ``"paired"`` are those of ``"observational"`` under interventions: the same units
    with the same noise.
    """
    view = TaskView(recipe.get("view", "outcome"), contacts=recipe.get("contacts", False))
    made = problem(recipe["source"], seed=recipe["seed"], view=view)
    try:
        if recipe["data"] == "paired":
            design = replace(made.design, observational_fraction=0.0)
            n = -(-recipe["rows"] // made.rows)
            table = made.tidy(collect(made.system, design, n, seed=recipe["seed"], **made.setting))
        else:
            other = recipe["data"] == "interventional"  # other units
            table = made.data(recipe["data"], recipe["rows"], recipe["seed"] + other)
    finally:
        made.close()
    truth = (table.acting() if view.contacts else table).truth
    if truth is None:
        raise ModelError([f"the graph of {recipe['source']} is not known"])
    edges = sorted({(cause, effect) for cause, effect, *_ in truth.edges if cause != effect})
    hidden = sorted({tuple(sorted(pair[:2])) for pair in truth.confounded})
    graph = {"edges": [*map(list, edges)], "hidden": [*map(list, hidden)]}
    return table, {"names": [*truth.names], **graph}


# --- questions ------------------------------------------------------------------------------------


def _questions(
    name: str, recipe: Mapping[str, Any], key: str | None
) -> tuple[pandas.DataFrame, dict[str, Any]]:
    """Make the questions of a part; those without known draws are certified."""
    import pandas

    secret, rows, made = key if recipe.get("private") else None, [], list[Question]()
    trivial: dict[str, float] = {}
    for number, (i, spec) in enumerate(zip(_ids(name, recipe), _specs(recipe), strict=True)):
        if "draws" in recipe:
            seed, draw = recipe["seeds"][number], recipe["draws"][number]
            one = Question.of({**spec, "seed": seed, "draw": draw}, secret)
        else:
            one = _certified(spec, secret)
            for answer, score in (one.certificate or {})["trivial"].items():
                trivial[answer] = trivial.get(answer, 0.0) + score / recipe["n"]
        made.append(one)
        row = {ID: i, "kind": one.kind, "world": one.world, "level": one.level}
        row |= {"description": json.dumps(one.describe()), "spec": json.dumps(one.spec)}
        rows.append(row if secret else {**row, ANSWER: json.dumps(one.answer)})
    about: dict[str, Any] = {"seeds": [one.seed for one in made], "draws": [o.draw for o in made]}
    about["skipped"] = sum((seed - recipe["seed"]) // NEXT for seed in about["seeds"])
    about["trivial"] = {n: round(s, 4) for n, s in trivial.items()}
    return pandas.DataFrame(rows), about | ({"key": _mark(key)} if secret else {})


def _certified(spec: Mapping[str, Any], secret: str | None) -> Question:
    """Return the question of the first seed that has one; after s comes s + 10,000."""
    seeds = range(spec["seed"], spec["seed"] + SEEDS * NEXT, NEXT)
    for seed in seeds:
        with suppress(Unusable):
            return question(
                spec["kind"], spec["world"], seed, spec["level"], secret, **spec["knobs"]
            )
    raise ModelError([f"no seed of {[*seeds]} has a question of {spec}"])


def _specs(recipe: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the questions of a part, in worlds and with knobs that take turns."""
    worlds, knobs = recipe["worlds"], recipe["knobs"]
    return [
        {
            "kind": recipe["kind"],
            "world": worlds[i % len(worlds)],
            "seed": recipe["seed"] + i,
            "level": _level(recipe, i),
            "knobs": knobs[i // len(worlds) % len(knobs)],
        }
        for i in range(recipe["n"])
    ]


# --- answers --------------------------------------------------------------------------------------


def _frame(path: Location) -> pandas.DataFrame:
    """Read a file of answers."""
    import pandas

    readers: dict[str, Callable[..., Any]] = {
        ".parquet": pandas.read_parquet,
        ".csv": partial(pandas.read_csv, dtype={ID: str, ANSWER: str}),
        ".jsonl": partial(pandas.read_json, lines=True, dtype={ID: str}),
    }
    one_of("kind of a file of answers", path.suffix, tuple(readers))
    with reading(path, f"give a table with the columns {ID} and {ANSWER}"):
        found: pandas.DataFrame = readers[path.suffix](io.BytesIO(read_bytes(path)))
    return found


def _answers(table: pandas.DataFrame, known: set[str]) -> dict[str, tuple[Any, Any]]:
    """Return the answer and the confidence by the id of their question."""
    import pandas

    for column in (ID, ANSWER):
        one_of("column of answers", column, [*table])
    found = dict[str, tuple[Any, Any]]()
    sure = table[CONFIDENCE] if CONFIDENCE in table else [None] * len(table)
    for i, given, confidence in zip(table[ID], table[ANSWER], sure, strict=True):
        one_of("question", i, sorted(known))
        if i in found:
            raise UnknownOption("question", i, ("one row for each question",))
        if known_sure := not pandas.isna(confidence):
            real_number(f"confidence of question {i}", confidence, least=0.0, most=1.0)
        answer = given
        if isinstance(given, str):
            with suppress(ValueError):  # a law or a name without quotes
                answer = json.loads(given)
        found[i] = answer, float(confidence) if known_sure else None
    return found


def _graded(
    key: str | None, job: tuple[dict[str, Any], dict[str, Any], dict[str, tuple[Any, Any]]]
) -> list[tuple[str, float | None]]:
    """Return the score of each answer to a part; None for one of another form."""
    recipe, about, given = job
    specs = [] if "source" in recipe else _specs(recipe)
    graded = list[tuple[str, float | None]]()
    for i, (answer, _) in given.items():
        try:
            if "source" in recipe:
                score: float | None = _overlap(answer, about)
            else:
                number, secret = int(i.rpartition("-")[2]), key if recipe.get("private") else None
                found = {"seed": about["seeds"][number], "draw": about["draws"][number]}
                score = Question.of({**specs[number], **found}, secret).grade(answer)
        except ScmWorldError:
            score = None
        graded.append((i, score))
    return graded


def _overlap(answer: Any, about: Mapping[str, Any]) -> float:
    """Return F1 of a graph: of its directed edges and pairs with a hidden common cause."""
    found: set[Any] = {*graph_pairs(answer, "edges", about["names"])}
    found |= {frozenset(pair) for pair in graph_pairs(answer, "hidden", about["names"])}
    true = {*map(tuple, about["edges"]), *map(frozenset, about["hidden"])}
    return 2.0 * len(found & true) / max(len(found) + len(true), 1)


def _summary(rows: pandas.DataFrame) -> pandas.DataFrame:
    """Return a row for each kind, and for each level of a kind."""
    import pandas

    found = []
    for kind, of_kind in rows.groupby("kind", sort=False):
        levels = [*of_kind.groupby("level", sort=False)]
        for level, part in [("all", of_kind), *(levels if len(levels) > 1 else [])]:
            interval = mean_interval(part.score.to_numpy(float))
            trivial = part.filter(like="trivial ").mean()
            found.append(
                {
                    "kind": kind,
                    "level": level,
                    "questions": len(part),
                    "answered": int(part.answered.sum()),
                    "refused": int(part.refused.sum()),
                    "score": interval.value,
                    "low": interval.low,
                    "high": interval.high,
                    "brier": part.brier.astype(float).mean(),
                    "trivial": trivial.max() if len(trivial) else None,
                }
            )
    return pandas.DataFrame(found)
