"""Public functions and constructors with one wrong argument: a typed error, at once, or a result.

Every callable that the reference documents is called with valid arguments for all but one, which
gets wrong values one after another.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import re
import signal
import traceback
import typing
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest

import scm_world as sw
from scm_world import (
    backends,
    curricula,
    discovery,
    evaluation,
    fit,
    graph,
    lab,
    models,
    policies,
    queries,
    tasks,
    variables,
)
from scm_world import env as environments
from scm_world.discovery import data, learners, problems, representations
from scm_world.errors import ModelError, ScmWorldError
from scm_world.lab.questions import build as build_question
from scm_world.policies import planning
from scm_world.queries.local import local_graph
from scm_world.tasks import families
from scm_world.testing.model import check_model
from scm_world.world import (
    Audit,
    Audits,
    Batch,
    CompiledModel,
    EquationBatch,
    Equations,
    Simulation,
)

LIMIT = 60.0
"""Seconds of the processor after which a call counts as one that does not end.

The first call of a function may compile for ten seconds, where no cache of numba is left.
"""
WRONG: dict[str, Any] = {
    "None": None,
    "3": 3,
    "-1": -1,
    "2.5": 2.5,
    "nan": math.nan,
    "''": "",
    "'nonsense'": "nonsense",
    "'two lines'": "a\nb",
    "bytes": b"x",
    "[]": [],
    "[None]": [None],
    "{}": {},
    "{3: None}": {3: None},
    "object()": object(),
    "True": True,
    "10**30": 10**30,
    "lambda": lambda: 0,
    "frame": pd.DataFrame({"a": [1.0, 2.0]}),
    "objects": np.array([1, "a"], object),
}

VALID = {("workers", "3"), ("threads", "3")}
"""What would start processes or threads."""
BALL = (
    "<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
)


def _model() -> sw.SCM:
    cause = sw.Exogenous(name="a", distribution=variables.Normal(), a=sw.Box(0, 1))
    linear = sw.Linear(weights=(2.0,))
    noise = variables.Normal()
    return sw.SCM([cause, sw.Derived(name="y", parents=("a",), mechanism=linear, noise=noise)])


def _step(state: Any) -> Any:
    return state


@cache
def _documented() -> dict[str, Any]:
    """Return the callables of ``__all__`` of every module in docs/reference, and of the package."""
    pages = (Path(__file__).parents[1] / "docs/reference").glob("*.md")
    modules = [
        "scm_world",
        *(m for p in pages for m in re.findall(r"^::: (\S+)", p.read_text(), re.M)),
    ]
    homes = {module: importlib.import_module(module) for module in modules}
    homes.pop("scm_world.training")  # it has modules only
    named = {
        f"{m}.{name}": getattr(home, name) for m, home in homes.items() for name in home.__all__
    }
    return {name: one for name, one in named.items() if callable(one)}


def _calls(folder: Path) -> Iterator[tuple[Callable[..., Any], dict[str, Any]]]:
    """Yield callables with valid arguments by name; of which each is made wrong in turn."""
    V, model = variables, _model()  # noqa: N806
    table = data.collect(model, data.Design("single", ("a",)), 12)
    frame = data.as_frame(table)
    world = sw.World("pushing", backend="fake")
    world.reset(seed=0)
    scene = sw.World(BALL)
    scene.reset(seed=0)
    episode = model.rollout(seed=0)
    env = gymnasium.make("scm_world/Pushing-v0", backend="fake", max_episode_length=2)
    agent = policies.as_agent("random")
    part = curricula.resample("*.mass")
    time = {"at": 3}
    one = {"name": "a", "unit": "1", "shape": (), "dtype": "real", "bounds": sw.Box(-1, 1)}
    one |= {"a": sw.Box(0, 1), "b": sw.Box(0, 1), "a_or_b": None, "doc": ""}
    path = queries.save_episode(episode, folder / "episode.npz")
    saved = data.save(table, folder / "table")
    # Variables.
    yield sw.Exogenous, {**one, "default": 0.0, "distribution": V.Normal(), "per": "step"}
    given = {"parents": ("c",), "mechanism": sw.Linear(weights=(1.0,)), "start": 0.0}
    noise = {"noise": V.Normal(), "noise_shape": (), "inverse": None, "inverse_noise": "additive"}
    yield sw.Derived, {**one, **given, **noise}
    given = {"mechanism": None, "start": None, "carry": None, "restart": ()}
    yield sw.Measured, {**one, "parents": ("c",), "settable_state": True, "default": 0.0, **given}
    yield sw.Action, one
    yield sw.Fixed, {**one, "value": 0.5, "intervenable": True}
    yield sw.Box, {"low": -1.0, "high": 1.0}
    yield sw.Contact, {"first": "a", "second": "b"}
    yield sw.Draw, {"source": "A", "time": None, "stream": "a", "of": "a", "at": 3}
    yield sw.Draw, {"source": 0.0, "high": 1.0}
    yield sw.Hard, {"value": 1.0, "at": 3}
    yield sw.Linear, {"weights": (1.0,), "intercept": 0.0}
    mechanism = {"function": abs, "parents": ("a",), "noise": V.Normal(), "of": None, "at": 3}
    yield sw.Mechanism, {**mechanism, "inverse_noise": "additive"}
    yield sw.Natural, {"at": 3}
    yield sw.Null, {"at": 3}
    yield sw.Parent, {"name": "a", "lag": 1, "when": "set"}
    yield sw.Reaches, {"name": "a", "above": 1.0, "component": 0}
    for soft in (sw.Scale, sw.Shift):
        yield soft, {"by": 2.0, "at": 3, "shared": None, "below": None}
    yield V.Affine, {"parent": "a", "index": 0, "scale": 1.0, "offset": 0.0}
    yield V.Bernoulli, {"p": 0.5}
    yield V.Categories, {"members": (1, 2), "labels": ("one", "two")}
    yield V.Concatenation, {"shapes": ((2,), ())}
    yield V.Continuous, {"family": "gamma", "a": 2.0}
    yield V.Cylinder, {"box": sw.Box((-1, -1, -1), (1, 1, 1))}
    yield V.Discrete, {"values": (0.0, 1.0), "probabilities": (0.5, 0.5)}
    yield V.Either, {"first": sw.Box(0, 1), "second": sw.Box(2, 3)}
    yield V.Function, {"function": abs, "constants": {"a": 1.0}}
    yield V.Integers, {"low": 0, "high": 3}
    yield V.Noise, {"seed": 0}
    yield V.Normal, {"mean": 0.0, "std": 1.0}
    yield V.Rotations, {"keeps_sign": True}
    yield V.Subset, {"parts": (("a", "A"),)}
    yield V.Switch, {"parent": "a", "below": 0.0, "above": 1.0, "at": 0.5}
    yield V.Table, {"probabilities": [0.5, 0.5], "shape": (2,), "given": (), "values": (0, 1)}
    for when in (time, {"during": (2, 4)}, {"every": 2}, {"when": sw.Contact("a", "b")}):
        yield V.Time, when
    yield V.Variable, one
    yield V.bundle, {"name": "p", "parts": [model.declared("a")], "unit": "m"}
    yield V.names, {"parents": (sw.Parent("a"),)}
    # Models and graphs.
    for kind in (sw.SCM, graph.SCM):
        yield kind, {"variables": [model.declared("a"), model.declared("y")]}
    yield graph.Edge, {"cause": "a", "effect": "y", "lag": 0, "when": None}
    yield graph.episode_outcome, {
        "model": model, "outcomes": ["y"], "starts": ["a"], "contact": True, "without": []
    }  # fmt: skip
    yield graph.flatten, {"request": {"a": 1.0}, "twice": []}
    yield graph.from_json, {"text": graph.to_json(model), "trusted": ()}
    yield graph.to_dag, {"source": model}
    yield graph.to_digraph, {"source": model, "strength": {}, "at_least": 0.0}
    yield graph.to_json, {"model": model}
    yield graph.unrolled, {"source": model, "steps": 2}
    # Questions.
    setting = {"policy": "random", "nature": {"floor_friction": "A"}, "steps": 2, "seed": 0}
    yield sw.Laboratory, {
        "world": world, "allow": ("see",), "visible": ("*",), "settable": ("*",), "budget": 3,
        "outcomes": ["reward"], "workers": 1, **setting,
    }  # fmt: skip
    yield queries.Setting, {**setting, "workers": 1}
    yield queries.Random, {"share": 1.0, "every": 1}
    yield sw.Outcome, {"name": "y", "how": "final", "component": None}
    yield sw.Plan, {"request": {"a": 1.0}}
    yield sw.do, {"request": {"a": 1.0}}
    own = {"probes": 1, "seed": 0, "progress": None, "found": None}
    yield sw.verify, {"system": model, "held_out": 1, **own}
    many = sw.World("pushing", backend="fake", num_worlds=2)
    ranges = {"tool_block.mass": (0.02, 0.04)}
    asked = {"by": "set", "steps": 1, "resets": 4, "seed": 0, "progress": None}
    yield sw.check, {"envs": many, "ranges": ranges, **asked}
    checked = sw.check(many, ranges, steps=1)
    yield type(checked), {name: getattr(checked, name) for name in type(checked).model_fields}
    yield discovery.discover, {"system": model, "at_least": 0.0, "checkpoint": None, **own}
    yield queries.but_for, {
        "episode": episode, "outcome": lambda e: True, "over": {"a": 0.0}, "at": 0, "most": 1,
        "workers": 1,
    }  # fmt: skip
    yield queries.compare, {"one": episode, "other": episode, "names": ["a"], "tolerance": 0.0}
    yield queries.consequences, {
        "system": model, "request": {"a": 1.0}, "steps": 0, "seed": 0, "space": None
    }  # fmt: skip
    yield queries.consequences, {
        "system": world, "request": {"floor_friction": 0.5}, "steps": 1, "seed": 0, "space": "A"
    }  # fmt: skip
    found = queries.identify(model, "a", "y")
    yield queries.identify, {
        "graph": model, "treatment": "a", "outcome": "y", "observed": ["a", "y"], "frontdoor": True
    }  # fmt: skip
    yield (
        queries.estimate,
        {
            "found": found,
            "table": model.sample(30, seed=0).frame(),
            "do": 1.0,
            "versus": 0.0,
            "method": None,
        },
    )
    yield queries.load_episode, {"path": path, "world": model, "trusted": ()}
    yield queries.save_episode, {"episode": episode, "path": folder / "again.npz"}
    yield queries.nature_graph, {
        "model": model, "nature": {"a": "A"}, "outcomes": ["y"], "contact": True, "without": ()
    }  # fmt: skip
    yield queries.Comparison, {
        "task": "own", "backends": ("fake", "step"), "seed": 0, "probes": 1, "skipped": 0,
        "lost": 0, "effects": (), "gaps": (), "one_sided": (), "seconds": 1.0,
    }  # fmt: skip
    yield discovery.BenchmarkResult, {"problems": {}, "runs": (), "settings": {}}
    yield models.State, {"layout": scene.state.layout, "vector": None}
    for report in (sw.verify(model, probes=1, held_out=0), discovery.discover(model, probes=1)):
        yield type(report), {name: getattr(report, name) for name in type(report).model_fields}
    # Worlds.
    made = {"backend": "fake", "preset": "fast", "action_mode": "joint_positions"}
    made |= {"resolution": "vector", "frame_skip": 1, "max_episode_length": 2}
    made |= {"conventions": "scm_world", "variables_space": "A", "tool_block_position": (0, 0)}

    yield Simulation, {"task": "pushing", **made}
    yield sw.World, {"task": "pushing", "num_worlds": 1, **made}
    yield Audit, {"report": tuple}
    yield variables.Intervention, {"kind": "own", "at": 2}
    yield variables.Soft, {"kind": "own", "at": 2}
    yield Audits, {"audits": {}, "refused": {}}
    yield Batch, {"worlds": [scene], "threads": 1, "names": ()}
    yield CompiledModel, {"model": sw.SCM([])}
    compiled = CompiledModel(sw.SCM([]))
    yield Equations, {"compiled": compiled, "count": 2, "vectorised": True}
    yield EquationBatch, {"one": Equations(compiled), "num_worlds": 2}
    rows = {"time": 0.02 * np.arange(12.0), "ball.cartesian_position": np.zeros((12, 3))}
    fitted = {"world": scene, "recording": rows, "noise": None, "window": None, "progress": None}
    fitted["search"] = inspect.signature(fit.fit).parameters["search"].default
    yield fit.fit, {**fitted, "parameters": ["ball.mass"]}
    yield fit.explain, {**fitted, "candidates": ["ball.mass"], "most": 1}
    yield local_graph, {"world": world, "action": None}
    yield check_model, {"source": "none.xml", "backend": "mujoco", "steps": 1, "control_dt": 0.1}
    # Environments.
    options: dict[str, Any] = {
        "task": "pushing", "task_options": {}, "backend": "fake", "preset": "fast",
        "frame_skip": 1, "action_mode": "joint_positions", "resolution": "vector",
        "delta_scale": 1.0, "delta_origin": "command", "normalize_actions": True,
        "observation_mode": "structured", "observe": (), "include": (), "context": "none",
        "keypoints": False, "pad": None, "cameras": None, "image_size": None,
        "stack_images": False, "normalize_observations": True, "goal_env": False, "start": None,
        "history": 1, "stack_history": False,
        "random_goal": None, "variables_space": None, "max_episode_length": 2,
        "max_episode_steps": None, "on_failure": "raise", "conventions": "scm_world",
        "render_mode": None, "render_camera": None, "render_size": None,
    }  # fmt: skip
    yield sw.ScmWorldEnv, options

    vector = {"num_envs": 1, "autoreset_mode": "NextStep", "copy": True, "threads": 1}
    yield environments.ScmWorldVectorEnv, {**vector, "member": sw.ScmWorldEnv, "backend": "fake"}
    yield (
        environments.make_env,
        {"model": BALL, "control_dt": 0.02, "reward": (np.sum, "ball.orientation")},
    )
    yield environments.vector_env, {
        "model": None, "workers": 1, **vector, "member": sw.ScmWorldEnv, "backend": "fake"
    }  # fmt: skip
    # Curricula.
    yield curricula.CurriculumEnv, {"env": env, "curriculum": part}
    yield curricula.LevelsEnv, {"env": env, "levels": 2, "level_seed": 0}
    yield curricula.CurriculumState, {"episode": 0, "stages": {}, "noise": (0, 0), "every": 1}
    yield curricula.Progress, {"level": 0, "recent": (True,)}
    yield curricula.at_step, {"step": 3, "part": part}
    yield curricula.during, {"episodes": range(3), "part": part}
    for some in (curricula.everything, curricula.joints, curricula.looks):
        yield some, {"space": "A"}
    for some in (curricula.physics, curricula.poses):
        yield some, {"space": "A"}
    yield curricula.follow, {"function": abs}
    yield curricula.goals, {"space": "A", "besides": ("a",)}
    yield curricula.resample, {"what": ("a",), "space": "A", "besides": ("b",)}
    yield curricula.stages, {"of": (part, part), "up": 0.8, "down": 0.2, "window": 3}
    yield curricula.timed, {"time": V.Time(at=3), "part": part}
    yield curricula.together, {"of": (part,)}
    yield curricula.make_vec, {
        "env_id": "scm_world/Pushing-v0", "num_envs": 1, "curriculum": part,
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP, "backend": "fake",
        "levels": None, "level_seed": 0,
    }  # fmt: skip
    # Discovery and data.
    store = {"out": None, "shard": None, "progress": None, "workers": 1, "engine": None}
    design = data.Design()
    yield discovery.Design, {
        "name": "single", "targets": ("a",), "values": "A", "observational_fraction": 0.3
    }  # fmt: skip
    yield discovery.Levels, {"space": "A", "count": 5}
    yield discovery.TaskView, {
        "view": "outcome", "causes": None, "outcomes": None, "policy": None, "steps": 2,
        "sensor_noise": 0.0, "contacts": False, "options": {}, "arguments": {},
    }  # fmt: skip
    yield discovery.Learner, {
        "name": "mine", "learn": abs, "takes": ("observational",), "temporal": False, "extra": "",
        "package": "", "doc": "", "baseline": False, "marked": False,
    }  # fmt: skip
    yield discovery.collect, {"source": model, "design": design, "n": 2, "seed": 0, **store}
    yield data.collect_parts, {"source": model, "design": design, "n": 2, "seed": 0, **store}
    yield (
        discovery.sweep,
        {"system": model, "over": {"a": [0.0]}, "outcomes": ["y"], "n": 2, **store},
    )
    del store["shard"]
    yield discovery.benchmark, {
        "learners": ["empty"], "problems": [model], "budgets": (20,), "seeds": 1, "data": (),
        "view": None, "timeout": None, "standardised": True, **store,
    }  # fmt: skip
    yield discovery.evaluate, {
        "found": [("a", "y", 0)], "declared": model, "names": ["a", "y"], "pairs": None,
        "marks": False,
    }  # fmt: skip
    yield (
        discovery.learn,
        {"given": "do_order", "data": table, "seed": 0, "shuffle": True, "q": 0.1},
    )
    yield discovery.problem, {"name": model, "seed": 0, "view": None}
    yield discovery.register, {"learner": learners.learners()["empty"]}
    yield data.Pictures, {"cameras": (None,), "size": (8, 8), "goals": False}
    yield data.Regime, {"plan": sw.Plan(), "targets": ()}
    for convert in (data.as_causal_learn, data.as_frame, data.as_gies, data.as_tigramite):
        yield convert, {"dataset": table}
    yield data.as_dcdi, {"dataset": table, "folder": folder / "dcdi", "number": 1}
    yield data.as_huggingface, {"folder": saved, "name": "table"}
    for read in (data.batches, data.load):
        yield read, {"folder": saved, "trusted": (), "partial": False}
    yield data.default_causes, {"world": model}
    yield data.default_outcomes, {"world": world, "every_step": False}
    yield data.from_frame, {"frame": frame, "trusted": ()}
    yield data.save, {"dataset": table, "folder": folder / "new", "shard": 5}
    yield data.triplets, {
        "world": world, "factors": ["tool_block.mass"], "n": 1, "out": folder / "triplets",
        "cameras": (None,), "size": (8, 8), "targets": 1, "steps": 0, "seed": 0, "shard": 1,
        "workers": 1, "engine": None, "progress": None,
    }  # fmt: skip
    yield learners.learner, {"name": "empty"}
    numbers = np.random.default_rng(0).normal(size=(8, 2))
    for score in (representations.mcc, representations.r2):
        yield score, {"codes": numbers, "factors": numbers}
    yield representations.dci, {"codes": numbers, "factors": numbers, "trees": 2, "seed": 0}
    yield problems.problem, {"name": "er2:4", "seed": 0, "view": None}
    yield families.random_model, {"name": "er2:4", "seed": 0}
    graphs = discovery.EstimatedGraph.of_edges(["a", "y"], [("a", "y", 0)])
    row = models.Parameter("p", "1", (), np.zeros(()), np.zeros(()), np.ones(()), "")
    for made_once in (table, graphs, table.truth, row):
        names = (field.name for field in dataclasses.fields(made_once) if field.init)
        yield type(made_once), {name: getattr(made_once, name) for name in names}
    # Evaluation.
    yield evaluation.Interval, {"value": 0.5, "low": 0.0, "high": 1.0, "level": 0.95, "n": 3}
    yield evaluation.Protocol, {
        "name": "P", "varies": ("*.mass",), "space": "A", "step": 0, "act": None, "doc": ""
    }  # fmt: skip
    yield evaluation.Recorder, {"env": env, "infos": None}
    rest = {"backend": "fake", "env": {"max_episode_length": 1}, "out": None, "trusted": None}
    yield evaluation.evaluate, {
        "policy": "random", "protocols": ["P0"], "task": "pushing", "n": 1, "seeds": 0, **rest,
        "workers": 1, "engine": None, "progress": None, "repeats": None, "steps": False,
    }  # fmt: skip
    yield evaluation.Adaptive, {
        "policy": "random", "parameters": "mass", "measures": {"x": 0.1}, "after": 5,
        "every": None, "iterations": 2, "last": None, "use": "mean", "keeps": False,
    }  # fmt: skip
    yield evaluation.in_world, {"policy": "random", "world": world}
    yield evaluation.inferred, {
        "policy": "still", "variables": "tool_block.mass", "task": "pushing", "steps": [0],
        "at": 0, "after": 0, "privileged": None, "n": 1, "seed": 0, **rest, "workers": 1,
        "engine": None, "progress": None,
    }  # fmt: skip
    yield evaluation.play, {
        "env": env, "agent": agent, "plan": None, "hooks": (), "seed": 0, "episode": None,
        "draws": None,
    }  # fmt: skip
    yield evaluation.protocols_of, {"task": "pushing", "backend": "fake"}
    yield evaluation.record, {
        "policy": "random", "env": env, "n": 1, "seed": 0, "first": 0, "do": None, "infos": None,
        "noise": 0.0, "labels": None, "out": None,
    }  # fmt: skip
    judged = evaluation.evaluate("random", ["P1"], task="pushing", n=1, **rest)
    yield evaluation.why, {
        "evaluation": judged, "protocol": "P1", "episode": 0, "metric": None, "versus": "A",
        "policy": None, "task": None, "trusted": (), "progress": None,
    }  # fmt: skip
    # Laboratories.
    asked_for = build_question("effect", "equations", 0, "L2", lab.Knobs(), 0, None)
    yield lab.Knobs, dataclasses.asdict(lab.Knobs())
    yield lab.Laboratory, {"question": asked_for}
    yield lab.LabEnv, {
        "kind": "effect", "world": "equations", "level": "L2", "seeds": 1, "first": 0,
        "experiments": 8, "n": 10,
    }  # fmt: skip
    yield lab.certify, {"question": asked_for}
    yield lab.offers, {"kind": "effect"}
    yield lab.play, {"agent": "random", "question": asked_for}
    yield lab.question, {
        "kind": "effect", "world": "equations", "seed": 0, "level": "L2", "key": None,
        "noise": 0.02,
    }  # fmt: skip
    yield lab.replay, {"path": lab.play("random", asked_for).save(folder / "run.json"), "key": None}
    yield lab.scores, {"runs": [lab.play("random", asked_for)]}
    yield lab.suite, {"name": "physics-1"}
    # Policies.
    layer = policies.Layer(np.zeros((56, 9), np.float32), np.zeros(9, np.float32))
    about = policies.PolicyAbout(task="pushing")
    yield policies.Layer, {"weight": layer.weight, "bias": layer.bias}
    yield policies.MlpPolicy, {"layers": (layer,), "log_std": None, "value": (), "made_for": None}
    yield policies.PolicyAbout, {
        "task": "pushing", "env": {}, "activation": "tanh", "output": "clip", "inputs": None,
        "memory": 0, "card": {},
    }  # fmt: skip
    yield policies.WorldPolicy, {"policy": abs}
    yield policies.Agent, {"about": {"name": "a"}, "begin": abs, "policy": None, "card": None}
    yield policies.agent_from, {"about": agent.about, "trusted": ()}
    yield policies.as_agent, {"policy": "random", "trusted": None, "env": None}
    network = policies.MlpPolicy((layer,))
    kept = policies.save_policy(folder / "policy.safetensors", network, about)
    yield policies.file_of, {"policy": kept}
    yield policies.load_policy, {"path": kept}
    yield policies.load_sb2, {"path": folder / "none.zip"}
    yield (
        policies.save_policy,
        {"path": folder / "b.safetensors", "network": network, "about": about},
    )
    yield planning.CrossEntropy, {
        "objective": None, "terminal": None, "every": 2, "do": None, "backend": None,
        "foresees": False, "seed": 0, "threads": 1, "samples": 4,
    }  # fmt: skip
    yield planning.PlanningModel, {
        "world": scene, "n": 1, "names": ["ball.cartesian_position"], "backend": None, "do": None,
        "foresees": False, "threads": 1,
    }  # fmt: skip
    yield planning.Score, {"names": ("a",), "function": abs, "sums": False}
    yield planning.Search, {
        "samples": 4, "horizon": 3, "iterations": 1, "elites": None, "spread": 0.1, "color": 3.0,
        "momentum": 0.1,
    }  # fmt: skip
    yield planning.action_range, {"world": world}
    yield planning.nearness, {"task": sw.make_task("pushing")}
    # Tasks, models and engines.
    yield sw.make_task, {"source": "pushing", "tool_block_mass": 0.02}
    yield tasks.read_source, {"source": "pushing", "options": {}}
    yield sw.ModelTask, {
        "model": BALL, "control_dt": 0.02, "seconds": 1.0, "start": None, "reward": None,
        "success": None, "terminated": None, "outcomes": (), "observe": None, "goal": None,
        "expose": None, "spaces": None, "ties": None, "name": "ball",
    }  # fmt: skip
    yield tasks.EquationTask, {
        "model": sw.SCM([sw.Action(name="u", bounds=sw.Box(-1, 1))]), "actions": (),
        "reward": "u", "success": None, "terminated": None, "outcomes": (), "observe": None,
        "goal": None, "name": "own",
    }  # fmt: skip
    state = sw.Measured(name="x", default=0.0, parents=("u",))
    yield sw.StepTask, {
        "step": _step, "name": "own", "parameters": (), "states": (state,),
        "actions": (sw.Action(name="u", bounds=sw.Box(-1, 1)),), "control_dt": 0.1, "noise": {},
        "outcomes": (), "seconds": 1.0, "vectorized": False, "signature": "dicts", "start": None,
        "reward": None, "success": None, "terminated": None, "observe": None, "goal": None,
    }  # fmt: skip
    for task in tasks.TASKS.values():
        yield (
            task,
            {
                name: parameter.default
                for name, parameter in inspect.signature(task).parameters.items()
                if parameter.kind is parameter.KEYWORD_ONLY
            },
        )
    yield families.servo, {"n": 5, "seed": 0, "hidden": 0}
    yield families.Springs, {"n": 5, "seed": 0}
    yield tasks.register, {"kind": sw.ModelTask}
    yield tasks.term, {"name": "near", "function": abs, "parents": ("a",), "doc": ""}
    yield tasks.Options, dataclasses.asdict(world.options)
    yield tasks.Goal, {"achieved": (), "desired": (), "causes": ()}
    yield tasks.Observation, {"rows": (), "saturates": False}
    yield tasks.Observed, {"variable": "a", "low": 0.0, "high": 1.0}
    yield tasks.Conventions, {"name": "own", "published": False}

    yield backends.make_backend, {"name": "fake"}
    yield backends.read_model, {"source": BALL}
    yield backends.register, {"kind": backends.BackendWrapper}
    yield backends.BackendWrapper, {"engine": backends.make_backend("fake")}
    yield backends.SeparateScenes, {"backends": (backends.make_backend("fake"),), "threads": 1}
    yield sw.load_hull, {"path": folder / "none.obj", "scale": 1.0}


class _TooSlow(BaseException):
    """A call that went on for too long."""


@contextmanager
def _limited() -> Iterator[None]:
    """End what takes longer than the limit."""

    def ended(*_: Any) -> None:
        raise _TooSlow

    before = signal.signal(signal.SIGPROF, ended)
    signal.setitimer(signal.ITIMER_PROF, LIMIT)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def _fault(function: Callable[..., Any], given: dict[str, Any]) -> str:
    """Call a function; return its error in words, unless it is one of this package's."""
    try:
        with _limited():
            made = function(*given.pop("*", ()), **given)
            if hasattr(made, "close"):
                made.close()
    except (ScmWorldError, DeprecationWarning):
        return ""
    except _TooSlow:
        return "does not end"
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:80]} ({where.filename}:{where.lineno})"
    return ""


def _only_keeps(one: Any) -> bool:
    """Return whether nothing can go wrong: aliases, base classes, results, calls without arguments.

    Constructors of results and rows that the package makes keep what they are given.
    """
    if one is Any or not (inspect.isclass(one) or inspect.isfunction(one)):
        return True
    if inspect.isclass(one):
        keeps = dataclasses.is_dataclass(one) or issubclass(one, tuple)
        is_form = typing.is_typeddict(one) or getattr(one, "_is_protocol", False)
        if issubclass(one, ScmWorldError) or inspect.isabstract(one) or is_form:
            return True
        return (keeps and not hasattr(one, "__post_init__")) or not inspect.signature(
            one
        ).parameters
    return not inspect.signature(one).parameters


@pytest.mark.usefixtures("in_this_process")
def test_wrong_arguments_end_in_typed_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each call with one wrong argument ends, in a result or one of our errors."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")  # a text may be the name of a file to write
    faults, called = [], set()
    for function, given in _calls(tmp_path):
        called.add(id(function))
        for name in given:
            for label, wrong in WRONG.items():
                more = {} if (name, label) in VALID else {name: wrong}
                if fault := _fault(function, {**given, **more}):
                    faults.append(f"{function}({name}={label}): {fault}")
    assert not faults
    documented = {name: one for name, one in _documented().items() if id(one) not in called}
    left = [name for name, one in documented.items() if not _only_keeps(one)]
    assert not left, ", ".join(left)


def test_errors_of_user_code_pass_through_constructors() -> None:
    """What a user's iterator or array raises is not taken for a wrong argument."""

    def pairs() -> Iterator[Any]:
        yield "a", "A"
        raise ValueError("a fault of mine")

    for make in (partial(sw.Mechanism, abs), variables.Subset):
        with pytest.raises(ValueError, match="a fault of mine") as caught:
            make(pairs())
        assert not isinstance(caught.value, ScmWorldError)
    with pytest.raises(ModelError, match="not iterable"):
        variables.Subset(3)
