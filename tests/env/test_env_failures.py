"""What ends where the engine cannot go on: an episode, or everything."""

from __future__ import annotations

from copy import deepcopy
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from scm_world import Action, Box, Exogenous, Measured, ModelTask, StepTask
from scm_world.env import ScmWorldEnv, ScmWorldVectorEnv
from scm_world.errors import EngineFailure, EvaluationError, UnknownOption
from scm_world.evaluation import evaluate

GROWING = """<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody><body name="c">
<joint name="j" type="slide" damping="0.1"/><geom size=".1" mass="1"/></body></worldbody>
<actuator><general name="m" joint="j" gainprm="1" biastype="affine" biasprm="0 0 60"
ctrlrange="-1 1"/></actuator></mujoco>"""


class Growing(ModelTask):
    """A slider whose motor speeds it up the more the faster it is; unstable where it is pushed."""

    model = GROWING
    reward = (np.cos, "j.position")
    success = (lambda place: abs(float(place)) < 1e9, "j.position")


def doubling(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Square what is pushed, until no number is large enough."""
    if action["push"] < -0.99:
        raise RuntimeError("a fault of the function")
    with np.errstate(over="ignore"):
        grown = (state["x"] + parameters["rate"]) ** 2
    return {"x": grown if action["push"] > 0.0 else state["x"]}


def squares() -> StepTask:
    """Return a step function that diverges where it is pushed."""
    return StepTask(
        doubling,
        parameters=[Exogenous(name="rate", default=1e100)],
        states=[Measured(name="x", parents=("rate", "x", "push"))],
        actions=[Action(name="push", bounds=Box(-1.0, 1.0))],
        reward=(np.tanh, "x"),
    )


KINDS = {"mujoco": Growing, "step": squares}


def played(envs: Any, steps: int) -> list[Any]:
    """Step environments of which the second is pushed, and return all that they give."""
    push = np.zeros((envs.num_envs, 1), np.float32)
    push[1] = 1.0
    return [envs.reset(seed=0), *(envs.step(push) for _ in range(steps))]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("kind", KINDS)
def test_a_world_that_fails_ends_its_own_episode(kind: str, mode: AutoresetMode) -> None:
    """Stepped together or one by one, all others go on, and the next episode begins."""
    options: Any = {"task": KINDS[kind](), "on_failure": "truncate", "max_episode_length": 90}
    native = ScmWorldVectorEnv(3, autoreset_mode=mode, **options)
    single: Any = SyncVectorEnv([partial(ScmWorldEnv, **options)] * 3, autoreset_mode=mode)
    ours, theirs = played(native, 80), played(single, 80)
    failed = 0
    for step, (one, two) in enumerate(zip(ours[1:], theirs[1:], strict=True)):
        for mine, its in zip(one[:4], two[:4], strict=True):
            np.testing.assert_array_equal(mine, its, err_msg=f"step {step}")
        _, rewards, terminated, truncated, infos = one
        flags = infos.get("final_info", infos)["failed"]
        assert not (flags & ~truncated).any()
        assert not flags[[0, 2]].any()
        if flags[1] and truncated[1]:
            failed += 1
            assert not terminated[1]
            assert rewards[1] == 0.0
            shown = infos["final_obs"][1] if "final_obs" in infos else one[0][1]
            before = ours[step][0][1]
            np.testing.assert_array_equal(shown, before)  # the last one there was
    assert failed >= 2
    assert [world.index for world in native.get_attr("world")][::2] == [80, 80]
    native.close()
    single.close()


def test_without_it_the_error_names_the_environment() -> None:
    """Nothing is truncated that was not asked for, and one word stands for an environment."""
    envs = gymnasium.make_vec("scm_world/Model-v0", num_envs=3, model=Growing())
    with pytest.raises(EngineFailure, match=r"^environment 1: MuJoCo produced .* unstable"):
        played(envs, 80)
    with pytest.raises(EngineFailure, match=r"^environment 1: .*reset the world"):
        envs.step(np.zeros((3, 1), np.float32))
    envs.close()
    with pytest.raises(UnknownOption, match="on_failure"):
        ScmWorldEnv(Growing(), on_failure="ignore")


def test_an_error_in_a_function_is_raised_all_the_same() -> None:
    """Only numbers beyond all bounds end an episode, also if others diverge in the same step."""
    envs = ScmWorldVectorEnv(3, task=squares(), on_failure="truncate")
    envs.reset(seed=0)
    envs.step(np.array([[1.0], [1.0], [0.0]], np.float32))  # they diverge with the next step
    with pytest.raises(EngineFailure, match=r"environment 2: .*a fault of the function") as caught:
        envs.step(np.array([[1.0], [1.0], [-1.0]], np.float32))
    assert deepcopy(caught.value).row == 2
    envs.close()


def test_a_copy_goes_on_like_the_original() -> None:
    """A copied environment truncates, too, and a failed one begins anew."""
    env = deepcopy(ScmWorldEnv(Growing(), on_failure="truncate"))
    env.reset(seed=0)
    for _ in range(80):
        observation, _, _, truncated, info = env.step(np.ones(1, np.float32))
        if truncated:
            break
    assert info["failed"]
    assert np.isfinite(observation).all()
    assert env.reset()[1]["failed"] is False
    assert not env.step(np.ones(1, np.float32))[3]


def test_an_evaluation_counts_them() -> None:
    """Episodes that failed have a column; without the option the first one ends the evaluation."""
    with pytest.raises(EvaluationError, match="unstable"):
        evaluate(lambda _: [1.0], "P0", task=Growing(), n=2)
    found = evaluate(lambda _: [1.0], "P0", task=Growing(), n=2, env={"on_failure": "truncate"})
    assert found.frame["failed"].tolist() == [1.0, 1.0]
    assert found.frame["success"].tolist() == [0.0, 0.0]
    assert found.score("P0", "failed").value == 1.0
