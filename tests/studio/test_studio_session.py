"""A session of the studio, without a server: other systems, changes of structure, Python."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from studio_pages import unpacked

from scm_world.graph import to_json
from scm_world.queries import World
from scm_world.studio.reading import Bundles, marks
from scm_world.studio.scene import SentShapes, packed
from scm_world.studio.spec import FRAME, Spec
from scm_world.studio.worker import Session
from scm_world.tasks.factories import load_factory
from scm_world.variables import Box, Categories, Integers
from scm_world.variables.spaces import Affine, Either

EQUATIONS = """
import scm_world as sw

def cart(drag=0.1):
    return sw.SCM([
        sw.Exogenous(name="mass", unit="kg", default=1.0, bounds=sw.Box(0.1, 5.0)),
        sw.Exogenous(name="push", distribution=sw.Box(-1.0, 1.0), per="step"),
        sw.Derived(name="speed", parents=(sw.Parent("speed", 1), sw.Parent("push"), "mass"),
                   mechanism=sw.Linear(weights=(1.0 - drag, 1.0, -0.1))),
    ])

def pond(growth=0.1):
    return sw.StepTask(
        lambda parameters, state, action, noise: {"size": state["size"] * (1 + parameters["rate"])},
        parameters=[sw.Exogenous(name="rate", default=growth, bounds=sw.Box(0.0, 2.0))],
        states=[sw.Measured(name="size", default=1.0, parents=("rate", sw.Parent("size", 1)))],
        control_dt=0.1,
    )
"""


class Pipe:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def send(self, message: Any) -> None:
        """Keep a message."""
        is_packed = isinstance(message, bytes) and message[0] != FRAME
        self.sent.append(unpacked(message) if is_packed else message)

    def last(self, kind: str) -> dict[str, Any]:
        """Return the last message of a type."""
        found = (m for m in reversed(self.sent) if isinstance(m, dict) and m["type"] == kind)
        return next(found)


class Asked:
    """A session, and a short way to ask it."""

    def __init__(self, system: str, **options: Any) -> None:
        settings = options.pop("settings", {})
        self.pipe = Pipe()
        pipe: Any = self.pipe
        spec = Spec(system=system, options=options, settings=settings)
        self.session = Session(spec, pipe)
        self.session.greet()

    def __call__(self, op: str, **given: Any) -> Any:
        """Ask for something that is granted."""
        reply = self.session._answer({"op": op, "id": 1, **given})
        self.session._show(force=True)
        assert "ok" in reply, reply["error"]
        return reply["ok"]

    @property
    def news(self) -> dict[str, Any]:
        """The last news."""
        return self.pipe.last("news")

    @property
    def head(self) -> tuple[int, ...]:
        """The head of the last frame: type, lane, scene, step, shapes, contacts."""
        frame = next(m for m in reversed(self.pipe.sent) if isinstance(m, bytes))
        return struct.unpack("<6I", frame[:24])

    def code(self) -> dict[str, Any]:
        """Run the Python that the page shows, and return its names."""
        names: dict[str, Any] = {}
        exec("\n".join(self.session._code()), names)  # noqa: S102 # what the page shows
        return names


@pytest.fixture
def module(tmp_path: Path) -> str:
    """A file with factories."""
    (tmp_path / "systems.py").write_text(EQUATIONS)
    return str(tmp_path / "systems.py")


@pytest.mark.parametrize(
    ("factory", "variable"), [("cart", "speed"), ("pond", "size"), ("file", "speed")]
)
def test_systems_without_shapes(module: str, factory: str, variable: str, tmp_path: Path) -> None:
    """Equations and step functions have a page too: graph, do, twins, series and Python."""
    system = f"{module}:{factory}"
    if factory == "file":
        system = str(tmp_path / "cart.json")
        Path(system).write_text(to_json(load_factory(f"{module}:cart")()))
    ask = Asked(system)
    hello = ask.pipe.last("hello")
    assert hello["has_shapes"] is False
    assert variable in [one["name"] for one in hello["variables"]]
    ask("plot", names=[variable])
    ask("step", n=4)
    cause = {"cart": "mass", "pond": "rate", "file": "mass"}[factory]
    ask("do", name=cause, act={"value": 0.5})
    ask("step", n=2)
    ask("split", at=1, do={cause: {"value": 1.5}})
    ask("step")
    assert ask.head[4:] == (0, 0)
    assert ask.news["twin"] == 1
    lanes = ask.session._lanes
    ask("plot", names=[variable])
    series = [rows["values"][variable] for rows in ask.news["rows"]]
    assert len(series[0]) == len(series[1]) == 8
    assert series[0][:1] == series[1][:1]
    assert series[0][3] != series[1][3]
    names = ask.code()
    assert names["live"].episode() == lanes[0].live.episode()
    assert names["twin"].episode() == lanes[1].live.episode()


def test_bodies_come_and_go() -> None:
    """Where an intervention changes which bodies there are, graph and shapes are sent anew."""
    given = {"number_of_blocks_in_tower": (1, 1, 3)}
    ask = Asked("towers", settings={"backend": "fake"}, **given)
    ask("step", n=2)
    before, bundles = ask.head, len(ask.pipe.last("hello")["bundles"])
    ask("do", name="number_of_blocks_in_tower", act={"value": [1, 1, 2]})
    assert ask.head[2] != before[2]
    assert ask.head[4] < before[4]
    assert len(ask.pipe.last("hello")["bundles"]) < bundles
    ask("step", n=2)
    ask("look", step=1)
    assert ask.head[2:5] == (before[2], 1, before[4])
    names = ask.code()
    assert names["live"].episode() == ask.session._lanes[0].live.episode()


def test_what_is_dragged_is_one_line() -> None:
    """At one instant the last value counts, in the episode and in Python; draws all count."""
    ask = Asked("pushing", settings={"backend": "fake"})
    ask("step", n=3)
    for value in (0.03, 0.04, 0.05):
        ask("do", name="tool_block.mass", act={"value": value})
    for _ in range(2):
        ask("do", name="floor_friction", act={"kind": "draw", "source": "B"})
    ask("do", name="stage_friction", act={"kind": "shift", "value": 0.1, "window": True, "stop": 5})
    ask("step", n=4)
    ask("policy", action=[0.0] * 9)
    ask("reset", seed=2, number=1)
    ask("policy", name="random")
    ask("step", n=2)
    lines = ask.session._code()
    assert [line for line in lines if "tool_block.mass" in line] == [
        "live.do({'tool_block.mass': 0.05})"
    ]
    assert sum("sw.Draw('B')" in line for line in lines) == 2
    assert "live.do({'stage_friction': sw.Shift(0.1, during=(3, 5))})" in lines
    assert ask.code()["live"].episode() == ask.session._lanes[0].live.episode()


def test_a_trained_policy_acts() -> None:
    """One of the zoo is offered for its task, and its line of Python repeats it."""
    ask = Asked("pushing")
    assert "zoo:pushing" in ask.pipe.last("hello")["policies"]
    assert "zoo:reaching" not in ask.pipe.last("hello")["policies"]
    ask("policy", name="zoo:pushing")
    ask("step", n=5)
    assert ask.code()["live"].episode() == ask.session._lanes[0].live.episode()


def test_marks_say_where_spaces_lie() -> None:
    """Spaces that follow other variables are given as they are now."""
    now = {"size": np.array(0.06)}
    box = Box((0.0, Affine(parent="size", scale=0.5)), (0.1, 0.3))
    assert marks(box, (2,), now) == [{"low": [0.0, 0.03], "high": [0.1, 0.3]}]
    assert marks(Box(0.0, np.inf), (), {}) == [{"low": [0.0], "high": [None]}]
    both = marks(Either(first=Box(0.0, 1.0), second=Box(2.0, 3.0)), (), {})
    assert [one["low"] for one in both or ()] == [[0.0], [2.0]]
    assert marks(Integers(1, 4), (), {}) == [{"low": [1], "high": [4], "whole": True}]
    members = marks(Categories(labels=("dry", "wet")), (), {})
    assert members == [{"members": [0, 1], "labels": ["dry", "wet"]}]
    assert marks(None, (), {}) is None


def test_edges_by_contact_join_what_touches() -> None:
    """A block on the floor is moved by the floor's friction, and not by a robot far away."""
    with World("pushing", backend="fake") as world:
        edges = Bundles(world)
        bodies = edges.bodies
        assert {
            (parent.name, name, parent.lag, parent.when)
            for causes, effects in edges.bundles
            for parent in causes
            for name in effects
        } == set(world.model.edges)

        def lit(pairs: frozenset[tuple[str, str]]) -> set[tuple[str, str]]:
            active = edges.lit(pairs)
            return {
                (edge.cause, edge.effect)
                for edge in world.model.edges
                if edge.when == "contact" and (bodies[edge.cause], bodies[edge.effect]) in active
            }

        pairs = frozenset({("floor", "tool_block")})
        found = lit(pairs)
        assert ("floor_friction", "tool_block.linear_velocity") in found
        assert ("tool_block.friction", "tool_block.linear_velocity") in found
        assert not any("joint" in name for edge in found for name in edge)
        both = pairs | {("robot_finger_60_link_3", "tool_block")}
        found = lit(both)
        assert ("joint_positions", "tool_block.linear_velocity") in found
        assert lit(frozenset()) == set()


def test_every_task_has_shapes() -> None:
    """The robot is drawn from its links, and each goal once."""
    for task, goals in (("reaching", 3), ("pushing", 1), ("stacking2", 2)):
        with World(task, backend="fake") as world:
            world.reset(seed=0)
            number, poses, vertices, message = SentShapes().place(world.scene())
            assert (number, len(vertices)) == (0, 0)
            assert message is not None
            kinds = [shape["kind"] for shape in message["shapes"]]
            assert len(kinds) == len(poses)
            assert sum(bool(shape["goal"]) for shape in message["shapes"]) == goals
            assert np.allclose(np.linalg.norm(poses[:, 3:], axis=1), 1.0)


BALL = """<mujoco><asset><mesh name="ball" builtin="sphere" params="4"/></asset><worldbody>
<body><joint/><geom type="mesh" mesh="ball" mass="1"/></body></worldbody></mujoco>"""


def test_meshes_have_few_triangles_without_a_graphics_card(monkeypatch: Any) -> None:
    """A ball stays a ball: its size, and normals that point outwards; arrays come as they were."""
    monkeypatch.setattr("scm_world.studio.scene.FEW_TRIANGLES", 500)
    with World(BALL) as world:
        world.reset(seed=0)
        sent = (SentShapes(coarse=few).place(world.scene())[3] for few in (False, True))
        whole, coarse = (unpacked(packed(message or {}))["meshes"][0] for message in sent)
    assert len(whole["corners"]) == 3 * 20 * 4**4
    for mesh, most, radii, turn in ((whole, 5120, 0.01, 0.02), (coarse, 500, 0.1, 0.3)):
        assert 100 < len(mesh["corners"]) / 3 <= most
        vertices = mesh["vertices"].reshape(-1, 3)
        normals = mesh["normals"].reshape(-1, 4)[:, :3] / 127.0
        assert len(vertices) == len(normals) == mesh["corners"].max() + 1
        outwards = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
        assert np.allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=radii)
        assert np.allclose(normals, outwards, atol=turn)


CHAIN = """
import scm_world as sw

def twice(x):
    return 2.0 * x

def chain():
    edges = {"b": "a", "c": "b", "d": "c"}
    linear = sw.Linear(weights=(1.0,))
    own = [sw.Derived(name=n, parents=(p,), mechanism=linear) for n, p in edges.items()]
    model = sw.SCM([sw.Exogenous(name="a"), *own])
    return model.given({"c": sw.Mechanism(twice, parents=("a",))})
"""


def test_the_graph_is_that_of_the_model_under_interventions(tmp_path: Path) -> None:
    """A given function shows its own edge; a value cuts, a shift does not, a release joins."""
    (tmp_path / "chain.py").write_text(CHAIN)
    ask = Asked(f"{tmp_path / 'chain.py'}:chain")
    live = ask.session._lanes[0].live

    def shown() -> set[tuple[str, str]]:
        """Return the edges that the page draws, without those that it draws as cut."""
        hello = ask.pipe.last("hello")
        names = [variable["name"] for variable in hello["variables"]]
        ends = {
            (names[cause[0]], names[effect])
            for causes, effects in hello["bundles"]
            for cause in causes
            for effect in effects
        }
        return {(cause, effect) for cause, effect in ends if effect not in ask.news["cut"]}

    ask("pause")
    whole = {("a", "b"), ("a", "c"), ("c", "d")}
    assert shown() == whole
    for name, act, left in (
        ("b", {"value": 1.0}, whole - {("a", "b")}),
        ("d", {"kind": "shift", "value": 1.0}, whole - {("a", "b")}),
        ("c", {"value": 1.0}, {("c", "d")}),
    ):
        ask("do", name=name, act=act)
        assert shown() == left == {(e.cause, e.effect) for e in live.world.graph.edges}
    ask("release", name="b")
    assert shown() == {("a", "b"), ("c", "d")}
