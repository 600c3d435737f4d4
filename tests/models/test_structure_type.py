"""What every engine may ask a system for, whatever kind of system it is."""

import pickle

import numpy as np
import pytest

from scm_world.backends import make_backend, read_model
from scm_world.models import Structure
from scm_world.tasks import StepTask
from scm_world.tasks.trifinger.system import trifinger
from scm_world.variables import Action, Box, Exogenous, Measured

BODY = "<body name='ball'><freejoint/><geom size='0.1'/></body>"


def drift(parameters, state, action, noise):
    """Move a place by a wind and a push."""
    return {"place": state["place"] + parameters["wind"] + action["push"]}


def walk() -> Structure:
    """Return the system of a step function."""
    return StepTask(
        drift,
        parameters=[Exogenous(name="wind", shape=(2,), default=(1.0, 2.0))],
        states=[Measured(name="place", shape=(2,), default=(3.0, 4.0))],
        actions=[Action(name="push", shape=(2,), bounds=Box(-1.0, 1.0))],
    ).system


@pytest.mark.parametrize(
    ("structure", "bodies"),
    [
        (read_model(f"<mujoco><worldbody>{BODY}</worldbody></mujoco>"), ("world", "ball")),
        (trifinger(("tool_block",)), None),
        (walk(), ()),
    ],
    ids=["model", "robot", "function"],
)
def test_a_structure_describes_itself(structure: Structure, bodies: tuple[str, ...] | None) -> None:
    """Its scene has the defaults of its tables, engines take it, and a copy is equal."""
    assert isinstance(structure, Structure)
    scene, layout = structure.default_scene(), structure.layout
    assert layout.names == tuple(row.name for row in structure.states)
    assert set(scene.parameters) == {row.key for row in structure.parameters}
    np.testing.assert_array_equal(scene.state.vector, layout.start)
    assert bodies is None or structure.body_names == bodies
    engine = make_backend("mujoco" if structure.bodies else "step")
    engine.build(scene)
    engine.step(np.zeros(structure.n_commands), 0)
    np.testing.assert_array_equal(engine.read().vector[layout.can_be_set], scene.state.settable())
    engine.close()
    again = pickle.loads(pickle.dumps(structure))  # noqa: S301 # our own bytes
    assert again == structure
    assert hash(again) == hash(structure)
    assert again.digest == structure.digest
