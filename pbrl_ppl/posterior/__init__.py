"""Posterior files: save, load, draws, what the data inform, the next prior."""

from pbrl_ppl.posterior.comparison import Comparison, compare
from pbrl_ppl.posterior.identifiability import Identifiability, identify, uninformed
from pbrl_ppl.posterior.known_effects import known_effects
from pbrl_ppl.posterior.learned_library import learned_library, library_probabilities
from pbrl_ppl.posterior.leave_out import by_number, by_trajectory, left_out, separate
from pbrl_ppl.posterior.loo_pit import loo_pit
from pbrl_ppl.posterior.origin import linearised_as, problem_of, versions
from pbrl_ppl.posterior.places import both_places, placed
from pbrl_ppl.posterior.predictions import predicted_rows
from pbrl_ppl.posterior.prior_groups import prior_groups
from pbrl_ppl.posterior.record import (
    MIN_ESS,
    checked,
    complete,
    evaluate,
    parameter_draws,
)
from pbrl_ppl.posterior.recording import both_recordings, recorded, recording
from pbrl_ppl.posterior.store import (
    DATATREE,
    HDI_PROB,
    convergence,
    draws,
    from_groups,
    group,
    groups,
    has_one_sigma,
    interval,
    likeliest_draw,
    load_posterior,
    save_posterior,
    scalars,
    scene_of,
    smoothed,
)
from pbrl_ppl.posterior.stored_mode import MODE, Point, climbed_text, stored_mode
from pbrl_ppl.posterior.updated_prior import moment_matched, updated_scene

__all__ = [
    "DATATREE",
    "HDI_PROB",
    "MIN_ESS",
    "MODE",
    "Comparison",
    "Identifiability",
    "Point",
    "both_places",
    "both_recordings",
    "by_number",
    "by_trajectory",
    "checked",
    "climbed_text",
    "compare",
    "complete",
    "convergence",
    "draws",
    "evaluate",
    "from_groups",
    "group",
    "groups",
    "has_one_sigma",
    "identify",
    "interval",
    "known_effects",
    "learned_library",
    "left_out",
    "library_probabilities",
    "likeliest_draw",
    "linearised_as",
    "load_posterior",
    "loo_pit",
    "moment_matched",
    "parameter_draws",
    "placed",
    "predicted_rows",
    "prior_groups",
    "problem_of",
    "recorded",
    "recording",
    "save_posterior",
    "scalars",
    "scene_of",
    "separate",
    "smoothed",
    "stored_mode",
    "uninformed",
    "updated_scene",
    "versions",
]
