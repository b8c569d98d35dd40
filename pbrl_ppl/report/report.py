"""Findings in words, as a page, and as the files of the contract."""

from __future__ import annotations

import base64
import json
import os
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from pbrl_ppl.criticism import ADEQUATE, UNEXPLAINED, Findings, revise
from pbrl_ppl.effects import catalogue
from pbrl_ppl.errors import OutputError
from pbrl_ppl.history import History
from pbrl_ppl.parameters import BODY_PARAMETERS
from pbrl_ppl.posterior import save_posterior
from pbrl_ppl.report import plots
from pbrl_ppl.report.plots import UNITS, plain
from pbrl_ppl.scene import Scene

#: What :meth:`Loop.save` writes.
FILES = ("report.html", "report.json", "before.nc", "after.nc")
#: A chain mix is good enough below this R-hat and above this effective sample size.
GOOD_R_HAT, GOOD_ESS = 1.01, 400.0

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, eq=False, repr=False)
class Loop:
    """A closed loop: the findings, and how to keep them.

    Everything in ``findings`` can be had directly: ``loop.verdict``, ``loop.added``.

    Parameters
    ----------
    findings : Findings
        What was found.
    """

    findings: Findings

    def __getattr__(self, name: str) -> Any:
        # copy and pickle look for dunder names before `findings` is there
        if name.startswith("__") or name == "findings":
            raise AttributeError(name)
        return getattr(self.findings, name)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *dir(self.findings), *vars(self.findings)})

    def __repr__(self) -> str:
        return f"Loop({verdict_in_words(self.findings)})"

    def report(self, path: str | Path) -> Path:
        """Write the report as one self-contained page and return its path.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        path = Path(path)
        page = render(self.findings)
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            temporary.write_text(page, encoding="utf-8")
            temporary.replace(path)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
        finally:
            temporary.unlink(missing_ok=True)
        return path

    def save(self, folder: str | Path, overwrite: bool = False) -> Path:
        """Write report.html, report.json, before.nc and after.nc, all or nothing.

        Parameters
        ----------
        folder : str or pathlib.Path
            Made if missing; other files in it are left alone.
        overwrite : bool
            Whether a folder that has content may be written to.

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
                (made / "report.html").write_text(render(self.findings), encoding="utf-8")
                text = json.dumps(self.findings.to_dict(), indent=1, allow_nan=False)
                (made / "report.json").write_text(text + "\n", encoding="utf-8")
                save_posterior(self.findings.posterior_before, made / "before.nc")
                save_posterior(self.findings.posterior_after, made / "after.nc")
                if nearest == folder:
                    # it may be a mount or somebody's working directory: fill it, do not swap it
                    for name in FILES:
                        (made / name).replace(folder / name)
                else:
                    folder.parent.mkdir(parents=True, exist_ok=True)
                    made.rename(folder)
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error}") from error
        return folder


def close_loop(scene: Scene, train: History, test: History | None = None, **options: Any) -> Loop:
    """Fit, find the residual, trace it to an effect, add it, refit, and compare on held-out data.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    train : History
        What is fitted.
    test : History, optional
        What errors are measured on; a seeded quarter of the trajectories of ``train`` without it.
    **options
        As :func:`pbrl_ppl.criticism.loop.revise` takes them.

    Examples
    --------
    ::

        loop = close_loop(scene, train, test, seed=1)
        loop.verdict  # 'effects-added'
    """
    return Loop(revise(scene, train, test, **options))


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
            " overwriting (--overwrite, overwrite=True)"
        )
    for name in FILES:
        if (folder / name).is_dir():
            raise OutputError(f"output folder {folder}: {name} in it is a folder; remove it")
    return folder


def verdict_in_words(findings: Findings) -> str:
    """Say the verdict in a sentence or two, for a reader who knows no statistics."""
    found = _joined(
        f"{one.sentence.rstrip('.')} ({plain(one.effect)}) on the {plain(one.body)}"
        for one in findings.added
    )
    left = findings.unexplained
    rest = "a pattern remains in the errors" if left is None else left.sentence.rstrip(".")
    if findings.verdict == ADEQUATE:
        return "Nothing is missing: the declared model explains the data up to measurement noise."
    if findings.verdict == UNEXPLAINED and not found:
        return f"Something is missing that no effect in the catalogue explains: {rest}."
    if findings.verdict == UNEXPLAINED or left is not None:
        return (
            f"Part of what was missing is {found}. Something is still missing that no effect in"
            f" the catalogue explains: {rest}."
        )
    if len(findings.added) > 1:
        return f"{len(findings.added)} things were missing: {found}."
    return f"Something was missing: {found}."


def render(findings: Findings) -> str:
    """Render the report: one page of HTML that needs nothing else."""
    table = plots.summary(findings.posterior_after)
    parameters = plots.most_interesting(findings, table)
    pictures = {
        "rollout": plots.plot_rollout(findings),
        "errors": plots.plot_errors(findings),
        "residuals": plots.plot_residuals(findings),
        "trace": plots.plot_trace(findings, parameters),
        "rank": plots.plot_rank(findings, parameters),
    }
    if findings.candidates:
        pictures["candidates"] = plots.plot_candidates(findings)
    if findings.added:
        pictures["added"] = plots.plot_added(findings)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(
        number=number,
        chance=chance,
        odds=_odds,
        plain=plain,
        joined=_joined,
        change=_change,
        quantity=_quantity,
    )
    template = resources.files("pbrl_ppl.report").joinpath("report.html.jinja").read_text("utf-8")
    return environment.from_string(template).render(
        findings=findings,
        verdict=verdict_in_words(findings),
        posterior=_posterior_rows(findings, table),
        units=UNITS,
        shown=parameters,
        added={(one.effect, one.body) for one in findings.added},
        best=_largest_fall(findings),
        good={"r_hat": GOOD_R_HAT, "ess": GOOD_ESS},
        hardly=plots.HARDLY,
        most=plots.MOST_CANDIDATES,
        picture={
            name: "data:image/png;base64," + base64.b64encode(plots.png(figure)).decode("ascii")
            for name, figure in pictures.items()
        },
    )


def _posterior_rows(findings: Findings, table: pd.DataFrame) -> list[dict[str, Any]]:
    """One row per parameter of the revised model: its summary, unit, and what is wrong with it."""
    units = dict(BODY_PARAMETERS) | {
        f"{one.effect}_{name}": e.unit
        for one in findings.added
        for name, e in one.parameters.items()
    }
    units |= {effect.variable(p): p.unit for effect in catalogue for p in effect.parameters}
    rows = []
    for label, values in table.iterrows():
        name, _, place = str(label).rstrip("]").partition("[")
        ess = min(values["ess_bulk"], values["ess_tail"])
        wrong = []
        # written so that a value that is not a number counts as bad
        if not values["r_hat"] <= GOOD_R_HAT:
            wrong.append(f"R-hat {number(values['r_hat'], 4)}")
        if not ess >= GOOD_ESS:
            wrong.append(f"effective sample size {number(ess)}")
        unit = UNITS.get(place, "") if name == "sigma" else units.get(name, "")
        rows.append({"label": label, "unit": unit.removesuffix("1"), "wrong": wrong, **values})
    return rows


def _largest_fall(findings: Findings) -> dict[str, Any] | None:
    """Find the state dimension whose error at the end of a rollout fell by the largest share."""
    before, after = findings.before.rollout_rmse, findings.after.rollout_rmse
    shares = {d: after[d] / before[d] for d in before if d in after and before[d] > 0}
    if not shares:
        return None
    best = min(shares, key=lambda dimension: shares[dimension])
    return {"name": best, "before": before[best], "after": after[best]}


def number(value: float | None, digits: int = 3) -> str:
    """Write a number for a reader: three significant digits, no exponent below a million.

    Examples
    --------
    >>> number(419.04), number(0.00123456), number(2.0), number(float("nan"))
    ('419', '0.00123', '2.00', '–')
    """
    if value is None or not np.isfinite(value):
        return "–"
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        return f"{mantissa} × 10{str(int(exponent)).translate(_RAISED)}"
    places = digits - 1 - int(np.floor(np.log10(abs(value)))) if value else 0
    return f"{value:,.{max(places, 0)}f}".replace("-", "−")


def _quantity(value: float, unit: str) -> str:
    """Write a number with its unit, which is "1" where there is none."""
    return f"{number(value)} {unit.removesuffix('1')}".rstrip()


def chance(p_value: float) -> str:
    """Write a p-value: two digits, and no pretence of exactness where it underflowed.

    Examples
    --------
    >>> chance(0.0312), chance(1e-80), chance(0.0)
    ('0.031', '1.0 × 10⁻⁸⁰', '< 10⁻³⁰⁰')
    """
    return "< 10⁻³⁰⁰" if p_value < 1e-300 else number(p_value, 2)


def _odds(p_value: float) -> str:
    """How often chance alone does it."""
    if p_value < 1e-300:
        return "less than once in 10³⁰⁰ times"
    if p_value > 0.1:
        return f"in {100 * p_value:.0f} % of all cases"
    if p_value > 1e-6:
        return f"once in {1 / p_value:,.0f} times"
    power = int(np.floor(-np.log10(p_value)))
    return f"less than once in 10{str(power).translate(_RAISED)} times"


def _change(before: float, after: float) -> str:
    """Say by how much an error fell."""
    share = 1 - after / before if before > 0 else float("nan")
    if not np.isfinite(share) or abs(share) < 0.005:
        return "did not change"
    return f"{'fell' if share > 0 else 'rose'} by {abs(share) * 100:.0f} %"


def _joined(parts: Iterable[str], word: str = "and") -> str:
    *most, last = [str(part) for part in parts] or [""]
    return f"{'; '.join(most)}, {word} {last}" if most else last
