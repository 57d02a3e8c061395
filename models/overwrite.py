"""Copy a vector in machine code. numba compiles `target[:] = source` for long, error texts included."""

import numba as nb


@nb.njit
def overwrite(target, source):  # type: ignore[no-untyped-def]
    """target[i] = source[i] for all i of the source."""
    for i in range(len(source)):
        target[i] = source[i]
