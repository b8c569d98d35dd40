"""Memory of the last few predictions, for samplers that ask again for what was just computed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: A Metropolis step asks for the proposed point and the current one: the latter was just computed.
_REMEMBERED = 4


class Memory:
    """The last few results of a function, by its arguments; they do not go into a pickle."""

    def __init__(self) -> None:
        self._known: OrderedDict[Hashable, Array] = OrderedDict()

    def __getstate__(self) -> dict[str, object]:
        """Nothing."""
        return {"_known": OrderedDict()}

    def recall(self, arguments: tuple[Array, ...], compute: Callable[..., Array]) -> Array:
        """``compute(*arguments)``, or what it gave for equal arguments a moment ago.

        Examples
        --------
        >>> memory, one = Memory(), np.ones(2)
        >>> memory.recall((one,), np.exp) is memory.recall((np.ones(2),), np.exp)
        True
        """
        parameters, *data = arguments  # of what is large, a hash will do
        key = (parameters.tobytes(), *((own.shape, hash(own.tobytes())) for own in data))
        if key in self._known:
            self._known.move_to_end(key)
        else:
            self._known[key] = compute(*arguments)
            if len(self._known) > _REMEMBERED:
                self._known.popitem(last=False)
        return self._known[key]
