"""A folder of Parquet files as a dataset of Hugging Face, with its Croissant description."""

from __future__ import annotations

import hashlib
import io
import json
from typing import Any

from scm_world._arguments import load
from scm_world.errors import UnreadableFile
from scm_world.output.durable import write_durably
from scm_world.output.remote import Location, located

CONFORMS = "http://mlcommons.org/croissant/1.1"
PARQUET = "application/x-parquet"
KINDS = {"triplets": "pairs", "shard": "rows", "pictures": "pictures"}
"""How the names of files begin, and what a part of the dataset is called that has them."""
TYPES = {"int64": "cr:Int64", "double": "cr:Float64", "string": "sc:Text"}

_TERMS = (
    "arrayShape citeAs column conformsTo containedIn equivalentProperty excludes extract field "
    "fileProperty fileObject fileSet format includes isArray isLiveDataset jsonPath key md5 "
    "parentField path recordSet references regex repeated replace samplingRate separator source "
    "subField transform"
)
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    **{term: f"cr:{term}" for term in _TERMS.split()},
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "description": {"@container": "@language"},
}


def as_huggingface(
    folder: Location | str,
    *,
    name: str = "",
    description: str = "",
    license: str = "",  # noqa: A002 # as Croissant calls it
    url: str = "",
    creator: str = "",
    published: str = "",
    version: str = "1.0.0",
    citation: str = "",
) -> Location:
    """Describe a folder of ``triplets`` or ``collect``, as it can be uploaded to Hugging Face.

    Writes ``README.md``, the card by which ``datasets.load_dataset`` finds the Parquet files, and
    ``croissant.json``, which ``mlcroissant`` reads. Data stay as they are.

    Args:
        folder: With Parquet files; complete.
        name: Of the dataset; that of the folder if empty.
        description: For people; a sentence on where the data come from if empty.
        license: A name or a URL, such as ``"cc-by-4.0"``. Croissant asks for it and what follows.
        url: Where the dataset is.
        creator: Who made it.
        published: The date, as YYYY-MM-DD.
        version: Of the dataset.
        citation: How to cite it, such as a BibTeX entry.

    Returns:
        The folder.

    Raises:
        UnreadableFile: There are no Parquet files of ours.
        MissingExtra: pyarrow is not installed.

    Source:
        MLCommons, *Croissant Format Specification*, version 1.1.
    """
    parquet = load("pyarrow.parquet", "pyarrow", "data")
    place = located(folder)
    groups = dict[str, list[Location]]()
    for kind, part in KINDS.items():
        found = sorted(list[Location](place.glob(f"{kind}-*.parquet")), key=str)
        if found:
            groups[part] = found
    if not groups:
        advice = "give a folder that triplets or collect wrote, with format='parquet'"
        raise UnreadableFile(str(place), "there are no Parquet files of ours in it", advice)
    called = name or place.name
    said = description or "Data of interventions on a simulated system, written by scm-world."
    distribution: list[Any] = []
    records: list[Any] = []
    for part, files in groups.items():
        distribution += [
            {
                "@type": "cr:FileObject",
                "@id": file.name,
                "name": file.name,
                "contentUrl": file.name,
                "encodingFormat": PARQUET,
                "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            }
            for file in files
        ]
        distribution.append(
            {
                "@type": "cr:FileSet",
                "@id": f"{part}-files",
                "name": f"{part}-files",
                "encodingFormat": PARQUET,
                "includes": files[0].name.partition("-")[0] + "-*.parquet",
            }
        )
        schema = parquet.read_schema(io.BytesIO(files[0].read_bytes()))
        fields = [_field(part, column) for column in schema]
        records.append({"@type": "cr:RecordSet", "@id": part, "name": part, "field": fields})
    about = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS,
        "name": called,
        "description": said,
        "license": license,
        "url": url,
        "creator": {"@type": "sc:Person", "name": creator} if creator else "",
        "datePublished": published,
        "version": version,
        "citeAs": citation,
        "distribution": distribution,
        "recordSet": records,
    }
    about = {key: value for key, value in about.items() if value}
    lines = ["---", f"pretty_name: {json.dumps(called)}"]
    lines += [f"license: {json.dumps(license)}"] if license else []
    lines += ["configs:"]
    for part, files in groups.items():
        pattern = files[0].name.partition("-")[0] + "-*.parquet"
        lines += [f"- config_name: {part}", f"  data_files: {json.dumps(pattern)}"]
    lines += ["---", "", f"# {called}", "", said, ""]
    write_durably(place / "README.md", "\n".join(lines).encode())
    write_durably(place / "croissant.json", (json.dumps(about, indent=1) + "\n").encode())
    return place


def _field(part: str, column: Any) -> dict[str, Any]:
    """Describe a column: a number, a list of numbers or words, or a picture."""
    kind, extract = str(column.type), {"column": column.name}
    source: dict[str, Any] = {"fileSet": {"@id": f"{part}-files"}, "extract": extract}
    field = {"@type": "cr:Field", "@id": f"{part}/{column.name}", "name": column.name}
    if kind.startswith("struct"):
        source["transform"] = {"jsonPath": "bytes"}
        return {**field, "dataType": "sc:ImageObject", "source": source}
    several = kind.startswith("list")
    plain = str(column.type.value_type) if several else kind
    shape = {"isArray": True, "arrayShape": "-1"} if several else {}
    return {**field, "dataType": TYPES[plain], **shape, "source": source}
