"""Lanelet maps as OSM files, as the Lanelet2 library of Poggenhans et al. (2018) reads them.

Lanelet2 places a map by UTM: x and y are what easting and northing exceed those of the origin by, in the origin's zone.
With latitude phi, longitude lambda from the middle of the zone, and e, f and a of the ellipsoid WGS 84 (Krüger's
series, as in Karney 2011, "Transverse Mercator with an accuracy of a few nanometers"),

    tau = sinh(atanh(sin phi) - e atanh(e sin phi))
    zeta = atan2(tau, cos lambda) + i asinh(sin lambda / hypot(tau, cos lambda))
    northing + i easting = 0.9996 A (zeta + sum_k alpha_k sin 2 k zeta)

where A = a (1 + n^2 / 4) / (1 + n), n = f / (2 - f). Two terms are within .1 mm at 4 km from the origin. False easting
and northing cancel.
"""

from __future__ import annotations

import math
from itertools import count, pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike, NDArray

from experiments.lanelets import LaneletMap
from models.program import InputError

Floats = NDArray[np.float64]
Place = tuple[float, float]  # latitude, longitude [deg]
KARLSRUHE = (49.0105, 8.4190)  # for maps of no known place

FLATTENING = 1 / 298.257223563
E = math.sqrt(FLATTENING * (2 - FLATTENING))
N = FLATTENING / (2 - FLATTENING)
RADIUS = 0.9996 * 6378137.0 * (1 + N**2 / 4) / (1 + N)  # [m]
ALPHA = (N / 2 - 2 * N**2 / 3, 13 * N**2 / 48)


def write_osm(path: Path, lanelets: LaneletMap, origin: Place = KARLSRUHE) -> None:
    """Write a map whose metres count from `origin` to the east (x) and to the north (y).

    Lanelet i is relation i + 1. Lanelets that follow one another have the nodes of their common end in common.
    Borders are virtual: nobody saw markings. Raises InputError for an origin beyond the usual zones of UTM."""
    number = len(lanelets.lanelets)
    begin, end = 2 * np.arange(number), 2 * np.arange(number) + 1  # which gate each lanelet leads from and to
    for before, after in lanelets.followers:
        begin[after] = end[before]
    for before, after in lanelets.followers:  # again, for the others that lead to the same gate
        end[before] = begin[after]

    places: dict[int, Floats] = {}
    ways: list[list[int]] = []
    between = count(4 * number)
    for lanelet, first, last in zip(lanelets.lanelets, begin.tolist(), end.tolist(), strict=True):
        for side, border in enumerate((lanelet.left, lanelet.right)):
            nodes = [2 * first + side, *(next(between) for _ in border[1:-1]), 2 * last + side]
            places.update(zip(nodes, border, strict=True))
            ways.append(nodes)

    osm = Element("osm", version="0.6", generator="waybayes")
    degrees = geographic(np.array(list(places.values())), origin)
    for node, (latitude, longitude) in zip(places, degrees, strict=True):
        _element(osm, "node", node + 1, {}, lat=f"{latitude:.11f}", lon=f"{longitude:.11f}")
    for way, nodes in enumerate(ways):
        element = _element(osm, "way", way + 1, {"type": "virtual"})
        for node in nodes:
            ElementTree.SubElement(element, "nd", ref=str(node + 1))
    tags = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes"}
    for lane in range(number):
        element = _element(osm, "relation", lane + 1, tags)
        for side, role in enumerate(("left", "right")):
            ElementTree.SubElement(element, "member", type="way", ref=str(2 * lane + side + 1), role=role)
    ElementTree.indent(osm)
    ElementTree.ElementTree(osm).write(path, encoding="utf-8", xml_declaration=True)


def read_osm(path: Path, origin: Place = KARLSRUHE) -> Any:
    """The lanelet2.core.LaneletMap in a file. Raises InputError without the extra `maps`."""
    try:
        from lanelet2 import io, projection
    except ImportError:
        raise InputError(
            "Lanelet2 maps are read by lanelet2, which is not installed; install the extra 'maps'"
        ) from None
    return io.load(str(path), projection.UtmProjector(io.Origin(*origin)))


def routes_ok(lanelets: LaneletMap, path: Path, origin: Place = KARLSRUHE) -> float:
    """Share of connections whose whole route vehicles may drive in the routing graph of the file at `path`.

    Raises InputError without the extra `maps`."""
    stored = read_osm(path, origin)
    from lanelet2 import routing, traffic_rules

    rules = traffic_rules.create(traffic_rules.Locations.Germany, traffic_rules.Participants.Vehicle)
    graph = routing.RoutingGraph(stored, rules)
    lanes = [stored.laneletLayer[number + 1] for number in range(len(lanelets.lanelets))]
    follows = {(lane.id - 1, after.id - 1) for lane in lanes for after in graph.following(lane)}
    passable = [rules.canPass(lane) for lane in lanes]
    driven = [all(passable[lane] for lane in r) and follows.issuperset(pairwise(r)) for r in lanelets.routes]
    return float(np.mean(driven))


def geographic(points: Floats, origin: Place) -> Floats:
    """Latitude and longitude (n, 2) [deg] of points (n, 2) to the east and north of an origin [m]."""
    meridian = _meridian(*origin)
    latitude, longitude = np.radians(origin)
    zeta = (_grid(latitude, longitude - math.radians(meridian)) + points[:, 1] + 1j * points[:, 0]) / RADIUS
    conformal = zeta
    for _ in range(5):  # each takes three digits off the error
        conformal = zeta - _series(conformal)
    tau = np.sin(conformal.real) / np.hypot(np.sinh(conformal.imag), np.cos(conformal.real))
    sine = np.tanh(np.arcsinh(tau))
    for _ in range(6):  # each takes two
        sine = np.tanh(np.arcsinh(tau) + E * np.arctanh(E * sine))
    east = np.arctan2(np.sinh(conformal.imag), np.cos(conformal.real))
    return np.stack([np.degrees(np.arcsin(sine)), meridian + np.degrees(east)], axis=1)


def _grid(latitude: float, longitude: float) -> complex:
    """Northing + i easting [m] of radians, longitude from the middle of the zone."""
    tau = math.sinh(math.atanh(math.sin(latitude)) - E * math.atanh(E * math.sin(latitude)))
    cosine = math.cos(longitude)
    zeta = complex(math.atan2(tau, cosine), math.asinh(math.sin(longitude) / math.hypot(tau, cosine)))
    return complex(RADIUS * (zeta + _series(zeta)))


def _series(zeta: ArrayLike) -> Any:
    return sum(alpha * np.sin(2 * (k + 1) * np.asarray(zeta)) for k, alpha in enumerate(ALPHA))


def _meridian(latitude: float, longitude: float) -> float:
    """The middle of the zone of a place [deg]; Norway's south-west belongs to the zone to its east."""
    if not (-80 <= latitude < 72 and -180 <= longitude < 180):
        raise InputError(
            f"the origin must be a latitude from -80 to 72 and a longitude from -180 to 180 degrees, where UTM has "
            f"zones of 6 degrees, but is {latitude}, {longitude}; choose another"
        )
    if 56 <= latitude < 64 and 3 <= longitude < 12:
        return 9.0
    return 6.0 * math.floor(longitude / 6) + 3.0


def _element(osm: Element, kind: str, name: int, tags: dict[str, str], **more: str) -> Element:
    element = ElementTree.SubElement(osm, kind, {"id": str(name), "version": "1", "visible": "true", **more})
    for key, value in tags.items():
        ElementTree.SubElement(element, "tag", k=key, v=value)
    return element
