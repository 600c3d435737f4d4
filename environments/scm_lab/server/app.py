"""The server of the environment: ``server --port 8000``, or ``uvicorn server.app:app``."""

from __future__ import annotations

import argparse

import uvicorn
from openenv.core.env_server.http_server import create_app
from openenv.core.env_server.types import ConcurrencyConfig

try:
    from ..models import CallToolAction, CallToolObservation
    from .scm_lab_environment import ScmLabEnvironment
except ImportError:  # run in this folder, as the container does
    from models import CallToolAction, CallToolObservation
    from server.scm_lab_environment import ScmLabEnvironment

SESSIONS, IDLE = 64, 1800.0
"""The most sessions at once, and seconds after which a session without a call ends."""

app = create_app(
    ScmLabEnvironment,
    CallToolAction,
    CallToolObservation,
    env_name="scm_lab",
    concurrency_config=ConcurrencyConfig(max_concurrent_envs=SESSIONS, session_timeout=IDLE),
)


def main() -> None:
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000)
    args = parser.parse_args()
    uvicorn.run(app, host=args.host, port=args.port, ws_max_size=1 << 20)


if __name__ == "__main__":
    main()
