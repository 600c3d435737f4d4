"""Search for the settings of a recipe: trainings with values that Optuna proposes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world._arguments import load, plain, whole_number
from scm_world.errors import Diverged, UnknownOption
from scm_world.queries.progress import Progress, Tell
from scm_world.runs.files import is_there, write_whole
from scm_world.runs.study import Study
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe


@final
@dataclass(frozen=True)
class SearchResult:
    """A search that is over.

    Attributes:
        folder: Folder of its files; the training of trial 3 is in ``trials/003``.
        rows: The trials, in order: ``number``, ``score`` (None of one that failed), ``error``, and
            the ``values`` by name.
        best: The recipe with the best score; None if all have failed.
        score: Its score.
    """

    folder: Path
    rows: tuple[dict[str, Any], ...]
    best: Recipe | None
    score: float | None


def sweep(
    recipe: Recipe,
    space: Mapping[str, Any],
    *,
    trials: int = 20,
    out: Path | str,
    seed: int = 0,
    backend: str = "mujoco",
    progress: Progress | None = None,
    tell: Tell | None = None,
    **options: Any,
) -> SearchResult:
    """Search for the values of a recipe with which the best policy has the highest score.

    Values are proposed by the tree-structured Parzen estimator of Optuna. Each trial is a training
    with the same seed in a folder of its own, and its score the best mean of its evaluations. One
    whose values do not go together, or that diverges, has none. Proposals follow from the seed and
    the trials before. If ``out`` holds a part of the same search, it goes on: a training that was
    killed from its last checkpoint, as ``train`` does. It may have more trials than before.

    Args:
        recipe: What is changed; its trials must evaluate something.
        space: By names as in ``Recipe.but``, such as ``"rate.initial"`` or ``"n_steps"``: a tuple
            ``(low, high)`` or ``(low, high, "log")``, of whole numbers if both are; or a list.
        trials: How many trainings.
        out: Folder of all files: ``sweep.json``, ``sweep.csv`` and ``best.json``, a recipe.
        seed: Seed of the proposals and of each training.
        backend: Name of the engine.
        progress: Called with how many trials are done, and how many there are.
        tell: Called with a sentence about each event.
        options: Other arguments of ``train``: ``start``, ``device``, ``threads``, ``log``.

    Raises:
        MissingExtra: Optuna is not installed.
        UnknownOption: A name or a range is impossible, or nothing is evaluated.
        UnreadableFile: Something else is in the folder.

    Source:
        Bergstra et al., *Algorithms for Hyper-Parameter Optimization*, NeurIPS 2011; Akiba et al.,
        *Optuna*, KDD 2019.
    """
    optuna = load("optuna", "optuna", "train")
    count, say = whole_number("trials", trials, least=1), tell or (lambda _: None)
    if not recipe.trials.protocols:
        raise UnknownOption("trials.protocols of a sweep", [], ("some: they give the score",))
    if not isinstance(space, Mapping) or not space:
        raise UnknownOption("space of a sweep", space, ("ranges and lists by name",))
    ranges = {name: _distribution(optuna, name, one) for name, one in space.items()}
    for name, one in ranges.items():
        recipe.but(**_values({name: getattr(one, "choices", [getattr(one, "low", 0)])[0]}))
    folder, rows = Path(out), list[dict[str, Any]]()
    settings = {"recipe": recipe.as_dict(), "seed": seed, "backend": backend}
    settings["space"] = json.loads(json.dumps(plain(dict(space))))
    with Study(folder, "sweep", settings) as study:
        for number in range(count):
            name = f"results/{number:03}.json"
            if not is_there(folder / name):
                found = _proposed(optuna, ranges, rows, seed)
                values = _values(found)
                say(f"trial {number}: {values}")
                row: dict[str, Any] = {"number": number, "score": None, "error": None}
                row |= {"values": values, "proposed": found}
                try:
                    made, how = recipe.but(**values), {"seed": seed, "backend": backend, **options}
                    place: dict[str, Any] = {"out": folder / f"trials/{number:03}", "tell": tell}
                    row["score"] = train(made, **place, **how).score
                except (UnknownOption, Diverged) as error:
                    row["error"] = str(error)
                study.keep(name, json.dumps(row).encode())
            rows.append(study.kept(name, json.loads))
            say(f"trial {number}: score {rows[-1]['score']}, {rows[-1]['error'] or 'done'}")
            if progress is not None:
                progress(number + 1, count)
        ranked = sorted((r for r in rows if r["score"] is not None), key=lambda row: -row["score"])
        best = recipe.but(**ranked[0]["values"]) if ranked else None
        shown = [{name: one for name, one in row.items() if name != "proposed"} for row in rows]
        about = {**settings, "best": ranked[0]["number"] if ranked else None, "trials": shown}
        write_whole(folder / "sweep.json", json.dumps(about, indent=2))
        table = csv.writer(text := io.StringIO(), lineterminator="\n")
        table.writerow(["number", "score", *ranges, "error"])
        for row in rows:
            given = [row["values"][name] for name in ranges]
            table.writerow([row["number"], row["score"], *given, row["error"]])
        write_whole(folder / "sweep.csv", text.getvalue())
        if best is not None:
            write_whole(folder / "best.json", best.to_json())
    return SearchResult(folder, tuple(shown), best, ranked[0]["score"] if ranked else None)


def _distribution(optuna: Any, name: str, given: object) -> Any:
    """Return the distribution of a range or of a list, whose entries stand as JSON."""
    known = optuna.distributions
    try:
        if isinstance(given, list) and given:
            return known.CategoricalDistribution([json.dumps(plain(one)) for one in given])
        if isinstance(given, tuple) and (how := list(given[2:])) in ([], ["log"]):
            low, high = given[:2]
            both = isinstance(low, int) and isinstance(high, int)
            kind = known.IntDistribution if both else known.FloatDistribution
            return kind(low, high, log=bool(how))
    except (TypeError, ValueError):
        pass
    allowed = ("a tuple (low, high) or (low, high, 'log') with low < high", "a list of values")
    raise UnknownOption(f"range of {name}", given, allowed)


def _values(proposed: Mapping[str, Any]) -> dict[str, Any]:
    return {n: json.loads(one) if isinstance(one, str) else one for n, one in proposed.items()}


def _proposed(
    optuna: Any, ranges: Mapping[str, Any], rows: list[dict[str, Any]], seed: int
) -> dict[str, Any]:
    """Propose the values of the next trial, which follow from the seed and the rows before."""
    states, made = optuna.trial.TrialState, optuna.trial.create_trial
    random = int(np.random.SeedSequence([seed, len(rows)]).generate_state(1)[0])
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize", sampler=optuna.samplers.TPESampler(seed=random)
    )
    for row in rows:
        given = {"params": row["proposed"], "distributions": dict(ranges)}
        is_done = row["score"] is not None
        state = states.COMPLETE if is_done else states.FAIL
        study.add_trial(made(state=state, value=row["score"] if is_done else None, **given))
    return dict(study.ask(dict(ranges)).params)
