"""Some episodes as the bytes of a Parquet file, and back without loss."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.discovery.data.dataset import NUMBERS, RESERVED, TARGETS, Dataset, Ints, Regime
from scm_world.discovery.data.sources import SourceRows
from scm_world.output.reading import read_table
from scm_world.queries.plans import FORMAT as PLAN
from scm_world.queries.plans import Plan

KEY = b"scm_world"
FORMAT = "scm_world/shard/1"


@final
@dataclass(frozen=True)
class Raw:
    """What a file holds, before it is believed."""

    header: dict[str, Any]
    numbers: dict[str, Ints]
    targets: list[str]
    values: Floats


def encoded(part: SourceRows, plan: str, numbers: range) -> bytes:
    """Write episodes as the bytes of a file; the same ones every time.

    Args:
        part: The episodes.
        plan: Sums up everything that decides the rows of the dataset they belong to.
        numbers: Of the episodes.

    Raises:
        ModelError: A plan has a function without a name, or a column has a name of ours.
    """
    header = {
        "format": FORMAT,
        "plan": plan,
        "first": numbers.start,
        "stop": numbers.stop,
        "refused": [list(pair) for pair in part.refused],
        **({"touching": part.touching} if part.touching else {}),
        **_regimes(part.table.regimes),
    }
    raw = raw_of(part.table, header)
    header["checksum"] = checksum(raw)
    return _to_parquet(raw, part.table.names)


def raw_of(table: Dataset, header: dict[str, Any] | None = None) -> Raw:
    """Give a table as a file holds it; with its regimes as the header, if there is no other.

    Raises:
        ModelError: A plan has a function without a name.
    """
    head = _regimes(table.regimes) if header is None else header
    numbers = {name: getattr(table, name) for name in NUMBERS}
    texts = [";".join(names) for names in table.target_names]
    return Raw(head, numbers, [texts[number] for number in table.regime], table.values)


def decoded(
    data: bytes, plan: str, empty: Dataset, trusted: Sequence[str]
) -> tuple[range, SourceRows]:
    """Read what ``encoded`` wrote.

    Args:
        data: The bytes of the file.
        plan: As above.
        empty: The dataset it should belong to, without rows.
        trusted: Packages whose functions may be mechanisms of its plans.

    Returns:
        The numbers of its episodes, and these.

    Raises:
        ValueError: It is damaged, or belongs to another dataset; with the reason.
        ModelError: A plan names a function outside of the trusted packages.
    """
    raw = _from_parquet(data, empty.names)
    header = raw.header
    if header.get("format") != FORMAT:
        raise ValueError("it is no part of a dataset")
    given = header.pop("checksum", None)
    if given != checksum(raw):
        raise ValueError("its content is not what was written")
    if header["plan"] != plan:
        raise ValueError("it belongs to another dataset")
    acts = [
        (name, Plan.from_dict({"format": PLAN, "do": {name: parts}}, trusted=trusted)[name])
        for name, parts in header["acts"]
    ]
    regimes = tuple(
        Regime(Plan(dict(acts[number] for number in numbers)), tuple(targets))
        for numbers, targets in header["regimes"]
    )
    rows: dict[str, Any] = {"values": raw.values, "regimes": regimes, **raw.numbers}
    table = replace(empty, **rows)
    refused = tuple((int(number), str(why)) for number, why in header["refused"])
    return range(header["first"], header["stop"]), SourceRows(
        table, refused, touching=header.get("touching", {})
    )


def checksum(raw: Raw) -> str:
    """Sum up what a file holds."""
    found = hashlib.sha256(json.dumps([raw.header, raw.targets], sort_keys=True).encode())
    for name in NUMBERS:
        found.update(np.ascontiguousarray(raw.numbers[name], dtype="<i8").tobytes())
    found.update(np.ascontiguousarray(raw.values, dtype="<f8").tobytes())
    return found.hexdigest()


# --- regimes ----------------------------------------------------------------------------------


def _regimes(regimes: Sequence[Regime]) -> dict[str, Any]:
    """Write regimes; what many of them do is written once."""
    acts: dict[str, int] = {}
    written = []
    for regime in regimes:
        done = regime.plan.as_dict()["do"]
        texts = [json.dumps([name, parts]) for name, parts in done.items()]
        numbers = [acts.setdefault(text, len(acts)) for text in texts]
        written.append([numbers, list(regime.targets)])
    return {"acts": [json.loads(text) for text in acts], "regimes": written}


# --- Parquet ----------------------------------------------------------------------------------


def _to_parquet(raw: Raw, names: Sequence[str]) -> bytes:
    import pyarrow as arrow
    from pyarrow import parquet

    columns = {
        **raw.numbers,
        TARGETS: arrow.array(raw.targets, arrow.string()),
        **dict(zip(names, raw.values.T.copy(), strict=True)),
    }
    header = json.dumps(raw.header, sort_keys=True)
    made = arrow.table(columns).replace_schema_metadata({KEY: header})
    sink = arrow.BufferOutputStream()
    # Only words repeat; numbers keep every bit without a dictionary, and are faster.
    parquet.write_table(made, sink, compression="zstd", use_dictionary=[TARGETS])
    return bytes(sink.getvalue())


def _from_parquet(data: bytes, names: Sequence[str]) -> Raw:
    table = read_table(data)
    if table.column_names != [*RESERVED, *names]:
        raise ValueError("it has other columns")
    rows = [table[name].to_numpy() for name in names]
    return Raw(
        json.loads((table.schema.metadata or {})[KEY]),
        {name: table[name].to_numpy().astype(np.int64) for name in NUMBERS},
        table[TARGETS].to_pylist(),
        np.stack(rows, axis=1) if rows else np.empty((table.num_rows, 0)),
    )
