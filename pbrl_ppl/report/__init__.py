"""Plots and reports; the only place that imports matplotlib."""

from pbrl_ppl.report.check_plots import plot_calibration, plot_prior_check
from pbrl_ppl.report.loop import Loop, check_folder, close_loop
from pbrl_ppl.report.scene_plots import animate_plan
from pbrl_ppl.report.style import png
from pbrl_ppl.report.words import unseen_in_words, verdict_in_words

__all__ = [
    "Loop",
    "animate_plan",
    "check_folder",
    "close_loop",
    "plot_calibration",
    "plot_prior_check",
    "png",
    "unseen_in_words",
    "verdict_in_words",
]
