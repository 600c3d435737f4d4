"""The commands of suites: tables and questions that can be cited, made anew and scored."""

from __future__ import annotations

from typing import Annotated

import typer

from scm_world.cli import console, options
from scm_world.runs.files import located

Name = Annotated[str, typer.Argument(metavar="NAME")]
Answers = Annotated[str, typer.Argument(metavar="ANSWERS")]
Path = Annotated[str | None, typer.Option(metavar="PATH")]
SHOWN = 20  # parts that are named


def list_() -> None:
    """Print the suites.

    Example: scm-world suite list
    """
    from scm_world.lab.suites import SUITES, suite

    found = [suite(name) for name in SUITES]
    rows = [
        {"suite": one.name, "parts": len(one.parts()), "about": one.manifest["title"]}
        for one in found
    ]
    console.frame(rows)


def make(
    name: Name, *, key: options.Key = None, out: options.Out = None, jobs: options.ManyJobs
) -> None:
    """Make a suite in a folder, and compare its hashes with the manifest.

    The folder has the layout of Hugging Face, with Croissant. Exits 1 if a part differs. After
    Ctrl-C (exit code 130) the same command resumes.
    Example: scm-world suite make physics-1 --out physics-1

    Args:
        name: Name of a suite; see 'scm-world suite list'.
    """
    from scm_world.lab.suites import suite

    found, folder = suite(name), console.results_folder(out, "suite", name)
    with jobs.open("parts", folder, "*.parquet", "parts") as job:
        made = found.make(key=key, **job)
    rows = sum(part["rows"] for part in made.parts.values())
    known = sum("sha256" in found.manifest["parts"][part] for part in made.parts)
    console.say(
        f"{name}: {len(made.parts)} parts, {rows} rows; the manifest has hashes of {known} parts, "
        f"and {known - len(made.differ)} are the same"
    )
    if skipped := sum(part.get("skipped", 0) for part in made.parts.values()):
        console.say(f"seeds without a question, of which others took the place: {skipped}")
    if made.differ:
        shown = ", ".join(made.differ[:SHOWN]) + ", …" * (len(made.differ) > SHOWN)
        other = "; ".join(made.versions) or "the versions are the same"
        console.say(f"these differ: {shown}", f"versions: {other}")
    console.written(folder / "README.md", folder / "croissant.json")
    raise typer.Exit(int(bool(made.differ)))


def score(
    name: Name,
    answers: Answers,
    *,
    made: Path = None,
    key: options.Key = None,
    jobs: options.ManyJobs,
) -> None:
    """Grade answers to a suite, by kind and level, with 95 % intervals.

    Example: scm-world suite score physics-1 answers.csv --made physics-1

    Args:
        name: Name of a suite; see 'scm-world suite list'.
        answers: Parquet, CSV or JSONL with the columns question, answer (JSON) and confidence.
        made: Folder of 'suite make'; without it the parts with answers are made again.
    """
    from scm_world.lab.suites import suite

    with jobs.open("parts", located(made or answers), "*.parquet", "parts") as job:
        job.pop("out")
        table = suite(name).score(answers, made=made, key=key, **job)
    console.frame(table, title=f"{name}: mean scores with 95 % intervals")
