"""What Gymnasium's registry makes: one environment or many, of a task or of any model."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from scm_world._arguments import true_or_false, typed, whole_number
from scm_world.env.batch import ScmWorldVectorEnv, mode_of
from scm_world.env.environment import ENV_OPTIONS, ScmWorldEnv
from scm_world.errors import UnknownOption
from scm_world.graph import flatten
from scm_world.runs.processes import cores, single_threaded
from scm_world.tasks import AnySource, EquationTask, ModelTask, StepTask, Task, make_task
from scm_world.tasks.model import DeclaredTask
from scm_world.tasks.sources import is_causal, is_model, is_step, load_named
from scm_world.variables import Intervention
from scm_world.world import CausalSystem

MODEL_ID = "scm_world/Model-v0"


def make_env(model: AnySource = None, **options: object) -> ScmWorldEnv:
    """Make an environment of a task or of a model.

    Args:
        model: A path to an MJCF or URDF file, XML text, an ``MjSpec``, an ``MjModel`` or a
            ``Model``; a causal model without an engine: an ``SCM``, its file, a world of its
            equations or ``"er2:20"``; or a task: itself, its class, a function that gives it, or
            its name, such as ``"module:function"``. If None, the task is among the options.
        options: Of ``ScmWorldEnv`` and, with a model, of ``ModelTask`` (``reward``,
            ``terminated``, ``spaces``, ``seconds``, …) or of ``EquationTask`` (``actions``,
            ``reward``, …), as far as the task is not made yet.
            ``start``, ``frame_skip`` and ``observe`` are options of both. With a model they
            are those of ``ModelTask``, ``observe`` except with ``observation_mode="custom"``;
            interventions in ``start`` are done at every reset, as in other environments. With a
            task they are those of ``ScmWorldEnv``, and add to what the task has itself; its states
            and parameters may begin with a space or distribution to draw from, too.
            With ``task_options``, a dictionary of all options of the model, the others are those
            of ``ScmWorldEnv``.

    Raises:
        UnknownOption: An option exists in neither, or the task is made already.
        ModelError: The model cannot be read, or it has no reward.

    Example:
        >>> import gymnasium
        >>> import numpy as np
        >>> pendulum = '''<mujoco><worldbody><body name="pole"><joint name="hinge" damping="0.1"/>
        ...   <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.05"/></body></worldbody>
        ...   <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>'''
        >>> env = gymnasium.make(MODEL_ID, model=pendulum, reward=(np.cos, "hinge.position"))
        >>> env.reset(seed=0)[0]
        array([0., 0.], dtype=float32)
        >>> env.step(env.action_space.high)[1] < 1.0
        True
    """
    return ScmWorldEnv(**_of_env(model, options))


@typed
def vector_env(
    num_envs: int = 1,
    model: AnySource = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    copy: bool = True,
    workers: int | None = None,
    threads: int | None = None,
    member: Callable[..., Any] = ScmWorldEnv,
    **options: object,
) -> ScmWorldVectorEnv | AsyncVectorEnv:
    """Make many environments, the fastest way that there is.

    Args:
        num_envs: How many.
        model: As in ``make_env``.
        autoreset_mode: As in ``ScmWorldVectorEnv``, like the next one.
        copy: Likewise.
        workers: How many are simulated at the same time, each in a process of its own, which
            Gymnasium's ``AsyncVectorEnv`` runs; 1: a ``ScmWorldVectorEnv`` in this process. As many
            as there are cores for Bullet if None, else 1; a process of a pool starts none.
        threads: As in ``ScmWorldVectorEnv``.
        member: Likewise.
        options: Of ``make_env``.

    Example:
        >>> envs = vector_env(3, task="pushing", backend="fake")
        >>> observations, infos = envs.reset(seed=0)
        >>> print(envs.do({1: {"floor_friction": 0.4}})[1])
        floor_friction = 0.4, engine reports 0.4
        >>> envs.step(envs.action_space.sample())[0].shape
        (3, 56)
        >>> envs.close()
    """
    found = _of_env(model, options, ("autoreset_mode", "copy", "workers", "threads", "member"))
    count = whole_number("num_envs", num_envs, least=1)
    how: dict[str, Any] = {"copy": true_or_false("copy", copy)}
    how["autoreset_mode"] = mode_of(autoreset_mode)
    if workers is None:
        backend = found.get("backend")
        if backend is None:
            backend = getattr(found.get("task"), "backend", Task.backend)
        is_single = str(backend) != "bullet" or multiprocessing.current_process().daemon
        workers = 1 if is_single or threads is not None else cores()
    if min(whole_number("workers", workers, least=1), count) == 1:
        return ScmWorldVectorEnv(count, threads=threads, member=member, **how, **found)
    if threads is not None:
        raise UnknownOption("threads", threads, ("None with workers", "any with workers=1"))
    # A server that has imported this package starts processes quickest.
    kinds = multiprocessing.get_all_start_methods()
    how["context"] = "forkserver" if "forkserver" in kinds else "spawn"
    if "forkserver" in kinds:
        multiprocessing.get_context("forkserver").set_forkserver_preload([__name__])
    with single_threaded(here=False):
        return AsyncVectorEnv([partial(member, **found)] * count, max_concurrency=workers, **how)


def _of_env(
    model: AnySource, options: Mapping[str, Any], others: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return the options of an environment, of a model with the task that is made of it."""
    given = options.get("task_options")
    is_of_file = isinstance(model, str) and ".py:" in model
    function = load_named(model, "task") if is_of_file else model
    kind: type[DeclaredTask] = StepTask if is_step(function, options) else ModelTask
    if kind is ModelTask and is_causal(function):
        kind = EquationTask
    own = [] if model is None or given is not None else [*kind.options()]
    is_name = isinstance(model, str) and not is_model(model) and kind is ModelTask
    is_world = isinstance(model, CausalSystem) and kind is ModelTask
    if is_name or isinstance(model, Task) or is_world or (callable(model) and kind is ModelTask):
        own = [name for name in own if name not in ENV_OPTIONS]
        if options.get("observe"):
            options = {"observation_mode": "custom", **options}
    elif options.get("observation_mode") == "custom" and "observe" in own:
        own.remove("observe")
    found = {name: value for name, value in options.items() if name not in own}
    for name in found:
        if name not in ENV_OPTIONS:
            raise UnknownOption("option of the environment", name, (*own, *ENV_OPTIONS, *others))
    if model is None:
        return found
    if found.get("task") is not None:
        raise UnknownOption("task beside a model", found["task"], ("left out",))
    of_task = {name: options[name] for name in own if name in options}
    if isinstance(of_task.get("start"), Mapping):
        start = flatten(of_task["start"])
        acts = {name: act for name, act in start.items() if isinstance(act, str | Intervention)}
        of_task["start"] = {name: value for name, value in start.items() if name not in acts}
        found["start"] = acts or None
    return {**found, "task": make_task(model, **(given or of_task)), "task_options": None}
