"""The layout of the dataset CausalCircuit (Brehmer et al., NeurIPS 2022) on our robot.

``python examples/causal_circuit.py FOLDER [TRAIN] [PIXELS]`` writes ``train-0.npz`` to
``train-9.npz``, ``val.npz`` and ``test.npz`` (see docs/pictures.md), but those that are there.
"""

import io
import sys
from functools import partial
from pathlib import Path

import numpy as np
from scipy import special

from scm_world import SCM, Box, Derived, Draw, Exogenous, World
from scm_world.backends.renderer import picture, png
from scm_world.models.camera import Camera
from scm_world.runs.files import write_whole
from scm_world.tasks.trifinger.general import General
from scm_world.tasks.trifinger.kinematics import forward, inverse
from scm_world.variables import Noise

LATENTS = ("red", "green", "blue", "arm")
PLACES = {"red": 0.5, "green": 0.15, "blue": 0.85}  # of the buttons on the way of the arm
SHARPNESS, REACH = 5.0, 0.2  # of the Beta distributions; of a button, on the way of the arm
RADIUS, HEIGHT, EDGE = 0.11, 0.09, 0.05  # [m] of the path of the fingertip, and of a block
START, END = np.radians([35.0, 135.0])  # of that path, around the middle of the floor
CAMERA = Camera("circuit", (0.01, 0.42, 0.34), (0.01, 0.075, 0.03), field_of_view=34.0)


def beta(causes):
    """Give the parameters of a Beta distribution whose mean rises with the sum of the causes."""
    mean = 0.2 + 0.6 * np.clip(np.sum(causes, axis=0), 0.0, 1.0)
    return SHARPNESS * mean, SHARPNESS * (1.0 - mean)


def light(*causes, noise):
    """Draw the brightness of a light."""
    return special.betaincinv(*beta(causes), noise)


def noise_of(brightness, *causes):
    """Invert ``light``."""
    return special.betainc(*beta(causes), brightness)


def circuit() -> SCM:
    """The arm presses buttons, which make lights bright; green and blue light cause red light.

    This is the graph of the paper as we read it; the published files do not state one.
    """
    unit = Box(0.0, 1.0)
    lit = {"mechanism": light, "noise": unit, "inverse_noise": noise_of, "a": unit}
    variables = [Exogenous(name="arm", distribution=unit, a=unit)]
    for name, place in PLACES.items():
        way, button = [place - REACH, place, place + REACH], f"pressed_{name}"
        press = partial(np.interp, xp=way, fp=[0.0, 1.0, 0.0])
        causes = (button, "green", "blue") if name == "red" else (button,)
        variables.append(Derived(name=button, parents=("arm",), mechanism=press))
        variables.append(Derived(name=name, parents=causes, **lit))
    return SCM(variables)


def around(place):
    """Give the point of the path at a place in [0, 1], shape (2,) [m]."""
    angle = START + place * (END - START)
    return RADIUS * np.cos(angle), RADIUS * np.sin(angle)


def shown(world: World, values, i: int, pixels: int) -> bytes:
    """Take the picture of row i: blocks are the lights, and a fingertip hovers over the path."""
    joints, height = np.tile([-1.57, -0.1, -2.7], 3), float(world["robot_height"])
    tips = forward(joints, height)
    tips[:3] = *around(values["arm"][i]), HEIGHT
    joints[:3] = inverse(tips, height, joints).joint_positions[:3]
    lit = 0.06 + np.diag([0.06 + 0.88 * values[name][i] for name in PLACES])
    world.do({"joint_positions": joints, **{f"tool_{k}.color": lit[k] for k in range(3)}})
    return png(picture(world.scene().with_(goals=()), CAMERA, (pixels, pixels)))


def pairs(world: World, first: int, n: int, pixels: int) -> dict[str, np.ndarray]:
    """Make n pairs from a number on: nothing or one latent is drawn anew, and all noise stays."""
    model, rows = circuit(), np.arange(n)
    plain = model.draw(n, seed=0, first=first)
    worlds = [plain, *(model.do({v: Draw("A")}).draw(n, seed=0, first=first) for v in LATENTS)]
    lots = Noise(0).uniforms("targets", n=1, episode=first, count=n)[:, 0]
    labels = np.floor(lots * len(worlds)).astype(int)
    both = [plain, {v: np.stack([one[v] for one in worlds])[labels, rows] for v in model}]
    found = [dict(one) for one in both]
    for noise, one in zip(found, both, strict=True):
        noise |= {v: noise_of(one[v], *map(one.get, model.parents(v))) for v in PLACES}
    columns = {
        "original_latents": [[one[v] for v in LATENTS] for one in both],
        "epsilon": [[noise[v] for v in LATENTS] for noise in found],
        "pressed": [[one[f"pressed_{v}"] for v in PLACES] for one in both],
    }
    return {
        "imgs": np.array([[shown(world, one, i, pixels) for one in both] for i in rows]),
        **{name: np.moveaxis(np.array(values), -1, 0) for name, values in columns.items()},
        "intervention_labels": labels,
        "intervention_masks": labels[:, None] == 1 + np.arange(len(LATENTS)),
    }


def main(folder: str, train: str = "1000", pixels: str = "64") -> None:
    """Write ten files for training, and two with a tenth of that for validation and testing."""
    each, places = max(int(train) // 10, 1), [around(place) for place in PLACES.values()]
    fixed = {f"tool_{k}.cartesian_position": (*at, EDGE / 2) for k, at in enumerate(places)}
    fixed |= {f"robot_finger_60_link_{k}.color": (0.5, 0.5, 0.5) for k in range(4)}
    Path(folder).mkdir(parents=True, exist_ok=True)
    with World(General(nums_objects=3)) as world:
        world.reset(seed=0, do={"tool_block_size": EDGE, **fixed})
        for k, name in enumerate([*(f"train-{k}" for k in range(10)), "val", "test"]):
            path, made = Path(folder) / f"{name}.npz", io.BytesIO()
            if not path.exists():
                np.savez(made, **pairs(world, k * each, each, int(pixels)))
                write_whole(path, made.getvalue())
            print(path, f"{(k + 1) * each} of {12 * each} pairs")


if __name__ == "__main__":
    main(*sys.argv[1:])
