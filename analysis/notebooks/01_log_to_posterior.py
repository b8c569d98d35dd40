# %% [markdown]
# # From a log to a posterior
#
# A scene file declares a physical system, a log has its measured motion. This notebook reads both,
# checks them, infers the unknown parameters, shows the result and saves it as a file.

# %%
# %matplotlib inline
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.errors import ConvergenceWarning, UninformedWarning
from pbrl_ppl.reporting import draw_motion, plot_prior_check, summary

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").is_file())
CART = ROOT / "models" / "shopping_cart"

# %% [markdown]
# The constants below set how long this takes. `METHOD = "laplace"` with few trajectories is a
# quick, approximate run; the fit warns of that.

# %% tags=["parameters"]
TRAJECTORIES = 12  # of the recording, at most 12
METHOD, DRAWS = "importance", 500  # sampler; draws of each chain
OUT = ROOT / "out" / "notebooks"

# %%
OUT.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The scene
#
# The scene declares geometry and sampling: a shopping cart, seen from above, in a room with four
# walls. It stands on a floor (`normal_gravity` presses it down) and has one wheel, which rolls
# along one direction and resists sliding along the other.

# %%
scene = pp.Scene.load(CART / "scene.toml")
print((CART / "scene.toml").read_text())

# %% [markdown]
# ## The log
#
# One row for each trajectory, step and body: time, the measured state `x, y, theta, vx, vy,
# omega` (m, rad, m/s, rad/s), and the wrench `force_x, force_y, torque` (N, N m) that is held
# over the interval that begins there. A log with gaps, wrong units or a wrong time step is
# refused with a message that names the row. The history is an `xarray.Dataset`.

# %%
history = pp.History.load(CART / "recorded" / "train.csv", scene)
history = history.select(range(TRAJECTORIES))
print(history)
history.to_dataframe().head()

# %% [markdown]
# The picture shows the tracks seen from above: a dashed outline where each trajectory begins, a
# full one where it ends. The cart turns as it is pushed: that is the effect of the wheel.

# %%
states = history.dataset["observed"].transpose("trajectory", "time", "body", "state").to_numpy()
figure, axes = plt.subplots(figsize=(6, 6), layout="constrained")
for trajectory in states[:6]:
    draw_motion(axes, scene, trajectory)
places = states[:6, ..., :2].reshape(-1, 2)
axes.set_xlim(places[:, 0].min() - 1, places[:, 0].max() + 1)
axes.set_ylim(places[:, 1].min() - 1, places[:, 1].max() + 1)
axes.set_title(f"{min(6, TRAJECTORIES)} of {TRAJECTORIES} trajectories")
figure.savefig(OUT / "01_recording.png", dpi=100)

# %% [markdown]
# ## The model, and a check before it is fitted
#
# `physics_model` makes an ordinary PyMC model: the prior is Table 1 of Scholz et al. (2014), with
# the physics engine between parameters and predicted next states. `next_state` is normal about
# the prediction, with one `sigma` for each state dimension.

# %%
model = pp.physics_model(scene, history)
print([variable.name for variable in model.free_RVs])

# %% [markdown]
# A prior predictive check asks whether the declared prior could have produced these data at all.
# This finds wrong units (degrees, millimetres) and wrong hyper-parameters before you spend time on
# a fit. In the picture the measured changes of state over one interval (blue) should lie within
# the prior's predictions (grey); thin lines hold 94 %, thick ones half. Far wider grey bars are
# usual: the prior is vague.

# %%
check = pp.prior_predictive_check(model, seed=1)
print(*check.summary, sep="\n")
figure = plot_prior_check(check)
figure.savefig(OUT / "01_prior_check.png", dpi=100)
figure

# %% [markdown]
# ## The fit
#
# `fit` searches for the mode, starts chains around it, and returns ArviZ's type: an
# `InferenceData` (ArviZ 0.x) or an `xarray.DataTree` (ArviZ 1.x). This cart never touches a wall,
# so its restitution `r` and contact friction `mu_c` keep their prior, and the fit says so in a
# warning. That is expected here.

# %%
warnings.simplefilter("ignore", UninformedWarning)
warnings.simplefilter("ignore", ConvergenceWarning)  # short runs; R-hat and ESS are looked at below
idata = pp.fit(
    model, method=METHOD, draws=DRAWS, seed=1, progress=False,
)  # fmt: skip
print(idata.attrs["warnings"])

# %% [markdown]
# ## The result
#
# `summary` is ArviZ's, with the same columns on both of its generations. R-hat should be at most
# 1.01 and both effective sample sizes at least 400.

# %%
table = summary(idata)
table.round(4)

# %% [markdown]
# The same as pictures: draws from the prior (grey), and the posterior's median (line) and 94 %
# interval (band). A narrow band means an informed parameter; with a band as wide as the prior, the
# data do not inform it. The wheel's direction `w_theta` has four equivalent descriptions; posterior
# and prior show the same one.

# %%
names = ("mass", "w_x", "w_y", "w_theta", "mu_x", "mu_y", "r", "mu_c")
figure, panels = plt.subplots(2, 4, figsize=(11, 4.5), layout="constrained")
for axes, name in zip(panels.flat, names, strict=True):
    prior, posterior = (idata[group][name].to_numpy().ravel() for group in ("prior", "posterior"))
    label = name
    if name in ("mass", "r"):  # positive, over orders of magnitude
        prior, posterior, label = np.log10(prior), np.log10(posterior), f"log10 {name}"
    low, middle, high = np.quantile(posterior, (0.03, 0.5, 0.97))
    axes.hist(prior, 30, color="#bbbbbb", label="prior")
    axes.axvspan(low, high, color="#0072B2", alpha=0.3, label="posterior, 94 %")
    axes.axvline(middle, color="#0072B2", linewidth=1.5, label="posterior, median")
    axes.set_xlabel(label)
    axes.set_yticks([])
handles, labels = panels[0, 0].get_legend_handles_labels()
figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
figure.savefig(OUT / "01_posterior.png", dpi=100)

# %% [markdown]
# ## The file
#
# A posterior file is complete, with the scene and the data, as NetCDF. A planner or a later
# `update` needs nothing else.

# %%
path = OUT / "01_cart.nc"
pp.save_posterior(idata, path)
again = pp.load_posterior(path)
print(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
print("mass:", float(again["posterior"]["mass"].mean()), "kg")

# %% [markdown]
# The next notebook tests whether this model is adequate.
