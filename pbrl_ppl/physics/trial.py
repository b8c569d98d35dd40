"""Trial evaluation of a user's effect, in Python first, before it runs inside a fit."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from concurrent.futures import Future, wait
from itertools import product

import numpy as np

from pbrl_ppl.effects import (
    Clock,
    Command,
    Effect,
    Force,
    Friction,
    Noise,
    Properties,
    Sensor,
    Structure,
)
from pbrl_ppl.effects.effect import INTERVAL, MEMORY, MOST_MEMORY, TIME
from pbrl_ppl.errors import EffectError
from pbrl_ppl.history import History
from pbrl_ppl.physics.physics import Physics
from pbrl_ppl.physics.properties import SEEN
from pbrl_ppl.physics.world import COLUMNS
from pbrl_ppl.scene import Body, Scene, Units, body_sizes, units_of
from pbrl_ppl.state import STATE, STATE_UNITS, Floats


def try_effect(effect: Effect, scene: Scene, history: History, patience: float = 10.0) -> None:
    """Evaluate an effect's functions at measured states and at parameters from its prior.

    They run in Python: in the compiled rollout, a law that raises would stop silently. Then a few
    measured intervals are simulated with the effect at its null value and without it, which must be
    the same.

    Parameters
    ----------
    effect : Effect
        Effect to evaluate.
    scene, history : Scene and History
        Scene and data that it would act on.
    patience : float
        Time after which a trial counts as an endless loop (s).

    Raises
    ------
    EffectError
        If it raises, returns a number that is not finite, does not return in time, or does not
        vanish at its null value.
    """
    # what the trial simulates with is compiled first: that is no endless loop
    physics = Physics(scene, substeps=1, extrapolate=False, engine="chipmunk")
    centre, k = np.array([prior.centre for prior in physics.layout.priors]), len(scene.moving)
    physics.predict(centre, np.zeros((1, k, 6)), np.zeros((1, 1, k, 3)))
    outcome: Future[None] = Future()

    def run() -> None:
        try:
            _try(effect, scene, history)
            outcome.set_result(None)
        except Exception as error:
            outcome.set_exception(error)

    threading.Thread(target=run, daemon=True).start()  # an endless one must not keep the process
    if not wait([outcome], patience).done:
        raise EffectError(
            f"effect {effect.name} did not return within {patience:g} s when it was tried once; is"
            " there a loop in it that does not end?"
        )
    error = outcome.exception()
    if isinstance(error, EffectError):
        raise error
    if error is not None:
        raise EffectError(
            f"effect {effect.name} raised {type(error).__name__} when it was tried:"
            f" {error}; fix it, or remove it from the catalogue"
        ) from error


def _try(effect: Effect, scene: Scene, history: History, draws: int = 4) -> None:
    """Raise if a function fails at a state, at the null value or at draws from the prior."""
    bodies = [body for body in scene.dynamic if effect.applies(scene, body)]
    rng = np.random.default_rng(0)
    for body in bodies:
        units = units_of(scene, body.name)
        sized = effect.in_si(units)
        drawn = np.array([parameter.prior.sample(rng, draws) for parameter in sized.parameters])
        values = np.vstack([sized.null, drawn.T])
        if effect.scan is not None:
            points = np.asarray(effect.scan(scene, history, body), dtype=float)
            if points.ndim != 2 or points.shape[1] != len(effect.parameters):
                raise EffectError(
                    f"effect {effect.name}: scan gave shape {points.shape}, expected"
                    f" (point, {len(effect.parameters)})"
                )
        for state, row in product(_some_states(history, body), values):
            result = _applied(effect, state, row, body, units)
            if not np.isfinite(result).all():
                named = _named(effect, row).items()
                shown = ", ".join(f"{name} = {value.item():.3g}" for name, value in named)
                raise EffectError(
                    f"effect {effect.name} gives what is not a finite number on {body.name} at"
                    f" {shown}; fix its law or narrow its prior"
                )
        _check_null(sized, scene, history, body)


def _check_null(
    effect: Effect, scene: Scene, history: History, body: Body, rounding: float = 1e-9
) -> None:
    """Raise if simulations with the effect at its null value differ from those without it.

    Six intervals are simulated. A smaller difference than ``rounding``, as a share of the
    coordinate's size, is none.
    """
    null = (f"{p.name} = {p.null:.4g} {p.unit}".removesuffix(" 1") for p in effect.parameters)
    at_null = ", ".join(null)
    cure = "change its law, or give EffectParameter the null= at which it vanishes"
    if isinstance(effect.stage, Noise):
        tail = float(effect.stage.tail(_named(effect, effect.null))[0, 0])
        if tail != 0.0:
            raise EffectError(
                f"effect {effect.name} does not vanish on {body.name} at its null value"
                f" ({at_null}): its tail is {tail:.3g} there, expected 0; {cure}"
            )
        return
    states = np.nan_to_num(history.dataset["start"].to_numpy())
    segments = history.pieces(states, 1)
    chosen = np.unique(np.linspace(0, segments.n - 1, 6).astype(int))
    without = Physics(scene, substeps=2, extrapolate=False, engine="chipmunk")
    there = without.changed(effects=(effect.on(body.name),))
    known = dict(zip(effect.on(body.name).labels, effect.null, strict=True))

    def predicted(physics: Physics) -> Floats:
        pairs = zip(physics.layout.labels, physics.layout.priors, strict=True)
        phi = np.array([known.get(label, prior.centre) for label, prior in pairs])
        return physics.predict(phi, segments.start[chosen], physics.inputs(segments)[chosen])

    before = predicted(without)
    change = np.nan_to_num(np.abs(predicted(there) - before))
    size = np.abs(np.nan_to_num(before)) + body_sizes(scene)
    relative = (change / size).max(axis=(0, 1))
    if relative.max() > rounding:
        moved, k = np.unravel_index(relative.argmax(), relative.shape)
        most = change[..., moved, k].max()
        raise EffectError(
            f"effect {effect.name} does not vanish on {body.name} at its null value ({at_null}):"
            f" it changes {STATE[k]} of {scene.moving[moved].name} by {most:.3g} {STATE_UNITS[k]}"
            f" in one interval of {scene.time_step:g} s, expected no change; {cure}"
        )


def _some_states(history: History, body: Body, n: int = 6) -> Floats:
    """Return complete measured states of a body, or zeros, shape (n or fewer, 6)."""
    states = history.dataset["start"].sel(body=body.name).to_numpy().reshape(-1, 6)
    states = states[np.isfinite(states).all(axis=1)]
    if not len(states):
        return np.zeros((1, 6))
    return np.asarray(states[np.unique(np.linspace(0, len(states) - 1, n).astype(int))])


def _named(effect: Effect, parameters: Iterable[float]) -> dict[str, Floats]:
    """Return parameters by name, shape (1, 1) each."""
    names = (parameter.name for parameter in effect.parameters)
    return {name: np.array([[one]]) for name, one in zip(names, parameters, strict=True)}


def _applied(effect: Effect, state: Floats, parameters: Floats, body: Body, units: Units) -> Floats:
    """Return the results of an effect's functions at a state and parameters, as one array."""
    stage, named = effect.stage, _named(effect, parameters)
    if isinstance(stage, Force | Command | Friction):
        wrench = np.array([1.0, -0.5, 0.2]) * (units.force, units.force, units.torque)
        command = np.zeros(MEMORY + MOST_MEMORY)
        command[:9] = *wrench, *(0.5 * wrench), 0.4, 0.5, 0.0
        command[[TIME, INTERVAL]] = 1.0, 0.1
        numbers = np.array([*parameters, *effect.in_si(units).constants], dtype=float)
        wrench = np.concatenate([wrench, np.zeros(6)])  # as the compiled loop has it
        stage.law(state.copy(), command, numbers, wrench)
        slots = 3 * stage.memory if isinstance(stage, Command) else getattr(stage, "memory", 0)
        remembered = np.zeros(slots)
        for name in ("remember", "rate", "begin"):
            if (law := getattr(stage, name, None)) is not None:
                law(state.copy(), command, numbers, remembered)
        return np.concatenate([wrench, remembered])
    if isinstance(stage, Properties):
        values = {name: np.ones((1, 1)) for name in (*COLUMNS, *SEEN)}
        values["mass"] = np.full((1, 1), units.mass)
        values["moment_per_mass"] = np.full((1, 1), body.shape.unit_moment)
        clock = Clock(np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)))
        stage.modify(values, named, clock)
        return np.concatenate([np.ravel(value) for value in values.values()])
    if isinstance(stage, Sensor):
        flat = {name: value[0] for name, value in named.items()} | {"time": np.ones(1)}
        measured = stage.measure(state[None].copy(), flat)
        return np.concatenate([np.ravel(measured), np.ravel(stage.invert(measured, flat))])
    if isinstance(stage, Structure):
        discs = [(disc.x, disc.y, disc.radius) for disc in stage.discs(named)]
        rods = [] if stage.rod is None else [tuple(stage.rod(named))]
        return np.concatenate([np.ravel(numbers) for numbers in (*discs, *rods)])
    return np.ravel(np.asarray(stage.tail(named), dtype=float))
