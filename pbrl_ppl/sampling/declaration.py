"""Declaration of the model: Eq. 11, or linearised trajectories."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from pbrl_ppl.effects import Attached, Effect, attach, catalogue
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import TransitionLikelihood, declared_problem
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import Physics, try_effect
from pbrl_ppl.posterior import Idata, PosteriorRecord, linearised_as, stored_mode
from pbrl_ppl.scene import Scene

if TYPE_CHECKING:
    import pymc as pm


def physics_model(
    scene: Scene,
    history: History,
    effects: Iterable[Effect | Attached] = (),
    *,
    likelihood: str | Idata = TransitionLikelihood.name,
    horizon: int = 1,
    sigma: str = "per_dimension",
    nu: float | None = None,
    substeps: int | None = None,
    threads: int = 1,
    library: ParameterLibrary | None = None,
) -> pm.Model:
    """Declare the model of the paper's section 3.2 for a scene and a history.

    Parameters
    ----------
    scene : Scene
        Known geometry, and which parameters are known.
    history : History
        Measured transitions.
    effects : iterable of Effect or Attached
        Effects beside those that the scene declares. Your own are tried once; see
        :func:`pbrl_ppl.physics.try_effect`.
    likelihood : str, InferenceData or DataTree
        ``transitions`` (Eq. 11): measured initial states are exact.

        ``trajectories``: whole trajectories are whitened together, with two noises: ``sigma``, the
        error of measuring a state, ``unexplained_acceleration``, what a step adds, and where bodies
        touch ``contact_acceleration``, what comes on top of it there.

        ``simulation``: trajectories are simulated from latent initial states without process noise
        (output error), in pieces as long as a simulation does not magnify its initial state.
        ``sigma`` is the error of measuring a state; the log-likelihood is divided by its
        autocorrelation time.

        The latter two are linearised about the states at the prior's centre, and again at the mode
        by :func:`pbrl_ppl.fit`, which searches for it. A posterior of the same data has their
        likelihood as it was linearised in that fit, and its mode as the initial point: give
        ``fit(model, method="map")`` before ``pm.sample``. With joints of unknown bodies
        ``simulation`` is refused.
    horizon : int
        Intervals predicted from one measured state, of ``transitions``; 1 is Eq. 11.
    sigma : str
        ``per_dimension`` or ``scalar`` (the paper's Eq. 11).
    nu : float, optional
        Degrees of freedom of Student-t noise, for recordings full of contacts, whose residuals have
        heavy tails; 4 is usual. Sigma is then its scale. Gaussian without it.
    substeps : int, optional
        Engine steps an interval; the scene's by default.
    threads : int
        Engine worlds that run side by side within one evaluation.
    library : ParameterLibrary, optional
        Pre-learned parameter sets of which each body has one, in place of Table 1: the variable
        ``library_index`` holds the bodies' choices, and the parameters follow from it.

    Returns
    -------
    pymc.Model
        An ordinary model, for ``pm.sample`` too.

    Raises
    ------
    EffectError
        If an effect is unknown or does not apply, or your own does not vanish at its null value.
    HistoryError
        If the history has nothing to fit at this horizon, or nothing moves in whole trajectories,
        or initial states of simulations can follow all that was measured.
    SimulationError
        If bodies start deep inside each other or a wall, or a hinge's bodies apart.
    ValueError
        If ``likelihood`` or ``sigma`` is no option, ``horizon`` is below 1 or ``nu`` is not above
        0, or an option does not go with the likelihood: a horizon, a library and a scalar sigma are
        for ``transitions``, and ``simulation`` has Gaussian noise and joints of known bodies.
    PosteriorError
        If ``likelihood`` is a posterior of other data or parameters.
    ParameterError
        If the library does not fit the scene's bodies.

    Examples
    --------
    >>> import pandas as pd
    >>> from pbrl_ppl.scene import Body, Shape
    >>> scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.2)),))
    >>> rows = pd.DataFrame({"trajectory": 0, "time": [0.0, 0.1], "body": "puck", "x": [0.0, 0.1],
    ...     "y": 0.0, "theta": 0.0, "vx": 1.0, "vy": 0.0, "omega": 0.0,
    ...     "force_x": 0.0, "force_y": 0.0, "torque": 0.0})
    >>> model = physics_model(scene, History.from_dataframe(rows, scene))
    >>> [variable.name for variable in model.free_RVs]
    ['mass', 'r', 'mu_c', 'sigma']
    """
    if isinstance(likelihood, str):
        kind, earlier = likelihood, None
    else:
        kind, earlier = PosteriorRecord.of(likelihood).likelihood_name, likelihood
    physics = Physics.declare(
        with_units(scene, history), effects, substeps=substeps, threads=threads
    )
    try_own_effects(physics, history)
    problem = declared_problem(
        physics,
        history,
        horizon=horizon,
        likelihood=TransitionLikelihood.declare(sigma, nu),
        library=library,
        kind=kind,
    )
    from pbrl_ppl.model import build_model  # PyMC takes seconds to load

    if earlier is None:
        return build_model(problem)
    problem = linearised_as(problem, earlier)
    model, mode = build_model(problem), stored_mode(problem, earlier)
    for name, value in problem.named(mode.phi, mode.sigma).items():  # pm.sample begins there
        model.set_initval(model[name], value)
    return model


def try_own_effects(physics: Physics, history: History) -> None:
    """Try the effects that are a user's own; see :func:`pbrl_ppl.physics.try_effect`."""
    scene = physics.scene
    bare = scene.replace(
        bodies=tuple(replace(body, effects=(), known=(), prior=()) for body in scene.bodies)
    )
    implied = {attached.effect.name for attached in attach(bare)}  # of actuators, for example
    known = {effect.name for effect in catalogue} | implied
    effects = {attached.effect.name: attached.effect for attached in physics.effects}
    for name in effects.keys() - known:
        try_effect(effects[name], physics.scene, history)
