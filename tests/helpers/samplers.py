"""Samplers with short runs."""

from dataclasses import replace

import pytest

from pbrl_ppl.sampling import fitting


def shorten(patch: pytest.MonkeyPatch, draws: int) -> None:
    """Of each chain by default, where none are asked for: in an update that refits, say."""
    few = replace(fitting.METHODS[fitting.DEFAULT], draws=draws)
    patch.setattr(fitting, "METHODS", {**fitting.METHODS, fitting.DEFAULT: few})
