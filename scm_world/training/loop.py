"""Training an agent: resumable, the same bits whether it was interrupted or not."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from scm_world.errors import Diverged, UnknownOption
from scm_world.evaluation.policies.trained import in_run
from scm_world.evaluation.policies.weights import load_policy
from scm_world.evaluation.zoo.shelf import PREFIX, path_of
from scm_world.graph.exchange.libraries import load
from scm_world.output.durable import locked, made
from scm_world.queries.progress import Progress
from scm_world.training.checkpoints import checkpoints, read_checkpoint
from scm_world.training.export import begin_with
from scm_world.training.instants import resumed
from scm_world.training.learners import device_for, library, make_learner, torch
from scm_world.training.memory import Memory
from scm_world.training.recipe import Recipe
from scm_world.training.runs import Run
from scm_world.training.watching import Stopped, Watching, is_finite, watch
from scm_world.training.worlds import Worlds, make_worlds
from scm_world.world.start import whole_number

EVERY = 60.0  # [s] between checkpoints
LARGEST_SEED = 2**32 - 1  # of Stable-Baselines3

Tell = Callable[[str], None]


@final
@dataclass(frozen=True)
class Trained:
    """A training that is over.

    Attributes:
        folder: Of its files.
        recipe: How the agent was trained.
        seed: Of everything that was drawn.
        steps: Control steps.
        policy: The file of the policy at the end.
        best: The file of the one that was best in the evaluations while it ran; that at the end
            if there were none.
        score: Of that one, mean last fractional success; None without evaluations.
    """

    folder: Path
    recipe: Recipe
    seed: int
    steps: int
    policy: Path
    best: Path
    score: float | None


def train(
    recipe: Recipe,
    *,
    out: Path | str,
    seed: int = 0,
    backend: str = "mujoco",
    steps: int | None = None,
    start: Path | str | None = None,
    progress: Progress | None = None,
    tell: Tell | None = None,
    device: str = "auto",
    threads: int | None = None,
    every: float = EVERY,
) -> Trained:
    """Train an agent.

    What is learned follows from the recipe, the seed, the engine, ``threads`` and the versions.
    If ``out`` holds a part of the same training, it goes on from its last checkpoint, also with
    more steps than before if neither the learning rate nor the ceiling of the standard deviations
    depends on how many there are; on a CPU the weights in the end are, bit for bit, those of a
    training that was not interrupted. Ctrl-C lets it write a checkpoint after the present round,
    and end; a second one ends it at once.

    Args:
        recipe: How it is trained.
        out: Folder of the run; see ``Run``.
        seed: Of everything that is drawn.
        backend: Name of the engine.
        steps: Control steps, in place of those of the recipe.
        start: Policy to begin with: a file, the folder of a run, or one of the zoo.
        progress: Told how many steps are done, and how many there are.
        tell: Told in words what happens.
        device: ``"cpu"``, ``"cuda"``, or ``"auto"``.
        threads: Of the engine and of torch. None: as many as there are cores for the engine,
            whose results do not depend on it, and one for torch, whose last bits do.
        every: Seconds between checkpoints.

    Returns:
        Where its policies are.

    Raises:
        MissingExtra: Stable-Baselines3 is not installed.
        UnknownOption: Something is asked for that does not exist.
        UnreadableFile: Another training is in the folder, somebody else is writing to it, or its
            last checkpoint is damaged.
        UnwritableFolder: There is no room; the last checkpoint is still whole.
    """
    library(), torch(), load("tensorboard", "tensorboard", "train")
    if steps is not None:
        recipe = with_steps(recipe, steps)
    number = whole_number("seed", seed, least=0)
    if number > LARGEST_SEED:
        raise UnknownOption("seed", seed, (f"any whole number from 0 to {LARGEST_SEED}",))
    count = None if threads is None else whole_number("threads", threads, least=1)
    where = device_for(recipe, device)
    first = None if start is None else named(start)
    run = Run(Path(out), recipe, number, backend, count or 1, where, first)
    run.identity  # noqa: B018 # refuses a start that is not there before a folder is made
    with locked_new(run.folder), torch_threads(run.threads):
        worlds = make_worlds(recipe, backend=backend, seed=number, threads=count)
        try:
            return _trained(run, worlds, progress, tell or _nobody, every)
        finally:
            worlds.close()


def named(start: Path | str) -> Path:
    """Give the file of a policy: of a run, of the zoo, or the one that is given.

    Raises:
        UnknownOption: There is none of this name in the zoo.
        UnreadableFile: The folder is of no run.
    """
    text = str(start)
    if text.startswith(PREFIX):
        return path_of(text)
    return in_run(Path(text)) if Path(text).is_dir() else Path(text)


def with_steps(recipe: Recipe, steps: int) -> Recipe:
    """Give the same recipe with another number of control steps.

    Raises:
        UnknownOption: There are fewer than in one round.
    """
    number = whole_number("steps", steps, least=1)
    if number < recipe.round:
        allowed = (f"at least {recipe.round:,}, what {recipe.worlds} worlds make in one round",)
        raise UnknownOption("steps", steps, allowed)
    return recipe.model_copy(update={"steps": number})


def _trained(
    run: Run, worlds: Worlds, progress: Progress | None, tell: Tell, every: float
) -> Trained:
    engine = worlds.engine
    for line in run.newer(engine):
        tell(line)
    model = make_learner(
        run.recipe, worlds.vec_env, seed=run.seed, length=worlds.length, device=run.device
    )
    if run.start is not None:
        begin_with(model, run.recipe, run.start)
    goes_on = run.open(engine)
    worlds.begin_with(run.seed)  # the algorithm has set other seeds
    memory = Memory(model, run.replay) if hasattr(model, "replay_buffer") else None
    watching = Watching(run, worlds, memory, run.card(engine), progress, tell, every)
    if goes_on:
        checkpoint = read_checkpoint(checkpoints(run.checkpoints)[-1])
        resumed(model, worlds, memory, checkpoint.tensors, checkpoint.state)
        watching.resume(checkpoint)
        tell(f"goes on after {checkpoint.steps:,} steps")
    elif memory is not None:
        memory.clear()
    if getattr(model, "learning_starts", 0) >= run.recipe.steps:
        tell(f"nothing will be learned: learning starts after {model.learning_starts:,} steps")
    left = run.recipe.steps - model.num_timesteps
    if left > 0:
        with _interruptible(watching, tell):
            _learn(model, watching, left)
    policy = load_policy(run.policy)
    best = run.best if run.best.exists() else run.policy
    steps = int(policy.about.card["steps"])  # type: ignore[arg-type] # JSON
    return Trained(run.folder, run.recipe, run.seed, steps, run.policy, best, watching.score)


def _learn(model: Any, watching: Watching, left: int) -> None:
    logger = library("common.logger")
    folder = made(watching.run.folder / "tensorboard")
    model.set_logger(logger.configure(str(folder), ["tensorboard"]))
    try:
        model.learn(left, callback=watch(watching), reset_num_timesteps=False, log_interval=1)
    except Stopped:
        raise KeyboardInterrupt from None
    except ValueError:
        if is_finite(model.policy):
            raise
        raise Diverged(model.num_timesteps) from None  # torch found it before a round was over
    finally:
        model.logger.close()


def _nobody(_: str) -> None:
    """Tell nobody."""


@contextmanager
def locked_new(folder: Path) -> Iterator[None]:
    """Be the only one who writes to a folder; one that is made and stays empty is removed."""
    with locked(folder):
        try:
            yield
        finally:
            if not any(folder.iterdir()):
                folder.rmdir()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch have so many threads for a while; its last bits depend on them."""
    before = torch().get_num_threads()
    torch().set_num_threads(count)
    try:
        yield
    finally:
        torch().set_num_threads(before)


@contextmanager
def _interruptible(watching: Watching, tell: Tell) -> Iterator[None]:
    """Let the first Ctrl-C end the training after the present round, and the second one at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)

    def stop(*_: Any) -> None:
        watching.stop = True
        signal.signal(signal.SIGINT, before)
        tell("stops after this round with a checkpoint; Ctrl-C again stops at once")

    signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
