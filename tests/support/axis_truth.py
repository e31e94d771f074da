"""The true axis of the turntable."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

F64 = NDArray[np.float64]


def true_axis(turns: Sequence[F64]) -> tuple[F64, F64]:
    """(2,) rotation vector from z to the axis, (2,) mm where it passes z = 0; object frame at the first angle."""
    relative = np.linalg.inv(turns[0]) @ turns[1]
    way = Rotation.from_matrix(relative[:3, :3]).as_rotvec()
    way *= np.sign(way[2]) / np.linalg.norm(way)
    point = np.linalg.lstsq(np.eye(3) - relative[:3, :3], relative[:3, 3], rcond=None)[0]
    return np.array([-way[1], way[0]]), (point - point[2] / way[2] * way)[:2]
