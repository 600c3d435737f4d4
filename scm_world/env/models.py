"""What Gymnasium's registry makes: many environments, and those of any model or custom task."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import Any

from scm_world._arguments import whole_number
from scm_world.env.arguments import refuse_unknown
from scm_world.env.environment import ScmWorldEnv
from scm_world.env.many import ScmWorldVectorEnv
from scm_world.env.native import NativeVectorEnv
from scm_world.env.processes import ProcessVectorEnv
from scm_world.errors import UnknownOption
from scm_world.tasks import ModelTask, Task
from scm_world.work.processes import cores
from scm_world.world.structures import as_task

MODEL_ID = "scm_world/Model-v0"

OF_TASK = ModelTask.options()
"""Options of a model; where the environment has one of the same name, the model's is meant."""

OF_ENV = tuple(name for name in signature(ScmWorldEnv).parameters if name != "task")

OF_VECTOR = ("workers", *(n for n in signature(NativeVectorEnv).parameters if n != "num_envs"))


def vector_env(
    num_envs: int = 1,
    *,
    workers: int | None = None,
    threads: int | None = None,
    member: Callable[..., Any] = ScmWorldEnv,
    **options: Any,
) -> ScmWorldVectorEnv:
    """Make many environments, the fastest way that there is.

    Args:
        num_envs: How many.
        workers: How many are simulated at the same time, each in a process of its own; 1: all in
            this process. As many as there are cores for Bullet if None, else 1; a process of a
            pool starts none.
        threads: Of a backend that steps many worlds in one call; as many as there are cores if
            None.
        member: Makes one of them from the options.
        options: Of ``ScmWorldVectorEnv`` and ``ScmWorldEnv``.

    Raises:
        UnknownOption: An option does not exist, or does not go with the others.

    Example:
        >>> envs = vector_env(3, task="pushing", backend="fake")
        >>> observations, infos = envs.reset(seed=0)
        >>> print(envs.do({1: {"floor_friction": 0.4}})[1])
        floor_friction = 0.4, engine reports 0.4
        >>> envs.step(envs.action_space.sample())[0].shape
        (3, 56)
        >>> envs.close()
    """
    if member is ScmWorldEnv:
        refuse_unknown(options, ScmWorldEnv, NativeVectorEnv, vector_env)
    count = whole_number("num_envs", num_envs, least=1)
    backend = options.get("backend") or getattr(options.get("task"), "backend", Task.backend)
    if workers is None:
        is_single = backend != "bullet" or multiprocessing.current_process().daemon
        workers = 1 if is_single or threads is not None else cores()
    if min(whole_number("workers", workers, least=1), count) == 1:
        return NativeVectorEnv(count, threads=threads, member=member, **options)
    if threads is not None:
        raise UnknownOption("threads", threads, ("None with workers", "any with workers=1"))
    return ProcessVectorEnv(count, workers=workers, member=member, **options)


def model_env(model: Any = None, **options: Any) -> ScmWorldEnv:
    """Make an environment of a model.

    Args:
        model: A path to an MJCF or URDF file, XML text, an ``MjSpec``, an ``MjModel``, a
            ``Model``, ``"module:function"`` for a function that gives a task, or a task.
        options: Of ``ModelTask`` (``reward``, ``terminated``, ``spaces``, ``seconds``, …) and of
            ``ScmWorldEnv``. ``start`` and ``frame_skip`` are those of ``ModelTask``, and
            ``observe`` is, except with ``observation_mode="custom"``. With ``task_options``, a
            dictionary of all options of the model, the others are those of ``ScmWorldEnv``.

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
    task, of_env = _split(model, options)
    return ScmWorldEnv(task, **of_env)


def model_vector_env(num_envs: int = 1, model: Any = None, **options: Any) -> ScmWorldVectorEnv:
    """Make many environments of a model, stepped in one call where the backend can.

    Args:
        num_envs: How many.
        model: As in ``model_env``.
        options: As in ``model_env``, and those of ``vector_env``.

    Raises:
        UnknownOption: As in ``model_env``.
        ModelError: Likewise.
    """
    of_vector = {name: options.pop(name) for name in OF_VECTOR if name in options}
    task, of_env = _split(model, options, OF_VECTOR)
    return vector_env(num_envs, task=task, **of_vector, **of_env)


def _split(
    model: Any, options: Mapping[str, Any], besides: Sequence[str] = ()
) -> tuple[Task, dict[str, Any]]:
    """Make the task, and give the options that are left for the environment."""
    given = options.get("task_options")
    shared = ("observe",) if options.get("observation_mode") == "custom" else ()
    mixed = [name for name in options if name in OF_TASK and name not in shared]
    of_task = {name: options[name] for name in mixed} if given is None else dict(given)
    apart = ("task_options", *(mixed if given is None else ()))
    of_env = {name: value for name, value in options.items() if name not in apart}
    for name in of_env:
        if name not in OF_ENV:
            raise UnknownOption(f"option of {MODEL_ID}", name, (*OF_TASK, *OF_ENV, *besides))
    return as_task(model, of_task), of_env
