"""A custom curriculum, from easy to hard: written to a file, tried out, and trained under.

The training needs the extra ``train``. Run it with ``python examples/own_curriculum.py [STEPS
[FOLDER [TRIALS]]]``; a million steps are a whole training.
"""

import importlib.util
import sys
import tempfile
from pathlib import Path

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments
from scm_world.curricula import A, Curriculum, CurriculumEnv, during, resample, stages, together

NEAR = resample("goal_block.cylindrical_position", "A")
HEAVY = together(NEAR, resample("tool_block.mass", "A"))
SLIPPERY = together(HEAVY, resample("floor_friction", "A"))
CURRICULUM = together(
    stages(NEAR, HEAVY, SLIPPERY, up=0.8, down=0.2, window=4),  # by the last four successes
    during(range(0, 10**6, 10), resample("block.size", "A")),  # and sizes once in a while
)
SPACE = A - "gravity"  # nothing at a reset may leave A, or touch gravity


def main(steps: str = "20480", out: str = "", trials: str = "20") -> None:
    """Save it, watch it go from stage to stage, and train under it."""
    folder = Path(out or tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "curriculum.json"
    file.write_text(CURRICULUM.to_json())
    print(f"written to {file}, without loss: {Curriculum.load(file) == CURRICULUM}")

    env = CurriculumEnv(gymnasium.make("scm_world/Pushing-v0", max_episode_length=3), CURRICULUM)
    for episode in range(10):
        env.reset(seed=0 if episode == 0 else None, options={"space": SPACE})
        env.unwrapped.do(env.unwrapped.world.task.solution(env.unwrapped.world.values()))
        for _ in range(3):
            _, _, _, _, info = env.step(np.zeros(9, np.float32))
        names = env.unwrapped.interventions[0][1]
        print(f"episode {episode}: drew {', '.join(names)}; success {info['is_success']}")

    if importlib.util.find_spec("stable_baselines3") is None:
        print("no training: pip install 'scm-world[train]'")
        return
    from scm_world.training.loop import train
    from scm_world.training.recipe import recipe

    few = {"episodes": int(trials)}
    made = recipe("pushing", curriculum=str(file), steps=int(steps), trials=few)
    trained = train(made, out=folder / "run", tell=print)
    print(f"trained for {trained.steps} steps: {trained.best}, score {trained.score}")


if __name__ == "__main__":
    main(*sys.argv[1:])
