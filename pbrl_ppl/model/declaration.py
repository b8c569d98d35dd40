"""The pm.Model of a problem: Table 1 prior, Eq. 11 likelihood, named coordinates."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor import shared
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable
from scipy.special import i0e

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import (
    ACCELERATION,
    ACTION_DIMS,
    NEXT_STATE_DIMS,
    START_DIMS,
    Problem,
    is_filtered,
    variable_coords,
    variable_dims,
)
from pbrl_ppl.model.op import LogLikelihoodOp, SimulatorOp
from pbrl_ppl.parameters import Block, Layout, ParameterLibrary, Prior
from pbrl_ppl.state import Floats

with warnings.catch_warnings():  # PyMC 5 imports ArviZ 0.23, which announces 1.0 once a day
    warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing", FutureWarning)
    import pymc as pm
    from pymc.distributions.distribution import _support_point
    from pymc.logprob.abstract import _logprob


def build_model(problem: Problem) -> pm.Model:
    """Declare the pm.Model of a problem; see :func:`pbrl_ppl.physics_model`."""
    observations, segments, physics = problem.observations, problem.segments, problem.physics
    sensitivity, dims = problem.likelihood.sensitivity, variable_dims(problem)
    with pm.Model(coords=variable_coords(problem)) as model:
        start = pm.Data("start", segments.start, dims=START_DIMS)
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
        sigma = _noise(problem)
        # Eq. 7: s' = f(s, a; Phi) + eps, and Eq. 11
        columns = list(observations.columns)
        predicted = SimulatorOp(physics, sensitivity)(phi, start, actions)[..., columns]
        # bodies of independent parts never meet in the likelihood; in draws they may
        whole = predicted
        if len(problem.physics.simulator.parts) > 1:
            world = SimulatorOp(physics, sensitivity, one_world=True)
            whole = world(phi, start, actions)[..., columns]
        _NextState(
            "next_state", predicted, whole, sigma, phi,
            problem=problem, observed=np.nan_to_num(problem.measured), dims=NEXT_STATE_DIMS,
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
        problem: Problem = observed[0].problem
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


def _noise(problem: Problem) -> TensorVariable:
    """Declare the noise parameters, shape (parameter,)."""
    median, spread = problem.noise_prior
    if problem.likelihood.scalar:
        scalar = pm.LogNormal("sigma", mu=np.log(median).mean(), sigma=spread)
        return pt.ones(len(median)) * scalar
    if not is_filtered(problem):
        return pm.LogNormal("sigma", mu=np.log(median), sigma=spread, dims="state")
    parts, mu = [pt.zeros(0)], np.log(median)
    for name, names in problem.noise_variables.items():
        centre, dims = mu[: len(names)], variable_dims(problem)[name]
        if name == ACCELERATION:
            variable = pm.Exponential(name, scale=np.exp(centre) / np.log(2.0), dims=dims)
        else:
            variable = pm.LogNormal(name, mu=centre, sigma=spread, dims=dims)
        parts.append(variable)
        mu = mu[len(names) :]
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
    __props__ = (*RandomVariable.__props__, "problem")

    def __init__(self, problem: Problem, **settings: Any) -> None:
        super().__init__(**settings)
        self.problem = problem

    def rng_fn(
        self,
        rng: np.random.Generator,
        predicted: Floats,
        whole: Floats,
        sigma: Floats,
        phi: Floats,
        size: object = None,
    ) -> Floats:
        """Draw measurements."""
        linearised = np.nan_to_num(self.problem.observations.values)
        return self.problem.likelihood.random(whole, linearised, sigma, rng, self.problem.nu(phi))


class _NextState(pm.Distribution):
    """Distribution of `_NextStateRV`."""

    rv_type = _NextStateRV

    @classmethod
    def dist(cls, *parameters: TensorVariable, **options: Any) -> TensorVariable:
        """Return a variable with this distribution."""
        return super().dist(parameters, **options)

    @classmethod
    def rv_op(
        cls, *parameters: TensorVariable, problem: Problem, size: object = None, rng: object = None
    ) -> TensorVariable:
        """Return a variable."""
        rng = shared(np.random.default_rng()) if rng is None else rng
        return _NextStateRV(problem).make_node(rng, size, *parameters).default_output()


@_logprob.register(_NextStateRV)
def _log_likelihood(  # type: ignore[no-untyped-def]
    op, values, rng, size, predicted, whole, *noise, **options
):
    return LogLikelihoodOp(op.problem)(values[0], predicted, *noise)


@_support_point.register(_NextStateRV)
def _expected(op, variable, rng, size, predicted, *parameters):  # type: ignore[no-untyped-def]
    return predicted


#: Above this concentration the von Mises density of PyMC 5 overflows; PyMC wants a concentration
#: above 0, and at this one the density is uniform to the last digit.
_SHARP, _LEVEL = 500.0, 1e-12


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
    kappa = np.maximum(kappa, _LEVEL)
    if kappa.max() <= _SHARP:
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
