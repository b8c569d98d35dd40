"""Plots and reports; the only place that imports matplotlib.

``pp.report`` is this subpackage, and can be called: ``pp.report(loop, path)``.
"""

import sys
from types import ModuleType

from pbrl_ppl.report.brief import in_brief as in_brief
from pbrl_ppl.report.check_plots import plot_calibration as plot_calibration
from pbrl_ppl.report.check_plots import plot_prior_check as plot_prior_check
from pbrl_ppl.report.effect_plots import plot_candidates as plot_candidates
from pbrl_ppl.report.error_plots import plot_errors as plot_errors
from pbrl_ppl.report.error_plots import plot_rollout as plot_rollout
from pbrl_ppl.report.logs import Log as Log
from pbrl_ppl.report.logs import read_manifest as read_manifest
from pbrl_ppl.report.many import ManyLoops as ManyLoops
from pbrl_ppl.report.many import close_loop_many as close_loop_many
from pbrl_ppl.report.many_page import in_words as in_words
from pbrl_ppl.report.page import Source as Source
from pbrl_ppl.report.posterior_plots import plot_rank as plot_rank
from pbrl_ppl.report.posterior_plots import plot_trace as plot_trace
from pbrl_ppl.report.posterior_plots import summary as summary
from pbrl_ppl.report.posterior_report import render_posterior as render_posterior
from pbrl_ppl.report.report import render as render
from pbrl_ppl.report.report import report as report
from pbrl_ppl.report.scene_plots import animate_plan as animate_plan
from pbrl_ppl.report.scene_plots import draw_goal as draw_goal
from pbrl_ppl.report.scene_plots import draw_motion as draw_motion
from pbrl_ppl.report.scene_plots import draw_scene as draw_scene
from pbrl_ppl.report.style import png as png


class _Report(ModuleType):
    """Class of this subpackage, which writes a report when it is called.

    Python sets ``pbrl_ppl.report`` to the subpackage on its first import, and the public function
    has the same name, so the subpackage must be both.
    """

    __call__ = staticmethod(report)


sys.modules[__name__].__class__ = _Report
globals()["report"] = sys.modules[__name__]  # `pp.report` is the same, whatever was imported first
