"""``pbrl-ppl plan`` and ``pbrl-ppl suggest``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from pbrl_ppl.cli.terminal import (
    FAILED,
    AsJson,
    Overwrite,
    Quiet,
    Seed,
    check_file,
    interruptible,
    print_json,
    stages,
)
from pbrl_ppl.errors import GoalError


def pose(text: str, bodies: Sequence[str], option: str) -> tuple[str, list[float]]:
    """A body and its numbers from ``BODY=X,Y,THETA``; the body may be left out if there is one.

    A coordinate that is free, ``-``, is None.
    """
    name, separator, numbers = text.rpartition("=")
    if not separator:
        if len(bodies) > 1:
            raise GoalError(f"{option} {text}: say which body: {bodies[0]}={text}")
        name = bodies[0]
    values = []
    for number in numbers.split(","):
        try:
            values.append(None if number.strip() == "-" else float(number))
        except ValueError:
            raise GoalError(
                f"{option} {text}: {number.strip()!r} is not a number; expected BODY=X,Y,THETA"
            ) from None
    if option == "--start" and None in values:
        raise GoalError(f"{option} {text}: a start has no free coordinates; give a number for -")
    return name.strip(), values  # type: ignore[return-value]


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
