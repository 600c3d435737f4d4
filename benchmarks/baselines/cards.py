"""Cards of trained policies, as pages in Markdown."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from scm_world.evaluation.statistics import Interval
from scm_world.policies import PolicyAbout

SCORES = {
    "last_fractional_success": "last fractional success",
    "success": "success",
    "published_overlap": "published overlap",
}
"""Columns of the table, and what they are called."""

MAIN = next(iter(SCORES))
"""The score of which seeds and ceilings are given."""

COMMAND, RESULTS, LIMITS = "command", "scores", "limits"
"""Entries of a card that are written when a policy is published."""

_FACTS = ("seed", "backend", "steps", "cpu_s", "wall_s", "device", "threads")
_APART = (COMMAND, RESULTS, LIMITS, "versions", *_FACTS)
_LONG = 80  # letters of JSON from which on an entry is folded away

INTRODUCTION = """# Zoo

Trained policies that come with the package. Each is named `zoo:NAME` wherever a policy is named,
and brings the options of the environment that it was trained with:

```console
scm-world evaluate zoo:pushing --protocols P0,P5
```

Scores are means over episodes with 95 % intervals; [Evaluation](evaluation.md) says what the
protocols are and how scores are estimated. 4 × 40 are 40 episodes of each of four seeds of draws,
which the command under a table draws again. Means come back to about 1e-4 on another machine: P12
of `zoo:reaching` on Bullet, 0.62020 in its card, was 0.62016 there;
a score without an interval is of one and the same episode. Intervals of cards with 20 episodes are
of an earlier kind that is too narrow where failures are rare. Columns of seeds have the same score
of several seeds of the same training; a column with the name of a script says what one reaches that
sees the whole world. The published overlap is the score of CausalWorld's actors, see
[metrics](evaluation.md). `scm-world list --zoo` lists the policies. This page is written by
`python -m benchmarks.baselines.publish`.
"""


def page_text(cards: Mapping[str, PolicyAbout]) -> str:
    """Write cards as one page.

    Args:
        cards: By the name of the policy.
    """
    parts = [card_text(about, name, level=2) for name, about in cards.items()]
    return "\n".join([INTRODUCTION, *parts] if parts else [INTRODUCTION, "The zoo is empty.\n"])


def card_text(about: PolicyAbout, name: str | None = None, *, level: int = 1) -> str:
    """Write the card of a policy in Markdown.

    Args:
        about: What it says of itself.
        name: Of the policy; that of its task if None.
        level: Of the heading.
    """
    card: Mapping[str, Any] = about.card
    mark = "#" * level
    lines = [f"{mark} {name or about.task}", "", *_facts(about)]
    if COMMAND in card:
        lines += ["", "```console", str(card[COMMAND]), "```"]
    if card.get(RESULTS):
        lines += ["", *_table(card[RESULTS])]
        if name is not None and (again := [*_repeats(name, card[RESULTS])]):
            lines += ["", "To draw the same episodes again:", "", "```console", *again, "```"]
    if card.get(LIMITS):
        lines += ["", f"{mark}# Limits", "", *(f"- {limit}" for limit in card[LIMITS])]
    for entry, value in card.items():
        if entry not in _APART and _is_long(value):
            lines += ["", f"<details><summary>{entry}</summary>", "", "```json"]
            lines += [json.dumps(value, indent=1), "```", "", "</details>"]
    return "\n".join(lines) + "\n"


def _facts(about: PolicyAbout) -> Iterable[str]:
    """List in a table what a policy is and how it was made."""
    card: Mapping[str, Any] = about.card
    versions = card.get("versions")
    rows: dict[str, Any] = {
        "task": about.task,
        "environment": ", ".join(f"`{name}={value!r}`" for name, value in about.env.items())
        or "as usual",
        **{name: card[name] for name in _FACTS if card.get(name) is not None},
        "versions": ", ".join(f"{n} {v}" for n, v in versions.items()) if versions else None,
        **{n: value for n, value in card.items() if n not in _APART and not _is_long(value)},
    }
    yield from ("| | |", "|---|---|")
    for name, value in rows.items():
        if value is not None:
            yield f"| {name} | {_cell(value)} |"


def _is_long(value: Any) -> bool:
    return isinstance(value, dict | list) and len(json.dumps(value)) > _LONG


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.4g}" if abs(value) < 1000 else f"{value:,.0f}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    text = value if isinstance(value, str) else f"`{json.dumps(value)}`"
    return text.replace("|", "\\|").replace("\n", " ")


def _table(rows: Iterable[Mapping[str, Any]]) -> Iterable[str]:
    """Write scores: a line for each protocol, a column for each engine and score."""
    listed = list(rows)
    engines = list(dict.fromkeys(row["engine"] for row in listed))
    found = {(row["protocol"], row["engine"]): row for row in listed}
    varied = {row["protocol"]: row.get("varied", "") for row in listed}
    more = {entry: word for entry, word in SCORES.items() if any(entry in row for row in listed)}
    if any("seeds" in row for row in listed):
        more["seeds"] = "seeds"
    if ceilings := {row["ceiling"]["name"] for row in listed if "ceiling" in row}:
        more["ceiling"] = f"`{ceilings.pop()}`"
    heads = [f"{word}, {engine}" for engine in engines for word in more.values()]
    yield f"| {' | '.join(('protocol', 'varied', *heads, 'episodes'))} |"
    yield "|---|---|" + "---:|" * (len(heads) + 1)
    for protocol, what in varied.items():
        cells = [
            _score(found[protocol, engine].get(entry)) if (protocol, engine) in found else "–"
            for engine in engines
            for entry in more
        ]
        mine = [row for row in listed if row["protocol"] == protocol]
        counts = {(row["n"], len(row.get("draws", "0"))) for row in mine}
        episodes = ", ".join(f"{n}" if m == 1 else f"{m} × {n // m}" for n, m in sorted(counts))
        yield f"| {' | '.join((protocol, what.replace('|', chr(92) + '|'), *cells, episodes))} |"


def _repeats(name: str, rows: Iterable[Mapping[str, Any]]) -> Iterable[str]:
    """Write the commands that run episodes again: one for all of the same seeds and number."""
    found: dict[tuple[tuple[int, ...], int], list[Mapping[str, Any]]] = {}
    for row in rows:
        if draws := tuple(row.get("draws", ())):
            found.setdefault((draws, row["n"] // len(draws)), []).append(row)
    for (draws, count), mine in found.items():
        protocols, engines = (
            ",".join(dict.fromkeys(row[of] for row in mine)) for of in ("protocol", "engine")
        )
        how = f"--protocols {protocols} -n {count} --seeds {','.join(map(str, draws))}"
        yield f"scm-world evaluate {name} {how} --backend {engines}"


def _score(entry: Any) -> str:
    """Write an interval, the means of several seeds, or a ceiling."""
    if isinstance(entry, list):
        return ", ".join(f"{one:.2f}" for one in entry)
    if entry is None or "name" in entry:
        return "–" if entry is None else f"{entry['value']:.2f}"
    return str(_interval(entry))


def _interval(row: Mapping[str, Any]) -> Interval:
    ends = {end: float("nan") if row[end] is None else row[end] for end in ("low", "high")}
    return Interval(row["value"], ends["low"], ends["high"], row["level"], row["n"])
