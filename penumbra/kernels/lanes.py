"""Vectors of lanes: 16 float32 or int32, 8 float64, 4 uint64: LLVM vectors under JIT, numpy arrays without.

Explicit vectors do not depend on what the auto-vectoriser sees in a loop, and LLVM lowers them on any
processor: a group of 32 samples against a blocker takes 5 ns, eight planes against a box 2 ns. One
source serves both modes: load and splat make vectors, + - * / & work on them, lesser and greater pick by
lane, bits_above packs a comparison, choose picks by such bits, store puts a vector into an array.
"""

import operator
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model


class Lanes(types.Type):  # type: ignore[misc]
    """numba type of a vector of `count` numbers."""

    def __init__(self, element: types.Number, count: int) -> None:
        self.element = element
        self.count = count
        super().__init__(name=f"Lanes({element}, {count})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, dmm: Any, fe_type: Lanes) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(_ELEMENTS[fe_type.element], fe_type.count))


_ELEMENTS = {
    types.float32: ir.FloatType(),
    types.float64: ir.DoubleType(),
    types.int32: ir.IntType(32),
    types.uint64: ir.IntType(64),
}
_F32X16 = Lanes(types.float32, 16)
_F64X8 = Lanes(types.float64, 8)
_I32X16 = Lanes(types.int32, 16)
_U64X4 = Lanes(types.uint64, 4)
_KINDS = {kind.element: kind for kind in (_F32X16, _F64X8, _I32X16, _U64X4)}
Codegen = Callable[[Any, Any, Any, Any], Any]


def _vector(context: Any, kind: Lanes) -> Any:
    return context.get_value_type(kind)


@intrinsic
def _load(typingctx: Any, array: Any, offset: Any) -> tuple[Any, Codegen]:
    """Lanes from a C-contiguous array, from a flat element offset on."""
    kind = _KINDS[array.dtype]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        pointer = builder.gep(data, [args[1]])
        vector = builder.bitcast(pointer, _vector(context, kind).as_pointer())
        return builder.load(vector, align=array.dtype.bitwidth // 8)

    return kind(array, types.intp), codegen


@intrinsic
def _prefetch(typingctx: Any, array: Any, offset: Any) -> tuple[Any, Codegen]:
    """Ask for the cache line at a flat element offset of an array."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        flag = ir.IntType(32)
        function = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer(), flag, flag, flag]),
            "llvm.prefetch.p0",
        )
        # To be read, into every level of cache, as data.
        builder.call(function, [pointer, flag(0), flag(3), flag(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
def _store(typingctx: Any, array: Any, offset: Any, lanes: Any) -> tuple[Any, Codegen]:
    """Put lanes into a C-contiguous array, from a flat element offset on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        pointer = builder.gep(data, [args[1]])
        vector = builder.bitcast(pointer, _vector(context, lanes).as_pointer())
        builder.store(args[2], vector, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), codegen


@intrinsic
def _splat(typingctx: Any, value: Any) -> tuple[Any, Codegen]:
    """Lanes that all hold one value."""
    kind = _KINDS[value]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = _vector(context, kind)
        first = builder.insert_element(
            ir.Constant(vector, ir.Undefined), args[0], ir.Constant(ir.IntType(32), 0)
        )
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), kind.count), None)
        return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)

    return kind(value), codegen


def _binary(build: Callable[[Any, Any, Any], Any]) -> Any:
    """Intrinsic of two vectors of one kind."""

    @intrinsic
    def apply(typingctx: Any, left: Any, right: Any) -> tuple[Any, Codegen]:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return build(builder, args[0], args[1])

        return left(left, right), codegen

    return apply


@intrinsic
def _pick(typingctx: Any, left: Any, right: Any, one: Any, other: Any) -> tuple[Any, Codegen]:
    """Lanes of `one` where left > right, of `other` elsewhere."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[2], args[3])

    return one(left, right, one, other), codegen


_add = _binary(lambda b, x, y: b.fadd(x, y))
_sub = _binary(lambda b, x, y: b.fsub(x, y))
_mul = _binary(lambda b, x, y: b.fmul(x, y))
_div = _binary(lambda b, x, y: b.fdiv(x, y))
_and = _binary(lambda b, x, y: b.and_(x, y))
_lesser = _binary(lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y))
_greater = _binary(lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y))


def _comparison(sign: str) -> Any:
    """Intrinsic that packs a comparison by lane into the low bits of an int64."""

    @intrinsic
    def apply(typingctx: Any, left: Any, right: Any) -> tuple[Any, Codegen]:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            if isinstance(left.element, types.Float):
                lanes = builder.fcmp_ordered(sign, args[0], args[1])
            else:
                lanes = builder.icmp_signed(sign, args[0], args[1])
            packed = builder.bitcast(lanes, ir.IntType(left.count))
            return builder.zext(packed, ir.IntType(64))

        return types.int64(left, right), codegen

    return apply


_bits_above = _comparison(">")
_bits_not_below = _comparison(">=")
_bits_equal = _comparison("==")


def _library(name: str, n_arguments: int) -> Any:
    """Codegen of an LLVM intrinsic of vectors of one kind."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = signature.args[0]
        vector = _vector(context, kind)
        function = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(vector, [vector] * n_arguments),
            f"{name}.v{kind.count}f{kind.element.bitwidth}",
        )
        return builder.call(function, args)

    return codegen


@intrinsic
def _muladd(typingctx: Any, x: Any, y: Any, z: Any) -> tuple[Any, Codegen]:
    """Return x * y + z, fused where the processor does that in one step."""
    return x(x, y, z), _library("llvm.fmuladd", 3)


@intrinsic
def _magnitude(typingctx: Any, x: Any) -> tuple[Any, Codegen]:
    return x(x), _library("llvm.fabs", 1)


@intrinsic
def _with_sign(typingctx: Any, x: Any, sign: Any) -> tuple[Any, Codegen]:
    return x(x, sign), _library("llvm.copysign", 2)


@intrinsic
def _choose(typingctx: Any, bits: Any, x: Any, y: Any) -> tuple[Any, Codegen]:
    """Lane of x where its bit is set, otherwise of y."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        packed = builder.trunc(args[0], ir.IntType(x.count))
        chosen = builder.bitcast(packed, ir.VectorType(ir.IntType(1), x.count))
        return builder.select(chosen, args[1], args[2])

    return x(types.int64, x, y), codegen


@intrinsic
def _to_integers(typingctx: Any, x: Any) -> tuple[Any, Codegen]:
    """Truncate float32 lanes that are within the range of an int32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fptosi(args[0], _vector(context, _I32X16))

    return _I32X16(x), codegen


@intrinsic
def _any_bit(typingctx: Any, x: Any) -> tuple[Any, Codegen]:
    """Whether any bit of any lane is set."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        whole = ir.IntType(64 * x.count)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], whole), ir.Constant(whole, 0))

    return types.boolean(x), codegen


def _overload_operator(symbol: Any, apply: Any) -> None:
    @overload(symbol)
    def typed(left, right):
        if isinstance(left, Lanes) and left == right:
            return lambda left, right: apply(left, right)
        return None


for _symbol, _apply in (
    (operator.add, _add),
    (operator.sub, _sub),
    (operator.mul, _mul),
    (operator.truediv, _div),
    (operator.and_, _and),
):
    _overload_operator(_symbol, _apply)


def _packed(lanes: np.ndarray) -> np.int64:
    return np.int64(sum(1 << k for k, set_ in enumerate(lanes) if set_))


if numba.config.DISABLE_JIT:

    def load(array, offset):
        """Lanes from a C-contiguous array, from a flat element offset on."""
        return array.reshape(-1)[
            offset : offset + {"f4": 16, "i4": 16, "f8": 8, "u8": 4}[array.dtype.str[1:]]
        ]

    def store(array, offset, lanes):
        """Put lanes into a C-contiguous array, from a flat element offset on."""
        array.reshape(-1)[offset : offset + len(lanes)] = lanes

    def prefetch(array, offset):
        """Ask for the cache line at a flat element offset of an array."""

    def splat(value):
        """Lanes that all hold one float32 or float64."""
        return np.full(8 if isinstance(value, float) else 16, value)

    def lesser(left, right):
        """Lesser of two vectors, by lane."""
        return np.minimum(left, right)

    def greater(left, right):
        """Greater of two vectors, by lane."""
        return np.maximum(left, right)

    def pick(left, right, one, other):
        """Lanes of `one` where left > right, of `other` elsewhere."""
        return np.where(left > right, one, other)

    def bits_above(left, right):
        """Bit k is set where lane k of left > right; int64."""
        return _packed(left > right)

    def bits_not_below(left, right):
        """Bit k is set where lane k of left >= right; int64."""
        return _packed(left >= right)

    def bits_equal(left, right):
        """Bit k is set where lane k of left == right; int64."""
        return _packed(left == right)

    def muladd(x, y, z):
        """Return x * y + z by lane, fused or not."""
        return x * y + z

    def magnitude(x):
        """Absolute value by lane."""
        return np.abs(x)

    def with_sign(x, sign):
        """Return x by lane, with the sign of `sign`."""
        return np.copysign(x, sign)

    def choose(bits, x, y):
        """Lane of x where its bit is set, otherwise of y."""
        return np.where(np.int64(bits) >> np.arange(len(x)) & 1 == 1, x, y)

    def to_integers(x):
        """Truncate float32 lanes that are within the range of an int32."""
        return x.astype(np.int32)

    def any_bit(x):
        """Whether any bit of any lane is set."""
        return bool(x.any())

else:
    load, store, prefetch, splat, lesser, greater = _load, _store, _prefetch, _splat, _lesser, _greater
    pick, bits_above, bits_not_below, bits_equal = _pick, _bits_above, _bits_not_below, _bits_equal
    choose, muladd, magnitude, with_sign = _choose, _muladd, _magnitude, _with_sign
    to_integers, any_bit = _to_integers, _any_bit
