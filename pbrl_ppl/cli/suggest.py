"""``pbrl-ppl suggest``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli.answers import print_json
from pbrl_ppl.cli.outputs import check_file
from pbrl_ppl.cli.poses import pose
from pbrl_ppl.cli.terminal import FAILED, AsJson, Overwrite, Quiet, Seed, interruptible, stages
from pbrl_ppl.errors import GoalError


def suggest(
    posterior: Annotated[
        Path,
        typer.Argument(
            metavar="POSTERIOR",
            help="Posterior file of whole trajectories: after.nc of close-loop.",
        ),
    ],
    start: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BODY=X,Y,THETA",
            help="Where a body starts (m, rad), at rest or with ,VX,VY,OMEGA; once a body.",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="The experiment (.csv).")
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Effects to tell apart, such as spring or 'spring on cart'; two or more. What the"
            " loop could not separate if not given.",
        ),
    ] = None,
    bounds: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BODY.NAME=LOW,HIGH",
            help="What is allowed: cart.force_x=-20,20 (N, world frame; torque N m); repeat for"
            " others.",
        ),
    ] = None,
    actions: Annotated[
        Path | None,
        typer.Option(help="Or actions (.toml), as of plan; if neither, such as were recorded."),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Sampling intervals.")] = 20,
    hold: Annotated[
        int | None, typer.Option(min=1, help="Intervals for which a wrench within bounds is held.")
    ] = None,
    draws: Annotated[int, typer.Option(min=1, help="Posterior draws of each effect's model.")] = 16,
    seed: Seed = 1,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Suggest the actions that tell apart effects which the data so far cannot separate."""
    with interruptible(), stages(quiet) as progress:
        if output is None:
            raise GoalError("suggest: say where it should be written: -o next.csv")
        if bounds and actions is not None:
            raise GoalError("suggest: --bounds and --actions both say what is allowed; drop one")
        check_file(output, (".csv",), overwrite)
        progress("reading the posterior")
        from pbrl_ppl.planning import ActionSet, suggest_actions
        from pbrl_ppl.posterior import load_posterior, scene_of

        idata = load_posterior(posterior)
        only = [body.name for body in scene_of(idata).dynamic]
        places = dict(pose(text, only, "--start") for text in start or ())
        allowed = _bounds(bounds, only) if bounds else None
        result = suggest_actions(
            idata,
            places,
            allowed if actions is None else ActionSet.load(actions),
            effects=effect,
            steps=steps,
            hold=hold,
            draws=draws,
            seed=seed,
            progress=progress,
        )
        result.to_csv(output)
    if as_json:
        names = [str(name) for name in result.separation["true"].values]
        print_json(
            {
                "effects": names,
                "expected_log_bayes_factor": result.expected,
                "separation": result.separation.values,
                "at_random": result.at_random,
                "decisive": result.decisive,
                "meeting": result.meeting,
                "sentences": result.sentences,
                "written": [output],
            }
        )
    else:
        for sentence in result.sentences:
            typer.echo(sentence)
        typer.echo(f"experiment: {output}")
    if not result.decisive:
        raise typer.Exit(FAILED)


def _bounds(given: Sequence[str], bodies: Sequence[str]) -> dict[str, dict[str, list[float]]]:
    """Bounds from ``BODY.NAME=LOW,HIGH``; the body may be left out if there is one."""
    found: dict[str, dict[str, list[float]]] = {}
    for text in given:
        place, _, numbers = text.partition("=")
        body, dot, name = place.strip().rpartition(".")
        if not dot:
            if len(bodies) != 1:
                raise GoalError(f"--bounds {text}: say which body: {bodies[0]}.{text}")
            body = bodies[0]
        try:
            found.setdefault(body, {})[name] = [float(number) for number in numbers.split(",")]
        except ValueError:
            raise GoalError(
                f"--bounds {text}: expected BODY.NAME=LOW,HIGH, such as cart.force_x=-20,20"
            ) from None
    return found
