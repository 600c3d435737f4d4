"""What a recording says of itself in a file, beside its numbers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world.errors import ModelError, UnreadableFile
from scm_world.evaluation.recording.environments import as_data
from scm_world.evaluation.recording.episodes import Recorded
from scm_world.queries.plans import Plan

FORMAT = "scm_world/recording/1"
KEYS = {"environment", "versions", "policy", "episodes"}
_EPISODE = {"seed", "number", "interventions", "sha256"}
_ENVIRONMENT = {"task", "backend", "action_mode", "normalize_actions"}

Numbers = dict[str, Any]
"""Arrays of an episode by the names of its fields, its observations and infos included."""


def written(
    environment: Mapping[str, Any],
    versions: Mapping[str, str],
    policy: Mapping[str, Any] | None,
    episodes: Sequence[Recorded],
) -> str:
    """Write a header as JSON.

    Raises:
        ModelError: Something is no plain data: an argument of the environment, or a function.
    """
    header = {
        "format": FORMAT,
        "environment": as_data(environment),
        "versions": dict(versions),
        "policy": None if policy is None else dict(policy),
        "episodes": [
            {
                "seed": episode.seed,
                "number": episode.number,
                "interventions": episode.plans(),
                "sha256": episode.sha256(),
            }
            for episode in episodes
        ],
    }
    try:
        return json.dumps({**header, "checksum": _checksum(header)}, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ModelError([f"what the policy is cannot be written: {error}"]) from None


def _checksum(header: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(header, sort_keys=True).encode()).hexdigest()


@final
@dataclass(frozen=True)
class Header:
    """What was written, read and checked.

    Attributes:
        environment: Arguments of the environment.
        versions: What the recording was made with.
        policy: What acted, if it is known.
        episodes: Seed, number, interventions and sum of each episode.
        path: Of the file, for messages.
        trusted: Packages whose functions may be mechanisms.
    """

    environment: dict[str, Any]
    versions: dict[str, str]
    policy: dict[str, Any] | None
    episodes: list[dict[str, Any]]
    path: str
    trusted: Sequence[str]

    @classmethod
    def read(cls, text: str | bytes | None, path: str, trusted: Sequence[str]) -> Header:
        """Read what ``written`` wrote.

        Raises:
            UnreadableFile: It is something else, or damaged.
        """
        try:
            header = json.loads(text or "")
        except ValueError:
            header = None
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise UnreadableFile(path, "it is no recording", ADVICE)
        known = header.pop("checksum", None)
        if known != _checksum(header):
            raise UnreadableFile(path, "its header is not what was written", ADVICE)
        made_with, episodes = header.get("environment") or {}, header.get("episodes") or []
        is_whole = header.keys() >= KEYS and made_with.keys() >= _ENVIRONMENT
        if not (is_whole and all(episode.keys() >= _EPISODE for episode in episodes)):
            raise UnreadableFile(path, "its header is incomplete", ADVICE)
        return cls(made_with, header["versions"], header["policy"], episodes, path, trusted)

    def episode(self, number: int, numbers: Callable[[], Numbers]) -> Recorded:
        """Put an episode together from its numbers.

        Args:
            number: Its place in the recording.
            numbers: Gives the arrays; a ``ValueError`` says that they are damaged.

        Raises:
            UnreadableFile: The numbers are not those that were written.
            ModelError: A mechanism is a function of no trusted package.
        """
        known = self.episodes[number]
        plans = [
            (int(step), Plan.from_dict(plan, trusted=self.trusted))
            for step, plan in known["interventions"]
        ]
        try:
            found = Recorded(
                environment=self.environment,
                seed=known["seed"],
                number=known["number"],
                interventions=tuple(plans),
                **_typed(numbers()),
            )
            is_whole = found.sha256() == known["sha256"]
        except (ValueError, KeyError, TypeError, IndexError) as error:
            reason = f"its episode {number} is damaged ({error})"
            raise UnreadableFile(self.path, reason, ADVICE) from None
        if not is_whole:
            raise UnreadableFile(self.path, f"its episode {number} is not what was written", ADVICE)
        return found


def _typed(numbers: Numbers) -> Numbers:
    """Give arrays the types that they have in a recording."""
    kinds: dict[str, type[np.generic]] = {"rewards": np.float64, "states": np.int64}
    kinds |= dict.fromkeys(("terminations", "truncations"), np.bool_)
    return {
        name: np.asarray(value, dtype=kinds[name]) if name in kinds else value
        for name, value in numbers.items()
    }


ADVICE = "give one that a Recording was saved to"
