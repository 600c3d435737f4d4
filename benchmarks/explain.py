"""Explain simulated recordings of models of others, and count which explanations are right.

::

    python benchmarks/explain.py --runs 2

Each of 15 questions is asked of ``runs`` recordings, with the noise given and with it estimated.
Parameters of several kinds deviate: one or several at once, a number of a vector (a tilted base, a
centre of mass), and parameters that are zero in the file. In three questions nothing deviates. A
verdict is ``right`` (the only best set is that of the deviating parameters, or ``none``), ``tied``
(it is one of several that are said to be tied), ``nothing`` (no parameter is named), ``partly``
(some that deviate are named, and no other ones), or ``wrong``. Candidates are those that deviate
and the others of a question; where it names none, up to four of the same kinds, and what the fits
of the case fit beside them. Every explanation is written to a file of lines of JSON, from which an
interrupted study goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fit import ANGLES, CASES, HERE, Case, deviating, record, world_of

from scm_world.queries.experiments.versions import versions

ENDINGS = (".mass", ".damping", ".gear", ".kp")
EXPOSED = ["*", "*.center_of_mass"]
ACROBOT, FINGER, _, REACHER, _, IIWA = CASES.values()


@dataclasses.dataclass(frozen=True)
class Question:
    """A recorded system, and the candidates.

    Attributes:
        case: The model; its ``factors`` deviate where no values do.
        values: Values that deviate.
        others: Candidates that do not deviate.
        nothing: Whether nothing deviates.
    """

    case: Case
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    others: tuple[str, ...] = ()
    nothing: bool = False


def still(case: Case) -> Case:
    """Return a case in which nothing deviates."""
    return dataclasses.replace(case, factors={}, also=(), delay=0.0)


LINKS = ("upper_arm.mass", "lower_arm.mass", "shoulder.damping", "elbow.damping", "elbow.gear")
CARTPOLE = Case("dm_control", "suite/cartpole.xml", {}, (), {"*.position": 1e-3})
CART = ("slider.damping", "hinge_1.damping", "slider.frictionloss", "slide.gear", "pole_1.mass")
PENDULUM = Case("dm_control", "suite/pendulum.xml", {}, (), ANGLES)
QUESTIONS = {name: Question(case) for name, case in CASES.items()} | {
    "acrobot: tilted base": Question(still(ACROBOT), {"gravity": [1.0, 0.0, -9.76]}, LINKS),
    "acrobot: centre of mass": Question(
        still(ACROBOT), {"lower_arm.center_of_mass": [0.1, 0.0, 0.6]}, ("gravity", *LINKS)
    ),
    "iiwa (URDF): payload": Question(
        still(IIWA),
        {
            "lbr_iiwa_link_7.mass": 1.3,
            "lbr_iiwa_link_7.center_of_mass": [0.05, 0.0, 0.1],
        },
        ("lbr_iiwa_joint_4.damping", "lbr_iiwa_link_4.mass", "gravity"),
    ),
    "cart-pole: spring and friction": Question(
        CARTPOLE, {"slider.stiffness": 20.0, "hinge_1.frictionloss": 0.05}, CART
    ),
    "reacher: friction of a joint": Question(
        still(REACHER),
        {"joint0.frictionloss": 10.0},
        ("joint0.damping", "joint0.gear", "joint1.damping", "joint1.frictionloss", "delay"),
    ),
    "pendulum: armature": Question(
        PENDULUM,
        {"hinge.armature": 0.1},
        ("hinge.damping", "torque.gear", "pole.mass", "hinge.stiffness", "gravity"),
    ),
    "acrobot: none": Question(still(ACROBOT), {}, ("gravity", *LINKS), nothing=True),
    "finger: none": Question(
        still(FINGER),
        {},
        ("hinge.frictionloss", "hinge.damping", "proximal.stiffness", "distal.gear", "distal.mass"),
        nothing=True,
    ),
    "cart-pole: none": Question(
        CARTPOLE, {}, ("slider.stiffness", "hinge_1.frictionloss", "gravity", *CART), nothing=True
    ),
}


def verdict(best: tuple[str, ...], truth: set[str]) -> str:
    """Judge the best sets of an explanation."""
    sets = [set(one.split(" + ")) for one in best]
    if truth in sets:
        return "right" if len(sets) == 1 else "tied"
    if sets[0] == {"none"}:
        return "nothing"
    return "partly" if sets[0] <= truth else "wrong"


def explained(question: Question, seed: int, given: bool) -> dict[str, Any]:
    """Explain one recording."""
    case = question.case
    world = world_of(case, expose=EXPOSED)
    values = question.values or deviating(world, case)
    fine = {"control_dt": 0.01} if case.delay else {}
    true = world_of(case, expose=EXPOSED, **fine).given(values)
    truth = {*values, *(("delay",) if case.delay else ())} or {"none"}
    world.reset(seed=0)
    asked = [*values, *case.also, *question.others]
    if not question.others:
        kinds = [n for n in world.compiled.static_names if n.endswith(ENDINGS) and n not in values]
        asked += kinds[:: max(1, len(kinds) // 4)][:4]
    recording, begin = record(world, true, case, seed), time.process_time()
    noise = dict(case.noise) if given else None
    most = 2 if question.nothing else len(truth)
    found = world.explain(recording, [*dict.fromkeys(asked)], most=most, noise=noise)
    seconds = time.process_time() - begin
    said = verdict(found.best, truth)
    about = {"verdict": said, "best": found.best, "CPU seconds": round(seconds, 2)}
    rows = found.table.drop(columns=["fitted"]).head(4)
    return {**about, "truth": sorted(truth), "table": rows.to_string(index=False)}


def main() -> None:
    """Explain recordings of all questions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=2, help="recordings of each question")
    parser.add_argument("--only", default="", help="questions whose names contain this")
    parser.add_argument("--out", type=Path, default=HERE / "explain.json")
    parser.add_argument("--kept", type=Path, default=Path("explain-runs.jsonl"))
    asked = parser.parse_args()
    done = [*map(json.loads, asked.kept.read_text().splitlines())] if asked.kept.exists() else []
    known = {(one["question"], one["seed"], one["noise given"]) for one in done}
    for seed in range(asked.runs):
        for name, question in QUESTIONS.items():
            for given in (True, False):
                if asked.only not in name or (name, seed, given) in known:
                    continue
                which = {"question": name, "seed": seed, "noise given": given}
                done.append(which | explained(question, seed, given))
                print(json.dumps(which), done[-1]["verdict"], done[-1]["CPU seconds"])
                print(done[-1]["table"], flush=True)
                with asked.kept.open("a") as file:
                    file.write(json.dumps(done[-1]) + "\n")
    count, seconds = Counter(one["verdict"] for one in done), [one["CPU seconds"] for one in done]
    print(json.dumps(count), f"at most {max(seconds):.3g} CPU seconds")
    if not asked.only:
        found = {"explanations": len(done), "verdicts": count, "versions": versions("")}
        found |= {"CPU seconds": {"sum": sum(seconds), "most": max(seconds)}}
        each = [{key: one[key] for key in one if key != "table"} for one in done]
        asked.out.write_text(json.dumps({**found, "each": each}, indent=1) + "\n")


if __name__ == "__main__":
    main()
