"""Elements of CommonRoad files: numbers, points, shapes, references; what is wrong is one sentence with its place."""

from __future__ import annotations

import gzip
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.program import InputError

Floats = NDArray[np.float64]
Element = ET.Element
ROUND = 16  # corners of a circle


def root_of(file: Path) -> Element:
    """The outermost element of a scenario in an .xml or .xml.gz file."""
    try:
        data = file.read_bytes()
        root = ET.fromstring(gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data)
    except FileNotFoundError:
        raise InputError(f"{file}: there is no such file") from None
    except (OSError, EOFError) as error:
        raise InputError(f"{file}: cannot be read ({error})") from None
    except ET.ParseError as error:
        raise InputError(f"{file}: is no XML ({error})") from None
    if root.tag != "commonRoad":
        raise InputError(f"{file}: is no CommonRoad scenario, its outermost element is <{root.tag}>")
    return root


def name_of(e: Element) -> str:
    """Tag and id, as messages name it."""
    return f"{e.tag} {e.get('id')}"


def key_of(e: Element, file: str) -> int:
    """Its id."""
    return integer(e.get("id"), f"{file}: id of a {e.tag}")


def integer(text: str | None, where: str) -> int:
    """A whole number."""
    try:
        return int(text or "")
    except ValueError:
        raise InputError(f"{where} is {text!r}, but must be a whole number") from None


def number(text: str | None, where: str) -> float:
    """A finite number."""
    try:
        value = float(text or "")
    except ValueError:
        raise InputError(f"{where} is {text!r}, but must be a number") from None
    if not math.isfinite(value):
        raise InputError(f"{where} is {value}; leave it out or mend it")
    return value


def child(e: Element, path: str, where: str) -> Element:
    """The first element along a path."""
    found = e.find(path)
    if found is None:
        raise InputError(f"{where} has no {path}")
    return found


def span(e: Element, where: str) -> tuple[float, float]:
    """Least and most of an exact value or an interval."""
    exact = e.findtext("exact")
    if exact is not None:
        value = number(exact, where)
        return value, value
    return tuple(number(child(e, f"interval{end}", where).text, where) for end in ("Start", "End"))  # type: ignore[return-value]


def points(e: Element, where: str) -> Floats:
    """(N, 2) of the points in it [m]."""
    told = [[number(p.findtext(axis), f"{where}: {axis} of a point") for axis in "xy"] for p in e.findall("point")]
    return np.array(told, float).reshape(-1, 2)


def refs(e: Element, tag: str, where: str) -> tuple[int, ...]:
    """Ids that elements of a tag refer to."""
    return tuple(integer(r.get("ref"), f"{where}: ref of a {tag}") for r in e.findall(tag))


def shapes(e: Element, where: str) -> Iterator[Floats]:
    """The parts of a shape, or of a place, as polygons (N, 2)."""
    for part in e:
        if part.tag == "polygon":
            yield points(part, f"{where}, polygon")
        if part.tag not in ("rectangle", "circle"):
            continue
        at = part.find("center")
        x, y = (0.0 if at is None else number(at.findtext(axis), f"{where}: center") for axis in "xy")
        if part.tag == "circle":
            angle = 2 * math.pi * np.arange(ROUND) / ROUND
            radius = number(part.findtext("radius"), f"{where}: radius")
            yield np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], -1)
        else:
            long, wide = (number(part.findtext(tag), f"{where}: {tag}") for tag in ("length", "width"))
            turn = number(part.findtext("orientation", "0"), f"{where}: orientation")
            u, v = long / 2 * np.array([1, -1, -1, 1]), wide / 2 * np.array([1, 1, -1, -1])
            cos, sin = math.cos(turn), math.sin(turn)
            yield np.stack([x + u * cos - v * sin, y + u * sin + v * cos], -1)
