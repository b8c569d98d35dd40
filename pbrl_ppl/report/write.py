"""Page of a closed loop or of a posterior, written to a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pbrl_ppl.criticism import Loop
from pbrl_ppl.files import write_text
from pbrl_ppl.report.page import Source
from pbrl_ppl.report.posterior_report import render_posterior
from pbrl_ppl.report.report import render


def report(found: Any, path: str | Path, *, source: Source | None = None) -> Path:
    """Write the report of a closed loop or of a posterior as one self-contained page.

    Parameters
    ----------
    found : Loop, InferenceData or DataTree
        Result of :func:`pbrl_ppl.close_loop`, or a posterior.
    path : str or pathlib.Path
        Written whole or not at all.
    source : Source, optional
        Names of the files, and the command that makes the page again.

    Returns
    -------
    pathlib.Path
        The page.

    Raises
    ------
    OutputError
        If the file cannot be written.
    PosteriorError
        If the posterior lacks what its report shows.

    Examples
    --------
    ::

        pp.report(pp.close_loop(scene, train, test, seed=1), "report.html")
        pp.report(pp.load_posterior("cart.nc"), "cart.html")
    """
    if isinstance(found, Loop):
        page = loop_page(found, source)
    else:
        page = render_posterior(found, source=source)
    write_text(Path(path), page)
    return Path(path)


def loop_page(loop: Loop, source: Source | None = None) -> str:
    """Return the report of a closed loop as HTML, with its learned remainder if it has one."""
    return render(loop, loop.held_out, loop.catalogue, source, remainder=loop.remainder_words)
