"""Words and decimal numbers in a byte buffer, for the kernels that scan OBJ and ascii PLY text.

Numbers are read to the nearest float64. What the arithmetic below cannot decide (large exponents,
values within its error bound of a rounding boundary, hexadecimal) is left to the caller as a span.
"""

import numpy as np

from penumbra.kernels._jit import helper

# What `read_number` found.
NUMBER = 0  # a decimal number; the value is correctly rounded
UNDECIDED = 1  # a valid decimal or a hexadecimal word: the caller reads the span again
NOT_A_NUMBER = 2  # any other word, "nan", "inf" and "1.#IND" included
NEED_MORE = 3  # the word touches the end of the buffer, so its end is not known

_POWERS_OF_TEN = np.array([10.0**power for power in range(23)])  # all of them exact
_LARGEST_EXACT = 1 << 53
_KEEP_BELOW = 10**17  # a mantissa below this takes one more digit: at most 18 digits, which fit int64

_SPLIT = 134217729.0  # 2**27 + 1, Veltkamp's constant


@helper
def is_newline(byte):
    """CR or LF."""
    return byte == 10 or byte == 13


@helper
def is_blank(byte):
    """Space, tab, vertical tab or form feed."""
    return byte == 32 or byte == 9 or byte == 11 or byte == 12


@helper
def next_newline(text, pos, end):
    """Position of the first CR or LF at or after `pos`, or `end`."""
    while pos < end and text[pos] != 10 and text[pos] != 13:
        pos += 1
    return pos


@helper
def word_end(text, pos, end):
    r"""Position of the first blank, newline or `\` before a newline at or after `pos`, or `end`.

    `end` means that the word may go on behind the buffer.
    """
    while pos < end:
        byte = text[pos]
        if byte <= 32 and (is_blank(byte) or is_newline(byte)):
            return pos
        if byte == 92:
            if pos + 1 == end:
                return end
            if is_newline(text[pos + 1]):
                return pos
        pos += 1
    return end


@helper
def _two_product(a, b):
    """Product and its rounding error, exact (Dekker 1971); no over- or underflow in the range used here."""
    high_a = _SPLIT * a - (_SPLIT * a - a)
    low_a = a - high_a
    high_b = _SPLIT * b - (_SPLIT * b - b)
    low_b = b - high_b
    product = a * b
    error = ((high_a * high_b - product) + high_a * low_b + low_a * high_b) + low_a * low_b
    return product, error


@helper
def _scale(mantissa, exponent, truncated):
    """`mantissa * 10**exponent` in double-double, and whether its rounding to float64 is certain.

    `mantissa` is below 10**18 and |exponent| <= 22. `truncated`: the true mantissa lies in
    [mantissa, mantissa + 1). The sum `main + rest` differs from the true value by less than `bound`:
    the few roundings in `rest` are each 2**-53 of the terms they add.
    """
    high = np.float64(mantissa)
    low = np.float64(mantissa - np.int64(high))
    power = _POWERS_OF_TEN[abs(exponent)]
    if exponent >= 0:
        main, error = _two_product(high, power)
        rest = error + low * power
        bound = (abs(error) + abs(low * power)) * 2.0**-50
        unit = power
    else:
        main = high / power
        product, error = _two_product(main, power)
        rest = (((high - product) - error) + low) / power
        bound = abs(rest) * 2.0**-50
        unit = 1.0 / power
    if truncated:
        bound += 2.0 * unit
    return main + rest, main + (rest - bound) == main + (rest + bound)


@helper
def _read_exponent(text, pos, end):
    """Value of `e+12` at `pos` and the position behind it; (0, pos) when there is no complete exponent."""
    if pos >= end or (text[pos] != 101 and text[pos] != 69):
        return np.int64(0), pos
    at = pos + 1
    negative = at < end and text[at] == 45
    if at < end and (text[at] == 43 or text[at] == 45):
        at += 1
    if at >= end or text[at] < 48 or text[at] > 57:
        return np.int64(0), pos
    value = np.int64(0)
    while at < end and 48 <= text[at] <= 57:
        value = min(value * 10 + np.int64(text[at]) - 48, np.int64(1_000_000))
        at += 1
    return (-value if negative else value), at


@helper
def read_number(text, begin, end):
    """Read the word that starts at `begin` as C's strtod would, the whole word or nothing.

    Returns (kind, value, end of the word); the value counts only for NUMBER.
    """
    pos = begin
    negative = text[pos] == 45
    if negative or text[pos] == 43:
        pos += 1
    digits_at = pos
    mantissa = np.int64(0)
    exponent = np.int64(0)
    n_digits = 0
    point = False
    truncated = False
    while pos < end:
        digit = np.int64(text[pos]) - 48
        if 0 <= digit <= 9:
            n_digits += 1
            if mantissa < _KEEP_BELOW:
                mantissa = mantissa * 10 + digit
                exponent -= 1 if point else 0
            else:
                truncated = truncated or digit != 0
                exponent += 0 if point else 1
        elif text[pos] == 46 and not point:
            point = True
        else:
            break
        pos += 1
    if n_digits > 0:
        power, pos = _read_exponent(text, pos, end)
        exponent += power
    tail = word_end(text, pos, end)
    if tail == end:
        return NEED_MORE, 0.0, end
    if tail != pos or n_digits == 0:
        hexadecimal = tail > digits_at + 2 and text[digits_at] == 48 and text[digits_at + 1] | 32 == 120
        return (UNDECIDED if hexadecimal else NOT_A_NUMBER), 0.0, tail
    value = 0.0
    certain = mantissa == 0
    if not certain and -22 <= exponent <= 22:
        if mantissa <= _LARGEST_EXACT and not truncated:
            # Both operands are exact, so the one rounding of the operation is the right one.
            power_of_ten = _POWERS_OF_TEN[abs(exponent)]
            value = mantissa * power_of_ten if exponent >= 0 else mantissa / power_of_ten
            certain = True
        else:
            value, certain = _scale(mantissa, exponent, truncated)
    return (NUMBER if certain else UNDECIDED), (-value if negative else value), tail
