"""Draws over discrete choices: what joints join, and which parameter set a body has."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import xarray as xr

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import (
    Mode,
    Pair,
    Weighed,
    choose_from_library,
    index_law,
    library_of,
    profile_sigma,
    stored,
)
from pbrl_ppl.parameters import JOINT_ANCHORS, JOINT_INDICES
from pbrl_ppl.posterior import Idata, ParameterPoint, from_groups, group, groups, parameter_draws
from pbrl_ppl.sampling.methods import SamplerRun, as_trace, posterior_dataset
from pbrl_ppl.state import Bools, Floats, Ints


def mix(job: SamplerRun, weighed: Sequence[Weighed], sample: Callable[[Mode], Idata]) -> Idata:
    """Sample each configuration that matters, and mix the draws by their probabilities.

    The number of draws of each is fixed, their order in the chains is random. A pair's
    bodies are in the order of ``scene.joinable`` (``i_a < i_b``), for the other order is the same
    joint, unless the two indices have different priors: then each order has its share. A joint that
    joins nothing has ``i_a = i_b`` and anchors from their prior.

    Parameters
    ----------
    job : SamplerRun
        Of a scene with joints of unknown bodies.
    weighed : sequence of Weighed
        Configurations with their probabilities.
    sample : callable
        ``sample(mode) -> trace`` of a configuration.

    Returns
    -------
    InferenceData or DataTree
        With ``posterior``, ``sample_stats``, ``observed_data`` and ``constant_data``, and the
        configurations as an attribute.
    """
    draws, chains, rng = job.method.draws, job.method.chains, np.random.default_rng(job.seed)
    probability = np.array([configuration.probability for configuration in weighed])
    wanted = np.flatnonzero(allocate(probability, chains * draws))
    traces = {}
    for i in wanted[np.argsort(-probability[wanted])]:
        traces[i] = sample(weighed[i].mode)
        done = group(traces[i], "posterior").sizes
        if done["chain"] < chains or (done["draw"] < draws and len(traces) < len(wanted)):
            raise KeyboardInterrupt  # PyMC ended quietly, and some have no draws at all
    draws = min(group(trace, "posterior").sizes["draw"] for trace in traces.values())
    fitted = np.isin(np.arange(len(weighed)), list(traces))
    counts = allocate(np.where(fitted, probability, 0.0), chains * draws)
    label = rng.permutation(np.repeat(np.arange(len(weighed)), counts)).reshape(chains, draws)
    values = _values(job.problem, weighed, traces, label, rng)
    data = groups(next(iter(traces.values()))) | {
        "posterior": posterior_dataset(job.problem, values), "sample_stats": _stats(traces, label)
    }  # fmt: skip
    return from_groups(data, {"configurations": stored(weighed)})


def most_probable(problem: Problem, weighed: Sequence[Weighed]) -> ParameterPoint:
    """Return the mode of the most probable configuration, as a point of the whole model.

    Anchors of joints that join nothing are at the centre of their prior.

    Parameters
    ----------
    problem : Problem
        Of a scene with joints of unknown bodies.
    weighed : sequence of Weighed
        Configurations with their probabilities.
    """
    best = max(weighed, key=lambda configuration: configuration.probability)
    layout = problem.layout
    values = dict(zip(best.mode.problem.layout.labels, best.mode.phi.tolist(), strict=True))
    phi = np.array([values.get(label, np.nan) for label in layout.labels])[None]
    for joint, pair in best.configuration.pairs:
        law = _index_law(problem, joint, pair)
        _put_indices(problem, phi, np.array([True]), joint, np.array([law.argmax()]))
    _fill_anchors(problem, phi, None)
    return ParameterPoint(phi[0], best.mode.sigma)


def allocate(probability: Floats, n: int, *, negligible: float = 1e-3) -> Ints:
    """Share ``n`` draws out by probability, to within one draw each (largest remainders).

    What is less probable than the share ``negligible`` of the best gets no draws.

    Examples
    --------
    >>> allocate(np.array([0.7, 0.2995, 0.0005]), 1000)
    array([700, 300,   0])
    """
    kept = np.where(probability < negligible * probability.max(), 0.0, probability)
    ideal = n * kept / kept.sum()
    counts = np.floor(ideal).astype(np.int64)
    rest = n - int(counts.sum())
    counts[np.argsort(counts - ideal, kind="stable")[:rest]] += 1
    return np.asarray(counts)


def _values(
    problem: Problem,
    weighed: Sequence[Weighed],
    traces: Mapping[int, Idata],
    label: Ints,
    rng: np.random.Generator,
) -> dict[str, Floats]:
    """Return the whole model's variables, shape (chain, draw, ...), from the traces."""
    layout = problem.layout
    phi = np.full((*label.shape, layout.size), np.nan)
    sigma = np.empty((*label.shape, sum(map(len, problem.noise_variables.values()))))
    for i, trace in traces.items():
        own, here = weighed[i].mode.problem, label == i
        if own.noise_labels != problem.noise_labels:
            raise FitError(
                "fit: choices of the bodies that a joint joins have different coordinates;"
                " take --likelihood transitions, or name the bodies in the scene"
            )
        chain, draw = np.nonzero(here)
        rows = chain * group(trace, "posterior").sizes["draw"] + draw
        of_phi, of_sigma = parameter_draws(own, trace)
        sigma[here] = of_sigma[rows]
        for name, values in zip(own.layout.labels, of_phi[rows].T, strict=True):
            phi[here, layout.labels.index(name)] = values
        for joint, pair in weighed[i].configuration.pairs:
            law = _index_law(problem, joint, pair)
            drawn_pairs = rng.choice(law.size, size=int(here.sum()), p=law.ravel())
            _put_indices(problem, phi, here, joint, drawn_pairs)
    _fill_anchors(problem, phi, rng)
    named = problem.named(phi, sigma)
    return named | {name: named[name].astype(int) for name in JOINT_INDICES}


def _index_law(problem: Problem, joint: str, pair: Pair) -> Floats:
    """Return the probabilities of (i_a, i_b) of what a joint joins, shape (name, name)."""
    places = (problem.layout.index(name, joint) for name in JOINT_INDICES)
    a, b = (problem.layout.priors[place].probabilities for place in places)
    return index_law(pair, problem.scene, a, b)


def _put_indices(problem: Problem, phi: Floats, here: Bools, joint: str, chosen: Ints) -> None:
    """Put indices of the flat table of (i_a, i_b) into phi, and swap the anchors, in place."""
    layout, some = problem.layout, phi[here]
    a, b = (layout.index(name, joint) for name in JOINT_INDICES)
    some[:, a], some[:, b] = np.divmod(chosen, len(problem.scene.joinable))
    turned = some[:, a] > some[:, b]
    anchors = np.array([layout.index(name, joint) for name in JOINT_ANCHORS])
    swapped = some[:, np.roll(anchors, 2)]
    some[:, anchors] = np.where(turned[:, None], swapped, some[:, anchors])
    phi[here] = some


def _fill_anchors(problem: Problem, phi: Floats, rng: np.random.Generator | None) -> None:
    """Draw the anchors of joints that join nothing from their prior, given the index, in place.

    At the prior's centre without a generator.
    """
    layout = problem.layout
    for block in layout.blocks:
        for owner, conditional in zip(block.owners, block.conditional, strict=False):
            column = phi[..., layout.index(block.name, owner)]
            missing = np.isnan(column)
            if not missing.any():  # among them are joints whose bodies are named
                continue
            index = phi[..., layout.index(f"i_{block.name[0]}", owner)]
            for i, prior in enumerate(conditional):
                here = missing & (index == i)
                n = int(here.sum())
                column[here] = prior.centre if rng is None else prior.sample(rng, n)


def _stats(traces: Mapping[int, Idata], label: Ints) -> xr.Dataset:
    """Return the samplers' statistics of each draw; NaN for one that a sampler does not have."""
    mixed: dict[str, Floats] = {}
    for i, trace in traces.items():
        of_trace = group(trace, "sample_stats").isel(draw=slice(label.shape[1]))
        for name, variable in of_trace.data_vars.items():
            if variable.dims == ("chain", "draw"):
                values = mixed.setdefault(str(name), np.full(label.shape, np.nan))
                values[label == i] = variable.to_numpy()[label == i]
    return xr.Dataset(
        {name: (("chain", "draw"), values) for name, values in mixed.items()},
        {dim: np.arange(n) for dim, n in zip(("chain", "draw"), label.shape, strict=True)},
    )


def summed(problem: Problem, draws: int, chains: int, seed: int) -> tuple[Idata, ParameterPoint]:
    """Return draws by summing over the choices, and the most probable choice.

    Parameters
    ----------
    problem : Problem
        Of a model with a library.
    draws, chains, seed : int
        As for :func:`pbrl_ppl.fit`.
    """
    phi, sigma, index, best = choose_from_library(problem, draws, chains, seed)
    values: dict[str, Floats | Ints] = {**problem.layout.to_dict(phi), "library_index": index}
    values["sigma"] = sigma[..., 0] if problem.likelihood.scalar else sigma
    return as_trace(problem, values, {"accept": np.ones((chains, draws))}), _point(problem, best)


def most_frequent(problem: Problem, trace: Idata) -> ParameterPoint:
    """Return the most frequent choice among the draws, jointly for bodies that meet.

    Parameters
    ----------
    problem : Problem
        Problem with a library.
    trace : InferenceData or DataTree
        Its draws.
    """
    drawn = group(trace, "posterior")["library_index"].transpose("chain", "draw", ...)
    index = drawn.to_numpy().reshape(-1, drawn.shape[-1])
    names = list(problem.scene.owners)
    best = np.zeros(index.shape[1], dtype=np.intp)
    for part in problem.physics.simulator.parts:
        columns = [names.index(owner) for owner in part.physics.scene.owners]
        choices, counts = np.unique(index[:, columns], axis=0, return_counts=True)
        best[columns] = choices[counts.argmax()]
    return _point(problem, best)


def _point(problem: Problem, choice: Ints) -> ParameterPoint:
    """Return the parameters of a choice (owner,), with the most probable sigma."""
    table = library_of(problem).table(problem.layout, problem.scene)
    names = list(problem.scene.owners)
    owners = [owner for block in problem.layout.blocks for owner in block.owners]
    phi = table[np.arange(len(owners)), choice[[names.index(owner) for owner in owners]]]
    return ParameterPoint(phi, profile_sigma(problem, problem.residual(phi), phi), choice)
