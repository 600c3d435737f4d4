"""Physics engines that cannot do their work."""

from __future__ import annotations

from scm_world.errors.base import ScmWorldError


class EngineError(ScmWorldError, RuntimeError):
    """The physics engine cannot do its work.

    Attributes:
        engine: The name of the backend.
    """

    def __init__(self, message: str, engine: str) -> None:
        self.engine = engine
        super().__init__(message)


class MissingEngine(EngineError, ImportError):
    """The engine is not installed.

    Attributes:
        install: The command that installs it.
    """

    def __init__(self, engine: str, install: str, reason: str = "") -> None:
        self.install = install
        because = f" ({reason})" if reason else ""
        EngineError.__init__(
            self, f"the {engine} engine is not installed{because}; try: {install}", engine
        )


class MixedInstallation(EngineError):
    """Two versions of an engine lie in one folder.

    Attributes:
        versions: What was found, by distribution.
        repair: The command that repairs it.
    """

    def __init__(self, engine: str, versions: dict[str, str], repair: str) -> None:
        self.versions = dict(versions)
        self.repair = repair
        found = ", ".join(f"{name} {version}" for name, version in versions.items())
        super().__init__(
            f"the {engine} installation mixes versions ({found}); repair it with: {repair}", engine
        )


class EngineFailure(EngineError):
    """The engine produced a state that is not finite.

    Attributes:
        unmoved: Of a batch, the numbers of the scenes that are as they were.
    """

    unmoved: tuple[int, ...] = ()


class SnapshotMismatch(ScmWorldError, ValueError):
    """A snapshot of another scene cannot be restored here."""
