"""The loop that a peer is measured with: every shadow ray of every receiver through Embree, 16 at a time.

Embree's C function is called from machine code by its address, so that the loop around it costs what it
would in C++. Nothing in the program itself uses this file.
"""

import platform
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.bits import ONE, ZERO, popcount64
from penumbra.kernels.lanes import bits_above, load, splat, store

LANES = 16
# Where the fields of a packet begin, in 4-byte words: each holds one value for each of the 16 rays.
ORIGIN_X, ORIGIN_Y, ORIGIN_Z, T_NEAR = 0, 16, 32, 48
DIRECTION_X, DIRECTION_Y, DIRECTION_Z, TIME = 64, 80, 96, 112
T_FAR, RAY_MASK, RAY_ID, RAY_FLAGS = 128, 144, 160, 176
PACKET_WORDS = 192

_ZERO = np.float32(0.0)
_END = np.float32(1.0)
# Flush-to-zero, denormals-are-zero, and every floating-point exception masked.
_FLUSHING = 0x9FC0
_IS_X86 = platform.machine().lower() in ("x86_64", "amd64")


@intrinsic
def _occluded16(typingctx: Any, function: Any, valid: Any, scene: Any, packet: Any, arguments: Any) -> Any:
    """Call `void (int *valid, scene, packet, arguments)` at an address; the arrays are passed as pointers."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        address = builder.inttoptr(
            args[0], ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer, pointer]).as_pointer()
        )
        lanes, rays = (
            builder.bitcast(context.make_array(kind)(context, builder, array).data, pointer)
            for kind, array in ((signature.args[1], args[1]), (signature.args[3], args[3]))
        )
        handle, options = (builder.inttoptr(word, pointer) for word in (args[2], args[4]))
        builder.call(address, [lanes, handle, rays, options])
        return context.get_dummy_value()

    return types.void(types.intp, valid, types.intp, packet, types.intp), codegen


@intrinsic
def _store_positive(typingctx: Any, array: Any, lanes: Any) -> Any:
    """Write -1 into an int32 array where a lane is above zero, and 0 elsewhere."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        above = builder.fcmp_ordered(">", args[1], ir.Constant(args[1].type, None))
        words = builder.sext(above, ir.VectorType(ir.IntType(32), lanes.count))
        builder.store(words, builder.bitcast(data, words.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, lanes), codegen


@intrinsic
def _set_float_control(typingctx: Any, word: Any) -> Any:
    """Set the thread's floating-point control word and return the former one; 0 where there is none."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        i32, pointer = ir.IntType(32), ir.IntType(8).as_pointer()
        if not _IS_X86:
            return ir.Constant(i32, 0)
        kind = ir.FunctionType(ir.VoidType(), [pointer])
        place = cgutils.alloca_once(builder, i32)
        read, write = (
            cgutils.get_or_insert_function(builder.module, kind, f"llvm.x86.sse.{name}")
            for name in ("stmxcsr", "ldmxcsr")
        )
        builder.call(read, [builder.bitcast(place, pointer)])
        former = builder.load(place)
        builder.store(args[0], place)
        builder.call(write, [builder.bitcast(place, pointer)])
        return former

    return types.uint32(types.uint32), codegen


@helper
def _clear_padding(words, n_samples):
    """Clear the bits beyond the samples in the last word of a mask."""
    in_last = n_samples - 64 * (words.shape[0] - 1)
    # A pass over fewer samples may end before the last word, where there is nothing to clear.
    if 0 < in_last < 64:
        words[-1] &= (ONE << np.uint64(in_last)) - ONE


@kernel
def trace_shadow_rays(
    occluded16, scene, arguments, valid, packet, points, normals, sets, samples, n_samples, masks
):
    """Trace all shadow rays of some receivers; returns the number of rays traced.

    occluded16, scene, arguments: addresses. valid int32 (16,) and packet float32 (PACKET_WORDS,) are
    scratch of one thread, aligned to 64 bytes, whose constant fields are filled in. points, normals
    float32 (R, 3); sets int64 (R,); samples float32 (sets, 3, K padded to 16, the padding nan). masks
    uint64 (R, n_words) is written: a set bit means blocked, or below the receiver's plane.
    """
    control = _set_float_control(np.uint32(_FLUSHING))
    n_packets = (n_samples + LANES - 1) // LANES
    n_traced = 0
    for receiver in range(points.shape[0]):
        x, y, z = splat(points[receiver, 0]), splat(points[receiver, 1]), splat(points[receiver, 2])
        nx, ny, nz = splat(normals[receiver, 0]), splat(normals[receiver, 1]), splat(normals[receiver, 2])
        store(packet, ORIGIN_X, x)
        store(packet, ORIGIN_Y, y)
        store(packet, ORIGIN_Z, z)
        first = sets[receiver] * 3 * samples.shape[2]
        masks[receiver, :] = ZERO
        for number in range(n_packets):
            at = first + number * LANES
            dx = load(samples, at) - x
            dy = load(samples, at + samples.shape[2]) - y
            dz = load(samples, at + 2 * samples.shape[2]) - z
            above = nx * dx + ny * dy + nz * dz
            traced = bits_above(above, splat(_ZERO))
            blocked = np.int64(0xFFFF)
            if traced:
                store(packet, DIRECTION_X, dx)
                store(packet, DIRECTION_Y, dy)
                store(packet, DIRECTION_Z, dz)
                # The direction is not normalised: the sample itself is at t = 1.
                store(packet, T_FAR, splat(_END))
                _store_positive(valid, above)
                _occluded16(occluded16, valid, scene, packet, arguments)
                # Embree sets t_far of a blocked ray to minus infinity.
                blocked = bits_above(splat(_ZERO), load(packet, T_FAR)) & traced | (traced ^ blocked)
                n_traced += popcount64(np.uint64(traced))
            masks[receiver, number // 4] |= np.uint64(blocked) << np.uint64(16 * (number % 4))
        _clear_padding(masks[receiver], n_samples)
    _set_float_control(control)
    return n_traced
