"""Pictures in files: beside the rows of a table, and in pairs around an intervention."""

from __future__ import annotations

import copy
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, final

import numpy as np

from scm_world._arguments import MANY, typed, whole_number
from scm_world._fingerprint import fingerprint
from scm_world.backends.renderer import png, render, scene_camera
from scm_world.errors import UnknownOption
from scm_world.models.camera import Camera
from scm_world.models.scene import Scene
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import Plan
from scm_world.queries.progress import Progress
from scm_world.runs.files import Location, located
from scm_world.runs.pool import Pool, pool_of
from scm_world.runs.study import Study
from scm_world.variables import Draw, Noise
from scm_world.world import Simulation

Row = dict[str, Any]
"""Numbers, lists of numbers or of words, and pictures as the bytes of a PNG, by column."""


@typed
@final
@typed
@dataclass(frozen=True)
class Pictures:
    """Which pictures are taken.

    Attributes:
        cameras: Names of cameras, of the robot or of the model; None is the usual one.
        size: Height and width [pixels].
        goals: Whether to also take pictures of the goals alone, without moving bodies.

    Raises:
        UnknownOption: A size is not a positive number.
    """

    cameras: tuple[str | None, ...] = (None,)
    size: tuple[int, int] = (64, 64)
    goals: bool = False

    def __post_init__(self) -> None:
        height, width = (whole_number("size", side, least=1) for side in self.size)
        cameras = (self.cameras,) if isinstance(self.cameras, str) else tuple(self.cameras)
        object.__setattr__(self, "cameras", cameras or (None,))
        object.__setattr__(self, "size", (height, width))

    def take(self, scene: Scene, placed: Iterable[Camera], label: str = "image") -> Row:
        """Take the pictures of a scene with the software renderer, alike on all machines.

        Cameras that are ``placed`` are variables. ``label`` is the name of the column; with several
        cameras ``.CAMERA`` follows.
        """
        own: dict[str | None, Camera] = {camera.name: camera for camera in placed}
        found: Row = {}
        for goals_only in (False, True) if self.goals else (False,):
            name = f"goal_{label}" if goals_only else label
            for camera in self.cameras:
                from_ = scene_camera(scene, own.get(camera, camera), self.size)
                column = f"{name}.{camera}" if len(self.cameras) > 1 else name
                found[column] = png(render(scene, from_, goals_only=goals_only).rgb)
        return found


def encoded_pictures(rows: Sequence[Row]) -> bytes:
    """Return rows of the same columns as Parquet, in its metadata the features of ``datasets``."""
    import pyarrow as arrow
    from pyarrow import parquet

    image = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
    columns, features = dict[str, Any](), dict[str, Any]()
    for name, first in rows[0].items() if rows else ():
        values = [row[name] for row in rows]
        if isinstance(first, bytes):
            cells = [{"bytes": value, "path": None} for value in values]
            columns[name], features[name] = arrow.array(cells, image), {"_type": "Image"}
            continue
        several = isinstance(first, list)
        kind = next((type(x) for value in values for x in (value if several else (value,))), str)
        here, there = {int: ("int64",) * 2, float: ("double", "float64")}.get(kind, ("string",) * 2)
        plain = {"dtype": there, "_type": "Value"}
        features[name] = {"_type": "List", "feature": plain} if several else plain
        cell = arrow.type_for_alias(here)
        columns[name] = arrow.array(values, arrow.list_(cell) if several else cell)
    about = {"huggingface": json.dumps({"info": {"features": features}})}
    sink = io.BytesIO()
    table = arrow.table(columns).replace_schema_metadata(about)
    parquet.write_table(table, sink, compression="none")  # pictures are compressed already
    return sink.getvalue()


# --- pairs ----------------------------------------------------------------------------------------


@typed
def triplets(
    world: Simulation,
    factors: Iterable[str],
    n: int,
    out: Location | str,
    *,
    cameras: Iterable[str | None] = (None,),
    size: tuple[int, int] = (64, 64),
    targets: int = 1,
    steps: int = 0,
    seed: int = 0,
    shard: int = 1000,
    workers: int | None = None,
    engine: Pool | str | None = None,
    progress: Progress | None = None,
) -> Location:
    """Write pictures x of a scene and x̃ of its counterfactual, with factors z and z̃ and targets.

    In each pair all factors are drawn from their space A, but those that are given a mechanism with
    ``world.given``, which follow it. Then some factors are drawn again, and everything else stays:
    the noise, and over ``steps`` control steps the idle action, too. So z̃ differs from z in the
    targets, and in the factors that follow from them.

    An interrupted call resumes when it is repeated, and the files are then the same, byte for byte.
    They have one row per pair, and ``datasets.load_dataset("parquet", …)`` of Hugging Face reads
    them; pictures are PNG.

    Args:
        world: That is drawn; it is not changed.
        factors: Names of variables with a space A.
        n: Number of pairs.
        out: A folder, or a URL: new, empty, or one of the same call.
        cameras: Names of cameras, of the robot or of the model; None is the usual one. Each has two
            columns.
        size: Height and width of a picture [pixels].
        targets: How many factors are drawn again in each pair, chosen at random.
        steps: Control steps after which the pictures are taken.
        seed: Seed of the noise.
        shard: How many pairs are in a file.
        workers: Processes; None is one. The files do not depend on it.
        engine: See ``collect``.
        progress: Called with (finished, planned) pairs after each file.

    Returns:
        The folder.

    Raises:
        UnknownVariable: A factor does not exist.
        UnknownOption: A factor has no space A, or a number is wrong.
        UnreadableFile: The folder holds something else.

    Source:
        Ahuja et al., *Weakly supervised representation learning with sparse perturbations*, NeurIPS
        2022; Brehmer et al., *Weakly supervised causal representation learning*, NeurIPS 2022.
    """
    names = tuple(dict.fromkeys((factors,) if isinstance(factors, str) else factors))
    free = [name for name in world.model if world.model.declared(name).space("A") is not None]
    allowed = (f"variables with a space A: {', '.join(free) or 'this world has no such variable'}",)
    for name in names:
        if world.model.declared(name).space("A") is None:
            raise UnknownOption("factor", name, allowed)
    if not names:
        raise UnknownOption("factors", names, allowed)
    many = whole_number("targets", targets, least=1)
    if many > len(names):
        raise UnknownOption("targets", targets, (f"1 to {len(names)}, the number of factors",))
    taken = Pictures(tuple(cameras), size)
    count, each = whole_number("n", n, least=1), whole_number("shard", shard, least=1)
    after = whole_number("steps", steps, least=0, most=MANY)
    pairs = _Pairs(copy.deepcopy(world), names, taken, many, after, seed)
    pairs(range(1))  # a faulty request is refused before any file is written
    about = {
        "task": world.task.name,
        "backend": world.backend.name,
        "fingerprint": fingerprint(world),
        "given": getattr(world, "plan", Plan()).as_dict()["do"],
        "factors": list(names),
        **asdict(taken),
        "targets": many,
        "steps": steps,
        "seed": seed,
        "n": count,
        "shard": each,
        "versions": versions(world.engine),
    }
    starts = range(0, count, each)
    files = {
        f"triplets-{i:05d}-of-{len(starts):05d}.parquet": range(start, min(start + each, count))
        for i, start in enumerate(starts)
    }
    done = 0
    with Study(out, "triplets", about) as study, pool_of(engine, workers) as pool:
        for name, _ in study.map(files, pairs, read=bytes, write=bytes, pool=pool):
            done += len(files[name])
            if progress is not None:
                progress(done, count)
    return located(out)


@final
@dataclass(frozen=True)
class _Pairs:
    """Makes files of pairs, in a world of its own."""

    world: Simulation
    factors: tuple[str, ...]
    taken: Pictures
    targets: int
    steps: int
    seed: int

    def __call__(self, numbers: range) -> bytes:
        """Return the file of some pairs."""
        return encoded_pictures([self._pair(number) for number in numbers])

    def _pair(self, number: int) -> Row:
        world = self.world
        order = Noise(self.seed).uniforms("targets of pairs", n=len(self.factors), episode=number)
        targets = [self.factors[i] for i in sorted(np.argsort(order[0])[: self.targets].tolist())]
        follow = getattr(world, "plan", ())
        drawn = {name: Draw("A") for name in self.factors if name not in follow}
        row: Row = {"pair": number, "targets": targets}
        world.reset(seed=self.seed, episode=number, do=drawn)
        self._look("", row)
        if self.steps:
            world.reset(seed=self.seed, episode=number, do=drawn)
        world.do({name: Draw("A") for name in targets})
        self._look("_counterfactual", row)
        return row

    def _look(self, which: str, row: Row) -> None:
        """Add the factors at the beginning, and the pictures."""
        world = self.world
        now = world.evaluate(self.factors)
        for name in self.factors:
            row[f"z{which}.{name}"] = np.ravel(now[name]).astype(float).tolist()
        for _ in range(self.steps):
            world.step(world.task.idle(world))
        placed = world.cameras() if any(self.taken.cameras) else ()
        row.update(self.taken.take(world.scene(), placed, f"image{which}"))
