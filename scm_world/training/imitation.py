"""Imitation: a network is fitted to demonstrations of a scripted or trained policy, or recorded."""

from __future__ import annotations

import copy
import io
import json
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Self, cast, final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from scm_world._arguments import load, one_of, whole_number
from scm_world._fingerprint import fingerprint
from scm_world._types import Floats, Observation
from scm_world.env import ScmWorldEnv
from scm_world.env.observer import FAILED
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation.episodes import Hook, in_world, play, under
from scm_world.evaluation.protocols import chosen, protocols_of
from scm_world.evaluation.recording import Recording, action_noise
from scm_world.policies import MlpPolicy, as_agent, save_policy
from scm_world.policies.cards import OPTIONS, context_of
from scm_world.policies.networks import policy_in
from scm_world.policies.scripted import NAMED, Policy
from scm_world.policies.zoo import PREFIX as ZOO
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress, Tell
from scm_world.queries.world import World
from scm_world.runs.files import is_there, read_arrays
from scm_world.runs.pool import Pool
from scm_world.runs.study import Study
from scm_world.tasks import TASKS, make_task
from scm_world.tasks.rewards import FRACTION, SUCCESS
from scm_world.training.export import mean, scored, words
from scm_world.training.loop import Trained, torch_threads
from scm_world.training.settings import (
    Count,
    Network,
    NotNegative,
    Observations,
    Positive,
    Share,
    TaskName,
    Trials,
    built,
    known_task,
    observed,
    presets,
)
from scm_world.variables.spaces import Frozen

SHARD = 25
"""Episodes in a file."""

SEED = 5_000_003
"""Added to seeds, so that no evaluation has the episodes of the demonstrations."""

UNIT = 0.1
"""Of actions, while they are learned: errors of that size count fully, larger ones linearly."""

CHANGES = 15.0
"""Weight of the loss where the memory changes, which is seldom."""

SEQUENCE = 32
"""Control steps through which the loss of a recurrent network is propagated back."""

ONLY: Mapping[str, tuple[Any, ...]] = {
    "normalize_actions": (True,),
    "observation_mode": ("structured", "full", "custom"),
    "context": ("none", "observation"),
    "stack_history": (False,),
    "goal_env": (False,),
}
"""Options whose other values give no vector of numbers, or actions that are not in [-1, 1]."""


# --- lessons --------------------------------------------------------------------------------------


@final
class Lesson(Frozen):
    """How a network learns from a teacher.

    Attributes:
        task: Name of the task.
        teacher: Name of a policy that reads the world's state; or a trained policy, in its own
            observations, ``"privileged"`` ones for example: its file, the folder of its run, or
            ``"zoo:name"``.
        env: Options of the environment, those that a policy file keeps.
        protocols: Names of protocols that vary the demonstrations, in turns; a name that stands
            there twice has twice as many.
        episodes: Number of those in which the teacher acts alone.
        rounds: How often the network acts now and then afterwards, and is trained again.
        more: Episodes of each of these rounds.
        noise: Largest standard deviation of the noise added to actions, in units of actions; each
            episode has one between 0 and that.
        share: Share of the control steps in which the network acts in those rounds, on average.
        stretch: Control steps that it acts at a stretch, on average.
        keep: Fractional success of an episode, in the end, that is learned from; success where the
            task has no other. A task without either needs 0: all episodes are learned from.
        settled: Control steps in a row that are as good as ``keep``, after which an episode of the
            teacher ends; None for the whole length of each. Recordings are taken as they are.
        symmetric: Whether each control step is also shown as the task's symmetries have it: the
            robot with three fingers looks the same after a third of a turn.
        memory: Whether the network learns the memory of the teacher, too: its answer about that
            it gets back in the next control step; see ``scm_world.policies.PolicyAbout``. Not from
            recordings. In rounds it is given what the teacher remembers.
        observations: ``"plain"``, or ``"privileged"``: the network observes every causal parameter.
        network: What learns. With ``recurrent`` an LSTM learns sequences: its state goes on from
            update to update, through which the loss is propagated back 32 control steps.
        updates: Steps of the optimizer, each time.
        batch: Control steps in each of them.
        rate: Learning rate at the beginning; it falls as a cosine.
        trials: Evaluations after each round; the best policy is kept.

    Source:
        Noise: Laskey et al., *DART*, CoRL 2017. Rounds: Ross et al., *DAgger*, AISTATS 2011; here
        the network acts in short stretches, since a teacher that has a plan is only right about
        small deviations from it.
    """

    task: TaskName
    teacher: str = "feedback"
    env: dict[str, Any] = Field(default_factory=dict)
    protocols: Annotated[tuple[str, ...], Field(min_length=1)] = ("P0", "P1", "P5")
    episodes: Count = 250
    rounds: Annotated[int, Field(ge=0)] = 1
    more: Count = 100
    noise: NotNegative = 0.04
    share: Annotated[float, Field(ge=0.0, le=0.5)] = 0.3
    stretch: Annotated[float, Field(ge=1.0, allow_inf_nan=False)] = 10.0
    keep: Share = 0.9
    settled: Count | None = None
    symmetric: bool = False
    memory: bool = False
    observations: Observations = "plain"
    network: Network = Field(default_factory=lambda: Network(activation="relu"))
    updates: Count = 20_000
    batch: Count = 512
    rate: Positive = 1e-3
    trials: Trials = Field(default_factory=lambda: Trials(protocols=("P1", "P5")))

    @field_validator("teacher")
    @classmethod
    def _named(cls, teacher: str) -> str:
        if teacher not in NAMED and not is_policy(teacher):
            allowed = (*NAMED, "a policy file", "the folder of a training", "'zoo:name'")
            raise UnknownOption("teacher", teacher, (*allowed, "a recording"))
        return teacher

    @field_validator("env")
    @classmethod
    def _of_a_policy(cls, env: dict[str, Any]) -> dict[str, Any]:
        for name, value in env.items():
            one_of("option of the environment of a lesson", name, OPTIONS)
            kind = context_of(value)[0] if name == "context" else value
            if kind not in (allowed := ONLY.get(name, (kind,))):
                raise UnknownOption(
                    f"{name} of a lesson", value, [json.dumps(one) for one in allowed]
                )
        return env

    @model_validator(mode="after")
    def _remembers(self) -> Self:
        if self.memory and self.symmetric:
            raise UnknownOption("symmetric", True, ("False", "True with memory=False"))
        if self.symmetric and self.env.get("history"):
            known = ("0", "a number with symmetric=False")
            raise UnknownOption("env.history of a lesson", self.env["history"], known)
        if self.network.recurrent is not None and (self.memory or self.symmetric):
            known = ("None", "a width with memory=False and symmetric=False")
            raise UnknownOption("network.recurrent", self.network.recurrent, known)
        if self.memory and not hasattr(NAMED.get(self.teacher, object)(), "memory"):
            allowed = (f"False: {self.teacher!r} does not report its memory",)
            raise UnknownOption("memory of a lesson", True, allowed)
        return self

    @property
    def options(self) -> dict[str, Any]:
        """Options of the environment, with all that follows from the other fields."""
        return observed(self.env, self.observations)

    def __str__(self) -> str:
        """Summarise the demonstrations and the fit in a line."""
        return (
            f"{self.task} by imitation: {self.episodes} episodes in {', '.join(self.protocols)}, "
            f"with noise up to {self.noise:g}, then {self.rounds} rounds of {self.more}; "
            f"observations {self.observations}"
        )

    def about(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {"format": "scm_world/lesson/1", **self.model_dump(mode="json")}


def is_policy(text: str) -> bool:
    """Return whether a text is the name of a trained policy in the zoo, its file or its run."""
    path = Path(text)
    is_run = any((path / name).is_file() for name in ("best.safetensors", "policy.safetensors"))
    return text.startswith(ZOO) or path.suffix == ".safetensors" or is_run


def teacher_in(lesson: Lesson, world: World) -> Callable[[], Policy]:
    """Return what makes the teacher of an episode in a world.

    A trained one observes, in its own form, a second world that is restored to every instant.
    """
    if lesson.teacher in NAMED:
        return NAMED[lesson.teacher]
    trained = in_world(lesson.teacher, world)
    return lambda: trained


def lesson(task: str, **changes: object) -> Lesson:
    """Return the lesson that works for a task, with changes.

    For a task that is not of this package, the protocols that it has of these vary: P0 at least.

    Args:
        task: Name of the task.
        changes: Fields of the ``Lesson``. Those that have parts (``env``, ``network``,
            ``trials``) change the parts that are named; ``a.b`` names a part of ``a``.

    Raises:
        UnknownOption: A field is unknown, or a value is impossible.

    Example:
        >>> lesson("picking", episodes=10, env={"frame_skip": 5}).env["frame_skip"]
        5
        >>> lesson("picking", **{"trials.episodes": 40}).trials.episodes
        40
    """
    fields: dict[str, Any] = Lesson.model_construct(task=task).model_dump(mode="json")
    fields |= copy.deepcopy(presets()["lessons"].get(task, {}))
    made = make_task(known_task(task))
    fields["env"] = {**made.training.get("env", {}), **fields["env"]}
    known = protocols_of(made)
    there = {protocol.name for protocol in known}
    for part in (fields, fields["trials"]) if task not in TASKS else ():
        usual = [name for name in part["protocols"] if name in there]
        part["protocols"] = usual or ["P0"]  # nothing varies: every task has it
    found = built(Lesson, "a lesson", fields, changes)
    chosen(dict.fromkeys(found.protocols), known)  # one that is there twice is shown twice
    chosen(found.trials.protocols or ("P0",), known)
    return found


# --- demonstrations -------------------------------------------------------------------------------


Demonstrations = dict[str, NDArray[Any]]
"""The control steps of successful episodes, and the scores of all episodes.

- ``observations``: Shape (n, k).
- ``actions``: What the teacher would have done, shape (n, n_actions), in [-1, 1].
- ``before``: What the teacher remembered before each control step, -1 or 1, or 0 in the first one
  of an episode, shape (n, m); m is 0 without a memory.
- ``after``: Its memory afterwards, of the same shape.
- ``lengths``: Rows of each episode that was kept.
- ``scores``: Fractional success at the end of each episode, shape (episodes,); its return where
  there is no success, and NaN where states grew beyond all bounds.
- ``kept``: Whether its control steps are there, shape (episodes,).
"""

ROWS = ("observations", "actions", "before", "after")


def successful(
    rows: Iterable[Any], lengths: Sequence[int], scores: Sequence[float], keep: float
) -> Demonstrations:
    """Return demonstrations; ``rows`` are the control steps of all episodes, in order of ``ROWS``.

    Episodes are left out whose score is less than ``keep`` (none with 0), or not a number.
    """
    ends = np.array(scores)
    kept = (ends >= keep) | ((keep == 0.0) & np.isfinite(ends))
    taken = np.repeat(kept, lengths)
    found = {n: np.array(one, np.float32)[taken] for n, one in zip(ROWS, rows, strict=True)}
    return {**found, "lengths": np.array(lengths)[kept], "scores": ends, "kept": kept}


def metric_of(names: Container[str], lesson: Lesson) -> str | None:
    """Return the info that says how good an episode is; None if there is none, and all are kept."""
    found = next((name for name in (FRACTION, SUCCESS) if name in names), None)
    if found is None and (lesson.keep or lesson.settled is not None):
        what = "keep of a lesson" if lesson.keep else "settled of a lesson"
        allowed = "0: all episodes are learned from" if lesson.keep else "None"
        reason = f"{allowed}, as {lesson.task} says neither {FRACTION!r} nor {SUCCESS!r}"
        raise UnknownOption(what, lesson.keep or lesson.settled, (reason,))
    return found


def joined(parts: Sequence[Demonstrations]) -> Demonstrations:
    """Put demonstrations together."""
    found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if not len(found["actions"]):
        scores = found["scores"]
        problem = (
            f"none of {len(scores)} demonstrations ended well enough to learn from; the best one "
            f"reached {np.nanmax(scores, initial=0.0):.3f}: take another teacher, less noise, or a "
            "smaller keep"
        )
        raise ModelError([problem])
    return found


def demonstrated(
    job: tuple[range, str],
    *,
    lesson: Lesson,
    seed: int,
    round_: int = 0,
    learner: MlpPolicy | None = None,
) -> Demonstrations:
    """Record episodes of the teacher, and now and then of a learner; those that fail are left out.

    So are those in which states grow beyond all bounds.

    The job has the numbers of the episodes and the backend. An episode follows from the seed, the
    round and its number.
    """
    numbers, backend = job
    options = {"on_failure": "truncate", **lesson.options}
    with closing(ScmWorldEnv(lesson.task, backend=backend, **options)) as env:
        metric, teacher = metric_of(env.world.model, lesson), teacher_in(lesson, env.world)
        known = protocols_of(lesson.task)
        taught = [one for name in lesson.protocols for one in chosen([name], known)]
        shown, lengths, scores = list[tuple[Any, ...]](), list[int](), list[float]()
        for number in numbers:
            acting = under(env, taught[number % len(taught)])
            random = np.random.default_rng([seed, round_, number])
            teaching = Teaching(lesson, teacher(), random, learner, metric)
            info = play(acting, teaching, hooks=[teaching], seed=SEED + seed, episode=number)
            shown += teaching.pairs
            lengths.append(len(teaching.pairs))
            scores.append(float("nan") if info[FAILED] else teaching.score)
    return successful(zip(*shown, strict=True), lengths, scores, lesson.keep)


@final
class Teaching(Hook):
    """Acts in an episode as the teacher does, or now and then as the learner does.

    ``pairs`` have a row for each control step, in order of ``ROWS``; ``metric`` is the info that
    says how good the present is, and ``score`` the last one, or the return without it.
    """

    def __init__(
        self,
        lesson: Lesson,
        teacher: Policy,
        random: np.random.Generator,
        learner: MlpPolicy | None,
        metric: str | None,
    ) -> None:
        self._lesson, self._random, self._learner = lesson, random, learner
        self._metric, self._learns, self._row, self.score = metric, False, 0, 0.0
        self._memory, self._teacher = np.empty(0), cast("Any", teacher)
        self._state: NDArray[Any] | None = None
        self.pairs: list[tuple[Any, ...]] = []

    def start(self, env: ScmWorldEnv) -> None:
        """Begin an episode."""
        self._env = env
        self._scale = self._lesson.noise * self._random.uniform()
        self._share = self._lesson.share * self._random.uniform(0.0, 2.0)
        self._noises = action_noise(self._random, env.world.compiled.n_actions)

    def act(self, observation: Observation) -> NDArray[Any]:
        """Keep the action of the teacher; return the one that is played."""
        env, lesson, teacher = self._env, self._lesson, self._teacher
        right = np.clip(env.as_action(teacher(env.world)), -1.0, 1.0)
        now = teacher.memory(env.world) if lesson.memory else self._memory
        before = self._memory if self.pairs else np.zeros_like(now)
        self._memory = now
        self.pairs.append((observation, right, before, now))
        if lesson.symmetric:
            names = env.observed or ()
            symmetries = env.world.task.observation.symmetries
            if symmetries is None:
                allowed = (f"False: {lesson.task} has no symmetries",)
                raise UnknownOption("symmetric of a lesson", True, allowed)
            for scene, order in symmetries(env.world.evaluate(names), names):
                self.pairs.append((env.observe_values(scene), right[list(order)], before, now))
        action: NDArray[Any] = right
        if self._learner is not None:
            if self._random.uniform() < 1.0 / lesson.stretch:
                self._learns = self._random.uniform() < self._share
            if self._learns or lesson.network.recurrent:
                state = before if lesson.memory else self._state
                said, after = self._learner.predict(observation, state)
                self._state = after if lesson.network.recurrent else None
                action = said if self._learns else right
        return np.clip(action + self._scale * next(self._noises), -1.0, 1.0)

    def after(self, observation: object, reward: float, info: Mapping[str, Any]) -> bool:
        """End the episode where it has been good for long enough."""
        if self._metric is None:
            self.score += reward
            return False
        self.score = float(info[self._metric])
        self._row = self._row + 1 if self.score >= self._lesson.keep else 0
        return self._row == self._lesson.settled


def given_demonstrations(
    source: Recording | Path | str, lesson: Lesson
) -> tuple[Demonstrations, Lesson]:
    """Read demonstrations of recordings, and return the lesson in their environment."""
    if isinstance(source, Recording):
        recordings = [source]
    else:
        path = Path(source)
        files = sorted(path.glob("*.parquet")) if path.is_dir() else [path]
        if not files:
            advice = "give a recording, or a folder with files that Recording.save has written"
            raise UnreadableFile(str(path), "the folder has no Parquet file", advice)
        recordings = [Recording.load(file) for file in files]
    for one in recordings:
        task = one.environment["task"]
        name = task if isinstance(task, str) else getattr(task, "name", str(task))
        if name != lesson.task:
            raise UnknownOption("task of a recording", name, (lesson.task,))
    options = [
        {n: one.environment[n] for n in OPTIONS if n in one.environment} for one in recordings
    ]
    if any(one != options[0] for one in options):
        raise ModelError(["the recordings were made in environments with different options"])
    fields = {**lesson.model_dump(mode="json"), "env": json.loads(json.dumps(options[0]))}
    fields |= {"rounds": 0, "symmetric": False, "memory": False}
    learned = built(Lesson, "a recording to learn from", fields)
    if learned.options != learned.env:
        allowed = ("plain: these recordings do not have the causal parameters",)
        raise UnknownOption("observations", lesson.observations, allowed)
    episodes = tuple(episode for one in recordings for episode in one)
    said = [name for name in (FRACTION, SUCCESS) if all(name in e.infos for e in episodes)]
    if not said and lesson.keep:
        problem = f"the recording does not say how episodes ended: record {FRACTION!r}, too, or "
        raise ModelError([problem + "learn from all of them with keep=0"])
    scores = [float(one.infos[said[0]][-1] if said else one.rewards.sum()) for one in episodes]
    seen, done = Recording(recordings[0].environment, episodes).pairs()
    rows = seen, done, *2 * [np.empty((len(seen), 0))]
    found = successful(rows, [len(episode) for episode in episodes], scores, lesson.keep)
    return joined([found]), learned


# --- fitting --------------------------------------------------------------------------------------


def fitted(
    shown: Demonstrations, lesson: Lesson, *, seed: int
) -> tuple[dict[str, NDArray[np.float32]], float]:
    """Fit a network to demonstrations, by Adam on Huber's loss.

    With a memory the network also learns the memory of the teacher afterwards, from that before. A
    recurrent one learns sequences, by truncated backpropagation through time.

    Observations are whitened: turned into their principal components, each with a standard
    deviation of one. So how far a fingertip is from a block counts as much as where both are. The
    first layer of the result has this turned back.

    Returns:
        The tensors of the network, by the names in a policy file, and the mean loss of the last
        tenth of the updates.
    """
    torch = load("torch", "torch", "train")
    observations, actions, *memories = (shown[name] for name in ROWS)
    turn, shift = whitening(observations)
    white, n_actions = len(turn), actions.shape[1]
    whitened = (observations @ turn.T + shift).astype(np.float32)
    seen = torch.from_numpy(np.concatenate([whitened, memories[0]], axis=1))
    done = torch.from_numpy(actions / np.float32(UNIT))
    before, after = map(torch.from_numpy, memories)
    weight = torch.where(after == before, 1.0, CHANGES)
    unit = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[lesson.network.activation]
    losses, huber = [], torch.nn.functional.smooth_l1_loss
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers: list[Any] = []
        width, lstm = seen.shape[1], None
        state: Any = None
        if lesson.network.recurrent:
            lstm = torch.nn.LSTMCell(width, width := lesson.network.recurrent)
            layers.append(lstm)
            sequences = in_sequences(shown["lengths"], max(1, lesson.batch // SEQUENCE), seed)
        for hidden in lesson.network.hidden:
            layers += [torch.nn.Linear(width, hidden), unit()]
            width = hidden
        network = torch.nn.Sequential(*layers, torch.nn.Linear(width, n_actions + after.shape[1]))
        body = network if lstm is None else network[1:]
        optimizer = torch.optim.Adam(network.parameters(), lr=lesson.rate)
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(
            optimizer, lesson.updates, eta_min=0.01 * lesson.rate
        )
        for _ in range(lesson.updates):
            if lstm is None:
                rows = torch.randint(0, len(seen), (lesson.batch,))
                found = body(seen[rows])
            else:
                taken, begins = next(sequences)
                hidden_now = []
                for now, goes_on in zip(seen[taken], torch.from_numpy(~begins), strict=True):
                    state = lstm(now, state and [part * goes_on[:, None] for part in state])
                    hidden_now.append(state[0])
                rows, found = torch.from_numpy(taken.ravel()), body(torch.cat(hidden_now))
                state = [part.detach() for part in state]
            loss = huber(found[:, :n_actions], done[rows])
            if after.shape[1]:
                said = huber(found[:, n_actions:], after[rows], reduction="none")
                loss = loss + (weight[rows] * said).mean()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            falling.step()
            losses.append(loss.item())
    last = float(np.mean(losses[-max(lesson.updates // 10, 1) :]))
    if not np.isfinite(last):
        raise ModelError(["the loss is not finite any more: take a smaller rate"])
    arrays = [tensor.detach().numpy().astype(np.float64) for tensor in network.parameters()]
    first = arrays[0][:, :white]
    bias = 1 if lstm is None else 2  # of an LSTM both weights come first
    arrays[0] = np.concatenate([first @ turn, arrays[0][:, white:]], axis=1)
    arrays[bias] = first @ shift + arrays[bias]
    for array in arrays[-2:]:
        array[:n_actions] *= UNIT
    kinds = ("weight", "bias")
    names = [f"lstm.{i}.{kind}" for kind in kinds for i in range(2)] if lstm is not None else []
    names += [f"layers.{i // 2}.{kinds[i % 2]}" for i in range(len(arrays) - len(names))]
    return {n: array.astype(np.float32) for n, array in zip(names, arrays, strict=True)}, last


def in_sequences(
    lengths: NDArray[Any], streams: int, seed: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """Yield rows of episodes that follow one another in ``streams``, and which begin an episode.

    Both have shape (``SEQUENCE``, streams). Episodes, of these ``lengths``, are drawn uniformly.
    """
    random, ends = np.random.default_rng(seed), np.cumsum(lengths)
    at = stop = np.zeros(streams, np.int64)
    while True:
        rows = np.empty((SEQUENCE, streams), np.int64)
        begins = np.empty((SEQUENCE, streams), bool)
        for row, over in zip(rows, begins, strict=True):
            over[:] = at == stop
            drawn = random.integers(len(ends), size=streams)
            at = np.where(over, (ends - lengths)[drawn], at)
            stop = np.where(over, ends[drawn], stop)
            row[:], at = at, at + 1
        yield rows, begins


def whitening(observations: NDArray[Any]) -> tuple[Floats, Floats]:
    """Return matrix, shape (m, k), and shift, shape (m,), that whiten observations, shape (n, k).

    Directions that do not vary are left out, unless none does; those that hardly do count less.

    Example:
        >>> points = np.random.default_rng(0).normal(size=(1000, 2)) * [3.0, 0.1] + 5.0
        >>> matrix, shift = whitening(points)
        >>> np.allclose(np.cov((points @ matrix.T + shift).T), np.eye(2), atol=1e-3)
        True
    """
    points = observations.astype(np.float64)
    middle = points.mean(axis=0)
    centered = points - middle
    variances, axes = np.linalg.eigh(centered.T @ centered / len(points))
    varied = variances > 1e-8
    varied[-1] = True
    matrix = (axes[:, varied] / np.sqrt(variances[varied] + 1e-6)).T
    return matrix, -matrix @ middle


# --- cloning --------------------------------------------------------------------------------------


def clone(
    source: Recording | Path | str | None,
    lesson: Lesson,
    *,
    out: Path | str,
    seed: int = 0,
    backend: str = "mujoco",
    workers: int | None = None,
    progress: Progress | None = None,
    tell: Tell | None = None,
) -> Trained:
    """Train a network to imitate a teacher.

    The network is fitted to the successful episodes of the teacher. In each further round the
    network acts now and then, the actions of the teacher are recorded (DAgger), and the network is
    fitted to all demonstrations.

    With several backends, files of episodes come from them in turns.

    The policy of a round is written before it is evaluated. If ``out`` holds a part of the same
    work, it resumes after the last whole file of episodes, the last fit or the last evaluation.
    The result follows from the lesson, the seed, the backend and the versions.

    Args:
        source: Where demonstrations come from: None for the teacher of the lesson; a recording,
            its Parquet file, or a folder of such files, from which alone is learned then, with
            the environment that they were made in.
        lesson: The demonstrations, and how the network learns.
        out: Folder for all files.
        seed: Seed of everything that is drawn.
        backend: Its name, or several with commas; evaluations are on the first one.
        workers: How many files of 25 demonstrations are recorded at the same time; None is one, in
            this process. It changes nothing in the result.
        progress: Called with how many episodes have been shown, and how many will be.
        tell: Called with a sentence about each event.

    Returns:
        Where its policies are.

    Raises:
        MissingExtra: torch is not installed.
        ModelError: There are no demonstrations that ended well.
        ActionError: The teacher cannot act in this task, or not by such actions.
        UnknownOption: Something does not exist, or the recording is of another task.
        UnreadableFile: Something else is in the folder, or a file is damaged.
        UnwritableFolder: The disk is full, or permission is missing.
    """
    torch = load("torch", "torch", "train")
    number, folder, say = whole_number("seed", seed, least=0), Path(out), tell or (lambda _: None)
    shown, digest, backends = list[Demonstrations](), None, backend.split(",")
    made_with = {"torch": str(torch.__version__), **versions("")}
    if source is not None:
        given, lesson = given_demonstrations(source, lesson)
        shown.append(given)
        content = given["observations"].tobytes() + given["actions"].tobytes()
        digest = sha256(content).hexdigest()
    for name in backends if source is None else ():
        with closing(ScmWorldEnv(lesson.task, backend=name, **lesson.options)) as env:
            env.reset(seed=number)
            teacher_in(lesson, env.world)()(env.world)  # raises where it cannot act
            made_with |= versions(env.world.engine)
    settings = {
        **lesson.about(),
        "fingerprint": fingerprint(make_task(lesson.task), libraries=False),
        "seed": number,
        "backend": backend,
        "recording": digest,
    }
    if source is None and lesson.teacher not in NAMED:
        settings["teacher"] = as_agent(lesson.teacher).about["sha256"]
    policies: list[MlpPolicy] = []
    with (
        torch_threads(1),
        Pool(workers=workers) as pool,
        Study(folder, "clone", settings) as study,
    ):
        who = lesson.teacher if source is None else source
        say(f"Learning {lesson}; from {who} on {backend}, seed {number}, in {folder}")
        total, done = lesson.episodes + lesson.rounds * lesson.more, 0
        for round_ in range(lesson.rounds + 1):
            stop = done + (lesson.more if round_ else lesson.episodes)
            cells = {
                f"demonstrations/{round_:02}-{first:06}.npz": (
                    range(first, min(first + SHARD, stop)),
                    backends[first // SHARD % len(backends)],
                )
                for first in range(done, stop, SHARD)
            }
            learner = policies[-1] if policies else None
            work = partial(demonstrated, lesson=lesson, seed=number, round_=round_, learner=learner)
            found = dict[str, Demonstrations]()
            wanted = cells if source is None else {}
            for name, part in study.map(wanted, work, read=read_arrays, write=_npz, pool=pool):
                found[name] = part
                done += len(cells[name][0])
                if progress is not None:
                    progress(done, total)
            shown += [found[name] for name in wanted]
            written = f"rounds/{round_:02}.safetensors"
            if not is_there(folder / written):
                pairs = joined(shown)
                n, kept = len(pairs["actions"]), int(pairs["kept"].sum())
                episodes = {"shown": len(pairs["kept"]), "kept": kept}
                ended = f"{kept} of {episodes['shown']} episodes"
                say(f"round {round_}: learns from {n:,} control steps, of {ended}")
                tensors, loss = fitted(pairs, lesson, seed=number)
                about = {
                    "task": lesson.task,
                    "env": lesson.options,
                    "activation": lesson.network.activation,
                    "memory": pairs["after"].shape[1],
                    "card": {
                        "lesson": lesson.about(),
                        "seed": number,
                        "backend": backend,
                        "round": round_,
                        "control_steps": n,
                        "episodes": episodes,
                        "teacher": float(np.nanmean(pairs["scores"])),
                        "loss": loss,
                        "versions": made_with,
                    },
                }
                # Nothing that fails later costs this.
                study.keep(written, MlpPolicy.of(tensors, about).content())
                say(f"round {round_}: loss {loss:.4f}; written to {folder / written}")
            policy = study.kept(written, policy_in)
            save_policy(folder / "policy.safetensors", policy)
            if "trials" not in policy.about.card:
                scores: dict[str, float] = {}
                if lesson.trials.protocols:
                    where = lesson.task, lesson.options, lesson.trials, backends[0]
                    _, scores = scored(policy, *where)
                    say(f"round {round_}: {words(scores)}")
                policy = MlpPolicy.of(policy.tensors(), policy.about.with_card(trials=scores))
                study.keep(written, policy.content())
            policies.append(policy)
    means = [mean(policy.about.card["trials"]) for policy in policies]  # type: ignore[arg-type]
    best = last = folder / "policy.safetensors"
    save_policy(last, policies[-1])
    steps = cast("int", policies[-1].about.card["control_steps"])
    ranked = max(range(len(means)), key=lambda i: (means[i] or 0.0, i))
    if means[ranked] is not None:
        best = folder / "best.safetensors"
        save_policy(best, policies[ranked])
    return Trained(folder, lesson, number, steps, last, best, means[ranked])


def _npz(shown: Demonstrations) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **shown)
    return stream.getvalue()
