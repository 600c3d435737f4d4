"""Trained policies that come with this package, each with a card.

A policy of the zoo is named ``"zoo:pushing"`` wherever a policy is named::

    evaluate("zoo:pushing", "P0,P5")
    print(load_policy("zoo:pushing").about.card["command"])
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scm_world._arguments import one_of, typed
from scm_world.errors import UnreadableFile
from scm_world.policies.cards import PolicyAbout
from scm_world.policies.networks import load_policy

PREFIX = "zoo:"
FOLDER = Path(__file__).parent


def zoo() -> Mapping[str, PolicyAbout]:
    """Return the cards of all policies of the zoo, by name."""
    return {name: load_policy(name).about for name in _names()}


@typed
def file_of(policy: Path | str) -> Path:
    """Return the file of a policy.

    Args:
        policy: A file, ``"zoo:pushing"``, or the folder of a training run, which stands for the
            best policy of its evaluations or, without evaluations, for the last one.

    Raises:
        UnknownOption: The zoo has no policy of this name.
        UnreadableFile: The folder has no policy.
    """
    text = str(policy)
    if text.startswith(PREFIX):
        one_of("policy of the zoo", text, _names())
        return FOLDER / f"{text.removeprefix(PREFIX)}.safetensors"
    if not Path(text).is_dir():
        return Path(text)
    for name in ("best.safetensors", "policy.safetensors"):
        if (Path(text) / name).is_file():
            return Path(text) / name
    advice = "give the folder of a training run that has begun to evaluate, or a file"
    raise UnreadableFile(text, "it has neither best.safetensors nor policy.safetensors", advice)


def best_known(about: PolicyAbout) -> str:
    """Return the scores on a card in one line, those of the first backend."""
    rows: Any = about.card.get("scores") or []
    return ", ".join(
        f"{row['protocol']} {row['last_fractional_success']['value']:.2f}"
        for row in rows
        if row["engine"] == rows[0]["engine"]
    )


def _names() -> tuple[str, ...]:
    return tuple(f"{PREFIX}{path.stem}" for path in sorted(FOLDER.glob("*.safetensors")))
