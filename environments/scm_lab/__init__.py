"""A laboratory of scm_world as an OpenEnv environment."""

from .client import ScmLabEnv
from .models import CallToolAction, CallToolObservation, ListToolsAction

__all__ = ["CallToolAction", "CallToolObservation", "ListToolsAction", "ScmLabEnv"]
