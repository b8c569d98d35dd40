# %% [markdown]
# # Planning from a posterior file
#
# A planner needs one file: the posterior. The scene, the effects, the usual pushes and the
# uncertainty are in it. This notebook makes such a file, deletes everything else, and plans.

# %%
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.errors import ConvergenceWarning, UninformedWarning
from pbrl_ppl.reporting import draw_goal, draw_scene

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").is_file())
CART = ROOT / "models" / "shopping_cart"

# %% [markdown]
# The constants below set how long this takes.

# %% tags=["parameters"]
TRAJECTORIES = 12  # of the recording, at most 12
METHOD, DRAWS = "importance", 500  # sampler; draws of each chain
PLANNED = 8  # posterior draws that one plan must do for
OUT = ROOT / "out" / "notebooks"

# %%
OUT.mkdir(parents=True, exist_ok=True)
# the cart never touches a wall, so r and mu_c stay at their prior; and a short run says that it is
warnings.simplefilter("ignore", UninformedWarning)
warnings.simplefilter("ignore", ConvergenceWarning)

# %% [markdown]
# ## The file
#
# A cart whose castor resists turning, with that resistance in the model.

# %%
scene = pp.Scene.load(CART / "scene.toml")
history = pp.History.load(CART / "recorded" / "train.csv", scene).select(range(TRAJECTORIES))
drag = next(effect for effect in pp.catalogue if effect.name == "angular_drag")
fitted = pp.fit(
    pp.physics_model(scene, history, [drag]), method=METHOD, draws=DRAWS, seed=1,
    progress=False,
)  # fmt: skip
pp.save_posterior(fitted, OUT / "05_cart.nc")
del scene, history, fitted

# %% [markdown]
# ## The planner
#
# From here on only the file is used. Start and goal are given by body, as x, y (m) and theta
# (rad). With `draws` one plan must do for several posterior draws, so that it does not rely on
# one guess of the parameters. The search is A\* over continuous states.

# %%
idata = pp.load_posterior(OUT / "05_cart.nc")
start, goal = {"cart": (-2.0, 0.0, 0.0)}, {"cart": (2.0, 1.0, 1.57)}
plan = pp.plan(idata, start, goal, draws=PLANNED, seed=1)
print(plan.in_words())
print(f"{plan.nodes} states looked at in {plan.seconds:.1f} s")

# %% [markdown]
# Left: the path of the cart predicted by each draw, with its outline every half second for one
# draw and at the end for all; the hatched circle is the goal with its tolerance. Right: the
# pushes of the plan, each held for an interval.

# %%
states = plan.predicted["predicted"].transpose("draw", "time", "body", "state").to_numpy()
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
every = round(0.5 / plan.scene.time_step)
for state in (*states[0, ::every], *states[:, -1]):
    draw_scene(left, plan.scene, state, faded=True)
for x, y in states[:, :, 0, :2].transpose(0, 2, 1):
    left.plot(x, y, color="#D55E00", linewidth=1)
draw_goal(left, plan.scene, plan.goal)
left.set(xlim=(-3.5, 3.5), ylim=(-2.5, 2.5))
time = plan.scene.time_step * np.arange(len(plan.wrenches) + 1)
for i, name in enumerate(("force_x (N)", "force_y (N)", "torque (N m)")):
    right.stairs(plan.wrenches[:, 0, i], time, label=name, linewidth=1.5, baseline=None)
right.set(xlabel="time (s)", ylabel="push, in the world's frame")
right.legend(frameon=False)
figure.savefig(OUT / "05_plan.png", dpi=100)

# %% [markdown]
# Uncertainty of the final state: mean and standard deviation over the draws. The spread is the
# uncertainty that the data leave.

# %%
end = plan.predicted["predicted"].isel(time=-1).sel(body="cart")
print(end.mean("draw").to_series().round(3), end.std("draw").to_series().round(3), sep="\n")

# %% [markdown]
# ## Executing the plan
#
# The plan is saved as a history without measurements. Execute it on the machine, record the motion
# in the same format, and `pp.update` adds it to the posterior; `pp.act` is that loop, with a new
# plan every few intervals.

# %%
plan.save(OUT / "05_plan.csv")
print((OUT / "05_plan.csv").read_text().splitlines()[0])
