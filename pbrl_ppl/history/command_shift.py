"""Commands that were logged whole rows early or late, found by cross-correlation."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.history.history import History
from pbrl_ppl.history.kinematics import hung_bodies
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import THETA, Floats

#: Rows by which commands may be shifted, either way.
_MOST = 3


def command_shifts(
    history: History, scene: Scene, *, clear: float = 30.0, whole: float = 0.15
) -> dict[str, int]:
    """Return by how many rows bodies answer commands later than they were logged.

    Accelerations are regressed on the commands of each shift, on positions, speeds and a constant.
    A shift counts if it explains far more than none, and if the commands of the rows beside it
    explain hardly more: a delay by a part of a row, or a lag, is a law of an actuator.

    Parameters
    ----------
    history, scene : History, Scene
        What was measured, and where commands act.
    clear : float
        Log-likelihood ratio (nats) that a shift has over any other.
    whole : float
        Rows by which the mean delay may differ from whole rows.

    Returns
    -------
    dict of str to int
        Rows by body, negative where a body moves before the command; those without are left out.
    """
    hung, found = hung_bodies(scene), {}
    for body in scene.dynamic:
        data = history.dataset.sel(body=body.name)
        pose = data["observed"].to_numpy()[..., :3].astype(float)
        pose[..., THETA] = np.where(
            np.isfinite(pose[..., THETA]), np.unwrap(np.nan_to_num(pose[..., THETA])), np.nan
        )
        sent = data["action"].to_numpy().astype(float)
        for d in (THETA,) if body.name in hung else range(3):
            pushes = _pushes(scene, body.name, pose, sent, d)
            scores = _scores(pose[..., d], pushes, turns=d == THETA)
            if scores is not None and (shift := _shift(*scores, clear, whole)):
                found[body.name] = shift
                break
    return found


def shift_sentence(scene: Scene, body: str, rows: int) -> str:
    """Return how commands are shifted, with the entry that moves them back."""
    clocks = dict(scene.recording.time) if scene.recording else {}
    offset = float(clocks.get("offset", 0.0)) + rows * scene.time_step
    named = f'commands = "{clocks["commands"]}", ' if "commands" in clocks else ""
    count = f"{abs(rows)} row{'s' * (abs(rows) > 1)}"
    cause = f"before its commands: they were logged {count} late"
    if rows > 0:
        cause = f"after its commands: they were logged {count} early, or an actuator delays them"
    return (
        f"{body} moves {count} {cause}: time = {{ {named}offset = {offset:.6g} }} in [recording]"
        " moves them"
    )


def _pushes(scene: Scene, name: str, pose: Floats, sent: Floats, d: int) -> Floats:
    """Return the commands that may accelerate a dimension, shape (command, trajectory, time)."""
    actuators = scene.actuators_of(name)
    if not actuators:
        return sent[..., d][None]
    along = [column for column, one in zip(np.moveaxis(sent, -1, 0), actuators, strict=False)
             if one.kind != "servo"]  # fmt: skip
    if d == THETA or not along:
        return np.array(along).reshape(len(along), *sent.shape[:-1])
    angle = pose[..., THETA]
    parts = (np.cos(angle), np.sin(angle)) if np.isfinite(angle).any() else (np.ones_like(angle),)
    return np.array([part * column for part in parts for column in along])


def _scores(
    place: Floats, pushes: Floats, *, turns: bool, few: int = 40
) -> tuple[Floats, float, Floats] | None:
    """Return log-likelihoods of each shift, that of the best with its neighbours, their weights."""
    n = place.shape[1]
    if not len(pushes) or n < 4 * _MOST + 2:
        return None
    rows = np.arange(_MOST + 1, n - _MOST - 2)
    y = (place[:, rows + 1] - 2 * place[:, rows] + place[:, rows - 1]).ravel()
    rest = [
        np.ones_like(y),
        place[:, rows].ravel(),
        (place[:, rows + 1] - place[:, rows - 1]).ravel(),
    ]
    if turns:
        rest += [np.sin(place[:, rows]).ravel(), np.cos(place[:, rows]).ravel()]
    moved = {
        s: np.stack([(p[:, rows - 1 - s] + p[:, rows - s]).ravel() for p in pushes], axis=1)
        for s in range(-_MOST - 1, _MOST + 2)
    }
    whole = np.column_stack([y, *rest, *moved.values()])
    kept = np.isfinite(whole).all(axis=1)
    if kept.sum() < few or not any(np.ptp(one[kept], axis=0).any() for one in moved.values()):
        return None
    base = np.stack([column[kept] for column in rest], axis=1)
    base = base / np.maximum(np.abs(base).max(axis=0), 1e-300)

    def fit(*shifts: int) -> tuple[float, Floats]:
        x = np.column_stack([base, *(moved[s][kept] for s in shifts)])
        best, *_ = np.linalg.lstsq(x, y[kept], rcond=1e-9)
        off = y[kept] - x @ best
        size = max(float(off @ off), 1e-18 * float(y[kept] @ y[kept]), 1e-300)
        return -0.5 * len(off) * np.log(size), best[base.shape[1] :]

    shifts = range(-_MOST, _MOST + 1)
    each = np.array([fit(s)[0] for s in shifts])
    best = shifts[int(each.argmax())]
    joint, weights = fit(best - 1, best, best + 1)
    return each, joint, weights.reshape(3, -1)


def _shift(each: Floats, joint: float, weights: Floats, clear: float, whole: float) -> int:
    """Return the shift that is clear and of whole rows; 0 if there is none."""
    best = int(each.argmax())
    gain = each[best] - each[_MOST]
    others = np.delete(each, best).max()
    size = weights[:, int(np.abs(weights[1]).argmax())]
    off = float((size[2] - size[0]) / size.sum()) if size.sum() else np.inf
    if each[best] - others < clear or abs(off) > whole or joint - each[best] > 0.1 * gain:
        return 0
    return best - _MOST
