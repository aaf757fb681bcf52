"""Bits of masks in uint64 words; every literal that meets a word is a uint64, or numba widens to int64."""

import numpy as np

from penumbra.kernels._jit import helper

ZERO = np.uint64(0)
ONE = np.uint64(1)
_M1 = np.uint64(0x5555555555555555)
_M2 = np.uint64(0x3333333333333333)
_M4 = np.uint64(0x0F0F0F0F0F0F0F0F)
_H01 = np.uint64(0x0101010101010101)
_S1, _S2, _S4, _S56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)


@helper
def popcount64(word):
    """Number of set bits; LLVM recognises the idiom and emits one instruction."""
    word = word - ((word >> _S1) & _M1)
    word = (word & _M2) + ((word >> _S2) & _M2)
    word = (word + (word >> _S4)) & _M4
    return np.int64((word * _H01) >> _S56)


@helper
def lowest_bit(word):
    """Index of the lowest set bit of a word that is not 0."""
    return popcount64((word & (~word + ONE)) - ONE)
