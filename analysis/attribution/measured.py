"""Recordings, what is physically there, and results of the loop with their judgement."""

from __future__ import annotations

import json
import re
import resource
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from running import sources

import pbrl_ppl as pp
from attribution.fitted_initial_states import forecast_errors
from pbrl_ppl import Loop, Physics, close_loop
from pbrl_ppl.criticism import NOT_CONVERGED
from pbrl_ppl.criticism.held_out import HeldOut, forecast
from pbrl_ppl.criticism.refinement import checked_histories
from pbrl_ppl.history import thinned
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import trajectory_mode
from pbrl_ppl.posterior import draws
from pbrl_ppl.reporting import plot_rollout, png
from pbrl_ppl.reporting.words import verdict_in_words
from pbrl_ppl.state import STATE

#: The recordings lie beside the project, which holds no copy.
SHARED = Path(__file__).parents[3] / "shared"
#: Of each loop.
SEED = 0
#: What the board says of a result.
JUDGEMENTS = ("right", "partly", "missed", "wrong", "unexplained", "late", "failed")
#: State dimensions whose errors are told together, and their unit.
QUANTITIES = {"angle": (("theta",), "rad"), "position": (("x", "y"), "m")}
#: The same by a reference's name; errors of others are stated in other ways than a forecast's.
_NAMED = {"theta": "angle"}
_VELOCITIES = list(STATE[3:])
#: Names in the catalogue of what references call outside of it.
_SINCE = {"load_dependent_friction": "pivot_load_friction", "stribeck": "pivot_stribeck"}
#: Laws that have another one in them.
_WITH = {"pivot_friction": {"pivot_load_friction", "pivot_stribeck"}}


@dataclass(frozen=True)
class Ahead:
    """A forecast, and the held-out errors of independent fits at its end.

    Parameters
    ----------
    seconds : float
        Length of the forecast (s).
    quantity : str
        ``angle`` (rad) or ``position`` (m, in the plane).
    declared, best : float, optional
        Root mean square errors of independent fits of the declared physics and of the best law in
        the catalogue.
    law : str
        What the best law is.
    """

    seconds: float
    quantity: str
    declared: float | None = None
    best: float | None = None
    law: str = ""


@dataclass(frozen=True)
class Recording:
    """A folder with scene.toml, train.csv and test.csv, and what independent fits found.

    Parameters
    ----------
    name : str
        Names the result's files.
    folder : Path
        Where it is.
    about, declared : str
        What was measured, and what the scene declares, one line each.
    body : str
        The only body on which names are right; any by default.
    coordinates : tuple of str, optional
        State dimensions that are used; all that were recorded by default.
    ahead : tuple of Ahead
        Forecasts to judge by; without them as far as the loop's own.
    start_rows : int, optional
        Rows that the initial state of a forecast is fitted to; filtered states by default.
    laws : tuple of str
        Effects that are physically there.
    also : tuple of str
        Effects that are as good a name, or may be there too.
    same_data : mapping of str to sequence of str
        Effects that make the same data as another.
    outside : tuple of str
        What is physically there and in no catalogue.
    expected : str
        The right verdict, where it was stated.
    sizes : dict of (str, str) to float
        Independent estimates by effect and parameter, in the catalogue's units.
    """

    name: str
    folder: Path
    about: str = ""
    declared: str = ""
    body: str = ""
    coordinates: tuple[str, ...] | None = None
    ahead: tuple[Ahead, ...] = ()
    start_rows: int | None = None
    laws: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    same_data: Mapping[str, Sequence[str]] = field(default_factory=dict)
    outside: tuple[str, ...] = ()
    expected: str = ""
    sizes: Mapping[tuple[str, str], float] = field(default_factory=dict)

    def names_of(self, law: str) -> set[str]:
        """Return the names of a law: its own, those of the same data, and of what has it in it."""
        since = {_SINCE.get(each, each) for each in self.outside}
        return {law, *self.same_data.get(law, ()), *(since & _WITH.get(law, set()))}

    @property
    def right(self) -> set[str]:
        """The names that are right, those too of what was in no catalogue and is now."""
        since = {_SINCE.get(law, law) for law in self.outside} & {one.name for one in pp.catalogue}
        return {name for law in (*self.laws, *self.also, *since) for name in self.names_of(law)}

    @property
    def is_there(self) -> bool:
        """Whether its files are."""
        return self.folder.exists()

    @property
    def inputs(self) -> tuple[Any, ...]:
        """What the loop's result depends on beside the files: what is right does not count."""
        return (self.coordinates,)

    def load(self) -> tuple[pp.Scene, pp.History, pp.History | None]:
        """Return scene, train and test, without velocities if these are not used."""
        scene = pp.Scene.load(self.folder / "scene.toml")

        def history(name: str) -> pp.History:
            frame = pd.read_csv(self.folder / f"{name}.csv")
            if self.coordinates is not None:
                unused = [key for key in STATE if key not in self.coordinates]
                frame = frame.assign(**dict.fromkeys(unused, np.nan))
            return pp.History.from_dataframe(frame, scene)

        return scene, history("train"), history("test")


def with_reference(recording: Recording) -> Recording:
    """Return a recording with the truth and the fits of its reference.json; itself without one."""
    path = recording.folder / "reference.json"
    if not path.is_file():
        return recording
    known = json.loads(path.read_text())
    return replace(
        recording,
        **_forecasts_of(known),
        same_data=known["same_data"],
        expected=known["expected"],
        **{name: tuple(known[name]) for name in ("laws", "also", "outside")},
    )


def _forecasts_of(known: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a recording that a reference's independent fits give, if any."""
    quantity = _NAMED.get(known.get("quantity", ""))
    if quantity is None:
        return {}
    best = known.get("catalogue", known["law"])
    law = next(name for name, own in known["steps"].items() if best.items() <= own.items())
    rows = re.search(r"fitted by the model to (\d+) rows", known["start"])
    ahead = tuple(
        Ahead(seconds, quantity, known["declared"][key], best[key], law)
        for seconds in known["horizons_s"]
        for key in [f"{seconds:g}"]
    )
    return {"ahead": ahead, "start_rows": int(rows[1]) if rows else None}


#: Independent fits of recordings without a reference.json are stated here; see their PROVENANCE.md.
_SWING = Recording(
    name="pendulum-swing-velocities",
    folder=SHARED / "data" / "real" / "pendulum-swing",
    about="One arm of a multi-arm pendulum on a bearing, swinging freely (Kaheman et al., arXiv"
    " 2205.06231): encoder angle and the angular velocity by a local polynomial, 50 Hz.",
    declared="a hinge and a weighed arm, moment of inertia free; no friction",
    ahead=(
        Ahead(1.0, "angle", 0.0130, 0.0025, "viscous, dry and quadratic friction"),
        Ahead(2.0, "angle", 0.0354, 0.0037, "viscous, dry and quadratic friction"),
    ),
    laws=("pivot_friction", "quadratic_drag"),
    # an encoder's zero is set by hand; beside the tilt viscous friction takes nothing off
    also=("sensor_bias", "pivot_damping"),
    same_data={"pivot_damping": ("angular_drag", "linear_drag")},
)
_RECORDINGS = (
    _SWING,
    replace(
        _SWING,
        name="pendulum-swing-angle",
        about="The same recording, the angle alone.",
        coordinates=("theta",),
    ),
    Recording(
        name="pendulum-torque",
        folder=SHARED / "measured" / "pendulum-torque",
        about="An arm with a weight at its end, swung up by a motor in its hinge (DFKI"
        " torque-limited simple pendulum): encoder angle, and the torque from the motor's current,"
        " 50 Hz. Train and test are of two controllers.",
        declared="a hinge and an arm, mass and moment of inertia free; no friction",
        coordinates=("theta",),
        ahead=(Ahead(0.2, "angle", 0.086, 0.029, "dry friction and a command 8 ms late"),),
        laws=("pivot_friction",),
        also=("actuator_delay", "sensor_bias"),
        # the outline is nominal, mass and inertia are free: all turn the angle of rest
        same_data={"sensor_bias": ("gravity_tilt", "com_offset")},
        sizes={("pivot_friction", "torque"): 0.143},
    ),
    Recording(
        name="phy180-pendulum-tt",
        folder=SHARED / "measured" / "phy180-pendulum-tt",
        about="Coins in a cup on a string, swinging freely (T. Lian, phy180_lab): angle from a"
        " phone's video by colour tracking, 20 Hz.",
        declared="a hinge, a weighed cup, centre of mass free within 2 cm; no drag",
    ),
    Recording(
        name="bam-xl330",
        folder=SHARED / "measured" / "bam-xl330",
        about="A hobby servo (Dynamixel XL330) that turns a weight at the end of an arm"
        " (Duclusaud et al., arXiv 2410.08650): encoder angle, and the stall torque at the"
        " voltage that was applied, 100 Hz. Back-EMF is not in that torque.",
        declared="a hinge and a weighed arm, moment of inertia and torque gain free; no"
        " back-EMF, no friction",
    ),
    Recording(
        name="quarter-drone",
        folder=SHARED / "measured" / "quarter-drone",
        about="A balanced arm on a hinge with a propeller at its end (PUC-Rio, quarter drone):"
        " angle, and the command of the propeller as a torque, 50 Hz.",
        declared="a hinge and an arm, mass and centre of mass free, torque in proportion to the"
        " command; no friction, no threshold of thrust",
    ),
    Recording(
        name="hovercraft",
        folder=SHARED / "measured" / "hovercraft",
        about="A palm-size hovercraft on a floor with two thrusters (EPFL, M. Pfister): motion"
        " capture seen from above, 25 Hz, and the commanded thrusts.",
        declared="mass, moment of inertia, thrust and lever by the lab; no drag",
    ),
    Recording(
        name="rocket-coast",
        folder=SHARED / "measured" / "rocket-coast",
        about="A model rocket that coasts to its apogee (Erebus; RocketPy): barometric altitude"
        " alone, 20 Hz. Train is the first part of the coast, test the rest.",
        declared="a weighed point under gravity; no drag",
    ),
    Recording(
        name="drop-basketball",
        folder=SHARED / "measured" / "drop-basketball",
        about="A ball that was dropped (de Silva et al. 2020): filmed, 15 Hz, one fall each for"
        " train and test.",
        declared="a ball under gravity; no drag",
    ),
    Recording(
        name="drop-whiffleball",
        folder=SHARED / "measured" / "drop-whiffleball",
        about="The same of a ball with holes.",
        declared="a ball under gravity; no drag",
    ),
    Recording(
        name="double-pendulum-driven",
        folder=SHARED / "data" / "real" / "double-pendulum-driven",
        about="Two arms with a motor in each hinge (DFKI double pendulum, design C.1; Wiebe et al.,"
        " doi 10.1109/MRA.2023.3341257): angles, velocities by a local polynomial, torques from"
        " the motors' currents, 100 Hz.",
        declared="two hinges, two arms with free mass, moment of inertia and centre of mass; no"
        " friction",
        ahead=(Ahead(0.1, "angle", 0.0641, 0.0095, "dry friction in both hinges"),),
        laws=("pivot_friction",),
        also=("sensor_bias",),
    ),
    Recording(
        name="planar-push",
        folder=SHARED / "contact" / "planar-push",
        about="A steel block pushed over a table by a robot's finger (Zhou et al., arXiv"
        " 1602.06056): motion capture of the block before and after each push, of the finger all"
        " the way.",
        declared="a weighed block and the finger's path; nothing of the table",
        ahead=(
            Ahead(6.7, "position", 0.0050, 0.00149, "quasi-static ellipsoidal limit surface"),
            Ahead(6.7, "angle", 0.0419, 0.0241, "quasi-static ellipsoidal limit surface"),
        ),
        laws=("sliding_friction",),
    ),
)
#: The measured recordings, in the order of the page.
MEASURED = tuple(map(with_reference, _RECORDINGS))


@dataclass(frozen=True)
class Result:
    """What the loop found on a recording.

    Parameters
    ----------
    name : str
        Of the recording.
    method, sources, version : str
        Of the posteriors, hash of the package's files, and the package's version.
    seed : int
        Of the loop.
    verdict, sentence : str
        The loop's verdict in a word and in a sentence; ``failed`` or ``late`` where it gave none.
    added : tuple of dict
        As in ``report.json``: effect, body, parameters with mean, interval and unit, and effects
        that are not separable from it.
    errors : tuple of dict
        Of each forecast: seconds, quantity, unit, before and after (root mean square).
    error : str, optional
        Why there is no verdict.
    seconds : float
        Processor time of the process until the verdict (s).
    """

    name: str
    method: str
    seed: int
    sources: str
    version: str
    verdict: str = "failed"
    sentence: str = ""
    added: tuple[dict[str, Any], ...] = ()
    errors: tuple[dict[str, Any], ...] = ()
    error: str | None = None
    seconds: float = 0.0

    @classmethod
    def of(cls, recording: Recording, method: str, **found: Any) -> Result:
        """Return a result by the present code, its processor time so far by default."""
        about = (recording.name, method, SEED, sources(), pp.__version__)
        return cls(*about, **{"seconds": time.process_time() + children()} | found)

    def save(self, path: Path) -> None:
        """Write the result as JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> Result | None:
        """Return a stored result, if any."""
        if not path.is_file():
            return None
        kept = json.loads(path.read_text())
        return cls(**kept | {key: tuple(kept[key]) for key in ("added", "errors")})

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        """Return each added effect with its confounded effects."""
        return tuple((each["effect"], *each["not_separable_from"]) for each in self.added)


def false_names(recording: Recording, result: Result) -> list[str]:
    """Return the added effects that are not right, and confounded with none that is."""
    right, body = recording.right, recording.body
    return [
        group[0]
        for each, group in zip(result.added, result.names, strict=True)
        if not right & set(group) or body not in ("", each["body"])
    ]


def missing_laws(recording: Recording, result: Result) -> list[str]:
    """Return the laws that are physically there and were not named."""
    named = {name for group in result.names for name in group}
    return [law for law in recording.laws if not recording.names_of(law) & named]


def judgement(recording: Recording, result: Result, limit: float = np.inf) -> str:
    """Return how right a result is, one of `JUDGEMENTS`.

    Parameters
    ----------
    recording : Recording
        With what is physically there.
    result : Result
        The loop's. Each group of confounded effects is right if one of them is.
    limit : float
        Processor time (s) after which a verdict is late.

    Returns
    -------
    str
        ``wrong`` if a name is; ``right`` if no law is missing. ``unexplained`` if the loop says
        that something is, beside names that are right, and this is not the expected verdict. Else
        ``partly`` if some laws are named, and ``missed`` if none is.
    """
    if result.verdict == "late" or result.seconds > limit:
        return "late"
    if result.error is not None or result.verdict == NOT_CONVERGED:
        return "failed"
    if false_names(recording, result):
        return "wrong"
    missing = missing_laws(recording, result)
    some = len(missing) < len(recording.laws)
    is_open = result.verdict == "unexplained"
    as_expected = not missing and "unexplained" in recording.expected
    if is_open and (some or not recording.laws) and not as_expected:
        return "unexplained"
    if missing:
        return "partly" if some else "missed"
    # of what no catalogue has, a verdict is the only trace
    silent = not recording.laws and recording.outside and not (is_open or result.added)
    return "missed" if silent else "right"


def children() -> float:
    """Return the processor time of ended child processes (s)."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run(
    recording: Recording,
    path: Path,
    method: str = "laplace",
    limit: int = 0,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Run the loop on a recording and write its result, as soon as there is a verdict.

    Errors of forecasts and a picture of a recording that the page shows follow.

    Parameters
    ----------
    recording : Recording
        Its files exist.
    path : Path
        The result's file (.json). The picture (.png) is beside it.
    method : str
        Of the posteriors, as of ``close_loop``.
    limit : int
        Processor time (s) after which the process ends without a verdict, and the same again for
        the forecasts; 0 is none.
    progress : callable, optional
        Called with the name of each stage.
    """
    if limit:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (limit, 2 * limit))
    warnings.simplefilter("ignore")  # the result says what matters of them
    try:
        scene, train, test = recording.load()
        found = close_loop(scene, train, test, seed=SEED, method=method, progress=progress)
    except Exception as error:  # it is a row of the board
        why = f"{type(error).__name__}: {error}"
        Result.of(recording, method, error=why).save(path)
        return
    sentence, added = verdict_in_words(found), tuple(found.to_dict()["added"])
    done = Result.of(recording, method, verdict=found.verdict, sentence=sentence, added=added)
    done.save(path)
    if recording.about and test is not None:
        if limit:
            resource.setrlimit(resource.RLIMIT_CPU, (2 * limit, 2 * limit))
        replace(done, errors=errors_ahead(recording, found, train, test)).save(path)
        path.with_suffix(".png").write_bytes(picture(found))


def errors_ahead(
    recording: Recording, found: Loop, train: pp.History, test: pp.History
) -> tuple[dict[str, Any], ...]:
    """Return held-out errors of each forecast, before and after; None for short trajectories."""
    scene = found.scene
    step = round(scene.time_step / train.dataset.attrs["time_step"])
    _, (train, test), _ = thinned(scene, train, test)
    start_rows = recording.start_rows and max(recording.start_rows // step, 3)
    train, test, *_ = checked_histories(scene, train, test)
    by_name = {effect.name: effect for effect in pp.catalogue}
    added = [by_name[each.effect].on(each.body) for each in found.added]
    models = [(found.posterior_before, ())]
    if added:
        models.append((found.posterior_after, added))
    forecasts = []
    for posterior, effects in models:
        physics = Physics.declare(scene, effects, substeps=found.numerical.substeps_used, threads=2)
        problem, drawn = Problem.of(physics, train), draws(posterior)
        phi = problem.layout.to_vectors(drawn, len(drawn["sigma"])).mean(axis=0)
        forecasts.append(_forecasts(problem, phi, test, start_rows))
    own = found.forecasts.horizon * scene.time_step
    asked = recording.ahead or tuple(Ahead(own, quantity) for quantity in QUANTITIES)
    rows = []
    for each in asked:
        dimensions, unit = QUANTITIES[each.quantity]
        errors = []
        for rmse in (ahead(round(each.seconds / scene.time_step)) for ahead in forecasts):
            square = [rmse[name] ** 2 for name in dimensions if name in rmse]
            errors.append(float(np.sqrt(sum(square))) if square else None)
        row = {"seconds": each.seconds, "quantity": each.quantity, "unit": unit}
        rows.append(row | {"before": errors[0], "after": errors[-1]})
    if recording.ahead:
        return tuple(rows)
    return tuple(row for row in rows if row["before"] is not None)


def _forecasts(
    problem: Problem, phi: NDArray[np.float64], test: pp.History, start_rows: int | None
) -> Callable[[int], dict[str, float]]:
    """Return the function of a forecast's intervals that gives errors by state dimension."""
    if start_rows is not None:
        return partial(forecast_errors, problem, phi, test, start_rows)
    mode = trajectory_mode(problem, phi)
    held_out = HeldOut.of(mode, test).problem
    return lambda intervals: forecast(held_out, mode.phi, mode.sigma, intervals).rmse()


def picture(found: Loop) -> bytes:
    """PNG of positions and angle of a held-out trajectory, measured and forecast from its start."""
    shown = found.forecasts.rollout
    columns = [place for place, name in enumerate(shown.names) if name not in _VELOCITIES]

    def of(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values[:, columns]

    places = replace(
        shown,
        names=tuple(shown.names[place] for place in columns),
        units=tuple(shown.units[place] for place in columns),
        measured=of(shown.measured),
        before=of(shown.before),
        after=of(shown.after),
    )
    forecasts = replace(found.forecasts, rollout=places)
    return png(plot_rollout(replace(found, forecasts=forecasts)))
