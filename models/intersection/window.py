"""Views of a long array for machine code that makes many of them in every call."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


def _window(context: Any, array: Any, begin: Any, shape: Any) -> Any:
    """The C-ordered view of a vector that starts at `begin` and has `shape`, a tuple.

    It has no owner and nothing is checked, so it costs no atomic counting and no call. Valid only while the owner
    lives, that is, inside the call that was handed the vector, and within its length."""
    view_type = types.Array(array.dtype, len(shape), "C")

    def build(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = target.make_array(signature.args[0])(target, builder, arguments[0])
        view = target.make_array(view_type)(target, builder)
        word = target.get_value_type(types.intp)
        lengths = [
            target.cast(builder, builder.extract_value(arguments[2], i), axis, types.intp)
            for i, axis in enumerate(signature.args[2])
        ]
        strides: list[Any] = []
        items = ir.Constant(word, 1)
        for length in reversed(lengths):
            strides.insert(0, builder.mul(items, vector.itemsize))
            items = builder.mul(items, length)
        first = target.cast(builder, arguments[1], signature.args[1], types.intp)
        view.data = builder.gep(vector.data, [first])
        view.shape, view.strides = _packed(builder, word, lengths), _packed(builder, word, strides)
        view.nitems, view.itemsize = items, vector.itemsize
        view.meminfo, view.parent = ir.Constant(view.meminfo.type, None), ir.Constant(view.parent.type, None)
        return view._getvalue()

    return view_type(array, begin, shape), build


window: Any = intrinsic(_window)


def _packed(builder: Any, word: Any, values: list[Any]) -> Any:
    """An LLVM array of values."""
    out = ir.Constant(ir.ArrayType(word, len(values)), ir.Undefined)
    for i, value in enumerate(values):
        out = builder.insert_value(out, value, i)
    return out
