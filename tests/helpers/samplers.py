"""Samplers with short runs."""

from dataclasses import replace

import pytest

from pbrl_ppl.sampling import fitting


def shorten(patch: pytest.MonkeyPatch, draws: int, tune: int) -> None:
    """Of each chain, where none are asked for: in an update that fits anew, say."""
    few = replace(fitting.METHODS["metropolis"], draws=draws, tune=tune)
    patch.setattr(fitting, "METHODS", {**fitting.METHODS, "metropolis": few})
