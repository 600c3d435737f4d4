"""Explain simulated recordings of the models of ``fit.py``, and count which explanations are right.

::

    python benchmarks/explain.py --runs 3

A verdict is ``right`` (the only best set is that of the deviating parameters), ``tied`` (it is one
of several that are said to be tied), ``nothing`` (no parameter is named), ``partly`` (some that
deviate are named, and no other ones), or ``wrong``. Candidates are those that deviate, up to four
of the same kinds that do not, and what the fits of the case fit beside them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from typing import Any

from fit import CASES, OTHERS, Case, deviating, record, world_of

ENDINGS = (".mass", ".damping", ".gear", ".kp")


def verdict(best: tuple[str, ...], truth: set[str]) -> str:
    """Judge the best sets of an explanation."""
    sets = [set(one.split(" + ")) for one in best]
    if truth in sets:
        return "right" if len(sets) == 1 else "tied"
    if sets[0] == {"none"}:
        return "nothing"
    return "partly" if sets[0] <= truth else "wrong"


def explained(case: Case, seed: int, given: bool) -> dict[str, Any]:
    """Explain one recording."""
    world = world_of(case)
    values = deviating(world, case)
    true = world_of(case, **({"control_dt": 0.01} if case.delay else {})).given(values)
    truth = {*values, *(("delay",) if case.delay else ())}
    world.reset(seed=0)
    others = [n for n in world.compiled.static_names if n.endswith(ENDINGS) and n not in values]
    asked = dict.fromkeys([*values, *case.also, *others[:: max(1, len(others) // 4)][:4]])
    recording, begin = record(world, true, case, seed), time.process_time()
    noise = dict(case.noise) if given else None
    found = world.explain(recording, [*asked], most=len(truth), noise=noise)
    seconds = time.process_time() - begin
    about = {"verdict": verdict(found.best, truth), "best": found.best, "CPU seconds": seconds}
    rows = found.table.drop(columns=["fitted"]).head(4)
    return {**about, "truth": sorted(truth), "table": rows.to_string(index=False)}


def main() -> None:
    """Explain recordings of all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3, help="recordings of each model")
    parser.add_argument("--only", default="", help="cases whose names contain this")
    asked = parser.parse_args()
    count: Counter[str] = Counter()
    for name, case in {**CASES, **OTHERS}.items():
        for seed in range(asked.runs if asked.only in name else 0):
            for given in (True, False):
                found = explained(case, seed, given)
                count[found["verdict"]] += 1
                table = found.pop("table")
                said = "noise given" if given else "noise estimated"
                print(f"{name}, seed {seed}, {said}: {json.dumps(found)}\n{table}", flush=True)
    print(json.dumps(count))


if __name__ == "__main__":
    main()
