"""Randomisation of Gymnasium's MuJoCo environments as users write it, and what ``check`` finds.

Each pattern is a wrapper of a few lines, as it is found in public repositories, in our own words.
``python -m benchmarks.randomisation`` writes ``randomisation.json``, from which
``python -m benchmarks.figures randomisation`` draws the picture of the page.
"""

from __future__ import annotations

import argparse
import copy
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

import scm_world as sw
from benchmarks import as_json

HERE = Path(__file__).parent
ENVIRONMENTS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5")
LOW, HIGH = 0.5, 1.5
MASS = {"body_mass": sw.Scale(sw.Draw(LOW, HIGH))}
TORSO = {"body_mass[torso]": sw.Scale(sw.Draw(LOW, HIGH))}
FRICTION = {"geom_friction[floor, 0]": sw.Scale(sw.Draw(LOW, HIGH))}


class Pattern(gymnasium.Wrapper):
    """A wrapper that keeps the masses of the file."""

    ranges = MASS

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.model = self.unwrapped.model
        self.mass, self.inertia = self.model.body_mass.copy(), self.model.body_inertia.copy()
        self.friction = self.model.geom_friction.copy()

    def factors(self) -> Any:
        """Draw a factor for each body, by the global generator, as most users do."""
        return np.random.uniform(LOW, HIGH, size=self.mass.shape)  # noqa: NPY002 # as they do


class StoredBefore(Pattern):
    """Masses of the file times a draw, before the reset."""

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        self.model.body_mass[:] = self.mass * self.factors()
        return self.env.reset(**given)


class StoredAfter(Pattern):
    """The same, after the reset, whose observation is returned."""

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        found = self.env.reset(**given)
        self.model.body_mass[:] = self.mass * self.factors()
        return found


class InPlace(Pattern):
    """Present masses times a draw, after each reset."""

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        found = self.env.reset(**given)
        self.model.body_mass[:] *= self.factors()
        return found


class Forward(Pattern):
    """After the reset, with mj_forward, and an observation that is read again."""

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        _, info = self.env.reset(**given)
        self.model.body_mass[:] = self.mass * self.factors()
        mujoco.mj_forward(self.model, self.unwrapped.data)
        return self.unwrapped._get_obs(), info


class WithInertia(Pattern):
    """One factor for masses and inertias, before the reset."""

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        factor = self.factors()[0]
        self.model.body_mass[:] = self.mass * factor
        self.model.body_inertia[:] = self.inertia * factor
        return self.env.reset(**given)


class Once(Pattern):
    """The mass of the torso is written once, when the environment is made."""

    ranges = TORSO

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.model.body_mass[1] = self.mass[1] * 1.2


class SameSeed(Pattern):
    """Each environment has a generator of its own, with the default seed 42."""

    ranges = TORSO

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.rng = np.random.default_rng(42)

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        self.model.body_mass[1] = self.mass[1] * self.rng.uniform(LOW, HIGH)
        return self.env.reset(**given)


class NoSuchName(Pattern):
    """Bodies are looked up by names, and skipped if there are none."""

    ranges = TORSO

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        for name in ("trunk", "base_link"):
            body = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name)
            if body >= 0:
                self.model.body_mass[body] = self.mass[body] * self.factors()[0]
        return self.env.reset(**given)


class OnACopy(Pattern):
    """The model is copied, to be safe, and the copy is written to."""

    ranges = TORSO

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.model = copy.deepcopy(self.model)

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        self.model.body_mass[1] = self.mass[1] * self.factors()[0]
        return self.env.reset(**given)


class FloorFriction(Pattern):
    """The friction of the floor times a draw, before the reset."""

    ranges = FRICTION

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        self.model.geom_friction[0, 0] = self.friction[0, 0] * self.factors()[0]
        return self.env.reset(**given)


class Careful(Pattern):
    """Masses and inertias of the file, before the reset, and constants that follow."""

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        factors = self.factors()
        self.model.body_mass[:] = self.mass * factors
        self.model.body_inertia[:] = self.inertia * factors[:, None]
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        return self.env.reset(**given)


PATTERNS: tuple[type[Pattern], ...] = (
    *(StoredBefore, StoredAfter, InPlace, Forward, WithInertia, Once, SameSeed),
    *(NoSuchName, OnACopy, FloorFriction, Careful),
)


def measure(name: str, pattern: type[Pattern], *, worlds: int, steps: int) -> dict[str, Any]:
    """Check one pattern in one environment; return a row."""
    begun = time.perf_counter()
    envs = gymnasium.vector.SyncVectorEnv([lambda: pattern(gymnasium.make(name))] * worlds)
    np.random.seed(0)  # noqa: NPY002 # patterns draw from it
    found = sw.check(envs, pattern.ranges, steps=steps)
    envs.close()
    answers = found.ranges[0].answers
    stale, response = answers["constants"], answers["responds"]
    return {
        "environment": name,
        "pattern": pattern.__name__,
        "faults": {question: said for _, question, said in found.faults},
        "remarks": {q: answers[q].said for q in ("in range", "second reset") if answers[q].said},
        "response": [response.size, response.unit],
        "stale": [stale.size, stale.unit, stale.share],
        "seconds": round(time.perf_counter() - begun, 2),
    }


def main() -> None:
    """Measure all patterns in all environments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=25)
    given, rows = parser.parse_args(), []
    warnings.simplefilter("ignore")
    for name in ENVIRONMENTS:
        for pattern in PATTERNS:
            rows.append(measure(name, pattern, worlds=given.worlds, steps=given.steps))
            print(name, pattern.__name__, *rows[-1]["faults"], sep=", ", flush=True)
    words = {one.__name__: (one.__doc__ or "").partition("\n")[0].rstrip(".") for one in PATTERNS}
    about = {"worlds": given.worlds, "steps": given.steps, "mujoco": mujoco.__version__}
    about |= {"gymnasium": gymnasium.__version__, "patterns": words, "rows": rows}
    (HERE / "randomisation.json").write_text(as_json(about) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
