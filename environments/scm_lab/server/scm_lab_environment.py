"""A laboratory of scm_world: certified causal questions, tools, and a reward without a judge."""

from __future__ import annotations

import os
import secrets
from typing import Any
from uuid import uuid4

from openenv.core.env_server.interfaces import Environment
from openenv.core.env_server.types import Action, EnvironmentMetadata, State

from scm_world import lab

try:
    from ..models import (
        CallToolAction,
        CallToolObservation,
        ListToolsAction,
        ListToolsObservation,
        Tool,
        ToolError,
        ToolErrorType,
    )
except ImportError:  # run in this folder, as the container does
    from models import (
        CallToolAction,
        CallToolObservation,
        ListToolsAction,
        ListToolsObservation,
        Tool,
        ToolError,
        ToolErrorType,
    )

TOOLS = [Tool(**tool) for tool in lab.tools()]


class ScmLabEnvironment(Environment[Action, CallToolObservation, State]):
    """An episode is a question: experiments within a budget, and one answer.

    The reward is the score of the answer, in [0, 1]; every step before has the reward 0. A call
    that is refused costs and changes nothing, and its observation has a typed error.
    """

    SUPPORTS_CONCURRENT_SESSIONS = True

    def __init__(self) -> None:
        super().__init__()
        self._room: lab.Laboratory | None = None
        self._state = State(episode_id=str(uuid4()), step_count=0)

    def reset(
        self,
        seed: int | None = None,
        episode_id: str | None = None,
        kind: str = "effect",
        world: str = "equations",
        level: str = "L2",
        **knobs: Any,
    ) -> CallToolObservation:
        """Begin an episode, and return what the tool ``describe`` returns.

        Args:
            seed: Number of the question; one at random if it is left out.
            episode_id: Name of the episode.
            kind: A name of ``lab.KINDS``.
            world: A name of ``lab.WORLDS``.
            level: What the agent knows beforehand: L1 to L4.
            knobs: Further arguments of ``lab.question``, such as ``noise=0.1``.

        The environment variable ``SCM_LAB_KEY`` of the server makes the questions private.
        """
        number = secrets.randbelow(2**31) if seed is None else seed
        key = os.environ.get("SCM_LAB_KEY")
        question = lab.question(kind, world, number, level, key=key, **knobs)
        self._room = lab.Laboratory(question)
        self._state = State(episode_id=episode_id or str(uuid4()), step_count=0, seed=number)
        return CallToolObservation(
            tool_name="describe", result=self._room.describe(), metadata={"seed": number}
        )

    def step(
        self, action: Action, timeout_s: float | None = None, **kwargs: Any
    ) -> CallToolObservation | ListToolsObservation:
        """Call a tool, or list the tools."""
        if isinstance(action, ListToolsAction):
            return ListToolsObservation(tools=TOOLS)
        assert isinstance(action, CallToolAction)
        name, error = action.tool_name, None
        if self._room is None:
            found, why = {}, ToolErrorType.EXECUTION_ERROR
            error = ToolError(error_type=why, message="call reset first")
        else:
            found = self._room.call(name, action.arguments)
            if "refused" in found:
                known = name in {tool.name for tool in TOOLS}
                why = ToolErrorType.INVALID_ARGS if known else ToolErrorType.TOOL_NOT_FOUND
                error = ToolError(error_type=why, message=found["refused"])
            else:
                self._state.step_count += 1
        score = self._room.score if self._room else None
        return CallToolObservation(
            tool_name=name,
            result=None if error else found,
            error=error,
            done=score is not None,
            reward=score["score"] if score and not error else 0.0,
            metadata={"score": score} if score else {},
        )

    @property
    def state(self) -> State:
        """Name, seed and number of accepted calls of the episode."""
        return self._state

    def get_metadata(self) -> EnvironmentMetadata:
        """Return name and description of the environment."""
        return EnvironmentMetadata(
            name="scm_lab",
            description="Certified causal questions in simulated laboratories, graded exactly.",
            version="0.1.0",
        )
