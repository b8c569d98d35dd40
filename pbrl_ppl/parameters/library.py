"""Categorical prior over parameter sets learned before, in place of Table 1."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters.layout import Layout
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import Floats


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
        sets = dict(self.sets)
        if not sets:
            raise ParameterError("library: it is empty; name at least one parameter set")
        for name, values in sets.items():
            for key, value in dict(values).items():
                if not np.isfinite(value):
                    raise ParameterError(
                        f"parameter set {name!r}: {key} is {value}, expected a finite number"
                    )
        object.__setattr__(self, "sets", _frozen({k: dict(v) for k, v in sets.items()}))
        probabilities = dict(self.probabilities or {})
        nested = {k: dict(v) for k, v in probabilities.items() if isinstance(v, Mapping | tuple)}
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
        object.__setattr__(self, "probabilities", _frozen(probabilities) if probabilities else None)

    @classmethod
    def from_json(cls, text: str) -> ParameterLibrary:
        """Read what :meth:`to_json` wrote."""
        return cls(*json.loads(text))

    def to_json(self) -> str:
        """Return the library as JSON, for a posterior file."""
        probabilities = {
            k: dict(v) if isinstance(v, tuple) else v for k, v in self.probabilities or ()
        }
        return json.dumps(
            [{name: dict(values) for name, values in self.sets}, probabilities or None]
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sets, in the order of the index."""
        return tuple(name for name, _ in self.sets)

    def prior(self, body: str) -> Floats:
        """Return the probability of each set for a body or class, shape (set,)."""
        probabilities: dict[str, Any] = dict(self.probabilities or {})
        if any(isinstance(value, tuple) for value in probabilities.values()):
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
        for block in layout.blocks:
            if block.of == "joint":
                raise ParameterError(
                    f"library: the joint {block.owners[0]} is to be inferred, and a library"
                    " is of bodies; say in the scene what the joint is"
                )
            for owner, law in zip(block.owners, block.priors, strict=True):
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


def _frozen(mapping: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple((k, _frozen(v) if isinstance(v, Mapping) else v) for k, v in mapping.items())
