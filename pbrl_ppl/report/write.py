"""The loop as people use it: closed by one call, and kept as a report and posterior files."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pbrl_ppl.criticism import (
    DEFAULT,
    UNEXPLAINED,
    Added,
    Candidate,
    Criteria,
    Errors,
    Findings,
    Unexplained,
    learn_remainder,
    revise,
)
from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import FitError, OutputError
from pbrl_ppl.history import History
from pbrl_ppl.posterior import save_posterior
from pbrl_ppl.report.page import Source, write_page
from pbrl_ppl.report.report import render
from pbrl_ppl.report.words import remainder_in_words, verdict_in_words
from pbrl_ppl.scene import Scene

#: What :meth:`Loop.save` writes, and what beside it where a remainder was learned.
FILES = ("report.html", "report.json", "before.nc", "after.nc")
REMAINDER = "remainder.nc"


@dataclass(frozen=True, eq=False, repr=False)
class Loop:
    """A closed loop: the findings, and how to keep them.

    What is asked for most can be had directly: ``loop.verdict``, ``loop.added``; everything is in
    ``findings``.

    Parameters
    ----------
    findings : Findings
        What was found.
    held_out : History, optional
        What errors were measured on; reports play it.
    catalogue : tuple of Effect
        Where the names of effects are looked up.
    remainder : InferenceData or DataTree, optional
        What :meth:`learn_remainder` gave: reports name it, and ``save`` writes ``remainder.nc``.
    """

    findings: Findings
    held_out: History | None = None
    catalogue: tuple[Effect, ...] = tuple(full_catalogue)
    remainder: Any = None

    @property
    def verdict(self) -> str:
        """``adequate``, ``effects-added`` or ``unexplained``."""
        return self.findings.verdict

    @property
    def added(self) -> tuple[Added, ...]:
        """Effects added, in order."""
        return self.findings.added

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """All candidates of the first round, best first."""
        return self.findings.candidates

    @property
    def unexplained(self) -> Unexplained | None:
        """What remains that no effect in the catalogue explains."""
        return self.findings.unexplained

    @property
    def before(self) -> Errors:
        """Held-out errors of the declared model."""
        return self.findings.before

    @property
    def after(self) -> Errors:
        """Held-out errors of the revised model."""
        return self.findings.after

    @property
    def posterior_before(self) -> Any:
        """Posterior of the declared model, as ArviZ takes it."""
        return self.findings.posterior_before

    @property
    def posterior_after(self) -> Any:
        """Posterior of the revised model; the same where nothing was added."""
        return self.findings.posterior_after

    def learn_remainder(
        self,
        body: str | None = None,
        *,
        seed: int = 0,
        progress: Callable[[str], None] | None = None,
    ) -> Any:
        """Learn a force for what stays unexplained; the verdict and what was added stay.

        Parameters
        ----------
        body : str, optional
            Which body lacks it; where it shows most by default.
        seed : int
            The same seed gives the same posterior.
        progress : callable, optional
            Told the name of each stage.

        Returns
        -------
        InferenceData or DataTree
            The posterior with the effect ``learned_remainder``, to save, plan with and update; see
            :func:`pbrl_ppl.criticism.learn_remainder`.

        Raises
        ------
        FitError
            If nothing is unexplained, or what is does not follow the body's velocity.

        Examples
        --------
        ::

            loop.verdict  # 'unexplained'
            pp.save_posterior(loop.learn_remainder(seed=1), "remainder.nc")
        """
        if self.verdict != UNEXPLAINED:
            raise FitError(f"nothing to learn: the verdict is {self.verdict}")
        found = self.unexplained.body if self.unexplained is not None else ""
        bodies = [moving.name for moving in self.findings.scene.dynamic]
        body = body or found or (bodies[0] if len(bodies) == 1 else "")
        if not body:
            raise FitError(f"remainder: it shows on no body in particular; give body=, of {bodies}")
        return learn_remainder(
            self.posterior_after, body, catalogue=self.catalogue, seed=seed, progress=progress
        )

    def __repr__(self) -> str:
        return f"Loop({verdict_in_words(self.findings)})"

    @property
    def remainder_words(self) -> str:
        """What the learned remainder does, in a sentence; empty without one."""
        if self.remainder is None:
            return ""
        return remainder_in_words(self.posterior_after, self.remainder)

    def page(self, source: Source | None = None) -> str:
        """The report as one self-contained page of HTML."""
        return render(
            self.findings, self.held_out, self.catalogue, source, remainder=self.remainder_words
        )

    def report(self, path: str | Path, *, source: Source | None = None) -> Path:
        """Write the report as one self-contained page and return its path.

        Parameters
        ----------
        path : str or pathlib.Path
            Written whole or not at all.
        source : Source, optional
            Names of the files, and the command that makes the page again.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        return write_page(path, self.page(source))

    def save(
        self, folder: str | Path, overwrite: bool = False, *, source: Source | None = None
    ) -> Path:
        """Write report.html, report.json, before.nc, after.nc (and remainder.nc), all or nothing.

        Parameters
        ----------
        folder : str or pathlib.Path
            Made if missing; other files in it are left alone.
        overwrite : bool
            Whether a folder that has content may be written to.
        source : Source, optional
            Names of the files, and the command that makes them again, for the report.

        Returns
        -------
        pathlib.Path
            The folder.

        Raises
        ------
        OutputError
            If the folder cannot be written, or has content and ``overwrite`` is false.
        """
        folder = Path(folder)
        nearest = check_folder(folder, overwrite)
        try:
            # on the same file system as the folder, so that renaming is all that is left to do
            with tempfile.TemporaryDirectory(prefix=".pbrl-ppl-", dir=nearest) as temporary:
                made = Path(temporary) / "result"
                made.mkdir()
                (made / "report.html").write_text(self.page(source), encoding="utf-8")
                said = self.findings.to_dict()
                save_posterior(self.findings.posterior_before, made / "before.nc")
                save_posterior(self.findings.posterior_after, made / "after.nc")
                if self.remainder is not None:
                    said["learned_remainder"] = self.remainder_words
                    save_posterior(self.remainder, made / REMAINDER)
                text = json.dumps(said, indent=1, allow_nan=False)
                (made / "report.json").write_text(text + "\n", encoding="utf-8")
                if nearest == folder:
                    # it may be a mount or somebody's working directory: fill it, do not swap it
                    for one in made.iterdir():
                        one.replace(folder / one.name)
                else:
                    folder.parent.mkdir(parents=True, exist_ok=True)
                    made.rename(folder)
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error}") from error
        return folder


def close_loop(
    scene: Scene,
    train: History,
    test: History | None = None,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    substeps: int | None = None,
    draws: int | None = None,
    method: str = "metropolis",
    criteria: Criteria = DEFAULT,
    progress: Callable[[str], None] | None = None,
) -> Loop:
    """Fit, find the residual, trace it to an effect, add it, refit, and compare on held-out data.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    train : History
        What is fitted.
    test : History, optional
        What errors are measured on; a seeded quarter of the trajectories of ``train`` without it.
    catalogue : iterable of Effect
        Effects to consider; add your own to the package's.
    seed : int
        The same seed gives the same findings.
    substeps : int, optional
        Engine steps an interval to begin with; the scene's by default.
    draws : int, optional
        Posterior draws kept of each chain; by default 300, or 1000 where chains have not converged.
    method : str
        Of :func:`pbrl_ppl.fit`, for the posteriors; with ``laplace`` the verdict stands on modes.
    criteria : Criteria
        Thresholds of the decisions.
    progress : callable, optional
        Told the name of each stage.

    Returns
    -------
    Loop
        Verdict, effects, errors before and after and both posteriors, and the report of them.

    Raises
    ------
    HistoryError
        If the histories do not fit each other or are too short.
    EffectError
        If the scene declares an unknown effect.

    Warns
    -----
    PriorWarning
        Before anything is fitted, if the declared prior could not have made ``train``.

    Examples
    --------
    ::

        loop = pp.close_loop(scene, train, test, seed=1)
        loop.verdict  # 'effects-added'
        loop.report("report.html")
    """
    catalogue = tuple(catalogue)
    if test is None:
        # as revise does it, so that the report can play what was held out
        train, test = train.split(0.25, seed)
    found = revise(
        scene,
        train,
        test,
        catalogue=catalogue,
        seed=seed,
        substeps=substeps,
        draws=draws,
        method=method,
        criteria=criteria,
        progress=progress,
    )
    return Loop(found, test, catalogue)


def check_folder(folder: Path, overwrite: bool) -> Path:
    """Return the nearest folder that exists, if results can be written to ``folder``.

    Raises
    ------
    OutputError
        If they cannot, or if it has content and ``overwrite`` is false.
    """
    nearest = folder
    # a dangling link counts as there: it cannot be made a folder
    while not (nearest.exists() or nearest.is_symlink()) and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir():
        raise OutputError(
            f"output folder {folder}: {nearest} is a file, expected a folder; choose another path"
        )
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise OutputError(f"output folder {folder}: no permission to write in {nearest}")
    if nearest != folder:
        return nearest
    if not overwrite and any(folder.iterdir()):
        raise OutputError(
            f"output folder {folder}: it has content already; choose another, or allow"
            " overwriting: overwrite=True"
        )
    for name in (*FILES, REMAINDER):
        if (folder / name).is_dir():
            raise OutputError(f"output folder {folder}: {name} in it is a folder; remove it")
    return folder
