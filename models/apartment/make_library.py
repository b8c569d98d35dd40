"""Learn each piece of furniture by itself, and keep the modes: the paper's categorical prior.

Run from anywhere: `python models/apartment/make_library.py` writes library.json in a minute or two.
"""

import warnings

import numpy as np
from task import LIBRARY_FILE, SCENE, TRUTH

import pbrl_ppl as pp
from pbrl_ppl.history import from_segments
from pbrl_ppl.model import build_layout

#: Transitions of each trial, and the noise of what is measured (m, rad, m/s, rad/s).
COUNT, SIGMA = 60, 0.005


def trial(number: int, name: str) -> tuple[pp.Scene, pp.History]:
    """Random pushes of one body from random states, a wall beside it in a third of them."""
    rng = np.random.default_rng([7, number])
    alone = SCENE.subset([name])
    body, layout = alone.dynamic[0], build_layout(SCENE)
    truth = layout.to_dict(layout.to_vector(TRUTH))
    known = {
        block.name: truth[block.name][block.owners.index(name)]
        for block in layout.blocks
        if name in block.owners
    }
    hung = bool(alone.joints)
    reach, mass = body.shape.bounding_radius, known["mass"]
    if not hung:
        wall = pp.Wall((2.0, -50.0), (2.0, 50.0))
        alone = alone.replace(walls=(wall,))
    start = np.zeros((COUNT, 1, 6))
    if hung:
        start[:, 0, :3] = body.pose
    else:
        start[:, 0, 0] = np.where(
            rng.uniform(size=COUNT) < 1 / 3, 2.0 - reach - rng.uniform(0.02, 0.3, COUNT), -9.0
        )
        start[:, 0, 2] = rng.uniform(-np.pi, np.pi, COUNT)
        start[:, 0, 3:5] = rng.normal(0, 0.8, (COUNT, 2))
        start[:, 0, 5] = rng.normal(0, 0.8, COUNT)
    # strong enough to get over dry friction
    force, torque = 6.0 * mass, 6.0 * mass * body.shape.unit_moment
    actions = rng.uniform(-1, 1, (COUNT, 1, 3)) * [force, force, torque]
    if hung:
        actions[..., :2] = 0.0
    true = pp.Dynamics.known(alone, known, threads=1)
    after = true.step(start[None], actions)[0]
    after += rng.normal(0, SIGMA, after.shape)
    return alone, from_segments(alone, start, actions[:, None], after[:, None])


def main() -> None:
    """A trial and a fit of each, and the file."""
    sets, kinds = {}, {}
    for number, body in enumerate(SCENE.dynamic):
        alone, history = trial(number, body.name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # castors: what is not there cannot be learned
            model = pp.physics_model(alone, history, sigma="scalar")
            idata = pp.fit(model, seed=1, method="map", progress=False)
        learned = pp.learned_library({body.name: idata})
        values = dict(dict(learned.sets)[body.name])
        for key in ("w_x", "w_y", "w_theta", "mu_x", "mu_y"):
            values.setdefault(key, 0.0)  # a wheel of no friction is none
        sets[body.name] = {key: round(value, 6) for key, value in values.items()}
        print(body.name, sets[body.name], flush=True)
    for body in SCENE.dynamic:
        x_min, x_max, y_min, y_max = body.shape.bounds
        kinds[body.name] = {  # a wheel is somewhere under its body
            name: 1.0
            for name, values in sets.items()
            if not body.wheel
            or (x_min <= values["w_x"] <= x_max and y_min <= values["w_y"] <= y_max)
        }
    library = pp.ParameterLibrary(sets, kinds)
    LIBRARY_FILE.write_text(library.to_json() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
