"""Exact signs of small determinants of float64 differences, in fixed-point integers.

A float64 is an integer times a power of two, so a determinant of differences is one too. Integers
instead of Shewchuk's expansions ("Adaptive Precision Floating-Point Arithmetic and Fast Robust
Geometric Predicates", 1997): nothing can underflow or overflow, and a process with flush-to-zero
set gets the same signs. Each row of the matrix is scaled by its own power of two, which keeps the
integers short (a few hundred bits for ordinary scenes) and changes no sign.

Numbers are little-endian arrays of 32-bit limbs held in uint64, in two's complement.
"""

import math

import numpy as np

from penumbra.kernels._jit import helper

LIMB_BITS = 32
_ZERO = np.uint64(0)
_ONE = np.uint64(1)
_SHIFT = np.uint64(LIMB_BITS)
_LOW = np.uint64(0xFFFFFFFF)
_TOP_BIT = np.uint64(0x80000000)
# What a limb is combined with to be added or, as two's complement, subtracted. Constants of one type:
# numba would compile a literal flag once for either value.
ADD = np.uint64(0)
SUBTRACT = np.uint64(0xFFFFFFFF)
_NO_EXPONENT = np.int64(1 << 30)


@helper
def _split(value):
    """Integer mantissa without trailing zeros, and exponent: value = mantissa * 2**exponent."""
    if value == 0.0:
        return np.int64(0), np.int64(0)
    fraction, exponent = math.frexp(value)
    mantissa = np.int64(fraction * 9007199254740992.0)
    lowest = mantissa & -mantissa
    zeros = np.int64(math.frexp(float(lowest))[1] - 1)
    return mantissa >> zeros, np.int64(exponent) - np.int64(53) + zeros


@helper
def _add_shifted(number, mantissa, shift):
    """Add mantissa * 2**shift to a number; |mantissa| < 2**54, shift >= 0."""
    negative = mantissa < 0
    magnitude = np.uint64(-mantissa) if negative else np.uint64(mantissa)
    limb = shift // LIMB_BITS
    offset = np.uint64(shift - limb * LIMB_BITS)
    low = (magnitude & _LOW) << offset
    high = (magnitude >> _SHIFT) << offset
    piece0 = low & _LOW
    middle = (low >> _SHIFT) + (high & _LOW)
    piece1 = middle & _LOW
    piece2 = (high >> _SHIFT) + (middle >> _SHIFT)
    carry = _ZERO
    for i in range(limb, number.shape[0]):
        k = i - limb
        piece = piece0 if k == 0 else (piece1 if k == 1 else (piece2 if k == 2 else _ZERO))
        if k > 2 and carry == _ZERO:
            return
        if negative:
            total = (number[i] | (_ONE << _SHIFT)) - piece - carry
            number[i] = total & _LOW
            carry = _ONE - (total >> _SHIFT)
        else:
            total = number[i] + piece + carry
            number[i] = total & _LOW
            carry = total >> _SHIFT


@helper
def multiply(x, y, out):
    """Set out to x * y; correct if the product fits the common length of the three numbers."""
    n = out.shape[0]
    out[:] = _ZERO
    for i in range(n):
        if x[i] == _ZERO:
            continue
        carry = _ZERO
        for j in range(n - i):
            total = x[i] * y[j] + out[i + j] + carry
            out[i + j] = total & _LOW
            carry = total >> _SHIFT


@helper
def accumulate(total, term, how):
    """Add a number to another one (ADD) or subtract it (SUBTRACT)."""
    carry = how & _ONE
    for i in range(total.shape[0]):
        value = total[i] + (term[i] ^ how) + carry
        total[i] = value & _LOW
        carry = value >> _SHIFT


@helper
def integer_sign(number):
    """Sign of a number: -1, 0 or 1."""
    if number[number.shape[0] - 1] & _TOP_BIT:
        return np.int64(-1)
    for i in range(number.shape[0]):
        if number[i] != _ZERO:
            return np.int64(1)
    return np.int64(0)


@helper
def row_range(plus, minus):
    """Lowest exponent of a row's six values, and the bits that hold each difference with its sign."""
    low = _NO_EXPONENT
    high = -_NO_EXPONENT
    for k in range(3):
        for value in (plus[k], minus[k]):
            if value != 0.0:
                _, exponent = _split(value)
                low = min(low, exponent)
                high = max(high, np.int64(math.frexp(value)[1]))
    if low == _NO_EXPONENT:
        return np.int64(0), np.int64(2)
    return low, high - low + 2


@helper
def fill_row(row, plus, minus, low):
    """Set row (3, n_limbs) to the scaled differences plus - minus."""
    for k in range(3):
        for sign, value in ((1, plus[k]), (-1, minus[k])):
            if value != 0.0:
                mantissa, exponent = _split(value)
                _add_shifted(row[k], sign * mantissa, exponent - low)


@helper
def exact_det_sign(plus, minus):
    """Sign (-1, 0, 1) of det(plus - minus), exactly; two float64 (3, 3) arrays of finite values."""
    lows = np.empty(3, np.int64)
    bits = np.int64(4)
    for row in range(3):
        low, row_bits = row_range(plus[row], minus[row])
        lows[row] = low
        bits += row_bits
    n_limbs = bits // LIMB_BITS + 1
    matrix = np.zeros((3, 3, n_limbs), np.uint64)
    for row in range(3):
        fill_row(matrix[row], plus[row], minus[row], lows[row])
    pair = np.zeros(n_limbs, np.uint64)
    minor = np.zeros(n_limbs, np.uint64)
    total = np.zeros(n_limbs, np.uint64)
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        multiply(matrix[1, i], matrix[2, j], minor)
        multiply(matrix[1, j], matrix[2, i], pair)
        accumulate(minor, pair, SUBTRACT)
        multiply(matrix[0, k], minor, pair)
        accumulate(total, pair, ADD)
    return integer_sign(total)


@helper
def exact_dot_sign(normal, plus, minus):
    """Sign (-1, 0, 1) of normal . (plus - minus), exactly; three float64 (3,) arrays of finite values."""
    zero = np.zeros(3)
    normal_low, normal_bits = row_range(normal, zero)
    low, row_bits = row_range(plus, minus)
    n_limbs = (normal_bits + row_bits + 4) // LIMB_BITS + 1
    factors = np.zeros((3, n_limbs), np.uint64)
    differences = np.zeros((3, n_limbs), np.uint64)
    fill_row(factors, normal, zero, normal_low)
    fill_row(differences, plus, minus, low)
    term = np.zeros(n_limbs, np.uint64)
    total = np.zeros(n_limbs, np.uint64)
    for k in range(3):
        multiply(factors[k], differences[k], term)
        accumulate(total, term, ADD)
    return integer_sign(total)
