"""Learn furniture by itself, and keep the modes: the paper's categorical prior.

The library is of other instances of the furniture than the apartment's: same outlines, other masses
and frictions. Each is pushed about by itself, and what is kept is the mode of its posterior.

Run from anywhere: `python models/apartment/make_library.py` writes library.json in some minutes.
"""

import warnings
from itertools import product

import numpy as np
from task import LIBRARY_FILE, SCENE, TRUTH

import pbrl_ppl as pp

#: Transitions of each trial, and the noise of what is measured (m, rad, m/s, rad/s).
COUNT, SIGMA = 60, 0.005
#: Instances of each piece; they differ from the apartment's by these factors (logarithms' standard
#: deviations, of mass and of friction) and by so much in the wheel's place (m).
INSTANCES, MASS, FRICTION, PLACE = 10, 0.1, 0.1, 0.02


def instance(rng: np.random.Generator, known: dict[str, float]) -> dict[str, float]:
    """Parameters of another instance of a body."""
    other = dict(known, mass=known["mass"] * rng.lognormal(0.0, MASS))
    for name in ("mu_x", "mu_y"):
        if name in known:
            other[name] = min(known[name] * rng.lognormal(0.0, FRICTION), 1.0)
    if "w_x" in known:
        other["w_x"] = known["w_x"] + rng.normal(0.0, PLACE)
    return other


def trial(number: int, name: str, copy: int) -> tuple[pp.Scene, pp.History]:
    """Random pushes of one instance from random states, a wall beside it in a third of them."""
    rng = np.random.default_rng([7, number, copy])
    alone = SCENE.subset([name])
    body, layout = alone.dynamic[0], pp.Physics(SCENE).layout
    truth = layout.to_dict(layout.to_vector(TRUTH))
    known = {
        block.name: truth[block.name][block.owners.index(name)]
        for block in layout.blocks
        if name in block.owners
    }
    known = instance(rng, known)
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
    return alone, pp.History.of_arrays(np.stack([start, after], axis=1), alone, actions[:, None])


def main() -> None:
    """A trial and a fit of each, and the file."""
    sets, kinds = {}, {}
    for number, copy in product(range(len(SCENE.dynamic)), range(INSTANCES)):
        body = SCENE.dynamic[number]
        alone, history = trial(number, body.name, copy)
        name = f"{body.name}_{copy + 1}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # castors: what is not there cannot be learned
            model = pp.physics_model(alone, history, sigma="scalar")
            idata = pp.fit(model, seed=1, method="map", progress=False)
        learned = pp.learned_library({body.name: idata})
        values = dict(dict(learned.sets)[body.name])
        for key in ("w_x", "w_y", "w_theta", "mu_x", "mu_y"):
            values.setdefault(key, 0.0)  # a wheel of no friction is none
        sets[name] = {key: round(value, 6) for key, value in values.items()}
        print(name, sets[name], flush=True)
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
