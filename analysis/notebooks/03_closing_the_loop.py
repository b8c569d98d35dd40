# %% [markdown]
# # Closing the loop
#
# `close_loop` automates the steps of the last notebook: it fits the declared model, searches for
# the physical effects that it lacks, tests the residual, samples both posteriors, and reports the
# error before and after on a recording that no decision used.

# %%
# %matplotlib inline
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl.errors import BoundWarning, ConvergenceWarning, UninformedWarning
from pbrl_ppl.reporting import plot_candidates, plot_errors, plot_rollout

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").is_file())
CART = ROOT / "models" / "shopping_cart"

# %% [markdown]
# The constants below set how long this takes. `METHOD = "laplace"` takes the posteriors from the
# modes, quickly; the verdict then depends on this approximation.

# %% tags=["parameters"]
TRAJECTORIES = 12  # of the cart's recording, at most 12
METHOD = "importance"  # of the cart's posteriors before and after
PENDULUM = ROOT.parent / "shared" / "data" / "real" / "pendulum-swing"  # a measured pendulum
BLOCK = ROOT.parent / "shared" / "contact" / "planar-push"  # a measured block that is pushed
PUSHES = 8  # of the block's recording, at most 30: 3 minutes, all of them 15
OUT = ROOT / "out" / "notebooks"

# %%
OUT.mkdir(parents=True, exist_ok=True)
# what is expected: parameters that the data do not inform, a friction of zero, short chains
for kind in (UninformedWarning, BoundWarning, ConvergenceWarning):
    warnings.simplefilter("ignore", kind)

# %% [markdown]
# ## A recorded cart
#
# The recording was made in another physics engine (Box2D). Its cart has a castor that resists
# turning with 1.2 N m s, which the scene file does not declare.

# %%
scene = pp.Scene.load(CART / "scene.toml")
train = pp.History.load(CART / "recorded" / "train.csv", scene).select(range(TRAJECTORIES))
test = pp.History.load(CART / "recorded" / "test.csv", scene)
cart = pp.close_loop(scene, train, test, seed=1, method=METHOD)
cart

# %% [markdown]
# ### The search
#
# Trajectories are simulated without process noise, in pieces of four rows, then longer ones. At
# each length one linear regression proposes the best subsets of one to three laws, and the best are
# refitted. Common laws are tried first, unusual ones only if these leave more than noise.

# %%
for length in cart.found.lengths:
    errors = ", ".join(f"{name} {error:.3g}" for name, error in length.error.items())
    print(f"pieces of {length.seconds:.2g} s: added {', '.join(length.accepted) or 'nothing'}")
    print(f"  error before: {errors}")

# %% [markdown]
# ### The candidates
#
# A score test compares the error of the shortest pieces with the signature of each effect that the
# search tried, after projecting out the part that the declared parameters can absorb. The picture
# has the first candidates, the strongest first. Several resemble each other; the search has decided
# among them.

# %%
figure = plot_candidates(cart)
figure.savefig(OUT / "03_candidates.png", dpi=100)
figure

# %% [markdown]
# ### The added effect
#
# Its evidence, summed over lengths of pieces, and the share of the declared model's error on the
# longest ones that it takes off, at least a fifth.

# %%
for added in cart.added:
    print(f"{added.effect} on {added.body}: {added.sentence}")
    share = 100 * added.simulated_share
    print(f"  {added.simulated_nats:.0f} nats, {share:.0f} % off the simulation error")
    for name, found in added.parameters.items():
        low, high = found.hdi
        print(f"  {name}: {found.mean:.3f} {found.unit}, 94 % interval {low:.3f} to {high:.3f}")
print("unexplained:", cart.unexplained)

# %% [markdown]
# ### Before and after
#
# Errors on the test recording, in units of the noise floor (dotted line), which is an estimate of
# the error of a perfect model. Left: one step ahead. Right: a forecast over many steps, in which
# the missing effect accumulates.

# %%
figure = plot_errors(cart)
figure.savefig(OUT / "03_errors.png", dpi=100)
figure

# %%
pd.DataFrame(
    {
        "before": cart.before.rollout_rmse,
        "after": cart.after.rollout_rmse,
        "noise floor": cart.noise_floor.rollout_rmse,
    }
).round(4)

# %% [markdown]
# One trajectory of the test recording: measured, and forecast from its first state by both
# models.

# %%
figure = plot_rollout(cart)
figure.savefig(OUT / "03_rollout.png", dpi=100)
figure

# %% [markdown]
# `pp.report(cart, path)` writes all this as one page, and `cart.save(folder)` the posteriors. These
# are ordinary ones: `cart.posterior_after` goes into ArviZ or a planner.

# %%
print(pp.report(cart, OUT / "03_cart.html").name)

# %% [markdown]
# ## A measured pendulum
#
# A real arm on a bearing, recorded at 50 Hz by an encoder. The scene knows its mass and its
# pivot, and declares that its mass may not be uniform (`inertia_scale`). It declares no friction.
# The posteriors are Gaussians at the modes (`laplace`), because chains over so many samples take
# many minutes. The data are not part of this repository; without them this section is skipped.

# %%
pendulum = None
if PENDULUM.is_dir():
    scene = pp.Scene.load(PENDULUM / "scene.toml")
    train, test = (pp.History.load(PENDULUM / f"{part}.csv", scene) for part in ("train", "test"))
    pendulum = pp.close_loop(scene, train, test, seed=1, method="laplace")
    print(pendulum)
else:
    print("skipped: the measured pendulum is not here")

# %% [markdown]
# A real machine never equals its model exactly. Besides the added effects, read the remaining
# residual: the verdict is `unexplained` if forecasts, simulations or accelerations still have
# significant errors, whatever was added. Hypotheses are unusual laws that would take a part of
# these errors off: declare one to try it.

# %%
if pendulum is not None:
    print("verdict:", pendulum.verdict)
    for added in pendulum.added:
        values = ", ".join(
            f"{name} {found.mean:.3g} {found.unit}" for name, found in added.parameters.items()
        )
        print(f"added: {added.effect} ({values}); {added.simulated_nats:.0f} nats")
    print("remains:", pendulum.unexplained.sentence if pendulum.unexplained else "nothing")
    print("hypotheses:", [f"{one.effect} on {one.body}" for one in pendulum.found.hypotheses])
    print("error before:", pendulum.before.rollout_rmse)
    print("error after: ", pendulum.after.rollout_rmse)
    for name, draw in (("errors", plot_errors), ("rollout", plot_rollout)):
        figure = draw(pendulum)
        figure.savefig(OUT / f"03_pendulum_{name}.png", dpi=100)

# %%
plot_rollout(pendulum) if pendulum is not None else None

# %% [markdown]
# ## A measured block, pushed over a table
#
# A triangular steel block that a robot's finger pushes. The finger's path was measured throughout,
# the block only before and after each push: the cells in between are empty. The scene declares the
# block's outline and mass, and that the finger follows its recorded path, but no friction of the
# table. These data are not part of this repository either.

# %%
block = None
if BLOCK.is_dir():
    scene = pp.Scene.load(BLOCK / "scene.toml")
    train, test = (pp.History.load(BLOCK / f"{part}.csv", scene) for part in ("train", "test"))
    block = pp.close_loop(scene, train.select(range(PUSHES)), test, seed=1, method="laplace")
    print(block)
else:
    print("skipped: the measured block is not here")

# %% [markdown]
# The error of the block's last pose, over the 20 pushes of the test recording. For comparison:
# without any motion it is 9.7 mm and 4.8 degrees; a quasi-static model of pushing, which was made
# for such data, reaches 1.5 mm and 1.4 degrees. With all 30 pushes the loop ends at 1.5 mm and
# 1.3 degrees.
#
# The friction's radius determines how the block turns as it slides. Its size `mu` is not reliable:
# the pushes are slow, 2 mm/s, and any `mu` from 0.0001 to 0.3 gives the same error of the last
# pose.

# %%
if block is not None:
    print("verdict:", block.verdict)
    for added in block.added:
        values = ", ".join(
            f"{name} {found.mean:.3g} {found.unit}" for name, found in added.parameters.items()
        )
        print(f"added: {added.effect} ({values}); {added.simulated_nats:.0f} nats")
    print("remains:", block.unexplained.sentence if block.unexplained else "nothing")
    for label, errors in (("before", block.before), ("after", block.after)):
        last = errors.rollout_rmse
        far, turned = 1e3 * np.hypot(last["x"], last["y"]), np.degrees(last["theta"])
        print(f"error {label}: {far:.1f} mm, {turned:.1f} degrees")
    plot_candidates(block).savefig(OUT / "03_block_candidates.png", dpi=100)

# %%
plot_candidates(block) if block is not None else None
