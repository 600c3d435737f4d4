"""The client of the environment."""

from __future__ import annotations

from typing import Any

from openenv.core import EnvClient
from openenv.core.client_types import StepResult
from openenv.core.env_server.types import State

from .models import CallToolAction, CallToolObservation, ListToolsAction, Tool, ToolError


class ScmLabEnv(EnvClient[CallToolAction, CallToolObservation, State]):
    """An episode in a laboratory: a session of its own on the server.

    Example:
        with ScmLabEnv(base_url="http://localhost:8000").sync() as env:
            question = env.reset(seed=0, kind="effect").observation.result
            found = env.step(CallToolAction(tool_name="observe", arguments={"n": 5}))
            answer = {"answer": 0.0, "confidence": 0.1}
            print(env.step(CallToolAction(tool_name="submit", arguments=answer)).reward)
    """

    def _step_payload(self, action: CallToolAction | ListToolsAction) -> dict[str, Any]:
        return action.model_dump(exclude={"metadata"})

    def _parse_result(self, payload: dict[str, Any]) -> StepResult[CallToolObservation]:
        found = payload["observation"]
        if "tools" in found:
            found = {"tool_name": "list_tools", "result": [Tool(**one) for one in found["tools"]]}
        error = found.get("error")
        observation = CallToolObservation(
            tool_name=found["tool_name"],
            result=found.get("result"),
            error=ToolError(**error) if error else None,
            done=payload["done"],
            reward=payload["reward"],
            metadata=payload.get("metadata") or {},
        )
        return StepResult(observation=observation, reward=payload["reward"], done=payload["done"])

    def _parse_state(self, payload: dict[str, Any]) -> State:
        return State(**payload)
