"""Exceptions and warnings: each message says what is wrong, where, and the cure."""

import inspect
import re
import warnings
from collections.abc import Mapping
from pathlib import Path

_PACKAGE = str(Path(__file__).parent)
#: Characters that a terminal obeys or that turn the direction of a text, and halves of characters.
_OBEYED = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)


def printable(text: object, kept: str = "") -> str:
    r"""Return a text with control characters and marks of direction as escapes, but those ``kept``.

    Examples
    --------
    >>> print(printable("cart\x1b[2J"))
    cart\x1b[2J
    """
    return _OBEYED.sub(lambda one: one[0] if one[0] in kept else ascii(one[0])[1:-1], str(text))


def in_a_line(message: object) -> str:
    """Return a message in one line, whatever it quotes from a file, without control characters."""
    return printable(" ".join(str(message).split()))


def warn(message: str | Warning, category: type[Warning] | None = None) -> None:
    """Issue a warning that points at the first caller outside the package."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


class PbrlError(Exception):
    """Base of every error that a user can cause and cure."""


class SceneError(PbrlError, ValueError):
    """An invalid scene: an unknown key, an impossible shape, a joint to nowhere."""


class HistoryError(PbrlError, ValueError):
    """An invalid history: missing columns, bad times, values that are not numbers."""


class LayoutError(HistoryError):
    """A recording that needs an entry of ``[recording]`` first: the message proposes it.

    Parameters
    ----------
    message : str
        What is wrong, and the entry as the cure.
    **entries
        The entries, such as ``units={"time": "ms"}``.
    """

    def __init__(self, message: str, **entries: Mapping[str, object]) -> None:
        super().__init__(message)
        self.entries = entries


class ParameterError(PbrlError, ValueError):
    """A physical parameter outside its support, or one that is missing or unknown."""


class EffectError(PbrlError, ValueError):
    """An effect that is not in the catalogue, or that does not apply to the body named."""


class SimulationError(PbrlError, RuntimeError):
    """An impossible request to the engine: wrong shapes, an unknown path, no substeps."""


class PosteriorError(PbrlError, ValueError):
    """A file that is not a posterior of this package, or that lacks a part."""


class OutputError(PbrlError, OSError):
    """An output that cannot be written, or that exists already."""


class PbrlWarning(UserWarning):
    """Base of the warnings below."""


class ConvergenceWarning(PbrlWarning):
    """A fit whose R-hat or effective sample size is not good enough to rely on."""


class BoundWarning(PbrlWarning):
    """A fit with a parameter at a bound of its support."""


class LinearisationWarning(PbrlWarning):
    """A fit of whole trajectories whose linearised likelihood differs from the engine's."""


class UninformedWarning(PbrlWarning):
    """A fit whose data do not inform a parameter: its posterior is its prior."""


class PriorWarning(PbrlWarning):
    """A recording that is improbable under the prior: check units and hyper-parameters."""


class RefitWarning(PbrlWarning):
    """An update that could not use the earlier draws, so that all data were fitted again."""


class MeetingWarning(PbrlWarning):
    """A fit that was repeated because bodies that were simulated apart meet."""


class RecordingWarning(PbrlWarning):
    """A recording that is cut, or of which rows are left out."""


class ResamplingWarning(PbrlWarning):
    """A history whose samples were not evenly spaced, and were interpolated."""


class FitError(PbrlError, ValueError):
    """A model that cannot be fitted as asked."""


class GoalError(PbrlError, ValueError):
    """An invalid goal, start or set of actions."""
