"""Vehicle tracks as the intersection model reads them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Tracks(NamedTuple):
    """Positions of vehicles, one after the other, each in driving order, about a metre apart.

    points   (N, 2) [m]
    heading  (N,) driving direction [rad], None where it was not measured
    offsets  (T + 1,) track t holds points[offsets[t]:offsets[t + 1]]
    borders  (M, 2) points on the borders of lanes, markings or curbs, that were seen beside the tracks [m]
    """

    points: NDArray[np.float64]
    heading: NDArray[np.float64] | None
    offsets: NDArray[np.int64]
    borders: NDArray[np.float64] | None = None
