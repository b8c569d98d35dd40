"""Bodies of the cases: drawn from ranges, as the engines make and the scene declares them."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.state import STATE

sys.path.insert(0, str(Path(__file__).parents[2] / "models" / "shopping_cart"))
import make_history as mh

#: A float, or floats, as `make_history.Effects` takes them.
Hidden = float | tuple[float, ...]
Rng = np.random.Generator

#: Made by Box2D: a box on a wheel in a room, a free box, a pendulum, two discs that may touch. Made
#: by MuJoCo: a free box, a pendulum, a double pendulum.
CART, PUCK, ARM, PAIR = "cart", "puck", "arm", "pair"
SLED, LEVER, CHAIN = "sled", "lever", "chain"
SORTS = (CART, PUCK, ARM, PAIR, SLED, LEVER, CHAIN)
#: Those that hang in a hinge and are seen from the side.
HINGED = (ARM, LEVER, CHAIN)
MUJOCO = (SLED, LEVER, CHAIN)

#: Noise of motion capture: m, m, rad, m/s, m/s, rad/s.
_CAPTURE = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)
#: Transitions, seconds of the training recording, and seconds of a trajectory, at most.
_TRANSITIONS, _SECONDS, _LONG = 400, 20.0, 6.0
# A wheel whose point all but stops while the body turns makes errors of the step's first order: in
# one interval of 360 they reach the noise at 1 ms.
_WHEEL_STEP, _STEP = 0.00025, 0.001  # s
_ROOM = 12.0  # m

#: Effects that are the same physics on a body: they are left out together, and each is a right name
#: of the others. A turned frame sees pushes askew; where the mass is free, a force's scale is that
#: of the torque; where nothing depends on the heading, so is a scale of the inertia or of angles.
_TURNED, _SCALED = ("actuator_rotation", "frame_rotation"), ("torque_gain", "force_gain")
_FREE = (_TURNED, ("inertia_scale", *_SCALED, "sensor_scale"))
_HUNG = (
    ("pivot_damping", "linear_drag", "angular_drag"),
    ("constant_torque", "body_force"),  # a force fixed to the arm turns it alike everywhere
    # angles from a vertical that is off; a force turns gravity and adds to it
    ("gravity_tilt", "sensor_bias", "constant_force", "frame_rotation"),
    # to the angle's fourth power, a scaled angle moves as one with a spring does
    ("torsion_spring", "sensor_scale"),
)
INDISTINGUISHABLE = {
    CART: (_TURNED, _SCALED), PUCK: _FREE, SLED: _FREE, PAIR: _FREE, ARM: _HUNG, LEVER: _HUNG,
    CHAIN: _HUNG[:2],
}  # fmt: skip
#: A richer effect, and one that it contains: the richer one is left out with it. A centre of
#: gravity beside the arm lets it hang askew.
_RICHER = (("anisotropic_gain", "torque_gain"),)
_ASKEW = (("com_offset", "gravity_tilt"), ("com_offset", "sensor_bias"))
CONTAIN = {CART: _RICHER, ARM: _ASKEW, LEVER: _ASKEW, CHAIN: ()}
CONTAIN |= {sort: (*_RICHER, ("anisotropic_gain", "inertia_scale")) for sort in (PUCK, SLED, PAIR)}


def indistinguishable(sort: str, effect: str | None) -> tuple[str | None, ...]:
    """Return an effect and those equivalent to it on a kind of body."""
    return next((group for group in INDISTINGUISHABLE[sort] if effect in group), (effect,))


@dataclass(frozen=True)
class Body:
    """A body of a case, or several that are joined or may touch.

    Parameters
    ----------
    sort : str
        One of `SORTS`.
    setups : tuple of Setup
        One each body; the first one's clock, counts and noise hold for all.
    base : tuple of (str, Hidden)
        Effects that the scene declares, with their true values, on each body.
    """

    sort: str
    setups: tuple[mh.Setup, ...]
    base: tuple[tuple[str, Hidden], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the bodies."""
        return tuple(setup.name for setup in self.setups)

    @property
    def noise(self) -> dict[str, float]:
        """Return the noise of each measured state dimension."""
        noise = dict(zip(STATE, self.setups[0].noise, strict=True))
        return {name: size for name, size in noise.items() if not math.isnan(size)}

    @property
    def scene(self) -> pp.Scene:
        """Return the declared scene."""
        hinged, corner = self.sort in HINGED, _ROOM
        corners = [(-corner, -corner), (corner, -corner), (corner, corner), (-corner, corner)]
        walls = [pp.Wall(corners[i - 1], corners[i]) for i in range(4)]
        gravity = {"gravity": (0.0, -mh.NORMAL_GRAVITY)} if hinged else {}
        return pp.Scene(
            time_step=self.setups[0].time_step,
            normal_gravity=0.0 if hinged else mh.NORMAL_GRAVITY,
            bodies=tuple(self._declared(setup) for setup in self.setups),
            walls=tuple(walls) if self.sort == CART else (),
            joints=tuple(self._hinge(i) for i in range(len(self.setups))) if hinged else (),
            **gravity,
        )

    def _declared(self, setup: mh.Setup) -> pp.Body:
        known: dict[str, float] = {"r": setup.r, "mu_c": setup.mu_c}
        if self.sort in HINGED:
            known = {"mass": setup.mass}
        elif self.sort == CART:
            known = {}
        round_one = self.sort == PAIR
        shape = pp.Shape.circle(setup.size[0] / 2) if round_one else pp.Shape.box(*setup.size)
        effects = tuple(name for name, _ in self.base)
        return pp.Body(
            setup.name, shape, wheel=setup.wheel is not None, known=known, effects=effects
        )

    def _hinge(self, i: int) -> pp.Joint:
        own, before = self.setups[i].hinge, -(self.setups[i - 1].hinge or 0j) if i else 0j
        holder = self.names[i - 1] if i else "world"
        anchors = [(end.real, end.imag) for end in (own or 0j, before)]
        return pp.Joint("hinge", (self.names[i], holder), *anchors)


def draw_body(sort: str, rng: Rng) -> Body:
    """Draw a body of a kind: size, mass, frictions, pushes and measurements."""
    recording = _recording(sort, rng)
    if sort == PAIR:
        discs = [_free(rng, name, recording, disc=True) for name in ("left", "right")]
        return Body(sort, tuple(discs))
    if sort in HINGED:
        names = ("upper", "lower") if sort == CHAIN else (sort,)
        pushed = bool(rng.random() < 0.5)
        links = tuple(_hung(rng, name, recording, pushed) for name in names)
        return Body(sort, links, (("inertia_scale", float(rng.uniform(0.8, 1.3))),))
    setup = _free(rng, sort, recording, wheel=sort == CART)
    base = ()
    if sort == PUCK and rng.random() < 0.4:
        base = (("sliding_friction", (_log(rng, 0.02, 0.2), 0.3 * setup.size[0])),)
    return Body(sort, (setup,), base)


def _log(rng: Rng, low: float, high: float) -> float:
    """Draw log-uniformly."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _recording(sort: str, rng: Rng) -> dict[str, Any]:
    """Draw the clock, the counts and the noise."""
    time_step = 0.002 * max(5, round(1 / _log(rng, 5, 100) / 0.002))
    many = min(16, int(_SECONDS / 15 / time_step))
    n_train = int(rng.integers(4, 7) if sort == PAIR else rng.integers(6, many + 1))
    most = min(_TRANSITIONS // n_train, int(_SECONDS / n_train / time_step), int(_LONG / time_step))
    n_intervals = 12 if sort == PAIR else max(15, min(int(rng.integers(15, 61)), most))
    places, speeds = 10 ** rng.uniform(-0.5, 0.5, 2)
    noise = np.array(_CAPTURE) * np.repeat([places, speeds], 3)
    if sort in HINGED:
        noise[[0, 1, 3, 4]] = math.nan
    return {
        "time_step": round(time_step, 3),
        "n_train": n_train,
        "n_test": max(3, n_train // 3),
        "n_intervals": n_intervals,
        "hold": max(1, round(rng.uniform(0.1, 0.4) / time_step)),
        "noise": tuple(float(f"{size:.4g}") for size in noise),
        "step": _WHEEL_STEP if sort == CART else _STEP,
    }


def _free(
    rng: Rng, name: str, recording: dict[str, Any], *, wheel: bool = False, disc: bool = False
) -> mh.Setup:
    """Draw a body on a floor, pushed about."""
    width, mass = _log(rng, 0.25, 1.2), _log(rng, 1.0, 15.0)
    size = (width, width if disc else width * float(rng.uniform(0.5, 1.0)))
    moment = mass * (width**2 / 8 if disc else (size[0] ** 2 + size[1] ** 2) / 12)
    push, turn = mass * _log(rng, 1.5, 5.0), moment * _log(rng, 1.5, 6.0)
    speed = _log(rng, 0.5, 1.5)
    at = rng.uniform(-0.35, 0.35, 2) * size
    axis, along, across = rng.uniform((-0.6, 0.02, 0.2), (0.6, 0.1, 0.6))
    return mh.Setup(
        name,
        size,
        mass,
        r=float(rng.uniform(0.0, 0.5)),
        mu_c=float(rng.uniform(0.1, 0.5)),
        wheel=mh.Wheel(*map(float, (*at, axis, along, across))) if wheel else None,
        room=_ROOM if wheel else None,
        wrench_sd=(push, push, turn),
        start_range=(3.0, 3.0, math.pi),
        start_sd=(speed, speed, _log(rng, 0.5, 2.0)),
        **recording,
    )


def _hung(rng: Rng, name: str, recording: dict[str, Any], pushed: bool) -> mh.Setup:
    """Draw an arm on a hinge, which swings freely or is turned by a motor."""
    length, mass = _log(rng, 0.2, 1.2), _log(rng, 0.2, 5.0)
    hinge = length * float(rng.uniform(0.35, 0.48))
    torque = mass * mh.NORMAL_GRAVITY * hinge * float(rng.uniform(0.1, 0.5)) * pushed
    return mh.Setup(
        name,
        (length * float(rng.uniform(0.05, 0.15)), length),
        mass,
        hinge=hinge * 1j,
        gravity=mh.NORMAL_GRAVITY,
        wrench_sd=(0.0, 0.0, torque),
        start_range=(0.0, 0.0, 1.5),
        start_sd=(0.0, 0.0, _log(rng, 0.7, 3.0)),
        **recording,
    )
