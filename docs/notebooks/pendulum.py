# %% [markdown]
# # A pendulum in ten minutes
#
# An MJCF file of a pendulum becomes a structural causal model. This notebook steps it, intervenes, asks
# for a counterfactual and an effect, tests the graph, and fits the model to a recording.

# %%
import matplotlib.pyplot as plt
import numpy as np

import scm_world as sw
from scm_world.backends.renderer import picture

PENDULUM = """
<mujoco model="pendulum">
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.02"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""

world = sw.World(PENDULUM, expose=["*", "*.scale"])
print(len(world.model), "variables,", len(world.graph.edges), "edges")
print("causes of the velocity:", *sorted(world.graph.parents("hinge.velocity")))

# %% [markdown]
# The variables are read from the file, and the edges follow from its structure. Masses, dampings and
# gravity are parameters; angles and velocities are states; the command of the motor is an action.

# %%
world.reset(seed=0, do={"hinge.position": 1.0})
figure, axes = plt.subplots(num="The pendulum", figsize=(3, 2.4))
axes.imshow(picture(world.scene(), size=(240, 300)))
axes.axis("off")

# %% [markdown]
# ## Intervene
#
# `do` sets a variable at one instant, and reports the consequences at the same instant. `pole.scale`, which `expose`
# adds, is a factor from which mass and inertia follow.

# %%
print(world.do({"pole.scale": 2.0}))

# %% [markdown]
# ## Observe, and imagine
#
# `rollout` records an episode. A counterfactual repeats it with the same noise and the same actions and
# changes one thing: here the damping from control step 40 on. Before that step nothing differs.

# %%
episode = world.rollout(None, seed=0, steps=150, do={"hinge.position": 1.0})
other = episode.counterfactual({"hinge.damping": 0.1}, at=40)
assert (episode["hinge.position"][:41] == other["hinge.position"][:41]).all()

figure, axes = plt.subplots(num="Observed and counterfactual angle", figsize=(6, 2.4))
axes.plot(episode["hinge.position"], label="observed")
axes.plot(other["hinge.position"], "--", label="damping 0.1 from step 40 on")
axes.set(xlabel="control step", ylabel="angle [rad]")
axes.legend()
figure.tight_layout()

# %% [markdown]
# ## How large is an effect?
#
# `effect` compares two interventions on many units. The start angle varies from unit to unit. Each unit
# gets both interventions with the same start and the same noise. The last number of
# the answer says how much smaller the variance is than with different units.

# %%
setting = {"nature": {"hinge.position": sw.Draw(0.5, 1.5)}, "policy": None, "steps": 60}
lowest = sw.Outcome("hinge.position", "min")  # how far the pole swings to the other side
print(
    world.effect(lowest, do={"hinge.damping": 0.1}, versus={"hinge.damping": 0.02}, n=20, **setting)
)
print(world.effect(lowest, do={"rod.color": [1, 0, 0, 1]}, versus={}, n=20, **setting))

# %% [markdown]
# ## Is the graph true?
#
# `verify` changes one variable at a time in paired experiments. A declared edge has to change its
# child, and an absent one must leave it bit-identical.

# %%
found = world.verify(probes=8)
print(found.headline)
strongest = found.table[found.table.effect == "hinge.velocity"].nlargest(4, "largest")
print(*strongest.cause)

# %% [markdown]
# ## Fit a recording
#
# A recording has a column for the time, and one for each command and measurement. Here another
# pendulum, with twice the damping and a noisy encoder, takes the place of hardware.

# %%
noise = np.random.default_rng(2).normal(0.0, 0.01, 151)
hardware = world.rollout(
    "random", seed=3, steps=150, do={"hinge.damping": 0.04, "hinge.position": 1.0}
)
recording = {"time": 0.02 * np.arange(151), "motor.control": hardware.actions[:, 0]}
recording["hinge.position"] = hardware["hinge.position"] + noise
fit = world.fit(recording, ["hinge.damping"])
row = fit.table.iloc[0]
print(f"damping {row.value:.4f} N m s/rad, 95 % interval {row.low:.4f} to {row.high:.4f}")
assert row.low < 0.04 < row.high

# %% [markdown]
# Next: [From an MJCF file to a verified graph](../guides/robots.md), [Questions to a world](../queries.md),
# [Fit](../fit.md).
