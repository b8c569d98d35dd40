"""The models that are written out by hand are those that the package declares."""

import importlib.util
import sys

import numpy as np
import pytest

import pbrl_ppl as pp
from tests.helpers.histories import simulated_history
from tests.helpers.places import MODELS

#: Folder and function of each model.
WRITTEN = {
    "shopping_cart": "cart_model",
    "pendulum": "pendulum_model",
    "namo": "rooms_model",
    "apartment": "apartment_model",
}
POINTS = 4


def module_of(folder: str, name: str):
    path = MODELS / folder / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"{folder}_{name}", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def history_of(folder: str, scene: pp.Scene) -> pp.History:
    """As recorded, as the robot's first round, or pushes of all that stands in the apartment."""
    if folder == "namo":
        world = module_of(folder, "world")
        return world.go_round(world.World(1)).history()
    if folder != "apartment":
        return pp.History.load(MODELS / folder / "recorded" / "train.csv", scene)
    typical = {"mass": 20.0, "r": 0.2, "mu_c": 0.3, "w_x": 0.1, "w_y": 0.0, "w_theta": 0.3,
               "mu_x": 0.1, "mu_y": 0.4}  # fmt: skip
    return simulated_history(
        scene, typical, seed=1, trajectories=2, intervals=3, wrench_sd=(60.0, 60.0, 10.0),
        poses=[body.pose for body in scene.dynamic],
    )  # fmt: skip


@pytest.mark.parametrize("folder", WRITTEN)
def test_a_model_written_out_is_the_one_declared(folder) -> None:
    """Log-probability, prior and likelihood together, at points about the prior's middle."""
    scene = pp.Scene.load(MODELS / folder / "scene.toml")
    history = history_of(folder, scene)
    by_hand = getattr(module_of(folder, "model"), WRITTEN[folder])(scene, history)
    declared = pp.physics_model(scene, history)
    one, other = (model.compile_logp(mode="FAST_COMPILE") for model in (by_hand, declared))
    shapes = [
        {name: value.shape for name, value in model.initial_point().items()}
        for model in (by_hand, declared)
    ]
    assert sorted(shapes[0]) == sorted(shapes[1])
    middle, rng = declared.initial_point(), np.random.default_rng(1)
    found = []
    for _ in range(POINTS):
        point = {name: value + 0.3 * rng.normal(size=value.shape) for name, value in middle.items()}
        values = [
            float(logp({name: point[name].reshape(own[name]) for name in own}))
            for logp, own in zip((one, other), shapes, strict=True)
        ]
        found.append(values)
    # PyMC's normal density has its constant to 3e-9 a cell
    np.testing.assert_allclose(*np.transpose(found), rtol=1e-8)
    assert len(np.unique(found)) >= POINTS
    assert np.isfinite(found).all()
