"""Layout of phi: names of the unknown parameters; vectors of values, and libraries of them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters.priors import Prior, prior_draws
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import Bools, Floats

#: Table 1's names for one body, in the order of Eq. 8, with units.
BODY_PARAMETERS: Mapping[str, str] = dict(
    mass="kg", r="1", mu_c="1", w_x="m", w_y="m", w_theta="rad", mu_x="1", mu_y="1"
)
WHEEL_PARAMETERS = ("w_x", "w_y", "w_theta", "mu_x", "mu_y")
#: Table 1's names for one joint: which bodies it joins, and where in each one's frame, with units.
JOINT_INDICES = ("i_a", "i_b")
JOINT_ANCHORS: Mapping[str, str] = {"a_x": "m", "a_y": "m", "b_x": "m", "b_y": "m"}


@dataclass(frozen=True)
class Block:
    """One named parameter over the bodies, or joints, that have it.

    Parameters
    ----------
    name : str
        Variable name, e.g. ``mass`` or ``linear_drag_coefficient``.
    owners : tuple of str
        The bodies in the scene's order, or the joints; the length of the variable. Bodies that
        share Table 1's parameters are one owner, under the name of their class.
    unit : str
        SI unit.
    priors : tuple of Prior
        One an owner.
    effect : str, optional
        The effect that the parameter belongs to; None for Table 1.
    of : str
        ``body`` or ``joint``.
    conditional : tuple of tuple of Prior
        For an anchor: an owner's prior if its index is 0, 1, ...; the support is the bounds of the
        body that the index names. Empty for all others.
    """

    name: str
    owners: tuple[str, ...]
    unit: str
    priors: tuple[Prior, ...]
    effect: str | None = None
    of: str = "body"
    conditional: tuple[tuple[Prior, ...], ...] = ()


@dataclass(frozen=True)
class Layout:
    """The order in which unknown parameters stand in the vector phi.

    Parameters
    ----------
    blocks : tuple of Block
        Named parameters; the vector is their concatenation.
    """

    blocks: tuple[Block, ...]

    def __getstate__(self) -> dict[str, object]:
        """Return the blocks alone: cached properties are computed again."""
        return {"blocks": self.blocks}

    def subset(self, owners: Iterable[str]) -> Layout:
        """Return the layout of the parameters of these bodies and joints alone."""
        kept, blocks = set(owners), []
        for block in self.blocks:
            places = [i for i, owner in enumerate(block.owners) if owner in kept]
            if places:
                conditional = tuple(block.conditional[i] for i in places if block.conditional)
                names = tuple(block.owners[i] for i in places)
                priors = tuple(block.priors[i] for i in places)
                blocks.append(replace(block, owners=names, priors=priors, conditional=conditional))
        return Layout(tuple(blocks))

    @cached_property
    def entries(self) -> tuple[tuple[Block, str, Prior], ...]:
        """Block, owner and prior of each entry."""
        return tuple(
            (block, owner, prior)
            for block in self.blocks
            for owner, prior in zip(block.owners, block.priors, strict=True)
        )

    @property
    def size(self) -> int:
        """Length of the vector."""
        return len(self.entries)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """One readable label an entry, such as ``mass[cart]``."""
        return tuple(f"{block.name}[{owner}]" for block, owner, _ in self.entries)

    @cached_property
    def priors(self) -> tuple[Prior, ...]:
        """One prior an entry."""
        return tuple(prior for *_, prior in self.entries)

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper end of each entry's support, shape (p,) each."""
        support = np.array([prior.support for prior in self.priors]).reshape(-1, 2)
        return support[:, 0], support[:, 1]

    def supports(self, phi: Floats) -> tuple[Floats, Floats]:
        """Return the ends of each entry's support at phi, shape (n, p) each.

        An anchor's support depends on its index.

        Parameters
        ----------
        phi : ndarray
            Shape (n, p).
        """
        lower, upper = (np.tile(end, (len(phi), 1)) for end in self.bounds)
        for place, index, number, prior in self._conditional():
            here = phi[:, index] == number
            lower[here, place], upper[here, place] = prior.support
        return lower, upper

    def log_prior(self, phi: Floats) -> Floats:
        """Return the log-density of each entry; an anchor's prior depends on its index.

        Parameters
        ----------
        phi : ndarray
            Shape (..., p).

        Returns
        -------
        ndarray
            Shape (..., p): sums over it, or over some entries, are joint log-densities.
        """
        result = np.empty(np.shape(phi))
        for i, prior in enumerate(self.priors):
            result[..., i] = prior.log_density(phi[..., i])
        for place, index, number, prior in self._conditional():
            chosen = phi[..., index] == number
            result[chosen, place] = prior.log_density(phi[chosen, place])
        return result

    def prior_draws(self, rng: np.random.Generator, n: int) -> Floats:
        """Return draws from the prior, shape (n, p); an anchor's prior depends on its index."""
        phi = prior_draws(self.priors, rng, n)
        for place, index, number, prior in self._conditional():
            here = phi[:, index] == number
            phi[here, place] = prior.sample(rng, int(here.sum()))
        return phi

    def _conditional(self) -> Iterator[tuple[int, int, int, Prior]]:
        """Yield the places of each anchor of unknown bodies and of its index, and each prior.

        With the prior comes the value of the index to which it belongs.
        """
        for block in self.blocks:
            side = f"i_{block.name[0]}"
            for owner, conditional in zip(block.owners, block.conditional, strict=False):
                if f"{side}[{owner}]" in self.labels:
                    place, index = self.index(block.name, owner), self.index(side, owner)
                    yield from ((place, index, i, prior) for i, prior in enumerate(conditional))

    def scale(self, phi: Floats) -> Floats:
        """Return the scale of each entry of phi for step sizes, shape (p,); 0 if discrete."""
        least = np.array([prior.scale for prior in self.priors])
        counts = [block.unit == "1" for block, *_ in self.entries]
        least[counts] = np.minimum(least[counts], 1.0)
        return np.where(self.discrete, 0.0, np.maximum(np.abs(phi - self.origin), 0.1 * least))

    @property
    def origin(self) -> Floats:
        """Where each entry is counted from, shape (p,): a normal prior's mean, such as of a place.

        Of others it is zero.
        """
        return np.array([prior.mu if prior.family == "normal" else 0.0 for prior in self.priors])

    def slices(self) -> Iterator[tuple[Block, slice]]:
        """Yield each block with its place in the vector."""
        begin = 0
        for block in self.blocks:
            yield block, slice(begin, begin + len(block.owners))
            begin += len(block.owners)

    @property
    def discrete(self) -> Bools:
        """Which entries are discrete, indices of names, shape (p,)."""
        return np.array([prior.discrete for prior in self.priors], dtype=bool)

    def index(self, name: str, owner: str) -> int:
        """Return the place of a parameter of a body, or joint, in the vector.

        Raises
        ------
        ParameterError
            If the layout has no such parameter.
        """
        label = f"{name}[{owner}]"
        if label not in self.labels:
            raise ParameterError(
                f"parameter {label} is not among the unknown ones: {', '.join(self.labels)}"
            )
        return self.labels.index(label)

    def places(self, labels: Iterable[str]) -> list[int]:
        """Return the places of labels in the vector."""
        return [self.labels.index(label) for label in labels]

    def to_vector(self, values: Mapping[str, object]) -> Floats:
        """Return the vector phi, shape (p,), of named values, scalars or (owner,) arrays.

        Raises
        ------
        ParameterError
            If a name is missing, or a value has the wrong length.
        """
        vector = np.empty(self.size)
        for block, place in self.slices():
            if block.name not in values:
                raise ParameterError(f"parameter {block.name} is missing; add it to the values")
            value = np.asarray(values[block.name], dtype=float)
            if value.size not in (1, len(block.owners)):
                raise ParameterError(
                    f"parameter {block.name} has {value.size} values, expected"
                    f" {len(block.owners)}, one for each of {', '.join(block.owners)}"
                )
            vector[place] = value.ravel()
        return vector

    def from_layout(self, other: Layout, phi: Floats) -> Floats:
        """Return another layout's values, priors' centres where it has none, shape (p,)."""
        known = dict(zip(other.labels, phi.tolist(), strict=True))
        pairs = zip(self.labels, self.priors, strict=True)
        return np.array([known.get(label, prior.centre) for label, prior in pairs])

    def to_vectors(self, draws: Mapping[str, Floats], n: int) -> Floats:
        """Return vectors, shape (n, p), of ``n`` named draws, shape (n, owner) each."""
        columns = [draws[block.name].reshape(n, -1) for block in self.blocks]
        return np.hstack([np.zeros((n, 0)), *columns])

    def columns(self, draws: Mapping[str, Floats]) -> Floats:
        """Return vectors, shape (n, p), of draws by label, shape (n,) each; NaN where one lacks."""
        n = len(next(iter(draws.values()), ()))
        phi = np.full((n, self.size), np.nan)
        for place, label in enumerate(self.labels):
            if label in draws:
                phi[:, place] = draws[label]
        return phi

    def to_dict(self, vector: Floats) -> dict[str, Floats]:
        """Return named arrays, shape (..., owner), of phi, shape (..., p)."""
        return {block.name: vector[..., place] for block, place in self.slices()}


@dataclass(frozen=True)
class ParameterLibrary:
    """Named parameter sets of which each body has one: the paper's categorical prior.

    Parameters
    ----------
    sets : mapping of str to mapping of str to float
        For each set its parameters by name, SI units, such as
        ``{"cart": {"mass": 8.0, "mu_x": 0.05, ...}, "table": {...}}``. A body takes those that it
        has; what the scene knows of it stays as it is.
    probabilities : mapping, optional
        Of the sets by name, ``{"cart": 0.7, "table": 0.3}``, or for each body its own,
        ``{"sofa": {"table": 1.0}}``; sets left out have none, bodies left out and all bodies
        without it take every set as likely. They are scaled to add up to one. Bodies of one class
        with equal attributes have one choice, under the class's name (`Body.owner`).

    Raises
    ------
    ParameterError
        If there is no set, or a value or probability is not a finite number.

    Examples
    --------
    >>> sets = {"light": {"mass": 2.0}, "heavy": {"mass": 9.0}}
    >>> library = ParameterLibrary(sets, {"light": 3, "heavy": 1})
    >>> library.names
    ('light', 'heavy')
    >>> library.prior("sofa")
    array([0.75, 0.25])
    """

    sets: Any
    probabilities: Any = None

    def __post_init__(self) -> None:
        """Freeze the mappings."""
        sets = {name: dict(values) for name, values in dict(self.sets).items()}
        if not sets:
            raise ParameterError("library: it is empty; name at least one parameter set")
        for name, parameters in sets.items():
            for key, value in parameters.items():
                if not np.isfinite(value):
                    raise ParameterError(
                        f"parameter set {name!r}: {key} is {value}, expected a finite number"
                    )
        object.__setattr__(self, "sets", tuple((k, tuple(v.items())) for k, v in sets.items()))
        probabilities = dict(self.probabilities or {})
        nested = {k: dict(v) for k, v in probabilities.items() if _of_body(v)}
        by_set = {k: v for k, v in probabilities.items() if k not in nested}
        if by_set and nested:
            raise ParameterError(
                "library: probabilities are by set or by body, not both; give each body's own"
            )
        for where, weights in ({"the library": by_set} if by_set else nested).items():
            wrong = [name for name in weights if name not in self.names]
            if wrong:
                raise ParameterError(
                    f"probabilities of {where}: there is no set {wrong[0]!r}"
                    f"{nearest(wrong[0], self.names)}"
                )
            values = np.array(list(weights.values()), dtype=float)
            if not (np.isfinite(values).all() and (values >= 0).all() and values.sum() > 0):
                raise ParameterError(
                    f"probabilities of {where} are {', '.join(f'{v:g}' for v in values)}; expected"
                    " none below 0, and some above"
                )
        frozen = (*by_set.items(), *((k, tuple(v.items())) for k, v in nested.items()))
        object.__setattr__(self, "probabilities", frozen or None)

    @classmethod
    def from_json(cls, text: str) -> ParameterLibrary:
        """Read what :meth:`to_json` wrote."""
        return cls(*json.loads(text))

    def to_json(self) -> str:
        """Return the library as JSON, for a posterior file."""
        probabilities = {k: dict(v) if _of_body(v) else v for k, v in self.probabilities or ()}
        sets = {name: dict(values) for name, values in self.sets}
        return json.dumps([sets, probabilities or None])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sets, in the order of the index."""
        return tuple(name for name, _ in self.sets)

    def prior(self, body: str) -> Floats:
        """Return the probability of each set for a body or class, shape (set,)."""
        probabilities: dict[str, Any] = dict(self.probabilities or {})
        if any(map(_of_body, probabilities.values())):
            probabilities = dict(probabilities.get(body, ()))
        p = np.array([float(probabilities.get(name, 0.0)) for name in self.names])
        return p / p.sum() if p.sum() else np.full(len(p), 1.0 / len(p))

    def table(self, layout: Layout, scene: Scene) -> Floats:
        """Return every entry of phi under every set, shape (p, set).

        Raises
        ------
        ParameterError
            If a joint is to be inferred, a set lacks a parameter, has one that no body has, or has
            a value that a body cannot have while the set is possible for it.
        """
        bodies = tuple(scene.owners)
        for name, _ in self.probabilities or ():
            if name not in (*bodies, *self.names):
                raise ParameterError(
                    f"probabilities: {name!r} is neither a parameter set nor a moving body or class"
                    f"{nearest(name, (*bodies, *self.names))}"
                )
        wanted = [block.name for block in layout.blocks]
        known = {key for body in scene.moving for key, _ in body.known}
        for name, values in self.sets:
            for key in dict(values):
                if key not in wanted and key not in known:
                    raise ParameterError(
                        f"parameter set {name!r} has {key!r}, which is no parameter of a body of"
                        f" the scene{nearest(key, wanted)}"
                    )
        rows = []
        for block, owner, law in layout.entries:
            if block.of == "joint":
                raise ParameterError(
                    f"library: the joint {owner} is to be inferred, and a library is of bodies; say"
                    " in the scene what the joint is"
                )
            row = [dict(values).get(block.name, np.nan) for _, values in self.sets]
            rows.append(row)
            lower, upper = law.support
            for name, value, p in zip(self.names, row, self.prior(owner), strict=True):
                where = f"parameter set {name!r}: {block.name} of body {owner!r}"
                cure = f"give the set probability 0 for {owner!r}, or correct it"
                if p and np.isnan(value):
                    raise ParameterError(f"{where} is missing; add it, or {cure}")
                if p and not (lower <= value <= upper and (value or block.name != "mass")):
                    raise ParameterError(
                        f"{where} is {value:g} {block.unit}, expected {lower:g} to {upper:g};"
                        f" {cure}"
                    )
        return np.array(rows).reshape(-1, len(self.names))


def _of_body(probability: object) -> bool:
    """Return whether an entry of a library's probabilities is of a body, with one for each set."""
    return isinstance(probability, Mapping | tuple)
