"""Arrays without reference counts inside a kernel.

numba counts references of every array it takes out of a tuple, with an atomic increment and
decrement each time: 16,000 receivers of the dragon took 54 s to cast, and 16 s with borrowed arrays. A
kernel's arguments outlive it, so it may borrow them: the same arrays with no owner, whose counting is
a no-op. A helper that stays a call borrows again: only where LLVM sees that there is no owner does it
drop the counting altogether (the same receivers, other helpers inlined: 11 s without that, 5 s with it).
"""

from typing import Any

import numba
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if not isinstance(kind, types.Array):
        return value
    array = context.make_array(kind)(context, builder, value)
    array.meminfo = cgutils.get_null_value(array.meminfo.type)
    array.parent = cgutils.get_null_value(array.parent.type)
    return array._getvalue()


@intrinsic
def _borrow(typingctx: Any, value: Any) -> Any:
    """Return an array, or a tuple of arrays and numbers, with no owner."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = signature.args[0]
        if not isinstance(kind, types.BaseTuple):
            return _without_owner(context, builder, kind, args[0])
        members = cgutils.unpack_tuple(builder, args[0])
        borrowed = [_without_owner(context, builder, k, m) for k, m in zip(kind.types, members, strict=True)]
        return context.make_tuple(builder, kind, borrowed)

    return value(value), codegen


if numba.config.DISABLE_JIT:

    def borrow(value: Any) -> Any:
        """Return the value itself: Python counts its references anyway."""
        return value

else:
    borrow = _borrow
