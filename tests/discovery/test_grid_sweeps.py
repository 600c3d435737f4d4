"""Sweeps: the same units at every point of a grid, in files that are gone on with."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import scm_world
from scm_world.cli.app import app
from scm_world.cli.data import read_over
from scm_world.discovery.data import Dataset, Levels, Swept, load, sweep
from scm_world.discovery.data.sweeps import points_of
from scm_world.errors import InterventionError, UnknownOption, UnknownVariable, UnreadableFile
from scm_world.graph import SCM
from scm_world.queries import Outcome, World
from scm_world.queries.samples import difference
from scm_world.variables import (
    Action,
    Box,
    Categories,
    Derived,
    Exogenous,
    Integers,
    Linear,
    Normal,
    Parent,
)

MASS, FRICTION = "tool_block.mass", "floor_friction"
OVER = {MASS: [0.02, 0.05, 0.08], FRICTION: Levels("A", 2)}
HOW: dict[str, Any] = {"steps": 2, "seed": 5, "nature": {"gravity": "A"}, "shard": 4}
FIRST, OTHER = (f"tool_block_{number}.cartesian_position" for number in (1, 2))
SPEED = Outcome("tool_block.linear_velocity", "final", 2)


@pytest.fixture(scope="module")
def world() -> World:
    """A world without physics."""
    return World("pushing", backend="fake")


def contents(folder: Path) -> dict[str, bytes]:
    """Read every file of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- grids ----------------------------------------------------------------------------------------


def test_levels_lie_evenly_in_a_space() -> None:
    """From end to end; whole numbers stay whole, categories are all taken, unions in turn."""
    model = SCM(
        [
            Exogenous(name="x", a=Box(0.0, 1.0), b=Box(2.0, 3.0)),
            Exogenous(name="k", dtype="integer", default=1, a=Integers(1, 4)),
            Exogenous(name="g", shape=(2,), default=(0.0, 0.0), a=Box((0.0, 1.0), (2.0, 5.0))),
        ]
    )
    assert [p["x"] for p in points_of({"x": "A"}, model)] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert [p["x"] for p in points_of({"x": Levels("A|B", 3)}, model)] == [0.0, 1.0, 2.0]
    assert [p["x"] for p in points_of({"x": Box(5.0, 6.0)}, model)] == [5.0, 5.25, 5.5, 5.75, 6.0]
    assert [p["k"] for p in points_of({"k": Levels("A", 9)}, model)] == [1, 2, 3, 4]
    assert [p["k"] for p in points_of({"k": Categories((4, 2))}, model)] == [4, 2]
    assert [p["g"] for p in points_of({"g": Levels("A", 2)}, model)] == [[0.0, 1.0], [2.0, 5.0]]


def test_a_grid_is_every_combination(world: World) -> None:
    """The last variable varies fastest."""
    points = points_of(OVER, world.model)
    assert len(points) == 6
    assert [point[MASS] for point in points] == [0.02, 0.02, 0.05, 0.05, 0.08, 0.08]
    low, high = (float(end) for end in world.model.declared(FRICTION).a.bounds((), {}))
    assert [point[FRICTION] for point in points] == [low, high] * 3


@pytest.mark.parametrize(
    ("over", "said"),
    [
        ({}, "one variable or more"),
        ({MASS: []}, "values of tool_block.mass"),
        ({MASS: [0.02, 0.02]}, "each of them once"),
        ({MASS: 0.02}, "Levels"),
        ({MASS: "C"}, "A, B, A|B, values"),
        ({MASS: Levels("A", 0)}, "levels of tool_block.mass"),
        ({"tool_block.cylindrical_position": "A"}, "a space with ends of its own"),
        ({"tool_block.type": "A"}, "cannot be 'A'; it can be: values, as it has"),
        ({MASS: Levels("A", 10**12)}, "levels of tool_block.mass cannot be 1000000000000"),
        ({MASS: Levels("A", 400), FRICTION: Levels("A", 400)}, "160000; it can be: at most"),
    ],
)
def test_grids_without_values_are_refused(over: Any, said: str, world: World) -> None:
    """With what can be given."""
    with pytest.raises(UnknownOption) as caught:
        sweep(world, over, n=1, steps=1)
    assert said in str(caught.value)


def test_what_is_no_world_is_refused() -> None:
    """Its name is none: an evaluation takes that, a sweep does not."""
    with pytest.raises(UnknownOption, match="system cannot be 'pushing'"):
        sweep("pushing", OVER, n=1)  # type: ignore[arg-type] # it is none


def test_no_column_comes_twice(world: World) -> None:
    """What is set is written down already; it is told before any episode."""
    with pytest.raises(UnknownOption, match=rf"outcomes cannot be '{MASS}'"):
        sweep(world, OVER, [MASS], n=10**9)


def test_variables_of_a_grid_can_be_set(world: World) -> None:
    """Typos and impossible values are told before any episode."""
    with pytest.raises(UnknownVariable, match=r"tool_block\.mass"):
        sweep(world, {"tool_blok.mass": [1.0]}, n=1)
    with pytest.raises(InterventionError, match="do"):
        sweep(world, {MASS: [-1.0]}, n=1)


# --- what comes out -------------------------------------------------------------------------------


def test_every_point_has_the_same_units(world: World) -> None:
    """Unit i of a point is what a world gives in which that is done."""
    found = sweep(world, OVER, [SPEED, "gravity"], n=3, **HOW)
    for place, point in enumerate(found.points):
        assert found.units(place).tolist() == [0, 1, 2]
        told = world.sample(3, point, outcomes=[SPEED], steps=2, seed=5, nature=HOW["nature"])
        name = found.measured[0].name
        assert found.values(place, name).tolist() == next(iter(told.values())).tolist()
        falls = [found.values(at, "gravity[2]").tolist() for at in (place, 0)]
        assert falls[0] == falls[1]
    assert len(set(found.values(0, "gravity[2]"))) == 3


def test_a_causal_model_is_swept() -> None:
    """Its units are those of ``sample``; an action has its value after the first step."""
    model = scm_world.SCM(
        [
            Exogenous(name="x", distribution=Normal(), a=Box(0.0, 1.0)),
            Action(name="push", bounds=Box(-1.0, 1.0)),
            Derived(
                name="y",
                parents=("x", Parent("push", 1), Parent("y", 1)),
                mechanism=Linear(weights=(2.0, 1.0, 0.5)),
                noise=Normal(),
            ),
        ]
    )
    how: dict[str, Any] = {"steps": 3, "seed": 2, "policy": "random", "nature": {"x": "A"}}
    over = {"push": [-0.5, 0.5]}
    found = sweep(model, over, n=4, **how)
    for place, point in enumerate(found.points):
        told = model.sample(4, point, **how)
        assert {c.name for c in found.measured} == {"x", "y"}
        for column in found.measured:
            assert found.values(place, column.name).tolist() == told[column.name].tolist()
    assert [row["push"] for row in found.rows()] == over["push"]
    assert set(found.data["push"].tolist()) == {-0.5, 0.5}


def test_the_table_has_means_and_intervals(world: World) -> None:
    """Of each point, and of the paired difference to the first one."""
    found = sweep(world, OVER, [SPEED], n=4, **HOW)
    rows, name = found.rows(), found.measured[0].name
    assert len(rows) == 6
    assert [(row["n"], row["refused"]) for row in rows] == [(4, 0)] * 6
    values, first = found.values(3, name), found.values(0, name)
    alone = difference(values, np.zeros(4), paired=True)[:3]
    apart = difference(values, first, paired=True)[:3]
    for about, ends in (("", alone), (".change", apart)):
        found_ends = [rows[3][f"{name}{about}{end}"] for end in ("", ".low", ".high")]
        assert found_ends == [None if np.isnan(end) else float(end) for end in ends]
    assert rows[0][f"{name}.change"] == 0.0
    assert rows[0][f"{name}.change.low"] is None  # nothing differs from itself


def test_one_unit_has_no_interval(world: World) -> None:
    """What nobody knows is None."""
    row = sweep(world, {MASS: [0.02]}, ["reward"], n=1, steps=1).rows()[0]
    assert (row["reward.low"], row["reward.change.high"]) == (None, None)
    assert isinstance(row["reward"], float)


def test_refused_units_are_left_out_of_pairs() -> None:
    """A point at which a unit was impossible is compared in the others."""
    values = [[0.0, 1.0], [1.0, 4.0], [0.0, 50.0], [0.0, 3.0], [1.0, 8.0]]
    data = Dataset.of(values, ["x", "y"], episode=[0, 1, 2, 4, 5], refused={"3": "too large"})
    found = Swept(({"x": 0.0}, {"x": 1.0}), data)
    assert found.units(1).tolist() == [0, 2]
    one, other = found.rows()
    assert [(row["n"], row["refused"]) for row in (one, other)] == [(3, 0), (2, 1)]
    assert (one["y"], other["y"], other["y.change"]) == (18.0, 6.0, 4.0)


def test_impossible_points_side_by_side_are_told_in_the_table() -> None:
    """Some of a grid, all in its first shard: they are less than half, and the rest is measured."""
    inside, beside = np.linspace(0.0, 0.03, 20), np.linspace(0.07, 0.09, 21)
    places = [[x, 0.0, 0.0325] for x in (*inside, *beside)]
    with World("stacking2", backend="fake").given({FIRST: places[0]}) as world:
        found = sweep(world, {OTHER: places}, ["reward"], n=1, steps=1, shard=20)
        assert [row["refused"] for row in found.rows()] == [1] * 20 + [0] * 21
        with pytest.raises(InterventionError, match="20 of 20 episodes were refused"):
            sweep(world, {OTHER: places[:20]}, ["reward"], n=1, steps=1, shard=10)
        most = [*places[:20], *places[20:39]]
        with pytest.raises(InterventionError, match="20 of 39 episodes were refused"):
            sweep(world, {OTHER: most}, ["reward"], n=1, steps=1, shard=20)


def test_what_is_given_to_the_world_holds_everywhere(world: World) -> None:
    """The sweep varies something else beside it."""
    with world.given({"gravity": [0.0, 0.0, -5.0]}) as light:
        found = sweep(light, {MASS: [0.02, 0.08]}, ["gravity"], n=2, steps=1)
    assert found.data["gravity[2]"].tolist() == [-5.0] * 4


# --- files ----------------------------------------------------------------------------------------


def test_a_folder_holds_the_table_and_the_episodes(world: World, tmp_path: Path) -> None:
    """The table is a CSV; the episodes are a dataset with regimes."""
    found = sweep(world, OVER, [SPEED], n=3, out=tmp_path, **HOW)
    with (tmp_path / "sweep.csv").open(newline="") as stream:
        table = list(csv.DictReader(stream))
    cells = [{k: float(cell) if cell else None for k, cell in row.items()} for row in table]
    assert cells == found.rows()
    data = load(tmp_path)
    assert data == found.data
    assert {data.regimes[i].targets for i in data.regime} == {tuple(sorted((MASS, FRICTION)))}
    assert data[MASS].tolist() == [found.points[k % 6][MASS] for k in data.episode]


@pytest.mark.parametrize("after", [1, 7, 17])
def test_an_interrupted_sweep_goes_on(after: int, world: World, tmp_path: Path) -> None:
    """The files are in the end the same, byte for byte; what was whole is not made again."""
    whole, out = tmp_path / "whole", tmp_path / "out"

    def interrupt(done: int, planned: int) -> None:
        if done >= after:
            raise KeyboardInterrupt

    sweep(world, OVER, [SPEED], n=3, out=whole, **HOW)
    with pytest.raises(KeyboardInterrupt):
        sweep(world, OVER, [SPEED], n=3, out=out, progress=interrupt, **HOW)
    assert not (out / "sweep.csv").exists()
    assert len(list(out.glob("shard-*"))) == -(-after // 4)
    sweep(world, OVER, [SPEED], n=3, out=out, **HOW)
    assert contents(out) == contents(whole)


def test_a_sweep_can_have_more_units(world: World, tmp_path: Path) -> None:
    """But not other points: that is another one."""
    sweep(world, OVER, [SPEED], n=2, out=tmp_path, **HOW)
    more = sweep(world, OVER, [SPEED], n=4, out=tmp_path, **HOW)
    assert more.rows() == sweep(world, OVER, [SPEED], n=4, **HOW).rows()
    with pytest.raises(UnreadableFile, match=r"differ: .*design"):
        sweep(world, {MASS: [0.02]}, [SPEED], n=4, out=tmp_path, **HOW)


def test_workers_change_nothing(world: World, tmp_path: Path) -> None:
    """Two processes write the files that one does."""
    for name, workers in (("one", 1), ("two", 2)):
        sweep(world, OVER, [SPEED], n=3, out=tmp_path / name, workers=workers, **HOW)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_what_other_processes_cannot_have_is_refused(world: World, tmp_path: Path) -> None:
    """A policy without a name."""
    with pytest.raises(UnknownOption, match="work cannot be"):
        sweep(world, OVER, n=1, policy=lambda world: np.zeros(9), workers=2)


# --- the command ----------------------------------------------------------------------------------

COMMAND = ["sweep", "pushing", "--backend", "fake", "--steps", "2", "-n", "3"]


def test_the_command_sweeps(tmp_path: Path) -> None:
    """It says where it works, and prints a row for each point."""
    given = ["--over", f"{MASS}=0.02:0.08:3", "--over", f"{FRICTION}=A:2", "--outcome", "reward"]
    done = CliRunner().invoke(
        app, [*COMMAND, *given, "--do", "gravity=0,0,-5", "--out", str(tmp_path)]
    )
    assert done.exit_code == 0, done.output
    assert "the work is done in this process" in done.output
    assert "0.05" in done.output
    assert "written:" in done.output
    world = World("pushing", backend="fake")
    with world.given({"gravity": [0.0, 0.0, -5.0]}) as light:
        over = {MASS: [0.02, 0.05, 0.08], FRICTION: Levels("A", 2)}
        found = sweep(light, over, ["reward"], n=3, steps=2)
    assert load(tmp_path).values.tolist() == found.data.values.tolist()


@pytest.mark.parametrize(
    "wrong",
    [
        ["--over", "tool_block.mass"],
        ["--over", "tool_block.mass=1:2"],
        ["--over", "tool_block.mass=A:0"],
        ["--over", "tool_block.mass=0:1:1000000000000"],
        ["--over", "tool_block.mass=shift:1"],
        ["--over", "tool_block.mass=1", "--over", "tool_block.mass=2"],
        ["--over", "tool_blok.mass=1"],
        ["--over", "tool_block.mass=A", "--engine", "dask"],
        ["--over", "tool_block.mass=A", "--engine", "serial", "--workers", "2"],
        ["--over", "tool_block.mass=A", "--address", "auto"],
    ],
)
def test_the_command_refuses_what_it_cannot_read(wrong: list[str], tmp_path: Path) -> None:
    """With exit code 2, and no folder."""
    done = CliRunner().invoke(app, [*COMMAND, *wrong, "--out", str(tmp_path / "new")])
    assert done.exit_code == 2, done.output
    assert not (tmp_path / "new").exists()


def test_values_are_read() -> None:
    """Ranges, spaces, and lists; ends are met."""
    assert read_over(["x=0:1:5", "y=B", "z=A|B:3", "w=7"]) == {
        "x": [0.0, 0.25, 0.5, 0.75, 1.0],
        "y": Levels("B"),
        "z": Levels("A|B", 3),
        "w": [7],
    }
