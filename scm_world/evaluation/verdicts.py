"""What an agent infers, as a result: probes of its hidden state, and changes of its actions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, final

from scm_world.errors import UnknownOption, reading
from scm_world.evaluation.statistics.causes import aligned
from scm_world.evaluation.statistics.intervals import Interval
from scm_world.evaluation.statistics.probes import Scores
from scm_world.runs.files import Location, located, read_text, write_whole

FORMAT = "scm_world/inferred/1"
END = -1
"""Stands for the last control step of an episode."""
INFERRED = "inferred"
HIDDEN, SHUFFLED, UNTRAINED, OBSERVATION = REPRESENTATIONS = (
    "hidden",
    "shuffled",
    "untrained",
    "observation",
)
PARTS = ("own", "reaction", "memory")


@final
@dataclass(frozen=True)
class CauseProbe:
    """How much of a cause can be read off the hidden state after some control steps.

    Attributes:
        variable: Name of the cause, with the number of the component if it has several.
        step: The control step; ``END`` is the last one.
        scores: R² in held-out episodes by the name of the probe, of ``"hidden"``, of the controls
            ``"shuffled"``: the causes of other episodes; ``"untrained"``: the same network with
            random weights in the same episodes, if there is a network; ``"observation"``: the
            present observation, without history and memory.
    """

    variable: str
    step: int
    scores: Mapping[str, Scores]

    @property
    def verdict(self) -> str:
        """``"inferred"``, ``"no"``, or ``"no: …"`` with the control that shows the cause as well.

        The cause is inferred where the lower end of the interval of one of the probes lies above
        the upper ends of both probes of each control. A control shows it where the same holds of
        the control and the shuffled causes.
        """
        each = self.scores.items()
        lows = {name: max(one.low for one in by.values()) for name, by in each}
        highs = {name: max(one.high for one in by.values()) for name, by in each}
        worst = max(highs.keys() - {HIDDEN}, key=lambda name: (highs[name], name))
        if lows[HIDDEN] > highs[worst]:
            return INFERRED
        return f"no: {worst}" if lows[worst] > highs[SHUFFLED] else "no"


@final
@dataclass(frozen=True)
class Change:
    """How the action changes where a cause is set to another value within the episode.

    Attributes:
        variable: Name of the cause.
        part: ``"own"``: the change on the agent's own trajectory; ``"reaction"``: that of the
            action which it gives for the same observations with an emptied memory and history;
            ``"memory"``: the difference of both, which it owes to what it remembers.
        size: Mean length of the change, in the unit of actions.
        effect: Mean change, where the cause increases, in the direction of the mean of the other
            episodes.
        shuffled: The same with signs at random: the mean, and where 95 % of the draws lie.
        agreement: Mean cosine of the change and that of the privileged agent, which is shown the
            one and the other value in the same state; None without one, or where nothing changes.
        flipped: The same with signs at random, likewise.
    """

    variable: str
    part: str
    size: Interval
    effect: Interval
    shuffled: Interval
    agreement: Interval | None = None
    flipped: Interval | None = None

    @property
    def verdict(self) -> str:
        """``"change"``, or ``"no change"`` where the interval contains what random signs give.

        That is their mean; or the effect lies among their 95 %.
        """
        return "change" if _exceeds(self.effect, self.shuffled) else "no change"

    @property
    def agrees(self) -> bool | None:
        """Whether it has the direction of the privileged agent's; None where that is not known."""
        if self.agreement is None or self.flipped is None:
            return None
        return _exceeds(self.agreement, self.flipped)


def _exceeds(found: Interval, chance: Interval) -> bool:
    return found.low > chance.value and found.value > chance.high


@final
@dataclass(frozen=True)
class Inferred:
    """Which causes an agent infers.

    Attributes:
        about: Description as plain data: task, agents, protocol, seeds, versions, steps.
        probes: The probes of the hidden state, by cause and step; none without a hidden state.
        changes: The changes of the action, three for each cause.
        left_out: Why the episodes say nothing about a cause or a step, by its name.
    """

    about: Mapping[str, Any]
    probes: tuple[CauseProbe, ...]
    changes: tuple[Change, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)

    def verdicts(self) -> dict[str, str]:
        """Return, by cause, ``"inferred"`` if it is at one of the steps, or why it is not."""
        found: dict[str, str] = {}
        for one in self.probes:
            name = one.variable.partition("[")[0]
            found[name] = INFERRED if found.get(name) == INFERRED else one.verdict
        return found

    def __str__(self) -> str:
        rows = [
            (
                one.variable,
                "end" if one.step == END else str(one.step),
                kind,
                *(
                    str(one.scores[name][kind]) if name in one.scores else "-"
                    for name in REPRESENTATIONS
                ),
                one.verdict,
            )
            for one in self.probes
            for kind in one.scores[HIDDEN]
        ]
        lines = aligned(("cause", "step", "probe", *REPRESENTATIONS, "verdict"), rows)
        agrees = {None: "-", True: "agrees", False: "no agreement"}
        changed = [
            (
                *(one.variable, one.part, str(one.size), str(one.effect), str(one.shuffled)),
                *(one.verdict, str(one.agreement or "-"), agrees[one.agrees]),
            )
            for one in self.changes
        ]
        head = ("cause", "action", "size", "effect", "signs at random", "verdict", "cosine", "")
        lines += ["", *aligned(head, changed)] if changed else []
        lines += [f"{name}: left out, {reason}" for name, reason in self.left_out.items()]
        return "\n".join(lines).strip()

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data, with the verdicts."""
        found: dict[str, Any] = {"format": FORMAT, **asdict(self)}
        found["probes"] = [{**asdict(one), "verdict": one.verdict} for one in self.probes]
        found["changes"] = [{**asdict(one), "verdict": one.verdict} for one in self.changes]
        return found

    def save(self, path: Location | str) -> Location:
        """Write it as JSON, whole or not at all.

        Raises:
            UnwritableFolder: The disk is full, or permission is missing.
        """
        text = json.dumps(self.as_dict(), indent=1, allow_nan=False)
        write_whole(located(path), text + "\n")
        return located(path)

    @classmethod
    def load(cls, path: Location | str) -> Inferred:
        """Read a file of ``save``, or ``inferred.json`` in a folder of ``scm-world infer``.

        Raises:
            UnreadableFile: It is damaged, or something else.
        """
        with reading(path, "give a file that Inferred.save or scm-world infer has written"):
            place = located(path)
            place = place / "inferred.json" if place.is_dir() else place
            data = json.loads(read_text(place), object_hook=_read)
            if data.pop("format") != FORMAT:
                raise ValueError(f"it has not the format {FORMAT!r}")
            made = {"probes": CauseProbe, "changes": Change}
            for name, kind in made.items():
                fields = [{k: v for k, v in one.items() if k != "verdict"} for one in data[name]]
                data[name] = tuple(kind(**one) for one in fields)
            return cls(**data)


def verdicts_of(found: Inferred | None, about: Mapping[str, Any], agent: str) -> dict[str, str]:
    """Return the verdicts, none without ``found``, about an agent of an evaluation.

    Raises:
        UnknownOption: They are about another policy: another file, or one of another name.
    """
    if found is None:
        return {}
    its, mine = (
        {p.get("sha256", p["name"]) for p in (a["policy"] for a in there if a["agent"] == name)}
        for name, there in (("agent", found.about["agents"]), (agent, about["agents"]))
    )
    if not its & mine:
        raise UnknownOption("inferred", sorted(its)[0], (*sorted(mine), f"the policy of {agent!r}"))
    return found.verdicts()


def _read(value: dict[str, Any]) -> Any:
    return Interval(**value) if value.keys() == Interval.__dataclass_fields__.keys() else value
