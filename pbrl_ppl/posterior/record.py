"""Record of a fit: all but arrays that a posterior file holds, and the mode that it stores."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import cache
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from pbrl_ppl.effects import Effect, attach, catalogue
from pbrl_ppl.errors import PbrlError, PosteriorError
from pbrl_ppl.likelihood import (
    Coordinates,
    Problem,
    TrajectoryLikelihood,
    TransitionLikelihood,
    log_posterior,
    noise_labels,
)
from pbrl_ppl.modes import near_mode
from pbrl_ppl.parameters import Layout, ParameterLibrary, nearest
from pbrl_ppl.physics import Physics, build_layout
from pbrl_ppl.posterior.store import SCHEMA, Idata, check_schema, draws
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats, Ints

#: A JSON object.
JsonObject = Mapping[str, Any]


@dataclass(frozen=True)
class StoredMode:
    """Mode (MAP) of a posterior as its file holds it.

    Parameters
    ----------
    parameters : mapping of str to float
        By label, such as ``mass[cart]``, SI units.
    noise : mapping of str to float
        By label, such as ``sigma[vx]``, or ``sigma`` where it is one number.
    log_posterior : float
        Log-posterior density there, up to the evidence (nats).
    sets : mapping of str to str, optional
        Parameter set of each body or class, in a model with a library.
    """

    parameters: Mapping[str, float]
    noise: Mapping[str, float]
    log_posterior: float
    sets: Mapping[str, str] | None = None


@dataclass(frozen=True, eq=False)
class ParameterPoint:
    """A point of the parameter space.

    Parameters
    ----------
    phi : ndarray
        Parameters in the layout's order, shape (p,), SI units.
    sigma : ndarray
        Noise parameters, shape (state,).
    choice : ndarray of int, optional
        Index of each owner's parameter set in the library, shape (owner,), if there is one.
    """

    phi: Floats
    sigma: Floats
    choice: Ints | None = None


@dataclass(frozen=True)
class LinearisationCheck:
    """Check of the smoothed states' linearisation, at some draws.

    Parameters
    ----------
    draws : int
        How many.
    sd, largest : float
        Standard deviation of the differences of the log-likelihood from that with the states
        smoothed at the draw, and the largest from their mean (nats).
    trajectory : int
        The one, from 0, whose differences vary most.
    """

    draws: int
    sd: float
    largest: float
    trajectory: int


@dataclass(frozen=True, eq=False)
class PosteriorRecord:
    """Everything but arrays that a posterior file holds: model, data, method and diagnostics.

    Each field is an attribute of the file under the same name, as text, a number or JSON; one that
    is None is left out. The attribute ``schema`` is the version of this list.

    Parameters
    ----------
    scene : Scene
        The scene that was fitted, with the effects that were added to it.
    effects : tuple of (str, str)
        Name and body of each effect of the model, declared or added.
    horizon : int
        Intervals predicted from one measured state.
    substeps : int
        Engine steps an interval.
    together : tuple of str
        Bodies that are simulated in one world whatever the history says.
    measured : tuple of str
        State dimensions that the likelihood is over.
    scalar_sigma : bool
        Whether one sigma is that of all state dimensions.
    sigma_prior : tuple
        Medians of the noise parameters' prior, and the standard deviation of their logarithm.
    data_sha256 : str
        Hash of the history.
    seed : int
        Seed of the fit.
    versions : mapping of str to str
        Versions of Python and of the packages that the fit depends on.
    method : str
        The sampler's name.
    likelihood : str, optional
        Name of the likelihood; see :func:`pbrl_ppl.physics_model`.
    nu : float, optional
        Degrees of freedom of Student-t noise; Gaussian without it.
    library : ParameterLibrary, optional
        Parameter sets of which each body has one.
    cells : Coordinates, optional
        Which noise parameter each coordinate is subject to, where the fit is of whole trajectories.
    mode : StoredMode, optional
        The posterior's mode.
    linearisation : LinearisationCheck, optional
        Check of the smoothed states' linearisation.
    configurations : tuple of mapping, optional
        Which bodies the joints may join, and the probability of each choice.
    updates : tuple of mapping, optional
        One entry for each :func:`pbrl_ppl.update`.
    max_rhat, min_ess : float, optional
        Largest R-hat and smallest effective sample size of a parameter.
    warnings : tuple of str, optional
        Warnings of the fit.
    interrupted : bool, optional
        True if an interrupt left fewer draws than were asked for.
    pareto_k, importance_ess : float, optional
        Of draws by importance sampling: Pareto k of the proposals' weights, and the effective
        sample size of the resampled draws, which limits every parameter's ESS.
    proposals : str, optional
        The density that was weighted: Gaussians at the modes; of older posteriors also that of few
        engine steps. Why other draws were taken where weights did not suffice.
    log_evidence : float, optional
        Of the model, about the modes that were found.
    tolerance : float, optional
        Largest error of a step of bodies that choose their own steps: a field of
        :class:`pbrl_ppl.physics.Physics`.
    not_separable : tuple of tuple of str, optional
        Groups of effects, such as ``spring on cart``, that the recording cannot separate.
    """

    scene: Scene
    effects: tuple[tuple[str, str], ...]
    horizon: int
    substeps: int
    together: tuple[str, ...]
    measured: tuple[str, ...]
    scalar_sigma: bool
    sigma_prior: tuple[tuple[float, ...], float]
    data_sha256: str
    seed: int
    versions: Mapping[str, str]
    method: str
    likelihood: str | None = None
    nu: float | None = None
    library: ParameterLibrary | None = None
    cells: Coordinates | None = None
    mode: StoredMode | None = None
    linearisation: LinearisationCheck | None = None
    configurations: tuple[JsonObject, ...] | None = None
    updates: tuple[JsonObject, ...] | None = None
    max_rhat: float | None = None
    min_ess: float | None = None
    warnings: tuple[str, ...] | None = None
    interrupted: bool | None = None
    pareto_k: float | None = None
    importance_ess: float | None = None
    proposals: str | None = None
    log_evidence: float | None = None
    tolerance: float | None = None
    not_separable: tuple[tuple[str, ...], ...] | None = None

    @classmethod
    def of(cls, idata: Idata) -> PosteriorRecord:
        """Return the record of a posterior.

        Raises
        ------
        PosteriorError
            If the posterior has another schema version or lacks a field.
        """
        check_schema(idata.attrs, "posterior")
        needed = [field.name for field in fields(cls) if field.default is not None]
        if missing := [name for name in needed if name not in idata.attrs]:
            raise PosteriorError(
                f"posterior: it does not say its {', '.join(missing)}; make it with pbrl_ppl.fit"
            )
        return cls(**stored_fields(idata))

    def attributes(self) -> dict[str, object]:
        """Return the attributes of the file: plain text, numbers and JSON."""
        written = {
            name: _written(kind, value)
            for name, kind in _kinds(PosteriorRecord).items()
            if (value := getattr(self, name)) is not None
        }
        return {"pbrl_ppl": "posterior", "schema": SCHEMA, **written}

    def write(self, idata: Idata) -> None:
        """Write the record into the attributes of a posterior."""
        idata.attrs.update(self.attributes())

    @property
    def likelihood_name(self) -> str:
        """Name of the likelihood, of files that do not say it too."""
        named = TransitionLikelihood if self.cells is None else TrajectoryLikelihood
        return self.likelihood or named.name

    @property
    def noise_variables(self) -> dict[str, tuple[str, ...]]:
        """Variables of the noise, and the state dimensions of each, in the order of sigma."""
        return {"sigma": self.measured} if self.cells is None else self.cells.variables

    def physics(self, effects: Iterable[Effect], threads: int = 1) -> Physics:
        """Return the physics that was fitted, its effects looked up among ``effects`` by name.

        Raises
        ------
        EffectError
            If one is not among them.
        """
        laws = attach(self.scene, (), effects)
        tolerance = Physics.tolerance if self.tolerance is None else self.tolerance
        return Physics(
            self.scene, laws, self.substeps, threads, tolerance=tolerance, together=self.together
        )

    @property
    def noise_labels(self) -> tuple[str, ...]:
        """Labels of the noise parameters, such as ``sigma[x]``; ``sigma`` for a scalar."""
        return noise_labels(self.noise_variables, self.scalar_sigma)

    def mode_vectors(self, layout: Layout) -> tuple[Floats, Floats]:
        """Return the mode as vectors: phi, shape (p,), and sigma, shape (noise parameter,).

        Raises
        ------
        PosteriorError
            If the posterior holds no mode, or the mode lacks a parameter.
        """
        if self.mode is None:
            raise PosteriorError("posterior: it holds no mode; ask for draws, or fit it again")
        values, labels = {**self.mode.parameters, **self.mode.noise}, self.noise_labels
        if missing := [label for label in (*layout.labels, *labels) if label not in values]:
            raise PosteriorError(f"posterior: its mode has no {', '.join(missing)}; fit it again")
        phi = np.array([values[label] for label in layout.labels], dtype=float)
        sigma = np.array([values[label] for label in labels])
        width = sum(map(len, self.noise_variables.values()))
        return phi, np.broadcast_to(sigma, width).copy()


def vectors(
    idata: Idata, layout: Layout, variables: Mapping[str, tuple[str, ...]]
) -> tuple[Floats, Floats]:
    """Return draws as vectors: phi, shape (draw, p), and sigma, shape (draw, noise parameter)."""
    named = draws(idata)
    n = len(next(iter(named.values())))
    sigma = np.hstack([named[name].reshape(n, -1) for name in variables])
    width = sum(map(len, variables.values()))
    return layout.to_vectors(named, n), np.broadcast_to(sigma, (n, width))


def packed_mode(
    problem: Problem, mode: ParameterPoint, phi: Floats, sigma: Floats, likelihood: Floats
) -> StoredMode:
    """Return a posterior's mode for its record.

    Where a draw is higher by 0.1 nats, the mode is climbed to again from that draw. Wheels are
    described as in the draws.

    Parameters
    ----------
    problem : Problem
        What was fitted.
    mode : ParameterPoint
        The mode as it was found.
    phi, sigma : ndarray
        Posterior draws, shapes (draw, p) and (draw, state).
    likelihood : ndarray
        Log-likelihood of each draw, shape (draw,).
    """
    value = float(log_posterior(problem, mode.phi, mode.sigma, mode.choice))
    if problem.library is None and not problem.layout.discrete.any():
        draws = log_posterior(problem, phi, sigma, log_likelihood=likelihood)
        best = int(np.argmax(draws))
        if draws[best] > value + 0.1:
            climbed = near_mode(problem, phi[best])
            if climbed.log_posterior > value:
                mode, value = ParameterPoint(climbed.phi, climbed.sigma), climbed.log_posterior
    return _packed(problem, mode, value, phi)


def updated_mode(
    problem: Problem,
    earlier: ParameterPoint,
    draws: tuple[Floats, Floats, Ints | None],
    likelihood: Floats,
) -> StoredMode:
    """Return the mode of an updated posterior.

    It is climbed to from the earlier mode. Over a library or joints of unknown bodies there is no
    climb: there it is the draw of highest density.

    Parameters
    ----------
    problem : Problem
        Of all data.
    earlier : ParameterPoint
        The mode of the earlier data.
    draws : tuple
        Phi, shape (draw, p), sigma, shape (draw, state), and over a library the index of each
        owner's parameter set, shape (draw, owner).
    likelihood : ndarray
        Log-likelihood of each draw, shape (draw,).
    """
    phi, sigma, choice = draws
    if problem.library is None and not problem.layout.discrete.any():
        mode = near_mode(problem, earlier.phi)
        return _packed(problem, ParameterPoint(mode.phi, mode.sigma), mode.log_posterior, phi)
    value = log_posterior(problem, phi, sigma, choice, log_likelihood=likelihood)
    i = int(np.argmax(value))
    best = ParameterPoint(phi[i], sigma[i], None if choice is None else choice[i])
    return _packed(problem, best, float(value[i]), phi)


def _packed(problem: Problem, mode: ParameterPoint, value: float, draws: Floats) -> StoredMode:
    """Return a point for a record, its wheels described as in draws (draw, p)."""
    layout, point, sets = problem.layout, mode.phi, None
    if problem.library is None:
        point = nearest(layout, point[None], draws)[0]
    elif mode.choice is not None:
        chosen = (problem.library.names[i] for i in mode.choice)
        sets = dict(zip(problem.scene.owners, chosen, strict=True))
    return StoredMode(
        dict(zip(layout.labels, point.tolist(), strict=True)),
        dict(zip(problem.noise_labels, mode.sigma.tolist(), strict=False)),  # a scalar is repeated
        value,
        sets,
    )


def stored_mode(problem: Problem, idata: Idata) -> ParameterPoint:
    """Return the mode that a posterior holds, in the order of the problem's layout.

    Parameters
    ----------
    problem : Problem
        Of the posterior.
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, or loaded.

    Raises
    ------
    PosteriorError
        If it holds no mode, or the mode lacks a parameter of the problem.
    """
    record = PosteriorRecord.of(idata)
    phi, sigma = record.mode_vectors(problem.layout)
    choice = None
    if problem.library is not None and record.mode is not None and record.mode.sets is not None:
        names = [record.mode.sets[owner] for owner in problem.scene.owners]
        choice = np.array([problem.library.names.index(name) for name in names], dtype=np.intp)
    return ParameterPoint(phi, sigma, choice)


def scene_of(idata: Idata) -> Scene:
    """Return the scene that a posterior was fitted with, added effects included.

    Raises
    ------
    PosteriorError
        If there is none.
    """
    scene: Scene | None = stored_fields(idata, ("scene",)).get("scene")
    if scene is None:
        raise PosteriorError("posterior: it holds no scene; make it with pbrl_ppl.fit")
    return scene


def layout_of(idata: Idata, effects: Iterable[Effect] = catalogue) -> Layout:
    """Return the layout of a posterior's parameters."""
    scene = scene_of(idata)
    return build_layout(scene, attach(scene, (), effects))


def stored_fields(idata: Idata, names: Iterable[str] | None = None) -> dict[str, Any]:
    """Return fields of the record that a posterior's attributes hold, all or some, by name."""
    kinds, read = _kinds(PosteriorRecord), {}
    for name in kinds if names is None else names:
        if name in idata.attrs:
            try:
                read[name] = _read(kinds[name], idata.attrs[name])
            except PbrlError:
                raise
            except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
                raise PosteriorError(
                    f"posterior: its attribute {name} cannot be read; fit it again"
                ) from None
    return read


@cache
def _kinds(record: type) -> dict[str, object]:
    """Return the types of a dataclass's fields, without the None of an optional one."""
    kinds = get_type_hints(record)
    for name, kind in kinds.items():
        if type(None) in get_args(kind):
            (kinds[name],) = set(get_args(kind)) - {type(None)}
    return kinds


#: How fields of these types are read from an attribute, and written to one.
_PLAIN: Mapping[object, tuple[Callable[..., object], Callable[..., object]]] = {
    Scene: (Scene.from_toml, Scene.to_toml),
    ParameterLibrary: (ParameterLibrary.from_json, ParameterLibrary.to_json),
    bool: (bool, int),  # NetCDF has no such attribute
    int: (int, int),
    float: (float, float),
    str: (str, str),
}


def _read(kind: object, value: object) -> object:
    """Return a field from its attribute, by its type."""
    return _PLAIN[kind][0](value) if kind in _PLAIN else _from_json(kind, json.loads(str(value)))


def _from_json(kind: object, value: Any) -> Any:
    """Return a value of a type from what JSON holds of it."""
    if isinstance(kind, type) and is_dataclass(kind):
        kinds = _kinds(kind)
        values = {
            name: _from_json(kinds[name], entry) for name, entry in value.items() if name in kinds
        }  # of earlier versions there may be more
        if kind is Coordinates:  # no row has no columns in JSON
            values["push"] = values["push"].reshape(-1, len(values["places"]))
        return kind(**values)
    if kind in (Ints, Floats):
        return np.array(value, dtype=np.int64 if kind == Ints else float)
    if get_origin(kind) is tuple:
        return tuple(tuple(item) if isinstance(item, list) else item for item in value)
    return value


def _written(kind: object, value: object) -> object:
    """Return a field as an attribute, by its type."""
    if kind in _PLAIN:
        return _PLAIN[kind][1](value)
    if is_dataclass(value):
        value = {name: v for name, v in asdict(value).items() if v is not None}  # type: ignore[arg-type]
    return json.dumps(value, default=np.ndarray.tolist)
