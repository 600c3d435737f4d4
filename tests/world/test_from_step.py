"""Worlds whose physics is a function: ``World``."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from numba import njit

from scm_world import (
    Action,
    Box,
    Derived,
    Exogenous,
    Measured,
    StepTask,
    World,
    discover,
    verify,
)
from scm_world.errors import (
    EngineFailure,
    InterventionError,
    ModelError,
    NotIntervenable,
    OutOfBounds,
    UnknownOption,
)
from scm_world.testing import model
from scm_world.variables import Affine, Categories, Integers, Normal

N, DT = 5, 0.1
WIDE = Box(-5.0, 5.0)


# --- a chain of masses and springs, whose graph is known ------------------------------------------


def chain(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Masses in a row, each one bound to its neighbours: explicit Euler, one system or many."""
    new = {}
    for i in range(N):
        x, v = state[f"mass{i}.position"], state[f"mass{i}.velocity"]
        force = action["push"] if i == 0 else 0.0 * x
        for spring, other in ((i - 1, i - 1), (i, i + 1)):
            if 0 <= other < N:
                k = parameters[f"spring{spring}.stiffness"]
                force = force + k * (state[f"mass{other}.position"] - x)
        new[f"mass{i}.position"] = x + DT * v
        new[f"mass{i}.velocity"] = v + DT * (force / parameters[f"mass{i}.mass"]) + noise["wind"]
    return new


def neighbors(i: int) -> dict[str, tuple[str, ...]]:
    """Name the causes of position and velocity of a mass, as the equations have them."""
    springs = [f"spring{j}.stiffness" for j in (i - 1, i) if 0 <= j < N - 1]
    near = [f"mass{j}.position" for j in (i - 1, i, i + 1) if 0 <= j < N]
    push = ("push",) if i == 0 else ()
    return {
        "position": (f"mass{i}.position", f"mass{i}.velocity"),
        "velocity": (f"mass{i}.velocity", f"mass{i}.mass", *near, *springs, *push),
    }


EDGES = {
    (cause, f"mass{i}.{quantity}", 1)
    for i in range(N)
    for quantity, causes in neighbors(i).items()
    for cause in causes
}


def chain_world(*, leave_out: tuple[str, str] | None = None, full: bool = False) -> World:
    """Make the chain: with its edges, without one of them, or with all that could be."""
    states = [
        Measured(
            name=(name := f"mass{i}.{quantity}"),
            unit="m" if quantity == "position" else "m/s",
            default=0.1 * i,
            bounds=WIDE,
            parents=() if full else tuple(c for c in causes if (c, name) != leave_out),
        )
        for i in range(N)
        for quantity, causes in neighbors(i).items()
    ]
    masses = [Exogenous(name=f"mass{i}.mass", default=1.0, bounds=Box(0.5, 2.0)) for i in range(N)]
    springs = [
        Exogenous(name=f"spring{i}.stiffness", default=2.0, bounds=Box(0.5, 4.0))
        for i in range(N - 1)
    ]
    return World(
        chain,
        parameters=[*masses, *springs],
        states=states,
        actions=[Action(name="push", unit="N", bounds=Box(-1.0, 1.0))],
        control_dt=DT,
        noise={"wind": Normal(0.0, 0.01)},
        vectorized=True,
    )


def about_states(edges: Any) -> set[tuple[str, str, int]]:
    """Leave out the clock."""
    return {edge for edge in map(tuple, edges) if edge[1] != "control_index"}


def test_the_declared_parents_are_the_graph() -> None:
    """The graph has the declared edges, each at lag 1; plain names mean the step before."""
    world = chain_world()
    assert about_states(edge.key for edge in world.graph.edges) == EDGES


def test_a_state_without_parents_has_every_cause() -> None:
    """Where nothing is declared, every parameter, state and action is a cause."""
    world = chain_world(full=True)
    causes = (2 * N) + N + (N - 1) + 1
    assert len(about_states(edge.key for edge in world.graph.edges)) == 2 * N * causes


def test_discovery_finds_the_neighbors_and_nothing_else() -> None:
    """Experiments find exactly the edges that the equations have."""
    report = discover(chain_world(), probes=4)
    assert report.floor == 0.0
    assert about_states(report.found) == EDGES
    assert report.score.shd == 0


def test_discovery_thins_out_what_nobody_knew() -> None:
    """The same edges are found where all that could be were declared."""
    report = discover(chain_world(full=True), probes=4)
    assert about_states(report.found) == EDGES
    assert not report.score.undeclared


def test_a_forgotten_parent_is_found() -> None:
    """An edge that the function has and the declaration has not is undeclared."""
    forgotten = ("spring1.stiffness", "mass2.velocity")
    report = verify(chain_world(leave_out=forgotten), probes=4)
    assert [edge.key for edge in report.undeclared] == [(*forgotten, 1)]
    assert not report.never_fired
    assert report.outcome == "refuted"


def test_the_full_declaration_is_verified() -> None:
    """With the parent, everything is declared and everything declared is seen."""
    report = verify(chain_world(), probes=4)
    assert report.outcome == "confirmed"
    assert report.floor == 0.0


def test_a_counterfactual_reaches_only_who_is_near() -> None:
    """Another stiffness at one end moves the other end only after the steps it takes to get there.

    The noise is the same in both: where the spring has not reached, not a bit differs.
    """
    episode = chain_world().rollout("random", seed=3, steps=12)
    assert episode.counterfactual({}) == episode
    other = episode.counterfactual({"spring0.stiffness": 4.0}, at=2)
    for i in range(N):
        moved = np.flatnonzero(other[f"mass{i}.velocity"] != episode[f"mass{i}.velocity"])
        reached = 3 if i < 2 else 3 + 2 * (i - 1)  # a neighbour's position follows its velocity
        assert moved[0] == reached


def test_the_example_declares_its_graph_rightly() -> None:
    """Predator and prey: every edge of the equations is found, and no other one."""
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "predator_prey.py"))
    report = discover(example["make"](), probes=8)
    assert report.score.shd == 0
    assert len(report.found) == 9


# --- a small world with all there is --------------------------------------------------------------


def shop(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Stock of two goods, customers who come by chance, a price, and a season."""
    busy = (1, 3)[parameters["season"]]
    came = noise["arrivals"] * busy
    sold = np.minimum(state["stock"], came * parameters["demand"] / action["price"])
    return {
        "stock": state["stock"] - sold + action["order"],
        "customers": state["customers"] + came,
    }


def shop_world(**options: Any) -> World:
    """Make it."""
    season = Exogenous(name="season", dtype="categorical", bounds=Categories((0, 1)))
    given: dict[str, Any] = {
        "parameters": [
            season,
            Exogenous(name="taste", shape=(2,), default=(1.0, 2.0), bounds=Box(0.1, 5.0)),
            Derived(name="demand", shape=(2,), parents=("taste",), mechanism=np.sqrt),
        ],
        "states": [
            Measured(
                name="stock",
                shape=(2,),
                default=(20.0, 30.0),
                bounds=Box(0.0, 1e3),
                parents=("stock", "season", "demand", "price", "order"),
            ),
            Measured(
                name="customers",
                dtype="integer",
                bounds=Integers(0, 10**6),
                parents=("customers", "season"),
            ),
        ],
        "actions": [
            Action(name="price", bounds=Box(0.5, 2.0)),
            Action(name="order", shape=(2,), bounds=Box(0.0, 5.0)),
        ],
        "control_dt": 1.0,
        "noise": {"arrivals": Integers(0, 4)},
        "outcomes": [Measured(name="full", parents=("stock",), mechanism=np.sum)],
        "reward": (np.multiply, "full", "price"),
    }
    return World(shop, **{**given, **options})


def test_several_actions_are_one_command() -> None:
    """The command is one action after another, and each one has its name."""
    world = shop_world()
    world.reset(seed=0)
    world.step([2.0, 1.0, 3.0])
    assert world["price"] == 2.0
    assert world["order"].tolist() == [1.0, 3.0]
    assert world["full"] == world["stock"].sum()
    assert world["reward"] == world["full"] * 2.0


def test_every_kind_of_edge_is_seen() -> None:
    """Categories, vectors, whole numbers, and an action that the next reward depends on."""
    report = verify(shop_world(), probes=16)
    assert report.outcome == "confirmed"
    assert ("price", "reward", 1) in report.found


def test_integers_stay_integers_and_are_drawn_as_such() -> None:
    """A whole number is counted, set, read back and remembered as one."""
    world = shop_world()
    world.reset(seed=1)
    world.do({"customers": 7, "season": 1})
    for _ in range(5):
        world.step([1.0, 0.0, 0.0])
    came = int(world["customers"]) - 7
    assert came % 3 == 0
    assert came > 0
    assert world["customers"].dtype == world.values()["customers"].dtype == np.int64
    assert world.rollout("random", seed=0, steps=3)["customers"].dtype == np.int64


def test_a_parameter_holds_and_a_state_goes_on() -> None:
    """What is done is read back; derived parameters follow; a reset forgets all of it."""
    world = shop_world()
    world.reset(seed=0)
    audit = world.do({"taste": [4.0, 4.0], "stock": [5.0, 5.0]})
    np.testing.assert_array_equal(audit.targets["taste"].read_back, [4.0, 4.0])
    assert world["demand"].tolist() == [2.0, 2.0]
    world.step([1.0, 0.0, 0.0])
    assert world["taste"].tolist() == [4.0, 4.0]
    world.reset(seed=0)
    assert world["taste"].tolist() == [1.0, 2.0]
    assert world["stock"].tolist() == [20.0, 30.0]


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        ({"taste": [9.0, 1.0]}, OutOfBounds),
        ({"full": 3.0}, NotIntervenable),
        ({"season": 2}, OutOfBounds),
        ({"customers": 0.5}, InterventionError),
    ],
)
def test_what_is_refused_changes_nothing(request_: dict[str, Any], error: type[Exception]) -> None:
    """After a refusal the world goes on as if nobody had asked."""
    world, twin = shop_world(), shop_world()
    for one in (world, twin):
        one.reset(seed=0)
        one.step([1.0, 1.0, 1.0])
    with pytest.raises(error):
        world.do({"stock": [1.0, 1.0], **request_})
    for one in (world, twin):
        one.step([1.0, 1.0, 1.0])
    assert {k: v.tolist() for k, v in world.values().items()} == {
        k: v.tolist() for k, v in twin.values().items()
    }


def test_it_is_an_environment() -> None:
    """Gymnasium makes one of the task, or many: with its reward, and an end where it says so."""
    task = shop_world(terminated=(np.any, "customers")).task  # the first customer ends it
    env = gymnasium.make("scm_world/Model-v0", model=task, backend="step")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (3,)
    ended, steps = False, 0
    while not ended:
        _, reward, ended, _, _ = env.step(np.zeros(3, np.float32))
        steps += 1
    world = env.unwrapped.world  # type: ignore[attr-defined]
    assert world["customers"] > 0
    assert reward == world["reward"]
    many = gymnasium.make_vec("scm_world/Model-v0", model=task, backend="step", num_envs=3)
    many.reset(seed=0)
    ends = [bool(many.step(np.zeros((3, 3), np.float32))[2][0]) for _ in range(steps)]
    assert ends.index(True) == steps - 1


# --- what holds for every world -------------------------------------------------------------------


@pytest.mark.parametrize("make", [chain_world, shop_world])
class TestEveryWorld:
    """The promises of a world, kept by one with noise and one with whole numbers."""

    def test_undo_is_exact(self, make: Callable[[], World]) -> None:
        """Every variable is set and set back: later steps are the same to the bit."""
        world = make()
        assert model.check_undo(world) == len(model.quantities(world))

    def test_refusals_and_counterfactuals(self, make: Callable[[], World]) -> None:
        """A refusal leaves no trace, and a counterfactual of nothing is what happened."""
        assert model.check_refusal(make()) > 0
        model.check_counterfactual(make())

    def test_elsewhere(self, make: Callable[[], World]) -> None:
        """A pickled world and its snapshot go on alike in another process."""
        model.check_future(make())

    def test_batches(self, make: Callable[[], World]) -> None:
        """Worlds that are stepped together are like single ones."""
        model.check_batch(make, n=5)

    def test_endurance(self, make: Callable[[], World]) -> None:
        """Random actions and interventions are survived."""
        assert model.check_endurance(make(), steps=300) == (300, "")


# --- chance ---------------------------------------------------------------------------------------


def drift(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """A walk with a drift, whose steps are the noise that is named like it."""
    return {"place": state["place"] + parameters["drift"] + noise["place"]}


def walk(**options: Any) -> World:
    """Make it, in two dimensions."""
    given: dict[str, Any] = {
        "parameters": [Exogenous(name="drift", default=0.0, bounds=Box(-1.0, 1.0))],
        "states": [Measured(name="place", shape=(2,), parents=("place", "drift"))],
        "control_dt": 1.0,
        "noise": {"place": Normal(0.0, 2.0)},
    }
    return World(drift, **{**given, **options})


def test_noise_is_the_same_whatever_is_done() -> None:
    """The difference between two lives is what was done, to round-off: chance is shared."""
    world = walk()
    free = world.rollout(seed=1, steps=50)["place"]
    pushed = world.rollout(seed=1, steps=50, do={"drift": 0.5})["place"]
    np.testing.assert_allclose(pushed - free, 0.5 * np.arange(51)[:, None] + [0, 0], atol=1e-12)
    assert np.abs(free[-1]).min() > 0.0
    assert free[-1, 0] != free[-1, 1]


def test_noise_has_its_distribution_and_its_seed() -> None:
    """Steps have the declared spread and no memory; another seed or episode is another life."""
    world = walk(seconds=4000.0)
    steps = np.diff(world.rollout(seed=1)["place"], axis=0)
    assert steps.shape == (4000, 2)
    assert abs(steps.std() - 2.0) < 0.1
    assert abs(np.mean(steps[1:] * steps[:-1])) < 0.3
    others = [world.rollout(seed=s, episode=e, steps=1).final("place") for s, e in ((2, 0), (1, 1))]
    assert not any(np.array_equal(other, steps[0]) for other in others)


def test_an_episode_can_begin_anywhere() -> None:
    """A space as ``start`` is drawn anew at every reset, and is a variable like any other."""
    world = walk(start={"place": Box(1.0, 2.0)}, noise={})
    seen = []
    for seed in range(5):
        world.reset(seed=seed)
        seen.append(world["place"])
        assert ((world["place"] >= 1.0) & (world["place"] <= 2.0)).all()
    assert len({place.tobytes() for place in seen}) == 5
    world.reset(do={"place.start": [1.5, 1.25]})
    assert world["place"].tolist() == [1.5, 1.25]


def test_an_effect_is_what_the_equations_say() -> None:
    """The mean difference after ten steps of drift is ten times the drift, without spread."""
    found = walk().effect("place", do={"drift": 0.25}, n=4, steps=10)
    np.testing.assert_allclose(found.mean, 2.5, atol=1e-9)


# --- other ways to write it -----------------------------------------------------------------------


@njit
def compiled(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """The walk, of flat arrays."""
    return state + parameters[0] + noise


def test_a_compiled_function_of_arrays() -> None:
    """A numba function gives the same life as the Python one."""
    world = World(
        compiled,
        signature="arrays",
        name="walk",
        parameters=[Exogenous(name="drift", default=0.1, bounds=Box(-1.0, 1.0))],
        states=[Measured(name="place", shape=(2,), parents=("place", "drift"))],
        control_dt=1.0,
        noise={"place": Normal(0.0, 2.0)},
    )
    life = walk().rollout(seed=1, steps=9, do={"drift": 0.1})["place"]
    np.testing.assert_array_equal(world.rollout(seed=1, steps=9)["place"], life)


class Growth(StepTask):
    """A task of one's own, as a class."""

    parameters = (Exogenous(name="rate", default=0.5, bounds=Box(0.0, 1.0)),)
    states = (Measured(name="size", default=1.0, parents=("rate", "size")),)
    control_dt = 0.1
    seconds = 3.0

    @staticmethod
    def step(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        """Grow."""
        return {"size": state["size"] * (1.0 + 0.1 * parameters["rate"])}


def test_a_task_can_be_a_class() -> None:
    """A class with the declarations is a task, with the function as its static method."""
    world = World(Growth(), backend="step")
    episode = world.rollout()
    assert len(episode) == 30
    np.testing.assert_allclose(episode.final("size"), 1.05**30)
    assert world.task.name == "Growth"


# --- what is refused ------------------------------------------------------------------------------

PLACE = Measured(name="place", shape=(2,))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"states": []}, "a state is missing"),
        ({"control_dt": 0.0}, "control_dt=0.0 must be a positive number"),
        ({"signature": "lists"}, "signature='lists' must be"),
        (
            {"states": [Measured(name="place", mechanism=abs, parents=("drift",))]},
            "has a mechanism",
        ),
        ({"states": [Measured(name="place", parents=("wind",))]}, "'wind', a parent of 'place'"),
        ({"noise": 3}, "noise=3 is not a dict"),
        ({"noise": {"place": 0.1}}, "'place' is not a distribution: 0.1"),
        (
            {"noise": {"place": Box(0.0, Affine(parent="drift", scale=1.0))}},
            "must not follow variables",
        ),
        ({"parameters": [Exogenous(name="place")], "states": [PLACE]}, "place"),
        ({"reward": 3.0}, "reward=3.0 is not a declaration"),
    ],
)
def test_a_declaration_that_cannot_be_meant(options: dict[str, Any], message: str) -> None:
    """The error says what is wrong with it."""
    with pytest.raises(ModelError, match=message):
        walk(**options)


def test_what_does_not_exist_is_refused() -> None:
    """Options, variables of another kind, engines of bodies, control steps of several calls."""
    for options, message in (
        ({"states": [Exogenous(name="x")]}, "it can be: Measured"),
        ({"parameters": [PLACE]}, "it can be: Exogenous, Derived, Fixed"),
        ({"control_dt": "x"}, "any finite number"),
        ({"start": {"velocity": 1.0}}, "no start is named 'velocity'"),
    ):
        with pytest.raises(UnknownOption, match=message):
            walk(**options)
    bounded = type("Bounded", (Growth,), {"spaces": {"rate": {"a": Box(0.0, 0.5)}}})
    with pytest.raises(UnknownOption, match="no option of Bounded is named 'spaces'"):
        bounded()
    with pytest.raises(UnknownOption, match="control_dt"):
        walk(control_period=0.1)
    with pytest.raises(UnknownOption, match="step"):
        walk(backend="mujoco")
    with pytest.raises(UnknownOption, match="one call"):
        World(Growth(), backend="step", frame_skip=2)
    with pytest.raises(ModelError, match='set signature="arrays"'):
        World(compiled, states=[PLACE], control_dt=1.0)


def test_a_broken_function_is_an_error_that_names_the_variable() -> None:
    """The step fails; the world is where it was, and can be used further."""

    def blows_up(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        return {"x": state["x"] / parameters["mass"]}

    world = World(
        blows_up,
        parameters=[Exogenous(name="mass", default=1.0)],
        states=[Measured(name="x", default=1.0, parents=("x", "mass"))],
        control_dt=1.0,
    )
    world.reset(seed=0)
    world.do({"mass": 0.0})
    with np.errstate(divide="ignore"), pytest.raises(EngineFailure, match="'x' has a number"):
        world.step([])
    assert world["x"] == 1.0
    world.do({"mass": 2.0})
    world.step([])
    assert world["x"] == 0.5


def test_an_engine_that_calls_no_function_is_refused() -> None:
    """The fake engine would leave every state at its start."""
    still = {"states": [Measured(name="size", default=1.0)], "control_dt": 0.1}
    for backend in ("fake", "mujoco"):
        with pytest.raises(UnknownOption, match="step"):
            World(lambda parameters, state, action, noise: state, backend=backend, **still)
