"""``pbrl-ppl plan`` and ``pbrl-ppl suggest``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pbrl_ppl.cli import options
from pbrl_ppl.cli.app import command
from pbrl_ppl.cli.terminal import FAILED, Progress, Result
from pbrl_ppl.errors import EffectError, GoalError

if TYPE_CHECKING:
    from pbrl_ppl.planning import Goal


@dataclass(frozen=True)
class Wanted:
    """Options of a goal.

    Parameters
    ----------
    goal : BODY=X,Y,THETA
        Where a body should be, - where free; once a body. Or a goal file (.toml).
    tolerance
        Position tolerance (m); by default a fifth of the body's bounding radius.
    angle_tolerance
        Angle tolerance (rad).
    contact_penalty
        Cost of a second in contact (s); inf forbids it.
    """

    goal: list[str] | None = None
    tolerance: float | None = None
    angle_tolerance: float | None = None
    contact_penalty: float | None = None

    def of(self, bodies: Sequence[str]) -> Goal:
        """Return the goal of bodies, or of a file."""
        from pbrl_ppl.planning import Goal

        weights = options.given(vars(self) | {"goal": None})
        if not (self.goal and self.goal[0].endswith(".toml")):
            targets = dict(options.pose(text, bodies, "--goal") for text in self.goal or ())
            return Goal.of(targets, **weights)
        if len(self.goal) > 1 or weights:
            raise GoalError("--goal: a file has the whole goal; drop the other options of it")
        return Goal.load(self.goal[0])


@dataclass(frozen=True)
class PlanSearch:
    """Options of the search for a plan, arguments of `planning.plan`.

    Parameters
    ----------
    method
        astar or mppi.
    draws
        Posterior draws to plan with; the MAP if not given.
    weight
        Of A*'s heuristic: 1 is A* itself, more is quicker; 3 if not given.
    tail
        Share of the worst draws that count; 1 is the expectation.
    nodes
        States that the search generates at most.
    seconds
        Another limit (s); the plan then depends on the machine's load.
    """

    method: str = "astar"
    draws: options.Count | None = None
    weight: float | None = None
    tail: float = 1.0
    nodes: options.Count | None = None
    seconds: float | None = None
    seed: options.Seed = 1


@command("plan", 10, "pbrl-ppl plan cart.nc --start -2,0,0 --goal 2,1,1.57 -o plan.csv")
def plan(
    posterior: Path,
    wanted: Wanted,
    search: PlanSearch,
    laws: options.EffectFiles,
    to: options.TableOutput,
    progress: Progress,
    start: list[str] | None = None,
    actions: Path | None = None,
) -> Result:
    """Plan from a start to a goal with a posterior file alone.

    Parameters
    ----------
    output
        The plan (.csv).
    actions
        Actions (.toml); such as the posterior's data were recorded with.
    """
    catalogue = laws.catalogue()
    progress("reading the posterior")
    from pbrl_ppl.planning import ActionSet
    from pbrl_ppl.planning import plan as make_plan
    from pbrl_ppl.posterior import load_posterior, scene_of

    idata = load_posterior(posterior)
    bodies = [body.name for body in scene_of(idata).dynamic]
    goal = wanted.of(bodies)
    starts = options.starts_of(start, bodies)
    allowed = None if actions is None else ActionSet.load(actions)
    if search.weight is not None and search.method != "astar":
        raise GoalError(f"--weight: it is for astar, not --method {search.method}; omit it")
    progress("planning")
    result = make_plan(
        idata, starts, goal, allowed, effects=catalogue, progress=progress,
        **options.given(vars(search)),
    )  # fmt: skip
    result.save(to.output)
    words = result.in_words()
    contents = {"reached": result.reached, "duration": result.duration, "words": words}
    shown = [words, f"plan: {to.output}"]
    return Result(contents | {"written": [to.output]}, shown, 0 if result.reached else FAILED)


@command("suggest", 7, "pbrl-ppl suggest report/after.nc --start 0,0,0 -o next.csv")
def suggest(
    posterior: Path,
    to: options.TableOutput,
    laws: options.EffectFiles,
    progress: Progress,
    start: list[str] | None = None,
    effect: list[str] | None = None,
    bounds: list[str] | None = None,
    steps: options.Count = 20,
    draws: options.Count = 16,
    seed: options.Seed = 1,
) -> Result:
    """Suggest the actions that tell apart effects which the data so far cannot separate.

    Parameters
    ----------
    posterior : POSTERIOR
        Posterior file of whole trajectories: after.nc of close-loop.
    output
        The experiment (.csv).
    effect : NAME
        Effects to tell apart, such as spring or 'spring on cart'; two or more. What the loop could
        not separate if not given.
    bounds : BODY.NAME=LOW,HIGH
        What is allowed: cart.force_x=-20,20 (N, world frame; torque N m); repeat for others. Such
        as were recorded if not given.
    steps
        Sampling intervals.
    draws
        Posterior draws of each effect's model.
    """
    catalogue = laws.catalogue()
    progress("reading the posterior")
    from pbrl_ppl.planning import suggest_actions
    from pbrl_ppl.planning.experiments import kept_groups
    from pbrl_ppl.posterior import load_posterior, scene_of

    idata = load_posterior(posterior)
    if len(effect or ()) < 2 and (effect or not kept_groups(idata)):
        why = f"{posterior} names no effects that its data cannot separate"
        why = f"got --effect '{effect[0]}' alone" if effect else why
        raise EffectError(
            f"suggest: {why}; name two or more, such as --effect linear_drag --effect"
            " quadratic_drag"
        )
    bodies = [body.name for body in scene_of(idata).dynamic]
    starts = options.starts_of(start, bodies)
    result = suggest_actions(
        idata, starts, _bounds(bounds, bodies) if bounds else None, effects=effect, steps=steps,
        draws=draws, seed=seed, catalogue=catalogue, progress=progress,
    )  # fmt: skip
    result.to_csv(to.output)
    contents = {
        "effects": [str(name) for name in result.separation["true"].values],
        "expected_log_bayes_factor": result.expected,
        "separation": result.separation.values,
        "at_random": result.at_random,
        "decisive": result.decisive,
        "meeting": result.meeting,
        "sentences": result.sentences,
        "written": [to.output],
    }
    shown = [*result.sentences, f"experiment: {to.output}"]
    return Result(contents, shown, 0 if result.decisive else FAILED)


def _bounds(texts: Sequence[str], bodies: Sequence[str]) -> dict[str, dict[str, list[float]]]:
    """Return bounds from ``BODY.NAME=LOW,HIGH``; the body may be left out if there is one."""
    bounds: dict[str, dict[str, list[float]]] = {}
    for text in texts:
        place, _, numbers = text.partition("=")
        body, dot, name = place.strip().rpartition(".")
        body = body if dot else options.only_body(bodies, f"--bounds {text}", f".{text}")
        try:
            bounds.setdefault(body, {})[name] = [float(number) for number in numbers.split(",")]
        except ValueError:
            raise GoalError(
                f"--bounds {text}: expected BODY.NAME=LOW,HIGH, such as cart.force_x=-20,20"
            ) from None
    return bounds
