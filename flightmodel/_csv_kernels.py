"""Compiled reading of numbers in a CSV's bytes: every cell rounded as Python's ``float`` rounds it, or no answer.

``value = w * 10**q`` with the decimal digits as an integer ``w``. Up to 2**53 and 10**22 both are exact in float64, and
one multiplication or division rounds once (W. D. Clinger, How to Read Floating Point Numbers Accurately, PLDI 1990).
Beyond that the leading 64 bits of ``w`` are multiplied with 128 bits of the power of five, which always suffice (D.
Lemire, Number Parsing at a Gigabyte per Second, Software: Practice and Experience 51, 2021; N. Mushtak, D. Lemire,
Fast Number Parsing Without Fallback, 2023). Whatever is no plain number, no missing cell or no full row ends the
reading: the careful reader of `flightmodel.tables` then finds the words for it.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import exact_inlined, exact_kernel

SKIPPED, TEXT = -1, -2  # what becomes of a column that is not read as numbers
UNUSUAL = -1
LOWEST_POWER, HIGHEST_POWER = -342, 308
EXACT_TENS = 10.0 ** np.arange(23)

_NEWLINE, _RETURN, _SPACE, _TAB, _QUOTE, _COMMA, _MINUS, _PLUS, _POINT = 10, 13, 32, 9, 34, 44, 45, 43, 46
_A, _E, _L, _N, _U = 97, 101, 108, 110, 117
_ONE, _TEN, _LOW = np.uint64(1), np.uint64(10), np.uint64(0xFFFFFFFF)
_MANY = np.uint64(2**53)


def powers_of_five():
    """Leading 128 bits of 5**q for every q of float64, as two arrays of 64 bits; reciprocals are rounded up."""
    high, low = [], []
    for q in range(LOWEST_POWER, HIGHEST_POWER + 1):
        if q < 0:
            bits = (5**-q - 1).bit_length()
            power = 2 ** (bits + 127 if q >= -27 else 2 * bits + 128) // 5**-q + 1
        else:
            power = 5**q << max(0, 128 - (5**q).bit_length())
        power >>= max(0, power.bit_length() - 128)
        high.append(power >> 64)
        low.append(power & (2**64 - 1))
    return np.array(high, np.uint64), np.array(low, np.uint64)


@exact_inlined
def upper_product(a, b):
    """Upper 64 of the 128 bits of a product."""
    half = np.uint64(32)
    a0, a1, b0, b1 = a & _LOW, a >> half, b & _LOW, b >> half
    middle = a1 * b0 + (a0 * b0 >> half)
    return a1 * b1 + (middle >> half) + (a0 * b1 + (middle & _LOW) >> half)


@exact_inlined
def rounded(w, q, high, low):
    """The float64 nearest to ``w * 10**q``, ties to even; NaN below the normal numbers, infinity above all."""
    if w == np.uint64(0) or q < LOWEST_POWER:
        return 0.0
    if q > HIGHEST_POWER:
        return math.inf
    zeros = 0
    for step in (32, 16, 8, 4, 2, 1):
        if w >> np.uint64(64 - step) == np.uint64(0):
            w <<= np.uint64(step)
            zeros += step
    k = q - LOWEST_POWER
    upper, lower = upper_product(w, high[k]), w * high[k]
    if upper & np.uint64(0x1FF) == np.uint64(0x1FF):
        carried = upper_product(w, low[k])
        lower += carried
        upper += _ONE if carried > lower else np.uint64(0)
    top = upper >> np.uint64(63)
    shift = top + np.uint64(9)
    bits = upper >> shift  # 54 of them: one more than is kept
    # floor(q log2(10)) by integers
    exponent = ((217706 * q) >> 16) + 63 + np.int64(top) - zeros
    if exponent < -1022:
        return math.nan
    if lower <= _ONE and -4 <= q <= 23 and bits & np.uint64(3) == _ONE and bits << shift == upper:
        bits &= ~_ONE  # exactly half way: to even
    return math.ldexp(float((bits + (bits & _ONE)) >> _ONE), exponent - 52)


@exact_inlined
def after_missing(data, k):
    """First byte after ``nan``, ``na``, ``null`` (in any case) or ``-``, which mean a missing value; else ``k``."""
    if data[k] == _MINUS:
        return k + 1
    if data[k] | 32 == _N and data[k + 1] | 32 == _A:
        return k + 3 if data[k + 2] | 32 == _N else k + 2
    null = data[k] | 32 == _N and data[k + 1] | 32 == _U and data[k + 2] | 32 == _L and data[k + 3] | 32 == _L
    return k + 4 if null else k


@exact_inlined
def after_text(data, k):
    """First byte that ends a cell which is not read as a number, or that no plain text holds."""
    while data[k] != _COMMA and data[k] != _NEWLINE and data[k] != _RETURN:
        if data[k] == _QUOTE or data[k] > 126 or (data[k] < 32 and data[k] != _TAB):
            break
        k += 1
    return k


@exact_inlined
def exponent(data, k):
    """Power of ten after an ``e``, and the first byte after it; ``k`` for none."""
    at = k + 1 if data[k] == _MINUS or data[k] == _PLUS else k
    begin, power = at, 0
    while 48 <= data[at] <= 57:
        power = min(10 * power + (data[at] - 48), 10000)
        at += 1
    return -power if data[k] == _MINUS else power, k if at == begin else at


@exact_inlined
def leading_zeros(data, k):
    """How many zeros stand before the digits that count, of a number from byte ``k`` on."""
    zeros = 0
    while data[k] == 48 or data[k] == _POINT or data[k] == _MINUS or data[k] == _PLUS:
        zeros += data[k] == 48
        k += 1
    return zeros


@exact_kernel
def read_rows(data, k, stop, slots, tens, high, low, columns, spans, row):
    """Read whole lines of ``data`` from byte ``k`` to ``stop`` into ``columns``, from ``row`` on.

    ``slots`` says of each column of the file which row of ``columns`` takes it, or that it is `SKIPPED` or `TEXT`;
    where a text's bytes begin and end goes to ``spans``. Returns the number of rows, or `UNUSUAL`. Blank lines may
    stand at the end only. A newline and three more bytes must follow the last one.

    Numbers are read here and not in a function of their own: that costs twice the time.
    """
    first, last, blank = row, len(slots) - 1, False
    while k < stop:
        begin = k
        while data[k] == _SPACE or data[k] == _TAB or data[k] == _RETURN:
            k += 1
        if data[k] == _NEWLINE:
            blank = True
            k += 1
            continue
        if blank:
            return UNUSUAL
        k = begin
        for cell in range(last + 1):
            while data[k] == _SPACE or data[k] == _TAB:
                k += 1
            slot = slots[cell]
            if slot >= 0:
                start, w, q = k, np.uint64(0), 0
                negative = data[k] == _MINUS
                if negative or data[k] == _PLUS:
                    k += 1
                begin, digit = k, data[k] - 48
                while 0 <= digit <= 9:
                    w = w * _TEN + np.uint64(digit)
                    k += 1
                    digit = data[k] - 48
                digits = k - begin
                if data[k] == _POINT:
                    k += 1
                    begin, digit = k, data[k] - 48
                    while 0 <= digit <= 9:
                        w = w * _TEN + np.uint64(digit)
                        k += 1
                        digit = data[k] - 48
                    q = begin - k
                    digits -= q
                if digits == 0:
                    columns[slot, row] = math.nan
                    k = after_missing(data, start)
                else:
                    if digits > 19 and digits - leading_zeros(data, start) > 19:  # more than 64 bits hold
                        return UNUSUAL
                    if data[k] | 32 == _E:
                        k += 1
                        power, end = exponent(data, k)
                        if end == k:
                            return UNUSUAL
                        q, k = q + power, end
                    if w <= _MANY and -22 <= q <= 22:
                        value = float(w) / tens[-q] if q < 0 else float(w) * tens[q]
                    else:
                        value = rounded(w, q, high, low)
                        if not value < math.inf:
                            return UNUSUAL
                    # no negative zero: whole-number columns know none
                    columns[slot, row] = -value if negative and w != np.uint64(0) else value
            else:
                begin, k = k, after_text(data, k)
                if slot == TEXT:
                    spans[0, row], spans[1, row] = begin, k
            while data[k] == _SPACE or data[k] == _TAB:
                k += 1
            if cell == last and data[k] == _RETURN:
                k += 1
            # what is no number or no plain text stops short of this
            if data[k] != (_NEWLINE if cell == last else _COMMA):
                return UNUSUAL
            k += 1
        row += 1
    return row - first
