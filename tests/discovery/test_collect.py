"""Collecting: the same rows whatever the order, with the right regimes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Box, Derived, Exogenous, Linear
from scm_world.backends import Capabilities
from scm_world.discovery import evaluate, learn, problem
from scm_world.discovery.data import (
    Dataset,
    Design,
    collect,
    collect_parts,
    default_causes,
    default_outcomes,
)
from scm_world.discovery.learners.paired import SystemSimulator
from scm_world.env import ScmWorldEnv
from scm_world.errors import (
    InterventionError,
    ModelError,
    UnknownOption,
    UnknownVariable,
)
from scm_world.queries import Outcome, World
from scm_world.variables import Affine, Draw, Hard, Normal, Parent, Shift

MASS, FRICTION = "tool_block.mass", "floor_friction"


def model() -> SCM:
    """Three variables in a row; the space of the last one follows the first."""
    row: Any = Linear(weights=(1.5,))
    space = Box(Affine(parent="x", offset=10.0), 20.0)
    return SCM(
        [
            Exogenous(name="x", distribution=Normal(), a=Box(4.0, 5.0)),
            Derived(name="y", parents=("x",), mechanism=row, noise=Normal(), a=Box(7.0, 8.0)),
            Derived(name="z", parents=("y",), mechanism=row, noise=Normal(), a=space),
        ]
    )


@pytest.fixture
def world() -> World:
    """A world without physics."""
    return World("pushing", backend="fake")


# --- designs ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["single", "all", "half"])
@pytest.mark.parametrize("seen", [0.0, 0.3, 0.5, 1.0])
def test_every_prefix_has_its_share(name: str, seen: float) -> None:
    """The first N episodes have the share of watched ones, to one episode."""
    chosen = Design(name, tuple("abc"), observational_fraction=seen).chosen(0, 0, 200)
    watched = np.cumsum(~chosen.any(axis=1))
    assert np.all(np.abs(watched - seen * np.arange(1, 201)) <= 1.0)


def test_single_targets_take_turns() -> None:
    """Watched episodes do not make a target lose its turn."""
    chosen = Design("single", tuple("abc"), observational_fraction=0.25).chosen(0, 0, 40)
    turns = chosen[chosen.any(axis=1)].argmax(axis=1)
    np.testing.assert_array_equal(turns, np.arange(30) % 3)


def test_half_is_drawn_by_lot() -> None:
    """Half of the targets, rounded up; each one about as often; another seed, other lots."""
    design = Design("half", tuple("abcde"), observational_fraction=0.0)
    chosen = design.chosen(1, 0, 1000)
    assert set(chosen.sum(axis=1)) == {3}
    assert np.all(np.abs(chosen.mean(axis=0) - 0.6) < 0.06)  # four standard errors
    assert not np.array_equal(chosen, design.chosen(2, 0, 1000))


@pytest.mark.parametrize("name", ["observational", "single", "all", "half"])
def test_an_episode_does_not_know_how_many_there_are(name: str) -> None:
    """Episode i is the same in a part as in the whole."""
    design = Design(
        name, () if name == "observational" else tuple("abcd"), observational_fraction=0.3
    )
    np.testing.assert_array_equal(design.chosen(5, 0, 90)[37:61], design.chosen(5, 37, 24))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("sigle", ("a",)), "did you mean 'single'"),
        (("single", ()), "targets cannot be"),
        (("observational", ("a",)), "none with 'observational'"),
        (("all", ("a", "a")), "each of them once"),
        (("all", ("a",), "C"), "it can be: A, B"),
        (("all", ("a", "b"), {"a": "A"}), "a source for 'b'"),
        (("all", ("a",), "A", 1.5), "from 0 on to 1"),
    ],
)
def test_designs_that_mean_nothing_are_refused(arguments: Any, message: str) -> None:
    """The error says what there is."""
    with pytest.raises(UnknownOption, match=message):
        Design(*arguments)


# --- models -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["single", "half"])
def test_a_row_is_that_of_the_mutilated_model(name: str) -> None:
    """Row i is what ``do`` and ``draw`` give for episode i, bit for bit."""
    values = {"x": Normal(9.0, 1.0), "y": Shift(100.0), "z": "A"}
    found = collect(model(), Design(name, ("x", "y", "z"), values), 30, seed=4)
    for row in range(30):
        plan = found.regimes[found.regime[row]].plan.at_start()
        alone = model().do(plan).draw(1, seed=4, first=row)
        assert [alone[n][0] for n in ("x", "y", "z")] == found.values[row].tolist()


def test_a_lagged_model_is_solved_step_by_step() -> None:
    """Its rows are those of ``draw``, one for each control step."""
    drift = SCM(
        [
            Derived(
                name="x",
                parents=(Parent("x", 1),),
                mechanism=Linear(weights=(0.9,)),
                noise=Normal(),
            ),
            Derived(
                name="y",
                parents=(Parent("x", 1),),
                mechanism=Linear(weights=(1.0,)),
                noise=Normal(),
            ),
        ]
    )
    found = collect(
        drift, Design("all", ("x",), 3.0, observational_fraction=0.5), 4, seed=1, steps=6
    )
    assert found.step.tolist() == [0, 1, 2, 3, 4, 5] * 4
    seen, done = drift.draw(4, seed=1, steps=6), drift.do({"x": 3.0}).draw(4, seed=1, steps=6)
    for episode in range(4):
        rows = (seen, done)[episode % 2]
        np.testing.assert_array_equal(found["y"].reshape(4, 6)[episode], rows["y"][episode])
    with pytest.raises(ModelError, match="lagged edges"):
        collect(drift, Design(), 4)


def test_interventions_that_close_a_cycle_happen_in_different_episodes() -> None:
    """Each of them is possible; only together they close a cycle."""
    follows = {n: Box(Affine(parent=m), 99.0) for n, m in (("x", "y"), ("y", "x"))}
    pair = SCM([Exogenous(name=n, distribution=Box(0.0, 1.0)) for n in ("x", "y")])
    found = collect(pair, Design("single", ("x", "y"), follows, observational_fraction=0.0), 4)
    x, y = found.values[:2].T
    assert x[0] > y[0]
    assert y[1] > x[1]
    with pytest.raises(InterventionError, match=r"4 of 4 episodes were refused.*cycle"):
        collect(pair, Design("all", ("x", "y"), follows, 0.0), 4)


def test_a_model_takes_no_policy() -> None:
    """What belongs to worlds is refused, not ignored."""
    with pytest.raises(UnknownOption, match="circumstance of a model"):
        collect(model(), Design(), 2, policy="random")
    with pytest.raises(UnknownOption, match="of type SCM"):
        collect("pushing", Design(), 2)  # type: ignore[arg-type]


# --- worlds -----------------------------------------------------------------------------------


def test_a_row_of_a_world_is_its_episode(world: World) -> None:
    """Causes as they were set, outcomes as they ended."""
    design = Design("all", (MASS,), "B", observational_fraction=0.5)
    outcomes = ["fractional_success", Outcome("tool_block.cartesian_position", "change", 1)]
    found = collect(world, design, 4, seed=2, steps=3, causes=[FRICTION], outcomes=outcomes)
    assert found.names == (
        FRICTION,
        MASS,
        "fractional_success",
        "change tool_block.cartesian_position[1]",
    )
    for row in range(4):
        do = {MASS: Draw("B")} if row % 2 else {}
        episode = world.rollout("random", seed=2, episode=row, steps=3, do=do)
        want = [episode.final(FRICTION), episode.final(MASS), episode.final("fractional_success")]
        assert found.values[row, :3].tolist() == [float(value) for value in want]
    assert found.targeted[:, 1].tolist() == [False, True] * 2
    assert found.columns[1].unit == "kg"


def test_order_shards_and_workers_do_not_matter(world: World) -> None:
    """The same rows come out of one shard and one worker as of many."""
    design = Design("half", (MASS, FRICTION, "gravity"))
    how: Any = {"steps": 2, "nature": {"sensor_noise": 0.01, "tool_block.friction": "A"}}
    whole = collect(world, design, 12, seed=1, **how)
    assert collect(world, design, 12, seed=1, shard=5, workers=2, **how) == whole
    assert collect(world, design, 7, seed=1, **how) == whole.first(7)
    with pytest.raises(UnknownOption, match="any whole number from"):
        whole.first(-1)
    with pytest.raises(UnknownOption, match="at most 512,000,000 in files"):
        collect(world, design, 10**30)
    assert collect(world, design, 12, seed=2, **how) != whole


@pytest.mark.parametrize("most", [512, 3])
def test_whole_batches_are_single_episodes(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Acts in mid-episode, draws and refusals, read as arrays, are what each rollout says."""
    few = Capabilities(physics=False, scenes=most)
    monkeypatch.setattr("scm_world.backends.fake.FakeBackend.capabilities", few)
    late = {"gravity": Hard([0, 0, -5.0], at=3), FRICTION: Shift(0.05, during=(2, 4))}
    given, place = World("pushing", backend="fake").given(late), "tool_block.cartesian_position"
    values = {MASS: "B", FRICTION: Draw("A"), place: [0.0, 0.0, 0.001], "block.size": "A"}
    design, how = Design("single", tuple(values), values, 0.2), ("sum", "mean", "max", "change")
    outcomes = ["reward", *(Outcome(place, one) for one in how), Outcome("action", "sum", 2)]
    circumstances: Any = {"steps": 6, "causes": [FRICTION, "gravity"], "outcomes": outcomes}
    found = collect(given, design, 24, seed=2, **circumstances)
    refused, rows = found.about["refused"], iter(found.values)
    for number in range(24):
        plan = design.regime(number, seed=2).plan
        if str(number) in refused:
            assert place in plan
            with pytest.raises(InterventionError) as error:
                given.rollout("random", seed=2, episode=number, steps=6, do=plan)
            assert str(error.value) == refused[str(number)]
            continue
        episode = given.rollout("random", seed=2, episode=number, steps=6, do=plan)
        there = episode[place]
        summed, mean, most_of = there[1:].sum(axis=0), there[1:].mean(axis=0), there[1:].max(axis=0)
        begun = [episode[name][0] for name in ("gravity", FRICTION, MASS)]
        begun += [there[0], episode["block.size"][0], episode["reward"][-1]]
        ends = [summed, mean, most_of, there[-1] - there[0], episode["action"][:-1, 2].sum()]
        assert next(rows).tolist() == np.concatenate([*map(np.ravel, [*begun, *ends])]).tolist()
    assert len(refused) == 5
    for shard in (7, 5):
        files: Any = {"shard": shard, **circumstances}
        assert collect(given, design, 24, seed=2, **files) == found
        parts = [*collect_parts(given, design, 24, seed=2, **files)]
        assert [len(np.unique(part.episode)) <= shard for part in parts] == [True] * len(parts)
        whole = Dataset.joined([replace(part, about={}) for part in parts])
        assert whole == replace(found, about={})
        listed = [number for part in parts for number in part.about.get("refused", ())]
        assert sorted(listed, key=int) == sorted(refused, key=int)


def test_instants_have_the_action_of_their_step(world: World) -> None:
    """Row t has the world as it is when action t is chosen, and action t."""
    names = ["joint_positions", "fractional_success"]
    found = collect(
        world, Design(), 2, seed=3, steps=4, every_step=True, causes=[MASS], outcomes=names
    )
    assert found.is_temporal
    assert found.variables == (MASS, *names, "action")
    for number in range(2):
        episode = world.rollout("random", seed=3, episode=number, steps=4)
        rows = found.rows(found.episode == number)
        np.testing.assert_array_equal(rows["action"], episode.actions)
        np.testing.assert_array_equal(rows["joint_positions"], episode["joint_positions"][:-1])
        assert rows.step.tolist() == [0, 1, 2, 3]
    with pytest.raises(UnknownOption, match="every_step"):
        collect(world, Design(), 2, every_step=True, outcomes=[Outcome("reward", "sum")])


def test_a_state_is_a_target_at_its_instant_only(world: World) -> None:
    """A parameter stays set; where a block was put counts for the first row."""
    place = "tool_block.cylindrical_position"
    values = {MASS: 0.05, place: [0.05, 0.1, 0.0325]}
    design = Design("all", (MASS, place), values, observational_fraction=0.0)
    found = collect(
        world, design, 1, steps=3, every_step=True, outcomes=["tool_block.cartesian_position"]
    )
    assert found.targeted[:, found.names.index(MASS)].all()
    for name in (place, "tool_block.cartesian_position"):
        first = found.targeted[:, found.names.index(f"{name}[0]")]
        assert first.tolist() == [True, False, False]


def test_an_action_that_is_set_is_the_one_in_the_row(world: World) -> None:
    """What the robot was told counts, not what its policy wished."""
    told = [0.1, 0.9, -1.7] * 3
    found = collect(world, Design("all", ("action",), told, 0.0), 2, steps=2, every_step=True)
    np.testing.assert_array_equal(found["action"], np.tile(told, (4, 1)))


def test_default_causes_are_physical(world: World) -> None:
    """No looks, no noise, no structure; the color of the block serves as negative control."""
    names = default_causes(world)
    assert {MASS, FRICTION, "gravity", "block.size", "tool_block.color"} <= set(names)
    assert not {"floor_color", "sensor_noise", "timestep_preset", "light_ambient"} & set(names)
    assert not any(name.startswith("camera") for name in names)
    walls = World("stacked_blocks", backend="fake")
    assert "max_level_width" in walls.model
    assert not {"max_level_width", "wall_noise"} & set(default_causes(walls))
    assert Outcome("fractional_success") in default_outcomes(world)


@pytest.mark.parametrize("pattern", ["tool_blok.*", "fractional_success"])
def test_patterns_that_name_nothing_are_refused(world: World, pattern: str) -> None:
    """A cause has to be something that can be set."""
    with pytest.raises(UnknownVariable, match=r"no variable (is named|fits)"):
        collect(world, Design(), 2, causes=[pattern])


def test_outcomes_are_plain_data(world: World) -> None:
    """A function could not be written down."""
    with pytest.raises(UnknownOption, match="outcome of a dataset"):
        collect(world, Design(), 2, outcomes=[len])


# --- sensors ----------------------------------------------------------------------------------


def test_noise_reaches_what_is_measured_and_nothing_else(world: World) -> None:
    """Parameters and actions are exact; the rest is off by the declared fraction of its range."""
    names = ["joint_positions", "control_index"]
    how: Any = {"steps": 4, "causes": [MASS], "outcomes": names, "every_step": True}
    clean = collect(world, Design(), 60, **how)
    noisy = collect(world, Design(), 60, nature={"sensor_noise": 0.01}, **how)
    for name in (MASS, "action", "control_index"):
        np.testing.assert_array_equal(noisy[name], clean[name])
    off = (noisy["joint_positions"] - clean["joint_positions"]) / (0.01 * 3.3)  # [rad], half range
    assert abs(off.mean()) < 0.1  # five standard errors of 2,160 numbers
    assert abs(off.std() - 1.0) < 0.1
    assert len(np.unique(off)) == off.size


def test_the_range_is_that_of_the_observations(world: World) -> None:
    """A sensor has the same strength here as in the environment."""
    from scm_world.discovery.data.worlds import half_range

    env = ScmWorldEnv("pushing", backend="fake", normalize_observations=False)
    env.reset(seed=0)
    vector: Any = env.observer.parts["observation"]
    for name, place in vector.layout.items():
        if world.model.declared(name).role in ("state", "readout"):
            np.testing.assert_array_equal(
                half_range(world, name),
                vector._spread[place],
            )


def test_a_mean_is_that_of_what_was_measured(world: World) -> None:
    """Noise is added at every instant, then summed up; both see the same noise."""
    how: Any = {"nature": {"sensor_noise": 0.01}, "causes": [MASS], "steps": 4}
    name = "joint_positions"
    outcomes = [Outcome(name, "first"), Outcome(name, "change"), name, Outcome(name, "mean")]
    ends = collect(world, Design(), 2, outcomes=outcomes, **how)
    every = collect(world, Design(), 2, outcomes=[name], every_step=True, **how)
    np.testing.assert_array_equal(ends[f"first {name}"], every[name][::4])
    np.testing.assert_allclose(ends[f"change {name}"], ends[name] - every[name][::4], atol=1e-15)
    inner = every[name].reshape(2, 4, 9)[:, 1:].sum(axis=1)
    np.testing.assert_allclose(ends[f"mean {name}"], (inner + ends[name]) / 4, atol=1e-15)


# --- refusals ---------------------------------------------------------------------------------


def test_refusals_of_a_world_do_not_end_it(world: World) -> None:
    """What is drawn from beyond the arena is left out, with the reason, and the rest stays."""
    place = "tool_block.cartesian_position"
    values = Box((0.0, 0.1, 0.0325), (0.3, 0.1, 0.0325))  # [m]; the arena ends at 0.24
    how: Any = {"steps": 1, "causes": [place]}
    found = collect(world, Design("all", (place,), values, 0.0), 16, shard=5, **how)
    assert 0 < len(found) < 16
    refused = found.about["refused"]
    assert sorted([*map(int, refused), *found.episode.tolist()]) == list(range(16))
    assert all("is outside" in why for why in refused.values())


def test_a_hopeless_collection_ends_with_the_reason(world: World) -> None:
    """If most episodes are refused it says why."""
    place = "tool_block.cartesian_position"
    sunk = Design("all", (place,), [0.0, 0.0, 0.0], 0.0)
    with pytest.raises(InterventionError, match=r"20 of 20 episodes were refused; .*not feasible"):
        collect(world, sunk, 40, shard=20, steps=1)


def test_what_can_never_be_is_refused_at_once(world: World) -> None:
    """Names and shapes are checked before the first episode."""
    for request in ({"tool_block.speed": 1.0}, {MASS: [1.0, 2.0]}):
        with pytest.raises(InterventionError):
            collect(world, Design("all", tuple(request), request), 2)
        with pytest.raises(InterventionError):
            collect(world, Design(), 2, nature=request)


def test_targets_may_be_patterns() -> None:
    """They mean the variables that they fit; one that fits nothing is refused."""
    world = World("reaching", backend="fake")
    names = tuple(name for name in world.model if name.endswith(".mass"))
    tables = [
        collect(world, Design("single", targets, "A", 0.0), 3, steps=1, causes=names[:1])
        for targets in (("*.mass",), names)
    ]
    assert names
    assert tables[0].regimes == tables[1].regimes
    np.testing.assert_array_equal(tables[0].values, tables[1].values)
    with pytest.raises(UnknownVariable, match="fits the pattern"):
        collect(world, Design("single", ("*.nope",), "A"), 3, steps=1)


def test_equations_are_collected_as_their_world_was_given_them() -> None:
    """Rows and truth are those of the mutilated model; a shift of the design lies above."""
    world = World(
        SCM(
            [
                Exogenous(name="a", distribution=Normal()),
                Derived(name="b", parents=("a",), mechanism=Linear(weights=(2.0,))),
                Derived(name="c", parents=("b",), mechanism=Linear(weights=(2.0,))),
            ]
        )
    ).given({"b": 1.0})
    table = collect(world, Design("single", ("b",), Shift(0.5), 0.5), 6)
    assert table.values[:, 1].tolist() == [1.0, 1.5] * 3
    assert table.truth is not None
    assert table.truth.edges == (("b", "c", 0),)
    for part in collect_parts(world, Design("single", ("b",), Shift(0.5), 0.5), 6, shard=4):
        assert part.truth == table.truth
    assert evaluate([("b", "c", 0)], world).shd == 0
    assert problem(world).truth.edges == (("b", "c", 0),)
    assert learn("paired", SystemSimulator(world)).directed == (("b", "c", 0),)
