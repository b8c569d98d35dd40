"""``pbrl-ppl plan``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from pbrl_ppl.cli.answers import print_json
from pbrl_ppl.cli.outputs import check_file
from pbrl_ppl.cli.poses import pose
from pbrl_ppl.cli.terminal import FAILED, AsJson, Overwrite, Quiet, Seed, interruptible, stages
from pbrl_ppl.errors import GoalError


def plan(
    posterior: Annotated[
        Path, typer.Argument(metavar="POSTERIOR", help="Posterior file (.nc); all that is needed.")
    ],
    start: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BODY=X,Y,THETA",
            help="Where a body starts (m, rad), at rest or with ,VX,VY,OMEGA; once a body.",
        ),
    ] = None,
    goal: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BODY=X,Y,THETA",
            help="Where a body should be, - where free; once a body. Or a goal file (.toml).",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="The plan (.csv).")
    ] = None,
    actions: Annotated[
        Path | None,
        typer.Option(help="Actions (.toml); such as the posterior's data were recorded with."),
    ] = None,
    method: Annotated[str, typer.Option(help="astar or mppi.")] = "astar",
    draws: Annotated[
        int | None, typer.Option(min=1, help="Posterior draws to plan with; the MAP if not given.")
    ] = None,
    weight: Annotated[
        float | None,
        typer.Option(help="Of A*'s heuristic: 1 is A* itself, more is quicker; 3 if not given."),
    ] = None,
    tail: Annotated[
        float, typer.Option(help="Share of the worst draws that count; 1 is the expectation.")
    ] = 1.0,
    noise: Annotated[bool, typer.Option("--noise", help="Plan with Eq. 13's noise.")] = False,
    tolerance: Annotated[float | None, typer.Option(help="How near is there (m).")] = None,
    angle_tolerance: Annotated[float | None, typer.Option(help="How near is there (rad).")] = None,
    contact_penalty: Annotated[
        float | None, typer.Option(help="Cost of a second in contact (s); inf forbids it.")
    ] = None,
    nodes: Annotated[
        int | None, typer.Option(min=1, help="States that the search generates at most.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Another limit (s); the plan then depends on the machine's load."),
    ] = None,
    seed: Seed = 1,
    animate: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Show the plan as a picture that moves (.gif)."),
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Plan from a start to a goal with a posterior file, and nothing else."""
    with interruptible(), stages(quiet) as progress:
        if output is None and animate is None:
            raise GoalError("plan: say where it should be written: -o plan.csv")
        for path, ending in ((output, ".csv"), (animate, ".gif")):
            if path is not None:
                check_file(path, (ending,), overwrite)
        progress("reading the posterior")
        from pbrl_ppl.planning import ActionSet, Goal
        from pbrl_ppl.planning import plan as make_plan
        from pbrl_ppl.posterior import load_posterior, scene_of

        idata = load_posterior(posterior)
        only = [body.name for body in scene_of(idata).dynamic]
        options = {
            "tolerance": tolerance,
            "angle_tolerance": angle_tolerance,
            "contact_penalty": contact_penalty,
        }
        given = {name: value for name, value in options.items() if value is not None}
        if goal and goal[0].endswith(".toml"):
            if len(goal) > 1 or given:
                raise GoalError("--goal: a file has the whole goal; drop the other options of it")
            wanted = Goal.load(goal[0])
        else:
            wanted = Goal.of(dict(pose(text, only, "--goal") for text in goal or ()), **given)
        places = dict(pose(text, only, "--start") for text in start or ())
        allowed = None if actions is None else ActionSet.load(actions)
        limit: dict[str, Any] = {} if nodes is None else {"nodes": nodes}
        if weight is not None:
            if method != "astar":
                raise GoalError(f"--weight: it is of astar, and --method is {method}; leave it out")
            limit["weight"] = weight
        progress("planning")
        result = make_plan(
            idata, places, wanted, allowed, method=method, draws=draws, tail=tail, noise=noise,
            seconds=seconds, seed=seed, progress=progress, **limit,
        )  # fmt: skip
        if output is not None:
            result.save(output)
        if animate is not None:
            progress("drawing")
            os.environ.setdefault("MPLBACKEND", "Agg")
            from pbrl_ppl.report import animate_plan

            animate_plan(result, animate)
    written = [path for path in (output, animate) if path is not None]
    if as_json:
        print_json(
            {
                "reached": result.reached,
                "duration": result.duration,
                "words": result.in_words(),
                "written": written,
            }
        )
    else:
        typer.echo(result.in_words())
        for path in written:
            typer.echo(f"plan: {path}")
    if not result.reached:
        raise typer.Exit(FAILED)
