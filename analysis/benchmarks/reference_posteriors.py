"""Moments of posteriors from long runs, to test samplers against.

    python analysis/benchmarks/reference_posteriors.py ../shared/data              # all, and store
    python analysis/benchmarks/reference_posteriors.py ../shared/data --check --only cart-null

The cart recordings in FOLDER under Eq. 11, and the first trajectories of some as whole ones; most
with the effect of their truth. Stored are means and standard deviations of all parameters and their
Monte Carlo standard errors, no measured rows. ``--check`` compares what is stored with
sequential Monte Carlo and with short default fits, and stores nothing. Some minutes.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
from scipy.stats import norm

import pbrl_ppl as pp
from pbrl_ppl.model import problem_in
from pbrl_ppl.modes import Mode, find_trajectory_mode
from pbrl_ppl.parameters import by_prior
from pbrl_ppl.posterior import convergence, parameter_draws

STORED = Path(__file__).parents[2] / "tests" / "sampling" / "reference_posteriors.json"
#: The recordings, and the effect that is added to the scene: that of the truth.
RECORDINGS = {
    "cart-linear-drag": "linear_drag",
    "cart-null": None,
    "cart-offset-push": None,
    "cart-slope": "constant_force",
    "cart-thrust-bias": "body_force",
}
#: Recorded trajectories that are fitted, the first ones: all under Eq. 11.
KINDS = {"transitions": 12, "trajectories": 4}
#: Seed of the search for the mode at which whole trajectories are linearised.
MODEL_SEED = 0
#: Probability that a correct sampler fails the comparison of one case: 4 sigma, two-sided.
FALSE_ALARM = 2 * float(norm.sf(4.0))
#: The long runs.
LONG: dict[str, Any] = {"method": "importance", "draws": 2500, "chains": 4, "seed": 1}
PARTICLES: dict[str, Any] = {"method": "smc", "draws": 1000, "chains": 4, "seed": 2}
#: Seeds of the short fits that check whether effective sample sizes are true.
SEEDS = range(11, 15)


@dataclass(frozen=True)
class Moments:
    """Mean and standard deviation of a parameter, each with its Monte Carlo standard error."""

    mean: float
    sd: float
    mean_error: float
    sd_error: float

    @property
    def size(self) -> float:
        """Effective sample size."""
        return (self.sd / self.mean_error) ** 2


def declared(folder: Path, case: str, kind: str) -> tuple[pm.Model, Mode | None]:
    """Return the model of a recording, with the effect added to it, and its mode.

    The mode is that of whole trajectories, which are linearised there.
    """
    scene = pp.Scene.load(folder / case / "scene.toml")
    history = pp.History.load(folder / case / "train.csv", scene)
    history = history.select(range(KINDS[kind]))
    effects = [effect for effect in pp.catalogue if effect.name == RECORDINGS[case]]
    model = pp.physics_model(scene, history, effects, likelihood=kind)
    if kind == "transitions":
        return model, None
    return model, find_trajectory_mode(problem_in(model), MODEL_SEED)


def moments(model: pm.Model, idata: Any) -> dict[str, Moments]:
    """Return moments by label, of wheels folded onto one description.

    Where the prior is log-normal, they are those of the logarithm: the posterior of a parameter
    that the data do not inform has tails too heavy for its moments. The error of
    a standard deviation is that of as many independent draws of this kurtosis.
    """
    layout = problem_in(model).layout
    phi, sigma = parameter_draws(problem_in(model), idata)
    phi = by_prior(layout, phi, equal_alone=True)
    columns: dict[str, Any] = {}
    for label, prior, x in zip(layout.labels, layout.priors, phi.T, strict=True):
        columns[label] = np.log(x) if prior.family == "log_normal" else x
    columns |= dict(zip(problem_in(model).noise_labels, sigma.T, strict=True))
    sizes, result = convergence(idata)[1], {}
    for label, x in columns.items():
        mean, sd, n = float(x.mean()), float(x.std()), sizes[label]
        kurtosis = float(((x - mean) ** 4).mean()) / sd**4
        error = sd * math.sqrt((kurtosis - 1) / (4 * n))
        result[label] = Moments(mean, sd, sd / math.sqrt(n), error)
    return result


def differences(found: dict[str, Moments], reference: dict[str, Moments]) -> dict[str, float]:
    """Return differences of means and standard deviations in Monte Carlo standard errors.

    The errors are of both runs. Those of the shorter run follow from its effective sample size and
    the reference's moments, which are known better.
    """
    if found.keys() != reference.keys():
        raise ValueError(
            f"parameters are {', '.join(found)}, those of the reference {', '.join(reference)}"
        )
    result = {}
    for label, there in reference.items():
        here = found[label]
        factor = math.sqrt(1 + there.size / here.size)
        result[f"mean of {label}"] = (here.mean - there.mean) / (factor * there.mean_error)
        result[f"sd of {label}"] = (here.sd - there.sd) / (factor * there.sd_error)
    return result


def bound(comparisons: int) -> float:
    """Return the largest difference of so many (Bonferroni), in standard errors."""
    return float(norm.isf(FALSE_ALARM / comparisons / 2))


def fitted(model: pm.Model, **options: Any) -> tuple[dict[str, Moments], str]:
    """Return a fit's moments, and how it went."""
    begin = time.perf_counter()
    idata = pp.fit(model, progress=False, **options)
    took, (r_hat, size) = time.perf_counter() - begin, convergence(idata)
    how = f"{idata.attrs['method']}, {took:.0f} s, R-hat {max(r_hat.values()):.3f}"
    how += f", least ESS {min(size.values()):.0f}"
    if "pareto_k" in idata.attrs:
        how += f", Pareto k {idata.attrs['pareto_k']:.2f}"
    if "proposals" in idata.attrs:
        how += f", proposals: {idata.attrs['proposals']}"
    return moments(model, idata), how


def load_reference() -> dict[str, dict[str, Any]]:
    """Return what is stored, by case and kind: the mode, and Moments by label."""
    stored = json.loads(STORED.read_text())
    for entry in stored.values():
        entry["moments"] = {label: Moments(*row) for label, row in entry["moments"].items()}
    return stored


def store(folder: Path, cases: list[str], kinds: list[str]) -> None:
    """Store the moments of long runs."""
    stored = load_reference() if STORED.exists() else {}
    for kind in kinds:
        for case in cases:
            model, mode = declared(folder, case, kind)
            found, how = fitted(model, start=mode, **LONG)
            print(f"{case} {kind}: {how}", flush=True)
            at = None if mode is None else list(mode.phi)
            stored[f"{case} {kind}"] = {"mode": at, "moments": found}
            write(stored)


def write(stored: dict[str, dict[str, Any]]) -> None:
    """Write the moments, a line each; six digits are more than their errors warrant."""

    def line(name: str, values: Any) -> str:
        numbers = values and [float(f"{value:.6g}") for value in values]
        return f"  {json.dumps(name)}: {json.dumps(numbers)}"

    entries = []
    for key, entry in stored.items():
        rows = [line(label, asdict(one).values()) for label, one in entry["moments"].items()]
        parts = [line("mode", entry["mode"]), '  "moments": {', ",\n".join(rows), "  }"]
        entries.append(f" {json.dumps(key)}: {{\n{parts[0]},\n" + "\n".join(parts[1:]) + "\n }")
    STORED.write_text("{\n" + ",\n".join(entries) + "\n}\n")


def check(folder: Path, cases: list[str], kinds: list[str]) -> None:
    """Compare what is stored with particles, and with short fits of several seeds."""
    stored = load_reference()
    for case in cases:
        for kind in kinds:
            reference = stored[f"{case} {kind}"]["moments"]
            model, mode = declared(folder, case, kind)
            found, how = fitted(model, start=mode, **PARTICLES)
            print(f"{case} {kind}\n  {how}: {worst(differences(found, reference))}", flush=True)
            every = []
            for seed in SEEDS:
                found, how = fitted(model, start=mode, seed=seed)
                off = differences(found, reference)
                every += off.values()
                print(f"  seed {seed}: {how}: {worst(off)}", flush=True)
            print(f"  rms of all {len(every)}: {np.sqrt(np.mean(np.square(every))):.2f}")


def worst(off: dict[str, float]) -> str:
    """Return a line on differences: their root mean square, and the three largest."""
    largest = sorted(off, key=lambda name: -abs(off[name]))[:3]
    rms = math.sqrt(np.mean(np.square(list(off.values()))))
    names = ", ".join(f"{name} {off[name]:+.1f}" for name in largest)
    return f"rms {rms:.2f}; {names}; bound {bound(len(off)):.2f}"


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="has the five cart recordings")
    parser.add_argument("--only", nargs="+", choices=RECORDINGS, default=list(RECORDINGS))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--check", action="store_true", help="compare with what is stored")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    if arguments.check:
        check(arguments.folder, arguments.only, arguments.kinds)
    else:
        store(arguments.folder, arguments.only, arguments.kinds)


if __name__ == "__main__":
    main()
