"""Pages of results: one HTML file that needs nothing else, and no network.

Functions with an argument ``title``, ``text`` or ``facts`` escape it. What is called ``inside`` or
``parts`` is HTML already.
"""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import final

from scm_world.output.pages_style import script, style


@final
@dataclass(frozen=True)
class Entry:
    """What stands in a table, if there is more to it than a text.

    Attributes:
        text: What is read.
        by: What the column is sorted by, if that is not the text; an empty one comes last.
        looks: ``"best"`` stands out, ``"w"`` is a sentence and may be broken into lines.
    """

    text: str
    by: str | None = None
    looks: str = ""


def page(
    title: str,
    parts: Iterable[str],
    *,
    lead: str = "",
    contents: Sequence[tuple[str, str]] = (),
    extra_style: str = "",
    early_style: str = "",
    extra_script: str = "",
) -> str:
    """Write a whole page.

    Args:
        title: In the head and above all.
        parts: What stands in it, one below the other.
        lead: A sentence below the title.
        contents: Anchors and names of the sections that are listed at the top.
        extra_style: Rules that override those of every page.
        early_style: Rules that those of every page override.
        extra_script: Statements of its own.

    Example:
        >>> made = page("Doors & keys", [section("all", "All", "<p>None.</p>")])
        >>> made.count("Doors &amp; keys"), "http" in made
        (2, False)
    """
    named, said = escape(title), f"<p>{escape(lead)}</p>" if lead else ""
    listed = "".join(
        f'<li><a href="#{escape(anchor)}">{escape(name)}</a></li>' for anchor, name in contents
    )
    nav = f"<nav aria-label='Contents'><ul>{listed}</ul></nav>" if listed else ""
    whole = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        f"<title>{named}</title><style>{style(extra_style, early=early_style)}</style>"
        "</head><body>",
        f"<header><h1>{named}</h1>{said}</header>",
        f"{nav}<main>",
        *parts,
        f"</main><script>{script(extra_script)}</script></body></html>\n",
    ]
    return "\n".join(whole)


def section(anchor: str, title: str, inside: str) -> str:
    """Write a section with its heading.

    Example:
        >>> section("s1", "a < b", "<p>Yes.</p>")
        '<section id="s1"><h2>a &lt; b</h2><p>Yes.</p></section>'
    """
    return f'<section id="{escape(anchor)}"><h2>{escape(title)}</h2>{inside}</section>'


def facts(about: Mapping[str, object]) -> str:
    """Write names and what they stand for; nothing if there are none.

    Example:
        >>> facts({"seed": 3, "engine": "fake"})
        '<dl><dt>seed</dt><dd>3</dd><dt>engine</dt><dd>fake</dd></dl>'
    """
    lines = "".join(
        f"<dt>{escape(str(key))}</dt><dd>{escape(_words(value))}</dd>"
        for key, value in about.items()
    )
    return f"<dl>{lines}</dl>" if lines else ""


def _words(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


def table(
    heads: Sequence[str],
    rows: Iterable[Sequence[str | Entry]],
    *,
    left: int = 0,
    sortable: bool = False,
) -> str:
    """Write a table.

    Args:
        heads: Above the columns.
        rows: As many entries in each.
        left: How many of the first columns are texts; numbers are aligned to the right.
        sortable: Whether a click on a head sorts it. Such a table may be wider than the page.

    Example:
        >>> made = table(["who", "hits"], [["ann", Entry("3 ± 1", by="3")]], left=1)
        >>> print(made.partition("<tbody>")[2])
        <tr><td class="l">ann</td><td data-v="3">3 ± 1</td></tr></tbody></table>
    """
    above = "".join(
        f'<th scope="col"{_class("l" if i < left else "")}>{escape(head)}</th>'
        for i, head in enumerate(heads)
    )
    lines = "".join(
        f"<tr>{''.join(_entry(e, i < left) for i, e in enumerate(row))}</tr>" for row in rows
    )
    inside = f"<thead><tr>{above}</tr></thead><tbody>{lines}</tbody></table>"
    return (
        f'<div class="wide"><table class="sort">{inside}</div>' if sortable else f"<table>{inside}"
    )


def _entry(given: str | Entry, is_left: bool) -> str:
    entry = Entry(given) if isinstance(given, str) else given
    looks = " ".join(filter(None, ("l" if is_left else "", entry.looks)))
    by = "" if entry.by is None else f' data-v="{escape(entry.by)}"'
    return f"<td{_class(looks)}{by}>{escape(entry.text)}</td>"


def _class(looks: str) -> str:
    return f' class="{looks}"' if looks else ""


def picture(png: bytes, text: str, caption: str = "") -> str:
    """Write a picture into the page.

    Args:
        png: The picture.
        text: What it shows, for those who do not see it.
        caption: Below it.
    """
    data = b64encode(png).decode()
    below = f"<figcaption>{escape(caption, quote=False)}</figcaption>" if caption else ""
    return f'<figure><img alt="{escape(text)}" src="data:image/png;base64,{data}">{below}</figure>'


def folded(title: str, inside: str) -> str:
    """Write what is seen only after a click, and on paper.

    Example:
        >>> folded("3 more", "<p>…</p>")
        '<details><summary>3 more</summary><p>…</p></details>'
    """
    return f"<details><summary>{escape(title)}</summary>{inside}</details>"


def embedded(anchor: str, data: object) -> str:
    r"""Write data into the page, so that whoever has the page has the numbers.

    Args:
        anchor: Id of the element that holds them.
        data: Anything that JSON can hold.

    Raises:
        TypeError: It is something that JSON cannot hold.
        ValueError: A number is not finite.

    Example:
        >>> embedded("data", {"a": "</script>"})
        '<script type="application/json" id="data">{"a": "\\u003c/script>"}</script>'
    """
    text = json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{escape(anchor)}">{text}</script>'
