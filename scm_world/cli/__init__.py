"""The command line: discover, graph, do, list."""

import io
import sys


def main() -> None:
    """Run the command line; processes that a command starts import no more than this."""
    from scm_world.cli.app import app

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    app()
