"""Facts about episodes that are played side by side: their rows are those of one by one."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from evaluation_samples import Waning, contents, linear

from scm_world.errors import EvaluationError
from scm_world.evaluation import Protocol, WorldPolicy, evaluate
from scm_world.evaluation import pipeline as pipelines
from scm_world.evaluation.episodes import EpisodeRow
from scm_world.evaluation.lockstep import Lockstep
from scm_world.evaluation.pipeline import ShardRunner
from scm_world.evaluation.setups import prepare
from scm_world.policies import Layer, MlpPolicy

WITHIN = Protocol("late", act={"tool_block.cartesian_position": [0.2, 0.2, 0.0325]}).at(3)
"""Refused in the fourth control step: the block would be outside of the runner."""


class Found(NamedTuple):
    """What a policy and some protocols gave, and whether several episodes went on at once."""

    rows: list[EpisodeRow]
    together: bool


def found(policy: Any, protocols: Any, threads: int, n: int = 3, **env: Any) -> Found:
    """Play all shards with so many threads of the engine."""
    task = env.pop("task", "pushing")
    env = {"max_episode_length": 6, **env}
    setup = prepare(
        {"a": policy}, protocols, task=task, n=n, seeds=2, backend="mujoco", env=env, trusted=None
    )
    shard_runner = ShardRunner(setup, threads)
    rows = [row for shard in setup.shards() for row in shard_runner(shard)]
    executors = [lockstep._executor is not None for lockstep in shard_runner.locksteps.values()]
    shard_runner.close()
    return Found(rows, any(executors))


class Cell:
    """A model that remembers as Stable-Baselines3 wants it: it is told what it knew."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, **how: Any
    ) -> Any:
        """Mix what is seen with what was seen."""
        last = np.zeros(9, np.float32) if episode_start[0] else state
        state = np.tanh(0.5 * last + linear(observation)).astype(np.float32)
        return state.copy(), state


class Reused:
    """A function that gives one array again and again, and spoils what it is shown."""

    def __init__(self) -> None:
        self.action = np.zeros(9)

    def __call__(self, observation: Any) -> Any:
        """Write into both."""
        self.action[:] = linear(observation)
        observation[:] = np.nan
        return self.action


def network(folder: Path) -> Any:
    """Write a network of one layer."""
    onnx = pytest.importorskip("onnx")
    if importlib.util.find_spec("onnxruntime") is None:
        pytest.skip("onnxruntime is not installed")
    weight = np.random.default_rng(1).normal(size=(56, 9)).astype(np.float32)
    helper, numbers = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "w"], ["y"]), helper.make_node("Tanh", ["y"], ["z"])],
        "policy",
        [helper.make_tensor_value_info("x", numbers, [None, 56])],
        [helper.make_tensor_value_info("z", numbers, [None, 9])],
        [onnx.numpy_helper.from_array(weight, "w")],
    )
    opset = [helper.make_opsetid("", 13)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    onnx.save(model, folder / "policy.onnx")
    return folder / "policy.onnx"


def small_mlp() -> Any:
    """Give a network of this package."""
    draw = np.random.default_rng(0).normal(size=(56, 9)).astype(np.float32)
    return MlpPolicy((Layer(draw, np.zeros(9, np.float32)),))


@pytest.mark.parametrize("protocols", [None, "P2@3,P9@1"], ids=["published", "within"])
def test_every_protocol_gives_the_same_rows(protocols: Any) -> None:
    """Scores, draws and hashes, at the reset and within the episode, bit for bit."""
    alone, both = (found(small_mlp(), protocols, threads) for threads in (1, 2))
    assert both.rows == alone.rows
    assert (alone.together, both.together) == (False, True)


@pytest.mark.parametrize(
    ("policy", "together"),
    [
        (linear, False),
        (small_mlp(), True),
        (Cell(), False),
        (np.linspace(-1, 1, 54).reshape(6, 9), True),
        (np.zeros(9, np.float32), True),
        (Reused(), False),
        (Waning("nan", 99), False),
        ("random", False),
        (WorldPolicy(lambda world: world["joint_positions"]), False),
    ],
    ids=lambda value: type(value).__name__,
)
def test_every_policy_gives_the_same_rows(policy: Any, together: bool) -> None:
    """Functions, models that may have a memory, and who looks at the world play one by one."""
    alone, both = (found(policy, "P6,P2@3", threads) for threads in (1, 2))
    assert both.rows == alone.rows
    assert both.together is together


def test_a_network_gives_the_same_rows(tmp_path: Path) -> None:
    """An ONNX file is asked for one observation at a time."""
    alone, both = (found(str(network(tmp_path)), "P6", threads) for threads in (1, 2))
    assert both.rows == alone.rows
    assert both.together


@pytest.mark.parametrize(
    ("env", "together"),
    [
        ({"action_mode": "delta_end_effector_positions"}, True),
        ({"normalize_actions": False, "start": {"sensor_noise": 0.05}}, True),
        ({"conventions": "causal_world"}, True),
        ({"keypoints": True}, False),
        ({"task": "towers"}, False),
    ],
    ids=["delta", "noise", "predecessor", "keypoints", "towers"],
)
def test_every_environment_gives_the_same_rows(env: Any, together: bool) -> None:
    """Where bodies may come and go, or something has to be looked at alone, it is one by one."""
    alone, both = (
        found(np.full(9, 0.1, np.float32), "P0,P6@2", threads, n=2, **env) for threads in (1, 2)
    )
    assert both.rows == alone.rows
    assert both.together is together


@pytest.mark.parametrize("threads", [1, 2])
def test_errors_have_their_place(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first episode in which something goes wrong is named, not what goes wrong first."""
    monkeypatch.setattr(pipelines, "cores", lambda: threads)
    how: Any = {"n": 6, "seeds": 3, "env": {"max_episode_length": 6}}
    with pytest.raises(EvaluationError, match="not feasible") as refused:
        evaluate({"a": small_mlp()}, [WITHIN], **how)
    place = {"agent": "a", "engine": "mujoco", "protocol": "late@3", "seed": 3, "episode": 0}
    assert refused.value.place == {**place, "control step": 3}
    with pytest.raises(EvaluationError, match="gave") as raised:
        evaluate({"a": _afraid}, "P6", **how)
    assert raised.value.place == {**place, "protocol": "P6", "episode": 4, "control step": 2}


def _afraid(observation: Any) -> Any:
    """Fail in the fifth episode, and a step sooner in the sixth."""
    side, left = observation[33], observation[0]
    bad = side < -0.1 and left < (0.9 if side < -0.12 else 0.5)
    return np.full(9, np.nan if bad else 0.0)


def test_what_was_played_alone_goes_on_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The files of both are the same, byte by byte, and each is used by the other."""
    how: Any = {"env": {"max_episode_length": 3}}
    wholes = {}
    for threads in (1, 2):
        monkeypatch.setattr(pipelines, "cores", lambda threads=threads: threads)
        wholes[threads] = evaluate(small_mlp(), "P1,P6", n=30, out=tmp_path / str(threads), **how)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert wholes[1].digest == wholes[2].digest
    shards: list[int] = []
    play = Lockstep.play

    def counted(self: Lockstep, *given: Any, episodes: range, **how: Any) -> Any:
        shards.append(len(episodes))
        return play(self, *given, episodes=episodes, **how)

    monkeypatch.setattr(Lockstep, "play", counted)
    longer = evaluate(small_mlp(), "P1,P6", n=50, out=tmp_path / "1", **how)
    assert shards == [25, 25]  # the first ones were there, the short ones are others now
    assert longer.only(protocol="P6").columns["hash"][:30].tolist() == (
        wholes[1].only(protocol="P6").columns["hash"].tolist()
    )


def test_processes_leave_the_cores_to_one_another(tmp_path: Path) -> None:
    """Several workers have one thread each, and the same results."""
    how: Any = {"n": 30, "env": {"max_episode_length": 3}}
    alone = evaluate({"a": linear}, "P6", workers=1, **how)
    assert evaluate({"a": linear}, "P6", workers=2, **how) == alone
