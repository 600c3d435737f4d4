"""Pages of results: each is one HTML file that needs nothing else, and no network.

Pages are jinja2 templates that extend ``output/page.html`` and use the macros of
``output/parts.html``. All values of a template are escaped.
"""

from __future__ import annotations

import json
from base64 import b64encode
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
