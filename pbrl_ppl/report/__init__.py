"""Plots and reports; the only place that imports matplotlib.

``pp.report`` is this subpackage, and can be called: ``pp.report(loop, path)``.
"""

import sys
from types import ModuleType

from pbrl_ppl.report.brief import in_brief
from pbrl_ppl.report.check_plots import plot_calibration, plot_prior_check
from pbrl_ppl.report.effect_plots import plot_candidates
from pbrl_ppl.report.error_plots import plot_errors, plot_rollout
from pbrl_ppl.report.logs import Log, read_manifest
from pbrl_ppl.report.many import ManyLoops, close_loop_many
from pbrl_ppl.report.many_page import in_words
from pbrl_ppl.report.page import Source
from pbrl_ppl.report.posterior_plots import plot_rank, plot_trace, summary
from pbrl_ppl.report.posterior_report import render_posterior
from pbrl_ppl.report.scene_plots import (
    animate_plan,
    draw_goal,
    draw_motion,
    draw_scene,
)
from pbrl_ppl.report.style import png
from pbrl_ppl.report.write import loop_page, report

__all__ = [
    "Log",
    "ManyLoops",
    "Source",
    "animate_plan",
    "close_loop_many",
    "draw_goal",
    "draw_motion",
    "draw_scene",
    "in_brief",
    "in_words",
    "loop_page",
    "plot_calibration",
    "plot_candidates",
    "plot_errors",
    "plot_prior_check",
    "plot_rank",
    "plot_rollout",
    "plot_trace",
    "png",
    "read_manifest",
    "render_posterior",
    "report",
    "summary",
]


class _Report(ModuleType):
    """Class of this subpackage, which writes a report when it is called.

    Python sets ``pbrl_ppl.report`` to the subpackage on its first import, and the public function
    has the same name, so the subpackage must be both.
    """

    __call__ = staticmethod(report)


sys.modules[__name__].__class__ = _Report
globals()["report"] = sys.modules[__name__]  # `pp.report` is the same, whatever was imported first
