"""Cloning behavior: demonstrations, a network, and rounds in which it is let play along."""

from __future__ import annotations

import json
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, final

from pydantic import ValidationError

from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation.policies.cards import OPTIONS, PolicyAbout
from scm_world.evaluation.policies.weights import NetworkPolicy, load_policy, save_policy
from scm_world.evaluation.recording import Recording
from scm_world.output.durable import locked, made, write_whole
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.training.imitation.demonstrations import (
    Demonstrations,
    School,
    joined,
    recorded,
)
from scm_world.training.imitation.fitting import fitted
from scm_world.training.imitation.lessons import Lesson
from scm_world.training.learners import torch
from scm_world.training.loop import Tell, torch_threads
from scm_world.training.recipe import Recipe
from scm_world.training.runs import differences, read_about, strangers_in
from scm_world.training.settings import refused
from scm_world.training.trials import tried
from scm_world.world.start import whole_number

FORMAT = "scm_world/clone/1"
SHARD = 25
"""Episodes in a file."""


@final
@dataclass(frozen=True)
class Cloned:
    """A network that has learned from a teacher.

    Attributes:
        folder: Of its files.
        lesson: How it learned.
        seed: Of everything that was drawn.
        policy: The file of the policy after the last round.
        best: The file of the one that was best in the evaluations; the last one without them.
        score: Of that one, mean last fractional success; None without evaluations.
    """

    folder: Path
    lesson: Lesson
    seed: int
    policy: Path
    best: Path
    score: float | None


def clone(
    source: Recording | Path | str | None,
    lesson: Lesson,
    *,
    out: Path | str,
    seed: int = 0,
    backend: str = "mujoco",
    progress: Progress | None = None,
    tell: Tell | None = None,
) -> Cloned:
    """Let a network learn to do what a teacher does.

    The teacher shows episodes; those that end well are learned from. In each round after that the
    network acts now and then, the teacher says what it would have done, and the network learns
    anew from all of it.

    If ``out`` holds a part of the same work, it goes on after the last whole file of episodes, or
    the last round. What comes out follows from the lesson, the seed, the engine and the versions.

    Args:
        source: Where demonstrations come from: None for the teacher of the lesson; a recording,
            its Parquet file, or a folder of such files, from which alone is learned then, with
            the environment that they were made in.
        lesson: What is shown, and how it is learned.
        out: Folder for all files.
        seed: Of everything that is drawn.
        backend: Name of the engine.
        progress: Told how many episodes have been shown, and how many will be.
        tell: Told in words what happens.

    Returns:
        Where its policies are.

    Raises:
        MissingExtra: torch is not installed.
        ModelError: There are no demonstrations that ended well.
        ActionError: The teacher cannot act in this task, or not by such actions.
        UnknownOption: Something does not exist, or the recording is of another task.
        UnreadableFile: Something else is in the folder, or a file is damaged.
        UnwritableFolder: There is no room, or no permission.
    """
    torch()
    number, folder = whole_number("seed", seed, least=0), Path(out)
    given = None if source is None else given_demonstrations(source, lesson)
    if given is not None:
        lesson = given.lesson
    school = None if given else School(lesson, backend=backend, seed=number)
    try:
        with locked(folder), torch_threads(1):
            course = _Course(folder, lesson, number, backend, progress, tell or (lambda _: None))
            course.open(given)
            return course.run(given, school)
    finally:
        if school is not None:
            school.close()


@final
@dataclass(frozen=True)
class Given:
    """Demonstrations that were made before.

    Attributes:
        shown: The demonstrations.
        lesson: What is learned from them, in the environment that they were made in.
        digest: Sums them up.
    """

    shown: Demonstrations
    lesson: Lesson
    digest: str


def given_demonstrations(source: Recording | Path | str, lesson: Lesson) -> Given:
    """Read demonstrations that were made before.

    Args:
        source: A recording, its file, or a folder of such files.
        lesson: What should be learned from them.

    Raises:
        UnknownOption: They are of another task, their actions are not in [-1, 1], or they lack what
            privileged observations have.
        UnreadableFile: There are none.
        ModelError: None ended well.
    """
    recordings = [source] if isinstance(source, Recording) else _recordings(Path(source))
    for one in recordings:
        task = one.environment["task"]
        name = task if isinstance(task, str) else getattr(task, "name", str(task))
        if name != lesson.task:
            raise UnknownOption("task of a recording", name, (lesson.task,))
    kept = [
        {name: one.environment[name] for name in OPTIONS if name in one.environment}
        for one in recordings
    ]
    if any(options != kept[0] for options in kept):
        raise ModelError(["the recordings were made in environments with different options"])
    plain = json.loads(json.dumps(kept[0]))
    learned = lesson.model_copy(update={"env": plain, "rounds": 0})
    try:
        Lesson.model_validate(learned.model_dump(mode="json"))
    except ValidationError as error:
        raise refused("a recording to learn from", error) from None
    if learned.options != learned.env:
        allowed = ("plain: these recordings do not have the causal parameters",)
        raise UnknownOption("observations", lesson.observations, allowed)
    shown = joined([recorded(one, lesson.keep) for one in recordings])
    digest = sha256(shown.observations.tobytes() + shown.actions.tobytes()).hexdigest()
    return Given(shown, learned, digest)


def _recordings(path: Path) -> list[Recording]:
    files = sorted(path.glob("*.parquet")) if path.is_dir() else [path]
    if not files:
        advice = "give a recording, or a folder with files that Recording.save has written"
        raise UnreadableFile(str(path), "there is no Parquet file in it", advice)
    return [Recording.load(file) for file in files]


@final
@dataclass(frozen=True)
class _Course:
    """A lesson under way, in its folder."""

    folder: Path
    lesson: Lesson
    seed: int
    backend: str
    progress: Progress | None
    tell: Tell

    def open(self, given: Given | None) -> None:
        """Begin in the folder, or find out that the same was begun there."""
        identity = {
            "lesson": self.lesson.about(),
            "seed": self.seed,
            "backend": self.backend,
            "recording": None if given is None else given.digest,
        }
        about = self.folder / "clone.json"
        if about.exists():
            wrong = differences(read_about(about, FORMAT, "clone"), identity)
            if wrong:
                reason = f"it holds other work: {'; '.join(wrong)}"
                raise UnreadableFile(str(self.folder), reason, "give another folder")
            return
        if strangers := strangers_in(self.folder, about):
            reason = f"there is no clone in it, but {', '.join(strangers[:5])}"
            raise UnreadableFile(str(self.folder), reason, "give an empty folder, or a new one")
        write_whole(json.dumps({"format": FORMAT, **identity}, indent=2), about)

    def run(self, given: Given | None, school: School | None) -> Cloned:
        """Do all rounds that are not done yet."""
        shown: list[Demonstrations] = [] if given is None else [given.shown]
        learner: NetworkPolicy | None = None
        for round_ in range(self.lesson.rounds + 1):
            if school is not None:
                shown += self._collected(school, round_, learner)
            learner = self._learned(round_, joined(shown), school.engine if school else "")
        return self._finished()

    def _collected(
        self, school: School, round_: int, learner: NetworkPolicy | None
    ) -> list[Demonstrations]:
        """Let a round of episodes be shown, or read what was shown before."""
        lesson = self.lesson
        first = 0 if round_ == 0 else lesson.episodes + (round_ - 1) * lesson.more
        count = lesson.episodes if round_ == 0 else lesson.more
        folder = self.folder / "demonstrations"
        made(folder)
        found = []
        for begin in range(first, first + count, SHARD):
            numbers = range(begin, min(begin + SHARD, first + count))
            path = folder / f"{round_:02}-{begin:06}.npz"
            if not path.exists():
                school.shown(round_, numbers, learner).save(path)
            found.append(Demonstrations.load(path))
            if self.progress is not None:
                self.progress(numbers.stop, lesson.episodes + lesson.rounds * lesson.more)
        return found

    def _learned(self, round_: int, shown: Demonstrations, engine: str) -> NetworkPolicy:
        """Fit a network in a round, or read the one that was fitted before."""
        path = self._round(round_)
        made(path.parent)
        if not path.exists():
            self.tell(
                f"round {round_}: learns from {len(shown):,} control steps, of "
                f"{int(shown.kept.sum())} of {len(shown.kept)} episodes"
            )
            found = fitted(shown, self.lesson, seed=self.seed)
            policy = NetworkPolicy.of(found.tensors, self._about(round_, shown, found.loss))
            made_with = {**versions(engine), "torch": str(torch().__version__)}
            scores = self._scores(policy, len(shown))
            said = ", ".join(f"{name} {score:.3f}" for name, score in scores.items())
            self.tell(f"round {round_}: loss {found.loss:.4f}; {said or 'not evaluated'}")
            save_policy(path, policy, policy.about.with_card(trials=scores, versions=made_with))
        return load_policy(str(path))

    def _round(self, number: int) -> Path:
        return self.folder / "rounds" / f"{number:02}.safetensors"

    def _about(self, round_: int, shown: Demonstrations, loss: float) -> PolicyAbout:
        lesson = self.lesson
        card: dict[str, Any] = {
            "lesson": lesson.about(),
            "seed": self.seed,
            "backend": self.backend,
            "round": round_,
            "control_steps": len(shown),
            "episodes": {"shown": len(shown.kept), "kept": int(shown.kept.sum())},
            "teacher": float(shown.scores.mean()),
            "loss": loss,
        }
        return PolicyAbout(
            task=lesson.task, env=lesson.options, activation=lesson.network.activation, card=card
        )

    def _scores(self, policy: NetworkPolicy, steps: int) -> dict[str, float]:
        lesson = self.lesson
        if not lesson.trials.protocols:
            return {}
        recipe = Recipe(task=lesson.task, env=lesson.options, trials=lesson.trials)
        return dict(tried(policy, recipe, backend=self.backend, steps=steps).scores)

    def _finished(self) -> Cloned:
        """Put the policies where they are looked for."""
        policies = [load_policy(self._round(number)) for number in range(self.lesson.rounds + 1)]
        means = [_mean(policy.about.card.get("trials")) for policy in policies]
        last, best = self.folder / "policy.safetensors", self.folder / "best.safetensors"
        save_policy(last, policies[-1])
        if None in means:
            return Cloned(self.folder, self.lesson, self.seed, last, last, None)
        ranked = max(range(len(means)), key=lambda number: (means[number], number))
        save_policy(best, policies[ranked])
        return Cloned(self.folder, self.lesson, self.seed, last, best, means[ranked])


def _mean(scores: Any) -> float | None:
    return sum(scores.values()) / len(scores) if scores else None
