"""Which trees each variable acts on: as declared, and as physics says."""

from __future__ import annotations

import copy
from contextlib import closing
from typing import Any

import mujoco
import numpy as np
import pytest
from model_files import GYMNASIUM, SUITE, TRANSMISSIONS, URDFS, driven, model_file, pile

from scm_world.backends import read_model
from scm_world.backends.mujoco.reading import compiled
from scm_world.models import Model
from scm_world.queries import World, verify

INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
STEPS = 5

WORKSHOP = """
<mujoco><worldbody><geom name="floor" type="plane" size="9 9 0.1"/>
  <body name="post" pos="0 0 0.5">
    <geom name="post" type="cylinder" size="0.1 0.5" mass="3"/>
    <body name="arm" pos="0 0 0.5"><joint name="arm" axis="0 1 0"/>
      <geom name="arm" type="capsule" size="0.03" fromto="0 0 0 0.4 0 0"/>
      <site name="tip" pos="0.4 0 0"/></body>
    <body name="boom" pos="0 0.3 0.5"><joint name="boom" axis="0 1 0"/>
      <geom name="boom" type="capsule" size="0.03" fromto="0 0 0 -0.4 0 0"/></body>
  </body>
  <body name="load" pos="0.4 0 0.1"><freejoint/>
    <geom name="load" type="box" size="0.1 0.1 0.1"/><site name="load"/></body>
  <body name="crate" pos="0.42 0 0.31"><freejoint/>
    <geom name="crate" type="box" size="0.1 0.1 0.1"/></body>
  <body name="ghost" pos="3 0 1"><joint name="ghost" axis="0 1 0"/>
    <geom name="ghost" size="0.1" pos="0.1 0 0" contype="0" conaffinity="0"/></body>
  <body name="left" pos="5 0 1"><joint name="left" axis="0 1 0"/>
    <geom name="left" size="0.1" pos="0.1 0 0" contype="2" conaffinity="2"/></body>
  <body name="right" pos="6 0 1"><joint name="right" axis="0 1 0" damping="0.1"/>
    <geom name="right" size="0.1" pos="0.1 0 0" contype="4" conaffinity="4"/></body>
  <site name="hook" pos="3 0 2"/>
</worldbody>
<contact><exclude body1="load" body2="post"/></contact>
<tendon><spatial name="rope" limited="true" range="0 0.35"><site site="tip"/><site site="load"/>
</spatial></tendon>
<equality><joint joint1="left" joint2="right"/></equality>
<actuator><motor name="arm" joint="arm"/><motor name="pull" tendon="rope"/></actuator></mujoco>
"""


def effects(model: Model) -> dict[str, tuple[set[str], set[str]]]:
    """Name the trees that each variable acts on: always, and by contact."""
    return {
        row.name: (
            {model.trees[tree] for tree in row.always},
            {model.trees[tree] for tree in row.contact},
        )
        for row in (*model.parameters, *model.states, *model.inputs)
    }


def test_couplings_and_contacts_decide_what_acts_on_what() -> None:
    """Arms on one post, a rope and a constraint couple; contact is passed on by what moves."""
    model = read_model(
        WORKSHOP, expose=["*", "post.*", "post.mass", "hook.position", "tip.position"]
    )
    found = effects(model)
    assert model.trees == ("post", "load", "crate", "ghost", "left", "right")
    rig, pair = {"post", "load"}, {"left", "right"}
    everything = {*rig, "crate", "ghost", *pair}
    assert found["arm.position"] == (rig, {"crate"})  # the rope couples arm and load
    assert found["boom.mass"] == (rig, {"crate"})  # boom and arm hang from one post
    assert found["post.mass"] == (rig, {"crate"})  # it is where the tree's roundings come from
    assert found["pull.control"] == (rig, {"crate"})
    assert found["crate.mass"] == ({"crate"}, rig)
    assert found["crate.friction"] == (set(), {*rig, "crate"})
    assert found["floor.friction"] == (set(), {*rig, "crate"})
    assert found["left.damping"] == (pair, set())
    assert found["ghost.position"] == ({"ghost"}, set())
    assert found["hook.position"] == (set(), set())
    assert found["tip.position"] == (rig, {"crate"})
    assert found["gravity"] == (everything, set())
    assert found["floor.color"] == (set(), set())
    refused = dict(model.refused)
    assert refused["ghost.friction"].startswith("acts on nothing: its contacts")
    assert "left.friction" in refused  # its masks match nothing


def test_exclusions_and_pairs_are_heeded() -> None:
    """Two bodies that are excluded do not touch; a declared pair does, whatever the masks say."""
    two = pile(2).replace(
        ' type="plane" size="5 5 0.1"', ' type="plane" size="5 5 0.1" contype="0" conaffinity="0"'
    )
    apart = '<contact><exclude body1="b0" body2="b1"/></contact></mujoco>'
    model = read_model(two.replace("</mujoco>", apart))
    assert effects(model)["b0.mass"] == ({"b0"}, set())
    together = '<contact><pair geom1="g0" geom2="g1"/></contact></mujoco>'
    masked = two.replace('size="0.1 0.1 0.1"', 'size="0.1 0.1 0.1" contype="0" conaffinity="0"')
    model = read_model(masked.replace("</mujoco>", together))
    assert effects(model)["b0.mass"] == ({"b0"}, {"b1"})
    assert effects(model)["g0_g1.friction"] == (set(), {"b0", "b1"})
    none = read_model(pile(2, '<option><flag contact="disable"/></option>'))
    assert effects(none)["b0.mass"] == ({"b0"}, set())


# --- against physics ---------------------------------------------------------------------------


class Physics:
    """Runs a model from chosen states, and tells which trees a change has reached."""

    def __init__(self, model: Model) -> None:
        self.model, self.mj = model, copy.copy(compiled(model))
        self.data, self.scratch = mujoco.MjData(self.mj), mujoco.MjData(self.mj)
        self.slots = model.slots(self.mj, self.data)
        arrays = ("qpos", "qvel", "act")
        self.places = {array: model.places(array)[1] for array in arrays}
        self.data.warning.number[:] = 1
        self.tree = np.empty(model.layout.size, dtype=int)
        for row in model.states:
            self.tree[model.layout.slices[row.name]] = min(row.trees)
        self.start = np.empty(mujoco.mj_stateSize(self.mj, INTEGRATION))
        mujoco.mj_getState(self.mj, self.data, self.start, INTEGRATION)

    def vector(self) -> Any:
        """Read the state."""
        found = np.empty(self.model.layout.size)
        found[self.places["qpos"]] = self.data.qpos
        found[self.places["qvel"]] = self.data.qvel
        found[self.places["act"]] = self.data.act
        return found

    def random_states(self, rng: np.random.Generator, n: int) -> list[Any]:
        """Draw positions in range and velocities; let some of them fall together."""
        found = []
        for k in range(n):
            mujoco.mj_resetData(self.mj, self.data)
            push = rng.normal(size=self.mj.nv) * 0.1
            mujoco.mj_integratePos(self.mj, self.data.qpos, push, 1.0)
            self.data.qvel[:] = rng.normal(size=self.mj.nv) * 0.3
            mujoco.mj_step(self.mj, self.data, 60 * (k % 3))
            found.append(self.vector())
        return found

    def run(self, vector: Any, control: Any) -> Any:
        """Make some steps from a state."""
        mujoco.mj_setState(self.mj, self.data, self.start, INTEGRATION)
        self.data.qpos[:] = vector[self.places["qpos"]]
        self.data.qvel[:] = vector[self.places["qvel"]]
        self.data.act[:] = vector[self.places["act"]]
        self.data.ctrl[:] = control
        mujoco.mj_step(self.mj, self.data, STEPS)
        return self.vector()

    def write(self, row: Any, value: Any) -> None:
        """Set a parameter."""
        self.slots[row.key].write(value)
        if self.slots[row.key].constant:
            mujoco.mj_setConst(self.mj, self.scratch)

    def changed(self, row: Any, vector: Any, control: Any, rng: np.random.Generator) -> set[int]:
        """Intervene on one variable, and list the trees that are then not the same to the bit."""
        before = self.run(vector, control)
        vector, control = vector.copy(), control.copy()
        where = self.model.layout.slices.get(row.name)
        if where is not None:
            vector[where] += rng.normal(size=where.stop - where.start) * 0.02
            if row.kind == "rotation":
                vector[where] /= np.linalg.norm(vector[where])
            after = self.run(vector, control)
        elif row in self.model.inputs:
            control[self.model.inputs.index(row)] += 0.1
            after = self.run(vector, control)
        else:
            default = np.array(np.broadcast_to(row.default, row.shape))
            other = default * 1.2 if default.any() else default + 0.05
            self.write(row, 1.0 - default if row.kind == "switch" else other)
            after = self.run(vector, control)
            self.write(row, default)
        return set(self.tree[(before != after) & ~(np.isnan(before) & np.isnan(after))].tolist())


COUPLED = [
    WORKSHOP,
    pile(5),
    pile(4, '<option integrator="RK4"/>'),
    pile(4, '<option solver="PGS" cone="elliptic"/>'),
    pile(4, '<option solver="CG" noslip_iterations="3" density="100" wind="1 0 0"/>'),
    f"{SUITE}ball_in_cup.xml",
    f"{SUITE}finger.xml",
    f"{GYMNASIUM}reacher.xml",
    *(pytest.param(driven(kind), id=kind) for kind in TRANSMISSIONS),
    *(
        pytest.param(name, marks=pytest.mark.slow)
        for name in (
            f"{SUITE}stacker.xml",
            f"{SUITE}manipulator.xml",
            f"{SUITE}quadruped.xml",
            f"{GYMNASIUM}pusher_v5.xml",
            f"{URDFS}a1/a1.urdf",
            f"{URDFS}quadruped/minitaur.urdf",
        )
    ),
]


@pytest.mark.parametrize("source", COUPLED)
def test_nothing_acts_where_nothing_is_declared(source: str) -> None:
    """Interventions on every variable reach declared trees only; others keep every bit."""
    model = read_model(source if source.lstrip().startswith("<") else model_file(source))
    rng, physics = np.random.default_rng(0), Physics(model)
    assert len(model.trees) > 1
    states = physics.random_states(rng, 6)
    undeclared, fired = [], 0
    for row in (*model.parameters, *model.states, *model.inputs):
        for vector in states:
            control = rng.normal(size=len(model.inputs)) * 0.3
            reached = physics.changed(row, vector, control, rng)
            undeclared += [(row.name, tree) for tree in reached - row.always - row.contact]
            fired += len(reached)
    assert not undeclared
    assert fired > len(model.states)


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit"])
def test_the_inner_state_of_an_actuator_follows_its_control_alone(integrator: str) -> None:
    """No motion acts on that of a muscle, a filter or an integrator; it moves what is driven."""
    arm = '<body><joint name="{0}"/><geom name="{0}" size=".1" pos=".2 {1} 0"/></body>'
    text = f"""<mujoco><option integrator="{integrator}"/><worldbody>{arm.format("near", 0)}
        {arm.format("far", 1)}</worldbody><actuator>
        <muscle name="muscle" joint="near" lengthrange="-1 1"/>
        <general name="filter" joint="near" dyntype="filterexact" dynprm=".1"/>
        <intvelocity name="servo" joint="far" kp="5" actrange="-1 1"/></actuator></mujoco>"""
    with closing(World(text)) as world:
        found = verify(world, probes=3, held_out=1)
        for name in ("muscle", "filter", "servo"):
            own = {*(f"{name}.{what}" for what in ("activation", "control")), "timestep"}
            own |= {f"{name}.timeconst"} - {"servo.timeconst"}
            assert {c for c, effect, _ in found.declared if effect == f"{name}.activation"} == own
    assert found.undeclared == ()
    assert ("muscle.activation", "near.velocity", 1) in found.declared


@pytest.mark.parametrize("kind", TRANSMISSIONS)
def test_an_actuator_of_every_transmission_has_its_edges(kind: str) -> None:
    """Its control acts on the trees that the transmission joins."""
    model = read_model(driven(kind))
    trees = set(TRANSMISSIONS[kind][1].split())
    found = {model.trees[tree] for tree in model.inputs[0].always}
    assert {name for name in found if not name.endswith(".activation")} == trees
