"""Report of any posterior file: what is known, whether it can be relied on, and how it predicts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import PbrlError, PosteriorError
from pbrl_ppl.posterior import (
    Identifiability,
    compare,
    group,
    groups,
    identify,
    likelihood_name,
    scalars,
    scene_of,
)
from pbrl_ppl.reporting.loop_tables import loo_table
from pbrl_ppl.reporting.page import Source, Table, render_page
from pbrl_ppl.reporting.posterior_plots import (
    MOST_PRIORS,
    Coverage,
    coverage,
    most_dependent,
    pareto_k,
    plot_pairs,
    plot_pareto,
    plot_predictions,
    plot_prior,
    plot_rank,
    plot_trace,
)
from pbrl_ppl.reporting.posterior_tables import parameter_section
from pbrl_ppl.reporting.scene_plots import plot_recording
from pbrl_ppl.reporting.words import plain
from pbrl_ppl.state import Floats

#: Fewest draws for diagnostics of chains, densities and cross-validation.
LEAST_DRAWS = 100


def render_posterior(
    posterior: Any, effects: Iterable[Effect] = full_catalogue, source: Source | None = None
) -> str:
    """Render the report of a posterior: one page of HTML that needs nothing else.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, :func:`pbrl_ppl.update` or read from a file.
    effects : iterable of Effect
        Where the names of its effects are looked up; add your own to the package's.
    source : Source, optional
        The command that makes the page again.

    Returns
    -------
    str
        The page.

    Raises
    ------
    PosteriorError
        If it lacks a group, or has fewer than 100 draws, as one of a mode alone.

    Examples
    --------
    ::

        page = render_posterior(pp.load_posterior("cart.nc"))
        Path("cart.html").write_text(page, encoding="utf-8")
    """
    effects = tuple(effects)
    scene = scene_of(posterior)
    sizes = group(posterior, "posterior").sizes
    if sizes["chain"] * sizes["draw"] < LEAST_DRAWS:
        raise PosteriorError(
            f"posterior: it has {sizes['chain'] * sizes['draw']} draws, a report needs at least"
            f" {LEAST_DRAWS}; fit with a method that draws, and more draws"
        )
    pairs, draws = most_dependent(posterior), scalars(posterior)
    moving = [str(name) for name, values in draws.items() if float(values.max() - values.min()) > 0]
    priors = (moving or list(map(str, draws)))[:MOST_PRIORS]
    missing: dict[str, str] = {}
    known = _or_why(lambda: identify(posterior, effects=effects), "identifiability", missing)
    section = parameter_section(posterior, effects, known)
    covered = _or_why(lambda: coverage(posterior), "predictions", missing)
    k = _or_why(lambda: pareto_k(posterior), "loo", missing)
    compared = None if k is None else compare(posterior, posterior)
    pictures: dict[str, Callable[[float], Figure]] = {
        "prior": partial(plot_prior, posterior, priors),
        "trace": partial(plot_trace, posterior, section["shown"]),
        "rank": partial(plot_rank, posterior, section["shown"]),
    }
    if pairs:
        pictures["pairs"] = partial(plot_pairs, posterior, pairs)
    if covered:
        pictures["predictions"] = partial(plot_predictions, posterior)
    if k is not None:
        pictures["pareto"] = partial(plot_pareto, *k)
    poses = recorded_poses(posterior)
    if poses is not None and np.isfinite(poses[..., :2]).any():
        pictures["scene"] = partial(plot_recording, scene, poses, None)
    return render_page(
        "posterior.html.jinja",
        pictures,
        bodies=[body.name for body in scene.moving],
        headline=_headline(posterior, known),
        sentences=() if known is None else known.sentences,
        predicts=_predicts(covered, missing),
        warnings=_warned(posterior, known is not None),
        about=_about(posterior),
        has_prior="prior" in groups(posterior),
        shown_priors=priors,
        pairs=pairs,
        covered=covered and _coverage_table(covered),
        loo=compared and loo_table(compared, ["Value"]),
        missing=missing,
        source=source or Source(command="render_posterior(pp.load_posterior(...))"),
        refit=_refit(posterior),
        origin=_origin(posterior),
        scene_toml=scene.to_toml(),
        **section,
    )


def recorded_poses(posterior: Any) -> Floats | None:
    """Return the recorded poses that a posterior holds, shape (trajectory, time, body, 3)."""
    if "scene" not in posterior.attrs:
        return None
    given = group(posterior, "constant_data")
    if "recorded_start" in given:
        return np.asarray(given["recorded_start"].to_numpy()[..., :3])
    # single transitions: the start of each, in order
    return np.asarray(given["start"].to_numpy()[None, ..., :3])


def _or_why(compute: Callable[[], Any], name: str, missing: dict[str, str]) -> Any:
    """Return the result of a computation; if it fails, None, and note the reason for the page."""
    try:
        return compute()
    except PbrlError as error:
        missing[name] = f"Not available: {error}"
        return None


def _headline(posterior: Any, informed_by: Identifiability | None) -> str:
    scene, attrs = scene_of(posterior), posterior.attrs
    bodies = ", ".join(body.name for body in scene.dynamic)
    effects = json.loads(str(attrs.get("effects", "[]")))
    effects = [f"{plain(name)} of {body}" for name, body in effects]
    text = f"Posterior of {bodies}{' with ' + ', '.join(effects) if effects else ''}"
    if informed_by is None:
        return f"{text}: {len(scalars(posterior).data_vars)} parameters"
    verdicts = [width.verdict for width in informed_by.parameters]
    informed, weak, kept = map(verdicts.count, ("informed", "weak", "prior only"))
    text += f". The data inform {informed} of {len(verdicts)} parameters"
    if weak:
        text += f", {weak} more weakly"
    if kept:
        text += f"; {kept} {'keep their' if kept > 1 else 'keeps its'} prior"
    return f"{text}."


def _predicts(covered: Mapping[str, Coverage] | None, missing: dict[str, str]) -> str:
    if not covered:
        return missing.get("predictions", "It holds no predictions.")
    inside = [each.wide for each in covered.values()]
    low, high = min(inside), max(inside)
    return (
        f"Intervals that should hold 94 % of measurements hold {100 * low:.0f} to"
        f" {100 * high:.0f} % of them, in {len(covered)} state dimensions, each transition"
        " predicted without itself."
    )


def _warned(posterior: Any, identified: bool) -> list[str]:
    """Return the warnings of the fit, without those that other parts of the page cover."""
    every = json.loads(str(posterior.attrs.get("warnings", "[]")))
    covered = (
        "have not converged",
        "draws are too few",
        *(("say nothing about",) if identified else ()),
    )
    return [each for each in every if not any(words in each for words in covered)]


def _about(posterior: Any) -> str:
    attrs, sizes = posterior.attrs, group(posterior, "posterior").sizes
    transitions = group(posterior, "observed_data").sizes["transition"]
    horizon = int(attrs.get("horizon", 1))
    names = {"trajectories": "whole trajectories", "transitions": "transitions, Eq. 11"}
    likelihood = names.get(likelihood_name(posterior), "simulations")
    if horizon > 1:
        kind = "simulations" if likelihood == "simulations" else "segments"
        likelihood = f"{kind} of {horizon} intervals"
    return (
        f"{transitions} transitions; likelihood of {likelihood}; sampler"
        f" {attrs.get('method', 'unknown')}, {sizes['chain']} chains of {sizes['draw']} draws."
    )


def _coverage_table(covered: Mapping[str, Coverage]) -> Table:
    return Table(
        "Measurements inside leave-one-out predictions",
        ("State dimension", "In the central 50 %", "In the central 94 %", "Measurements"),
        [
            (name, f"{100 * each.half:.1f} %", f"{100 * each.wide:.1f} %", str(each.measurements))
            for name, each in covered.items()
        ],
    )


def _refit(posterior: Any) -> str:
    """Return the lines of Python that make the posterior again from its recording."""
    attrs, draws = posterior.attrs, group(posterior, "posterior")
    options = []
    name = likelihood_name(posterior)
    if name != "transitions":
        options.append(f'likelihood="{name}"')
    elif int(attrs.get("horizon", 1)) > 1:
        options.append(f"horizon={int(attrs['horizon'])}")
    if attrs.get("scalar_sigma"):
        options.append('sigma="scalar"')
    if "nu" in attrs:
        options.append(f"nu={float(attrs['nu']):g}")
    if "library" in attrs:
        options.append("library=...")
    options.append(f"substeps={int(attrs['substeps'])}")
    lines = [
        "import pbrl_ppl as pp",
        "scene = pp.Scene.load(...)  # as below",
        "history = pp.History.load(..., scene)",
        f"model = pp.physics_model(scene, history, {', '.join(options)})",
        f"idata = pp.fit(model, method={str(attrs.get('method', 'metropolis'))!r},"
        f" seed={int(attrs['seed'])}, draws={draws.sizes['draw']}, chains={draws.sizes['chain']})",
    ]
    if "updates" in attrs:
        lines.append("# and updates since, which attrs['updates'] lists")
    return "\n".join(lines)


def _origin(posterior: Any) -> dict[str, str]:
    """Return the attributes on a posterior's origin: seed, data, method, versions."""
    attrs = posterior.attrs
    names = ("seed", "data_sha256", "method", "substeps", "horizon", "updates")
    origin = {name: str(attrs[name]) for name in names if name in attrs}
    versions = json.loads(str(attrs.get("versions", "{}")))
    return origin | {"versions": ", ".join(f"{name} {number}" for name, number in versions.items())}
