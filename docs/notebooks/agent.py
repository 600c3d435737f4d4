# %% [markdown]
# # An agent, from an environment to an explanation
#
# A pole is kept upright by a motor. A small policy is trained on light poles, evaluated on light and heavy ones, and
# its failures are explained. The last cell does the same with a trained policy of the package.

# %%
import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import scm_world as sw
from scm_world.evaluation import evaluate, why
from scm_world.policies import as_agent

POLE = """
<mujoco model="pole">
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-0.3 0.3" ctrllimited="true"/></actuator>
</mujoco>
"""


def upright(angle):
    return float(np.cos(angle))


def fallen(angle):
    return abs(angle) > 0.5  # [rad]


class Balance(sw.ModelTask):
    """Keep the pole up."""

    name = "balance"
    model = POLE
    seconds = 2.0
    control_dt = 0.02
    spaces = {"pole.mass": {"a": (0.05, 0.2), "b": (0.2, 0.8)}}
    start = {"hinge.position": sw.Box(-0.2, 0.2)}
    reward = (upright, "hinge.position")
    terminated = (fallen, "hinge.position")  # an episode ends there


# %% [markdown]
# ## Make
#
# The environment draws the mass from the training space A at each reset. The policy sees angle and velocity, and never
# the mass.

# %%
form = {"normalize_observations": False, "normalize_actions": False}
form |= {"observation_mode": "custom", "observe": ["hinge.position", "hinge.velocity"]}
env = gymnasium.make(
    "scm_world/Model-v0",
    model=Balance(),
    start={"pole.mass": "A"},
    render_mode="rgb_array",
    render_size=(160, 160),
    **form,
)
print(env.observation_space.shape, env.action_space)

# %% [markdown]
# ## Train
#
# The policy is linear: two gains. The cross-entropy method draws gains, keeps the best ones, and draws again around
# them. Any library that takes Gymnasium's environments trains a larger policy in the same way.


# %%
def play(gains, seed):
    observation, _ = env.reset(seed=seed)
    total, ended = 0.0, False
    while not ended:
        observation, reward, terminated, truncated, _ = env.step([-(gains @ observation)])
        total, ended = total + reward, terminated or truncated
    return total


rng = np.random.default_rng(0)
gains, spread = np.zeros(2), np.full(2, 2.0)
for generation in range(5):
    tried = gains + spread * rng.normal(size=(12, 2))
    returns = np.array([np.mean([play(one, seed) for seed in range(3)]) for one in tried])
    best = tried[np.argsort(returns)[-4:]]
    gains, spread = best.mean(axis=0), best.std(axis=0) + 0.05
    print(f"generation {generation}: return {returns.mean():.1f} of 100")

figure, axes = plt.subplots(1, 4, num="The pole in four control steps", figsize=(6, 1.7))
observation, info = env.reset(seed=2)
for panel in axes:
    panel.imshow(env.render())
    panel.axis("off")
    for _ in range(4):
        observation, *rest = env.step([-(gains @ observation)])
figure.tight_layout()

# %% [markdown]
# ## Evaluate
#
# A protocol says what varies: the mass within A, and the mass within B, which the training never saw. Both agents get the
# same draws, so that their difference is paired.

# %%
agents = {"learned": as_agent(lambda seen: [-(gains @ seen)], env=form), "still": "still"}
found = evaluate(agents, "A:pole.mass,B:pole.mass", task=Balance(), n=30)
print(found.score("A:pole.mass", agent="learned"))
print(found.score("B:pole.mass", agent="learned"))
print(found.difference("learned", "still", "B:pole.mass"))

# %% [markdown]
# ## Explain
#
# `causes` ranks the variables that were drawn, over all episodes. `why` repeats one episode with the same noise, and
# replaces one of its draws at a time.

# %%
learned = found.only(agent="learned")
print(learned.causes("B:pole.mass"))
table = learned.frame[learned.frame.protocol == "B:pole.mass"].set_index("episode")
print(why(learned, "B:pole.mass", int(table["return"].idxmin())))

figure, axes = plt.subplots(num="Return over the mass", figsize=(5, 2.6))
start = table["drawn hinge.position.start"].abs()
points = axes.scatter(table["drawn pole.mass"], table["return"], c=start, s=16)
figure.colorbar(points, label="start angle [rad]")
axes.set(xlabel="mass [kg]", ylabel="return")
figure.tight_layout()

# %% [markdown]
# The motor is too weak for a heavy pole that starts far from upright. In the worst episode, either a lighter pole
# or a better start would have been enough.
#
# ## A trained policy of the package
#
# `zoo:reaching` brings its own environment, and is evaluated by the same call.

# %%
zoo = evaluate({"trained": "zoo:reaching"}, "P0,P12", n=2)
for protocol in ("P0", "P12"):
    print(protocol, zoo.score(protocol))

# %% [markdown]
# Next: [Environments](../environments.md), [Training](../training.md), [Evaluation](../evaluation.md).
