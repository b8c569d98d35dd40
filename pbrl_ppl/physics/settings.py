"""A scene, its effects and the engine's settings: what every simulation is given.

And phi's layout for it: Table 1, the univariate prior of each physical parameter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import chain
from typing import Any, Self

import numpy as np

from pbrl_ppl.effects import Attached, Effect, EffectParameter, attach, needs_inputs
from pbrl_ppl.errors import ParameterError, SimulationError
from pbrl_ppl.history import Segments
from pbrl_ppl.parameters import (
    BODY_PARAMETERS,
    JOINT_ANCHORS,
    JOINT_INDICES,
    WHEEL_PARAMETERS,
    Block,
    Layout,
    Prior,
)
from pbrl_ppl.physics import calls
from pbrl_ppl.scene import (
    CONTACT_NAMES,
    MASS_PRIOR,
    WORLD,
    Body,
    Joint,
    Scene,
    motion_time,
    nearest,
    units_of,
)
from pbrl_ppl.state import Floats

Parts = tuple[tuple[str, ...], ...]
#: Engines by name; see :class:`Physics`.
ENGINES = ("auto", "chipmunk", "contact-free")


@dataclass(frozen=True)
class PhysicsSettings:
    """Fields of :class:`Physics`, without its engines."""

    scene: Scene
    effects: tuple[Attached, ...] = ()
    substeps: int = None  # type: ignore[assignment]  # filled in below
    threads: int = 1
    extrapolate: bool = True
    tolerance: float = 1e-6
    engine: str = "auto"
    parts: Parts | None = None
    together: tuple[str, ...] = ()
    layout: Layout = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Fill in what the scene and the effects decide."""
        effects = tuple(attached.in_si(self.scene) for attached in self.effects)
        object.__setattr__(self, "effects", effects)
        if self.substeps is None:
            object.__setattr__(self, "substeps", self.scene.substeps)
        if self.layout is None:
            object.__setattr__(self, "layout", build_layout(self.scene, self.effects))
        if self.substeps < 1 or self.threads < 1:
            raise SimulationError(
                f"substeps is {self.substeps} and threads is {self.threads}; both must be at least"
                " 1"
            )
        if not 1e-12 <= self.tolerance <= 1e-2:
            raise SimulationError(f"tolerance is {self.tolerance:g}, expected 1e-12 to 1e-2")
        if self.engine not in ENGINES:
            raise SimulationError(
                f"engine is {self.engine!r}, expected one of {', '.join(ENGINES)}"
            )
        if not calls.AVAILABLE:
            raise SimulationError(calls.MISSING)

    @classmethod
    def declare(
        cls, scene: Scene, effects: Iterable[Effect | Attached] = (), **settings: object
    ) -> Self:
        """Return the physics of a scene with the effects that it declares and these.

        ``settings`` are the other fields.

        Raises
        ------
        EffectError
            If an effect is unknown or does not apply.
        """
        return cls(scene, attach(scene, effects), **settings)  # type: ignore[arg-type]

    def __getstate__(self) -> dict[str, object]:
        """Return the state to pickle: the fields, without the engine's worlds."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def inputs(self, segments: Segments) -> Floats:
        """Return what acts in segments, as far as the effects depend on it.

        Shape (transition, H, body, 3), or (transition, H, body, 9) as in
        :data:`pbrl_ppl.state.INPUT`.
        """
        return segments.inputs if needs_inputs(self.effects) else segments.actions

    @cached_property
    def coarse(self) -> Self:
        """The same with the fewest substeps, for scans, screening and first derivatives.

        There are three levels of substeps: ``coarse``, :attr:`medium` and the engine's own.
        """
        enough = max(4, self._steps_of(0.105))
        return self.changed(substeps=min(enough, self.substeps), extrapolate=False)

    @property
    def medium(self) -> Self:
        """The same with at most a medium number of substeps: for derivatives and changes."""
        return self.changed(substeps=min(max(10, self.fine_enough), self.substeps))

    @property
    def fine_enough(self) -> int:
        """Substeps that are short enough to begin with.

        Where rows are far apart, dry friction at a turning point shows with short steps alone.
        """
        return self._steps_of(0.021)

    def _steps_of(self, longest: float) -> int:
        """Return the substeps that are no longer than a share of the scene's motion time."""
        return math.ceil(self.scene.time_step / (longest * motion_time(self.scene)))

    def changed(self, **changes: object) -> Self:
        """Return the same with other fields; itself, with its engines, where they are equal."""
        if not {"scene", "effects"}.isdisjoint(changes):
            changes = {"layout": None, **changes}
        copy = replace(self, **changes)  # type: ignore[arg-type]
        return self if copy == self else copy

    def part(self, names: tuple[str, ...]) -> Self:
        """Return the physics of some moving bodies alone."""
        scene = self.scene.subset(names)
        return replace(
            self,
            scene=scene,
            effects=tuple(attached for attached in self.effects if attached.body in names),
            parts=None,
            together=(),
            layout=self.layout.subset((*names, *scene.owners, *scene.joint_names)),
        )


def table1(body: Body) -> dict[str, Prior]:
    """Table 1 for one body, uninformative by default; ``body.prior`` replaces hyper-parameters.

    Parameters
    ----------
    body : Body
        Its bounds (m) limit where the wheel can be.

    Returns
    -------
    dict of str to Prior
        One prior a parameter of Eq. 8.

    Raises
    ------
    ParameterError
        If a hyper-parameter does not belong to the parameter's family, or makes no distribution.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
    >>> table1(Body("cart", Shape.box(1.0, 0.6)))["w_x"].support
    (-0.5, 0.5)
    """
    x_min, x_max, y_min, y_max = body.shape.bounds
    share = Prior("truncated_normal", mu=0.5, sigma=1.0, lower=0.0, upper=1.0)
    priors = {
        "mass": Prior("log_normal", *MASS_PRIOR),
        "r": Prior("log_normal", mu=-1.5, sigma=1.0),
        "mu_c": share,
        "w_x": Prior("truncated_normal", sigma=x_max - x_min, lower=x_min, upper=x_max),
        "w_y": Prior("truncated_normal", sigma=y_max - y_min, lower=y_min, upper=y_max),
        "w_theta": Prior("von_mises", mu=0.0, kappa=0.0),  # uniform, as the wheel's symmetry is
        "mu_x": share,
        "mu_y": share,
    }
    return {name: declared_prior(body, name, prior) for name, prior in priors.items()}


def declared_prior(body: Body, name: str, default: Prior) -> Prior:
    """A parameter's prior with the hyper-parameters that the scene declares for it.

    Parameters
    ----------
    body : Body
        Its ``prior`` is looked at.
    name : str
        A parameter of Table 1, or an effect's variable such as ``linear_drag_coefficient``.
    default : Prior
        Gives the family, the support and what the scene leaves out.

    Raises
    ------
    ParameterError
        If a hyper-parameter does not belong to the family, or makes no distribution.
    """
    hyper: dict[str, Any] = dict(dict(body.prior).get(name, ()))
    where = f"body {body.name!r}: prior of {name}"
    for key in hyper:
        if key not in default.hyper_names:
            raise ParameterError(
                f"{where} has {key!r}, expected {' and '.join(default.hyper_names)}"
                f" ({default.family})"
            )
    try:
        return replace(default, **hyper)
    except ParameterError as error:
        raise ParameterError(f"{where}: {error}") from None


def anchor_prior(scene: Scene, holder: str, axis: int, centre: float | None = None) -> Prior:
    """Table 1 for one coordinate of a joint's anchor, on the bounds of the body that holds it.

    Parameters
    ----------
    scene : Scene
        Its extent bounds an anchor in the world.
    holder : str
        The body's name, or ``world``.
    axis : int
        0 for x, 1 for y.
    centre : float, optional
        Where the anchor is thought to be (m); the middle by default.
    """
    if holder == WORLD:
        bounds = scene.extent or _neighbourhood(scene)
    else:
        bounds = scene.body(holder).shape.bounds
    lower, upper = bounds[2 * axis : 2 * axis + 2]
    mu = (lower + upper) / 2 if centre is None else centre
    return Prior("truncated_normal", mu=mu, sigma=upper - lower, lower=lower, upper=upper)


def _neighbourhood(scene: Scene, ranges: float = 2.0) -> tuple[float, float, float, float]:
    """Return bounds of the places of dynamic bodies: ``x_min, x_max, y_min, y_max`` (m).

    They are so many ranges of a body away from its mean place.
    """
    units = [units_of(scene, body.name) for body in scene.dynamic]
    reach = np.array([ranges * unit.range for unit in units])
    x, y = np.array([(unit.x, unit.y) for unit in units]).T
    low_x, high_x, low_y, high_y = x - reach, x + reach, y - reach, y + reach
    return float(low_x.min()), float(high_x.max()), float(low_y.min()), float(high_y.max())


def index_priors(scene: Scene, joint: Joint) -> tuple[Prior, Prior]:
    """Table 1 for ``i_a`` and ``i_b`` of a joint of unknown bodies.

    Parameters
    ----------
    scene : Scene
        Its ``joinable`` are what the indices count.
    joint : Joint
        Its ``prior`` says how probable each is.
    """
    declared = {index: dict(table) for index, table in joint.prior}
    upper = float(len(scene.joinable) - 1)

    def prior(index: str) -> Prior:
        names = scene.joinable if index in declared else ()
        weights = tuple(declared[index].get(name, 0.0) for name in names)
        return Prior("categorical", lower=0.0, upper=upper, weights=weights)

    index_a, index_b = JOINT_INDICES
    return prior(index_a), prior(index_b)


def _joint_blocks(scene: Scene) -> list[Block]:
    """Table 1's parameters of the joints that are to be inferred."""
    named = zip(scene.joint_names, scene.joints, strict=True)
    joints = [(name, joint) for name, joint in named if not joint.known]
    if not joints:
        return []
    free = tuple(name for name, joint in joints if joint.bodies is None)
    indices = [index_priors(scene, joint) for _, joint in joints if joint.bodies is None]
    blocks = [
        Block(name, free, "1", priors, of="joint")
        for name, priors in zip(JOINT_INDICES, zip(*indices, strict=True), strict=False)
    ]
    for column, (name, unit) in enumerate(JOINT_ANCHORS.items()):
        side, axis = divmod(column, 2)
        conditional = []
        for _, joint in joints:
            holders = scene.joinable
            if joint.bodies is not None:
                holders = (joint.bodies[side],) * len(holders)
            anchor = (joint.anchor_a, joint.anchor_b)[side]
            centre = None if anchor is None else anchor[axis]
            priors = tuple(anchor_prior(scene, holder, axis, centre) for holder in holders)
            conditional.append(priors)
        priors = tuple(_union(alternatives) for alternatives in conditional)
        owners = tuple(owner for owner, _ in joints)
        blocks.append(Block(name, owners, unit, priors, of="joint", conditional=tuple(conditional)))
    return blocks


def _has(body: Body, name: str) -> bool:
    """Whether a moving body has a parameter of Table 1."""
    if body.kinematic:
        return name in CONTACT_NAMES
    return body.wheel or name not in WHEEL_PARAMETERS


def _union(priors: tuple[Prior, ...]) -> Prior:
    """Prior on the union of the supports: that of an anchor whose index is unknown."""
    if len(set(priors)) == 1:
        return priors[0]
    lower, upper = min(prior.lower for prior in priors), max(prior.upper for prior in priors)
    return replace(priors[0], mu=(lower + upper) / 2, sigma=upper - lower, lower=lower, upper=upper)


def build_layout(scene: Scene, effects: tuple[Attached, ...] = ()) -> Layout:
    """Phi of a scene: Table 1's unknowns of moving bodies and of joints, then the effects'.

    Parameters
    ----------
    scene : Scene
        Parameters that it names as known are left out, and a wheel's where there is none. Bodies
        that share parameters (`Scene.owners`) have one entry of each.
    effects : tuple of Attached
        All effects of the model.

    Raises
    ------
    ParameterError
        If a body's ``prior`` names a parameter that neither it nor its effects have, or makes no
        distribution.
    """
    for body in scene.moving:
        own = (attached.variables for attached in effects if attached.body == body.name)
        names = [*BODY_PARAMETERS, *chain(*own)]
        for name, _ in body.prior:
            if name not in names:
                raise ParameterError(
                    f"body {body.name!r}: prior has {name!r}, which is no parameter of it or its"
                    f" effects{nearest(name, names)}"
                )
    blocks = []
    owning = [scene.body(names[0]) for names in scene.owners.values()]  # those that share agree
    for name, unit in BODY_PARAMETERS.items():
        bodies = [body for body in owning if name not in dict(body.known) and _has(body, name)]
        if bodies:
            priors = tuple(table1(body)[name] for body in bodies)
            blocks.append(Block(name, tuple(body.owner for body in bodies), unit, priors))
    blocks += _joint_blocks(scene)
    for effect in dict.fromkeys(attached.effect.name for attached in effects):
        those = [attached.in_si(scene) for attached in effects if attached.effect.name == effect]
        by_name: dict[str, dict[str, EffectParameter]] = {}  # not every body has all
        for attached in those:
            free = (one for one in attached.effect.parameters if not one.given)
            for name, parameter in zip(attached.variables, free, strict=True):
                by_name.setdefault(name, {})[attached.body] = parameter
        for name, alike in by_name.items():
            priors = tuple(
                declared_prior(scene.body(owner), name, parameter.prior)
                for owner, parameter in alike.items()
            )
            unit = next(iter(alike.values())).unit
            blocks.append(Block(name, tuple(alike), unit, priors, effect=effect))
    return Layout(tuple(blocks))
