"""Write ``llms.txt`` and ``llms-full.txt`` into a built site: ``python .ci/llms.py site``.

The first one lists the pages (see https://llmstxt.org), the second one has their text. The Markdown
of each page lies in the site, too, and all links are relative to its root.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import posixpath
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
ENTRY = re.compile(r"^( +)- (?:([^\n]+?):)? ?(\S+\.md)?$", re.MULTILINE)
EXECUTED = re.compile(r'^```py exec="1"\n(.*?)^```$', re.DOTALL | re.MULTILINE)
INTRODUCTION = """# scm_world

> Turns a physical system (an MJCF or URDF file, a step function or equations) into a structural
> causal model that can be stepped: interventions, counterfactuals, effects, verified graphs,
> fits to recordings, interventional data, and environments for agents.
"""


def module(found: re.Match[str]) -> str:
    """Return the public names of a module, each with the first sentence of its docstring."""
    there = importlib.import_module(found[1])
    lines = [f"## {found[1]}", "", inspect.getdoc(there) or "", ""]
    own = [name for name, one in vars(there).items() if getattr(one, "__module__", "") == found[1]]
    for name in getattr(there, "__all__", [name for name in own if not name.startswith("_")]):
        text = inspect.getdoc(getattr(there, name)) if callable(getattr(there, name)) else None
        lines.append(f"- `{name}`" + (f": {text.partition(chr(10))[0]}" if text else ""))
    return "\n".join(lines)


def printed(found: re.Match[str]) -> str:
    """Return what a block of a page prints."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        exec(found[1], {})  # noqa: S102 # our own text
    return output.getvalue().replace("\n#", "\n##")


def pages() -> dict[str, tuple[str, str, str]]:
    """Return section, title and text of each page, in the order of the navigation, by its path."""
    _, _, navigation = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")
    found: dict[str, tuple[str, str, str]] = {}
    section = ""
    for indent, title, path in ENTRY.findall(navigation.partition("\nplugins:\n")[0]):
        section = title if len(indent) == 2 else section
        if path:
            text = re.sub(
                r'^--8<-- "(.+)"$',
                lambda one: (ROOT / one[1]).read_text().rstrip(),
                (DOCS / path).read_text(),
                flags=re.MULTILINE,
            )
            text = re.sub(r"^::: (\S+)$", module, EXECUTED.sub(printed, text), flags=re.MULTILINE)
            found[path] = (section, title, text)
    return found


def from_root(path: str, text: str) -> str:
    """Return the text of a page with its links to files of the site relative to the root."""

    def link(found: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), found[2]))
        return found[1] + (target if (DOCS / target).is_file() else found[2])

    return re.sub(r'(\]\(|src=")([^)"#:\s]+)', link, text)


def sentence(text: str) -> str:
    """Return the first sentence of a page, without its links."""
    text = re.sub(r"^```.*?^```$|!?\[![^\n]*|!\[[^\n]*", "", text, flags=re.DOTALL | re.MULTILINE)
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    words = [part for part in plain.split("\n\n")[1:] if re.match(r"\s*[A-Z`*]", part)]
    return re.split(r"(?<=[.?])\s", " ".join(words[0].split()))[0].rstrip(":") if words else ""


def texts(found: dict[str, tuple[str, str, str]]) -> tuple[str, str]:
    """Return the contents of ``llms.txt`` and of ``llms-full.txt`` for these pages."""
    lines, whole, last = [INTRODUCTION], [INTRODUCTION], ""
    for path, (section, title, text) in found.items():
        if section != last:
            lines.append(("" if last == "" else "\n") + f"## {section}\n")
            last = section
        lines.append(f"- [{title}]({path}): {sentence(text)}")
        whole.append(f"<!-- {path} -->\n\n{from_root(path, text).strip()}\n")
    return "\n".join(lines) + "\n", "\n".join(whole)


if __name__ == "__main__":
    site, found = Path(sys.argv[1]), pages()
    written = {name: text for name, (_, _, text) in found.items()}
    written["llms.txt"], written["llms-full.txt"] = texts(found)
    for name, text in written.items():
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (site / name).write_text(text)
