"""Clocks that run too fast or too slow: the acceleration of bodies that fall freely tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pbrl_ppl.history.history import History
from pbrl_ppl.history.kinematics import column_noise
from pbrl_ppl.history.measures import TIME, unit_size
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats

#: Ratios of the frame rates of a camera and of its film.
_RATIOS = (2.0, 4.0, 8.0, 10.0)


@dataclass(frozen=True)
class WrongClock:
    """A clock that runs too fast or too slow, by the fall of a body.

    Attributes
    ----------
    body : str
        Name of the body.
    acceleration, gravity : float
        The body's along gravity, and what the scene says (m/s^2).
    factor : float
        How many seconds the clock counts in a second.

    Examples
    --------
    >>> clock = WrongClock("ball", 0.153, 9.81, 8.0)
    >>> clock.unit(), clock.unit("ms"), clock.unit("240/s")
    ('8/s', '8/ms', '1920/s')
    """

    body: str
    acceleration: float
    gravity: float
    factor: float

    def unit(self, present: str = "s") -> str:
        """Return the unit of time that cures it, from the unit in which the times were read."""
        number, _, unit = present.rpartition("/")
        if number:
            return f"{self.factor * float(number):.10g}/{unit}"
        known = present in TIME and unit_size("time", present) is not None
        return f"{self.factor:.10g}/{present if known else 's'}"

    def sentence(self, scene: Scene) -> str:
        """Return what the fall shows, and the entries of the scene that cure it."""
        units = dict(scene.recording.units) if scene.recording else {}
        pace = self.factor if self.factor > 1 else 1 / self.factor
        square = f"1/{pace**2:g}" if self.factor > 1 else f"{pace**2:g} times"
        return (
            f"{self.body} falls with {self.acceleration:.3g} m/s^2, {square} that of gravity: the"
            f" clock runs {pace:g} times too {'fast' if self.factor > 1 else 'slow'}, as of a film"
            f' at another frame rate: units = {{ time = "{self.unit(units.get("time", "s"))}" }} in'
            f" [recording] and time_step = {scene.time_step / self.factor:.6g} in [world]"
        )


def wrong_clock(
    history: History, scene: Scene, *, near: float = 0.15, certain: float = 0.1
) -> WrongClock | None:
    """Return how a body's free fall contradicts the clock; None where it does not, or none falls.

    A body falls freely that is on no joint, is sent no command and has no actuator. Its
    acceleration along gravity is regressed on the drag of its motion; impacts are left out.

    Parameters
    ----------
    history : History
        What was measured.
    scene : Scene
        Has gravity, and says which bodies are free.
    near : float
        How far the acceleration may be, as a share, from gravity over the square of a ratio.
    certain : float
        Largest standard error of the acceleration, as a share.
    """
    gravity = float(np.hypot(*scene.gravity))
    held = {name for joint in scene.joints for name in joint.bodies or ()}
    if not gravity or any(joint.bodies is None for joint in scene.joints):
        return None
    down = np.array(scene.gravity) / gravity
    for body in scene.dynamic:
        data = history.dataset.sel(body=body.name)
        sent = np.nan_to_num(data["action"].to_numpy())
        if body.name in held or scene.actuators_of(body.name) or sent.any():
            continue
        fall, error = _fall(data["observed"].to_numpy()[..., :2], down, scene.time_step)
        ratios = (*_RATIOS, *(1 / ratio for ratio in _RATIOS))
        factor = min(ratios, key=lambda one: abs(np.log(max(fall, 1e-300) * one**2 / gravity)))
        if abs(fall * factor**2 / gravity - 1) < near and error < certain * fall:
            return WrongClock(body.name, fall, gravity, factor)
    return None


def _fall(places: Floats, down: Floats, dt: float, *, clear: float = 0.05) -> tuple[float, float]:
    """Return the acceleration along ``down`` (m/s^2) and its standard error.

    ``places`` has the shape (trajectory, time, 2).

    Differences are over as many rows as it takes for noise to be the share ``clear`` of them.
    """
    places = np.nan_to_num(places) if np.isnan(places).all(axis=(0, 1)).sum() == 1 else places
    along = places @ down
    noise, lag = column_noise(along, robust=True), 1
    while True:
        change = along[:, 2 * lag :] - 2 * along[:, lag:-lag] + along[:, : -2 * lag]
        seen = np.abs(change[np.isfinite(change)])
        if len(seen) < 8:
            return 0.0, np.inf
        if np.median(seen) > np.sqrt(6.0) * noise / clear or 12 * lag > along.shape[1]:
            break
        lag *= 2
    velocity = (places[:, 2 * lag :] - places[:, : -2 * lag]) / (2 * lag * dt)
    ahead, speed = velocity @ down, np.linalg.norm(velocity, axis=-1)
    design = np.stack([np.ones_like(ahead), ahead, speed * ahead], axis=-1).reshape(-1, 3)
    y = change.ravel() / (lag * dt) ** 2
    kept = np.isfinite(y) & np.isfinite(design).all(axis=1)
    best = np.zeros(3)
    for _ in range(4):  # impacts are far from the rest
        if kept.sum() < 8:
            return 0.0, np.inf
        x = design[kept] / np.maximum(np.abs(design[kept]).max(axis=0), 1e-300)
        best, *_ = np.linalg.lstsq(x, y[kept], rcond=1e-9)
        rest = y[kept] - x @ best
        size = 1.4826 * float(np.median(np.abs(rest)))
        within = np.abs(rest) <= max(4.0 * size, 1e-9)
        # white noise leaves differences of neighbouring rows independent
        error = float(np.sqrt(2.0 * np.mean(rest**2) * np.linalg.pinv(x.T @ x)[0, 0]))
        kept[kept] = within
        if within.all():
            break
    return float(best[0]), error
