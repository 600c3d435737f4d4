"""Pairs of pictures before and after an intervention, for learners of causal representations."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any, final

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._fingerprint import changes, fingerprint
from scm_world.discovery.data.pictures import ENDINGS, Pictures, Row
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.output.durable import made, write_durably
from scm_world.output.remote import Location, located
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.variables import Draw, Noise
from scm_world.work.executors import Executor, opened
from scm_world.world import Simulation

FORMAT = "scm_world/triplets/2"
HEAD = "triplets.json"


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
    format: str = "parquet",  # noqa: A002 # as other libraries call it
    workers: int | None = None,
    engine: Executor | str | None = None,
    progress: Progress | None = None,
) -> Location:
    """Write pictures x of a scene and x̃ of its counterfactual, with factors z and z̃ and targets.

    In each pair all factors are drawn from their space A, but those that are given a mechanism with
    ``world.given``, which follow it. Then some factors are drawn again, and everything else stays:
    the noise, and over ``steps`` control steps the idle action, too. So z̃ differs from z in the
    targets, and in the factors that follow from them.

    An interrupted call resumes when it is repeated, and the files are then the same, byte for byte.
    They have one row per pair; pictures are PNG.

    Args:
        world: That is drawn; it is not changed.
        factors: Names of variables with a space A.
        n: How many pairs.
        out: A folder, or a URL: new, empty, or one of the same call.
        cameras: Names of cameras, of the robot or of the model; None is the usual one. Each has two
            columns.
        size: Height and width of a picture [pixels].
        targets: How many factors are drawn again in each pair, by lot.
        steps: Control steps after which the pictures are taken.
        seed: Of the noise.
        shard: How many pairs are in a file.
        format: Of the files: ``"parquet"``, as ``datasets.load_dataset("parquet", …)`` of Hugging
            Face reads it, or ``"webdataset"``, tar files.
        workers: Processes; None is one. The files do not depend on it.
        engine: See ``engine_of``.
        progress: Called with (finished, planned) pairs after each file.

    Returns:
        The folder.

    Raises:
        UnknownVariable: A factor does not exist.
        UnknownOption: A factor has no space A, or a number is none.
        UnreadableFile: The folder holds something else.

    Source:
        Ahuja et al., *Weakly supervised representation learning with sparse perturbations*, NeurIPS
        2022; Brehmer et al., *Weakly supervised causal representation learning*, NeurIPS 2022.
    """
    names = tuple(dict.fromkeys((factors,) if isinstance(factors, str) else factors))
    free = [name for name in world.model if world.model.declared(name).space("A") is not None]
    allowed = (f"variables with a space A: {', '.join(free) or 'there are none'}",)
    for name in names:
        if world.model.declared(name).space("A") is None:
            raise UnknownOption("factor", name, allowed)
    if not names:
        raise UnknownOption("factors", names, allowed)
    many = whole_number("targets", targets, least=1)
    if many > len(names):
        raise UnknownOption("targets", targets, (f"1 to {len(names)}, the number of factors",))
    taken = Pictures(tuple(cameras), size, format=format)
    maker = _Pairs(world, names, taken, many, whole_number("steps", steps, least=0), seed)
    count, each = whole_number("n", n, least=1), whole_number("shard", shard, least=1)
    about = {
        "task": world.task.name,
        "backend": world.backend.name,
        "fingerprint": fingerprint(world),
        "given": maker.given,
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
        f"triplets-{place:05d}-of-{len(starts):05d}.{ENDINGS[format]}": range(
            start, min(start + each, count)
        )
        for place, start in enumerate(starts)
    }
    folder, said = located(out), {"format": FORMAT, **json.loads(json.dumps(about))}
    if (folder / HEAD).exists():
        other = changes(json.loads((folder / HEAD).read_text()), said)
        if other:
            advice = "give the same system, arguments and versions, or another folder"
            reason = f"it is of another call: {', '.join(other)} differ"
            raise UnreadableFile(str(folder / HEAD), reason, advice)
    elif folder.exists() and any(True for _ in folder.iterdir()):
        raise UnreadableFile(str(folder), "it is not empty", "give a new folder")
    else:
        maker()(range(1))  # what cannot be done is refused before there is anything
        made(folder)
        write_durably(folder / HEAD, (json.dumps(said, indent=1) + "\n").encode())
    missing = [name for name in files if not (folder / name).exists()]
    done = count - sum(len(files[name]) for name in missing)
    with opened(engine, 1 if workers is None and engine is None else workers) as executor:
        executor.check("world of pictures", world)
        for place, data in executor.run(maker, [files[name] for name in missing]):
            write_durably(folder / missing[place], data)
            done += len(files[missing[place]])
            if progress is not None:
                progress(done, count)
    return folder


@final
@dataclass(frozen=True)
class _Pairs:
    """Makes files of pairs; called in each worker, it gives what does so."""

    world: Simulation
    factors: tuple[str, ...]
    taken: Pictures
    targets: int
    steps: int
    seed: int

    def __call__(self) -> Callable[[range], bytes]:
        """Give the function from numbers of pairs to a file."""
        twin = copy.deepcopy(self.world)

        def file(numbers: range) -> bytes:
            rows = [self._pair(twin, number) for number in numbers]
            return self.taken.encoded(rows, [f"{number:08d}" for number in numbers])

        return file

    @property
    def given(self) -> Any:
        """What the world was given, as plain data."""
        plan = getattr(self.world, "plan", None)
        return {} if plan is None else plan.as_dict()["do"]

    def _pair(self, world: Any, number: int) -> Row:
        order = Noise(self.seed).uniforms("targets of pairs", n=len(self.factors), episode=number)
        targets = [self.factors[i] for i in sorted(np.argsort(order[0])[: self.targets].tolist())]
        follow = getattr(world, "plan", ())
        drawn = {name: Draw("A") for name in self.factors if name not in follow}
        row: Row = {"pair": number, "targets": targets}
        world.reset(seed=self.seed, episode=number, do=drawn)
        self._look(world, "", row)
        if self.steps:
            world.reset(seed=self.seed, episode=number, do=drawn)
        world.do({name: Draw("A") for name in targets})
        self._look(world, "_counterfactual", row)
        return row

    def _look(self, world: Any, which: str, row: Row) -> None:
        """Take the pictures, and write down the factors at the beginning."""
        now = world.evaluate(self.factors)
        for name in self.factors:
            row[f"z{which}.{name}"] = np.ravel(now[name]).astype(float).tolist()
        for _ in range(self.steps):
            world.step(world.task.idle(world))
        placed = world.cameras() if any(self.taken.cameras) else ()
        row.update(self.taken.take(world.scene(), placed, f"image{which}"))
