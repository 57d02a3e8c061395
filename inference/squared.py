"""A compiled sum of squares (models.capability.Squares) as one factor, so that any engine runs on it.

x = (z - loc) / scale,   f(x) = log_const - cost(z),   df / dx = -scale dcost / dz
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.capability import Factors, Squares

Array = NDArray[np.float64]


def squared(squares: Squares) -> Factors:
    """The factor of x, the numbers that inference.squares has."""
    size, blocks = len(squares.loc), squares.blocks
    hessian = np.empty((size, size) if blocks is None else (*blocks.shape, blocks.shape[1]))  # filled, never read

    def gradient(x: Array) -> tuple[Array, Array]:
        heights, slopes = np.empty(len(x)), np.empty(x.shape)
        for row, z in enumerate(squares.loc + squares.scale * x):
            heights[row] = squares.log_const - squares.evaluate(z, hessian, slopes[row])
        slopes *= -squares.scale
        return heights, slopes

    return Factors(
        evaluate=lambda x: gradient(x)[0][:, None],
        gradient=gradient,
        depends=np.ones((1, size), dtype=bool),
        sites=squares.sites,
        latents=lambda x: squares.unpack(squares.loc + squares.scale * x),
        whiten=lambda state: (squares.pack(state) - squares.loc) / squares.scale,
    )
