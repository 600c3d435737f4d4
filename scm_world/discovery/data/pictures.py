"""Pairs of pictures before and after an intervention, for learners of causal representations."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world._arguments import load, whole_number
from scm_world.backends.renderer import picture
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.output.durable import write_durably
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.variables import Draw, Noise
from scm_world.work.executors import Executor, opened
from scm_world.world import Simulation

FORMAT = "scm_world/triplets/1"
HEAD = "triplets.json"


def triplets(
    world: Simulation,
    factors: Iterable[str],
    n: int,
    out: Path | str,
    *,
    cameras: Iterable[str | None] = (None,),
    size: tuple[int, int] = (64, 64),
    targets: int = 1,
    steps: int = 0,
    seed: int = 0,
    shard: int = 1000,
    workers: int | None = None,
    engine: Executor | str | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write pictures x of a scene and x̃ of its counterfactual, with factors z and z̃ and targets.

    In each pair all factors are drawn from their space A; then some of them are drawn again, and
    everything else stays: the noise, and over ``steps`` control steps the idle action, too. So z̃
    differs from z in the targets, and in the factors that follow from them.

    An interrupted call resumes when it is repeated, and the files are then the same, byte for byte.
    They are Parquet, one row per pair, as ``datasets.load_dataset("parquet", …)`` of Hugging Face
    reads them: pictures are PNG.

    Args:
        world: That is drawn; it is not changed.
        factors: Names of variables with a space A.
        n: How many pairs.
        out: A folder: new, empty, or one of the same call.
        cameras: Names of cameras, of the robot or of the model; None is the usual one. Each has two
            columns.
        size: Height and width of a picture [pixels].
        targets: How many factors are drawn again in each pair, by lot.
        steps: Control steps after which the pictures are taken.
        seed: Of the noise.
        shard: How many pairs are in a file.
        workers: Processes; None is one. The files do not depend on it.
        engine: See ``engine_of``.
        progress: Called with (finished, planned) pairs after each file.

    Returns:
        The folder.

    Raises:
        UnknownVariable: A factor does not exist.
        UnknownOption: A factor has no space A, or a number is none.
        UnreadableFile: The folder holds something else.
        MissingExtra: pyarrow or Pillow is not installed.

    Source:
        Ahuja et al., *Weakly supervised representation learning with sparse perturbations*, NeurIPS
        2022; Brehmer et al., *Weakly supervised causal representation learning*, NeurIPS 2022.
    """
    names = tuple(dict.fromkeys((factors,) if isinstance(factors, str) else factors))
    free = [name for name in world.model if world.model.declared(name).space("A") is not None]
    for name in names:
        if world.model.declared(name).space("A") is None:
            raise UnknownOption("factor", name, free)
    if not names:
        raise UnknownOption("factors", "none", free)
    many = whole_number("targets", targets, least=1)
    if many > len(names):
        raise UnknownOption("targets", targets, (f"1 to {len(names)}, the number of factors",))
    height, width = (whole_number("size", side, least=1) for side in size)
    chosen = tuple(cameras)
    maker = _Maker(
        world, names, chosen, (height, width), many, whole_number("steps", steps, least=0), seed
    )
    count, each = whole_number("n", n, least=1), whole_number("shard", shard, least=1)
    load("pyarrow.parquet", "pyarrow", "data")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    about = {
        "format": FORMAT,
        "task": world.task.name,
        "backend": world.backend.name,
        "factors": list(names),
        "cameras": list(chosen),
        "size": [height, width],
        "targets": many,
        "steps": steps,
        "seed": seed,
        "n": count,
        "shard": each,
        "versions": versions(world.engine),
    }
    head = folder / HEAD
    if head.exists():
        if json.loads(head.read_text()) != about:
            advice = "give the same arguments and versions, or another folder"
            raise UnreadableFile(str(head), "it is of another call", advice)
    elif any(folder.iterdir()):
        raise UnreadableFile(str(folder), "it is not empty", "give a new folder")
    write_durably(head, (json.dumps(about, indent=1) + "\n").encode())
    starts = range(0, count, each)
    files = {
        start: folder / f"triplets-{place:05d}-of-{len(starts):05d}.parquet"
        for place, start in enumerate(starts)
    }
    missing = [range(s, min(s + each, count)) for s in starts if not files[s].exists()]
    done = count - sum(map(len, missing))
    with opened(engine, 1 if workers is None and engine is None else workers) as executor:
        executor.check("world of pictures", world)
        for place, data in executor.run(maker, missing):
            write_durably(files[missing[place].start], data)
            done += len(missing[place])
            if progress is not None:
                progress(done, count)
    return folder


@final
@dataclass(frozen=True)
class _Maker:
    """Makes files of pairs; called in each worker, it gives what does so."""

    world: Simulation
    factors: tuple[str, ...]
    cameras: tuple[str | None, ...]
    size: tuple[int, int]
    targets: int
    steps: int
    seed: int

    def __call__(self) -> Any:
        """Give the function from numbers of pairs to a file."""
        build, arguments, *_ = self.world.__reduce__()
        twin: Any = build(*arguments) if callable(build) else self.world
        return lambda numbers: self._file(twin, numbers)

    def _file(self, world: Any, numbers: range) -> bytes:
        arrow = load("pyarrow", "pyarrow", "data")
        parquet = load("pyarrow.parquet", "pyarrow", "data")
        rows = [self._pair(world, number) for number in numbers]
        image = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
        columns, features = {"pair": arrow.array(list(numbers))}, dict[str, Any]()
        for name in rows[0]:
            values = [row[name] for row in rows]
            if name.startswith("image"):
                cells = [{"bytes": value, "path": None} for value in values]
                columns[name], features[name] = arrow.array(cells, image), {"_type": "Image"}
            else:
                columns[name] = arrow.array(values)
        table = arrow.table(columns)
        about = json.dumps({"info": {"features": {**_features(table), **features}}})
        table = table.replace_schema_metadata({"huggingface": about})
        sink = io.BytesIO()
        parquet.write_table(table, sink, compression="none")  # pictures are compressed already
        return sink.getvalue()

    def _pair(self, world: Any, number: int) -> dict[str, Any]:
        order = Noise(self.seed).uniforms("targets of pairs", n=len(self.factors), episode=number)
        targets = [self.factors[i] for i in sorted(np.argsort(order[0])[: self.targets].tolist())]
        drawn = {name: Draw("A") for name in self.factors}
        again = {name: Draw("A") for name in targets}
        row: dict[str, Any] = {"targets": targets}
        world.reset(seed=self.seed, episode=number, do=drawn)
        if self.steps:
            self._look(world, "", row)
            world.reset(seed=self.seed, episode=number, do=drawn)
            world.do(again)
            self._look(world, "_counterfactual", row)
        else:
            self._look(world, "", row)
            world.do(again)
            self._look(world, "_counterfactual", row)
        return row

    def _look(self, world: Any, which: str, row: dict[str, Any]) -> None:
        """Take the pictures, and write down the factors at the beginning."""
        now = world.evaluate(self.factors)
        for name in self.factors:
            row[f"z{which}.{name}"] = np.ravel(now[name]).astype(float).tolist()
        for _ in range(self.steps):
            world.step(world.task.idle(world))
        scene = world.scene()
        own: dict[str | None, Any] = {camera.name: camera for camera in world.cameras()}
        for camera in self.cameras:
            label = f"image{which}" + (f".{camera}" if camera and len(self.cameras) > 1 else "")
            where = own.get(camera, camera)
            row[label] = _png(picture(scene, where, self.size, "software"))  # alike everywhere


def _features(table: Any) -> dict[str, Any]:
    """Describe columns without pictures, as Hugging Face ``datasets`` does."""
    found: dict[str, Any] = {}
    for field in table.schema:
        kind = str(field.type)
        if kind.startswith("list"):
            part = "string" if "string" in kind else "float64"
            found[field.name] = {"_type": "List", "feature": {"dtype": part, "_type": "Value"}}
        elif kind == "int64":
            found[field.name] = {"dtype": "int64", "_type": "Value"}
    return found


def _png(rgb: Any) -> bytes:
    from PIL import Image

    made = io.BytesIO()
    Image.fromarray(rgb).save(made, "png", compress_level=1)
    return made.getvalue()
