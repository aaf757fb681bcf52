"""A counter that threads share: each draws its next work from it, so uneven work balances."""

from typing import Any

import numba
from numba import types
from numba.extending import intrinsic


@intrinsic
def _draw(typingctx: Any, counter: Any, amount: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, args[1], "monotonic")

    assert isinstance(counter, types.Array)
    return types.int64(counter, types.int64), codegen


if numba.config.DISABLE_JIT:

    def draw(counter: Any, amount: int) -> int:
        """Add to counter[0] (int64), in one step whatever other threads do; return what it was."""
        before = int(counter[0])
        counter[0] = before + amount
        return before

else:
    draw = _draw
