"""Evaluations in files: JSON for people and programs, Parquet or CSV for the episodes."""

from __future__ import annotations

import io
import json
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import pandas

from scm_world._arguments import one_of
from scm_world.errors import DAMAGED, UnreadableFile, in_one_line
from scm_world.evaluation.results import KEYS, Evaluation
from scm_world.runs.files import Location, read_bytes, read_text, removed, write_whole

FORMAT = "scm_world/evaluation/2"
RESULTS = "results.json"
FORMS = ("parquet", "csv")
ABOUT = ("task", "arguments", "env", "engines", "agents", "protocols", "seeds", "n", "versions")
ADVICE = "give the folder, or the results.json, that an evaluation wrote"
TYPES: dict[str, Any] = {
    **dict.fromkeys(("agent", "engine", "protocol", "hash"), str),
    **dict.fromkeys(("run", "seed", "episode", "steps"), np.int64),
}
"""Types of the columns that do not hold 64-bit floats."""


def save(evaluation: Evaluation, folder: Location, form: str) -> tuple[Location, Location]:
    """Write the table, then the summary that names it; see ``Evaluation.save``."""
    one_of("format", form, FORMS)
    summary, table = folder / RESULTS, folder / f"episodes.{form}"
    content = io.BytesIO()
    if form == "parquet":
        evaluation.frame.to_parquet(content, compression="zstd", index=False)
    else:
        evaluation.frame.to_csv(content, index=False, na_rep="nan", lineterminator="\n")
    data = {
        "format": FORMAT,
        "table": {"file": table.name, "rows": len(evaluation)},
        "scores": summarized(evaluation),
        "about": dict(evaluation.about),
    }
    removed(summary)  # it is of the table that goes
    for other in FORMS:
        removed(folder / f"episodes.{other}")
    write_whole(table, content.getvalue())
    write_whole(summary, json.dumps(data, indent=1, allow_nan=False) + "\n")
    return summary, table


def summarized(evaluation: Evaluation) -> list[dict[str, Any]]:
    """List the scores with their intervals: one row for each agent, backend and protocol."""
    return [
        {
            "agent": agent,
            "engine": engine,
            "protocol": protocol,
            **{
                metric: mine.score(protocol, metric, agent=agent, engine=engine).as_dict()
                for metric in mine.metrics
            },
        }
        for agent in evaluation.agents
        for engine in evaluation.only(agent=agent).engines
        for mine in [evaluation.only(agent=agent, engine=engine)]
        for protocol in mine.protocols
    ]


def load(path: Location) -> Evaluation:
    """Read an evaluation; see ``Evaluation.load``."""
    file = path / RESULTS if path.is_dir() else path
    try:
        data = json.loads(read_text(file))
        if data["format"] != FORMAT:
            raise ValueError(f"it is not an evaluation of the format {FORMAT!r}")
        missing = [name for name in ABOUT if name not in data["about"]]
        table = file.parent / PurePosixPath(data["table"]["file"]).name
        content = io.BytesIO(read_bytes(table))
        if table.suffix == ".csv":
            frame = pandas.read_csv(content, dtype=str, keep_default_na=False)
        else:
            frame = pandas.read_parquet(content)
        missing += [name for name in (*KEYS, "steps", "return", "hash") if name not in frame]
        if missing or len(frame) != data["table"]["rows"]:
            lacks = f"lacks {missing[0]!r}" if missing else "has another number of rows"
            raise ValueError(f"it, or {table.name}, {lacks}")
        frame = frame.astype({name: TYPES.get(str(name), np.float64) for name in frame})
    except DAMAGED as error:
        raise UnreadableFile(str(file), in_one_line(error), ADVICE) from None
    return Evaluation(data["about"], frame)
