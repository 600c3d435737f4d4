"""A policy that plans with the model itself."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest

from scm_world.errors import (
    ActionError,
    InterventionError,
    ModelError,
    UnknownOption,
    UnknownVariable,
)
from scm_world.geometry.rotations import from_rotation_vector
from scm_world.policies.planning import CrossEntropy, PlanningModel, Score, Search, nearness
from scm_world.policies.planning.model import as_score
from scm_world.policies.scripted import NAMED
from scm_world.queries import World
from scm_world.tasks import Pushing, Reaching
from scm_world.tasks.trifinger.views import corners
from scm_world.variables import Noise
from scm_world.world import Simulation

SMALL: dict[str, Any] = {"samples": 6, "elites": 2, "horizon": 3, "iterations": 2, "threads": 1}
HEAVY = {"tool_block.mass": 0.09}


def begun(task: str = "pushing", **options: Any) -> World:
    """Make a world with an episode that goes on."""
    world = World(task, **options)
    world.reset(seed=3)
    world.step(0.5 * (world.action_low + world.action_high))
    return world


def sequences(world: World, n: int, steps: int) -> Any:
    """Draw sequences of actions."""
    share = np.random.default_rng(0).uniform(size=(n, steps, 9))
    return world.action_low + share * (world.action_high - world.action_low)


# --- the model ------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["joint_positions", "end_effector_positions", "joint_torques"])
def test_rollouts_are_those_of_single_worlds(mode: str) -> None:
    """What copies go through together is, bit for bit, what a world goes through alone."""
    world = begun(action_mode=mode)
    names, actions = ("reward", "tool_block.cartesian_position"), sequences(world, 3, 4)
    model = PlanningModel(world, 4, names, threads=2)
    found = model.rollouts(model.present(world), actions)
    for row in range(3):
        alone = copy.deepcopy(world)
        for step in range(4):
            alone.step(actions[row, step])
            for name in names:
                assert found[name][row, step].tobytes() == alone[name].tobytes()
    model.close()


def test_noise_is_foreseen_only_if_asked_for() -> None:
    """With the noise of the world the model says what will be; without it, it does not."""
    world = World("pushing", backend="mujoco")
    world.reset(seed=0, do={"actuator_noise": 0.3})
    actions = sequences(world, 1, 2)
    after = {}
    for foresees in (True, False):
        model = PlanningModel(world, 1, ["joint_positions"], foresees=foresees, threads=1)
        after[foresees] = model.rollouts(model.present(world), actions)["joint_positions"][0, -1]
    for action in actions[0]:
        world.step(action)
    assert (after[True] == world["joint_positions"]).all()
    assert (after[False] != world["joint_positions"]).any()


def test_the_model_may_believe_something_else() -> None:
    """What is believed holds in the model, and the world stays as it is."""
    world = begun(backend="fake")
    model = PlanningModel(world, 2, ["tool_block.mass"], do=HEAVY)
    before = pickle.dumps(world.snapshot())
    found = model.rollouts(model.present(world), sequences(world, 2, 2))
    assert (found["tool_block.mass"] == 0.09).all()
    assert pickle.dumps(world.snapshot()) == before
    assert world["tool_block.mass"] != 0.09


@pytest.mark.parametrize(("acts", "plans"), [("bullet", "mujoco"), ("mujoco", "bullet")])
def test_the_present_is_carried_to_another_engine(acts: str, plans: str) -> None:
    """Copies in another engine begin where the world is, and with its parameters."""
    pytest.importorskip("pybullet")
    world = begun(backend=acts)
    world.do(HEAVY)
    model = PlanningModel(
        world, 1, ["joint_positions", "tool_block.mass"], backend=plans, threads=1
    )
    rest = np.array(world["joint_positions"])
    found = model.rollouts(model.present(world), rest[None, None])
    world.step(rest)
    assert found["joint_positions"][0, 0] == pytest.approx(world["joint_positions"], abs=0.05)
    assert found["tool_block.mass"] == 0.09


# --- the search -----------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [1, 2, 7, 8])
def test_noise_has_variance_one(horizon: int) -> None:
    """Whatever its color and length."""
    drawn = Search(samples=4000, horizon=horizon).noise(Noise(0), "plan", 9, episode=0, step=0)
    assert drawn.shape == (4000, horizon, 9)
    assert drawn.var(axis=(0, 2)) == pytest.approx(np.ones(horizon), abs=0.05)


def test_noise_is_correlated_in_time() -> None:
    """Colored noise changes less from step to step than white noise."""
    change = {
        color: np.diff(
            Search(samples=200, color=color).noise(Noise(0), "plan", 9, episode=0, step=0), axis=1
        ).std()
        for color in (0.0, 3.0)
    }
    assert change[3.0] < 0.5 * change[0.0]


# --- the policy -----------------------------------------------------------------------------------


def test_threads_do_not_matter() -> None:
    """One thread and two choose the same actions, and so does a copy through a pickle."""
    world = begun()
    one, two = (CrossEntropy(**{**SMALL, "threads": n}) for n in (1, 2))
    again = pickle.loads(pickle.dumps(one))  # noqa: S301 # our own
    actions = [policy(world).tobytes() for policy in (one, two, again, one)]
    assert len(set(actions)) == 1
    other = CrossEntropy(**SMALL, seed=1)
    assert other(world).tobytes() != actions[0]


def test_the_world_is_left_alone() -> None:
    """Planning moves nothing, and changes no later step."""
    world, twin = begun(), begun()
    before = pickle.dumps(world.snapshot())
    action = CrossEntropy(**SMALL)(world)
    assert pickle.dumps(world.snapshot()) == before
    for one in (world, twin):
        one.step(action)
    assert pickle.dumps(world.snapshot()) == pickle.dumps(twin.snapshot())


def test_one_instance_serves_all_episodes() -> None:
    """Episode after episode, and in worlds by turns, it does what a new instance does."""
    policy = CrossEntropy(**SMALL)
    worlds = [World("reaching", backend="fake") for _ in range(2)]
    first = [policy_of(policy, world, seed) for seed, world in enumerate(worlds)]
    again = policy_of(policy, worlds[0], 0)
    fresh = policy_of(CrossEntropy(**SMALL), worlds[0], 0)
    assert first[0].tobytes() == again.tobytes() == fresh.tobytes()
    assert first[1].tobytes() != first[0].tobytes()


def policy_of(policy: CrossEntropy, world: Simulation, seed: int) -> Any:
    """Give the first actions of an episode."""
    world.reset(seed=seed)
    actions = []
    for _ in range(3):
        actions.append(policy(world))
        world.step(actions[-1])
    return np.array(actions)


def test_it_plans_anew_when_somebody_intervenes() -> None:
    """A plan that was made for another world is not followed to its end."""
    policy = CrossEntropy(**{**SMALL, "horizon": 4}, every=4)
    worlds = [begun("reaching") for _ in range(2)]
    for world in worlds:
        world.step(policy(world))
    worlds[1].do({"goal_60.cartesian_position": [0.05, 0.05, 0.2]})
    assert policy(worlds[0]).tobytes() != policy(worlds[1]).tobytes()


def test_it_comes_nearer_than_chance() -> None:
    """In a few steps the fingertips are nearer to their goals than after random actions."""
    world = World("reaching")
    planned = world.rollout(_quick(), steps=12)
    still, random = (world.rollout(policy, steps=12) for policy in (None, "random"))
    errors = [float(e.final("reach_error")) for e in (planned, still, random)]
    assert errors[0] < 0.6 * min(errors[1:])


def _quick() -> CrossEntropy:
    return CrossEntropy(samples=24, elites=5, horizon=5, spread=0.2, every=1, threads=1)


def test_it_has_a_name() -> None:
    """It can be asked for as ``mpc``, and is made once."""
    assert isinstance(NAMED["mpc"](), CrossEntropy)
    assert NAMED["mpc"]() is NAMED["mpc"]()


def test_the_end_of_a_plan_may_count_by_itself() -> None:
    """What counts at the end changes which action is chosen."""
    world = begun("reaching")
    error = {"reach_error": -1.0}
    calm = Score(("joint_velocities",), lambda v: -np.abs(v).sum(axis=-1))
    plain, other = (CrossEntropy(objective=error, terminal=t, **SMALL) for t in (None, calm))
    assert plain(world).tobytes() != other(world).tobytes()


# --- scores ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", ["joint_velocities", {"joint_velocities": -0.1, "gravity": 1.0}])
def test_the_sum_of_several_numbers_counts(given: Any) -> None:
    """Along a plan and at its end, also where no variable with one number stands beside them."""
    world = begun("reaching")
    one, two = (as_score(given), Score(("joint_velocities",), lambda v: v.sum(axis=-1)))
    values = {"joint_velocities": np.ones((2, 3, 9)), "gravity": np.ones((2, 3, 3))}
    wanted = 9.0 if isinstance(given, str) else 2.1
    assert one.of(values, (2, 3)) == pytest.approx(np.full((2, 3), wanted))
    actions = {
        CrossEntropy(objective=score, terminal=score, **SMALL)(world).tobytes()
        for score in (one, two)
    }
    assert len(actions) == (1 if isinstance(given, str) else 2)


def test_nearness_is_zero_at_the_goal() -> None:
    """Tips at their goals, and corners of a turned box at those of its goal."""
    goals = np.arange(9.0)
    found = nearness(Reaching()).of(
        {"end_effector_positions": goals, **_places(goals)}  # the order is that of the names
    )
    assert found == 0.0
    score, values = nearness(Pushing()), _boxes()
    here = float(score.of({**values, "end_effector_positions": np.tile([0.1, 0.2, 0.3], 3)}))
    assert here == pytest.approx(0.0)
    turned = {**values, "goal_block.orientation": np.array([0.0, 0.0, 1.0, 0.0])}
    tips = {"end_effector_positions": np.tile([0.1, 0.2, 0.3], 3)}
    assert float(score.of({**turned, **tips})) == pytest.approx(-np.hypot(1.0, 2.0))


def _places(goals: Any) -> dict[str, Any]:
    fingers = ("60", "120", "300")
    parts = goals.reshape(3, 3)
    return {f"goal_{f}.cartesian_position": p for f, p in zip(fingers, parts, strict=True)}


def _boxes() -> dict[str, Any]:
    pose = {
        "size": np.array([1.0, 2.0, 3.0]),
        "cartesian_position": np.array([0.1, 0.2, 0.3]),
        "orientation": np.array([0.0, 0.0, 0.0, 1.0]),
    }
    return {f"{box}.{p}": v for box in ("tool_block", "goal_block") for p, v in pose.items()}


def test_corners_turn_with_the_box() -> None:
    """A quarter turn about the vertical exchanges length and width."""
    quarter = from_rotation_vector([0.0, 0.0, np.pi / 2])
    found = corners(np.array([2.0, 4.0, 6.0]), np.zeros(3), quarter)
    assert np.abs(found).max(axis=0) == pytest.approx([2.0, 1.0, 3.0])


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("numbers", "match"),
    [
        ({"samples": 1}, "samples"),
        ({"horizon": 0}, "horizon"),
        ({"iterations": 2.5}, "iterations"),
        ({"elites": 100}, "elites"),
        ({"spread": -1.0}, "spread"),
        ({"spread": 1e308}, "spread"),
        ({"color": "pink"}, "color"),
        ({"momentum": 1.5}, "momentum"),
        ({"every": 13}, "every"),
        ({"seed": -1}, "seed"),
        ({"threads": 0}, "threads"),
        ({"population": 10}, "population"),
        ({"do": [1]}, "dictionary of variables"),
        ({"foresees": "no"}, "foresees"),
        ({"objective": 3}, "objective"),
        ({"objective": {"reward": float("nan")}}, "weight of reward"),
    ],
)
def test_wrong_options_are_refused(numbers: dict[str, Any], match: str) -> None:
    """The message names the option."""
    with pytest.raises(UnknownOption, match=match):
        CrossEntropy(**numbers)


def test_wrong_names_are_refused() -> None:
    """A variable, an engine or a belief that does not exist is told by name."""
    world = begun(backend="fake")
    with pytest.raises(UnknownVariable, match="rewards"):
        CrossEntropy(objective="rewards", **SMALL)(world)
    with pytest.raises(UnknownOption, match="backend"):
        CrossEntropy(backend="ode", **SMALL)(world)
    with pytest.raises(InterventionError, match=r"tool_block\.mas"):
        CrossEntropy(do={"tool_block.mas": 1.0}, **SMALL)(world)


@pytest.mark.parametrize("shape", [(3, 2, 9), (2, 9), (2, 2, 8)])
def test_actions_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    """More sequences than there are copies, too few axes, too few numbers."""
    world = begun(backend="fake")
    model = PlanningModel(world, 2, ["reward"])
    with pytest.raises(ActionError, match=r"shape \(n, steps, 9\), with n up to 2, got"):
        model.rollouts(model.present(world), np.zeros(shape))
    with pytest.raises(UnknownOption, match="threads"):
        PlanningModel(world, 2, ["reward"], threads=0)


@pytest.mark.parametrize("wrong", [lambda _: np.nan, lambda _: "much", lambda a, b: a])
def test_scores_are_finite_numbers(wrong: Any) -> None:
    """What a function gives otherwise is refused, with what it is a function of."""
    with pytest.raises(ModelError, match="score of a plan"):
        Score(("reward",), wrong).of({"reward": np.zeros(2)})
    one = CrossEntropy(objective=Score(("reward",), np.sum), **SMALL)
    with pytest.raises(ModelError, match=r"shape \(\), not \(6, 3\)"):
        one(begun(backend="fake"))
    assert as_score("reward").of({"reward": np.ones((2, 3))}).shape == (2, 3)
