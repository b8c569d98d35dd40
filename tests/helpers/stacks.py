"""A fit of each generation of PyMC and ArviZ, stored in tests/data.

``python -m tests.helpers.stacks`` writes the running generation's.
"""

from importlib.metadata import version
from pathlib import Path
from typing import Any

from pbrl_ppl.history import History
from pbrl_ppl.model import physics_model
from pbrl_ppl.posterior import save_posterior
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history
from tests.helpers.places import ROOT

GENERATIONS = ("5", "6")
DATA = ROOT / "tests" / "data"
SCENE = Scene(
    time_step=0.1,
    normal_gravity=9.81,
    bodies=(Body("puck", Shape.circle(0.2), known={"r": 0.5, "mu_c": 0.3}),),
)


def history(seed: int, trajectories: int = 3) -> History:
    """Return the history of a pushed puck."""
    truth = {"mass": 2.0}
    return simulated_history(SCENE, truth, seed=seed, trajectories=trajectories, intervals=4)


def file(generation: str) -> Path:
    return DATA / f"puck-pymc{generation}.nc"


def fitted(draws: int = 500) -> Any:
    """Return the puck's posterior on the running generation."""
    model = physics_model(SCENE, history(1))
    return fit(model, seed=3, draws=draws, chains=2, progress=False)


if __name__ == "__main__":
    DATA.mkdir(exist_ok=True)
    save_posterior(fitted(), file(version("pymc").split(".")[0]))
