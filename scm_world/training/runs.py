"""The folder of a training: what it holds, and whether it is the one that is asked for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, final

from scm_world.errors import UnreadableFile
from scm_world.evaluation.setups import Place
from scm_world.output.durable import draft_of, write_whole
from scm_world.queries.experiments.versions import versions
from scm_world.training.checkpoints import checkpoints
from scm_world.training.recipe import Recipe

FORMAT = "scm_world/run/1"
CHECKPOINTS = "checkpoints"
LIBRARIES = ("torch", "stable-baselines3")


@final
@dataclass(frozen=True)
class Run:
    """A training, and the folder in which it is kept.

    Attributes:
        folder: Of its files.
        recipe: How the agent is trained.
        seed: Of everything that is drawn.
        backend: Name of the engine.
        threads: Of torch.
        device: Where networks are computed.
        start: Policy file that it begins with, if any.
    """

    folder: Path
    recipe: Recipe
    seed: int
    backend: str
    threads: int = 1
    device: str = "cpu"
    start: Path | None = None

    @property
    def about(self) -> Path:
        """The file that says what it is."""
        return self.folder / "run.json"

    @property
    def curve(self) -> Path:
        """The learning curve."""
        return self.folder / "progress.csv"

    @property
    def checkpoints(self) -> Path:
        """The folder of its checkpoints."""
        return self.folder / CHECKPOINTS

    @property
    def replay(self) -> Path:
        """The folder of the replay buffer."""
        return self.folder / "replay"

    @property
    def trials(self) -> Path:
        """The folder of the evaluations while it runs."""
        return self.folder / "evaluations"

    @property
    def policy(self) -> Path:
        """The policy at the end, or at the last checkpoint."""
        return self.folder / "policy.safetensors"

    @property
    def best(self) -> Path:
        """The policy that was best in the evaluations while it ran."""
        return self.folder / "best.safetensors"

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What decides what is learned, as plain data."""
        start = None
        if self.start is not None:
            try:
                start = sha256(self.start.read_bytes()).hexdigest()
            except OSError as error:
                advice = "give a policy file to start from"
                raise UnreadableFile(str(self.start), str(error), advice) from None
        options = self.recipe.env.get("task_options")
        about = Place(self.recipe.task, {"task_options": options}).about()
        return {
            **{name: about[name] for name in ("class", "model") if name in about},
            "recipe": self.recipe.as_dict(),
            "seed": self.seed,
            "backend": self.backend,
            "threads": self.threads,
            "device": self.device,
            "start": start,
        }

    def card(self, engine: str) -> dict[str, Any]:
        """Say how its policy is made, as plain data."""
        found = {**versions(engine), **{name: version(name) for name in LIBRARIES}}
        return {**self.identity, "versions": found}

    def open(self, engine: str) -> bool:
        """Begin in the folder, or go on there.

        A training may become longer, unless its settings depend on how long it is.

        Args:
            engine: Name and version of the physics engine.

        Returns:
            Whether there is a part of this training.

        Raises:
            UnreadableFile: Another training is in the folder; it says what is different.
            UnwritableFolder: There is no room, or no permission.
        """
        if self.about.exists():
            self._compare(read_about(self.about))
        elif strangers := strangers_in(self.folder, self.about):
            reason = f"there is no training in it, but {', '.join(strangers[:5])}"
            raise UnreadableFile(str(self.folder), reason, "give an empty folder, or a new one")
        data = {"format": FORMAT, **self.card(engine)}
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(json.dumps(data, indent=2, allow_nan=False), self.about)
        return bool(checkpoints(self.checkpoints))

    def _compare(self, there: Mapping[str, Any]) -> None:
        """Refuse another training."""
        wanted, steps = self.identity, self.recipe.steps
        before = there.get("recipe", {}).get("steps")
        if self.recipe.may_grow and isinstance(before, int) and before < steps:
            wanted = {**wanted, "recipe": {**wanted["recipe"], "steps": before}}
        if wrong := differences(there, wanted):
            reason = f"it holds another training: {'; '.join(wrong)}"
            advice = "give another folder, or the same options as before"
            raise UnreadableFile(str(self.folder), reason, advice)

    def newer(self, engine: str) -> list[str]:
        """Say which versions are others than when the training began."""
        before = read_about(self.about).get("versions", {}) if self.about.exists() else {}
        return [
            f"{name} was {before[name]} and is {now} now: the last bits may be others"
            for name, now in self.card(engine)["versions"].items()
            if before.get(name, now) != now
        ]


def strangers_in(folder: Path, about: Path) -> list[str]:
    """Name what is in a folder besides the draft of a file, which a crash may leave there."""
    names = (path.name for path in folder.iterdir()) if folder.exists() else ()
    return sorted(name for name in names if name != draft_of(about).name)


def read_about(path: Path, form: str = FORMAT, command: str = "train") -> dict[str, Any]:
    """Read what a folder says of the work in it.

    Args:
        path: Of the file.
        form: The format that it has to have.
        command: Of ``scm-world``, which writes such folders.

    Raises:
        UnreadableFile: It is damaged, or of another kind.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data, dict) or data.get("format") != form:
            raise ValueError(f"it is not of the format {form!r}")
    except (OSError, ValueError) as error:
        advice = f"give a folder that scm-world {command} has written, or a new one"
        raise UnreadableFile(str(path), str(error), advice) from None
    return data


def differences(there: Any, here: Any, where: str = "") -> list[str]:
    """Say in what plain data are different; what is there besides does not matter.

    Example:
        >>> differences({"seed": 1, "recipe": {"steps": 8}}, {"seed": 2, "recipe": {"steps": 8}})
        ['seed is 1 there, and 2 was asked for']
    """
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        names = [*here, *(name for name in there if where and name not in here)]
        return [
            line
            for name in names
            for line in differences(
                there.get(name), here.get(name), f"{where}.{name}" if where else name
            )
        ]
    if there == here:
        return []
    return [f"{where.removeprefix('recipe.')} is {there!r} there, and {here!r} was asked for"]
