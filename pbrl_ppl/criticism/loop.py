"""Result of a closed loop, and the files that it is saved in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.results import (
    ADDED,
    ASIDE,
    CANDIDATE,
    NOTHING_RECORDED,
    Acceleration,
    Correlations,
    Errors,
    Growth,
    Law,
    Numerical,
    ResidualTest,
    Rollout,
    SearchLength,
    Unexplained,
)
from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import OutputError
from pbrl_ppl.files import check_folder, json_values, temporary_folder
from pbrl_ppl.history import History, UnusedVelocity
from pbrl_ppl.modes import FilteredMode
from pbrl_ppl.posterior import Comparison, Fit, Idata, Identifiability, save_posterior
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats

#: The verdicts; the last one means that there is none, for the chains do not agree.
ADEQUATE, EFFECTS_ADDED, UNEXPLAINED = "adequate", "effects-added", "unexplained"
NOT_CONVERGED = "not-converged"
#: Files of a saved loop and its report.
FILES = ("report.html", "report.json", "before.nc", "after.nc")
#: The file that is written last: where it is, the others belong to it.
DONE = "report.json"


@dataclass(frozen=True, eq=False, repr=False)
class Loop:
    """Result of :func:`pbrl_ppl.close_loop`: verdict, added effects, errors and both posteriors.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    verdict : str
        ``adequate``, ``effects-added``, ``unexplained``, or ``not-converged``.
    numerical : Numerical
        Engine substeps, and the numerical error that is left.
    candidates : tuple of Law
        All candidates, by their score tests at the declared model, best first.
    added : tuple of Law
        Effects added, in order.
    unexplained : Unexplained or None
        Structure that no effect in the catalogue explains.
    before, after, noise_floor : Errors
        Held-out errors of the declared model, of the revised one, and of the noise alone.
    declared, revised : Fit
        Both models with their posteriors; the same object twice if nothing was added.
    innovations : tuple of FilteredMode
        Both models with whole trajectories filtered, which the tests are made with.
    residuals_before, residuals_after : dict of str to ndarray
        Held-out residuals in units of noise per state dimension, 1-d arrays.
    rollout : Rollout
        One held-out trajectory.
    rollout_horizon : int
        Intervals of ``rollout_rmse``.
    provenance : dict
        Seed, versions, hash of the data, number of transitions, horizons.
    tests : tuple of ResidualTest
        Tests of the revised model's residual.
    acceleration : Acceleration
        Unexplained acceleration of both models.
    correlations : Correlations
        Correlations of the revised model's innovations.
    growth : Growth
        Growth of the revised model's forecast errors.
    search : tuple of SearchLength
        What the search found on pieces of each length.
    small : tuple of Law
        Effect that is significant in the innovations and was not added, if there is one.
    lesser : tuple of Law
        Laws that simulations show and that are no main ones: they are not added.
    hypotheses : tuple of Law
        Unusual laws that explain a part of what remains: they are not added.
    identifiability : Identifiability or None
        Which parameters of the revised model the data inform.
    loo : Comparison or None
        Leave-one-out cross-validation of both models on the data they were fitted to.
    velocities_not_used : tuple of UnusedVelocity
        Velocity columns that were computed from positions or lag them.
    bad_frames : tuple of str
        A sentence for each single bad frame that was left out, of either history.
    drawn : tuple of str
        A sentence on each history that was too long to be used as a whole.
    criteria : Criteria
        Thresholds of the decisions.
    held_out : History, optional
        The held-out trajectories; reports animate them.
    catalogue : tuple of Effect
        Where the names of effects are looked up.
    """

    scene: Scene
    verdict: str
    numerical: Numerical
    candidates: tuple[Law, ...]
    added: tuple[Law, ...]
    unexplained: Unexplained | None
    before: Errors
    after: Errors
    noise_floor: Errors
    declared: Fit
    revised: Fit
    innovations: tuple[FilteredMode, FilteredMode]
    residuals_before: Mapping[str, Floats]
    residuals_after: Mapping[str, Floats]
    rollout: Rollout
    rollout_horizon: int
    provenance: Mapping[str, object]
    tests: tuple[ResidualTest, ...]
    acceleration: Acceleration
    correlations: Correlations
    growth: Growth
    search: tuple[SearchLength, ...] = ()
    small: tuple[Law, ...] = ()
    lesser: tuple[Law, ...] = ()
    hypotheses: tuple[Law, ...] = ()
    identifiability: Identifiability | None = None
    loo: Comparison | None = None
    velocities_not_used: tuple[UnusedVelocity, ...] = ()
    bad_frames: tuple[str, ...] = ()
    drawn: tuple[str, ...] = ()
    criteria: Criteria = DEFAULT
    held_out: History | None = None
    catalogue: tuple[Effect, ...] = tuple(full_catalogue)

    def __repr__(self) -> str:
        added = [f"{one.effect} on {one.body}" for one in self.added]
        return f"Loop(verdict={self.verdict!r}, added={added})"

    @property
    def posterior_before(self) -> Idata:
        """Posterior of the declared model, an InferenceData or a DataTree."""
        return self.declared.posterior

    @property
    def posterior_after(self) -> Idata:
        """Posterior of the revised model; that of the declared one if nothing was added."""
        return self.revised.posterior

    @property
    def accepted(self) -> tuple[Law, ...]:
        """Return the added effects, or none without a verdict."""
        return () if self.verdict == NOT_CONVERGED else self.added

    @property
    def rejected(self) -> tuple[Law, ...]:
        """Return the significant candidates that were not added, best first."""
        present = {(added.effect, added.body) for added in self.added}
        return tuple(
            one
            for one in self.candidates
            if one.why
            and one.p_value < self.criteria.try_p
            and (one.effect, one.body) not in present
        )

    @property
    def diverges(self) -> bool:
        """Return whether held-out forecasts of the revised model diverge."""
        return any(np.isposinf(far) for far in self.after.rollout_rmse.values())

    @property
    def forecasts_at_noise(self) -> bool:
        """Return whether all held-out errors are near those that noise alone makes."""
        most, floor = self.criteria.worse_forecast, self.noise_floor.rollout_rmse
        errors = self.after.rollout_rmse.items()
        near = all(error < most * floor.get(name, 0.0) for name, error in errors)
        return near and self.after.normalised_rmse < most

    @property
    def depends_on_records(self) -> bool:
        """Return whether the residual depends on a recorded quantity."""
        left = self.unexplained
        return left is not None and left.depends_on != NOTHING_RECORDED

    @property
    def rollout_seconds(self) -> float:
        """Return how far ahead rollouts predict (s)."""
        return self.rollout_horizon * self.scene.time_step

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``report.json``; numbers that are not finite become null."""
        tested = [key for key in CANDIDATE if key not in ("sentence", "units")]
        contents: dict[str, Any] = json_values(
            {
                "verdict": self.verdict,
                "numerical": self.numerical,
                "added": [law.in_json(ADDED) for law in self.added],
                "candidates": [law.in_json(tested) for law in self.candidates],
                "small": [[law.effect, law.body] for law in self.small],
                "lesser": [law.in_json(ASIDE) for law in self.lesser],
                "hypotheses": [law.in_json(ASIDE) for law in self.hypotheses],
                "search": self.search,
                "tests": self.tests,
                "unexplained_acceleration": self.acceleration,
                "unexplained": self.unexplained,
                "error": {
                    "before": self.before,
                    "after": self.after,
                    "noise_floor": self.noise_floor,
                },
                "identifiability": self.identifiability and self.identifiability.to_dict(),
                "loo": self.loo and self.loo.to_dict(),
                "velocities_not_used": self.velocities_not_used,
                "bad_frames": self.bad_frames,
                "drawn": self.drawn,
                "provenance": self.provenance,
            }
        )
        return contents

    def save(self, folder: str | Path, overwrite: bool = False, *, page: str = "") -> Path:
        """Write report.json, before.nc and after.nc, all or nothing.

        Of an earlier result in the folder ``report.json`` is removed first, and the new one is
        written last: where it is, the files belong together, even if the process was killed.

        Parameters
        ----------
        folder : str or pathlib.Path
            Made if missing; other files in it are left alone.
        overwrite : bool
            Whether a folder that is not empty may be written to.
        page : str
            HTML of the report, written as report.html with the other files; none if empty.

        Returns
        -------
        pathlib.Path
            The folder.

        Raises
        ------
        OutputError
            If the folder cannot be written, or is not empty and ``overwrite`` is false.

        Examples
        --------
        ::

            loop.save("out")
            pp.report(loop, "out/report.html")
        """
        folder = Path(folder)
        nearest = check_folder(folder, overwrite, FILES)
        try:
            # on the same file system as the folder, so that only a rename is left at the end
            with temporary_folder(nearest) as temporary:
                made = temporary / "result"
                made.mkdir()
                if page:
                    (made / "report.html").write_text(page, encoding="utf-8")
                save_posterior(self.posterior_before, made / "before.nc")
                save_posterior(self.posterior_after, made / "after.nc")
                text = json.dumps(self.to_dict(), indent=1, allow_nan=False)
                (made / DONE).write_text(text + "\n", encoding="utf-8")
                if nearest == folder:
                    # it may be a mount or a working directory: fill it, do not replace it
                    (folder / DONE).unlink(missing_ok=True)
                    for name in sorted((file.name for file in made.iterdir()), key=DONE.__eq__):
                        (made / name).replace(folder / name)
                else:
                    folder.parent.mkdir(parents=True, exist_ok=True)
                    made.rename(folder)
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error}") from error
        return folder
