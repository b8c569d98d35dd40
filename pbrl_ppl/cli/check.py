"""``pbrl-ppl check`` and ``criticise`` of a recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.app import command
from pbrl_ppl.cli.terminal import PlainConsole, Progress, Result, sizes, table
from pbrl_ppl.state import STATE

if TYPE_CHECKING:
    from rich.table import Table

    from pbrl_ppl.criticism import Attribution, Law, PriorCheck
    from pbrl_ppl.effects import Effect
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene


@command("check", 2, "pbrl-ppl check scene.toml train.csv")
def check(
    scene: Path,
    history: list[Path],
    reading: options.SceneReading,
    progress: Progress,
    as_json: bool,
    prior: Annotated[bool, typer.Option()] = True,
    draws: Annotated[int, typer.Option(min=50)] = 400,
    seed: options.Seed = 0,
    verbose: Annotated[bool, typer.Option("--verbose", "-v")] = False,
) -> Result:
    """Read a scene and a history: what is in them, what is missing, whether the prior fits.

    Warns where a velocity and the changes of its position differ by the factor of a unit.

    Parameters
    ----------
    prior
        Whether to compare the data with draws from the prior.
    draws
        Draws from the prior.
    verbose
        List the default priors of effects.
    """
    declared, (loaded,) = reading.read(scene, [history])
    catalogue = reading.catalogue()
    from pbrl_ppl import history as histories
    from pbrl_ppl.physics import check_history

    check_history(declared, loaded, loaded.segments(1))
    missing, rows = _missing(loaded), int(loaded.dataset["n_rows"].sum())
    used, drawn = histories.drawn_pieces(loaded, options.MOST_TRANSITIONS, seed)
    unused = histories.unused_velocities(used)
    fall = histories.wrong_clock(used, declared)
    clock = [fall.sentence(declared)] if fall else []
    moved = histories.command_shifts(used, declared)
    said = [*drawn, *(velocity.sentence for velocity in unused), *clock]
    said += [histories.shift_sentence(declared, body, late) for body, late in moved.items()]
    sized = histories.with_units(declared, used)
    priors = _default_priors(sized, catalogue)
    # shown at once: the prior's draws take long
    console, contents = PlainConsole(quiet=as_json), _contents(declared, loaded)
    console.print(*(f"{name:15}{text}" for name, text in contents.items()), sep="\n")
    console.print(_missing_table(missing, rows))
    for sentence in (*said, *_lacking(declared, loaded)):
        console.print(sentence, soft_wrap=True)
    if verbose:
        console.print(_priors_table(priors))
    checked = None
    if prior:
        progress("comparing with draws from the prior")
        checked = _compared(sized, used, catalogue, draws, seed)
        for sentence in (one for one in checked.summary if one not in clock):
            console.print(f"prior: {sentence}", soft_wrap=True)
    facts = {
        "trajectories": loaded.n_trajectories,
        "transitions": loaded.n_transitions,
        "missing": missing,
        "velocities_not_used": [vars(column) for column in unused],
        "unit_mismatches": histories.unit_mismatches(used),
        "clock": clock,
        "command_shifts": moved,
        "typical": {body.name: dict(body.typical) for body in sized.dynamic},
        "default_priors": priors,
        "prior": checked and {"passed": not checked.sentences, "sentences": checked.summary},
    }
    return Result(contents | facts, ())  # it is shown by now


def _lacking(scene: Scene, history: History) -> Iterator[str]:
    """Yield sentences on what close-loop will need."""
    if history.n_trajectories < 2:
        yield (
            "one trajectory: close-loop holds out whole ones, and needs another, --test with a file"
            " of its own, or cut = { every = ... } in [recording] (s)"
        )
    if any(joint.bodies is None for joint in scene.joints):
        yield (
            "which bodies a joint joins is unknown: close-loop needs them in the scene, fit finds"
            " them"
        )


def _compared(
    scene: Scene, history: History, catalogue: Sequence[Effect], draws: int, seed: int
) -> PriorCheck:
    """Return how the data compare with draws from the prior."""
    from pbrl_ppl.criticism import check_prior
    from pbrl_ppl.effects import attach
    from pbrl_ppl.physics import Physics

    physics = Physics(scene, attach(scene, (), catalogue))
    return check_prior(physics, history, draws=draws, seed=seed)


def _contents(scene: Scene, history: History) -> dict[str, str]:
    """Return what a scene and a history hold, for people."""
    rows = history.dataset["n_rows"].to_numpy() - 1
    intervals = " to ".join(dict.fromkeys(f"{number}" for number in (rows.min(), rows.max())))
    return {
        "moving bodies": ", ".join(body.name for body in scene.moving),
        "walls, joints": f"{len(scene.walls)}, {len(scene.joints)}",
        "trajectories": f"{history.n_trajectories}",
        "transitions": f"{history.n_transitions} ({intervals} in a trajectory)",
        "time step": f"{scene.time_step:g} s, {scene.substeps} engine steps",
    }


def _missing(history: History) -> dict[str, dict[str, int]]:
    """Return the number of missing measurements, by body and state dimension."""
    dataset = history.dataset
    # rows after a trajectory's end are padding, not missing measurements
    real = dataset["time"] < dataset["n_rows"]
    missing = (dataset["observed"].isnull() & real).sum(("trajectory", "time"))
    return {
        body: {str(n): int(missing.sel(body=body, state=n)) for n in missing["state"].values}
        for body in history.bodies
    }


def _missing_table(missing: dict[str, dict[str, int]], rows: int) -> Table:
    """Return a table of missing measurements; a body has `rows` of each state dimension."""
    words = {0: "none", rows: "all"}
    return table(
        "missing measurements",
        {"body": "<"} | dict.fromkeys(STATE, ""),
        ([body, *(words.get(n, f"{n} of {rows}") for n in counts.values())]
         for body, counts in missing.items()),
    )  # fmt: skip


def _default_priors(scene: Scene, catalogue: Sequence[Effect]) -> dict[str, dict[str, str]]:
    """Return the priors of effects that depend on the recording's units, by body and variable."""
    from pbrl_ppl.effects import candidates

    sized = {(effect.name, p.name) for effect in catalogue for p in effect.parameters if p.scale}
    priors: dict[str, dict[str, str]] = {body.name: {} for body in scene.dynamic}
    for attached in candidates(scene, (), catalogue):
        effect = attached.effect
        for parameter in effect.parameters:
            if (effect.name, parameter.name) in sized:
                words = parameter.prior.in_words(parameter.unit)
                priors[attached.body][effect.variable(parameter)] = words
    return priors


def _priors_table(priors: dict[str, dict[str, str]]) -> Table:
    """Return a table of default priors, of all without a number, by body."""
    names = dict.fromkeys(chain(*priors.values()))
    cells = ([name, *(those.get(name, "") for those in priors.values())] for name in names)
    title = "default priors of effects, from the recording"
    return table(title, dict.fromkeys(["parameter", *priors], "<"), cells)


@command("criticise", 4, "pbrl-ppl criticise scene.toml train.csv")
def criticise(
    scene: Path,
    history: list[Path],
    reading: options.SceneReading,
    progress: Progress,
    seed: options.Seed = 1,
    most_transitions: options.Transitions = options.MOST_TRANSITIONS,
    simulate: Annotated[bool, typer.Option("--simulate")] = False,
) -> Result:
    """Rank the effects that the declared model might lack by the score test: no refit, no verdict.

    The score test says which effect's signature the residual looks like; close-loop finds out
    whether that effect helps on data that it has not seen. With --simulate, pieces of trajectories
    are simulated without process noise: on each length a regression proposes the best subset of
    laws, and refits decide. A main law takes at least a fifth off the error of the longest pieces.

    Parameters
    ----------
    most_transitions
        Of a longer recording pieces are used, drawn by the seed; more take more time.
    simulate
        Search for missing laws by simulation error, on short pieces, then longer ones.
    """
    progress("reading the scene and the history")
    declared, (loaded,) = reading.read(scene, [history])
    catalogue = reading.catalogue()
    progress("loading the model")
    from pbrl_ppl import criticism
    from pbrl_ppl.physics import check_history

    settings: dict[str, Any] = {
        "seed": seed,
        "most_transitions": most_transitions,
        "catalogue": catalogue,
    }
    if simulate:
        attribution = criticism.attribute(declared, loaded, progress=progress, **settings)
        return Result(attribution.to_dict(), _shown_laws(attribution))
    check_history(declared, loaded, loaded.segments(1))
    ranking = criticism.criticise(declared, loaded, progress=progress, **settings)
    columns = {"effect": "<", "body": "<", "S": ".1f", "dof": "", "p (corrected)": ".2g"}
    candidates = table(
        "what the declared model might lack, by the score test",
        columns | {"first estimate": "<"},
        map(_candidate_row, ranking.candidates),
    )
    note = (
        "small p: the residual looks like that effect's signature; close-loop says whether it is"
        " missing"
    )
    return Result(ranking.to_dict(), [candidates, note])


def _shown_laws(attribution: Attribution) -> Iterator[str | Table]:
    """Yield the search on each length of pieces, the laws found, and the simulation error."""
    for length in attribution.search:
        yield f"pieces of {length.seconds:.3g} s, intervals: {length.rows}"
        yield f"accepted: {', '.join(length.accepted) or 'none'}"
        yield from (f"dropped: {', '.join(length.dropped) or 'none'}", "")
    columns = {"law": "<", "body": "<", "nats": ".1f", "share of error": ""}
    yield table(
        "laws that the simulation error of trajectories shows",
        columns | {"size": "<"},
        map(_law_row, attribution.laws),
    )
    errors, correlated = (attribution.before, attribution.after), attribution.correlated
    yield table(
        f"simulation error over {attribution.seconds:.3g} s (SI)",
        {"state": "<", "declared": ".3g", "with them": ".3g", "autocorrelation (rows)": ".1f"},
        ([name, *(each[name] for each in errors), correlated[name]] for name in errors[0]),
    )
    yield from attribution.sentences
    yield from (f"rejected {law}: {why}" for law, why in attribution.rejected.items())


def _law_row(law: Law) -> list[object]:
    numbers = ((name, f"{value:.3g} ± {law.sd[name]:.2g}") for name, value in law.estimate.items())
    share = f"{100 * (law.simulated_share or 0.0):.2g} %"
    return [law.effect, law.body, law.simulated_nats, share, sizes(numbers, law.units)]


def _candidate_row(one: Law) -> list[object]:
    numbers = ((name, f"{value:.3g}") for name, value in one.estimate.items())
    # where the declared parameters absorb the effect, its size is not identifiable
    seen = sizes(numbers, one.units) if one.statistic > 0 else ""
    return [one.effect, one.body, one.statistic, one.dof, one.p_value, seen]
