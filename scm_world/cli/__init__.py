"""The command line: discover, graph, do, list."""

from scm_world.cli.app import app, main

__all__ = ["app", "main"]
