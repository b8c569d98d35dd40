"""The bar of counted work, and the lines of a log in its place."""

import io
import sys
import time

import pytest
from rich.console import Console

from pbrl_ppl.criticism import Stage
from pbrl_ppl.system.threads import Progress, Work, counted, in_parallel

pytestmark = pytest.mark.one_stack


class Terminal(io.StringIO):
    """What is written to a terminal."""

    def isatty(self) -> bool:
        return True


def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Return what is written to standard error, which is a terminal."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", Terminal())
    return sys.stderr


@pytest.fixture
def bar(monkeypatch: pytest.MonkeyPatch):
    """A bar whose clock is a list of one time (s), and what it shows at any time."""
    terminal(monkeypatch)
    bar, clock = Progress(False), [0.0]
    monkeypatch.setattr(bar._bar, "get_time", lambda: clock[0])

    def shown() -> str:
        text = Console(file=io.StringIO(), width=100, highlight=False)
        text.print(bar._bar.get_renderable())
        return " ".join(text.file.getvalue().split())

    return bar, clock, shown


def test_the_share_is_that_of_counted_work_and_the_time_left_is_at_its_speed(bar) -> None:
    """Units of 20 s: after 3 of 8 five are left."""
    bar, clock, shown = bar
    bar("searching")
    assert shown().startswith("searching") and "%" not in shown() and ":" not in shown()
    for done in range(4):
        clock[0] = 20.0 * done
        bar(Work("refitting models", done, 8))
    assert shown().startswith("refitting models") and shown().endswith("38% 0:01:40")


def test_the_bar_pulses_once_work_is_done(bar) -> None:
    """What follows in the stage is not counted: no share and no time left are promised."""
    bar, clock, shown = bar
    bar("searching")
    for clock[0], work in enumerate(counted("abc", 3, "refitting", bar)):
        assert shown().startswith("refitting") and f"{'abc'.index(work) / 3:.0%}" in shown()
    assert shown().startswith("searching") and "%" not in shown() and ":" not in shown()


def test_a_bar_never_goes_backwards(bar) -> None:
    """Work that begins again has a bar of its own."""
    bar, _, _ = bar
    bars, shares = [], []
    for done in (0, 2, 5, 0, 1):
        bar(Work("refitting", done, 6))
        (task,) = bar._bar.tasks
        bars.append(task.id)
        shares.append(task.percentage)
    assert bars[0] == bars[1] == bars[2] != bars[3] == bars[4]
    assert shares == pytest.approx([0.0, 100 / 3, 500 / 6, 0.0, 100 / 6])


def test_stages_are_numbered_and_findings_leave_the_bar(bar, capfd) -> None:
    """A stage that comes again, as for all of a long recording, does not lower the number."""
    bar, _, shown = bar
    bar("loading")
    bar.stages = (*Stage, "writing the report")
    bar(Stage.SIMULATE)
    assert shown().startswith(f"3 of 7: {Stage.SIMULATE}")
    bar(Work("refitting", 1, 2))
    bar("simulations name drag on cart")
    assert shown().startswith("3 of 7: refitting") and "50%" in shown()
    bar(Stage.FIT)
    assert shown().startswith(f"3 of 7: {Stage.FIT}")
    assert "s] simulations name drag on cart\n" in capfd.readouterr().err


def test_an_interrupt_leaves_the_terminal_clean(monkeypatch: pytest.MonkeyPatch) -> None:
    """The cursor is back and the last line is empty."""
    written = terminal(monkeypatch)
    with pytest.raises(KeyboardInterrupt), Progress(False) as bar:
        bar("searching")
        for i in counted(range(3), 3, "refitting", bar):
            bar._bar.refresh()
            if i:
                raise KeyboardInterrupt
    before, _, after = written.getvalue().rpartition("\x1b[2K")
    assert "refitting" in before and "33%" in before
    assert "\x1b[?25h" in before[before.rindex("refitting") :] + after
    assert "refitting" not in after and before.count("s] searching\n") == 1


def test_a_log_has_the_share_done(capfd: pytest.CaptureFixture[str]) -> None:
    """Work itself is no line."""
    with Progress(False, every=0.02) as bar:
        bar("searching")
        bar(Work("refitting", 2, 8))
        time.sleep(0.2)
    first, *others = capfd.readouterr().err.splitlines()
    assert first.endswith("s] searching")
    assert others and all(one.endswith("s] refitting: still running, 25% done") for one in others)


def test_work_in_parallel_is_counted() -> None:
    """In the order of the items, from none to all."""
    said: list[Work] = []
    assert in_parallel(lambda x: x * x, range(4), "squaring", said.append) == [0, 1, 4, 9]
    assert [(work, work.done, work.total) for work in said] == [
        ("squaring", done, 4) for done in range(5)
    ]
