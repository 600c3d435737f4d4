"""Which hidden cause has an agent learned to infer? Seven agents for a cart, a puck and a reacher.

``python examples/adaptation.py cart`` trains and tests them with one seed, in some ten minutes;
``python examples/adaptation.py cart puck reacher --seeds 5 --out adaptation`` is the study. Killed,
the same call resumes. It needs the extra ``train``. The page *Agents that adapt* says which
criteria were fixed beforehand, and what came out.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from numba import njit

from scm_world import Box, ModelTask
from scm_world.evaluation import Adaptive, Inferred, Protocol, evaluate, inferred
from scm_world.evaluation.figures import write_figures
from scm_world.evaluation.results import Evaluation

HERE = Path(__file__).resolve()


class Cart(ModelTask):
    """Stay at the origin against a steady push, seen by noisy sensors."""

    model = """<mujoco model="cart"><option timestep="0.01"/><worldbody><body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" damping="1"/>
      <geom size=".2 .1 .1" type="box" mass="1"/></body></worldbody><actuator>
      <motor name="motor" joint="slider" gear="10" ctrlrange="-1 1"/></actuator></mujoco>"""
    name, seconds, control_dt = "cart", 4.0, 0.04
    expose = ("*", "*.external_force")
    noise = {"slider.position": 0.03, "slider.velocity": 0.3}  # noqa: RUF012
    start = {"slider.position": Box(-0.5, 0.5)}  # noqa: RUF012
    spaces = {  # noqa: RUF012
        "cart.external_force": {"a": Box((-4, 0, 0), (4, 0, 0)), "b": Box((4, 0, 0), (6, 0, 0))},
        "motor.gear": {"a": Box(8, 12), "b": Box(12, 20)},
    }
    reward = (njit(lambda x, v: -abs(x) - 0.05 * abs(v)), "slider.position", "slider.velocity")


class Puck(ModelTask):
    """Push a puck to a place beyond the reach of the finger: it has to slide there."""

    model = """<mujoco model="puck"><option timestep="0.01"/><worldbody>
      <body name="finger"><joint name="rail" type="slide" axis="1 0 0" damping="1"
      range="-.2 .3" limited="true"/><geom name="tip" size=".03" mass=".2"/></body>
      <body name="puck"><joint name="slide" type="slide" axis="1 0 0" frictionloss=".5"
      damping=".1"/><geom name="disc" size=".04 .02" type="cylinder" mass=".5"/></body></worldbody>
      <actuator><motor name="motor" joint="rail" gear="5" ctrlrange="-1 1"/></actuator></mujoco>"""
    name, seconds, control_dt = "puck", 3.0, 0.04
    noise = {"slide.position": 0.005, "slide.velocity": 0.1}  # noqa: RUF012
    start = {"slide.position": Box(0.1, 0.15), "rail.position": Box(-0.1, 0.0)}  # noqa: RUF012
    spaces = {  # noqa: RUF012
        "puck.mass": {"a": Box(0.2, 0.8), "b": Box(0.8, 2.0)},
        "slide.frictionloss": {"a": Box(0.3, 1.0), "b": Box(1.0, 2.0)},
    }
    reward = (njit(lambda x: -abs(x - 0.45)), "slide.position")


class Reacher(ModelTask):
    """Hold the tip of two links at a place, with motors whose strength and delay are unknown."""

    model = """<mujoco model="reacher"><option timestep="0.01" gravity="0 0 0"/><default>
      <joint type="hinge" axis="0 0 1" damping="0.05" armature="0.01"/>
      <geom type="capsule" size="0.02" mass="0.2" contype="0" conaffinity="0"/></default>
      <worldbody><body name="upper"><joint name="shoulder"/><geom fromto="0 0 0 .3 0 0"/>
      <body name="lower" pos=".3 0 0"><joint name="elbow"/><geom fromto="0 0 0 .3 0 0"/></body>
      </body></worldbody><actuator><motor name="first" joint="shoulder" ctrlrange="-1 1"/>
      <motor name="second" joint="elbow" ctrlrange="-1 1"/></actuator></mujoco>"""
    name, seconds, control_dt = "reacher", 3.0, 0.04
    delay = {"*.control": 1.4}  # noqa: RUF012
    start = {"shoulder.position": Box(-1, 1), "elbow.position": Box(0.5, 2)}  # noqa: RUF012
    spaces = {  # noqa: RUF012
        "*.gear": {"a": Box(0.7, 1.3), "b": Box(1.3, 2.5)},
        "*.control_delay": {"a": Box(1.0, 1.5), "b": Box(1.5, 2.0)},
    }
    reward = (
        njit(
            lambda a, b: (
                -0.1
                * np.hypot(
                    3 * np.cos(a) + 3 * np.cos(a + b) - 2, 3 * np.sin(a) + 3 * np.sin(a + b) - 4
                )
            )
        ),
        "shoulder.position",
        "elbow.position",
    )


TASKS: dict[str, type[ModelTask]] = {"cart": Cart, "puck": Puck, "reacher": Reacher}
CAUSES = {
    "cart": {"push": "cart.external_force", "gear": "motor.gear"},
    "puck": {"mass": "puck.mass", "friction": "slide.frictionloss"},
    "reacher": {"gear": "*.gear", "delay": "*.control_delay"},
}
MEASURES = {  # by the agent that fits: the noise of its sensors, or what it takes for noise
    "cart": {"slider.position_reading": 0.03, "slider.velocity_reading": 0.3},
    "puck": {"slide.position_reading": 0.005, "rail.position": 0.001},
    "reacher": {"shoulder.position": 0.001, "elbow.position": 0.001},
}
PAST = 5  # control steps that the agents with a history observe
LEARNS: dict[str, dict[str, Any]] = {
    "plain": {},
    "randomised": {"curriculum": "A"},
    "history": {"curriculum": "A", "env": {"history": PAST}},
    "recurrent": {"curriculum": "A", "algo": "recurrent_ppo", "network": {"recurrent": 32}},
    "privileged": {"curriculum": "A", "observations": "privileged"},
}
AGENTS = (*LEARNS, "student", "fit")


def protocols(task: str) -> list[Protocol]:
    """Return what varies in the tests: nothing, and each cause and pair of causes from A and B."""
    sets = [one for k in (1, 2) for one in itertools.combinations(CAUSES[task].items(), k)]
    return [Protocol("P0")] + [
        Protocol(f"{space} {'+'.join(word for word, _ in one)}", [name for _, name in one], space)
        for space, one in itertools.product("AB", sets)
    ]


def trained(task: str, agent: str, seed: int, steps: int, folder: Path) -> Path:
    """Train an agent, or load it where it is trained."""
    from scm_world.training.imitation import clone, lesson
    from scm_world.training.loop import train
    from scm_world.training.recipe import recipe

    source, out = f"{HERE}:{TASKS[task].__name__}", folder / task / f"{agent}-{seed}"
    if (out / "done").exists():
        return out / "policy.safetensors"
    if agent == "student":  # of the privileged agent, with a history in place of the causes
        teacher = folder / task / f"privileged-{seed}" / "policy.safetensors"
        fields: dict[str, Any] = {"teacher": str(teacher), "env": {"history": PAST}, "keep": 0.0}
        fields |= {"protocols": ["A"], "episodes": steps // 500, "more": steps // 1000, "rounds": 3}
        fields |= {"share": 0.5, "stretch": 25.0, "noise": 0.1, "trials": {"protocols": []}}
        fields |= {"network": {"hidden": (64, 64)}, "updates": max(steps // 30, 100), "batch": 256}
        clone(None, lesson(source, **fields), out=out, seed=seed)
    else:
        given = dict(LEARNS[agent])
        how: dict[str, Any] = {"steps": steps, "worlds": 32, "n_steps": 50, "batch_size": 400}
        how |= {"n_epochs": 8, "gamma": 0.97, "rate": {"initial": 1e-3, "schedule": "linear"}}
        how["network"] = {"hidden": (64, 64), "log_std": -0.5, **given.pop("network", {})}
        made = recipe(source, given.pop("algo", "ppo"), trials={"protocols": []}, **how, **given)
        train(made, out=out, seed=seed)
    (out / "done").touch()
    return out / "policy.safetensors"


def fitting(task: str, policy: Path) -> Adaptive:
    """Return an agent that fits the causes to its episode, and acts as if it saw them."""
    causes = [*CAUSES[task].values()]
    how: dict[str, Any] = {
        "after": 10,
        "every": 30,
        "prior": "A",
        "iterations": 15,
        "measures": MEASURES[task],
    }
    return Adaptive(str(policy), causes, **how)


def study(task: str, seeds: int, steps: int, episodes: int, folder: Path) -> Evaluation:
    """Train all agents, evaluate them in the same draws, and probe those that have a memory."""
    policies = {
        agent: [trained(task, agent, seed, steps, folder) for seed in range(seeds)]
        for agent in (*LEARNS, "student")
    }
    agents: dict[str, Any] = {**policies}
    agents["fit"] = [fitting(task, policy) for policy in policies["privileged"]]
    source = f"{HERE}:{TASKS[task].__name__}"
    found = evaluate(agents, protocols(task), task=source, n=episodes, out=folder / task / "tests")
    found.save(folder / task)
    write_figures(found, folder / task, reference="privileged")
    for agent, seed in itertools.product(("history", "recurrent", "student"), range(seeds)):
        path = folder / task / f"inferred-{agent}-{seed}.json"
        if not path.exists():
            judge = policies["privileged"][seed]
            probed = inferred(
                policies[agent][seed],
                [*CAUSES[task].values()],
                task=source,
                privileged=judge,
                n=max(2 * episodes, 12),
                seed=seed,
            )
            probed.save(path)
    return found


def tables(found: Evaluation, folder: Path) -> Iterator[tuple[str, pandas.DataFrame]]:
    """Return what came out: scores, gains over the randomised agent, regrets, inferred causes."""
    others = [agent for agent in found.agents if agent != "randomised"]
    scores, gains, regrets = [], [], []
    for name in found.protocols:
        scores.append({a: str(found.score(name, agent=a)) for a in found.agents})
        gains.append({a: str(found.regret("randomised", a, name)) for a in others})
        left = [agent for agent in others if agent != "privileged"]
        regrets.append({a: str(found.regret(a, "privileged", name)) for a in left})
    yield "return", pandas.DataFrame(scores, index=found.protocols)
    yield "gain over the randomised agent", pandas.DataFrame(gains, index=found.protocols)
    yield "regret to the privileged agent", pandas.DataFrame(regrets, index=found.protocols)
    files = sorted(folder.glob("inferred-*.json"))
    probes = {path.stem.removeprefix("inferred-"): Inferred.load(path).verdicts() for path in files}
    yield "inferred", pandas.DataFrame(probes).T


def main(*arguments: str) -> None:
    """Run the study of some tasks."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("tasks", nargs="*", default=["cart"], help=", ".join(TASKS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--steps", type=int, default=150_000, help="of each training")
    parser.add_argument("--episodes", type=int, default=20, help="of each protocol")
    parser.add_argument("--out", default="adaptation")
    given = parser.parse_args(arguments or None)
    folder = Path(given.out or tempfile.mkdtemp())
    for task in given.tasks:
        found = study(task, given.seeds, given.steps, given.episodes, folder)
        for title, table in tables(found, folder / task):
            table.to_csv(folder / task / f"{title.replace(' ', '_')}.csv")
            print(f"\n{task}: {title}", table.to_string(), sep="\n")


if __name__ == "__main__":
    main()
