"""Views without reference counting, for code that makes many small views of a long-lived array."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.extending import intrinsic


@intrinsic
def borrow(context: Any, array: Any) -> Any:  # type: ignore[no-untyped-def]
    """The same array with no owner: its views cost no atomic counting.

    Valid only while the owner lives, that is, inside the call that was handed the array."""

    def build(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        view = target.make_array(signature.return_type)(target, builder, arguments[0])
        view.meminfo = ir.Constant(view.meminfo.type, None)
        return view._getvalue()

    return array(array), build
