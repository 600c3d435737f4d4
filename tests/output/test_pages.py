"""Pages that need nothing else."""

from __future__ import annotations

import json
from base64 import b64decode
from html.parser import HTMLParser
from typing import Any

import pytest

from scm_world.output import pages
from scm_world.output.pages import Entry

NASTY = "<b>\"a\" & 'b'</b>"
VOID = ("meta", "img")


class Reader(HTMLParser):
    """Notes elements, with their attributes, and texts; tags have to be closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note an element."""
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """Check that it was opened last."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Note a text."""
        self.texts.append(data)

    def named(self, tag: str) -> list[dict[str, str | None]]:
        """Give the attributes of all elements of a name."""
        return [attributes for name, attributes in self.elements if name == tag]


def page(main: str, **given: Any) -> str:
    """Render a page whose main part is given as a template."""
    head = '{% extends "output/page.html" %}{% import "output/parts.html" as parts %}'
    whole = pages._templates().from_string(f"{head}{{% block main %}}{main}{{% endblock %}}")
    return str(whole.render(**{"title": "T", "lead": "", "contents": [], **given}))


def test_whatever_is_said_is_a_text() -> None:
    """No title, name, caption or value can become a part of the page."""
    main = """
    {% call parts.section("s", nasty) %}{{ parts.facts({nasty: nasty, "list": [nasty]}) }}{% endcall %}
    {% call parts.section(nasty, "T") %}{{ parts.table([nasty], rows) }}{% endcall %}
    {{ parts.picture(png, nasty, nasty) }}
    {% call parts.folded(nasty) %}<p>inside</p>{% endcall %}"""  # noqa: E501
    rows = [[NASTY], [Entry(NASTY, by=NASTY)]]
    given: Any = {"title": NASTY, "lead": NASTY, "contents": [("s", NASTY)]}
    seen = Reader(page(main, **given, nasty=NASTY, rows=rows, png=b"png"))
    assert seen.texts.count(NASTY) == 12
    assert seen.named("img")[0]["alt"] == seen.named("td")[1]["data-v"] == NASTY
    assert not seen.named("b")


def test_a_page_loads_nothing() -> None:
    """There is no address in it, and its pictures are in it."""
    text = page('{{ parts.picture(png, "a picture") }}', png=b"some bytes")
    assert "http" not in text
    assert b64decode((Reader(text).named("img")[0]["src"] or "").partition(",")[2]) == b"some bytes"


def test_contents_lead_to_sections() -> None:
    """In their order; without any there is no list."""
    names = [("one", "One"), ("two", "Two")]
    main = "{% for n, t in contents %}{% call parts.section(n, t) %}{% endcall %}{% endfor %}"
    seen = Reader(page(main, contents=names))
    assert [a["href"] for a in seen.named("a")] == [f"#{s['id']}" for s in seen.named("section")]
    assert len(seen.named("a")) == 2
    assert not Reader(page("")).named("nav")


def test_tables_are_sorted_by_values_not_by_words() -> None:
    """What a column is sorted by may differ from what is read; texts stand on the left."""
    rows = [["ann", Entry("3 ± 1", by="3", looks="best")], ["bob", Entry("–", by="")]]
    seen = Reader(page('{{ parts.table(["who", "hits"], rows, 1, true) }}', rows=rows))
    assert seen.named("td") == [
        {"class": "l"},
        {"class": "best", "data-v": "3"},
        {"class": "l"},
        {"data-v": ""},
    ]
    assert [head.get("class") for head in seen.named("th")] == ["l", None]
    assert [t["class"] for t in seen.named("table")] == ["sort"]
    plain = Reader(page('{{ parts.table(["who", "hits"], rows) }}', rows=rows))
    assert plain.named("table") == [{}]


def test_numbers_in_a_page_can_be_read_again() -> None:
    """As they were, even where they would end the element."""
    main = '{{ parts.embedded("data", data) }}'
    data = {"rows": [1, 0.1, None, "</script><b>"], "é": "→"}
    seen = Reader(page(main, data=data))
    (written,) = (text for text in seen.texts if text.startswith("{"))
    assert json.loads(written) == data
    assert not seen.named("b")
    with pytest.raises(ValueError, match="JSON"):
        page(main, data={"x": float("nan")})


def test_no_facts_are_nothing() -> None:
    """An empty list would be announced as one."""
    assert not Reader(page("{{ parts.facts({}) }}")).named("dl")
