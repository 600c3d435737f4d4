"""Training an agent; an interrupted training goes on from its last checkpoint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, final

from scm_world._arguments import load, whole_number
from scm_world._fingerprint import fingerprint
from scm_world.backends import require_backend
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.policies import file_of, load_policy
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress, Tell
from scm_world.runs.files import read_bytes
from scm_world.runs.study import Study
from scm_world.tasks import make_task
from scm_world.training.logs import check_callback, log_names, opened_log
from scm_world.training.recipe import Recipe
from scm_world.training.worlds import device_for

if TYPE_CHECKING:
    from scm_world.training.imitation import Lesson

LARGEST_SEED = 2**32 - 1  # of Stable-Baselines3


@final
@dataclass(frozen=True)
class Trained:
    """A training that is over.

    Attributes:
        folder: Folder of its files.
        recipe: How the agent was trained: a ``Recipe``, or the ``Lesson`` of a clone.
        seed: Seed of everything that was drawn.
        steps: Control steps from which it has learned.
        policy: The file of the policy at the end.
        best: The file of the best one in the evaluations; that at the end without them.
        score: Its mean; None without evaluations.
    """

    folder: Path
    recipe: Recipe | Lesson
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
    start: Path | str | None = None,
    progress: Progress | None = None,
    tell: Tell | None = None,
    device: str = "auto",
    threads: int | None = None,
    callback: object = None,
    log: str | Sequence[str] | None = None,
) -> Trained:
    """Train an agent.

    The result follows from the recipe, the seed, the backend, ``threads`` and the versions. If
    ``out`` holds a part of the same training, it goes on from its last checkpoint, also with more
    steps than before if neither the learning rate nor the ceiling of the standard deviations
    depends on how many there are. After Ctrl-C it writes a checkpoint and ends.

    Args:
        recipe: How it is trained.
        out: Folder of the run.
        seed: Seed of everything that is drawn.
        backend: Name of the engine.
        start: Policy to begin with: a file, the folder of a run, or one of the zoo.
        progress: Called with how many steps are done, and how many there are.
        tell: Called with a sentence about each event.
        device: ``"cpu"``, ``"cuda"``, or ``"auto"``: the GPU if there is one, but for PPO of
            Stable-Baselines3 and sb3-contrib.
        threads: Threads of the backend and of torch. None: as many as there are cores for the
            backend, whose results do not depend on it, and one for torch, whose last bits do.
        callback: A function that is called with the numbers of each round, by the names of
            ``progress.csv``; or a ``BaseCallback`` of Stable-Baselines3, for its algorithms.
        log: Where these numbers go besides ``progress.csv``: ``"tensorboard"``, ``"wandb"``,
            ``"trackio"``; one, several, or a text with commas. A run that resumes goes on there.
            None: tensorboard, but for ``"rsl_ppo"``, which has none.

    Returns:
        Where its policies are.

    Raises:
        MissingExtra: Stable-Baselines3, or the library of the algorithm or of ``log``, is not
            installed.
        UnknownOption: Something is asked for that does not exist.
        UnreadableFile: Another training is in the folder, or another process is writing to it.
        UnwritableFolder: The disk is full, or permission is missing.
        Diverged: Weights are not finite any more.
    """
    used = ("stable_baselines3", "stable-baselines3", "train")
    library: Any
    if recipe.algo == "rsl_ppo":
        load(*(used := ("rsl_rl", "rsl-rl-lib", "scale")))
        from scm_world.training import many as library
    else:
        load(*used)
        if recipe.algo == "recurrent_ppo":
            load(*(used := ("sb3_contrib", "sb3-contrib", "train")))
        from scm_world.training import algorithms as library

    check_callback(callback, recipe.algo)
    logs = log_names(log, recipe.algo)
    own, function = (callback, None) if hasattr(callback, "on_rollout_start") else (None, callback)
    if whole_number("seed", seed, least=0) > LARGEST_SEED:
        raise UnknownOption("seed", seed, (f"any whole number from 0 to {LARGEST_SEED}",))
    count = None if threads is None else whole_number("threads", threads, least=1)
    require_backend(backend)
    first = None if start is None else file_of(start)
    given: dict[str, Any] = {"seed": seed, "backend": backend, "threads": count or 1}
    given["device"] = device_for(recipe, device)
    try:
        given["start"] = None if first is None else sha256(read_bytes(first)).hexdigest()
    except OSError as error:
        raise UnreadableFile(str(first), str(error), "give a policy file to start from") from None
    made_task = make_task(recipe.task, **(recipe.env.get("task_options") or {}))
    given["fingerprint"] = fingerprint(made_task, libraries=False)
    settings = {**recipe.as_dict(), **given}
    if recipe.rate.schedule != "linear" and recipe.network.log_std_end is None:
        del settings["steps"]  # it begins alike, however long it is
    folder, say = Path(out), tell or (lambda _: None)
    how = {"backend": backend, "seed": seed, "device": given["device"], "threads": count}
    with torch_threads(given["threads"]), library.opened(recipe, **how) as (model, world):
        if first is not None:
            library.begin_with(model, recipe, first)
        card = {
            **given,
            "recipe": recipe.as_dict(),
            "versions": {
                **versions(world.engine),
                **{name: version(name) for name in ("torch", used[1])},
            },
        }
        with (
            Study(folder, "training", settings) as study,
            opened_log(logs, folder, card, cast("Any", function)) as sink,
        ):
            say(f"Training {recipe}; on {backend}, seed {seed}, in {folder}")
            about: dict[str, Any] = {
                "backend": backend,
                "card": card,
                "progress": progress,
                "tell": say,
            }
            about |= {"begun": first is not None, "log": sink}
            if recipe.algo != "rsl_ppo":
                about |= {"callback": own, "tensorboard": "tensorboard" in logs}
            score = library.learn(model, recipe, study, **about)
    policy, best = folder / "policy.safetensors", folder / "best.safetensors"
    done = int(load_policy(policy).about.card["steps"])  # type: ignore[arg-type] # JSON
    best = best if best.exists() else policy
    return Trained(folder, recipe, seed, done, policy, best, score)


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch for a while; its last bits depend on it."""
    torch = load("torch", "torch", "train")
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
