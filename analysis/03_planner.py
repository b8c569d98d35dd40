"""A planner script that needs only the posterior file.

make demo && python analysis/03_planner.py out/demo/after.nc
"""

import sys

import pbrl_ppl as pp

idata = pp.load_posterior(sys.argv[1])
start, goal = {"cart": (-2.0, 0.0, 0.0)}, {"cart": (2.0, 1.0, 1.57)}
plan = pp.plan(idata, start, goal, draws=8, seed=1)
end = plan.predicted["predicted"].isel(time=-1).sel(body="cart")
print(plan.in_words())
print(end.mean("draw").to_series().round(3), end.std("draw").to_series().round(3), sep="\n")
plan.save("out/plan.csv")
