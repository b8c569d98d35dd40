"""The models that are written out by hand are those that the package declares."""

import importlib.util

import numpy as np

import pbrl_ppl as pp
from tests.helpers.places import ROOT


def test_the_cart_written_out_is_the_cart_declared():
    folder = ROOT / "models" / "shopping_cart"
    spec = importlib.util.spec_from_file_location("cart_model", folder / "model.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    scene = pp.Scene.load(folder / "scene.toml")
    history = pp.History.load(folder / "recorded" / "train.csv", scene)
    by_hand = module.cart_model(scene, history)
    declared = pp.physics_model(scene, history, sigma="scalar")
    values = {"mass": 6.5, "r": 0.2, "mu_c": 0.3, "w_x": -0.25, "w_y": 0.02, "w_theta": 0.1,
              "mu_x": 0.05, "mu_y": 0.4}  # fmt: skip
    phi = [name for name in values if name != "sigma"]

    def log_likelihood(model, size):
        point = model.initial_point()
        inputs = {}
        for rv in model.free_RVs:
            value = model.rvs_to_values[rv]
            if rv.name not in phi:
                inputs[value.name] = point[value.name] * 0.0  # sigma = 1
                continue
            transform = model.rvs_to_transforms[rv]
            constrained = np.full(size, values[rv.name])
            moved = transform.forward(constrained, *rv.owner.inputs).eval()
            inputs[value.name] = np.asarray(moved).reshape(point[value.name].shape)
        logp = model.compile_logp(vars=[model["next_state"]], sum=True, mode="FAST_COMPILE")
        return float(logp(inputs))

    # an angle that wraps makes the plain Normal differ from the declared likelihood: none does here
    np.testing.assert_allclose(
        log_likelihood(by_hand, ()), log_likelihood(declared, (1,)), rtol=1e-10
    )
