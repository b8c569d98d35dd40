"""Phi and effects -> the numbers that the engine is given for each body."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects.base import Attached
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters import BODY_PARAMETERS, Layout
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: Columns of the property array, one row a body. ``moment`` is about the centroid (kg m^2);
#: ``pivot_torque`` (N m) and ``pivot_damping`` (N m s) act in the body's hinge.
COLUMNS = (*BODY_PARAMETERS, "moment", "pivot_torque", "pivot_damping")
COLUMN = {name: i for i, name in enumerate(COLUMNS)}


def engine_properties(
    scene: Scene, effects: tuple[Attached, ...], layout: Layout, phi: Array
) -> tuple[Array, Array]:
    """Translate parameter vectors for the engine.

    Parameters
    ----------
    scene : Scene
        Gives the known parameters and the geometry.
    effects : tuple of Attached
        All effects of the model.
    layout : Layout
        Order of phi.
    phi : ndarray
        Proposals, shape (proposal, p), in SI units.

    Returns
    -------
    properties : ndarray
        Shape (proposal, body, column), columns as in :data:`COLUMNS`.
    effect_values : ndarray
        Parameters of the effects that have a force law, one after the other, shape (proposal, q).

    Raises
    ------
    ParameterError
        If a value is not finite, a mass or moment is not positive or a friction is negative; the
        message names the body.
    """
    named = layout.to_dict(phi)
    bodies_of = {block.name: block.bodies for block in layout.blocks}
    n = len(phi)

    def value(name: str, body: str) -> Array | None:
        bodies = bodies_of.get(name, ())
        return named[name][:, bodies.index(body)] if body in bodies else None

    properties = np.zeros((n, len(scene.dynamic), len(COLUMNS)))
    for i, body in enumerate(scene.dynamic):
        known = dict(body.known)
        row: dict[str, Array] = {}
        for name in COLUMNS:
            free = value(name, body.name)
            row[name] = np.full(n, known.get(name, 0.0)) if free is None else free.copy()
        row["moment"] = row["mass"] * body.shape.unit_moment
        for one in effects:
            if one.body == body.name and one.effect.modify is not None:
                one.effect.modify(row, _values(one, value, n))
        _check(body.name, row)
        for name, column in COLUMN.items():
            properties[:, i, column] = row[name]
    laws = [
        array
        for one in effects
        if one.effect.force is not None
        for array in _values(one, value, n).values()
    ]
    return properties, np.stack(laws, axis=1) if laws else np.zeros((n, 0))


def _values(one: Attached, value: Callable[[str, str], Array | None], n: int) -> dict[str, Array]:
    """Each parameter of an attached effect, shape (proposal,); null where phi does not hold it."""
    result = {}
    for parameter in one.effect.parameters:
        name = one.effect.variable(parameter)
        found = value(name, one.body)
        if found is not None and not np.isfinite(found).all():
            raise ParameterError(f"body {one.body!r}: {name} is not finite; give a finite number")
        result[parameter.name] = np.full(n, parameter.null) if found is None else found
    return result


def _check(body: str, row: Mapping[str, Array]) -> None:
    for name, values in row.items():
        if not np.isfinite(values).all():
            raise ParameterError(f"body {body!r}: {name} is not finite; give a finite number")
        if name in ("mass", "moment") and (values <= 0).any():
            raise ParameterError(
                f"body {body!r}: {name} is {values.min():g}, expected a positive number"
            )
        if (
            name in ("mu_c", "mu_x", "mu_y", "r", "pivot_torque", "pivot_damping")
            and (values < 0).any()
        ):
            raise ParameterError(
                f"body {body!r}: {name} is {values.min():g}, expected zero or more"
            )
