"""Local causal graphs: which edges hold in one control step."""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Callable

import numpy as np
import pytest

from scm_world.errors import NotReset
from scm_world.queries import World
from scm_world.queries.local import contact_terms, contacts_of, holds
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import inverse

NEEDS_BULLET = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)
ENGINES = ["mujoco", pytest.param("bullet", marks=NEEDS_BULLET)]
ROBOT, ONE, TWO = "joint_velocities", "tool_block_1", "tool_block_2"
STATES = {ROBOT: ROBOT, **{f"{one}.linear_velocity": one for one in (ONE, TWO)}}
TIP = hardware.COLLISION["tip"].radius  # [m]
HALF = 0.0325  # [m] of a block's edge

_WORLDS: dict[str, World] = {}


def begin(engine: str) -> World:
    """Give a world with two blocks at the start of an episode."""
    if engine not in _WORLDS:
        mode = "end_effector_positions"
        _WORLDS[engine] = World("stacking2", backend=engine, action_mode=mode)
    _WORLDS[engine].reset(seed=0)
    return _WORLDS[engine]


def place(world: World, tip: np.ndarray, one: list[float], two: list[float]) -> np.ndarray:
    """Put the first fingertip and both blocks somewhere, the other fingers out of the way.

    Returns:
        The fingertip positions, shape (9,).
    """
    tips = world["end_effector_positions"].reshape(3, 3).copy()
    tips[0] = tip
    joints = inverse(tips.ravel(), float(world["robot_height"]), np.array(hardware.REST))
    world.do(
        {
            "joint_positions": joints.joint_positions,
            f"{ONE}.cartesian_position": one,
            f"{TWO}.cartesian_position": two,
        }
    )
    return tips.ravel()


def among(*bodies: str) -> set[tuple[str, str]]:
    """List all edges among some bodies."""
    return set(itertools.permutations(bodies, 2))


def pushed(world: World) -> np.ndarray:
    """Let the first finger push the first block; the other lies elsewhere."""
    near = np.array([0.0, HALF + TIP + 3e-4, HALF])
    return place(world, near, [0.0, 0.0, HALF], [0.0, -0.16, HALF])


def stacked(world: World) -> np.ndarray:
    """Stand one block on the other."""
    world.do({f"{ONE}.cartesian_position": [0, 0, HALF]})
    world.do({f"{TWO}.cartesian_position": [0, 0, 3 * HALF]})
    return world["end_effector_positions"]


def alone(world: World) -> np.ndarray:
    """Let one block fall, while the other stands far from it."""
    away = {f"{ONE}.cartesian_position": [0.0, -0.14, HALF]}
    world.do({f"{TWO}.cartesian_position": [0.0, 0.0, 0.2], **away})
    return world["end_effector_positions"]


def chained(world: World) -> np.ndarray:
    """Let the first finger push the first block, and that one the second."""
    near = np.array([0.0, HALF + TIP + 3e-4, HALF])
    return place(world, near, [0.0, 0.0, HALF], [0.0, -2 * HALF - 3e-4, HALF])


def onward(tips: np.ndarray, steps: int) -> list[np.ndarray]:
    """List actions that move the first finger at 10 cm/s, so that it stays with what it pushes."""
    return [tips - np.array([0.0, 0.004 * (t + 1), *[0.0] * 7]) for t in range(steps)]


SCENES = {
    pushed: among(ROBOT, ONE),
    stacked: among(ONE, TWO),
    alone: set(),
    chained: among(ROBOT, ONE, TWO),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.__name__)
def test_hand_made_scenes(engine: str, scene: Callable[[World], np.ndarray]) -> None:
    """Contacts say what anyone sees; what stands still passes nothing on."""
    world = begin(engine)
    *actions, action = onward(scene(world), 4)
    for earlier in actions:
        world.step(earlier)
    graph = world.local_graph(action)
    found = {(STATES[a], STATES[b]) for a, b in graph.edges() if {a, b} <= STATES.keys() and a != b}
    assert found == SCENES[scene]
    assert graph.has_edge("floor_friction", f"{TWO}.linear_velocity") == (scene is not alone)
    before, ends = world.snapshot(), list[np.ndarray]()
    for friction in (0.3, 0.6):  # what an intervention changes is an edge that holds
        world.restore(before)
        world.do({"finger_friction": friction})
        world.step(action)
        ends.append(np.concatenate([world[name] for name in STATES]))
    acts = {name: graph.has_edge("finger_friction", name) for name in STATES}
    changed = np.repeat([*acts.values()], [world[name].size for name in STATES])
    assert ((ends[0] == ends[1]) | changed).all()
    assert acts == {name: scene in (pushed, chained) and ("2" not in name or scene is chained)
                    for name in STATES}  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES)
def test_asking_changes_nothing(engine: str) -> None:
    """The world goes on bit for bit as if nobody had asked, and lists the same contacts."""
    futures = []
    for asked in (False, True):
        world = begin(engine)
        action = onward(chained(world), 1)[0]
        world.step(action)
        before = world.values()
        touching = [(c.bodies, c.depth, c.force) for c in world.backend.contacts()]
        if asked:
            world.local_graph()
            world.local_graph(action)
            now = world.values()
            assert all(before[name].tobytes() == now[name].tobytes() for name in now)
        world.do({f"{TWO}.mass": 0.05})
        later = [(c.bodies, c.depth, c.force) for c in world.backend.contacts()]
        assert later == touching
        for _ in range(3):
            world.step(action)
        futures.append(world.vector.tobytes())
    assert futures[0] == futures[1]


def test_what_cannot_be_asked() -> None:
    """There must be an episode."""
    with pytest.raises(NotReset):
        World("pushing").local_graph()


# --- conditions of edges --------------------------------------------------------------------------

SCENE = """<mujoco><option timestep="0.004"/><worldbody>
  <geom name="floor" type="plane" size="5 5 1"/>
  <body name="shelf" pos="2 0 .3"><geom name="top" type="box" size=".3 .3 .02"/></body>
  <body name="box" pos="0 0 .05"><freejoint/><geom type="box" size=".05 .05 .05" mass="1"/></body>
  <body name="ball" pos=".02 0 .18"><freejoint/><geom name="skin" size=".05" mass="1"/></body>
  <body name="other" pos="2 0 .4"><freejoint/><geom type="box" size=".05 .05 .05" mass="1"/></body>
  <body name="base" pos="-1 0 .5"><body name="arm"><joint name="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .3 0 -.2" size=".03" mass=".5"/></body></body>
  <body name="cart" pos="-1 1 .5"><joint name="slide" type="slide" axis="1 0 0"/>
    <geom size=".05" mass=".3"/></body></worldbody>{}
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""
SPRING = """<tendon><fixed stiffness="3"><joint joint="hinge" coef="1"/>
  <joint joint="slide" coef="-1"/></fixed></tendon>"""


def test_what_edges_by_contact_wait_for() -> None:
    """Chains of bodies that move; not through what stands still; what is unknown joins all."""
    with World(SCENE.format(SPRING)) as world:
        terms = contact_terms(world)
    assert terms["together"] == [["arm", "cart"], ["ball"], ["box"], ["other"]]
    assert terms["still"] == ["base", "shelf", "world"]
    assert (terms["of"]["skin.friction"], terms["of"]["top.friction"]) == (["ball"], ["shelf"])
    assert terms["of"]["motor.control"] == ["arm"]
    acts = holds(terms, [("box", "world"), ("ball", "box"), ("other", "world")])
    assert acts("floor.friction", "ball.linear_velocity")  # through the box
    assert acts("skin.friction", "box.linear_velocity")
    assert not acts("ball.mass", "other.linear_velocity")  # the floor passes nothing on
    assert not acts("top.friction", "other.linear_velocity")
    assert not acts("hinge.velocity", "box.linear_velocity")
    assert holds(terms, [("cart", "box")])("hinge.velocity", "box.linear_velocity")
    assert holds(terms, [("cloth", "box")])("ball.mass", "other.linear_velocity")
    assert not holds(terms, [])("skin.friction", "ball.linear_velocity")


@pytest.mark.parametrize("engine", ENGINES)
def test_no_effect_by_contact_is_without_its_contact(engine: str) -> None:
    """Of each variable, varied a little, all effects in a control step are by edges that hold.

    The ball falls on the box, the other box on a shelf, and an arm swings beside them.
    """
    with World(SCENE.format(SPRING if engine == "mujoco" else ""), backend=engine) as world:
        terms, seen = contact_terms(world), set()
        edges = {(edge.cause, edge.effect): edge.when for edge in world.model.edges if edge.lag}
        states = [v.name for v in world.model.variables if v.role == "state" and v.dtype == "real"]
        varied = [
            v.name
            for v in world.model.variables
            if v.settable and v.dtype == "real" and v.role in ("state", "parameter")
            if not v.name.endswith(("color", "orientation"))
        ]
        world.reset(seed=0)
        for t in range(30):
            before, action = world.snapshot(), np.array([np.sin(t)])
            steps = contacts_of(world, action)
            after = world.snapshot()
            acts = holds(terms, {contact.bodies for step in steps for contact in step})
            for name in varied if t % 6 == 5 else ():
                ends = []
                for by in (1e-6, 2e-6):
                    world.restore(before)
                    world.do({name: np.asarray(world[name]) * (1.0 + by) + by / 10.0})
                    world.step(action)
                    ends.append([world[state].copy() for state in states])
                moved = [
                    s for s, a, b in zip(states, *ends, strict=True) if abs(a - b).max() > 1e-11
                ]
                for key in ((name, state) for state in moved):
                    seen.add((key, edges[key]))
                    assert edges[key] is None or acts(*key), (t, key)
            world.restore(after)
    assert {when for _, when in seen} == {None, "contact"}
    assert len(seen) > 100


def test_parameters_of_the_world_act_where_anything_touches() -> None:
    """A block on the floor bounces with the restitution, which no body has; in the air nothing."""
    edge = ("restitution", "tool_block.linear_velocity")
    with World("pushing") as world:
        world.reset(seed=0)
        world.step(world["joint_positions"])
        assert world.local_graph(world["joint_positions"]).has_edge(*edge)
        world.do({"tool_block.cartesian_position": [0.0, 0.0, 0.2]})
        assert not world.local_graph(world["joint_positions"]).has_edge(*edge)
