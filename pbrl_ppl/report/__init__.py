"""What people see: plots and reports; the only place that imports matplotlib."""

from pbrl_ppl.report.report import Loop, close_loop
from pbrl_ppl.report.scene_plots import animate_plan

__all__ = ["Loop", "animate_plan", "close_loop"]
