"""Objects side by side."""

from __future__ import annotations

import numpy as np

from models.multi_object import Bernoullis, Components, joined, no_components, together


def groups(sizes: list[int], first: int) -> Components:
    """Components numbered from `first` on, in groups of these sizes."""
    number = np.arange(first, first + sum(sizes))
    offset = np.append(0, np.cumsum(sizes)).astype(np.int64)
    return Components(
        offset, 0.5 + number, number % 3, np.tile(number[:, None], 2) + 0.0, number[:, None, None] * np.eye(2)
    )


def test_each_group_keeps_its_components_whatever_it_is_joined_with() -> None:
    parts = groups([2, 0, 3], 0), no_components(2, 1), groups([1, 2], 5)
    found = joined(*parts)
    np.testing.assert_array_equal(np.diff(found.offset), [2, 0, 3, 0, 1, 2])
    for there, expected in zip(found[1:], groups([8], 0)[1:], strict=True):
        np.testing.assert_array_equal(there, expected)
    assert [found[i].dtype for i in range(5)] == [parts[0][i].dtype for i in range(5)]


def test_objects_together_are_those_of_both_in_order() -> None:
    a = Bernoullis(np.array([7, 3]), np.array([0.5, 0.25]), groups([2, 1], 0))
    b = Bernoullis(np.array([9]), np.array([1.0]), groups([2], 3))
    found = together(a, b)
    np.testing.assert_array_equal(found.label, [7, 3, 9])
    np.testing.assert_array_equal(found.existence, [0.5, 0.25, 1.0])
    np.testing.assert_array_equal(found.components.weight, groups([5], 0).weight)
    np.testing.assert_array_equal(found.components.offset, [0, 2, 3, 5])
