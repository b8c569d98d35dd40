"""A push that never does more work in a second than a limit: the motor's or the supply's power."""

import numpy as np

import pbrl_ppl as pp


def law(state, command, parameters, wrench):
    """Weaken the commanded wrench where its power is beyond the parameter, the power (W)."""
    power = wrench[0] * state[3] + wrench[1] * state[4] + wrench[2] * state[5]
    if power > parameters[0]:
        for i in range(3):
            wrench[i] *= parameters[0] / power


def applies(scene, body):
    """Return whether a body's commands are forces and torques: it has no actuators."""
    return not scene.actuators_of(body.name)


def scan(scene, history, body):
    """Return powers between those that the commands would have, shape (point, 1), W."""
    data = history.dataset.sel(body=body.name)
    action, start = data["action"].to_numpy(), data["start"].to_numpy()[..., 3:]
    power = np.nansum(action * start, axis=-1)
    power = power[power > 0.0]
    if not len(power):
        return np.empty((0, 1))
    return np.unique(np.quantile(power, np.linspace(0.3, 0.98, 6)))[:, None]


power_limit = pp.Effect(
    "power_limit",
    (
        pp.EffectParameter(
            "power",
            "W",
            pp.Prior("log_normal", mu=0.0, sigma=1.5),
            null=1e9,  # typical powers, which nothing reaches
            scale="force speed",
        ),
    ),
    "a push never does more work in a second than a limit: the motor's or the supply's power",
    "power limit of an actuator, f . v <= P",
    pp.Command(law),
    applies=applies,
    scan=scan,
    log_odds=-3.0,
    family="shape of the command",
    unusual="drives are seldom commanded beyond their power",
)
