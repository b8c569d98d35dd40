# %% [markdown]
# # Many robots, many logs
#
# `close_loop_many` closes the loop on each log of a manifest, continues after an interrupt, and
# reports the effects found in each log. Robots of one kind are pooled: the posteriors of some of
# them give the prior of the next.

# %%
import logging
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl.errors import BoundWarning, ConvergenceWarning, UninformedWarning

ROOT = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").is_file())

# %% [markdown]
# The constants below set how long this takes. Posteriors are Gaussians at the modes (`laplace`);
# `METHOD = "metropolis"` takes minutes per robot.

# %% tags=["parameters"]
ROBOTS, TRAJECTORIES, INTERVALS = 6, 8, 15  # how many, and of each one's recording
METHOD = "laplace"
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
# declare. The recordings are simulated, with noise. A manifest names each robot, its scene and
# files, and its kind.

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


names = [f"puck{number}" for number in range(1, ROBOTS + 1)]
true_mass = 2.0 * np.exp(0.1 * np.random.default_rng(1).standard_normal(ROBOTS))
dragged = [name for number, name in enumerate(names) if number % 3 == 1]
(FOLDER / "scene.toml").write_text(scene.to_toml())
for number, (name, mass) in enumerate(zip(names, true_mass, strict=True)):
    for seed, part in enumerate(("train", "test")):
        rows = recording(mass, name in dragged, 2 * number + seed, TRAJECTORIES)
        rows.save(FOLDER / f"{name}_{part}.csv")
manifest = pd.DataFrame({"name": names, "kind": "puck", "scene": "scene.toml"})
for part in ("train", "test"):
    manifest[part] = [f"{name}_{part}.csv" for name in names]
manifest.to_csv(FOLDER / "logs.csv", index=False)
manifest

# %% [markdown]
# ## All loops
#
# One after another here; with `executor=`, any `concurrent.futures.Executor` (processes, or a Dask
# cluster's) closes several at a time. Robots whose log and settings have not changed are not run
# again by the same call, and one that fails does not stop the others. At the command line this is
# `pbrl-ppl close-logs logs.csv -o results --jobs 4`.

# %%
loops = pp.close_loop_many(
    FOLDER / "logs.csv", FOLDER / "results", seed=1, method=METHOD, progress=print
)
loops

# %% [markdown]
# ## Effects found in each log
#
# `results/index.html` is the same as a page, with a link to each robot's own report. Errors are
# those of a step on the test recordings, in units of the noise: 1 is the error of a perfect model.

# %%
loops.table()[["name", "verdict", "effects", "error_before", "error_after"]].round(3)

# %%
loops.effects().round(3)

# %%
found = sorted(loops.effects()["name"])
print("drag was put into", ", ".join(dragged), "and found in", ", ".join(found) or "none")

# %% [markdown]
# ## The population
#
# Robots of the manifest's `kind` are pooled, as `pp.pool` does with any posteriors of one scene.
# Each robot's posterior, with its prior divided out, informs the population's mean and the spread
# between robots. `p_same` is the p-value of no difference between robots.

# %%
posteriors = {name: pp.load_posterior(loops.folder / name / "after.nc") for name in names}
pooled = pp.pool(posteriors)
pooled.table().set_index("parameter").T

# %% [markdown]
# `left_out` names parameters that only some robots have. An effect found in some robots may be
# below the detection limit in the others, so the mean over those that have it would be too large.

# %%
print("left out:", pooled.left_out)

# %% [markdown]
# The picture has each robot's mass and its 94 % interval given all robots, narrower than the dot
# here, the truth (crosses), and the next robot of the kind.

# %%
robots = pooled.robots().query("parameter == 'mass[puck]'").set_index("robot")
kind = pooled.table().set_index("parameter").loc["mass[puck]"]
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
place = np.arange(ROBOTS + 1)
middle = np.append(robots["median"], kind["next_median"])
low, high = np.append(robots["low"], kind["next_low"]), np.append(robots["high"], kind["next_high"])
axes.errorbar(middle, place, xerr=(middle - low, high - middle), fmt="o", color="#0072B2")
axes.plot(true_mass, place[:-1], "x", color="#D55E00", label="simulated with", zorder=3)
axes.axvspan(
    kind["mean_low"], kind["mean_high"], color="#bbbbbb", alpha=0.4, label="the kind's mean"
)
axes.set_yticks(place, [*names, "the next"])
axes.set_xlabel("mass (kg)")
axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
figure.savefig(OUT / "07_masses.png", dpi=100)

# %% [markdown]
# ## The next robot
#
# `pooled.scene` is the scene for the next puck, with the population's distribution as its `prior`.
# Before any measurement of that puck, its mass has an interval far narrower than that of Table 1's
# prior; `pp.physics_model(pooled.scene, history)` uses it.

# %%
print(pooled.scene.to_toml())

# %%
table_1 = np.exp(1.0 + 1.5 * np.array([-1.88, 0.0, 1.88]))  # of log(mass/kg): mu 1, sigma 1.5
known = pd.DataFrame(
    {"Table 1": table_1, "the kind": kind[["next_low", "next_median", "next_high"]].to_list()},
    index=["3 %", "median", "97 %"],
).T
known.astype(float).round(2)

# %% [markdown]
# With few robots the result depends on the prior of the spread: `pp.pool(posteriors, spread=0.5)`
# sets how different robots of a kind may be.
