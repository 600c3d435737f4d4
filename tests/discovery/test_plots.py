"""Pictures of models, and the few words that name many variables."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from scm_world.discovery.model_pictures import draw_model, lay_out
from scm_world.discovery.names import braces, by_entity, families_of
from scm_world.graph import SCM
from scm_world.queries.world import World
from scm_world.variables import Derived, Exogenous, Linear, Parent
from scm_world.world import Simulation

MODEL = SCM(
    [
        Exogenous(name="a"),
        Derived(name="b", parents=("a",), mechanism=Linear(weights=(2.0,))),
        Derived(name="c", parents=("b", Parent("a", 1)), mechanism=Linear(weights=(1.0, 1.0))),
    ]
)


@pytest.mark.parametrize("model", [MODEL, SCM([]), SCM([Exogenous(name="a")])])
def test_models_are_drawn(tmp_path: Path, model: SCM) -> None:
    """Any model has a picture, even one without edges."""
    draw_model(model, tmp_path / "model.png")
    assert imread(tmp_path / "model.png").shape[1] == 1600


@pytest.mark.parametrize("task", ["pushing", "towers"])
def test_causes_stand_left_of_their_effects_and_boxes_apart(task: str) -> None:
    """In the drawing of a task arrows go right, and no two boxes overlap."""
    drawing = lay_out(Simulation(task, backend="fake").model)

    points = [drawing.graph.edges[edge]["points"] for edge in drawing.acyclic.edges]
    assert all(between[0][0] < between[-1][0] for between in points)
    width, height = drawing.box
    places = np.array([at for _, at in drawing.graph.nodes(data="at")])
    apart = np.abs(places[:, None] - places)
    touching = (apart[..., 0] < width) & (apart[..., 1] < height)
    assert touching.sum() == len(places)
    assert (places - (width / 2, height / 2) >= 0).all()
    assert (np.array((1600, drawing.height)) - places >= (width / 2, height / 2)).all()


def test_a_large_tree_is_folded_by_default_and_fits_a_page(tmp_path: Path) -> None:
    """Of a humanoid: parameters, the tree in one control step, states."""
    found = importlib.util.find_spec("gymnasium")
    assert found is not None
    assert found.origin is not None
    path = Path(found.origin).parent / "envs/mujoco/assets/humanoid.xml"
    model = World(str(path), backend="fake").model
    drawing = lay_out(model)
    assert drawing.folded
    assert len(model) > 200
    assert len(drawing.graph) < 30
    assert drawing.height < 1000
    assert "mass (13)" in drawing.graph
    assert drawing.graph.has_edge("mass (13)", "one control step")
    assert drawing.graph.has_edge("one control step", "velocity (17)")
    assert drawing.graph.edges["friction (18)", "one control step"]["contact"]
    assert not drawing.graph.edges["mass (13)", "one control step"]["contact"]
    assert len(lay_out(model, folded=False).graph) > 100
    assert not lay_out(World("pushing", backend="fake").model).folded
    draw_model(model, tmp_path / "folded.png")
    assert imread(tmp_path / "folded.png").shape[0] < 1200


def test_two_trees_are_folded_apart() -> None:
    """Quantities of one tree are one node, and the other tree has its own."""
    link = '<body name="{0}"><joint name="{0}"/><geom size=".1" mass="1"/>{1}</body>'
    arms = [link.format(f"{side}a", link.format(f"{side}b", "")) for side in ("left", "right")]
    scene = f"<mujoco><worldbody>{''.join(arms)}</worldbody></mujoco>"
    model = World(scene, backend="fake").model
    graph = lay_out(model, folded=True).graph
    assert {"mass (2: lefta …)", "mass (2: righta …)", "velocity (2: lefta …)"} <= {*graph}


def test_activations_of_one_tree_are_folded() -> None:
    """Beside the states that they move: these do not act on them."""
    muscles = "".join(f'<muscle name="{i}" joint="a" lengthrange="-1 1"/>' for i in "xyz")
    arm = '<body><joint name="a"/><geom size=".1" mass="1"/></body>'
    scene = f"<mujoco><worldbody>{arm}</worldbody><actuator>{muscles}</actuator></mujoco>"
    graph = lay_out(World(scene, backend="fake").model, folded=True).graph
    assert {"activation (3)", "control (3)", "timeconst (3)"} <= {*graph}
    assert not graph.has_edge("one control step", "activation (3)")


def test_strong_edges_are_thick_and_weak_ones_are_left_out() -> None:
    """A node has the largest strength of its edges, and edges without a strength stay."""
    strength = {("a", "b", 0): 3.0, ("b", "c", 0): 0.001}
    drawing = lay_out(MODEL, strength=strength, at_least=0.01)
    assert {*drawing.graph.edges} == {("a", "b"), ("a", "c")}
    assert drawing.graph.edges["a", "b"]["strength"] == 3.0
    assert np.isnan(drawing.graph.edges["a", "c"]["strength"])


def test_edges_within_a_cycle_are_drawn(tmp_path: Path) -> None:
    """Two variables that act on each other one step later have arrows both ways."""
    model = SCM(
        [
            Derived(name=a, parents=(Parent(b, 1),), mechanism=Linear(weights=(1.0,)))
            for a, b in (("x", "y"), ("y", "x"))
        ]
    )
    draw_model(model, tmp_path / "both.png")
    purple = (
        np.abs(imread(tmp_path / "both.png")[90:, :, :3] - (0.60, 0.44, 0.69)).max(axis=2) < 0.1
    )
    assert purple.sum() > 20


def test_drawing_loads_no_pyplot(tmp_path: Path) -> None:
    """Importing costs no matplotlib, and drawing leaves its global state alone."""
    code = (
        "import sys\n"
        "from scm_world.discovery.model_pictures import draw_model\n"
        "assert 'matplotlib' not in sys.modules\n"
        "from scm_world.graph import SCM\n"
        f"draw_model(SCM([]), {str(tmp_path / 'm.png')!r})\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)  # noqa: S603


def test_short_names_are_without_loss() -> None:
    """Braces stand for a full product of numbers; what is missing is not pretended."""
    names = ["x_1_a_1", "x_1_a_2", "x_2_a_1"]
    assert braces(names) == ["x_1_a_{1,2}", "x_2_a_1"]
    assert braces([*names, "x_2_a_2"]) == ["x_{1,2}_a_{1,2}"]
    assert by_entity(["b.m", "b.s", "g"]) == ["b.{m, s}", "g"]
    assert by_entity([]) == []


def test_families_have_the_same_edges() -> None:
    """Variables that differ in more than a number are drawn apart."""
    families = families_of(["b_1", "b_2", "b_3", "c"], [("b_1", "c", 0), ("b_2", "c", 0)])
    assert families == {"b_{1,2}": ("b_1", "b_2"), "b_3": ("b_3",), "c": ("c",)}


def test_blocks_of_one_kind_are_one_family() -> None:
    """What each block has of its own is one node, under a name that fits into a box."""
    model = Simulation("towers", backend="fake").model
    families = families_of(model, (edge.key for edge in model.edges))

    assert len(families["tool_{…}.mass (5)"]) == 5
    assert "tool_level_3_col_0_row_0.size" in families["tool_{…}.size (5)"]
    assert max(map(len, families)) < 60
    assert sum(map(len, families.values())) == len(model)


def test_a_block_that_plays_another_part_is_drawn_apart() -> None:
    """One edge more, even at a distance, makes a family of its own."""
    chain = [(f"a_{i}", f"b_{i}", 0) for i in range(3)]
    alike = families_of([f"{x}_{i}" for x in "ab" for i in range(3)], chain)
    assert set(alike) == {"a_{0,1,2}", "b_{0,1,2}"}

    other = families_of(["c"], [*chain, ("b_2", "c", 1)])
    assert {"a_{0,1}", "a_2", "b_{0,1}", "b_2", "c"} == set(other)
