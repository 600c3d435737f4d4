"""The joint controller in plain floats: it runs between two engine calls, every physics step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from scm_world.models.scene import ControlMode
from scm_world.tasks.trifinger.controller import ControllerSpec

Law = Callable[[Sequence[Any], Sequence[float]], list[float]]
"""From joint states (position, velocity, …) and a command, nine each, to nine torques [N m]."""


def compile_law(spec: ControllerSpec, mode: ControlMode) -> Law:
    """Write ``ControllerSpec.torques`` without arrays; the numbers are the same, bit for bit."""
    gains = tuple(zip(spec.kp * 3, spec.kd * 3, spec.safety * 3, strict=True))
    high, low = spec.limit, -spec.limit

    def positions(states: Sequence[Any], command: Sequence[float]) -> list[float]:
        torques = []
        for state, target, (kp, kd, safety) in zip(states, command, gains, strict=True):
            velocity = state[1]
            torque = kp * (target - state[0]) - kd * velocity
            torque = high if torque > high else low if torque < low else torque
            torque -= safety * velocity
            torques.append(high if torque > high else low if torque < low else torque)
        return torques

    def torques(states: Sequence[Any], command: Sequence[float]) -> list[float]:
        safe = []
        for state, wanted, (_, _, safety) in zip(states, command, gains, strict=True):
            torque = high if wanted > high else low if wanted < low else wanted
            torque -= safety * state[1]
            safe.append(high if torque > high else low if torque < low else torque)
        return safe

    return positions if mode is ControlMode.JOINT_POSITIONS else torques
