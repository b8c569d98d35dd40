"""Raw logs as rigs write them: a pole's angles, an encoder with its velocity, a camera's puck."""

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

#: A uniform pole of 0.6 m (g / (2/3 length) is what swings), its damping and friction over inertia.
POLE = "--side --body pole=box:0.02x0.6"
LENGTH, DAMPING, FRICTION = 0.6, 0.25, 0.6
#: Drag over mass of the puck (1/s), and noise of the camera (m).
DRAG, NOISE = 0.25, 0.001


def weighed(scene: Path, mass: float) -> None:
    """Declare the mass of a new scene's body: uncomment the line that has it as an example."""
    text = scene.read_text()
    assert "# known = { mass = 6.0 }" in text
    scene.write_text(text.replace("# known = { mass = 6.0 }", f"known = {{ mass = {mass} }}"))


def swing(seconds: float, dt: float, *, angle: float = 2.3) -> tuple[np.ndarray, np.ndarray]:
    """Return times and angles of a pole that swings with damping and dry friction."""

    def motion(_: float, state: np.ndarray) -> list[float]:
        pull = -1.5 * 9.81 / LENGTH * np.sin(state[0]) - DAMPING * state[1]
        return [state[1], pull - FRICTION * np.tanh(state[1] / 0.02)]

    times = np.arange(round(seconds / dt)) * dt
    found = solve_ivp(
        motion, (0, seconds), [angle, 0.0], t_eval=times, rtol=1e-8, atol=1e-10, max_step=0.01
    )
    return times, found.y[0]


def angles(path: Path, rows: int = 400) -> None:
    """Write times and angles at 20 Hz in one take: blanks between, no header."""
    rng = np.random.default_rng(3)
    times, angle = swing(0.05 * rows, 0.05)
    noisy = angle + 0.002 * rng.standard_normal(rows)
    lines = (f"{t:10.3f}   {a: .5f}" for t, a in zip(times, noisy, strict=True))
    path.write_text("\n".join(lines) + "\n")


def encoder(path: Path, rows: int = 1000) -> None:
    """Write the steps of an encoder at 100 Hz, with the velocity that its driver computes."""
    times, angle = swing(0.01 * rows, 0.01)
    step = 2 * np.pi / 4096
    steps = np.round(angle / step) * step
    speed = np.diff(steps, prepend=steps[0]) / 0.01
    table = np.column_stack([times, steps, speed])
    np.savetxt(path, table, "%.6f", delimiter=",", header="t,angle,speed", comments="")


def camera(path: Path, rows: int = 1200) -> None:
    """Write durations, x and y of a puck between walls; zeros where it was not seen, no header."""
    rng = np.random.default_rng(3)
    place, velocity = np.array([0.5, 0.4]), np.zeros(2)
    low, high = np.array([0.05, 0.05]), np.array([1.55, 0.95])
    table = []
    for row in range(rows):
        if row % 240 == 0:  # somebody pushes it
            heading = rng.uniform(0, 2 * np.pi)
            velocity = 1.6 * np.array([np.cos(heading), np.sin(heading)])
        duration = (1 + 0.02 * rng.uniform(-1, 1)) / 60
        for _ in range(20):
            velocity = velocity * (1 - DRAG * duration / 20)
            place = place + velocity * duration / 20
            out = ((place < low) & (velocity < 0)) | ((place > high) & (velocity > 0))
            velocity = np.where(out, -0.8 * velocity, velocity)
        seen = not (300 < row % 600 < 330 or rng.uniform() < 0.01)
        measured = place + NOISE * rng.standard_normal(2) if seen else np.zeros(2)
        table.append([duration, *measured])
    np.savetxt(path, table, "%.5f", delimiter=",")
