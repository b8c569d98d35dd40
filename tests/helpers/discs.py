"""Two discs that are thrown at each other and at a wall, in closed form from contact to contact.

No engine is used: between contacts the discs move at constant velocity, and each contact is an
impulse with Newton's restitution and Coulomb friction at the point of contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Scene, Shape, Wall
from tests.helpers.histories import COLUMNS

RADIUS = 0.1
NAMES = ("one", "two")
TRUTH = {"r": [0.7, 0.9], "mu_c": [0.2, 0.4]}
MASSES = (1.0, 1.5)
#: Errors of measuring: m, m, rad, m/s, m/s, rad/s.
MEASURED = (0.002, 0.002, 0.01, 0.02, 0.02, 0.1)
#: A disc moves by less than its noise in an engine step.
SCENE = Scene(
    time_step=0.05,
    substeps=100,
    walls=(Wall((-9.0, 0.0), (9.0, 0.0)),),
    bodies=tuple(
        Body(name, Shape.circle(RADIUS), known={"mass": mass})
        for name, mass in zip(NAMES, MASSES, strict=True)
    ),
)


@dataclass
class Discs:
    """Positions, angles and velocities of two discs above a wall along x.

    Parameters
    ----------
    place, velocity : ndarray
        Shape (2, 2), m and m/s.
    angle, spin : ndarray
        Shape (2,), rad and rad/s.
    mass, r, mu_c : ndarray
        Shape (2,); a contact's restitution and friction are products, and the wall has 1.
    contacts : list
        What touched, and when (s).
    """

    place: np.ndarray
    velocity: np.ndarray
    angle: np.ndarray
    spin: np.ndarray
    mass: np.ndarray
    r: np.ndarray
    mu_c: np.ndarray
    now: float
    contacts: list[tuple[float, str]]

    def move(self, duration: float) -> None:
        """Move on, from contact to contact."""
        while True:
            what, when = min(self._next(), key=lambda event: event[1])
            free = min(when, duration)
            self.place = self.place + free * self.velocity
            self.angle = self.angle + free * self.spin
            self.now += free
            if when > duration:
                return
            duration -= when
            self.contacts.append((self.now, what))
            if what == "pair":
                self._collide([0, 1], (self.place[1] - self.place[0]) / (2 * RADIUS))
            else:
                self._collide([NAMES.index(what)], np.array([0.0, -1.0]))

    def _next(self) -> list[tuple[str, float]]:
        """Return the contacts ahead and the time to each (s)."""
        events = [("none", np.inf)]
        for i, name in enumerate(NAMES):
            if self.velocity[i, 1] < 0:
                until = max((self.place[i, 1] - RADIUS) / -self.velocity[i, 1], 0.0)
                events.append((name, until))
        apart, rate = self.place[1] - self.place[0], self.velocity[1] - self.velocity[0]
        near = apart @ rate
        root = near**2 - rate @ rate * (apart @ apart - 4 * RADIUS**2)
        if near < 0 and root > 0:
            events.append(("pair", max((-near - np.sqrt(root)) / (rate @ rate), 0.0)))
        return events

    def _collide(self, pair: Sequence[int], normal: np.ndarray) -> None:
        """Apply the impulse of a contact; the normal points from the first body outwards."""
        tangent, sign = np.array([-normal[1], normal[0]]), np.array([1.0, -1.0])[: len(pair)]
        # velocity of the first body's point of contact relative to the other's
        slip = sum(s * self.velocity[i] @ tangent for s, i in zip(sign, pair, strict=True))
        slip += RADIUS * self.spin[pair].sum()
        close = sum(s * self.velocity[i] @ normal for s, i in zip(sign, pair, strict=True))
        lightness = (1 / self.mass[pair]).sum()
        push = (1 + self.r[pair].prod()) * close / lightness
        # a uniform disc's moment is m R^2 / 2: along the tangent it is three times as light
        drag = np.clip(slip / (3 * lightness), -self.mu_c[pair].prod() * push, None)
        drag = min(drag, self.mu_c[pair].prod() * push)
        for s, i in zip(sign, pair, strict=True):
            self.velocity[i] -= s * (push * normal + drag * tangent) / self.mass[i]
            self.spin[i] -= RADIUS * drag / (0.5 * self.mass[i] * RADIUS**2)


def thrown(
    seed: int,
    *,
    trajectories: int = 6,
    intervals: int = 12,
    apart: bool = False,
) -> tuple[History, list[list[tuple[float, str]]]]:
    """Return a recording with noise, and the contacts of each trajectory.

    Both are thrown at the same place of the wall, so that they meet; ``apart`` throws them away
    from each other and from the wall.
    """
    rng = np.random.default_rng(seed)
    rows, contacts = [], []
    for t in range(trajectories):
        place = np.array([[-0.25, 0.35], [0.25, 0.35]]) + rng.uniform(-0.08, 0.08, (2, 2))
        aim = np.array([0.0, 0.15]) + rng.uniform(-0.1, 0.1, (2, 2))
        way = place if apart else aim - place
        velocity = way * (rng.uniform(1.0, 1.6, 2) / np.linalg.norm(way, axis=1))[:, None]
        own = Discs(
            place, velocity, rng.uniform(-3, 3, 2), rng.normal(0, 15.0, 2),
            np.array(MASSES), np.array(TRUTH["r"]), np.array(TRUTH["mu_c"]), 0.0, [],
        )  # fmt: skip
        for i in range(intervals + 1):
            if i:
                own.move(SCENE.time_step)
            states = np.column_stack([own.place, own.angle, own.velocity, own.spin])
            states = states + rng.normal(0.0, MEASURED, states.shape)
            push = [0.0] * 3 if i < intervals else [np.nan] * 3
            rows += [
                [t, i, i * SCENE.time_step, name, *state, *push]
                for name, state in zip(NAMES, states, strict=True)
            ]
        contacts.append(own.contacts)
    table = pd.DataFrame(rows, columns=COLUMNS)
    return History.from_dataframe(table, SCENE), contacts
