"""What the tests of broken stages share: a stage with a slip has to score worse, or to refuse its input.

A slip has to raise the score by the factor that stands beside it, over what the unbroken stage scores in the same test.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.base.errors import DiscoError

F64 = NDArray[np.float64]
Patch = pytest.MonkeyPatch
Slip = Callable[[Patch], None]


def require_seen(score: Callable[[], float], good: float, factor: float) -> None:
    """The broken stage scores worse by the factor, a finite number, or refuses by a named error."""
    try:
        bad = score()
    except DiscoError:
        return
    assert np.isfinite(bad)
    assert bad > factor * good
