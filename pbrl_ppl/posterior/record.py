"""Record of a fit: everything in a posterior file but its arrays, in one versioned schema."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from pbrl_ppl.effects import Attached, Effect, attach, catalogue, learned_remainder
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.likelihood import Coordinates, noise_labels
from pbrl_ppl.parameters import Layout, ParameterLibrary
from pbrl_ppl.physics import build_layout
from pbrl_ppl.posterior.store import SCHEMA, check_schema, draws
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats


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
    learned_remainder : str, optional
        Table of the learned remainder among the effects.
    cells : Coordinates, optional
        Which noise parameter each coordinate is subject to, where the fit is of whole trajectories.
    mode : StoredMode, optional
        The posterior's mode.
    linearisation : mapping, optional
        Check of the smoothed states' linearisation: ``draws``, ``sd`` and ``largest`` (nats) and
        ``trajectory``, the worst one.
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
        Of draws by importance sampling: Pareto k of the proposals' weights, and the number of
        independent draws that the resampled draws are worth, which limits every parameter's ESS.
    proposals : str, optional
        The density that was weighted: Gaussians at the modes, or that of few engine steps.
    rungs : int, optional
        Rungs at which the engine moved particles, where weights alone did not suffice.
    acceptance : float, optional
        Share of those moves that were accepted; 1 without any.
    log_evidence : float, optional
        Of the model, about the modes that were found.
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
    learned_remainder: str | None = None
    cells: Coordinates | None = None
    mode: StoredMode | None = None
    linearisation: Mapping[str, Any] | None = None
    configurations: tuple[Mapping[str, Any], ...] | None = None
    updates: tuple[Mapping[str, Any], ...] | None = None
    max_rhat: float | None = None
    min_ess: float | None = None
    warnings: tuple[str, ...] | None = None
    interrupted: bool | None = None
    pareto_k: float | None = None
    importance_ess: float | None = None
    proposals: str | None = None
    rungs: int | None = None
    acceptance: float | None = None
    log_evidence: float | None = None

    @classmethod
    def of(cls, idata: Any) -> PosteriorRecord:
        """Return the record of a posterior.

        Raises
        ------
        PosteriorError
            If the posterior has another schema version or lacks a field.
        """
        attrs = idata.attrs
        check_schema(attrs, "posterior")
        needed = [field.name for field in fields(cls) if field.default is not None]
        if missing := [name for name in needed if name not in attrs]:
            raise PosteriorError(
                f"posterior: it does not say its {', '.join(missing)}; make it with pbrl_ppl.fit"
            )
        given = [field for field in fields(cls) if field.name in attrs]
        # the type's first word: "tuple[str, ...] | None" is "tuple"
        kinds = {field.name: re.split(r"\W", str(field.type))[0] for field in given}
        return cls(**{name: _READ[kind](attrs[name]) for name, kind in kinds.items()})

    def attributes(self) -> dict[str, Any]:
        """Return the attributes of the file: plain text, numbers and JSON."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        written = {name: _written(value) for name, value in values.items() if value is not None}
        return {"pbrl_ppl": "posterior", "schema": SCHEMA, **written}

    @property
    def noise_variables(self) -> dict[str, tuple[str, ...]]:
        """Variables of the noise, and the state dimensions of each, in the order of sigma."""
        return {"sigma": self.measured} if self.cells is None else self.cells.variables

    def attached(self, effects: Iterable[Effect]) -> tuple[Attached, ...]:
        """Return the model's effects, looked up among ``effects`` by name.

        Raises
        ------
        EffectError
            If one is not among them.
        """
        return _attached(self.scene, self.learned_remainder, effects)

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
    idata: Any, layout: Layout, variables: Mapping[str, tuple[str, ...]]
) -> tuple[Floats, Floats]:
    """Return draws as vectors: phi, shape (draw, p), and sigma, shape (draw, noise parameter)."""
    named = draws(idata)
    n = len(next(iter(named.values())))
    sigma = np.hstack([named[name].reshape(n, -1) for name in variables])
    width = sum(map(len, variables.values()))
    return layout.to_vectors(named, n), np.broadcast_to(sigma, (n, width))


def _attached(scene: Scene, table: str | None, effects: Iterable[Effect]) -> tuple[Attached, ...]:
    """Return the effects of a scene, and the learned remainder of a table where there is one."""
    learned = () if table is None else (learned_remainder(str(table)),)
    return attach(scene, (), (*effects, *learned))


def scene_of(idata: Any) -> Scene:
    """Return the scene that a posterior was fitted with, added effects included.

    Raises
    ------
    PosteriorError
        If there is none.
    """
    if "scene" not in idata.attrs:
        raise PosteriorError("posterior: it holds no scene; make it with pbrl_ppl.fit")
    return Scene.from_toml(str(idata.attrs["scene"]))


def layout_of(idata: Any, effects: Iterable[Effect] = catalogue) -> Layout:
    """Return the layout of a posterior's parameters."""
    scene, table = scene_of(idata), idata.attrs.get("learned_remainder")
    return build_layout(scene, _attached(scene, table, effects))


def _written(value: Any) -> Any:
    """Return a field as an attribute."""
    if isinstance(value, Scene):
        return value.to_toml()
    if isinstance(value, ParameterLibrary):
        return value.to_json()
    if isinstance(value, StoredMode):
        return json.dumps({name: v for name, v in asdict(value).items() if v is not None})
    if isinstance(value, Coordinates):
        return json.dumps({name: np.asarray(v).tolist() for name, v in asdict(value).items()})
    if isinstance(value, bool):  # NetCDF has no such attribute
        return int(value)
    return value if isinstance(value, int | float | str) else json.dumps(value)


def _cells(text: Any) -> Coordinates:
    held: dict[str, Any] = json.loads(str(text))
    kinds = {"places": np.intp, "sensor": np.intp, "pushed": np.intp, "fixed": float}
    arrays: dict[str, Any] = {
        name: np.array(held.pop(name), dtype=kind) for name, kind in kinds.items()
    }
    push = np.array(held.pop("push"), dtype=float).reshape(-1, len(arrays["places"]))
    memory = held.pop("memory")
    tuples: dict[str, Any] = {name: tuple(value) for name, value in held.items()}
    return Coordinates(**arrays, push=push, memory=memory, **tuples)


def _tuple(text: Any) -> Any:
    items = json.loads(str(text))
    return tuple(tuple(item) if isinstance(item, list) else item for item in items)


#: How attributes are read, by the type of the field.
_READ: Mapping[str, Callable[[Any], Any]] = {
    "Scene": lambda text: Scene.from_toml(str(text)),
    "ParameterLibrary": lambda text: ParameterLibrary.from_json(str(text)),
    "Coordinates": _cells,
    "StoredMode": lambda text: StoredMode(**json.loads(str(text))),
    "Mapping": lambda text: json.loads(str(text)),
    "tuple": _tuple,
    "bool": bool,
    "int": int,
    "float": float,
    "str": str,
}
