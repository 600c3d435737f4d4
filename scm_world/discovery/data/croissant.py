"""A folder of Parquet files as a dataset of Hugging Face, with its Croissant description."""

from __future__ import annotations

import hashlib
import io
import json
from typing import TYPE_CHECKING, Any

from scm_world._arguments import typed
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.runs.files import Location, located, write_whole

if TYPE_CHECKING:
    import pyarrow as arrow

KINDS = {
    "triplets": "pairs",
    "shard": "rows",
    "pictures": "pictures",
    "questions": "questions",
    "private": "private",
}
"""The beginning of the names of files, and the name of their part of the dataset."""
TYPES = {
    "int64": "cr:Int64",
    "double": "cr:Float64",
    "string": "sc:Text",
    "large_string": "sc:Text",  # of pandas 3
}
TERMS = (
    "arrayShape citeAs column containedIn equivalentProperty excludes extract field fileProperty "
    "fileObject fileSet format includes isArray isLiveDataset jsonPath key md5 parentField path "
    "recordSet references regex repeated replace samplingRate separator source subField transform"
)
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    **{term: f"cr:{term}" for term in TERMS.split()},
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "description": {"@container": "@language"},
}


@typed
def as_huggingface(folder: Location | str, **about: object) -> Location:
    """Describe a folder of ``triplets`` or ``collect``, as it can be uploaded to Hugging Face.

    Writes ``README.md``, the card by which ``datasets.load_dataset`` finds the Parquet files, and
    ``croissant.json``, which ``mlcroissant`` reads. Data stay as they are.

    Args:
        folder: With Parquet files, or with folders that have them, each a part of its own name;
            complete.
        about: Properties of the dataset, as Croissant calls them: ``name``, ``description``,
            ``version``, and its recommended fields: ``license``, ``url``, ``creator``,
            ``datePublished`` and ``citeAs``.

    Returns:
        The folder.

    Raises:
        UnreadableFile: There are no Parquet files of ours.

    Source:
        MLCommons, *Croissant Format Specification*, version 1.1.
    """
    from pyarrow import parquet

    for name, value in about.items():
        try:
            json.dumps(value)
        except (TypeError, ValueError):
            raise UnknownOption(name, value, ("a text, or other JSON",)) from None
    place = located(folder)
    said = "Data of interventions on a simulated system, written by scm-world."
    about = {"name": place.name, "description": said, "version": "1.0.0", **about}
    if isinstance(about.get("creator"), str):
        about["creator"] = {"@type": "sc:Person", "name": about["creator"]}
    card = [f"pretty_name: {json.dumps(about['name'])}"]
    card += [f"license: {json.dumps(about['license'])}"] if "license" in about else []
    distribution, records, configs = list[Any](), list[Any](), ["configs:"]
    patterns = {part: f"{kind}-*.parquet" for kind, part in KINDS.items()}
    for inner in sorted(list[Location](place.iterdir()), key=str):
        patterns |= {inner.name: f"{inner.name}/shard-*.parquet"} if inner.is_dir() else {}
    for part, pattern in patterns.items():
        inside = "".join(pattern.rpartition("/")[:2])
        found = list[Location](place.glob(pattern))
        files = {inside + file.name: file.read_bytes() for file in found}
        if not files:
            continue
        format_ = {"encodingFormat": "application/x-parquet"}
        whole = {"@type": "cr:FileSet", "@id": f"{part}-files", "name": f"{part}-files"}
        distribution.append({**whole, **format_, "includes": pattern})
        for name, data in sorted(files.items()):
            file = {"@type": "cr:FileObject", "@id": name, "name": name, "contentUrl": name}
            digest = hashlib.sha256(data).hexdigest()
            distribution.append({**file, **format_, "sha256": digest})
        schema = parquet.read_schema(io.BytesIO(files[min(files)]))
        fields = [_field(part, column) for column in schema]
        records.append({"@type": "cr:RecordSet", "@id": part, "name": part, "field": fields})
        configs += [f"- config_name: {part}", f"  data_files: {json.dumps(pattern)}"]
    if not records:
        advice = "give a folder that triplets or collect wrote"
        raise UnreadableFile(str(place), "there are no Parquet files of ours in it", advice)
    head = {"@context": CONTEXT, "@type": "sc:Dataset"}
    head["conformsTo"] = "http://mlcommons.org/croissant/1.1"
    croissant = {**head, **about, "distribution": distribution, "recordSet": records}
    lines = [
        "---",
        *card,
        *configs,
        "---",
        "",
        f"# {about['name']}",
        "",
        str(about["description"]),
        "",
    ]
    write_whole(place / "README.md", "\n".join(lines))
    write_whole(place / "croissant.json", json.dumps(croissant, indent=1) + "\n")
    return place


def _field(part: str, column: arrow.Field) -> dict[str, Any]:
    """Describe a column: a number, a list of numbers or words, or a picture."""
    kind, several = str(column.type), str(column.type).startswith("list")
    source = {"fileSet": {"@id": f"{part}-files"}, "extract": {"column": column.name}}
    field = {"@type": "cr:Field", "@id": f"{part}/{column.name}", "name": column.name}
    if kind.startswith("struct"):
        source["transform"] = {"jsonPath": "bytes"}
        return {**field, "dataType": "sc:ImageObject", "source": source}
    shape = {"isArray": True, "arrayShape": "-1"} if several else {}
    plain = str(column.type.value_type) if several else kind
    return {**field, "dataType": TYPES[plain], **shape, "source": source}
