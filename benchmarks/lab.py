"""Measure laboratories: certified questions and their answers; write manifests.

::

    python -m benchmarks.lab questions --n 25  # of each kind: certificates and CPU time
    python -m benchmarks.lab truth             # their answers, by an independent script
    python -m benchmarks.lab whole --made DIR --n 200  # figures of a made lab-1; as truth does
    python -m benchmarks.lab answers --n 200   # of questions that need not be certified; as truth
    python -m benchmarks.lab names --n 40      # guesses by names, of seeds of each world
    python -m benchmarks.lab suites --made DIR # the manifests, with the hashes of made folders
    python -m benchmarks.lab curves            # scores of agents by budget; resumable
    python -m benchmarks.lab trained           # PPO on experiments, beside two simple agents

The figures are in ``lab.json``. Questions are those of ``lab-1``, in the order of its parts.
"""

from __future__ import annotations

import argparse
import json
import runpy
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas

from benchmarks import as_json, figures
from benchmarks.lab_truth import confirm
from scm_world import lab
from scm_world.discovery.data import load
from scm_world.discovery.learners.registry import learn
from scm_world.evaluation.statistics import Interval, mean_interval
from scm_world.lab import suites
from scm_world.lab.questions import Question, Unusable, build
from scm_world.runs.pool import Pool

HERE = Path(__file__).parent
RESULTS = HERE / "lab.json"
MANIFESTS = HERE.parent / "scm_world" / "lab" / "manifests"
PER_PART = 25
KNOBS: tuple[dict[str, Any], ...] = (
    {},
    {"law": "cubic"},
    {"selection": True},
    {"law": "square"},
    {"noise": 0.1},
)
SOURCES = {
    **{f"servo-{n}": f"servo:{n}" for n in (5, 10, 20)},
    "servo-10-hidden": "servo:10:2",
    **{f"springs-{n}": f"springs:{n}" for n in (5, 10, 20, 50)},
    "boxes": "scm_world.lab.suites:boxes",
    "pushing": "pushing",
}
TRIVIAL = ("bipartite", "correlation")


def recipes() -> dict[str, dict[str, Any]]:
    """Return the recipes of ``lab-1``: 25 questions of each kind and level, and private ones."""
    found, seed = dict[str, dict[str, Any]](), 0
    for level in (*lab.LEVELS, None):
        for kind in lab.KINDS:
            recipe: dict[str, Any] = {
                "kind": kind,
                "worlds": [*lab.offers(kind)],
                "knobs": [*KNOBS][: 1 if kind == "graph" else None],
            }
            if kind in ("effect", "law"):  # cubic equations have tails too heavy for means
                recipe["knobs"][1] = {"law": "dead zone"}
            recipe |= {"seed": seed, "n": PER_PART}
            recipe |= {"private": True} if level is None else {"level": level}
            found[f"{kind}-{level or 'private'}"] = recipe
            seed += PER_PART
    return found


# --- questions ------------------------------------------------------------------------------------


def stronger(question: Question) -> dict[str, Any]:
    """Return answers without an experiment that the certificate does not try."""
    query = question.query
    match question.kind:
        case "control":
            ends = question.view.ends(query["cause"])
            place = {share: ends[0] + share * (ends[1] - ends[0]) for share in (0.12, 0.3, 0.88)}
            return {f"at {share:.0%}": {query["cause"]: x} for share, x in place.items()}
        case "explanation":
            usual = query["usual"]
            width = {name: float(np.ptp(question.view.ends(name))) for name in usual}
            far = {name: abs(query["set"][name] - usual[name]) / width[name] for name in usual}
            return {"farthest": max(far, key=lambda name: far[name])}
        case "graph":
            names = [name for name, one in question.view.quantities.items() if one.sets]
            others = [name for name in question.view.readable if name not in names] or names
            known = {tuple(edge) for edge in query["known"]}
            pairs = [[a, b] for a in names for b in others if a != b and (a, b) not in known]
            return {"all pairs": {"edges": pairs}, "half": {"edges": pairs[::2]}}
    return {}


def asked(job: dict[str, Any]) -> dict[str, Any]:
    """Make a certified question; return its spec, scores and the CPU seconds that it took."""
    begin = time.process_time()
    spec = {name: job[name] for name in ("kind", "world", "seed", "level")}
    try:
        made = lab.question(**spec, **job["knobs"])
    except Exception as error:  # a seed without a question is a result
        return {**job, "error": str(error)[:200], "seconds": time.process_time() - begin}
    seconds = time.process_time() - begin
    certificate = made.certificate or {}
    more = {name: made.grade(answer) for name, answer in stronger(made).items()}
    again = Question.of(made.spec)
    return {
        "spec": made.spec,
        "seconds": seconds,
        "rejected": len(certificate["rejected"]),
        "ideal": certificate["solver"],
        "trivial": {**certificate["trivial"], **more},
        "same": again.digest == made.digest,
        "digest": made.digest,
    }


def jobs(n: int) -> list[dict[str, Any]]:
    """Return the first ``n`` questions of each kind, with the levels in turn."""
    levels, found = [*lab.LEVELS], list[dict[str, Any]]()
    for i in range(n):
        for name, recipe in recipes().items():
            if name.endswith(levels[i % len(levels)]):
                found.append(suites._specs(recipe)[i])
    return found


def questions(n: int, workers: int, out: Path) -> None:
    """Certify questions; write a row of each to a scratch file as it is ready."""
    wanted = jobs(n)
    with Pool("process" if workers > 1 else None, workers) as pool, out.open("w") as file:
        for _, row in pool.run(asked, wanted):
            file.write(json.dumps(row) + "\n")
            file.flush()


def table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise certified questions by kind."""
    found, kinds = dict[str, Any](), defaultdict(list)
    for row in rows:
        kinds[row.get("spec", row)["kind"]].append(row)
    for kind, of_kind in kinds.items():
        good = [row for row in of_kind if "error" not in row]
        names = sorted({name for row in good for name in row["trivial"]})
        trivial = {n: [row["trivial"][n] for row in good if n in row["trivial"]] for n in names}
        found[kind] = {
            "questions": len(good),
            "seeds without one": len(of_kind) - len(good),
            "rejected draws": sum(row["rejected"] for row in good),
            "CPU seconds": round(sum(row["seconds"] for row in of_kind), 1),
            "ideal": round(float(np.mean([row["ideal"] for row in good])), 3),
            "trivial": {name: round(float(np.mean(s)), 3) for name, s in trivial.items()},
            "same without certifying": sum(row["same"] for row in good),
        }
    return found


def named(rows: list[tuple[str, str]]) -> dict[str, Any]:
    """Return how often the most frequent name of each world is right.

    For each row it is that of the other rows, so that chance does not raise it; names that are
    equally frequent share. The interval has 95 %.
    """
    right, counts = list[float](), defaultdict[str, Counter[str]](Counter)
    for world, name in rows:
        counts[world][name] += 1
    for world, name in rows:
        others = counts[world] - Counter([name])
        first = [n for n, often in others.items() if often == max(others.values())]
        right.append(first.count(name) / max(len(first), 1))
    share = mean_interval(np.array(right), proportion=True)
    return {
        "questions": len(rows),
        "most frequent name": [round(x, 3) for x in (share.value, share.low, share.high)],
        "answers": {world: dict(of.most_common()) for world, of in counts.items()},
    }


def names(n: int) -> dict[str, Any]:
    """Score guesses by names: of ``n`` seeds of each world, which need not be certified."""
    found, typical = dict[str, Any](), list[list[float]]()
    for kind in ("explanation", "diagnosis"):
        worlds = lab.offers(kind)
        asked = [usable(kind, world, seed) for seed in range(n) for world in worlds]
        found[kind] = named([(one.world, one.answer) for one in asked if one])
    for world in lab.offers("effect"):
        same = defaultdict[tuple[str, str], list[Question]](list)
        for one in filter(None, (usable("effect", world, seed) for seed in range(n))):
            same[one.query["cause"], one.query["outcome"]].append(one)
        for many in (many for many in same.values() if len(many) > 1):
            for one in many:
                others = [other.answer for other in many if other is not one]
                guess = float(np.median(others))
                typical.append([guess * one.answer > 0.0, one.grade(guess)])
    sign, score = np.mean(typical, axis=0)
    found["effect"] = {
        "questions": len(typical),
        "sign of the median effect of the same names": round(float(sign), 3),
        "score of that median": round(float(score), 3),
    }
    scores = defaultdict[str, list[float]](list)
    for world in lab.offers("graph"):
        for one in filter(None, (usable("graph", world, seed) for seed in range(n))):
            causes = sorted(name for name, of in one.view.quantities.items() if of.sets)
            read = sorted(n for n in one.view.readable if n not in causes) or causes
            pairs = [[a, b] for i, a in enumerate(causes) for j, b in enumerate(read) if i != j]
            chain = [[a, read[i + 1]] for i, a in enumerate(causes[:-1]) if i + 1 < len(read)]
            forward = [[a, b] for a, b in pairs if a.split(".")[0] < b.split(".")[0]]
            for name, edges in (("next in order", chain), ("earlier on later", forward)):
                scores[name].append(one.grade({"edges": edges}))
    found["graph"] = {name: round(float(np.mean(of)), 3) for name, of in scores.items()}
    return found


# --- agents ---------------------------------------------------------------------------------------

SHARES = (0.25, 0.5, 1.0, 2.0)
EACH = 1
"""Questions of each kind and level; with more, the same file is continued."""


def budgeted(question: Question, share: float) -> Question:
    """Return the same question with a share of its budget."""
    view = question.view.fresh()
    view.testbed = replace(view.testbed, budget=round(share * question.budget))
    return replace(question, view=view)


def curved(job: dict[str, Any]) -> dict[str, Any]:
    """Return the scores of all agents on a question, by budget."""
    spec = {name: job[name] for name in ("kind", "world", "seed", "level")}
    try:
        made = lab.question(**spec, **job["knobs"])
    except Unusable as error:
        return {**job, "error": str(error)[:200]}
    played = {
        agent: [lab.play(agent, budgeted(made, share)).score or {} for share in SHARES]
        for agent in lab.AGENTS
    }
    found = {agent: [one["score"] for one in ones] for agent, ones in played.items()}
    return {**job, "scores": found, "trivial": max((made.certificate or {})["trivial"].values())}


def curves(out: Path, workers: int) -> dict[str, Any]:
    """Play questions of ``lab-1`` but of servos and rows of boxes; continue with the same file.

    Levels begin one after another in the list of worlds, so that all worlds have their turn. The
    first ones are left out: the agents were written with some of them.
    """
    parts = list[list[dict[str, Any]]]()
    for number, level in enumerate(lab.LEVELS, 1):
        for kind in lab.KINDS:
            every = suites._specs(recipes()[f"{kind}-{level}"])[3 * number :]
            parts.append([job for job in every if job["world"] not in ("servo", "row")][:EACH])
    wanted = [part[i] for i in range(EACH) for part in parts]
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    known = [{name: row[name] for name in wanted[0]} for row in rows]
    with Pool("process" if workers > 1 else None, workers) as pool, out.open("a") as file:
        for _, row in pool.run(curved, [job for job in wanted if job not in known]):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    return averaged([row for row in rows if {n: row[n] for n in wanted[0]} in wanted])


def _row(one: Interval) -> dict[str, float]:
    return {"value": round(one.value, 4), "low": round(one.low, 4), "high": round(one.high, 4)}


def averaged(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return mean scores with intervals over questions: by kind, by level, and of all."""
    good = [row for row in rows if "scores" in row]

    def means(values: Any, **more: Any) -> list[dict[str, float]]:
        each = [mean_interval(column, **more) for column in np.transpose(values)]
        return [_row(one) for one in each]

    found: dict[str, Any] = {"shares": SHARES, "seeds without a question": len(rows) - len(good)}
    for name in (*lab.KINDS, *lab.LEVELS, "all"):
        some = [row for row in good if name in (row["kind"], row["level"], "all")]
        of = {agent: np.array([row["scores"][agent] for row in some]) for agent in lab.AGENTS}
        found[name] = {
            "questions": len(some),
            "agents": {agent: means(score, proportion=True) for agent, score in of.items()},
            "best trivial answer": means([[row["trivial"]] for row in some], proportion=True)[0],
            "minus random": {
                agent: means(of[agent] - of["random"], proportion=False)
                for agent in of
                if agent != "random"
            },
        }
    return found


def trained(steps: int) -> dict[str, Any]:
    """Train PPO to choose experiments, and compare it on questions that it has not seen."""
    compare = runpy.run_path(str(HERE.parent / "examples" / "lab_agents.py"))["compare"]
    begin = time.process_time()
    found = {name: np.array(scores) for name, scores in compare(steps).items()}
    minus = {
        f"trained minus {name}": mean_interval(found["trained"] - found[name], proportion=False)
        for name in ("random", "information")
    }
    every = {name: mean_interval(one, proportion=True) for name, one in found.items()} | minus
    rows = {name: _row(one) for name, one in every.items()}
    return {"steps": steps, "CPU seconds": round(time.process_time() - begin), **rows}


def whole(folder: Path, n: int) -> dict[str, Any]:
    """Return figures of a made ``lab-1``, and confirm ``n`` of its public questions at random."""
    found, rows = defaultdict[str, dict[str, Any]](dict), list[dict[str, Any]]()
    answers = defaultdict[str, list[tuple[str, str]]](list)
    for path in sorted(folder.glob("questions-*.parquet")):
        part = path.stem.removeprefix("questions-")
        about, kind = json.loads((folder / f"{part}.json").read_text())["content"], part[:-3]
        known = found[kind]
        for what, value in (
            ("questions", about["rows"]),
            ("rejected draws", sum(about["draws"])),
            ("seeds without one", about["skipped"]),
        ):
            known[what] = known.get(what, 0) + value
        for name, score in about["trivial"].items():
            known.setdefault("trivial", defaultdict(list))[name].append(score)
        for row in pandas.read_parquet(path).to_dict("records"):
            rows.append(json.loads(row["spec"]))
            if kind in ("explanation", "diagnosis") and row["level"] in ("L1", "L2"):
                answers[kind].append((row["world"], json.loads(row["answer"])))
    for kind, known in found.items():
        known["trivial"] = {n: round(float(np.mean(s)), 3) for n, s in known["trivial"].items()}
        if kind in answers:
            known["names at L1 and L2"] = named(answers[kind])
    picked = np.random.default_rng(0).permutation(len(rows))[:n]
    for kind, said in confirmed([Question.of(rows[i]) for i in picked]).items():
        found[kind].update(said)
    return dict(found)


def confirmed(questions: Iterable[Question]) -> dict[str, dict[str, Any]]:
    """Return by kind in how many questions of each world the independent script agrees."""
    found = defaultdict[str, dict[str, Any]](lambda: {"confirmed": Counter(), "not confirmed": []})
    for one in questions:
        said = confirm(one)
        if said["confirmed"]:
            found[one.kind]["confirmed"][one.world] += 1
        else:
            found[one.kind]["not confirmed"].append([one.spec, said])
    return {kind: {**one, "confirmed": dict(one["confirmed"])} for kind, one in found.items()}


def answers(n: int) -> dict[str, Any]:
    """Confirm ``n`` random public questions of ``lab-1`` at their first usable draw.

    They need not be certified: that says nothing of whether an answer is right.
    """
    parts = [recipe for recipe in recipes().values() if not recipe.get("private")]
    specs = [spec for recipe in parts for spec in suites._specs(recipe)]
    picked = [specs[i] for i in np.random.default_rng(1).permutation(len(specs))]
    return confirmed(islice((one for spec in picked if (one := usable(**spec))), n))


def usable(
    kind: str, world: str, seed: int, level: str = "L2", knobs: Mapping[str, Any] | None = None
) -> Question | None:
    """Return the first draw of a seed that makes a question, which need not be certified."""
    for draw in range(40):
        with suppress(Unusable):
            return build(kind, world, seed, level, lab.Knobs(**(knobs or {})), draw, None)
    return None


# --- manifests ------------------------------------------------------------------------------------


def trivial_tables(folder: Path, about: dict[str, Any]) -> dict[str, float]:
    """Return the scores of trivial learners on a table."""
    rows, found = load(folder), dict[str, float]()
    for name in TRIVIAL:
        graph = learn(name, rows.lagged() if rows.is_temporal else rows)
        pairs = {tuple(n.split("@")[0].split("[")[0] for n in edge[:2]) for edge in graph.directed}
        edges = [[a, b] for a, b in pairs if a != b]
        found[name] = round(suites._overlap({"edges": edges}, about), 3)
    every = [[a, b] for a in about["names"] for b in about["names"] if a != b]
    return {**found, "all": round(suites._overlap({"edges": every}, about), 3)}


def tables() -> dict[str, dict[str, Any]]:
    """Return the recipes of ``physics-1``."""
    return {
        f"{name}-{data}": {
            "kind": name,
            "level": data,
            "source": source,
            "data": data,
            "seed": 0,
            "rows": 400 if name == "pushing" else 1000,
            **({"contacts": True, "view": "step"} if name == "boxes" else {}),
        }
        for name, source in SOURCES.items()
        for data in ("observational", "interventional", "paired")
    }


ABOUT = {
    "lab-1": {
        "title": "1,000 certified causal questions to laboratories of equations and physics.",
        "measures": "Whether an agent with a budget of experiments finds graphs, effects, laws, "
        "predictions under interventions, counterfactuals, explanations, controls and faults. "
        "Levels L1 to L4 say less and less about the variables beforehand. A scripted solver "
        "answers each question with the same tools and the same budget. 800 questions are public; "
        "200 follow from a key.",
        "limits": "Whoever has the package can compute the answer to a public question: the public "
        "split measures an agent only while it has the tools alone. The worlds are small, the "
        "solver knows the kind of each question, and a score says nothing of other worlds. The "
        "world of a seed is the same at each level; here each question has another seed.",
    },
    "physics-1": {
        "title": "Tables of servos, springs, boxes and a robot that pushes, with true graphs.",
        "measures": "Whether a learner finds a graph from observational rows, interventional rows, "
        "or pairs: the rows of 'paired' are the units of 'observational' under an intervention, "
        "with the same noise. 'servo-10-hidden' has two forces without a column. Springs and boxes "
        "have a row for each control step, and edges lead from one row to the next. The answer is "
        "scored by F1 of directed edges, at any lag and without loops, and of pairs with a hidden "
        "cause.",
        "limits": "The graphs are those of simulated systems that are declared and verified by "
        "experiments. A declared edge can be too weak to be seen in so few rows. Everybody can "
        "compute the true graphs.",
    },
}


def manifests(made: dict[str, Path]) -> None:
    """Write the manifests, with hashes, draws and trivial scores of parts that were made."""
    for name, parts in (("physics-1", tables()), ("lab-1", recipes())):
        if made and name not in made:
            continue
        found = {"versions": suites._here()}
        for part, recipe in parts.items():
            path = made[name] / f"{part}.json" if name in made else None
            if path is None or not path.exists() or recipe.get("private"):
                continue
            about = json.loads(path.read_text())["content"]
            trivial = about.get("trivial") or trivial_tables(made[name] / part, about)
            draws = {n: about[n] for n in ("seeds", "draws", "skipped") if n in about}
            recipe.update(sha256=about["sha256"], trivial=trivial, **draws)
        text = as_json({**ABOUT[name], **found, "parts": parts}, 2)
        (MANIFESTS / f"{name}.json").write_text(text + "\n")


PARTS = ("questions", "truth", "whole", "answers", "names", "suites", "curves", "trained")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--n", type=int, default=25)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--made", type=Path, nargs="*", default=[])
    given = parser.parse_args()
    part = "curves" if given.part == "curves" else "questions"
    given.rows = given.rows or HERE / f"lab_{part}.jsonl"
    known = json.loads(RESULTS.read_text())
    if given.part in ("curves", "trained"):
        one = trained(given.steps) if given.part == "trained" else curves(given.rows, given.workers)
        RESULTS.write_text(as_json({**known, given.part: one}) + "\n")
    if given.part == "curves":
        figures.main(["lab"])
    if given.part == "questions":
        questions(given.n, given.workers, given.rows)
    if given.part == "answers":
        RESULTS.write_text(as_json({**known, "answers": answers(given.n)}) + "\n")
    if given.part == "whole":
        RESULTS.write_text(as_json({**known, "lab-1": whole(given.made[0], given.n)}) + "\n")
    if given.part == "truth":
        rows = [json.loads(line) for line in given.rows.read_text().splitlines()]
        found = table(rows)
        for row in rows:
            if "spec" in row:
                outcome = confirm(Question.of(row["spec"]))["confirmed"]
                count = found[row["spec"]["kind"]].setdefault("confirmed", {})
                count[str(outcome)] = count.get(str(outcome), 0) + 1
        RESULTS.write_text(as_json({**known, "questions": found}) + "\n")
    if given.part == "names":
        RESULTS.write_text(as_json({**known, "names": names(given.n)}) + "\n")
    if given.part == "suites":
        manifests({path.name: path for path in given.made})


if __name__ == "__main__":
    main()
