"""CausalCircuit on our robot: an arm, three lights, and pictures before and after interventions."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np
from scipy import special

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.backends.renderer import picture, png
from scm_world.discovery.data.triplets import write_files
from scm_world.graph import SCM
from scm_world.models.camera import Camera
from scm_world.output.remote import Location, located
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.tasks.trifinger.general import General
from scm_world.tasks.trifinger.kinematics import forward, inverse
from scm_world.variables import Box, Derived, Draw, Exogenous, Noise
from scm_world.work.executors import Executor
from scm_world.world import Simulation

LATENTS = ("red", "green", "blue", "arm")
"""In the order of ``original_latents``."""
PLACES = {"red": 0.5, "green": 0.15, "blue": 0.85}
"""Where the buttons are, in units of the arm's way."""
TRAIN_FILES = 10

SHARPNESS = 5.0  # of the Beta distribution of a light, the sum of its two parameters
REACH = 0.2  # of a button, in units of the arm's way
RADIUS, HEIGHT = 0.11, 0.09  # [m] of the arc of the fingertip around the middle of the floor
ARC = np.radians([35.0, 135.0])  # from where to where it goes
EDGE = 0.05  # [m] of a block
OFF = 0.12  # the brightness of a light that is off
CAMERA = Camera("circuit", (0.01, 0.42, 0.34), (0.01, 0.075, 0.03), field_of_view=34.0)


def _parameters(cause: Floats) -> tuple[Floats, Floats]:
    mean = 0.2 + 0.6 * np.clip(cause, 0.0, 1.0)
    return SHARPNESS * mean, SHARPNESS * (1.0 - mean)


def _light(*causes: Floats, noise: Floats) -> Floats:
    """Draw from a Beta distribution, the mean of which rises with the sum of the causes."""
    return np.asarray(special.betaincinv(*_parameters(np.sum(causes, axis=0)), noise))


def _noise(light: Floats, *causes: Floats) -> Floats:
    """Invert ``_light``."""
    return np.asarray(special.betainc(*_parameters(np.sum(causes, axis=0)), light))


def _button(place: float) -> Callable[[Floats], Floats]:
    return lambda arm: np.clip(1.0 - np.abs(arm - place) / REACH, 0.0, 1.0)


def circuit_model() -> SCM:
    """Return the causal model: the arm presses buttons, which make lights bright.

    The light of the red button depends on the other two lights, too. Variables are ``arm``,
    ``red``, ``green`` and ``blue``, in [0, 1], and ``pressed_red``, ``pressed_green`` and
    ``pressed_blue``, which follow from ``arm``.

    Example:
        >>> sorted(circuit_model().parents("red"))
        ['blue', 'green', 'pressed_red']
    """
    unit = Box(0.0, 1.0)
    variables: list[Any] = [Exogenous(name="arm", distribution=unit, a=unit)]
    for name, place in PLACES.items():
        pressed = f"pressed_{name}"
        causes = (pressed, "green", "blue") if name == "red" else (pressed,)
        variables += [
            Derived(name=pressed, parents=("arm",), mechanism=_button(place)),
            Derived(
                name=name,
                parents=causes,
                mechanism=_light,
                noise=unit,
                inverse_noise=_noise,
                a=unit,
            ),
        ]
    return SCM(variables)


def causal_circuit(
    out: Location | str,
    *,
    train: int = 100_000,
    val: int = 10_000,
    test: int = 10_000,
    size: tuple[int, int] = (64, 64),
    seed: int = 0,
    workers: int | None = None,
    engine: Executor | str | None = None,
    progress: Progress | None = None,
) -> Location:
    """Write pairs of pictures in the layout of CausalCircuit, with our TriFinger.

    In each pair nothing, or one of the four latents, is drawn anew, by lot; noise stays. Files are
    ``train-0.npz`` to ``train-9.npz``, ``val.npz`` and ``test.npz``. N is the number of pairs:

    - ``imgs``, (N, 2) bytes: PNG files, before and after;
    - ``original_latents``, (N, 2, 4): red, green and blue light, and the arm, in [0, 1];
    - ``epsilon``, (N, 2, 4): their noise; after, that which explains what was set;
    - ``pressed``, (N, 2, 3): how far the red, green and blue buttons are pressed, in [0, 1];
    - ``intervention_labels``, (N,): 0 for none, i for the latent i, counted from 1;
    - ``intervention_masks``, (N, 4): whether a latent was set.

    What differs from the published data: here a light is a colored block, and the tip hovers
    over it; pictures are PNG of our software renderer. The graph is the published one; the numbers
    in its functions are ours. An interrupted call resumes when it is repeated.

    Args:
        out: A folder, or a URL: new, empty, or one of the same call.
        train: How many pairs are for training.
        val: How many for validation.
        test: How many for testing.
        size: Height and width of a picture [pixels]; the published ones have 512.
        seed: Of the noise.
        workers: Processes; None is one. The files do not depend on it.
        engine: See ``engine_of``.
        progress: Called with (finished, planned) pairs after each file.

    Returns:
        The folder.

    Raises:
        UnknownOption: A number is too small; at least 10 pairs are for training.
        UnreadableFile: The folder holds something else.

    Source:
        Brehmer et al., *Weakly supervised causal representation learning*, NeurIPS 2022, and the
        description of the dataset CausalCircuit.
    """
    counts = {
        "train": whole_number("train", train, least=TRAIN_FILES),
        "val": whole_number("val", val, least=1),
        "test": whole_number("test", test, least=1),
    }
    height, width = (whole_number("size", side, least=1) for side in size)
    files = dict[str, range]()
    first = 0
    for split, n in counts.items():
        parts = TRAIN_FILES if split == "train" else 1
        ends = [first + n * (i + 1) // parts for i in range(parts)]
        for i, (start, stop) in enumerate(zip([first, *ends], ends, strict=False)):
            files[f"{split}-{i}.npz" if parts > 1 else f"{split}.npz"] = range(start, stop)
        first += n
    maker = _Circuit((height, width), whole_number("seed", seed, least=0))
    about = {"circuit": counts, "size": [height, width], "seed": seed, "versions": versions()}
    return write_files(located(out), files, maker, about, workers, engine, progress)


@final
@dataclass(frozen=True)
class _Circuit:
    """Makes files of pairs; called in each worker, it gives what does so."""

    size: tuple[int, int]
    seed: int
    rest: ClassVar[Floats] = np.tile([-1.57, -0.1, -2.7], 3)  # [rad] the fingers are up

    def __call__(self) -> Callable[[range], bytes]:
        """Give the function from numbers of pairs to a file."""
        world = Simulation(General(nums_objects=len(PLACES)))
        world.reset(seed=self.seed)
        angles = {name: ARC[0] + place * (ARC[1] - ARC[0]) for name, place in PLACES.items()}
        blocks = {
            f"tool_{i}.cartesian_position": [
                RADIUS * np.cos(angle), RADIUS * np.sin(angle), EDGE / 2.0
            ]
            for i, angle in enumerate(angles.values())
        }  # fmt: skip
        gray = {f"robot_finger_60_link_{i}.color": (0.5, 0.5, 0.5) for i in range(4)}
        world.reset(seed=self.seed, do={"tool_block_size": EDGE, **blocks, **gray})
        return lambda numbers: self._file(world, numbers)

    def _file(self, world: Simulation, numbers: range) -> bytes:
        model, n, first = circuit_model(), len(numbers), numbers.start
        plain = model.draw(n, seed=self.seed, first=first)
        each = [plain] + [
            model.do({name: Draw("A")}).draw(n, seed=self.seed, first=first) for name in LATENTS
        ]
        draws = Noise(self.seed).uniforms("targets of pairs", n=1, episode=first, count=n)
        labels = np.minimum((len(each) * np.ravel(draws)).astype(np.int64), len(LATENTS))
        after = {
            name: np.stack([values[name] for values in each])[labels, np.arange(n)]
            for name in model
        }
        pairs = [plain, after]
        lights = list(PLACES)
        pressed = [np.stack([one[f"pressed_{name}"] for name in lights], axis=1) for one in pairs]
        noises = []
        for one in pairs:
            found = {
                name: _noise(one[name], *(one[p] for p in model.parents(name))) for name in lights
            }
            noises.append(np.stack([found.get(name, one[name]) for name in LATENTS], axis=1))
        sink = io.BytesIO()
        np.savez(
            sink,
            imgs=np.array([[self._picture(world, one, i) for one in pairs] for i in range(n)]),
            original_latents=np.stack(
                [np.stack([one[name] for name in LATENTS], axis=1) for one in pairs], axis=1
            ),
            epsilon=np.stack(noises, axis=1),
            pressed=np.stack(pressed, axis=1),
            intervention_labels=labels,
            intervention_masks=labels[:, None] == 1 + np.arange(len(LATENTS)),
        )
        return sink.getvalue()

    def _picture(self, world: Simulation, values: dict[str, Any], i: int) -> bytes:
        angle = ARC[0] + float(values["arm"][i]) * (ARC[1] - ARC[0])
        joints = np.array(self.rest)
        height = float(world["robot_height"])
        tips = forward(joints, height)
        tips[:3] = RADIUS * np.cos(angle), RADIUS * np.sin(angle), HEIGHT
        joints[:3] = inverse(tips, height, joints).joint_positions[:3]
        colors = {}
        for place, name in enumerate(PLACES):
            color = np.full(3, OFF / 2.0)
            color[place] = OFF + (1.0 - OFF) * float(values[name][i])
            colors[f"tool_{place}.color"] = color
        world.do({"joint_positions": joints, **colors})
        return png(picture(world.scene().with_(goals=()), CAMERA, self.size, "software"))
