"""Ten million engine steps, and thousands of lost worlds, take no memory."""

import resource
import sys

import numpy as np
import pytest

from pbrl_ppl.physics import Physics, Simulator
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.worlds import G, body

pytestmark = pytest.mark.one_stack

MIB = (
    1024 if sys.platform.startswith("linux") else 1024**2
)  # ru_maxrss is in KiB, on a Mac in bytes


def peak() -> float:
    """Largest memory that the process has had (MiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MIB


def simulator() -> Simulator:
    """Everything the engine can hold: a wheel, contacts, walls, a rod, an inferred hinge."""
    disc = Shape.circle(0.1)
    scene = Scene(
        time_step=0.1,
        substeps=10,
        normal_gravity=G,
        bodies=(
            body("cart", Shape.box(0.4, 0.3), wheel=True, mu_x=0.05, mu_y=0.4, r=0.3, mu_c=0.2),
            Body("puck", disc, known={"r": 0.5, "mu_c": 0.3}),
            body("tail", disc),
        ),
        walls=tuple(
            Wall(a, b)
            for a, b in (
                ((-1, -1), (1, -1)),
                ((1, -1), (1, 1)),
                ((1, 1), (-1, 1)),
                ((-1, 1), (-1, -1)),
            )
        ),
        joints=(
            Joint("distance", ("cart", "tail"), (-0.3, 0.0), (0.0, 0.0)),
            Joint("hinge", known=False),
        ),
    )
    return Simulator(Physics(scene, threads=2))


@pytest.mark.long
def test_ten_million_steps_leak_nothing() -> None:
    sim = simulator()
    rng = np.random.default_rng(1)
    n = 1000
    start = rng.normal(0, [0.2, 0.2, 1, 1, 1, 1], (n, 3, 6))
    start[:, :, 0] += (-0.4, 0.5, -0.4)
    start[:, 2, 1] += 0.5
    actions = rng.normal(0, [5, 5, 0.5], (n, 1, 3, 3))
    phi = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # no second joint

    def run(calls: int) -> int:
        for i in range(calls):
            phi[1:3] = i % 4  # the worlds of other choices come and go
            sim(phi, start, actions)
        return calls * n * sim.physics.substeps

    run(50)
    before, steps = peak(), 0
    while steps < 10_000_000:
        steps += run(50)
    # a leak of one contact (200 bytes) a transition would be 190 MiB
    assert peak() - before < 8


@pytest.mark.slow
def test_lost_worlds_are_freed() -> None:
    sim = simulator()
    start = np.zeros((200, 3, 6))
    start[:, :, 0] = (-0.4, 0.5, -0.7)
    actions = np.zeros((200, 1, 3, 3))
    actions[:, :, 1] = 1e12
    phi = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert np.isnan(sim(phi, start, actions)).all()
    before = peak()
    for _ in range(20):
        sim(phi, start, actions)
    # 4,000 worlds of 30 kB would be 115 MiB
    assert peak() - before < 8
