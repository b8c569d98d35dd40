"""Moving pictures of plans."""

import pytest
from PIL import Image

from pbrl_ppl.cli import main
from pbrl_ppl.errors import OutputError
from pbrl_ppl.planning import plan
from pbrl_ppl.reporting import animate_plan
from tests.helpers.pucks import ACROSS, PUSHES, ROOM, known
from tests.helpers.stacks import file


def test_a_plan_becomes_a_moving_picture_of_its_length(tmp_path) -> None:
    found = plan(known(ROOM), *ACROSS, PUSHES)
    animate_plan(found, tmp_path / "plan.gif")
    with Image.open(tmp_path / "plan.gif") as picture:
        assert picture.n_frames == len(found.wrenches) + 1
        lasts = picture.info["duration"] * picture.n_frames
    assert lasts == pytest.approx(1000 * found.duration, rel=0.1)  # ms
    with pytest.raises(OutputError):
        animate_plan(found, tmp_path / "none" / "plan.gif")


def test_the_command_animates(tmp_path) -> None:
    path = tmp_path / "plan.gif"
    task = ["--start", "0,0,0", "--goal", "1.5,0.5,-", "--draws", "4", "-q"]
    assert main(["plan", str(file("5")), *task, "--animate", str(path)]) == 0
    assert path.read_bytes().startswith(b"GIF")
