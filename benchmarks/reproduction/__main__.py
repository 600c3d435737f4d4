"""Train and evaluate what the figures of the CausalWorld paper show, beside the published scores.

::

    python -m benchmarks.reproduction --table pushing --plan
    python -m benchmarks.reproduction --table pushing --algos ppo --seeds 0 --scale 0.01
    python -m benchmarks.reproduction --recipe pushing-ppo-c1 > recipe.json

See ``docs/causal_world.md``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from benchmarks.reproduction.paper import paper
from scm_world.errors import in_one_line
from scm_world.evaluation import Evaluation, evaluate, protocols_of
from scm_world.evaluation.figures import write_figures
from scm_world.evaluation.statistics import aggregate
from scm_world.runs.files import locked, write_whole
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe, recipe

KNOWN = json.loads((Path(__file__).parent / "published.json").read_text(encoding="utf-8"))
TASKS = ("pushing", "picking", "pick_and_place", "stacking2")
ALGOS, CURRICULA = ("ppo", "sac", "td3"), ("0", "1", "2")
PROTOCOLS = tuple(protocol.name for protocol in protocols_of("pushing"))
METRIC, ALL = "last_fractional_success", "all"
RULES = {"paper": "causal_world", "tuned": "scm_world"}
"""The usual conventions of each preset: those of the scores that it is compared with."""
SAME = ("preset", "scale", "backend", "policy", "conventions")
"""Options that are the same for everything in one folder."""

ON_POLICY, SIMULATED = 3850.0, 5900.0
"""Control steps per CPU-second: PPO with 64 worlds, and simulation alone (measured)."""
UPDATES = {"sac": (53.0, 256.0, 0.67), "td3": (104.0, 128.0, 0.27)}
"""Updates per CPU-second with a batch size, and by which power of it they slow down (measured)."""


class TimeIsOver(Exception):
    """The hours that were given are over; what is finished is kept."""


class Cell(NamedTuple):
    """A training."""

    task: str
    algo: str
    curriculum: int
    seed: int

    @property
    def name(self) -> str:
        """Name of its folders."""
        return f"{self.task}-{self.algo}-c{self.curriculum}-{self.seed}"


def cells(asked: argparse.Namespace) -> list[Cell]:
    """List the trainings: first one seed of everything, then the next one."""
    return [
        Cell(task, algo, int(curriculum), seed)
        for seed in asked.seeds
        for task in asked.tasks
        for algo in asked.algos
        for curriculum in asked.curricula
    ]


def recipe_of(asked: argparse.Namespace, cell: Cell) -> Recipe:
    """Return how a cell is trained, with a share of the preset's steps in whole rounds.

    There are no evaluations while training where the last policy counts: they change nothing.
    """
    make = paper if asked.preset == "paper" else recipe
    env = {"conventions": asked.conventions}
    made: Recipe = make(cell.task, cell.algo, curriculum=cell.curriculum, env=env)
    steps = math.ceil(made.steps * asked.scale / made.round) * made.round
    trials = {} if asked.policy == "best" else {"trials.protocols": ()}
    return made.but(steps=steps, **trials)


def cost(made: Recipe) -> float:
    """Estimate the time of the processor that a training takes [h]."""
    if made.algo == "ppo":
        return made.steps / ON_POLICY / 3600.0
    settings: Any = made.settings
    updates = made.steps / (settings.train_freq * made.worlds) * max(settings.gradient_steps, 1)
    rate, batch, power = UPDATES[made.algo]
    each = (settings.batch_size / batch) ** power / rate
    return (updates * each + made.steps / SIMULATED) / 3600.0


def evaluated(place: Path) -> Evaluation | None:
    """Read an evaluation; None if it is not finished."""
    return Evaluation.load(place) if (place / "results.json").exists() else None


def is_done(asked: argparse.Namespace, place: Path, policy: Path) -> bool:
    """Tell whether this very policy is evaluated in all protocols and episodes."""
    found = evaluated(place)
    if found is None or not policy.exists():
        return False
    same = found.about["agents"][0]["policy"]["sha256"] == _digest(policy)
    enough = found.about["n"] >= asked.episodes and {*asked.protocols} <= {*found.protocols}
    return bool(same and enough)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def run_cell(asked: argparse.Namespace, cell: Cell) -> None:
    """Train and evaluate a cell; what is finished is kept, and the rest goes on.

    Raises:
        TimeIsOver: It is.
    """
    made, run = recipe_of(asked, cell), asked.out / "runs" / cell.name
    policy = run / ("policy.safetensors" if asked.policy == "last" else "best.safetensors")
    place, tell = asked.out / "evaluations" / cell.name, partial(_in_time, asked.until)
    tell(0, 1)
    how: dict[str, Any] = {"seed": cell.seed, "backend": asked.backend, "threads": 1}
    train(made, out=run, progress=tell, **how)
    if not is_done(asked, place, policy):
        agent = {f"{cell.algo.upper()} curriculum {cell.curriculum}": str(policy)}
        play(asked, place, agent, cell.task)
        write_figures(Evaluation.load(place), place)


def play(asked: argparse.Namespace, place: Path, agent: Any, task: str, **env: Any) -> None:
    """Evaluate; protocols and episodes that are there already stay."""
    before = evaluated(place)
    names = (*asked.protocols, *(before.protocols if before else ()))
    found = evaluate(
        agent,
        tuple(dict.fromkeys(names)),
        task=task,
        n=max(asked.episodes, before.about["n"] if before else 0),
        backend=asked.backend,
        env=env or None,
        out=place,
        progress=partial(_in_time, asked.until),
    )
    found.save(place)


def _in_time(until: float, done: int, total: int) -> None:
    if done < total and time.time() >= until:
        raise TimeIsOver


def run(asked: argparse.Namespace) -> int:
    """Do the study; return how many trainings failed."""
    for actor in KNOWN["actors"] if asked.actors else ():
        if actor["task"] in asked.tasks:
            archive = asked.actors / actor["file"]
            if not archive.exists() or _digest(archive) != actor["sha256"]:
                raise SystemExit(f"{archive} is not the published archive")
            env = {"conventions": "causal_world", "frame_skip": 3}
            place = asked.out / "actors" / actor["task"]
            play(asked, place, {"published actor": str(archive)}, actor["task"], **env)
    failed = left = 0
    for cell, wait in _running(asked):
        try:
            wait()
            print(f"{cell.name}: done", flush=True)
        except TimeIsOver:
            left += 1
        except Exception as error:  # it must not stop the other trainings
            failed += 1
            print(f"{cell.name}: {in_one_line(error)}", file=sys.stderr, flush=True)
    if left:
        print(f"the time is over: {left} trainings are left; the same command goes on")
    return failed


def _running(asked: argparse.Namespace) -> Iterable[tuple[Cell, Callable[[], Any]]]:
    """Run the cells here or in processes; what is yielded waits for one of them."""
    if asked.workers == 1:
        yield from ((cell, partial(run_cell, asked, cell)) for cell in cells(asked))
        return
    with ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(run_cell, asked, cell): cell for cell in cells(asked)}
        yield from ((jobs[job], job.result) for job in as_completed(jobs))


# --- tables and figures ---------------------------------------------------------------------------


def findings(asked: argparse.Namespace) -> pd.DataFrame:
    """Return a row for each number of the figures: ours, the published one, the actor's."""
    rows: list[dict[str, Any]] = []
    for task in asked.tasks:
        actor_here = evaluated(asked.out / "actors" / task)
        for key in [(task, algo, int(c)) for algo in ALGOS for c in CURRICULA]:
            here: dict[int, Evaluation] = {}
            for place in sorted((asked.out / "evaluations").glob("{}-{}-c{}-*".format(*key))):
                if (one := evaluated(place)) is not None:
                    here[int(place.name.rpartition("-")[2])] = one
            known, actor = _known("scores", key), _known("actors", key)
            missing = lacks(asked, key, here)
            for protocol in (*PROTOCOLS, ALL):
                row = dict(zip(("task", "algo", "curriculum"), key, strict=True))
                row |= {"protocol": protocol, "status": missing, **_ours(here, protocol)}
                row |= {"published": _value(known, protocol), "source": known.get("source", "")}
                if actor and actor_here is not None:
                    row |= _ours({0: actor_here}, protocol, "actor_here")
                    row["actor_original"] = actor["values"].get(protocol)
                rows.append(row)
    columns = "mean low high over seeds actor_here actor_here_low actor_here_high actor_original"
    return pd.DataFrame(rows).reindex(
        columns=[*rows[0], *(c for c in columns.split() if c not in rows[0])]
    )


def _known(kind: str, key: tuple[str, str, int]) -> dict[str, Any]:
    found = [one for one in KNOWN[kind] if (one["task"], one["algo"], one["curriculum"]) == key]
    return found[0] if found else {}


def _value(known: dict[str, Any], protocol: str) -> float | None:
    values = known.get("values", {})
    return (
        float(np.mean([*values.values()])) if protocol == ALL and values else values.get(protocol)
    )


def _ours(here: dict[int, Evaluation], protocol: str, name: str = "mean") -> dict[str, Any]:
    """Estimate a score over seeds, or over the episodes of the only one."""
    names = PROTOCOLS if protocol == ALL else (protocol,)
    played = {s: e for s, e in here.items() if {*names} <= {*e.protocols}}
    scores = [np.array([e.only(protocol=p).frame[METRIC] for p in names]) for e in played.values()]
    if not scores or scores[0].shape[-1] * len(scores) == 1:
        return {}
    over = "seeds" if len(scores) > 1 else "episodes"
    units = np.array([one.mean(axis=-1) for one in scores]) if over == "seeds" else scores
    found = aggregate(units, over="runs" if over == "seeds" else over)["mean"]
    low = "" if name == "mean" else f"{name}_"
    row = {name: found.value, f"{low}low": found.low, f"{low}high": found.high}
    more = {"over": over, "seeds": " ".join(map(str, played))}
    return {**row, **(more if name == "mean" else {})}


def lacks(asked: argparse.Namespace, key: tuple[str, str, int], here: dict[int, Evaluation]) -> str:
    """Say what one group of trainings lacks of what was published."""
    if not here:
        return "not run"
    budget = KNOWN["budget"]
    made = recipe_of(asked, Cell(*key, 0))
    usual = {"preset": "paper", "policy": "last", "conventions": "causal_world"}
    problems = [
        f"{name} {getattr(asked, name)}, not the paper's"
        for name, its in usual.items()
        if getattr(asked, name) != its
    ]
    for what, ours, there in (
        ("control steps", made.steps, budget["steps"][key[1]]),
        ("seeds", len(here), budget["seeds"]),
        ("episodes of each protocol", min(e.about["n"] for e in here.values()), budget["episodes"]),
        ("protocols", min(len(e.protocols) for e in here.values()), len(PROTOCOLS)),
    ):
        if ours < there:
            problems.append(f"{ours:,} of {there:,} {what}")
    return f"Partial budget, not a reproduction: {'; '.join(problems)}" if problems else "Whole"


def write(asked: argparse.Namespace) -> None:
    """Write ``table.csv``, ``table.md`` and a radar of each task and algorithm that was run."""
    table = findings(asked)
    write_whole(asked.out / "table.csv", table.to_csv(index=False))
    head = ", ".join(f"{name} {getattr(asked, name)}" for name in SAME)
    lines = [f"# Figures of the paper: {', '.join(asked.tasks)}", "", f"{head}. {METRIC}: mean"]
    lines[-1] += " with its 95 % interval, over seeds or, marked with an e, over episodes."
    for (task, algo), part in table.groupby(["task", "algo"], sort=False):
        lines += ["", f"## {task}, {algo.upper()}", ""]
        for curriculum, group in part.groupby("curriculum"):
            lines.append(f"- curriculum {curriculum}: {group['status'].iloc[0]}")
        heads = [f"c{c}: {side}" for c in CURRICULA for side in ("ours", "published", "actor")]
        lines += ["", _line(["protocol", *heads]), _line(["---"] * (1 + len(heads)))]
        for protocol, group in part.groupby("protocol", sort=False):
            lines.append(
                _line([protocol, *(word for _, row in group.iterrows() for word in _said(row))])
            )
        if part[["mean", "actor_here"]].notna().any(axis=None):
            radar(part, f"{task}, {algo.upper()}", asked.out / f"{task}-{algo}.png")
    sources = [
        f"- {name}: {s['what']}; {s['how']}, ±{s['tolerance']}"
        for name, s in KNOWN["sources"].items()
    ]
    lines += ["", "## Sources", "", KNOWN["work"], "", *sources]
    lines += [f"- {remark}" for remark in KNOWN["remarks"]]
    write_whole(asked.out / "table.md", "\n".join(lines) + "\n")


def _line(words: Sequence[str]) -> str:
    return f"| {' | '.join(words)} |"


def _said(row: pd.Series) -> list[str]:
    def interval(name: str, low: str) -> str:
        return f"{row[name]:.2f} [{row[f'{low}low']:.2f}, {row[f'{low}high']:.2f}]"

    ours = "not run" if pd.isna(row["mean"]) else interval("mean", "")
    ours += " e" if row["over"] == "episodes" else ""
    published = "–" if pd.isna(row["published"]) else f"{row['published']:.2f}"
    actor = "" if pd.isna(row["actor_here"]) else f"{interval('actor_here', 'actor_here_')} e"
    return [ours, published, actor]


def radar(part: pd.DataFrame, title: str, path: Path) -> None:
    """Draw the scores of a task and an algorithm: a color for each curriculum."""
    angles = np.linspace(0.0, 2.0 * np.pi, len(PROTOCOLS), endpoint=False)
    figure, axes = plt.subplots(subplot_kw={"projection": "polar"}, figsize=(8, 7))
    styles = {"mean": ("ours", "-"), "published": ("published", ":"), "actor_here": ("actor", "--")}
    for curriculum, group in part[part["protocol"] != ALL].groupby("curriculum"):
        for column, (side, style) in styles.items():
            values = group[column].to_numpy(float)
            if np.isfinite(values).any():
                label = f"curriculum {curriculum}, {side}"
                closed = (np.append(angles, angles[0]), np.append(values, values[0]))
                axes.plot(*closed, style, color=f"C{curriculum}", label=label)
    axes.set_xticks(angles, PROTOCOLS)
    axes.set_ylim(0.0, 1.0)
    axes.set_title(f"{title}: fractional success at the end of an episode")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    status = part[["curriculum", "status"]].drop_duplicates().itertuples(index=False)
    figure.text(0.02, 0.01, "\n".join(f"curriculum {c}: {s}" for c, s in status), fontsize=6)
    figure.savefig(path, dpi=120, bbox_inches="tight")
    plt.close(figure)


# --- command line ---------------------------------------------------------------------------------


def _several(known: Sequence[str]) -> Callable[[str], list[str]]:
    def read(text: str) -> list[str]:
        words = [word.strip() for word in text.split(",")]
        for word in words:
            if word not in known:
                raise argparse.ArgumentTypeError(f"{word!r} is none of {', '.join(known)}")
        return words

    return read


def _seeds(text: str) -> list[int]:
    return [] if text == "none" else [int(word) for word in text.split(",")]


def read(words: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="benchmarks.reproduction", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("--table", default="pushing", choices=(*TASKS, "all"), help="figure that is filled")
    add("--tasks", type=_several(TASKS), help="of the figure; all by default")
    add("--algos", type=_several(ALGOS), default=ALGOS)
    add("--curricula", type=_several(CURRICULA), default=CURRICULA)
    add("--protocols", type=_several(PROTOCOLS), default=PROTOCOLS)
    add("--seeds", type=_seeds, default=[0, 1, 2, 3, 4], help="with commas; none: train nothing")
    add("--preset", choices=RULES, default="paper")
    add("--scale", type=float, default=1.0, help="share of the preset's training steps")
    add("--episodes", type=int, default=KNOWN["budget"]["episodes"], help="of each protocol")
    add("--policy", choices=("last", "best"), default="last", help="of a training")
    add("--conventions", choices=("causal_world", "scm_world"), help="usually by preset")
    add("--backend", default="mujoco")
    add("--actors", type=Path, help="folder with the published actors; they are evaluated, too")
    add("--hours", type=float, default=math.inf, help="stop after so much time on the clock")
    add("--workers", type=int, default=1, help="trainings at the same time")
    add("--out", type=Path, default=Path("reproduction"), help="folder for everything")
    add("--plan", action="store_true", help="show what there is to do, and what it costs")
    add("--recipe", metavar="TASK-ALGO-cN", help="print the recipe of a training as JSON")
    asked = parser.parse_args(words)
    if not 0.0 < asked.scale <= 1.0:
        parser.error("--scale must be more than 0 and at most 1")
    asked.tasks = asked.tasks or (TASKS if asked.table == "all" else (asked.table,))
    asked.conventions = asked.conventions or RULES[asked.preset]
    asked.until = time.time() + 3600.0 * asked.hours
    return asked


def main(words: Sequence[str] | None = None) -> int:
    """Run the study; return 1 if a training failed."""
    asked = read(words)
    if asked.recipe:
        task, algo, curriculum = asked.recipe.split("-")
        print(recipe_of(asked, Cell(task, algo, int(curriculum[1:]), 0)).to_json())
        return 0
    if asked.plan:
        hours = {cell.name: cost(recipe_of(asked, cell)) for cell in cells(asked)}
        for name, one in hours.items():
            state = "begun" if (asked.out / "runs" / name).exists() else ""
            if (asked.out / "evaluations" / name / "results.json").exists():
                state = "done"
            print(f"{name:28} {one:8.2f} CPU-hours  {state}")
        print(f"{len(hours)} trainings, {sum(hours.values()):,.1f} CPU-hours")
        return 0
    with locked(asked.out):
        head = {name: getattr(asked, name) for name in SAME}
        about = asked.out / "study.json"
        if about.exists() and json.loads(about.read_text(encoding="utf-8")) != head:
            raise SystemExit(f"{asked.out} holds a study with other options: {about.read_text()}")
        write_whole(about, json.dumps(head))
        failed = run(asked)
        write(asked)
    print(f"written: {asked.out}/table.md, table.csv")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
