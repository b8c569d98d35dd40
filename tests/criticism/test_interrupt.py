"""An interrupt of the samplers keeps what was found."""

import numpy as np
import pytest

from pbrl_ppl.criticism import LoopInterrupted, close_loop, closing
from pbrl_ppl.history import History
from tests.helpers.free_puck import BOX, box2d


@pytest.mark.one_stack
def test_the_loop_is_finished_with_gaussians(make_history, monkeypatch) -> None:
    sample = closing.sample

    def stopped(*args, method, **settings):
        if method != "laplace":
            raise KeyboardInterrupt
        return sample(*args, method=method, **settings)

    monkeypatch.setattr(closing, "sample", stopped)
    rows = box2d(make_history, 3, linear_drag=0.5)
    train, test = (History.from_dataframe(each, BOX) for each in rows)
    with pytest.raises(LoopInterrupted) as caught:
        close_loop(BOX, train, test, seed=1)
    loop = caught.value.finish()
    assert [added.effect for added in loop.added] == ["linear_drag"]
    assert loop.posterior_after.attrs["method"] == "laplace"
    np.testing.assert_array_equal(loop.held_out.dataset["observed"], test.dataset["observed"])
