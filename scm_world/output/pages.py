"""Pages of results: each is one HTML file that needs nothing else, and no network.

Pages are jinja2 templates that extend ``output/page.html`` and use the macros of
``output/parts.html``. Whatever a template is given is escaped.
"""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, final

FOLDER = Path(__file__).parents[1]
"""Names of templates are relative to the package."""


@final
@dataclass(frozen=True)
class Entry:
    """An entry of a table that is more than a text.

    Attributes:
        text: What is read.
        by: What the column is sorted by, if that is not the text; an empty one comes last.
        looks: ``"best"`` stands out, ``"w"`` is a sentence and may be broken into lines.
    """

    text: str
    by: str | None = None
    looks: str = ""


def render(template: str, **given: Any) -> str:
    """Return what a template makes of its data.

    Args:
        template: Its file, relative to the package, such as ``"output/page.html"``.
        given: What the template names; all of it has to be there.

    Raises:
        TypeError: Data to be embedded are nothing that JSON can hold.
        ValueError: A number in them is not finite.
    """
    return str(_templates().get_template(template).render(**given))


@cache
def _templates() -> Any:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    found = Environment(
        loader=FileSystemLoader(FOLDER), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    found.filters["base64"] = lambda data: b64encode(data).decode()
    found.filters["json"] = lambda data: json.dumps(data, ensure_ascii=False, allow_nan=False)
    found.filters["words"] = lambda value: (
        value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)
    )
    return found


# --- pages that are put together in Python -----------------------------------------------------


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
    """Return a whole page.

    Args:
        title: In the head and above all.
        parts: HTML, one below the other.
        lead: A sentence below the title.
        contents: Anchors and names of the sections that are listed at the top.
        extra_style: Rules that override those of every page; each line ends.
        early_style: Rules that those of every page override.
        extra_script: Statements of its own; each line ends.
    """
    from markupsafe import Markup

    html: dict[str, Any] = {"extra_style": extra_style, "early_style": early_style}
    html = {name: Markup(text) for name, text in (html | {"extra_script": extra_script}).items()}  # noqa: S704
    inside = [Markup(part) for part in parts]  # noqa: S704 - HTML, as it says
    return render(
        "output/page.html", title=title, parts=inside, lead=lead, contents=contents, **html
    )


def section(anchor: str, title: str, inside: str) -> str:
    """Return a section with its heading; ``inside`` is HTML."""
    return part("section", anchor, title, inside=inside)


def folded(title: str, inside: str) -> str:
    """Return what is seen only after a click, and on paper; ``inside`` is HTML."""
    return part("folded", title, inside=inside)


def facts(about: Mapping[str, object]) -> str:
    """Return names and what they stand for; nothing if there are none."""
    return part("facts", about)


def table(
    heads: Sequence[str],
    rows: Iterable[Sequence[str | Entry]],
    *,
    left: int = 0,
    sortable: bool = False,
) -> str:
    """Return a table, of which the first ``left`` columns are texts.

    Example:
        >>> made = table(["who", "hits"], [["ann", Entry("3 ± 1", by="3")]], left=1)
        >>> print(made.partition("<tbody>")[2])
        <tr><td class="l">ann</td><td data-v="3">3 ± 1</td></tr></tbody></table>
    """
    return part("table", heads, rows, left, sortable)


def picture(png: bytes, text: str, caption: str = "") -> str:
    """Return a picture; ``text`` says what it shows, ``caption`` stands below it."""
    return part("picture", png, text, caption)


def part(name: str, *given: Any, inside: str | None = None) -> str:
    """Return what a macro of ``output/parts.html`` makes of its arguments.

    Args:
        name: Of the macro.
        given: Its arguments, which it escapes.
        inside: HTML that it puts something around.
    """
    from markupsafe import Markup

    macro = getattr(_templates().get_template("output/parts.html").module, name)
    caller = {} if inside is None else {"caller": lambda: Markup(inside)}  # noqa: S704 - HTML
    return str(macro(*given, **caller))
