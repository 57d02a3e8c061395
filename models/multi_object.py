"""What multi-object filters ask of a model: how objects move, what a sensor says of them, where new ones come from.

An object is a kind k and a state x (n,). A filter holds T of them as Bernoullis, each with an existence probability and
a Gaussian mixture over (k, x). A model tells, for N components at once:

    move      x' = f(x) + L e,  e ~ N(0, I),   and the probability to survive
    view      z = h(x) + N(0, R) with probability p_D(x),   clutter of intensity lambda_c(z)
    unseen    the intensity of objects that no scan has shown yet, about each measurement of a scan
    arrivals  objects that may have come at known places

A new sensor, motion or kind is a matter of the model: nothing of it is known here, or to a filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Components(NamedTuple):
    """N Gaussians over states of given kinds, in T groups one after the other.

    offset      (T + 1,) component offset[t] is the first of group t
    weight      (N,)
    kind        (N,)
    mean        (N, n)
    covariance  (N, n, n)
    """

    offset: Ints
    weight: Floats
    kind: Ints
    mean: Floats
    covariance: Floats

    @property
    def group(self) -> Ints:
        """(N,) the group of each component."""
        return np.repeat(np.arange(len(self.offset) - 1), np.diff(self.offset))


class Bernoullis(NamedTuple):
    """T objects that may exist.

    label       (T,) who they are
    existence   (T,) r
    components  T groups, of which the weights sum to one
    """

    label: Ints
    existence: Floats
    components: Components


class Moved(NamedTuple):
    """What time does to N states: mean (N, n) = f(x), slope (N, n, n) = df/dx, noise (N, n, m) = L, survival (N,)."""

    mean: Floats
    slope: Floats
    noise: Floats
    survival: Floats


class View(NamedTuple):
    """What M measurements of one scan have to do with N states.

    predicted  (N, d) h(x)
    slope      (N, d, n) dh/dx
    detection  (N,) p_D(x)
    values     (M, d) z
    noise      (K, d, d) R
    sort       (M,) which R
    clutter    (M,) lambda_c(z), per unit of z
    feature    (M, C) what else the measurement shows, given its kind: p(feature | kind) / p(feature | clutter)
    period     (d,) of angles, inf for what is no angle: residuals lie within half a period
    """

    predicted: Floats
    slope: Floats
    detection: Floats
    values: Floats
    noise: Floats
    sort: Ints
    clutter: Floats
    feature: Floats
    period: Floats


class Timed(Protocol):
    """A scan, as far as a filter is concerned: when [s], and by which sensor."""

    @property
    def time(self) -> float: ...

    @property
    def sensor(self) -> str: ...


@runtime_checkable
class HasObjects(Protocol):
    """A model of many objects that filters can run on.

    names, kind_names  of the state's entries and of the kinds
    period             (n,) of the state's angles, inf for what is no angle

    move(kind (N,), mean (N, n), seconds) -> Moved
    view(scan, objects, more) -> View of the components of `objects`, then of those of `more`; detection of the first
        may depend on all objects, of which nearer ones hide farther ones
    unseen(scan, past) -> a group of components for each measurement: near it, weight times density is the intensity of
        objects not seen before, as far as this measurement can tell where (no components: it cannot). `past` are the
        latest scans before it, by time: where they looked, fewer may be left
    arrivals(seconds) -> objects that came at known places in this time; their labels are not read
    check(data) -> the scans in the order given; raises InputError for one that cannot be used
    """

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def kind_names(self) -> tuple[str, ...]: ...

    @property
    def period(self) -> Floats: ...

    def move(self, kind: Ints, mean: Floats, seconds: float) -> Moved: ...

    def view(self, scan: Any, objects: Bernoullis, more: Components) -> View: ...

    def unseen(self, scan: Any, past: Sequence[Any] = ()) -> Components: ...

    def arrivals(self, seconds: float) -> Bernoullis: ...

    def check(self, scans: Any) -> Sequence[Any]: ...


def joined(*parts: Components) -> Components:
    """The groups of all, one after the other."""
    begin = np.cumsum([0, *(part.offset[-1] for part in parts)])
    offset = np.concatenate([begin[:1], *(at + part.offset[1:] for at, part in zip(begin[:-1], parts, strict=True))])
    _, *columns = zip(*parts, strict=True)
    return Components(offset, *map(np.concatenate, columns))


def together(a: Bernoullis, b: Bernoullis) -> Bernoullis:
    """The objects of both."""
    label, existence = np.concatenate([a.label, b.label]), np.concatenate([a.existence, b.existence])
    return Bernoullis(label, existence, joined(a.components, b.components))


def no_components(size: int, num_groups: int = 0) -> Components:
    """Groups without components, of states (size,)."""
    none = np.zeros(0)
    return Components(
        np.zeros(num_groups + 1, dtype=np.int64),
        none,
        none.astype(np.int64),
        np.zeros((0, size)),
        np.zeros((0, size, size)),
    )


def no_objects(size: int) -> Bernoullis:
    """Nobody there."""
    return Bernoullis(np.zeros(0, dtype=np.int64), np.zeros(0), no_components(size))
