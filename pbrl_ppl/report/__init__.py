"""Plots and reports; the only place that imports matplotlib."""

from pbrl_ppl.report.brief import in_brief
from pbrl_ppl.report.check_plots import plot_calibration, plot_prior_check
from pbrl_ppl.report.contact_plots import draw_contacts
from pbrl_ppl.report.effect_plots import plot_candidates
from pbrl_ppl.report.error_plots import plot_errors, plot_rollout
from pbrl_ppl.report.manifest import Log, read_manifest
from pbrl_ppl.report.many import ManyLoops, close_loop_many
from pbrl_ppl.report.many_page import in_words
from pbrl_ppl.report.page import Source, write_page
from pbrl_ppl.report.posterior_plots import plot_rank, plot_trace, summary
from pbrl_ppl.report.posterior_report import render_posterior
from pbrl_ppl.report.scene_plots import animate_plan, draw_goal, draw_motion, draw_scene
from pbrl_ppl.report.style import png
from pbrl_ppl.report.write import Loop, check_folder, close_loop

__all__ = [
    "Log",
    "Loop",
    "ManyLoops",
    "Source",
    "animate_plan",
    "check_folder",
    "close_loop",
    "close_loop_many",
    "draw_contacts",
    "draw_goal",
    "draw_motion",
    "draw_scene",
    "in_brief",
    "in_words",
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
    "summary",
    "write_page",
]
