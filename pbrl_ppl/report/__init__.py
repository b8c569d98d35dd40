"""What people see: plots and reports; the only place that imports matplotlib."""

from pbrl_ppl.report.loop import Loop, check_folder, close_loop
from pbrl_ppl.report.report import verdict_in_words
from pbrl_ppl.report.scene_plots import animate_plan

__all__ = ["Loop", "animate_plan", "check_folder", "close_loop", "verdict_in_words"]
