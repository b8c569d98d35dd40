"""The pm.Model of a problem: Table 1 prior, Eq. 11 likelihood, named coordinates."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor import shared
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable
from scipy.special import i0e

from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.errors import FitError
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import (
    ACCELERATION,
    ACTION_DIMS,
    NEXT_STATE_DIMS,
    START_DIMS,
    Problem,
    TransitionLikelihood,
    at_centre,
    is_independent,
    outlined_problem,
    try_own_effects,
    variable_coords,
    variable_dims,
)
from pbrl_ppl.model.op import LazyProblem, LogLikelihoodOp, NoiseMediansOp, PredictionOp
from pbrl_ppl.parameters import Block, Layout, ParameterLibrary, Prior
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import Idata, PosteriorRecord, linearised_as, stored_mode
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats

with warnings.catch_warnings():  # PyMC 5 imports ArviZ 0.23, which announces 1.0 once a day
    warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing", FutureWarning)
    import pymc as pm
    from pymc.logprob.abstract import _logprob


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

        The latter two are linearised about smoothed states: nothing is smoothed here.
        :func:`pbrl_ppl.fit` does it at the mode, for which it searches, and the model's first
        evaluation by PyMC at the prior's centre, which is no place to sample about. A posterior of
        the same data has their likelihood as it was linearised in that fit, and its mode as the
        initial point: give that of ``fit(model, method="map")`` before ``pm.sample``. With joints
        of unknown bodies ``simulation`` is refused.
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

    Notes
    -----
    The medians of the noise's prior follow from the data, whose units and sizes no default could
    know: a tenth of how much each state dimension changes from one row to the next for errors of
    measuring and for ``contact_acceleration`` (log-normal, with a standard deviation of 2 of the
    logarithm), and for ``unexplained_acceleration`` (exponential) a scale that exceeds a tenth of
    the bodies' accelerations with a probability of 1 %. A posterior stores them as the attribute
    ``sigma_prior``. Declare measurement noise in the scene where you know it.

    ``pm.set_data`` takes ``start``, ``actions`` and ``measured`` (NaN where nothing was measured)
    of another recording of the same shape, if its transitions are predicted from measured states
    (``transitions``) of bodies in one world. Otherwise the model's next evaluation raises a
    FitError, for the likelihood is linearised along its recording; only ``measured`` can be others
    with ``trajectories``. The prior stays as it is declared.

    A ``simulation`` counts a correlated residual as fewer measurements, and :func:`pbrl_ppl.fit`
    widens its draws to the mode's robust covariance afterwards: draws of ``pm.sample`` lack that.

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
    outline = outlined_problem(
        physics,
        history,
        horizon=horizon,
        likelihood=TransitionLikelihood.declare(sigma, nu),
        library=library,
        kind=kind,
    )
    if earlier is None:
        return build_model(outline, at_centre)
    problem = linearised_as(outline, earlier)
    model, mode = build_model(problem), stored_mode(problem, earlier)
    for name, value in problem.named(mode.phi, mode.sigma).items():  # pm.sample begins there
        model.set_initval(model[name], value)
    return model


def build_model(
    problem: Problem, linearise: Callable[[Problem], Problem] | None = None
) -> pm.Model:
    """Declare the pm.Model of a problem; see :func:`pbrl_ppl.physics_model`.

    ``linearise`` returns the problem of an outline, at the model's first evaluation.
    """
    physics, dims, lazy = problem.physics, variable_dims(problem), LazyProblem(problem, linearise)
    with pm.Model(coords=variable_coords(problem)) as model:
        start = pm.Data("start", problem.segments.start, dims=START_DIMS)
        actions = pm.Data("actions", problem.inputs, dims=ACTION_DIMS)
        # Table 1
        table1: dict[str, TensorVariable] = {}
        if problem.library is not None:
            table1 = _chosen(problem, problem.library, dims)
        else:
            for block in physics.layout.blocks:
                index = _index(block, physics.layout, table1)
                table1[block.name] = random_variable(
                    block.name, block.priors, dims[block.name], block.conditional, index
                )
        phi = pt.concatenate(list(table1.values())) if table1 else pt.zeros(0)
        # P(sigma)
        sigma = _noise(lazy)
        # Eq. 7: s' = f(s, a; Phi) + eps, and Eq. 11
        columns = list(problem.observations.columns)
        predicted = PredictionOp(lazy)(phi, start, actions)[..., columns]
        # bodies of independent parts never meet in the likelihood; in draws they may
        whole = predicted
        if len(physics.simulator.parts) > 1:
            whole = PredictionOp(lazy, one_world=True)(phi, start, actions)[..., columns]
        # no pm.Data, which refuses NaN: PyMC would infer what was not measured
        measured = shared(problem.measured, name="measured")
        model.register_data_var(measured, dims=NEXT_STATE_DIMS)
        _NextState(
            "next_state", predicted, whole, sigma, phi,
            lazy=lazy, observed=measured, dims=NEXT_STATE_DIMS,
        )  # fmt: skip
    return model


def problem_in(model: pm.Model) -> Problem:
    """Return the problem that a model was declared from; its measured variable holds it.

    Parameters
    ----------
    model : pymc.Model
        Returned by :func:`pbrl_ppl.physics_model`, or a copy.

    Raises
    ------
    FitError
        If the model is of something else, or its variables are not those of the problem.
    """
    observed = [variable.owner.op for variable in model.observed_RVs]
    if len(observed) == 1 and isinstance(observed[0], _NextStateRV):
        problem: Problem = observed[0].lazy.problem
        variables = {each.name for each in (*model.free_RVs, *model.deterministics)}
        if variables == variable_dims(problem).keys() and not model.potentials:
            return problem
        raise FitError(
            "the variables of this pm.Model were changed after physics_model; use pm.sample"
        )
    raise FitError("this pm.Model was not made by physics_model; use pm.sample for others")


def _chosen(
    problem: Problem, library: ParameterLibrary, dims: Mapping[str, tuple[str, ...]]
) -> dict[str, TensorVariable]:
    """Declare the parameter set of each body or class, and the parameters that follow from it."""
    names = tuple(problem.scene.owners)
    table = library.table(problem.layout, problem.scene)
    p = np.stack([library.prior(name) for name in names])
    index = pm.Categorical("library_index", p=p, dims=dims["library_index"])
    result = {}
    for block, place in problem.layout.slices():
        sets = index[[names.index(owner) for owner in block.owners]]
        value = pt.as_tensor(table[place])[np.arange(len(block.owners)), sets]
        result[block.name] = pm.Deterministic(block.name, value, dims=dims[block.name])
    return result


def _noise(lazy: LazyProblem) -> TensorVariable:
    """Declare the noise parameters, shape (parameter,)."""
    problem = lazy.outline
    median, spread = problem.noise_prior
    if problem.likelihood.scalar:
        scalar = pm.LogNormal("sigma", mu=np.log(median).mean(), sigma=spread)
        return pt.ones(len(median)) * scalar
    medians = pt.as_tensor(median) if is_independent(problem) else NoiseMediansOp(lazy)()
    parts, place = [pt.zeros(0)], 0
    for name, names in problem.noise_variables.items():
        centre, dims = medians[place : place + len(names)], variable_dims(problem)[name]
        if name == ACCELERATION:
            variable = pm.Exponential(name, scale=centre / np.log(2.0), dims=dims)
        else:
            variable = pm.LogNormal(name, mu=pt.log(centre), sigma=spread, dims=dims)
        parts.append(variable)
        place += len(names)
    return pt.concatenate(parts)


def _index(block: Block, layout: Layout, variables: dict[str, TensorVariable]) -> TensorVariable:
    """Return the index that selects each anchor's prior; 0 where the body is given."""
    name = f"i_{block.name[0]}"
    if not block.conditional or name not in variables:
        return None
    free = next(index_block.owners for index_block in layout.blocks if index_block.name == name)
    holders = [variables[name][free.index(owner)] if owner in free else 0 for owner in block.owners]
    return pt.stack(holders)


class _NextStateRV(RandomVariable):
    """Measured states about the predictions of one world (Eq. 11).

    A class of its own: PyMC registers one for each custom distribution, for good, with all that its
    functions hold.
    """

    name = "next_state"
    signature = "(n,h,k,d),(n,h,k,d),(m),(p)->(n,h,k,d)"
    dtype = "float64"
    _print_name = ("NextState", r"\operatorname{NextState}")
    __props__ = (*RandomVariable.__props__, "lazy")

    def __init__(self, lazy: LazyProblem, **settings: Any) -> None:
        super().__init__(**settings)
        self.lazy = lazy

    def rng_fn(self, rng: np.random.Generator, *inputs: Any) -> Floats:
        """Draw measurements, for the inputs of the variable and a size."""
        (_, whole, sigma, phi, _), problem = inputs, self.lazy.problem
        linearised = np.nan_to_num(problem.observations.values)
        return problem.likelihood.random(whole, linearised, sigma, rng, problem.nu(phi))


class _NextState(pm.Distribution):
    """Distribution of `_NextStateRV`."""

    rv_type = _NextStateRV

    @classmethod
    def dist(cls, *parameters: TensorVariable, **options: Any) -> TensorVariable:
        """Return a variable with this distribution."""
        return super().dist(parameters, **options)

    @classmethod
    def rv_op(
        cls, *parameters: TensorVariable, lazy: LazyProblem, size: object = None, rng: object = None
    ) -> TensorVariable:
        """Return a variable."""
        rng = shared(np.random.default_rng()) if rng is None else rng
        return _NextStateRV(lazy).make_node(rng, size, *parameters).default_output()


@_logprob.register(_NextStateRV)
def _log_likelihood(  # type: ignore[no-untyped-def]
    op, values, rng, size, predicted, whole, *noise, **options
):
    return LogLikelihoodOp(op.lazy)(values[0], predicted, *noise)


def random_variable(
    name: str,
    priors: tuple[Prior, ...],
    dims: str | tuple[str, ...],
    conditional: tuple[tuple[Prior, ...], ...] = (),
    index: TensorVariable | None = None,
) -> TensorVariable:
    """Declare priors of one family in the PyMC model of the context, one an owner.

    Parameters
    ----------
    name : str
        The variable's name.
    priors : tuple of Prior
        Same family, one a body or joint.
    dims : str or tuple of str
        The model's dimension over those bodies or joints.
    conditional : tuple of tuple of Prior
        For each owner its prior if its index is 0, 1, ...; see `Block`.
    index : tensor, optional
        Index variable of each owner, whole numbers, shape (owner,).
    """
    family = priors[0].family

    def hyper(key: str) -> list[float] | TensorVariable:
        if index is None:
            return [getattr(prior, key) for prior in priors]
        table = np.array([[getattr(prior, key) for prior in row] for row in conditional])
        chosen = pm.math.eq(index[:, None], np.arange(table.shape[1]))
        return pm.math.where(chosen, table, 0.0).sum(axis=1)

    mu, sigma = hyper("mu"), hyper("sigma")
    if family == "log_normal":
        return pm.LogNormal(name, mu=mu, sigma=sigma, dims=dims)
    if family == "truncated_normal":
        lower, upper = hyper("lower"), hyper("upper")
        return pm.TruncatedNormal(name, mu=mu, sigma=sigma, lower=lower, upper=upper, dims=dims)
    if family == "von_mises":
        return _von_mises(name, np.array(mu), np.array(hyper("kappa")), dims)
    if family == "normal":
        return pm.Normal(name, mu=mu, sigma=sigma, dims=dims)
    if family == "half_normal":
        if any(mu):
            return pm.TruncatedNormal(name, mu=mu, sigma=sigma, lower=0.0, dims=dims)
        return pm.HalfNormal(name, sigma=sigma, dims=dims)
    p = np.stack([prior.probabilities for prior in priors])
    return pm.Categorical(name, p=p, dims=dims)


def _von_mises(name: str, mu: Floats, kappa: Floats, dims: str | tuple[str, ...]) -> TensorVariable:
    """Declare PyMC's von Mises, or an equal density that does not overflow if it is sharp."""
    kappa = np.maximum(kappa, 1e-12)  # has to be above 0: uniform to the last digit
    if kappa.max() <= 500.0:  # PyMC 5's density overflows above
        return pm.VonMises(name, mu=mu, kappa=kappa, dims=dims)
    log_norm = np.log(2 * np.pi * i0e(kappa))
    return pm.CustomDist(
        name,
        mu,
        kappa,
        logp=lambda value, mu, kappa: kappa * (pm.math.cos(value - mu) - 1.0) - log_norm,
        dist=lambda mu, kappa, size: pm.VonMises.dist(mu, kappa, size=size),
        transform=pm.distributions.transforms.circular,
        dims=dims,
    )
