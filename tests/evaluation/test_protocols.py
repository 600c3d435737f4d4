"""Facts about protocols: which variables move, and where they are drawn from."""

from __future__ import annotations

import itertools
import json
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.env import ScmWorldEnv
from scm_world.evaluation import Protocol, protocols_of
from scm_world.evaluation.episodes import Row, ScoreHook, scored_episode, under
from scm_world.evaluation.protocols import REACHING as REACHING_ROW
from scm_world.evaluation.protocols import ROLES, ROWS
from scm_world.policies.agents import as_agent
from scm_world.tasks import TASKS
from scm_world.tasks.trifinger.entities.block_world import overlaps

TWELVE = [f"P{k}" for k in range(12)]
CONVENTIONS = ("causal_world", "scm_world")
FIVE = ("reaching", "pushing", "picking", "pick_and_place", "stacking2")
PI = np.pi
LINKS = [f"robot_finger_{f}_link_{k}" for f in (60, 120, 300) for k in range(4)]
STAGE = {"floor_friction", "stage_friction", "floor_color", "stage_color"}
STAGE |= {f"{link}.{what}" for link in LINKS for what in ("mass", "color")}


@cache
def runner(task: str, conventions: str) -> ScmWorldEnv:
    """Make where episodes of a task begin."""
    return ScmWorldEnv(task, backend="fake", conventions=conventions)


def named(task: str, name: str) -> Protocol:
    """Give a protocol of a task."""
    return {protocol.name: protocol for protocol in protocols_of(task)}[name]


def begun(
    task: str, protocol: Protocol, conventions: str, episodes: int, seed: int = 0
) -> Iterator[tuple[set[str], dict[str, Any], dict[str, Any]]]:
    """Begin episodes; what was set, and all values without and with the protocol."""
    here = runner(task, conventions)
    for episode in range(episodes):
        here.reset(seed=seed, options={"episode": episode})
        before = here.world.values()
        under(here, protocol).reset(seed=seed, options={"episode": episode})
        done = {name for _, request in here.interventions for name in request}
        yield done, before, here.world.values()


@cache
def drawn(task: str, name: str, conventions: str, n: int) -> dict[str, list[list[float]]]:
    """Draw all variables of a protocol again and again; lists of numbers by name."""
    here, found = runner(task, conventions), defaultdict[str, list[list[float]]](list)
    for episode in range(n):
        measured = ScoreHook()
        measured.begin(
            here, under(here, named(task, name)).reset(seed=0, options={"episode": episode})
        )
        for variable, value in measured.drawn.items():
            found[variable].append(value)
    return found


# --- the table ------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_all_protocols(task: str) -> None:
    """P0 to P11, and one more for reaching; each says in words what it varies."""
    found = protocols_of(task)
    assert [p.name for p in found] == [*TWELVE, "P12"] if task == "reaching" else TWELVE
    assert all(p.doc for p in found)
    assert all(Protocol.from_dict(json.loads(json.dumps(p.as_dict()))) == p for p in found)


SPACES = {"P0": "A|B", **dict.fromkeys(("P1", "P3", "P4", "P5", "P7", "P10"), "A")}
SPACES |= dict.fromkeys(("P2", "P6", "P8", "P9", "P11", "P12"), "B")
T, G = "tool_block", "goal_block"
ONE_BLOCK = {
    "P0": "",
    "P1": f"{T}.mass",
    "P2": f"{T}.mass",
    "P3": "block.size",
    "P4": f"{T}.cylindrical_position",
    "P5": f"{G}.cylindrical_position",
    "P6": f"{G}.cylindrical_position {T}.cylindrical_position",
    "P7": f"{G}.cylindrical_position {T}.cylindrical_position {T}.mass",
    "P8": f"{G}.cylindrical_position {T}.cylindrical_position {T}.mass",
    "P9": f"{G}.cylindrical_position {T}.cylindrical_position {T}.mass floor_friction",
}
"""As published; there the size of the tool block is copied to the goal."""
MASSES = "tool_block_1.mass tool_block_2.mass"
STARTS = "tool_block_1.cylindrical_position tool_block_2.cylindrical_position"
TOWER = "goal_tower.cylindrical_position"
TWO_BLOCKS = {
    "P0": "",
    "P1": MASSES,
    "P2": MASSES,
    "P4": STARTS,
    "P5": TOWER,
    "P6": f"{TOWER} {STARTS}",
    "P7": f"{TOWER} {STARTS} {MASSES}",
    "P8": f"{TOWER} {STARTS} {MASSES}",
    "P9": f"{TOWER} {STARTS} {MASSES} floor_friction",
}
"""As published; there P9 names goals that do not exist, so that the tower stays where it is."""
GOALS = " ".join(f"goal_{finger}.cylindrical_position" for finger in (60, 120, 300))
REACHING = {"P0": "", "P5": GOALS, "P12": GOALS}
PUBLISHED: dict[str, dict[str, str]] = {
    "reaching": REACHING,
    **dict.fromkeys(("pushing", "picking", "pick_and_place"), ONE_BLOCK),
    "stacking2": TWO_BLOCKS,
}
CELLS = [(task, name) for task, rows in PUBLISHED.items() for name in rows]


@pytest.mark.parametrize("conventions", CONVENTIONS)
@pytest.mark.parametrize(("task", "name"), CELLS)
def test_protocols_move_what_is_published(task: str, name: str, conventions: str) -> None:
    """They set the published variables from the published space; only descendants follow."""
    protocol = named(task, name)
    assert protocol.space == SPACES[name]
    wanted = set(PUBLISHED[task][name].split())
    model = runner(task, conventions).world.model
    follow = {name for one in wanted for name in model.descendants(model.target(one))}
    moved: set[str] = set()
    for done, before, now in begun(task, protocol, conventions, 3):
        assert done == wanted
        moved |= {n for n in now if not np.array_equal(before[n], now[n])}
    assert wanted <= moved
    assert moved <= wanted | follow | {model.target(one) for one in wanted}


BODIES = {
    "reaching": {f"goal_{f}.{what}" for f in (60, 120, 300) for what in ("color", "euler")}
    | {"number_of_obstacles"},
    "pushing": {f"{T}.mass", f"{T}.color", f"{T}.euler", f"{G}.color", f"{G}.euler"},
    "stacking2": {f"tool_block_{k}.{what}" for k in (1, 2) for what in ("mass", "color", "euler")}
    | {"goal_tower.euler", "goal_block_1.color", "goal_block_2.color"},
}
BODIES["picking"] = BODIES["pushing"]
BODIES["pick_and_place"] = BODIES["pushing"] | {"obstacle.color", "wall_side"}
SIZES = {key: {"block.size"} for key in ("pushing", "picking", "stacking2")}
SIZES |= {"reaching": set(), "pick_and_place": {"block.size", "obstacle.size"}}
POSITIONS = {
    "reaching": set(GOALS.split()),
    **{key: set(ONE_BLOCK["P6"].split()) for key in ("pushing", "picking", "pick_and_place")},
    "stacking2": set(TWO_BLOCKS["P6"].split()),
}


@pytest.mark.parametrize("name", ["P10", "P11"])
@pytest.mark.parametrize("task", FIVE)
def test_everything_is_what_is_published(task: str, name: str) -> None:
    """Everything with spaces but the joints; of sizes and positions one, by a fair coin."""
    always = STAGE | {w.replace(".euler", ".euler_orientation") for w in BODIES[task]}
    sizes = positions = 0
    for names, _, _ in begun(task, named(task, name), "causal_world", 24):
        done = {n for n in names if not n.startswith("obstacle_")}  # as many as were drawn
        if done == always | SIZES[task]:
            sizes += 1
        else:
            assert done == always | POSITIONS[task]
            positions += 1
    assert min(sizes, positions) > 4


# --- where values are drawn from ------------------------------------------------------------------

RANGES: dict[tuple[str, str, str], tuple[Any, Any]] = {
    ("pushing", "P1", f"{T}.mass"): (0.015, 0.045),
    ("pushing", "P2", f"{T}.mass"): (0.045, 0.1),
    ("pushing", "P3", "block.size"): ([0.055] * 3, [0.075] * 3),
    ("pushing", "P4", f"{T}.cylindrical_position"): ([0, -PI, 0.0325], [0.11, PI, 0.0325]),
    ("pushing", "P5", f"{G}.cylindrical_position"): ([0, -PI, 0.0325], [0.11, PI, 0.0325]),
    ("pushing", "P6", f"{T}.cylindrical_position"): ([0.11, -PI, 0.0325], [0.15, PI, 0.0325]),
    ("pushing", "P6", f"{G}.cylindrical_position"): ([0.11, -PI, 0.0325], [0.15, PI, 0.0325]),
    ("pushing", "P9", "floor_friction"): (0.6, 0.8),
    ("pushing", "P10", "robot_finger_60_link_1.mass"): (0.015, 0.045),
    ("pushing", "P10", "floor_color"): ([0.5] * 3, [1.0] * 3),
    ("pushing", "P11", "stage_color"): ([0.5] * 3, [1.0] * 3),
    ("pushing", "P11", f"{T}.euler_orientation"): ([0, 0, -PI], [0, 0, PI]),
    ("reaching", "P5", "goal_60.cylindrical_position"): ([0, -PI, 0.015], [0.11, PI, 0.15]),
    ("reaching", "P12", "goal_300.cylindrical_position"): ([0.11, -PI, 0.015], [0.15, PI, 0.3]),
    ("picking", "P4", f"{T}.cylindrical_position"): ([0, -PI, 0.0325], [0.11, PI, 0.15]),
    ("picking", "P5", f"{G}.cylindrical_position"): ([0, -PI, 0.08], [0.11, PI, 0.2]),
    ("picking", "P6", f"{G}.cylindrical_position"): ([0.11, -PI, 0.2], [0.15, PI, 0.25]),
    ("pick_and_place", "P6", f"{T}.cylindrical_position"): (
        [0.12, -PI * 5 / 6, 0.0325],
        [0.15, -PI / 6, 0.0325],
    ),
    ("pick_and_place", "P5", f"{G}.cylindrical_position"): (
        [0.07, PI / 6, 0.0325],
        [0.12, PI * 5 / 6, 0.0325],
    ),
    ("stacking2", "P5", TOWER): ([0, -PI, 0.065], [0.11, PI, 0.065]),
    ("stacking2", "P6", "tool_block_2.cylindrical_position"): (
        [0.11, -PI, 0.0325],
        [0.15, PI, 0.3],
    ),
}
"""The published spaces; in pick and place on the sides where block and goal are by default."""


@pytest.mark.parametrize(
    ("task", "name", "variable"), [pytest.param(*cell, id="-".join(cell)) for cell in RANGES]
)
def test_draws_fill_the_published_ranges(task: str, name: str, variable: str) -> None:
    """All draws lie inside, come near both ends, and are uniform.

    Of two blocks in the air those that would be in one another, or in a finger, are drawn again.
    """
    n = 100
    values = np.array(drawn(task, name, "causal_world", n)[variable])
    low, high = (np.broadcast_to(end, values.shape[1:]) for end in RANGES[task, name, variable])
    if task == "picking" and variable == "goal_block.cylindrical_position":
        # Whatever is drawn is put above the centre: only the height has the published range.
        assert np.all(values[:, :2] == 0.0)
        values, low, high = values[:, 2:], low[2:], high[2:]
    assert len(values) >= n
    assert np.all(values >= low - 1e-12)
    assert np.all(values <= high + 1e-12)
    width = high - low
    near = 0.06 * width
    assert np.all(values.min(axis=0) <= low + near)
    assert np.all(values.max(axis=0) >= high - near)
    if task == "stacking2" and variable.startswith("tool"):
        return
    moves = width > 0
    share = np.sort((values[:, moves] - low[moves]) / width[moves], axis=0)
    steps = np.arange(1, len(values) + 1)[:, None] / len(values)
    apart = np.maximum(steps - share, share - (steps - 1 / len(values))).max(axis=0)
    # Kolmogorov and Smirnov: beyond this once in a thousand columns
    assert np.all(apart < 1.95 / np.sqrt(len(values)))


@pytest.mark.parametrize("task", TASKS)
def test_draws_lie_in_their_space(task: str) -> None:
    """Whatever a protocol draws lies in the space that it names, in every task."""
    for protocol in protocols_of(task)[1:]:
        few = 1 if task == "towers" and protocol.name == "P11" else 2  # up to 216 blocks
        for done, _, now in begun(task, protocol, "scm_world", few):
            model = runner(task, "scm_world").world.model
            for name in done - {"wall_pattern"}:
                variable = model.declared(name)
                assert variable.in_space(now[name], protocol.space, now), (protocol.name, name)
                if variable.dtype != "real":
                    assert np.all(now[name] == np.round(now[name]))


@pytest.mark.parametrize(
    ("task", "name", "variable", "values"),
    [
        ("towers", "P10", "number_of_blocks_in_tower", {1, 2, 3, 4}),
        ("general", "P10", "nums_objects", {1, 2, 3, 4, 5}),
        ("general", "P11", "nums_objects", {6, 7, 8, 9}),
        ("reaching", "P3", "number_of_obstacles", {1, 2, 3, 4, 5}),
    ],
)
def test_d25_numbers_of_bodies_are_whole(
    task: str, name: str, variable: str, values: set[int]
) -> None:
    """Each whole number comes, none between them, and the scene has that many."""
    number = Protocol(name, variable, named(task, name).space)
    found: set[float] = set()
    for _, _, now in begun(task, number, "scm_world", 30):
        found |= set(np.ravel(now[variable]).tolist())
        if task == "general":
            tools = [n for n in now if n.startswith("tool_") and n.endswith(".mass")]
            assert len(tools) == now[variable]
    assert found == values
    assert any(variable in done for done, _, _ in begun(task, named(task, name), "scm_world", 1))


# --- defects of the predecessor -------------------------------------------------------------------


@pytest.mark.parametrize("conventions", CONVENTIONS)
@pytest.mark.parametrize("name", ["P4", "P5", "P6", "P7", "P8", "P9", "P10", "P11"])
def test_d20_the_wall_is_between_block_and_goal(name: str, conventions: str) -> None:
    """In every protocol of pick and place, whichever of them is drawn."""
    for _, _, now in begun("pick_and_place", named("pick_and_place", name), conventions, 10):
        block, goal = (now[f"{body}.cartesian_position"][1] for body in (T, G))
        assert block * goal < 0.0


@pytest.mark.parametrize("conventions", CONVENTIONS)
def test_d21_goals_across_the_wall_are_drawn_alone(conventions: str) -> None:
    """P5 draws goals in A without touching the block; draws in B succeed every time."""
    goal = f"{G}.cylindrical_position"
    for space, (low, high) in {"A": (0.07, 0.12), "B": (0.12, 0.15)}.items():
        found = [
            now[goal]
            for done, before, now in begun(
                "pick_and_place", Protocol("goals", goal, space), conventions, 40
            )
            if done == {goal}
            and np.array_equal(now[f"{T}.orientation"], before[f"{T}.orientation"])
        ]
        assert len({tuple(value) for value in found}) == 40
        assert all(low <= value[0] <= high for value in found)


@pytest.mark.parametrize("task", ["picking", "pushing", "general"])
def test_d22_protocols_leave_no_trace(task: str) -> None:
    """The same episodes come out whichever protocols ran before."""
    names = ("P3", "P6", "P10", "P11")

    def run(order: Any) -> dict[tuple[str, int], Row]:
        here = ScmWorldEnv(task, backend="fake", max_episode_length=2)
        player = as_agent("still")
        return {
            (name, episode): scored_episode(
                here, player, named(task, name), seed=1, episode=episode
            )
            for name in order
            for episode in range(2)
        }

    assert run(names) == run((names[1], names[3], names[0], names[2]))


SMALL = {"stacked_blocks": {"num_of_levels": 2}, "creative_stacked_blocks": {"num_of_levels": 3}}


@pytest.mark.parametrize("task", TASKS)
def test_d27_no_two_bodies_are_in_one_place(task: str) -> None:
    """In no protocol of any task a body begins inside of another one; goals may be anywhere."""
    here = ScmWorldEnv(task, backend="fake", task_options=SMALL.get(task))
    for protocol in protocols_of(task):
        if task == "towers" and protocol.name == "P11":
            continue  # hundreds of blocks: the same draws are checked in test_towers
        for episode in range(2):
            under(here, protocol).reset(seed=3, options={"episode": episode})
            assert overlaps(here.world.scene(), tolerance=1e-3) == ()  # as is allowed


def test_pairs_of_protocols_share_no_draws() -> None:
    """Two protocols that draw one variable from one space have noises of their own."""
    tables = {
        name: np.array(drawn("pushing", name, "scm_world", 20)[f"{T}.cylindrical_position"])
        for name in ("P6", "P8", "P9")
    }
    for one, other in itertools.combinations(tables.values(), 2):
        assert np.all(one[:, 0] != other[:, 0])


def test_the_tables_of_the_documentation_are_true() -> None:
    """``docs/evaluation.md`` lists every protocol and every variable as the code has them."""
    text = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text()
    rows = re.findall(r"^\| (P\d+).*? \| (.*?) \| (A\\\|B|A|B) \|$", text, re.MULTILINE)
    wanted = [
        (name, ", ".join(what.split()) or "nothing", space.replace("|", "\\|"))
        for name, what, space in (*ROWS, REACHING_ROW)
    ]
    assert rows == wanted
    parts = re.findall(r"^\| (\w+) \| `(.*)` \| `(.*)` \| `(.*)` \| (.*) \|$", text, re.MULTILINE)
    assert [part[0] for part in parts] == [*TASKS]
    for task, mass, size, tool, goal in parts:
        roles = ROLES[task]
        assert (mass, size, tool) == (roles["mass"], roles["size"], roles["tool"])
        assert goal == (f"`{roles['goal']}`" if "goal" in roles else goal.strip("`"))
