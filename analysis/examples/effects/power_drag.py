"""Drag, and a torque against turning, that grow with a power of the speed.

F = -force (|v| / v0)^exponent v / |v|, and the same of the angular speed: laws with a constant, the
body's typical speed, at which they have their size.
"""

import numpy as np

import pbrl_ppl as pp


def force(state, command, parameters, wrench):
    """Add the force; the parameters are force and exponent, then the typical speed."""
    speed = (state[3] * state[3] + state[4] * state[4]) ** 0.5
    if speed > 0.0:
        drag = parameters[0] * (speed / parameters[2]) ** parameters[1] / speed
        wrench[0] -= drag * state[3]
        wrench[1] -= drag * state[4]


def torque(state, command, parameters, wrench):
    """Add the torque; the parameters are torque and exponent, then the typical angular speed."""
    rate = abs(state[5])
    if rate > 0.0:
        wrench[2] -= parameters[0] * (rate / parameters[2]) ** parameters[1] * state[5] / rate


def scan(scene, history, body):
    """Return exponents between and beyond the common ones; the derivative is taken by the size."""
    return np.array([(np.nan, 1.5), (np.nan, 3.0)])


SIZE = pp.Prior("half_normal", sigma=1.0)
EXPONENT = pp.EffectParameter(
    "exponent", "1", pp.Prior("truncated_normal", mu=2.0, sigma=0.7, lower=1.0, upper=3.0), null=2.0
)

power_drag = pp.Effect(
    "power_drag",
    (pp.EffectParameter("force", "N", SIZE, scale="force"), EXPONENT),
    "a force against the motion that grows with a power of the speed, and has this size at the"
    " typical speed",
    "power law, F = -f (|v| / v0)^p, with a typical speed v0",
    pp.Force(force),
    scan=scan,
    constants=("speed",),
    log_odds=-2.0,
    family="drag",
    unusual="between linear and quadratic drag only clean and fast recordings tell",
)

power_angular_drag = pp.Effect(
    "power_angular_drag",
    (pp.EffectParameter("torque", "N m", SIZE, scale="torque"), EXPONENT),
    "a torque against the rotation that grows with a power of the angular speed, and has this size"
    " at the typical one",
    "power law, tau = -t (|omega| / omega0)^p, with a typical angular speed omega0",
    pp.Force(torque),
    scan=scan,
    constants=("turn_rate",),
    log_odds=-2.0,
    family="angular drag",
    unusual="between linear and quadratic drag only clean and fast recordings tell",
)
