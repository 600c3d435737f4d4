# %% [markdown]
# # A causal study of a sled
#
# A sled slides along a rail. Heavy sleds run in stiff bearings and are pushed harder, so the mass confounds the
# effect of the damping on the distance. This notebook compares observation with intervention, identifies
# the effect, asks for a counterfactual, and lets a learner find the graph.

# %%
import matplotlib.pyplot as plt
import numpy as np

import scm_world as sw
from scm_world.discovery import Design, collect, evaluate, learn
from scm_world.queries import identify, nature_graph
from scm_world.variables import Normal

SLED = """
<mujoco model="sled">
  <worldbody>
    <body name="sled">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.6"/>
      <geom name="box" type="box" size="0.1 0.1 0.05" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="rail" ctrlrange="-1 1"/></actuator>
</mujoco>
"""

world = sw.World(SLED)
bearing = sw.Linear(weights=(0.3,), intercept=0.2)  # damping by mass
push = sw.Linear(weights=(0.5,), intercept=0.5)  # velocity at the start by mass
nature = {
    "sled.mass": sw.Draw(0.5, 2.0),  # [kg]
    "rail.damping": sw.Mechanism(bearing, ["sled.mass"], noise=Normal(0.0, 0.05)),  # [N s/m]
    "rail.velocity": sw.Mechanism(push, ["sled.mass"]),  # [m/s]
}

# %% [markdown]
# `nature` says how the sleds differ when nobody intervenes. The distance is the position after one
# second.
#
# ## Observe
#
# In 200 observed sleds, those with more damping go farther.

# %%
setting = {"nature": nature, "policy": None, "steps": 50}
columns = [sw.Outcome("rail.damping", "first"), sw.Outcome("sled.mass", "first")]
seen = world.see(200, outcomes=[*columns, "rail.position"], **setting)
damping, mass, distance = seen.values()
slope = np.polyfit(damping, distance, 1)[0]
print(f"association: {slope:+.2f} m per N s/m")

# %% [markdown]
# ## Intervene
#
# An intervention cuts the edge from the mass to the damping, and the sign turns.

# %%
arms = {"do": {"rail.damping": 0.7}, "versus": {"rail.damping": 0.5}}
effect = world.effect("rail.position", **arms, n=40, **setting)
print(f"effect: {effect.mean / 0.2:+.2f} m per N s/m")
assert slope > 0 > effect.mean

figure, axes = plt.subplots(num="Association and effect", figsize=(5, 3))
points = axes.scatter(damping, distance, c=mass, s=12)
figure.colorbar(points, label="mass [kg]")
axes.plot([0.3, 0.9], np.polyval(np.polyfit(damping, distance, 1), [0.3, 0.9]), label="association")
middle = distance.mean() + effect.mean / 0.2 * (np.array([0.3, 0.9]) - damping.mean())
axes.plot([0.3, 0.9], middle, "--", label="effect")
axes.set(xlabel="damping [N s/m]", ylabel="distance [m]")
axes.legend()
figure.tight_layout()

# %% [markdown]
# ## Identify
#
# Does the effect follow from the observations? The graph of this nature says so: adjust for the mass.

# %%
found = identify(
    nature_graph(world.model, nature, ["rail.position"]), "rail.damping", "rail.position"
)
print(found)
design = np.column_stack([damping, mass, np.ones(200)])
adjusted = np.linalg.lstsq(design, distance, rcond=None)[0][0]
print(f"adjusted: {adjusted:+.2f} m per N s/m")
assert abs(adjusted - effect.mean / 0.2) < 0.03

# %% [markdown]
# ## What would this sled have done?
#
# A counterfactual keeps the mass, the push and the noise of one sled, and changes its damping halfway.

# %%
episode = world.rollout(None, seed=4, steps=50, do=nature)
other = episode.counterfactual({"rail.damping": 0.2}, at=25)
assert other["sled.mass"][0] == episode["sled.mass"][0]
before, after = episode["rail.position"][-1], other["rail.position"][-1]
print(f"{before:.2f} m, and with less damping {after:.2f} m")

# %% [markdown]
# ## Discover
#
# A learner gets a table in which 40 % of the episodes are observed, and in which the others have one known
# target each. It does not see the graph. SHD counts the edges that are wrong.

# %%
values = {"sled.mass": sw.Box(0.5, 2.0), "rail.damping": sw.Box(0.2, 0.9)}
values["rail.velocity"] = sw.Box(0.5, 1.5)
design = Design("single", tuple(values), values=values, observational_fraction=0.4)
names = {"causes": ["sled.mass", "rail.damping"], "outcomes": ["rail.position"]}
table = collect(world, design, 400, seed=0, **names, **setting)
for rows in (25, 50, 100, 400):
    graph = learn("do_order", table.first(rows))
    print(rows, "rows, SHD", evaluate(graph, table.truth.edges).shd)
print(*(f"{cause} -> {effect}" for cause, effect, _ in graph.directed), sep="\n")

# %% [markdown]
# Next: [From a model to a learner](../guides/causality.md), [Questions to a world](../queries.md),
# [Discovery](../discovery.md).
