# %% [markdown]
# # A Bayesian workflow
#
# Two models of the same recording go through the steps of a Bayesian workflow (Gelman et al.,
# 2020): prior predictive check, fit, diagnostics of the sampler, posterior predictive checks,
# comparison by leave-one-out cross-validation, sensitivity to the prior.
#
# The recording is of a shopping cart whose castor resists turning. The first model is the scene
# as it is declared, without that resistance; the second has `angular_drag`, a torque against the
# rotation.

# %%
# %matplotlib inline
import warnings
from pathlib import Path

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.stats import binom

import pbrl_ppl as pp
from pbrl_ppl.errors import ConvergenceWarning, UninformedWarning
from pbrl_ppl.reporting import plot_prior_check, plot_rank, summary

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").is_file())
CART = ROOT / "models" / "shopping_cart"
COLOURS = {"declared": "#D55E00", "with drag": "#0072B2"}

# %% [markdown]
# The constants below set how long this takes.

# %% tags=["parameters"]
TRAJECTORIES = 12  # of the recording, at most 12
METHOD, DRAWS = "importance", 500  # sampler; draws of each chain
OUT = ROOT / "out" / "notebooks"

# %%
OUT.mkdir(parents=True, exist_ok=True)
# the cart never touches a wall, so r and mu_c stay at their prior; and a short run says that it is
warnings.simplefilter("ignore", UninformedWarning)
warnings.simplefilter("ignore", ConvergenceWarning)
# ArviZ 0.x and PyMC 5 call what newer versions of other packages will drop
warnings.simplefilter("ignore", FutureWarning)
warnings.simplefilter("ignore", DeprecationWarning)

scene = pp.Scene.load(CART / "scene.toml")
history = pp.History.load(CART / "recorded" / "train.csv", scene).select(range(TRAJECTORIES))
drag = next(effect for effect in pp.catalogue if effect.name == "angular_drag")
models = {
    "declared": pp.physics_model(scene, history),
    "with drag": pp.physics_model(scene, history, [drag]),
}

# %% [markdown]
# ## Prior predictive check
#
# Parameters are drawn from the prior and simulated from the measured initial states. Each panel has
# the changes of one state dimension over one interval: predicted in grey, measured in blue; thin
# lines hold 94 %, thick ones half. Measured bars outside the predicted ones would mean a prior that
# cannot have made the data. `pm.sample_prior_predictive(model)` gives such draws too.

# %%
check = pp.prior_predictive_check(models["with drag"], seed=1)
print(*check.summary, sep="\n")
figure = plot_prior_check(check)
figure.savefig(OUT / "02_prior_check.png", dpi=100)
figure

# %% [markdown]
# ## Fit

# %%
posteriors = {
    name: pp.fit(
        model, method=METHOD, draws=DRAWS, seed=1, progress=False,
    )
    for name, model in models.items()
}  # fmt: skip

# %% [markdown]
# ## Diagnostics of the sampler
#
# R-hat compares the chains with each other (at most 1.01). The effective sample sizes are the
# equivalent numbers of independent draws, in the bulk and in the tails (at least 400). The fit's
# warnings are also in `idata.attrs["warnings"]`.

# %%
tables = {name: summary(idata) for name, idata in posteriors.items()}
worst = pd.DataFrame(
    {
        name: {
            "largest R-hat": table["r_hat"].max(),
            "smallest bulk ESS": table["ess_bulk"].min(),
            "smallest tail ESS": table["ess_tail"].min(),
        }
        for name, table in tables.items()
    }
)
print(worst.round(3))
tables["with drag"].round(4)

# %% [markdown]
# Rank plot: the ranks of each chain's draws among all draws, minus those of uniform ranks.
# Converged chains stay in the grey band. Draws of a Markov chain are correlated, so the band's
# width follows from their effective sample size. `az.plot_rank` has no band in ArviZ 0.x, and in
# 1.3 marks the points that a test of the ranks finds suspicious.
# `az.plot_trace(idata, var_names=["mass"])` draws traces.

# %%
shown = ["mass[cart]", "w_x[cart]", "mu_x[cart]", "angular_drag_coefficient[cart]"]
figure = plot_rank(posteriors["with drag"], shown)
figure.savefig(OUT / "02_rank.png", dpi=100)
figure

# %% [markdown]
# ## Posterior predictive checks
#
# First, the distribution of the measured changes (black) against those of 50 predictive draws of
# each model. State dimensions have different units, so each has a separate panel. In most panels
# both models look right, and the declared one is only somewhat wide in `omega`: `sigma` is free,
# and grows until the overall spread fits. Such a check has little power; the ones below have more.
#
# ArviZ's check shows the states themselves, whose spread is so much larger than the noise that
# nothing can be seen. It pools all dimensions by default:
#
#     az.plot_ppc(idata, flatten=["transition", "step", "body"])  # ArviZ 0.x
#     az.plot_ppc_dist(idata, cols=["state"])  # ArviZ 1.x

# %%
start = posteriors["declared"]["constant_data"]["start"].rename(full_state="state")
measured = posteriors["declared"]["observed_data"]["next_state"].isel(step=0)
dimensions = [str(name) for name in measured["state"].values]
units = dict(zip(dimensions, ("m", "m", "rad", "m/s", "m/s", "rad/s"), strict=True))


def change(states: object, state: str) -> np.ndarray:
    """Change of one state dimension over an interval; of angles, the shorter way round."""
    off = (states.sel(state=state) - start.sel(state=state)).to_numpy()
    return (off + np.pi) % (2 * np.pi) - np.pi if state == "theta" else off


figure, panels = plt.subplots(2, 3, figsize=(11, 5.5), layout="constrained")
for axes, state in zip(panels.flat, dimensions, strict=True):
    values = change(measured, state).ravel()
    bins = np.linspace(*np.quantile(values, (0.005, 0.995)), 25)
    for name, idata in posteriors.items():
        predicted = idata["posterior_predictive"]["next_state"].isel(step=0)
        predicted = predicted.stack(sample=("chain", "draw")).transpose("sample", ...)
        for each in change(predicted[:: len(predicted) // 50], state):
            axes.hist(each.ravel(), bins, density=True, histtype="step", color=COLOURS[name],
                      alpha=0.12)  # fmt: skip
        axes.plot([], [], color=COLOURS[name], label=name)
    axes.hist(values, bins, density=True, histtype="step", color="black", label="measured")
    axes.set_xlabel(f"change of {state} in {scene.time_step:g} s ({units[state]})")
    axes.set_yticks([])
handles, labels = panels[0, 0].get_legend_handles_labels()
figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
figure.savefig(OUT / "02_predictive.png", dpi=100)

# %% [markdown]
# LOO-PIT: the position of each measurement in its prediction by the same model fitted without it
# (0: below all draws, 1: above all). For a calibrated model it is uniform, and the grey band holds
# 99 % of the bars. Bars that rise in the middle mean predictions that are too wide, bars that
# rise at the ends predictions that are too narrow.
#
# `pp.loo_pit` does this for all state dimensions. ArviZ's functions take one of them at a time, and
# only draws that have predictions:
#
#     draws = idata["posterior_predictive"]["draw"].values
#     one = idata.sel(draw=draws).sel(state="vx").isel(step=0, body=0)
#     az.plot_loo_pit(one)  # with y="next_state" in ArviZ 0.x

# %%
pits = {name: pp.loo_pit(idata) for name, idata in posteriors.items()}
figure, panels = plt.subplots(2, 3, figsize=(11, 5), layout="constrained", sharey=True)
edges = np.linspace(0, 1, 11)
for axes, state in zip(panels.flat, dimensions, strict=True):
    n = int(np.isfinite(pits["declared"].sel(state=state)).sum())
    axes.axhspan(*binom.interval(0.99, n, 0.1), color="#e0e0e0")
    for name, pit in pits.items():
        axes.hist(pit.sel(state=state).to_numpy().ravel(), edges, histtype="step",
                  color=COLOURS[name], label=name, linewidth=1.5)  # fmt: skip
    axes.set_title(state, fontsize=10)
    axes.set_xlabel("LOO-PIT")
panels[0, 0].set_ylabel("transitions")
panels[1, 0].set_ylabel("transitions")
handles, labels = panels[0, 0].get_legend_handles_labels()
figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)
figure.savefig(OUT / "02_loo_pit.png", dpi=100)

# %% [markdown]
# Residuals against a possible cause: the error of the predicted angular velocity against the
# angular velocity at the start. The declared model overestimates fast rotation in proportion to its
# speed, as expected from missing viscous drag; with drag no pattern is left. LOO-PIT cannot detect
# this, because it uses one measurement at a time. `pp.close_loop` does such tests automatically;
# see the next notebook.

# %%
spin = start.sel(state="omega").to_numpy().ravel()
figure, axes = plt.subplots(figsize=(6, 3.8), layout="constrained")
slopes = {}
for name, idata in posteriors.items():
    mean = idata["posterior_predictive"]["next_state"].mean(("chain", "draw")).isel(step=0)
    residual = (measured - mean).sel(state="omega").to_numpy().ravel()
    slopes[name] = float(np.polyfit(spin, residual, 1)[0])
    axes.plot(spin, residual, ".", color=COLOURS[name], markersize=4,
              label=f"{name}: slope {slopes[name]:+.3f}")  # fmt: skip
axes.axhline(0, color="black", linewidth=0.8)
axes.set(xlabel="omega at the start (rad/s)", ylabel="measured - predicted omega (rad/s)")
axes.legend(frameon=False)
figure.savefig(OUT / "02_residual.png", dpi=100)

# %% [markdown]
# ## Comparison by leave-one-out cross-validation
#
# `az.loo` estimates the expected log predictive density of a transition that was left out
# (PSIS-LOO, Vehtari et al., 2017). It is reliable if few Pareto k are high; it reports their
# number.

# %%
warnings.filterwarnings("ignore", message="Estimated shape parameter of Pareto")
print(az.loo(posteriors["with drag"]))

# %% [markdown]
# `az.compare` ranks the models: compare the difference in elpd with its standard error, `dse`. A
# difference of several times `dse` is significant.

# %%
comparison = az.compare(posteriors)
comparison

# %% [markdown]
# ## Sensitivity to the prior
#
# First, which parameters the data inform: the ratio of the posterior's width to the prior's.
# Those with a ratio near one are `prior only`.

# %%
said = pp.identify(posteriors["with drag"])
print(*said.sentences, sep="\n")
said.table().round(4)

# %% [markdown]
# Then, how much the posterior would change with another prior. Power scaling (Kallioinen et al.,
# 2024) raises the prior to a power and weighs the draws accordingly, without a new fit: a power
# of 0.8 is a somewhat weaker prior, 1.25 a somewhat stronger one. The table has the shift of each
# mean in posterior standard deviations between the two. It is small for informed parameters, and
# large for `r`, which the data do not inform. The density of the prior at the draws is in the group
# `log_prior`; with ArviZ 1.x `az.psense_summary(idata)` uses it too, and
# `az.plot_prior_posterior(idata)` the group `prior`.


# %%
def scaled(idata: object, power: float) -> pd.Series:
    """Posterior means with the prior raised to a power, by importance weights."""
    prior = idata["log_prior"].data_vars.values()
    own = sum(each.sum([d for d in each.dims if d not in ("chain", "draw")]) for each in prior)
    weights = np.exp((power - 1.0) * (own - own.max()))
    weights = weights / weights.sum()
    posterior = idata["posterior"]
    return pd.Series(
        {
            name: float((weights * posterior[name].squeeze()).sum())
            for name in posterior.data_vars
            if name != "sigma"
        }
    )


with_drag = posteriors["with drag"]
sd = pd.Series(
    {
        name: float(v.std())
        for name, v in with_drag["posterior"].data_vars.items()
        if name != "sigma"
    }
)
sensitivity = ((scaled(with_drag, 1.25) - scaled(with_drag, 0.8)) / sd).rename("shift in sd")
sensitivity.round(3)
