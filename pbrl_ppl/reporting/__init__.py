"""Plots and reports; the only place that imports matplotlib."""

from pbrl_ppl.reporting.loop_plots import plot_candidates as plot_candidates
from pbrl_ppl.reporting.loop_plots import plot_errors as plot_errors
from pbrl_ppl.reporting.loop_plots import plot_rollout as plot_rollout
from pbrl_ppl.reporting.posteriors import plot_prior_check as plot_prior_check
from pbrl_ppl.reporting.posteriors import plot_rank as plot_rank
from pbrl_ppl.reporting.posteriors import summary as summary
from pbrl_ppl.reporting.reports import FAILED as FAILED
from pbrl_ppl.reporting.reports import Source as Source
from pbrl_ppl.reporting.reports import count_verdicts as count_verdicts
from pbrl_ppl.reporting.reports import in_brief as in_brief
from pbrl_ppl.reporting.reports import render as render
from pbrl_ppl.reporting.reports import render_logs as render_logs
from pbrl_ppl.reporting.reports import render_posterior as render_posterior
from pbrl_ppl.reporting.reports import render_without_verdict as render_without_verdict
from pbrl_ppl.reporting.reports import report as report
from pbrl_ppl.reporting.scene_plots import draw_goal as draw_goal
from pbrl_ppl.reporting.scene_plots import draw_motion as draw_motion
from pbrl_ppl.reporting.scene_plots import draw_scene as draw_scene
from pbrl_ppl.reporting.style import png as png
