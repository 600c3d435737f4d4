"""Probe states: where experiments are made.

All choices are drawn from keyed noise: probe i of a seed is the same, whatever ran before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import InterventionError
from scm_world.queries.experiments.placing import Dice, joints_for
from scm_world.queries.experiments.scenarios import AT_START, Scenario, scenarios
from scm_world.variables import Noise
from scm_world.world import World, WorldSnapshot

ATTEMPTS = 20  # how often a scenario is tried with other numbers where it is not feasible


@final
@dataclass(frozen=True)
class Probe:
    """A state to experiment in.

    Attributes:
        kind: How it came about.
        snapshot: Of the world.
        action: What the robot does next, shape (9,).
    """

    kind: str
    snapshot: WorldSnapshot
    action: Floats


def probes(
    world: World, n: int, seed: int, *, settled: bool = True, first: int = 0
) -> Iterator[Probe]:
    """Prepare probe states one after another.

    Args:
        world: To experiment with; it is reset for each probe.
        n: How many, those before the first one included.
        seed: Of the choices.
        first: Number of the first one.
        settled: Whether control steps may be taken first. Without them a probe state is made of
            the same numbers on every engine.
    """
    noise = Noise(seed)
    world.reset(seed=seed)
    kinds = scenarios(world)
    for number in range(first, n):
        yield _prepared(world, kinds[number % len(kinds)], noise, number, settled)


def _prepared(world: World, scenario: Scenario, noise: Noise, number: int, settled: bool) -> Probe:
    for attempt in range(ATTEMPTS):
        dice = Dice(noise, number, attempt)
        world.reset(seed=number)
        try:
            states, drive = scenario.prepare(world, dice)
            world.do(states)
        except InterventionError:
            continue
        return _settled(world, scenario if settled else replace(scenario, steps=0), drive, dice)
    world.reset(seed=number)
    dice = Dice(noise, number)
    start = AT_START if settled else replace(AT_START, steps=0)
    return _settled(world, start, AT_START.prepare(world, dice)[1], dice)


def _settled(world: World, scenario: Scenario, drive: Floats, dice: Dice) -> Probe:
    action = _command(world, drive, dice)
    drawn = round(dice.between(0.0, 2.0))
    for _ in range(drawn if scenario.steps is None else scenario.steps):
        world.step(action)
    return Probe(scenario.name, world.snapshot(), _command(world, drive, dice))


def _command(world: World, drive: Floats, dice: Dice) -> Floats:
    """Turn fingertip positions into an action of the world's mode, with a little variety."""
    if world.action_mode == "end_effector_positions":
        return np.asarray(drive + dice.between(-0.005, 0.005, 9))
    joints = joints_for(world, drive) + dice.between(-0.05, 0.05, 9)
    if world.action_mode == "joint_positions":
        return np.asarray(joints)
    return np.asarray(np.clip(5.0 * (joints - np.array(world["joint_positions"])), -0.3, 0.3))
