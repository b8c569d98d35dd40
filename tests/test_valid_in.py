"""Valid in, verdict out: drawn scenes and recordings through the commands.

Some of the cases of ``analysis/reliability/valid.py``, which draws hundreds.
"""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from reliability.commands import run
from reliability.valid import UNKNOWN, commands

from pbrl_ppl.history import read_recording, read_scene
from pbrl_ppl.model import physics_model, problem_in
from tests.helpers.drawn import Case, cases, drawn_case

pytestmark = [pytest.mark.one_stack, pytest.mark.slow]

#: Quick cases with one body, of at most `ROWS` rows.
SEEDS = (2,)
ROWS = 60


@settings(
    max_examples=25, deadline=None, derandomize=True, database=None,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
@given(cases(120))
def test_check_reads_what_is_valid(case: Case) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ran = run(["check", "scene.toml", case.write(folder), "--no-prior"], folder, limit=60.0)
    assert not ran.fault(), (case.seed, case.about, ran.fault())


@pytest.mark.parametrize("seed", SEEDS)
def test_what_check_passes_ends_in_a_verdict(seed: int, tmp_path: Path) -> None:
    case = drawn_case(seed, ROWS)
    recording = case.write(tmp_path)
    checked = run(["check", "scene.toml", recording], tmp_path)
    assert not checked.fault(), checked.fault()
    for argv, codes in commands(case, recording, checked.out):
        ran = run(argv, tmp_path)
        assert not ran.fault(codes), (case.about, argv, ran.fault(codes), ran.err[-2000:])


def test_a_model_whose_prior_centre_has_no_prediction_is_declared(tmp_path: Path) -> None:
    """A rod of unknown anchors has no length at the prior's centre, where the engine diverges."""
    case = drawn_case(63, 80)
    recording = case.write(tmp_path)
    scene = read_scene(tmp_path / "scene.toml")
    history = read_recording(tmp_path / recording, scene)
    model = physics_model(scene, history, likelihood="trajectories")
    assert np.isfinite(problem_in(model).data.smoothed_states).all()


def test_bodies_of_a_joint_are_found_along_trajectories(tmp_path: Path) -> None:
    """Check says that the loop needs them; a fit of each choice is mixed with all its noises."""
    case = drawn_case(143, 80)
    recording = case.write(tmp_path)
    checked = run(["check", "scene.toml", recording, "--no-prior"], tmp_path)
    assert UNKNOWN in checked.out
    (fit, codes), *_ = commands(case, recording, checked.out)
    fitted = run(fit, tmp_path)
    assert not fitted.fault(codes), fitted.fault(codes)
    assert "unexplained_acceleration[vx]" in fitted.out
