"""The loop: ``pbrl-ppl close-loop``, on one log or many; ``demo`` on the package's recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pbrl_ppl.cli import options, terminal
from pbrl_ppl.cli.app import command
from pbrl_ppl.cli.new import models_folder
from pbrl_ppl.cli.terminal import Progress, Result
from pbrl_ppl.errors import HistoryError, PbrlError
from pbrl_ppl.system.files import check_folder, write_text
from pbrl_ppl.system.threads import Work, counted, obey_parent

if TYPE_CHECKING:
    from pbrl_ppl.criticism import Loop
    from pbrl_ppl.effects import Effect
    from pbrl_ppl.reporting import Source


#: Samplers of the loop's posteriors.
LoopMethod = Literal["importance", "smc", "laplace"]


@dataclass(frozen=True)
class LoopSettings:
    """Options of a command that closes loops, arguments of `criticism.close_loop`.

    Parameters
    ----------
    draws
        Posterior draws of each chain.
    method
        importance weights proposals by the engine; smc moves particles; laplace takes Gaussians
        at the modes, on which the verdict then stands.
    most_transitions
        Of a longer recording pieces are used, drawn by the seed; more take more time.
    catalogue
        common tries common laws alone, all tries unusual ones beside them from the start; by
        default unusual ones are tried last, and added if they explain all that is left.
    """

    seed: options.Seed = 1
    draws: Annotated[int | None, typer.Option(min=100)] = None
    method: LoopMethod = "importance"
    most_transitions: options.Transitions = options.MOST_TRANSITIONS
    catalogue: Literal["common", "all"] | None = None

    def with_laws(self, effects: Sequence[Effect]) -> dict[str, Any]:
        """Return the arguments, with those of these effects that are tried."""
        if self.catalogue == "common":
            effects = [effect for effect in effects if not effect.unusual]
        if self.catalogue == "all":
            effects = [replace(effect, unusual="") for effect in effects]
        return vars(self) | {"catalogue": tuple(effects)}


@command(
    "close-loop", 5, "pbrl-ppl close-loop scene.toml train.csv -o report/",
    kept="nothing was written but reports of finished logs of many, into {to.output}",
)  # fmt: skip
def close_loop(
    context: typer.Context,
    scene: Path,
    train: list[Path],
    to: options.FolderOutput,
    reading: options.SceneReading,
    settings: LoopSettings,
    progress: Progress,
    interrupts: terminal.Interrupts,
    test: list[Path] | None = None,
    each: Annotated[bool, typer.Option("--each")] = False,
    jobs: options.Count = 1,
) -> Result:
    """Find what the declared model lacks, add it, refit, and report before and after.

    Several logs, or a folder of them, are trajectories of one history. With --each every log has a
    report of its own, and index.html lists all. Exits with 3 if the chains have not converged: then
    there is no verdict; with --each it exits with 1 if at least one log failed, which does not stop
    the others.

    Parameters
    ----------
    train : TRAIN
        Measured history (.csv, .parquet, .nc, ...), several files of it, or a folder of them.
    test : TEST
        Held-out history, a file or a folder; repeat for several. Without it, a quarter of TRAIN's
        trajectories.
    each
        Close the loop on each log by itself.
    jobs
        With --each so many logs at a time, each in a process of its own.
    """
    progress("reading the scene and the histories")
    if each:
        if test:
            raise HistoryError(
                f"history {test[0]}: --test is given with --each; leave it out, and a quarter of"
                " each log's trajectories is held out"
            )
        logs = Each(scene, reading, settings, to, options.command_line(context))
        return _closed(logs, train, jobs, progress)
    if jobs > 1:
        raise typer.BadParameter(
            "several logs are one history; add --each to run each by itself", param_hint="--jobs"
        )
    declared, histories = reading.read(scene, [train, test] if test else [train])
    progress("loading the sampler")
    import pbrl_ppl.reporting as report
    from pbrl_ppl import criticism

    output = to.output
    check_folder(output, True, criticism.FILES)
    known, said = settings.with_laws(reading.catalogue()), list[str]()
    run = partial(criticism.close_loop, declared, *histories, **known)
    recorded, held_out = (", ".join(map(str, paths)) for paths in (train, test or ()))
    source = report.Source(str(scene), recorded, held_out, options.command_line(context))
    interrupts.rescue = partial(_without_verdict, said, settings, output, source)
    progress.stages = (*criticism.Stage, "writing the report")
    loop, stopped = _finished(run, progress, interrupts, said)
    interrupts.rescue = None
    progress(progress.stages[-1])
    loop.save(output, to.overwrite, page=report.render(loop, source))
    contents = loop.to_dict() | {"report": output / "report.html"}
    undecided = terminal.UNDECIDED if loop.verdict == criticism.NOT_CONVERGED else 0
    code = terminal.INTERRUPTED if stopped else undecided
    return Result(contents, report.in_brief(loop, output), code)


@dataclass(frozen=True)
class Each:
    """What all of many logs have in common."""

    scene: Path
    reading: options.SceneReading
    settings: LoopSettings
    to: options.FolderOutput
    command: str

    def close(self, name: str, log: Path) -> dict[str, Any]:
        """Close the loop on one log, write its report, and return its row of the page."""
        import pbrl_ppl.reporting as report
        from pbrl_ppl import criticism

        with terminal.warnings_in_a_line(), terminal.noted_warnings("") as noted:
            try:
                declared, histories = self.reading.read(self.scene, [[log]])
                known = self.settings.with_laws(self.reading.catalogue())
                loop = criticism.close_loop(declared, *histories, **known)
                source = report.Source(str(self.scene), str(log), "", self.command)
                page = report.render(loop, source)
                loop.save(self.to.output / name, self.to.overwrite, page=page)
            except PbrlError as error:
                return _failed(name, str(error))
            except Exception as error:
                return _failed(name, f"{type(error).__name__}: {error}")
        return {
            "log": name,
            "verdict": loop.verdict,
            "added": [f"{law.effect}[{law.body}]" for law in loop.added],
            "error_before": loop.before.normalised_rmse,
            "error_after": loop.after.normalised_rmse,
            "warnings": list(dict.fromkeys(map(terminal.in_a_line, noted))),
        }

    def apart(self, name: str, log: Path) -> dict[str, Any]:
        """Close the loop on one log in a process, whose end, short of memory say, is its alone."""
        try:
            # PyMC's threads do not survive a fork
            with ProcessPoolExecutor(1, get_context("spawn"), obey_parent) as process:
                return process.submit(self.close, name, log).result()
        except BrokenProcessPool as error:
            return _failed(name, f"BrokenProcessPool: {error}")


def _failed(name: str, why: str) -> dict[str, Any]:
    """Return the row of a log that failed."""
    message = terminal.in_a_line(why)
    return {"log": name, "verdict": "failed", "added": [], "warnings": [], "message": message}


def _named(logs: Sequence[Path]) -> dict[str, Path]:
    """Return logs by the names of their folders; some file systems ignore case."""
    from pbrl_ppl.history import log_name

    names = list(map(log_name, logs))
    name, count = Counter(map(str.lower, names)).most_common(1)[0]
    if count > 1:
        raise HistoryError(
            f'logs: {count} have the name "{name}", expected one each, for it names the folder of'
            " the report; rename one"
        )
    return dict(zip(names, logs, strict=True))


def _closed(each: Each, paths: Sequence[Path], jobs: int, progress: Progress) -> Result:
    """Close the loop on each log by itself, and write the page of all."""
    import pbrl_ppl.reporting as report
    from pbrl_ppl.history import logs_in, read_scene

    page = each.to.output / "index.html"
    check_folder(page.parent, True, [page.name])
    # what would be wrong for all
    declared = read_scene(each.scene, **each.reading.scene_settings())
    logs = _named(logs_in(paths, declared.recording))
    each.reading.catalogue()
    page.parent.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    progress.stages = (now := "closing the loop on each log",)
    with ThreadPoolExecutor(jobs) as threads:
        for row in counted(threads.map(each.apart, logs, logs.values()), len(logs), now, progress):
            rows.append(row)
            said = row.get("message") or ", ".join([row["verdict"], *row["added"]])
            progress(f"{len(rows)}/{len(logs)} {row['log']}: {said}")
    write_text(page, report.render_logs(rows, each.command))
    laws: dict[str, list[str]] = {}
    for row in rows:
        for law in row["added"]:
            laws.setdefault(law, []).append(row["log"])
    shown = [f"{law}: {', '.join(names)}" for law, names in laws.items()]
    shown += [report.count_verdicts(rows), f"page: {page}"]
    code = terminal.FAILED * any(row["verdict"] == report.FAILED for row in rows)
    return Result({"page": page, "logs": rows}, shown, code)


def _finished(
    run: Callable[..., Loop], progress: Progress, interrupts: terminal.Interrupts, said: list[str]
) -> tuple[Loop, bool]:
    """Return the loop, with Gaussians at the modes if it is interrupted while it samples.

    The second value is whether it was. What is found goes into ``said``.
    """
    from pbrl_ppl import criticism

    def noted(stage: str) -> None:
        progress(stage)
        if not isinstance(stage, (criticism.Stage, Work)):
            said.append(stage)
        if stage == criticism.Stage.SAMPLE:
            interrupts.keep()

    try:
        return run(progress=noted), False
    except criticism.LoopInterrupted as interrupt:
        progress("interrupted: Gaussians at the modes instead; once more ends without a report")
        return interrupt.finish(), True


def _without_verdict(
    said: Sequence[str], settings: LoopSettings, output: Path, source: Source
) -> str:
    """Write what was found before an interrupt, unless a report is there; return what is kept."""
    import pbrl_ppl.reporting as report

    faster = {
        "--method laplace": settings.method != "laplace",
        "--catalogue common": settings.catalogue != "common",
        f"--most-transitions {settings.most_transitions // 4}": True,
    }
    advice = f"{', '.join(one for one, new in faster.items() if new)} take less time"
    if not said or (output / "report.html").exists():
        return f"nothing was written; {advice}"
    output.mkdir(parents=True, exist_ok=True)
    write_text(output / "report.html", report.render_without_verdict(said, advice, source))
    return f"{output / 'report.html'} has what was found: {said[-1]}; {advice}"


@command("demo", 0, "pbrl-ppl demo")
def demo(
    context: typer.Context,
    progress: Progress,
    interrupts: terminal.Interrupts,
    as_json: bool,
    quiet: bool,
    output: options.OutputFolder = Path("pbrl-ppl-demo"),
    method: LoopMethod = "laplace",
    seed: options.Seed = 1,
    overwrite: bool = False,
) -> Result:
    """Close the loop on a recording that comes with the package, and write its report.

    A shopping cart is pushed. Its castor resists turning, which the scene does not declare.

    Parameters
    ----------
    output
        Folder for the results.
    method
        laplace takes seconds; importance and smc draw from the posterior itself, in minutes.
    overwrite
        Write to a folder that is not empty.
    """
    cart = models_folder() / "shopping_cart"
    to, settings = options.FolderOutput(output, overwrite), LoopSettings(seed, method=method)
    if not (as_json or quiet):
        typer.echo(
            "A shopping cart is pushed; the scene does not declare that its castor resists turning."
            "\nThis takes some 30 s on an idle machine, the first time a minute more to compile."
        )
    train, test = (cart / "recorded" / f"{name}.csv" for name in ("train", "test"))
    result = close_loop(
        context, cart / "scene.toml", [train], to, options.SceneReading(), settings, progress,
        interrupts, [test],
    )  # fmt: skip
    if quiet or result.code:
        return result
    last = "With a recording of yours: pbrl-ppl new scene.toml --history train.csv"
    return replace(result, shown=[*result.shown, last])
