"""What to do in the world: reference lines, candidate motions and their checks, optimal control, behaviour, control.

Fed with plain arrays; lengths are in m, times in s, angles in rad."""

import models.formula  # noqa: F401  the package says where compiled code is kept before numba asks
