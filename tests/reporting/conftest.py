"""What the tests of pages share."""

import pytest

from pbrl_ppl.reporting import reports


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page without its pictures, which take nearly all of its time."""
    monkeypatch.setattr(reports, "picture", lambda plot, *data: "data:image/png;base64,")
