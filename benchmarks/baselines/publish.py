"""Put a trained policy into the zoo, with a card that says how well it does.

::

    python -m benchmarks.baselines.publish RUN NAME --results EVALUATION …

``RUN`` is the folder of a training run, or a policy file; ``EVALUATION`` a folder that
``scm-world evaluate --seeds 0,1,2,3`` wrote about this very file, with four seeds of draws or more,
on one engine or both. The policy without its
value network becomes ``scm_world/policies/zoo/NAME.safetensors``, and ``docs/zoo.md`` is written
anew. Other runs of the same agent in the evaluation are the seeds beside it; the scripted policy
``--ceiling``, an agent in it too, says what can be reached in a protocol.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from benchmarks.baselines.cards import COMMAND, LIMITS, MAIN, RESULTS, SCORES, page_text
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation import Evaluation
from scm_world.policies import MlpPolicy, PolicyAbout, file_of, load_policy, save_policy, zoo
from scm_world.runs.files import write_whole
from scm_world.training.imitation import lesson
from scm_world.training.recipe import Recipe, recipe

LARGEST = 1_000_000  # [bytes] of a file in the package
DRAWS = 4  # seeds of draws, at least
PAGE = Path(__file__).parents[2] / "docs" / "zoo.md"


def scores_of(
    path: Path, results: Iterable[Path], ceiling: str | None = None
) -> list[dict[str, Any]]:
    """List the scores of a policy file in evaluations: a row for each engine and protocol.

    Args:
        path: Of the file.
        results: Folders of evaluations.
        ceiling: An agent in them that sees the whole world, if any.

    Raises:
        UnreadableFile: An evaluation is damaged, or not of this file.
        UnknownOption: An evaluation has fewer than four seeds of draws.
        ModelError: Two evaluations have the same protocol on the same engine.
    """
    content = sha256(path.read_bytes()).hexdigest()
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for folder in results:
        for row in _rows(folder, content, ceiling):
            if found.setdefault((row["engine"], row["protocol"]), row) is not row:
                raise ModelError([f"{folder}: {row['protocol']} on {row['engine']} is there twice"])
    return list(found.values())


def _rows(folder: Path, content: str, ceiling: str | None) -> Iterable[dict[str, Any]]:
    evaluation = Evaluation.load(folder)
    agents = [one for one in evaluation.about["agents"] if one["policy"].get("sha256") == content]
    if not agents:
        advice = "evaluate this very file: scm-world evaluate FILE --out FOLDER"
        raise UnreadableFile(str(folder), "it is no evaluation of this policy", advice)
    if len(evaluation.about["seeds"]) < DRAWS:
        advice = (f"{DRAWS} or more: scm-world evaluate --seeds 0,1,2,3",)
        raise UnknownOption("seeds of draws", evaluation.about["seeds"], advice)
    agent, run = agents[0]["agent"], agents[0]["run"]
    mine = evaluation.only(agent=agent, run=run)
    varied = {one["name"]: one.get("doc", "") for one in evaluation.about["protocols"]}
    for engine in mine.engines:
        for protocol in mine.only(engine=engine).protocols:
            scores: dict[str, Any] = {
                metric: mine.score(protocol, metric, agent=agent, engine=engine).as_dict()
                for metric in SCORES
                if metric in mine.metrics
            }
            n = len(mine.only(engine=engine, protocol=protocol))
            where = {"engine": engine, "protocol": protocol, "varied": varied[protocol], "n": n}
            where["draws"] = evaluation.about["seeds"]
            there = {"protocol": protocol, "engine": engine}
            if len(runs := evaluation.runs(agent)) > 1:
                each = [evaluation.only(agent=agent, run=one, **there) for one in runs]
                scores["seeds"] = [float(one.frame[MAIN].mean()) for one in each]
            if ceiling is not None:
                best = evaluation.only(agent=ceiling, **there).score(protocol, MAIN)
                scores["ceiling"] = {"name": ceiling, "value": best.value}
            yield {**where, **scores}


def command_of(card: Mapping[str, Any]) -> str:
    """Give the command that trains such a policy, from its card.

    Raises:
        UnknownOption: The card does not say how, or in another way than a preset or a lesson does.
    """
    learned = card.get("lesson")
    if learned is not None and learned == lesson(learned["task"]).about():
        words = ["scm-world", "clone", learned["task"], "--backend", card["backend"]]
        return shlex.join([*words, "--seed", str(card["seed"])])
    preset = _preset(card)
    if preset is None or card.get("start") is not None:
        raise UnknownOption("command", None, ("the one that trained it: --command '…'",))
    words = ["scm-world", "train", preset.task, "--algo", preset.algo]
    words += ["--backend", card["backend"], "--seed", card["seed"], "--steps", preset.steps]
    return shlex.join(map(str, words))


def _preset(card: Mapping[str, Any]) -> Recipe | None:
    """Give the recipe of a card if nothing but its steps is another than in its preset."""
    try:
        made = Recipe.from_dict(card.get("recipe"))
        usual = recipe(made.task, made.algo, steps=made.steps)
    except UnknownOption:
        return None
    return made if made == usual and {"backend", "seed"} <= card.keys() else None


def published(
    source: Path,
    results: Sequence[Path],
    *,
    command: str | None = None,
    limits: Sequence[str] = (),
    ceiling: str | None = None,
    keep: bool = False,
) -> MlpPolicy:
    """Give what goes into the zoo: a policy without its value network, with its scores.

    Args:
        source: The policy file.
        results: Folders of evaluations.
        command: That trained it; from its card if None.
        limits: What has to be known, in sentences.
        ceiling: See ``scores_of``.
        keep: Keep the scores of its card on engines that the evaluations leave out.

    Raises:
        UnreadableFile: A file is damaged, or an evaluation is not of this policy.
        UnknownOption: Nobody says with which command it was trained.
    """
    policy = load_policy(source)
    scores = scores_of(source, results, ceiling)
    engines = {row["engine"] for row in scores}
    earlier = policy.about.card.get(RESULTS, []) if keep else []
    scores = [*(row for row in earlier if row["engine"] not in engines), *scores]
    about: PolicyAbout = policy.about.with_card(
        **{
            COMMAND: command or policy.about.card.get(COMMAND) or command_of(policy.about.card),
            RESULTS: scores,
            LIMITS: [*limits],
        }
    )
    return MlpPolicy(policy.layers, policy.log_std, made_for=about)


def publish(
    source: Path, name: str, results: Sequence[Path], *, page: Path = PAGE, **more: Any
) -> Path:
    """Put a policy into the zoo, and write the page anew.

    Args:
        source: Folder of a training run, or a policy file.
        name: In the zoo.
        results: Folders of evaluations.
        page: Where the cards are written.
        more: See ``published``.

    Returns:
        The file in the zoo.

    Raises:
        UnknownOption: The name cannot be that of a file, or the file would be too large.
    """
    if not re.fullmatch(r"[a-z0-9_]+", name):
        raise UnknownOption("name in the zoo", name, ("small letters, digits and _",))
    policy = published(file_of(source), results, **more)
    size = sum(array.nbytes for array in policy.tensors().values()) + len(policy.about.text())
    if size >= LARGEST:
        raise UnknownOption("size of a policy", f"{size:,} bytes", (f"below {LARGEST:,}",))
    path = zoo.FOLDER / f"{name}.safetensors"
    save_policy(path, policy)
    write_whole(page, page_text(zoo.zoo()))
    return path


def main(words: Sequence[str] | None = None) -> None:
    """Read the command line, and publish."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, help="folder of a training run, or a policy file")
    parser.add_argument("name", help="in the zoo")
    parser.add_argument("--results", type=Path, nargs="+", required=True, help="of evaluations")
    parser.add_argument("--command", help="that trained it; from its recipe by default")
    parser.add_argument("--limit", action="append", default=[], help="sentence; one for each")
    parser.add_argument("--ceiling", help="agent in the evaluations that sees the whole world")
    parser.add_argument("--keep", action="store_true", help="scores on engines left out now")
    asked = parser.parse_args(words)
    more: dict[str, Any] = {"limits": asked.limit, "ceiling": asked.ceiling, "keep": asked.keep}
    path = publish(asked.source, asked.name, asked.results, command=asked.command, **more)
    print(f"written: {path}, {PAGE}")


if __name__ == "__main__":
    main()
