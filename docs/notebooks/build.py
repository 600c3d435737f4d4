"""Run the notebooks and write their pages and ``.ipynb`` files: ``python docs/notebooks/build.py``.

A notebook is a Python file in the percent format, in which ``# %%`` begins a cell of code and
``# %% [markdown]`` one of text. Its page has the printed output and the figures of each cell.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
REPOSITORY = "THE_OWNER/scm_world"  # on GitHub: replace it when the public address is known
COLAB = "https://colab.research.google.com"
INSTALL = f"%pip install -q git+https://github.com/{REPOSITORY}"


def cells(text: str) -> list[tuple[bool, str]]:
    """Return whether each cell of a file in the percent format is text, and its contents."""
    found = []
    for part in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        kind, _, body = part.partition("\n")
        is_text = kind.strip() == "[markdown]"
        body = re.sub(r"^# ?", "", body, flags=re.MULTILINE) if is_text else body
        found.append((is_text, body.strip("\n")))
    return found


def notebook(text: str) -> str:
    """Return the ``.ipynb`` file of a notebook, without outputs; Colab installs the package."""
    made: list[dict[str, Any]] = []
    linked = rf"](https://github.com/{REPOSITORY}/blob/main/docs/"
    for at, (is_text, body) in enumerate([(False, INSTALL), *cells(text)]):
        source = body.replace("](../", linked) if is_text else body
        made.append({"cell_type": "markdown" if is_text else "code", "id": f"cell-{at}"})
        made[-1] |= {"metadata": {}, "source": source.splitlines(keepends=True)}
        if not is_text:
            made[-1] |= {"execution_count": None, "outputs": []}
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    about = {"kernelspec": kernel, "language_info": {"name": "python"}}
    whole = {"cells": made, "metadata": about, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def page(path: Path) -> str:
    """Run a notebook, save its figures under ``docs/images/notebooks``, and return its page."""
    import matplotlib.pyplot as plt

    folder, names = HERE.parent / "images" / "notebooks", {"__name__": "document"}
    folder.mkdir(parents=True, exist_ok=True)
    address = f"{COLAB}/github/{REPOSITORY}/blob/main/docs/notebooks/{path.stem}.ipynb"
    button = f"[Open in Colab]({address}){{ .md-button }}"
    parts: list[str] = []
    drawn = 0
    for is_text, body in cells(path.read_text()):
        if is_text:
            parts.append(body)
            continue
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(body, str(path), "exec"), names)  # noqa: S102 # our own text
        parts.append(f"```python\n{body}\n```")
        if printed.getvalue():
            parts.append(f"```text\n{printed.getvalue()}```")
        for number in plt.get_fignums():
            figure, drawn = plt.figure(number), drawn + 1
            name = f"{path.stem}-{drawn}.png"
            figure.savefig(folder / name, dpi=80, metadata={"Software": None})
            parts.append(f"![{figure.get_label()}](../images/notebooks/{name})")
        plt.close("all")
    command = "This page is written by `python docs/notebooks/build.py`, with outputs of a run."
    return "\n\n".join([parts[0], button, *parts[1:], command]) + "\n"


if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("agg")
    for one in sorted(HERE.glob("*.py")):
        if one != Path(__file__) and (not sys.argv[1:] or one.stem in sys.argv[1:]):
            (HERE / f"{one.stem}.md").write_text(page(one))
            (HERE / f"{one.stem}.ipynb").write_text(notebook(one.read_text()))
