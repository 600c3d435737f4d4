"""Learn a representation from pairs of pictures with known targets, and score it.

Run it with ``python examples/representations.py [PAIRS] [EPOCHS] [SEEDS]``; it needs torch,
pyarrow, Pillow and scikit-learn.
"""

import io
import sys
import tempfile

import numpy as np
import pyarrow.parquet as parquet
import torch
from PIL import Image
from torch import nn

from scm_world import ModelTask, World
from scm_world.discovery.data import triplets
from scm_world.discovery.representations import dci, mcc, r2
from scm_world.variables import Box

MODEL = """<mujoco><worldbody><camera name="front" pos="0 -2.5 .8" xyaxes="1 0 0 0 0 1"/>
  <geom type="plane" size="3 3 .1" rgba=".8 .8 .8 1"/><body pos="0 0 1.1">
  <joint name="slide" type="slide" axis="1 0 0"/><geom type="box" size=".18 .1 .09"
  rgba=".2 .2 .8 1"/><body><joint name="shoulder" axis="0 1 0"/><geom type="capsule"
  fromto="0 0 0 0 0 -.45" size=".09" rgba=".8 .2 .2 1"/><body pos="0 0 -.45"><joint name="elbow"
  axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".09" rgba=".2 .7 .2 1"/>
  </body></body></body></worldbody></mujoco>"""
WAYS = {"slide.position": 0.4, "shoulder.position": 0.7, "elbow.position": 0.9}  # [m], [rad]
FACTORS = tuple(WAYS)


class Arm(ModelTask):
    """A cart, and two links that hang from it."""

    model, seconds, control_dt = MODEL, 1.0, 0.05
    spaces = {name: {"a": Box(-way, way)} for name, way in WAYS.items()}  # noqa: RUF012


def pairs_of_pictures(n: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, np.ndarray]:
    """Return x and x̃, shape (n, 3, 32, 32), the targets and the factors, shape (n, 3)."""
    with tempfile.TemporaryDirectory() as folder, World(Arm()) as world:
        place = triplets(world, FACTORS, n, folder, cameras=["front"], size=(32, 32), seed=1)
        rows = parquet.read_table(sorted(place.glob("*.parquet"))).to_pydict()
    x, other = (
        np.stack([np.asarray(Image.open(io.BytesIO(cell["bytes"]))) for cell in rows[name]])
        for name in ("image", "image_counterfactual")
    )
    both = torch.tensor(np.stack([x, other]), dtype=torch.float32).permute(0, 1, 4, 2, 3)
    both = (both - both[0].mean(dim=0)) / both[0].std()
    targets = torch.tensor([[name in row for name in FACTORS] for row in rows["targets"]])
    return both[0], both[1], targets, np.hstack([rows[f"z.{name}"] for name in FACTORS])


def encoder(seed: int) -> nn.Module:
    """Return a network from pictures to one number for each factor."""
    torch.manual_seed(seed)
    return nn.Sequential(
        *(nn.Conv2d(3, 16, 4, 2, 1), nn.ReLU(), nn.Conv2d(16, 32, 4, 2, 1), nn.ReLU()),
        *(nn.Conv2d(32, 32, 4, 2, 1), nn.ReLU(), nn.Flatten()),
        *(nn.Linear(512, 128), nn.ReLU(), nn.Linear(128, len(FACTORS))),
    )


def train(net: nn.Module, x: torch.Tensor, other: torch.Tensor, targets: torch.Tensor, n: int):
    """Make a code stay where its factor is not a target, relative to how much it varies."""
    steps = n * max(len(x) // 64, 1)
    optimizer = torch.optim.Adam(net.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, max(steps, 1))
    for _ in range(steps):
        rows = torch.randperm(len(x))[:64]
        codes = net(torch.cat([x[rows], other[rows]]))
        moved = codes[len(rows) :] - codes[: len(rows)]
        loss = ((moved**2 * ~targets[rows]).mean(dim=0) / codes.var(dim=0)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


def main(pairs: str = "5000", epochs: str = "15", seeds: str = "3") -> None:
    """Make pairs, learn from four fifths of them, and print the scores of the others."""
    x, other, targets, z = pairs_of_pictures(int(pairs))
    n = len(x) * 4 // 5
    pixels = x.flatten(1).numpy().astype(np.float64)
    axes = np.linalg.svd(pixels[:n:4], full_matrices=False)[2][: len(FACTORS)]
    codes = {"raw pixels": [pixels[n:]], "principal components": [pixels[n:] @ axes.T]}
    nothing = torch.zeros_like(targets)
    for name, told, how_long in (
        ("random encoder", targets, 0),
        ("without targets", nothing, int(epochs)),
        ("with targets", targets, int(epochs)),
    ):
        codes[name] = []
        for seed in range(int(seeds)):
            net = encoder(seed)
            train(net, x[:n], other[:n], told[:n], how_long)
            with torch.no_grad():
                codes[name].append(net(x[n:]).numpy())
    for name, found in codes.items():
        rows = [(mcc(c, z[n:]), r2(c, z[n:]), *dci(c, z[n:], trees=10)) for c in found]
        said = (
            f"{score} {min(column):.2f} to {max(column):.2f}"
            for score, column in zip(
                ("MCC", "R2", "D", "C", "I"), zip(*rows, strict=True), strict=True
            )
        )
        print(f"{name}: {', '.join(said)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
