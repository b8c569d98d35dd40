# %% [markdown]
# # Many robots, many logs
#
# The loop is closed on the log of each robot of a fleet, with a table of the effects found in each
# log. The posteriors of some robots of one kind give the prior of the next.

# %%
import dataclasses
import logging
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pymc as pm

import pbrl_ppl as pp
from pbrl_ppl.errors import BoundWarning, ConvergenceWarning, UninformedWarning

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").is_file())

# %% [markdown]
# The constants below set how long this takes. Posteriors are Gaussians at the modes (`laplace`);
# `METHOD = "importance"` takes minutes per robot.

# %% tags=["parameters"]
ROBOTS, TRAJECTORIES, INTERVALS = 6, 8, 15  # how many, and of each one's recording
METHOD = "laplace"
DRAWS = 1000  # of each chain of the population
OUT = ROOT / "out" / "notebooks"

# %%
FOLDER = OUT / "07_robots"
FOLDER.mkdir(parents=True, exist_ok=True)
# what is expected: pucks that touch nothing do not inform r and mu_c
for kind in (UninformedWarning, BoundWarning, ConvergenceWarning):
    warnings.simplefilter("ignore", kind)
# modes have one chain, of which ArviZ says that it cannot compare it with others
logging.getLogger("arviz").addFilter(lambda record: False)

# %% [markdown]
# ## A fleet
#
# Pucks of one make slide on air and are pushed at random. Their masses differ by about a tenth.
# The air supply of every third, from the second on, is bad: it has a drag that the scene does not
# declare. The recordings are simulated, with noise.

# %%
NOISE = np.array([0.002, 0.002, 0.004, 0.01, 0.01, 0.02])  # m, m, rad, m/s, m/s, rad/s
DRAG = 0.6  # kg/s
scene = pp.Scene(time_step=0.1, bodies=(pp.Body("puck", pp.Shape.circle(0.2)),))
drag = next(effect for effect in pp.catalogue if effect.name == "linear_drag")


def recording(mass: float, drags: bool, seed: int, trajectories: int) -> pp.History:
    """Pushes from random starts, measured with noise."""
    rng = np.random.default_rng(seed)
    truth = {"mass": mass, "r": 0.2, "mu_c": 0.3, "linear_drag_coefficient": DRAG * drags}
    start = rng.normal(0.0, [1.0, 1.0, 1.5, 0.7, 0.7, 0.5], (trajectories, 1, 6))
    wrenches = rng.normal(0.0, [3.0, 3.0, 0.05], (trajectories, INTERVALS, 1, 3))
    moved = pp.Transition(scene, truth, [drag], substeps=40).predict(start, wrenches)
    states = np.concatenate([start[:, None], moved], axis=1)[:, :, 0]
    states = states + NOISE * rng.standard_normal(states.shape)
    # the last row of a trajectory has no wrench
    last = np.full((trajectories, 1, 3), np.nan)
    table = np.concatenate([states, np.concatenate([wrenches[:, :, 0], last], axis=1)], axis=2)
    columns = ["x", "y", "theta", "vx", "vy", "omega", "force_x", "force_y", "torque"]
    rows = pd.DataFrame(table.reshape(-1, 9), columns=columns)
    rows["trajectory"] = np.repeat(np.arange(trajectories), INTERVALS + 1)
    rows["time"] = np.tile(scene.time_step * np.arange(INTERVALS + 1), trajectories)
    return pp.History.from_dataframe(rows.assign(body="puck"), scene)


PARTS = ("train", "test")
names = [f"puck{number}" for number in range(1, ROBOTS + 1)]
true_mass = 2.0 * np.exp(0.1 * np.random.default_rng(1).standard_normal(ROBOTS))
dragged = [name for number, name in enumerate(names) if number % 3 == 1]
(FOLDER / "scene.toml").write_text(scene.to_toml())
for number, (name, mass) in enumerate(zip(names, true_mass, strict=True)):
    for seed, part in enumerate(PARTS):
        rows = recording(mass, name in dragged, 2 * number + seed, TRAJECTORIES)
        rows.save(FOLDER / f"{name}_{part}.csv")

# %% [markdown]
# ## All loops
#
# One after another here. In a script the `map` of any `concurrent.futures.Executor` (processes, or
# a Dask cluster's) closes several at a time, with the same function. At the command line this is
# `pbrl-ppl close-loop scene.toml logs/ -o results --jobs 4`, which also writes a page of all.


# %%
def closed(name: str) -> pp.Loop:
    """Close the loop on one robot's log, and write its report."""
    train, test = (pp.History.load(FOLDER / f"{name}_{part}.csv", scene) for part in PARTS)
    loop = pp.close_loop(scene, train, test, seed=1, method=METHOD)
    folder = loop.save(FOLDER / "results" / name, overwrite=True)
    pp.report(loop, folder / "report.html")
    print(f"{name}: {loop.verdict}")
    return loop


loops = dict(zip(names, map(closed, names), strict=True))

# %% [markdown]
# ## Effects found in each log
#
# Errors are those of a step on the test recordings, in units of the noise: 1 is the error of a
# perfect model.

# %%
table = pd.DataFrame(
    {
        "verdict": loop.verdict,
        "effects": ", ".join(f"{law.effect}[{law.body}]" for law in loop.added),
        "error before": loop.before.normalised_rmse,
        "error after": loop.after.normalised_rmse,
    }
    for loop in loops.values()
)
table.set_axis(names).round(3)

# %%
found = [name for name, loop in loops.items() if loop.added]
print("drag was put into", ", ".join(dragged), "and found in", ", ".join(found) or "none")

# %% [markdown]
# ## The population
#
# A posterior with its prior divided out is a likelihood of that robot's parameter: of the logarithm
# of a mass both are nearly normal. The robots' logarithms are normal about the kind's mean, with a
# spread. PyMC infers both; the robots themselves are integrated out.

# %%
posteriors = [pp.load_posterior(FOLDER / "results" / name / "after.nc") for name in names]
log_mass = np.log([each.posterior["mass"].values.ravel() for each in posteriors])
MU, SIGMA = 1.0, 1.5  # the prior of log(mass / kg), that of Table 1
precision = 1 / log_mass.var(axis=1) - 1 / SIGMA**2  # of the data alone
measured = (log_mass.mean(axis=1) / log_mass.var(axis=1) - MU / SIGMA**2) / precision
with pm.Model():
    mean = pm.Normal("mean", MU, SIGMA)
    spread = pm.HalfNormal("spread", 0.5 * SIGMA)  # how different robots of a kind may be
    pm.Normal("robots", mean, pm.math.sqrt(spread**2 + 1 / precision), observed=measured)
    kind = pm.sample(DRAWS, chains=4, cores=1, random_seed=1, progressbar=False, target_accept=0.99)
mean, spread = (kind.posterior[name].values.ravel() for name in ("mean", "spread"))

# %% [markdown]
# Given mean and spread a robot's logarithm is normal, between its own estimate and the kind's mean,
# and that of a further robot is normal about the mean.

# %%
rng = np.random.default_rng(1)
weight = precision[:, None] / (precision[:, None] + spread**-2)
middle = weight * measured[:, None] + (1 - weight) * mean
robots = np.exp(rng.normal(middle, (precision[:, None] + spread**-2) ** -0.5))
following = np.exp(rng.normal(mean, spread))
END = [0.03, 0.5, 0.97]
intervals = pd.DataFrame(
    np.quantile([*robots, following, np.exp(mean)], END, axis=1).T,
    index=[*names, "the next", "the kind's mean"],
    columns=["3 %", "median", "97 %"],
)
intervals.round(3)

# %% [markdown]
# The picture has each robot's mass and its 94 % interval given all robots, narrower than the dot
# here, the truth (crosses), and the next robot of the kind.

# %%
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
place = np.arange(ROBOTS + 1)
low, at, high = intervals.iloc[:-1].to_numpy().T
axes.errorbar(at, place, xerr=(at - low, high - at), fmt="o", color="#0072B2")
axes.plot(true_mass, place[:-1], "x", color="#D55E00", label="simulated with", zorder=3)
ends = intervals.loc["the kind's mean", ["3 %", "97 %"]]
axes.axvspan(*ends, color="#bbbbbb", alpha=0.4, label="the kind's mean")
axes.set_yticks(place, [*names, "the next"])
axes.set_xlabel("mass (kg)")
axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
figure.savefig(OUT / "07_masses.png", dpi=100)

# %% [markdown]
# ## The next robot
#
# The scene of the next puck has the population's distribution as its `prior`. Before any
# measurement of that puck, its mass has an interval far narrower than that of Table 1's prior;
# `pp.physics_model(next_scene, history)` uses it.

# %%
hyper = (("mu", float(mean.mean())), ("sigma", float(np.hypot(mean.std(), spread).mean())))
puck = dataclasses.replace(scene.bodies[0], prior=(("mass", hyper),))
next_scene = scene.replace(bodies=(puck,))
print(next_scene.to_toml())

# %%
table_1 = np.exp(MU + SIGMA * np.array([-1.88, 0.0, 1.88]))
known = pd.DataFrame({"Table 1": table_1, "the kind": intervals.loc["the next"]}).T
known.round(2)

# %% [markdown]
# With few robots the result depends on the prior of the spread, here half of Table 1's.
