"""Evaluations in files: JSON for people and programs, Parquet or CSV for the episodes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from hashlib import blake2b
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from scm_world._arguments import one_of
from scm_world.errors import DAMAGED, UnreadableFile
from scm_world.evaluation.results import KEYS, TEXTS, WHOLE, Columns, Evaluation
from scm_world.output.durable import locked, removed, write_durably, write_whole
from scm_world.output.reading import LARGEST_TABLE, read_bytes, read_table, read_text
from scm_world.output.remote import Location

FORMAT = "scm_world/evaluation/1"
RESULTS = "results.json"
TABLE = "episodes"
ABOUT = ("task", "arguments", "env", "engines", "agents", "protocols", "seeds", "n", "versions")
ADVICE = "give the folder, or the results.json, that an evaluation wrote"


def save(evaluation: Evaluation, folder: Location, form: str) -> tuple[Location, Location]:
    """Write the table, then the summary that names it; see ``Evaluation.save``."""
    one_of("format", form, CODECS)
    table, summary = folder / f"{TABLE}.{form}", folder / RESULTS
    content = CODECS[form][0](evaluation.columns)
    data: dict[str, Any] = {
        "format": FORMAT,
        "table": {"file": table.name, "rows": len(evaluation), "digest": evaluation.digest},
        "scores": summarized(evaluation),
        "about": dict(evaluation.about),
    }
    data["checksum"] = _checksum(data)
    with locked(folder):
        removed(summary)  # it is of the table that goes
        for other in CODECS:
            removed(folder / f"{TABLE}.{other}")
        write_durably(table, content)
        write_whole(json.dumps(data, indent=1, allow_nan=False) + "\n", summary)
    return summary, table


def _checksum(data: Mapping[str, Any]) -> str:
    """Sum up everything in a summary but the sum."""
    rest = {name: value for name, value in data.items() if name != "checksum"}
    return blake2b(json.dumps(rest, sort_keys=True).encode(), digest_size=16).hexdigest()


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
            raise ValueError("it is no evaluation")
        if data.get("checksum", _checksum(data)) != _checksum(data):  # older files have none
            raise ValueError("its content is not what was written: the checksum differs")
        for name in ABOUT:
            data["about"][name]
        table = file.parent / PurePosixPath(data["table"]["file"]).name
        decode = CODECS[table.suffix.removeprefix(".")][1]
        found = Evaluation(data["about"], decode(read_bytes(table, LARGEST_TABLE)))
        if found.digest != data["table"]["digest"]:
            raise ValueError(f"{table.name} is not the table that was written with it")
    except DAMAGED as error:
        raise UnreadableFile(str(file), _said(error), ADVICE) from None
    return found


def _said(error: Exception) -> str:
    return f"it has no {error}" if isinstance(error, KeyError) else str(error)


# --- tables -----------------------------------------------------------------------------------


def _to_parquet(columns: Columns) -> bytes:
    import pyarrow as arrow
    from pyarrow import parquet

    table = arrow.table({n: arrow.array(c, from_pandas=False) for n, c in columns.items()})
    sink = arrow.BufferOutputStream()
    parquet.write_table(table, sink, compression="zstd", use_dictionary=list(TEXTS))
    return bytes(sink.getvalue())


def _from_parquet(data: bytes) -> Columns:
    table = read_table(data)
    return _typed({name: table[name].to_numpy() for name in table.column_names})


def _to_csv(columns: Columns) -> bytes:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(map(_word, c.tolist()) for c in columns.values()), strict=True))
    return stream.getvalue().encode()


def _word(value: Any) -> str:
    return repr(value) if isinstance(value, float) else str(value)


def _from_csv(data: bytes) -> Columns:
    try:
        head, *rows = list(csv.reader(io.StringIO(data.decode(), newline="")))
    except csv.Error as error:
        raise ValueError(f"the table is no CSV ({error})") from None
    return _typed(dict(zip(head, zip(*rows, strict=True), strict=True)))


def _typed(columns: Mapping[str, Any]) -> Columns:
    """Give columns the types that they had."""
    missing = [name for name in (*KEYS, "steps", "return", "hash") if name not in columns]
    if missing:
        raise ValueError(f"the table has no column {missing[0]!r}")
    kinds: dict[str, Any] = {**dict.fromkeys(TEXTS, str), **dict.fromkeys(WHOLE, np.int64)}
    return {n: np.array(list(c), dtype=kinds.get(n, np.float64)) for n, c in columns.items()}


CODECS: Mapping[str, tuple[Callable[[Columns], bytes], Callable[[bytes], Columns]]] = {
    "parquet": (_to_parquet, _from_parquet),
    "csv": (_to_csv, _from_csv),
}
"""How tables are written and read, by the ending of the file."""
