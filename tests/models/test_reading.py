"""Reading model files: tables, names, sources and what is refused."""

from __future__ import annotations

import copy
import pickle
import re
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import mujoco
import numpy as np
import pytest
from model_files import LONG, PENDULUM, QUICK, SUITE, URDFS, arrays, model_file, pile

from scm_world import World
from scm_world.backends import read_model
from scm_world.backends.mujoco import sources
from scm_world.backends.mujoco.reading import compiled
from scm_world.backends.mujoco.sources import LEAST
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.models import Model

FILES = [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG)]
NAME = re.compile(r"((\w+:)?[\w-]+\.)?\w+")


@pytest.fixture(params=FILES)
def model(request: pytest.FixtureRequest) -> Model:
    """A model that nobody here wrote."""
    return read_model(model_file(request.param))


def value(row: Any, numbers: Any) -> Any:
    """Give every component of a row its number."""
    return np.array(np.broadcast_to(numbers, row.shape), dtype=np.float64)


# --- every file --------------------------------------------------------------------------------


def test_every_file_gives_complete_tables(model: Model) -> None:
    """Names are unique and legal, units are given, and defaults lie within their bounds."""
    rows = (*model.parameters, *model.states, *model.inputs)
    names = [row.name for row in rows]
    assert len(set(names)) == len(names)
    for row in rows:
        default, low, high = (value(row, n) for n in (row.default, row.low, row.high))
        assert NAME.fullmatch(row.name)
        assert row.unit
        assert row.doc.endswith(".")
        assert (low <= default).all(), row.name
        assert (default <= high).all(), row.name
        assert row.always | row.contact <= set(range(len(model.trees)))
        assert not row.always & row.contact
    assert all(row.trees <= row.always for row in model.states)
    assert not any(name in dict(model.refused) for name in names)


def test_writing_and_undoing_leaves_no_trace(model: Model) -> None:
    """Every parameter is read back as written, and its default restores every array to the bit."""
    mj = copy.copy(compiled(model))
    data, scratch = mujoco.MjData(mj), mujoco.MjData(mj)
    before, places = arrays(mj), model.slots(mj, data)
    assert places.keys() == {row.key for row in model.parameters}
    for row in model.parameters:
        slot, default = places[row.key], value(row, row.default)
        assert np.array_equal(slot.read(), default)
        written = default * 0.9 if default.any() else default + 0.01
        written = 1.0 - default if row.kind == "switch" else written
        slot.write(written)
        if slot.constant:
            mujoco.mj_setConst(mj, scratch)
        np.testing.assert_allclose(slot.read(), written, rtol=0.0, atol=1e-6 * row.visual)
        slot.write(default)
    mujoco.mj_setConst(mj, scratch)
    after = arrays(mj)
    assert [name for name in before if after[name] != before[name]] == []


def test_the_state_vector_is_a_permutation(model: Model) -> None:
    """Every number of MuJoCo's state stands in exactly one place of the vector."""
    mj = compiled(model)
    positions, velocities, activations = (model.places(a)[1] for a in ("qpos", "qvel", "act"))
    data, start = mujoco.MjData(mj), model.empty_state().vector
    places = np.concatenate([positions, velocities, activations])
    assert sorted(places.tolist()) == list(range(mj.nq + mj.nv + mj.na))
    assert np.array_equal(start[positions], data.qpos)
    assert np.array_equal(start[velocities], data.qvel)
    assert np.array_equal(start[activations], data.act)


def test_a_model_goes_to_another_process(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pickled model is equal, and compiles to the same arrays."""
    if mujoco.mj_sizeModel(model.source.whole) > 30e6:
        pytest.skip("tens of megabytes of meshes")
    monkeypatch.setattr(sources, "_SOURCES", WeakValueDictionary())  # as in another process
    again = pickle.loads(pickle.dumps(model))  # noqa: S301 # our own
    assert again == model
    assert again.source is not model.source
    assert arrays(again.source.whole) == arrays(model.source.whole)
    assert arrays(compiled(again)) == arrays(compiled(model))


def test_equal_models_are_one_in_a_process() -> None:
    """Copies, pickles and other readings of one file share its compiled model."""
    model, saved = read_model(PENDULUM), pickle.dumps(read_model(PENDULUM))
    for other in (read_model(PENDULUM), copy.deepcopy(model), pickle.loads(saved)):  # noqa: S301
        assert other.source is model.source
    assert read_model(PENDULUM, exact=False).source is not model.source


def test_the_compiled_model_is_that_of_the_file(model: Model, request: Any) -> None:
    """All numbers but the options are what MuJoCo itself makes of the file, to the bit."""
    name = request.node.callspec.params["model"]
    if not name.endswith(".xml"):
        pytest.skip("MuJoCo alone does not find the meshes of a URDF")
    theirs = arrays(mujoco.MjModel.from_xml_path(str(model_file(name))))
    assert arrays(model.source.whole) == theirs
    ours = arrays(compiled(model))
    changed = {n for n in theirs if not n.startswith("opt.") and ours[n] != theirs[n]}
    pictures = ("tex_", "mesh_", "bvh_", "ntexdata", "nmesh", "nbvh", "nbuffer")
    assert {n for n in changed if not n.startswith(pictures)} <= {"dof_dampingpoly"}
    assert compiled(model).dof_dampingpoly.max() <= LEAST


# --- tables ------------------------------------------------------------------------------------


def test_a_pendulum_has_the_variables_one_expects() -> None:
    """Names are elements and attributes in the words of MJCF."""
    model = read_model(PENDULUM)
    assert model.name == "pendulum"
    assert [(row.name, row.unit) for row in model.parameters] == [
        ("pole.mass", "kg"),
        ("pole.inertia", "kg m^2"),
        ("hinge.damping", "N m s/rad"),
        ("hinge.armature", "kg m^2"),
        ("hinge.frictionloss", "N m"),
        ("hinge.stiffness", "N m/rad"),
        ("rod.color", "1"),
        ("motor.gear", "1"),
        ("gravity", "m/s^2"),
        ("timestep", "s"),
    ]
    assert [(row.name, row.unit) for row in model.states] == [
        ("hinge.position", "rad"),
        ("hinge.velocity", "rad/s"),
    ]
    assert (model.states[0].low, model.states[0].high) == pytest.approx((-np.pi / 2, np.pi / 2))
    (motor,) = model.inputs
    assert (motor.name, motor.unit, motor.low, motor.high) == ("motor.control", "N m", -2.0, 2.0)


def test_states_of_all_kinds_of_joints() -> None:
    """Free bodies, balls, slides and activations have the names and shapes of their kind."""
    model = read_model(
        """<mujoco><worldbody>
        <body name="cube"><freejoint name="any"/><geom size="0.1"/></body>
        <body name="b"><joint name="ball" type="ball"/><geom size="0.1" pos="0.2 0 0"/></body>
        <body name="s"><joint name="slide" type="slide"/><geom size="0.1"/></body>
        </worldbody><actuator><position name="servo" joint="slide" kp="3" timeconst="0.1"/>
        </actuator></mujoco>"""
    )
    assert [(row.name, row.shape, row.kind) for row in model.states] == [
        ("cube.cartesian_position", (3,), "real"),
        ("cube.orientation", (4,), "rotation"),
        ("cube.linear_velocity", (3,), "real"),
        ("cube.angular_velocity", (3,), "real"),
        ("ball.orientation", (4,), "rotation"),
        ("ball.angular_velocity", (3,), "real"),
        ("slide.position", (), "real"),
        ("slide.velocity", (), "real"),
        ("servo.activation", (), "real"),
    ]
    assert model.states[1].default == (0.0, 0.0, 0.0, 1.0)
    assert model.trees == ("cube", "b", "s", "servo.activation")


def test_elements_without_names_get_stable_ones() -> None:
    """They are named after their body or target, and by their number in it."""
    model = read_model(
        """<mujoco><worldbody><body><joint/><geom size="0.1"/><geom size="0.1" pos="1 0 0"/>
        <body name="fore arm.1"><joint axis="1 0 0"/><joint axis="0 1 0"/><geom size="0.1"/></body>
        </body></worldbody><actuator><motor joint="left/hand"/></actuator></mujoco>""".replace(
            '<joint axis="0 1 0"/>', '<joint name="left/hand" axis="0 1 0"/>'
        )
    )
    names = {row.name for row in (*model.parameters, *model.states, *model.inputs)}
    assert {"world_body_0.mass", "world_body_0.position", "world_body_0_geom_1.color"} <= names
    assert {"fore_arm_1.mass", "fore_arm_1_joint_0.velocity", "left_hand.control"} <= names


def test_only_what_collides_is_told_apart_by_its_kind() -> None:
    """A body and a shape of one name keep plain names, unless they share an attribute."""
    model = read_model(
        PENDULUM.replace('name="rod"', 'name="pole"').replace('name="motor"', 'name="hinge"'),
        expose=["*", "*.position", "*.armature"],
    )
    names = {row.name for row in (*model.parameters, *model.inputs)}
    assert {"pole.mass", "pole.color", "hinge.damping", "hinge.gear", "hinge.control"} <= names
    assert {"body:pole.position", "geom:pole.position", "hinge.armature"} <= names
    assert "actuator:hinge.armature" in names


def test_fields_that_act_on_nothing_are_not_exposed() -> None:
    """They are refused with the reason, to be read after the name."""
    refused = dict(read_model(PENDULUM).refused)
    assert refused["wind"] == "acts on nothing: density and viscosity are zero"
    assert refused["rod.margin"] == "acts on nothing: the shape touches nothing"
    assert refused["rod.friction"].startswith("acts on nothing: its contacts")
    assert refused["rod.contype"].startswith("is a whole number")
    assert refused["hinge.range"] == "is not exposed; name it in expose=[…]"
    still = read_model(
        PENDULUM.replace("<worldbody>", '<option><flag gravity="disable"/></option><worldbody>')
    )
    assert dict(still.refused)["gravity"] == "acts on nothing: the model disables gravity"


@pytest.mark.parametrize(
    ("patterns", "names"),
    [
        ("*.mass", ["pole.mass"]),
        (["pole.*", "hinge.range"], ["pole.mass", "pole.inertia", "hinge.range"]),
        (["density"], ["density"]),
        (["*.solreflimit", "gravity"], ["hinge.solreflimit", "gravity"]),
    ],
)
def test_patterns_choose_what_is_exposed(patterns: Any, names: list[str]) -> None:
    """Attributes beyond the usual ones are exposed where they are named."""
    assert [row.name for row in read_model(PENDULUM, expose=patterns).parameters] == names


def test_a_medium_that_may_come_makes_wind_act() -> None:
    """Exposing the density exposes the wind, and lets the size of shapes act at all times."""
    text = PENDULUM.replace('name="rod"', 'name="rod" fluidshape="ellipsoid"')
    model = read_model(text, expose=["density", "wind", "*.size"])
    assert {row.name: set(row.always) for row in model.parameters} == {
        "density": {0},
        "wind": {0},
        "rod.size": {0},
    }


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("pole.mas", "names no parameter; did you mean 'pole.mass'?"),
        ("wind", "'wind' acts on nothing: density and viscosity are zero"),
    ],
)
def test_patterns_that_name_nothing_are_errors(pattern: str, message: str) -> None:
    """The error has the nearest name, or says why it is refused."""
    with pytest.raises(ModelError, match=re.escape(message)):
        read_model(PENDULUM, expose=["*", pattern])


def test_servos_have_gains_instead_of_numbered_slots() -> None:
    """A gain that MuJoCo keeps in two places is one parameter, and both follow."""
    text = PENDULUM.replace("<motor", '<position kp="5" kv="0.5"')
    model = read_model(text, expose=["motor.*"])
    assert [(row.name, row.default, row.unit) for row in model.parameters] == [
        ("motor.gear", 1.0, "1"),
        ("motor.kp", 5.0, "N m/rad"),
        ("motor.kv", 0.5, "N m s/rad"),
    ]
    mj = copy.copy(compiled(model))
    places = model.slots(mj, mujoco.MjData(mj))
    places["motor", "kp"].write(np.array(7.0))
    assert (mj.actuator_gainprm[0, 0], mj.actuator_biasprm[0, 1]) == (7.0, -7.0)


def test_a_color_is_that_of_the_material_until_it_is_set() -> None:
    """Setting it to the color of the material undoes it to the bit."""
    text = PENDULUM.replace(
        "<worldbody>", '<asset><material name="red" rgba="0.9 0.1 0.2 1"/></asset><worldbody>'
    )
    model = read_model(text.replace('name="rod"', 'name="rod" material="red"'), expose="*.color")
    mj = copy.copy(compiled(model))
    before, slot = (
        arrays(mj),
        model.slots(mj, mujoco.MjData(mj))["rod", "color"],
    )
    assert model.parameters[0].default == (0.9, 0.1, 0.2, 1.0)
    for color in ([0.3, 0.4, 0.5, 1.0], [0.5, 0.5, 0.5, 1.0]):
        slot.write(np.array(color))
        np.testing.assert_allclose(slot.read(), color, atol=1e-6)
    slot.write(np.array([0.9, 0.1, 0.2, 1.0]))
    assert arrays(mj) == before


def test_sizes_act_as_in_a_model_that_is_compiled_with_them() -> None:
    """A new size with derived constants gives the trajectory of a new compilation, to the bit."""
    wide = pile(5).replace('size="0.1 0.1 0.1"', 'size="0.13 0.11 0.12"')
    model, other = read_model(pile(5)), read_model(wide)
    mj = copy.copy(compiled(model))
    places = model.slots(mj, mujoco.MjData(mj))
    for row in other.parameters:
        places[row.key].write(value(row, row.default))
    mujoco.mj_setConst(mj, mujoco.MjData(mj))
    runs = []
    for each in (mj, compiled(other)):
        data = mujoco.MjData(each)
        mujoco.mj_step(each, data, 300)
        runs.append(data.qpos.copy())
    assert np.array_equal(*runs)


def test_mocap_bodies_have_a_pose_that_can_be_set() -> None:
    """It lives in the data, acts at once, and moves what is welded to it."""
    model = read_model(
        """<mujoco><worldbody><body name="hand" mocap="true" pos="0 0 1"/>
        <body name="held" pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody>
        <equality><weld body1="hand" body2="held"/></equality></mujoco>"""
    )
    row = next(row for row in model.parameters if row.name == "hand.position")
    mj = copy.copy(compiled(model))
    data = mujoco.MjData(mj)
    model.slots(mj, data)[row.key].write(np.array([0.0, 0.3, 1.0]))
    mujoco.mj_step(mj, data, 500)
    assert data.body("held").xpos[1] == pytest.approx(0.3, abs=0.05)


def test_contacts_name_bodies() -> None:
    """The world's own shapes belong to the world."""
    assert read_model(pile(2)).owners == ("world", "b0", "b1")


# --- settings ----------------------------------------------------------------------------------


def test_exact_settings_are_in_force() -> None:
    """Islands on; warm start, autoreset and sleep off."""
    flags = '<option><flag warmstart="enable" island="disable" sleep="enable"/></option>'
    mj = compiled(read_model(PENDULUM.replace("<worldbody>", f"{flags}<worldbody>")))
    off = mujoco.mjtDisableBit
    assert mj.opt.disableflags & int(off.mjDSBL_WARMSTART)
    assert mj.opt.disableflags & int(off.mjDSBL_AUTORESET)
    assert not mj.opt.disableflags & int(off.mjDSBL_ISLAND)
    assert not mj.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP)


@pytest.mark.parametrize(
    ("text", "integrator", "notes"),
    [
        (PENDULUM, "EULER", 0),
        (pile(2), "EULER", 0),
        (pile(2, '<option integrator="RK4"/>'), "RK4", 0),
        (pile(2, '<option integrator="RK4" solver="PGS"/>'), "RK4", 1),
    ],
)
def test_the_integrator_is_that_of_the_file(text: str, integrator: str, notes: int) -> None:
    """Dual solvers with a dense Jacobian would tie several trees together: it is sparse."""
    model = read_model(text)
    mj = compiled(model)
    assert mj.opt.integrator == int(getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}"))
    assert sum(note.startswith("The ") for note in model.fidelity.notes) == notes
    assert mujoco.mj_isSparse(mj) == ("PGS" in text)


def test_settings_replace_options_of_the_file() -> None:
    """They are part of what decides whether two models are equal."""
    model = read_model(PENDULUM, settings={"timestep": 0.001, "integrator": "RK4"})
    assert model.timestep == 0.001
    assert compiled(model).opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)
    assert model != read_model(PENDULUM)
    assert read_model(PENDULUM) == read_model(PENDULUM)
    assert read_model(PENDULUM) != read_model(PENDULUM, expose="*.mass")
    for settings in ({"timestap": 0.001}, {"integrator": "euclid"}):
        with pytest.raises(UnknownOption):
            read_model(PENDULUM, settings=settings)


# --- sources -----------------------------------------------------------------------------------


def test_path_text_spec_and_compiled_model_are_one(tmp_path: Path) -> None:
    """They compile to the same arrays; what is given is not changed."""
    path = tmp_path / "pendulum.mjcf"
    path.write_text(PENDULUM)
    spec, mj = mujoco.MjSpec.from_string(PENDULUM), mujoco.MjModel.from_xml_string(PENDULUM)
    untouched = arrays(mj)
    sources = (path, str(path), PENDULUM, spec, mj)
    models = [read_model(source) for source in sources]
    assert len({model.digest for model in models}) == 1
    assert all(arrays(compiled(model)) == arrays(compiled(models[0])) for model in models)
    assert [model.name for model in models] == ["pendulum"] * 5
    again = pickle.loads(pickle.dumps(models[4]))  # noqa: S301 # our own
    assert again.parameters == models[0].parameters
    assert arrays(mj) == untouched


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_a_model_needs_its_files_only_once(tmp_path: Path) -> None:
    """Includes and meshes are inside: the files can go."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "part.obj").write_text(TETRAHEDRON)
    (tmp_path / "body.xml").write_text(
        '<mujoco><worldbody><body name="part"><freejoint/><geom type="mesh" mesh="part"/></body>'
        "</worldbody></mujoco>"
    )
    path = tmp_path / "main.xml"
    path.write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="part" file="part.obj"/></asset>'
        '<include file="body.xml"/></mujoco>'
    )
    model = read_model(path)
    assert model.name == "main"
    for file in (path, tmp_path / "body.xml", tmp_path / "meshes" / "part.obj"):
        file.unlink()
    again = pickle.loads(pickle.dumps(model))  # noqa: S301 # our own
    assert compiled(again).nmesh == 1


def test_included_files_find_theirs_as_in_mujoco(tmp_path: Path) -> None:
    """Includes are relative to the main file, and meshes to the file that names them."""
    robots, parts, meshes = (tmp_path / name for name in ("robots", "parts", "parts/meshes"))
    for folder in (robots, meshes):
        folder.mkdir(parents=True)
    (meshes / "part.obj").write_text(TETRAHEDRON)
    (parts / "body.xml").write_text(
        '<mujoco><asset><mesh file="meshes/part.obj"/></asset><worldbody><body name="part">'
        '<freejoint/><include file="../parts/shape.xml"/></body></worldbody></mujoco>'
    )
    (parts / "shape.xml").write_text('<mujoco><geom type="mesh" mesh="part"/></mujoco>')
    for ending in ("xml", "mjcf"):
        path = robots / f"main.{ending}"
        path.write_text('<mujoco><include file="../parts/body.xml"/></mujoco>')
        assert compiled(read_model(path)).nmesh == 1


def test_another_mujoco_does_not_read_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model that another version has compiled is one error that says what to do."""
    with monkeypatch.context() as older:
        older.setattr(mujoco, "__version__", "3.0.0")
        saved = pickle.dumps(read_model(PENDULUM))
    with pytest.raises(ModelError, match=r"compiled by MuJoCo 3\.0\.0.*read its file again"):
        pickle.loads(saved)  # noqa: S301 # our own


def test_the_root_of_a_urdf_can_be_free() -> None:
    """MuJoCo fixes it to the world, and then the mass of the root counts for nothing."""
    path = model_file(f"{URDFS}franka_panda/panda.urdf")
    fixed, free = read_model(path), read_model(path, fixed_base=False)
    assert fixed.trees == ("panda_link1",)
    assert free.trees == ("panda_link0",)
    assert free.layout.names[:2] == ("panda_link0.cartesian_position", "panda_link0.orientation")
    masses = [
        sum(row.default for row in model.parameters if row.name.endswith(".mass"))
        for model in (fixed, free)
    ]
    assert masses == pytest.approx([15.06, 17.96])


# --- errors ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ("nowhere.xml", UnreadableFile, "'nowhere.xml' cannot be read: no such file"),
        (3, ModelError, "3 is not a model: give the path of an .xml, .mjcf or .urdf file"),
        ("<html/>", ModelError, "begins with <html>: give MJCF"),
        ("<mujoco><worldbody>", ModelError, "MuJoCo cannot read the XML text: XML parse error"),
        ("<mujoco><wordbody/></mujoco>", ModelError, "unrecognized element"),
        ('<mujoco><include file="no.xml"/></mujoco>', ModelError, "put the file there"),
        ("<mujoco/>", ModelError, "has no joint, so that nothing in it can move"),
        (
            '<mujoco><asset><mesh file="a.stl"/></asset></mujoco>',
            ModelError,
            "opening file 'a.stl'; put the file there, or correct the path to it",
        ),
        (
            PENDULUM.replace("<motor", '<general gaintype="user"'),
            ModelError,
            "the actuator 'motor' needs a callback",
        ),
        (
            PENDULUM.replace("<motor", '<motor delay="0.01" nsample="6"'),
            ModelError,
            "the actuator 'motor' acts with a delay",
        ),
        (
            PENDULUM.replace("damping=", 'stiffness="1" springyield="0.1" damping='),
            ModelError,
            "springyield",
        ),
    ],
)
def test_what_is_no_model_is_one_typed_error(source: Any, error: Any, message: str) -> None:
    """The error names the file and what to do."""
    with pytest.raises(error, match=re.escape(message)):
        read_model(source)


LINK = (
    '<link name="{}"><inertial><mass value="1"/>'
    '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
HINGE = (
    '<joint name="{}" type="continuous"><parent link="{}"/><child link="{}"/>'
    '<axis xyz="0 1 0"/></joint>'
)


@pytest.mark.parametrize(
    ("links", "joints", "message"),
    [
        (("l", "r"), (("a", "base", "l"), ("a", "l", "r")), "2 joints called 'a'"),
        (("l", "l"), (("a", "base", "l"),), "2 links called 'l'"),
        (("l",), (("", "base", "l"),), "1 joints called ''"),
    ],
)
def test_names_of_a_urdf_that_are_not_unique_are_named(
    links: tuple[str, ...], joints: tuple[tuple[str, ...], ...], message: str
) -> None:
    """MuJoCo leaves out the second name, and motors would have no joint."""
    parts = [LINK.format(name) for name in links] + [HINGE.format(*joint) for joint in joints]
    with pytest.raises(ModelError, match=message):
        read_model(f'<robot name="r"><link name="base"/>{"".join(parts)}</robot>')


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (
            "".join(
                f'<joint name="j{i}" type="slide" axis="{axis}"/>'
                for i, axis in enumerate(("1 0 0", "0 1 0", "0 0 1", "1 1 0"))
            ),
            "'j0', 'j1', 'j3' depend on one another",
        ),
        (
            '<joint name="one"/><joint name="two" pos="0 .1 0" axis="0 0 1"/><joint name="three"/>',
            "'one', 'three' depend on one another",
        ),
    ],
)
def test_joints_that_depend_on_one_another_are_named(text: str, named: str) -> None:
    """A singular mass matrix is refused when the model is read, not at the first reset."""
    body = f'<body name="b">{text}<geom type="box" size=".05 .05 .05" mass="1"/></body>'
    with pytest.raises(ModelError, match=named):
        read_model(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


def test_a_compiled_model_without_sense_is_refused() -> None:
    """Masses, and ranges with the upper end first, that were written into a compiled model."""
    for array, value, message in (
        ("body_mass", -1.0, "no body has such a mass, or such moments of inertia, as 'pole'"),
        ("jnt_range", (1.0, -1.0), "hinge.range: the upper end comes first"),
    ):
        mj = mujoco.MjModel.from_xml_string(PENDULUM)
        getattr(mj, array)[-1] = value
        with pytest.raises(ModelError, match=message):
            read_model(mj, expose=["*", "*.range"])


# --- files that MuJoCo reads, too --------------------------------------------------------------


@pytest.mark.parametrize(
    ("declared", "encoding", "joint"),
    [
        ("UTF-16", "utf-8", "Gelenk_ä"),
        ("utf-8", "utf-8-sig", "Gelenk_ä"),
        ("no-such-encoding", "utf-8", "Gelenk_ä"),
        ("utf-8", "cp1252", "joint"),
    ],
)
@pytest.mark.parametrize("part", ["whole", "included"])
def test_xml_is_read_as_utf_8(
    declared: str, encoding: str, joint: str, part: str, tmp_path: Path
) -> None:
    """As well as with a byte order mark, or with stray bytes in a comment."""
    comment = "Länge" if joint.isascii() else joint
    head = f'<?xml version="1.0" encoding="{declared}"?><!-- {comment} -->'
    body = f'<body name="b"><joint name="{joint}"/><geom size=".1"/></body>'
    world = f"<worldbody>{body}</worldbody>"
    path = tmp_path / "m.xml"
    path.write_bytes(f"{head}<mujoco>{world}</mujoco>".encode(encoding))
    if part == "included":
        path.rename(tmp_path / "part.xml")
        path.write_text('<mujoco><include file="part.xml"/></mujoco>')
    assert read_model(path).layout.names == (f"{joint}.position", f"{joint}.velocity")


def test_folders_that_a_file_strips_from_its_paths_are_stripped(tmp_path: Path) -> None:
    """The mesh is beside the model, whatever folder the file names."""
    mesh = "<mesh name='m' file='/home/me/cad/part.obj'/>"
    (tmp_path / "part.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\n")
    path = tmp_path / "m.xml"
    path.write_text(
        f'<mujoco><compiler strippath="true"/><asset>{mesh}</asset><worldbody><body><joint/>'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    assert compiled(read_model(path)).nmesh == 1


def test_a_mesh_that_mujoco_does_not_read_is_to_be_converted(tmp_path: Path) -> None:
    """The error has the path of the file, which a package of ROS contains."""
    (tmp_path / "robot" / "meshes").mkdir(parents=True)
    (tmp_path / "robot" / "meshes" / "part.dae").write_text("<COLLADA/>")
    mesh = '<geometry><mesh filename="package://robot/meshes/part.dae"/></geometry>'
    path = tmp_path / "robot" / "m.urdf"
    path.write_text(
        plate("1", "1 1 1").replace("</inertial>", f"</inertial><collision>{mesh}</collision>")
    )
    with pytest.raises(ModelError, match=r"/robot/meshes/part\.dae'.*convert it to \.stl"):
        read_model(path)


def plate(mass: str, moments: str) -> str:
    """Write a URDF with one link."""
    x, y, z = moments.split()
    inertia = f'<inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/>'
    link = f'<link name="plate"><inertial><mass value="{mass}"/>{inertia}</inertial></link>'
    joint = HINGE.format("j", "base", "plate")
    return f'<robot name="r"><link name="base"/>{link}{joint}</robot>'


@pytest.mark.parametrize(
    ("mass", "moments", "notes"),
    [
        ("1", "0.01 0.01 0.01", ()),
        ("1", "0.01 0.01 0.1", ("plate (1; 0.01 0.01 0.1, now 1; 0.04 0.04 0.04)",)),
        ("0", "0 0 0", ("plate (0; 0 0 0, now 1e-06; 1e-09 1e-09 1e-09)",)),
    ],
)
def test_a_mass_or_inertia_that_is_replaced_is_noted(
    mass: str, moments: str, notes: tuple[str, ...]
) -> None:
    """What no body can have is replaced by the compiler, and a note has both numbers."""
    found = read_model(plate(mass, moments)).notes
    assert len(found) == len(notes)
    assert all(one in note for one, note in zip(notes, found, strict=True))


def test_efforts_that_are_too_large_are_noted_with_a_remedy() -> None:
    """The acceleration of a motor at its limit at the start pose, and a limit that is gentle."""
    text = plate("1", "0.001 0.001 0.001").replace("continuous", "revolute")
    limit = '<limit lower="0" upper="1" effort="{}" velocity="1"/></joint>'
    (note,) = read_model(text.replace("</joint>", limit.format(300))).notes
    assert "accelerate j (effort 300 N m: 3e+05 rad/s²)" in note
    assert "spaces={'j.control': {'bounds': (-1, 1)}}" in note
    assert not read_model(text.replace("</joint>", limit.format(1))).notes
    given = {"j.control": {"bounds": (-1, 1)}}
    world = World(text.replace("</joint>", limit.format(300)), spaces=given)
    assert world.action_high.tolist() == [1.0]


def test_warnings_of_the_compiler_are_notes(capfd: pytest.CaptureFixture[str]) -> None:
    """Each once, and none is printed or written into a log of MuJoCo's."""
    text = plate("1", "1 1 1").replace("continuous", "revolute")
    notes = read_model(text.replace("</joint>", '<limit lower="1" upper="1"/></joint>')).notes
    assert [note for note in notes if note.startswith("MuJoCo warns: joint 'j' has equal")]
    assert len(set(notes)) == len(notes)
    assert not capfd.readouterr().err
    assert mujoco.get_mju_user_warning() is None


# --- keyframes ---------------------------------------------------------------------------------

RAISED = PENDULUM.replace(
    "</mujoco>",
    '<keyframe><key name="up" qpos="1" qvel=".5" ctrl=".7"/><key qpos="-1"/></keyframe></mujoco>',
)


@pytest.mark.parametrize(("keyframe", "begin"), [("up", (1.0, 0.5, 0.7)), (1, (-1.0, 0.0, 0.0))])
def test_a_keyframe_is_where_everything_begins(
    keyframe: str | int, begin: tuple[float, ...]
) -> None:
    """Positions, velocities and controls are defaults; without a name it has its number."""
    model = read_model(RAISED, keyframe=keyframe)
    assert tuple(row.default for row in (*model.states, *model.inputs)) == begin
    assert model != read_model(RAISED)
    assert not model.notes


def test_an_unknown_keyframe_is_answered_with_all_there_are() -> None:
    """By name, or by number where there is none."""
    with pytest.raises(UnknownOption, match=r"no keyframe is named 'down'.*: up, 1"):
        read_model(RAISED, keyframe="down")


def test_plugins_are_refused_by_name() -> None:
    """What a plugin acts on is unknown."""
    plugin = '<plugin plugin="mujoco.pid"><instance name="p"/></plugin>'
    text = PENDULUM.replace("<worldbody>", f"<extension>{plugin}</extension><worldbody>")
    text = text.replace("<motor", '<plugin plugin="mujoco.pid" instance="p"')
    with pytest.raises(ModelError, match=r"uses 1 plugin\(s\) \(mujoco.pid\)"):
        read_model(text)


def test_flexes_act_without_variables() -> None:
    """Their vertices are states, their material is mentioned in a note."""
    model = read_model(
        """<mujoco><worldbody><flexcomp name="cloth" type="grid" count="3 3 1" spacing="0.1 0.1 0.1"
        dim="2" radius="0.01"><edge equality="true"/></flexcomp></worldbody></mujoco>"""
    )
    assert any("flex" in note for note in model.notes)
    assert len(model.states) == 2 * 3 * 9
    assert all(row.always == set(range(9)) for row in model.states)
    assert not any(row.name.startswith("cloth_1") for row in model.parameters)


@pytest.mark.slow
def test_every_other_suite_model_is_read() -> None:
    """Also those with a skin and hundreds of variables."""
    model = read_model(model_file(f"{SUITE}dog.xml"))
    assert any("skin" in note for note in model.notes)
    assert len(model.parameters) > 1000
