"""Decimal numbers in a file's bytes to float64, rounded as Python's `float` rounds them.

D. Lemire, Number parsing at a gigabyte per second, Software: Practice and Experience 51, 2021,
section 5: the digits as one 64-bit integer times a 128-bit power of five. The few numbers that
this cannot settle (over 19 digits, subnormal, NaN, infinity) are left to the caller.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.jit import jit

_LOWEST, _HIGHEST = -64, 64  # powers of ten in the tables


def _powers_of_five() -> tuple[Any, Any]:
    """Return the high and low 64 bits of 5^q, its highest bit moved to bit 127."""
    high, low = [], []
    for q in range(_LOWEST, _HIGHEST + 1):
        if q >= 0:
            value = 5**q
            shift = 128 - value.bit_length()
            value = value << shift if shift >= 0 else value >> -shift
        else:
            power = 5**-q
            value = (1 << (power.bit_length() + 127)) // power
            # Rounded up where 5^-q fits 64 bits, so that exact halves are known (section 6).
            value += q >= -27
        high.append(value >> 64)
        low.append(value & 0xFFFFFFFFFFFFFFFF)
    return np.array(high, np.uint64), np.array(low, np.uint64)


_HIGH, _LOW = _powers_of_five()
_EXACT = 10.0 ** np.arange(23)
_ONE = np.uint64(1)


@jit(nogil=True)
def _multiply(a: Any, b: Any) -> Any:
    """High and low 64 bits of the product of two 64-bit integers."""
    mask, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    a0, a1, b0, b1 = a & mask, a >> half, b & mask, b >> half
    low = a0 * b0
    middle = a1 * b0 + (low >> half)
    other = a0 * b1 + (middle & mask)
    return a1 * b1 + (middle >> half) + (other >> half), a * b


@jit(nogil=True)
def _scaled(digits: Any, power: int) -> tuple[float, bool]:
    """Digits times ten to the power, correctly rounded; False where this cannot tell."""
    if digits == 0:
        return 0.0, True
    if digits <= np.uint64(9007199254740992) and -22 <= power <= 22:
        # Both are exact in float64, so one rounding is the right one (W. Clinger, PLDI 1990).
        if power < 0:
            return np.float64(digits) / _EXACT[-power], True
        return np.float64(digits) * _EXACT[power], True
    if not _LOWEST <= power <= _HIGHEST:
        return np.nan, False
    zeros = 0
    while digits >> np.uint64(63) == 0:
        digits = digits << _ONE
        zeros += 1
    high, low = _multiply(digits, _HIGH[power - _LOWEST])
    if high & np.uint64(0x1FF) == np.uint64(0x1FF):
        more, _ = _multiply(digits, _LOW[power - _LOWEST])
        low = low + more
        if more > low:
            high = high + _ONE
    upper = np.int64(high >> np.uint64(63))
    drop = np.uint64(upper + 9)
    mantissa = high >> drop
    exponent = ((217706 * power) >> 16) + 63 + upper - zeros + 1023
    if exponent <= 0 or exponent >= 2046:
        return np.nan, False
    tie = low <= _ONE and -4 <= power <= 23 and mantissa & np.uint64(3) == _ONE
    if tie and mantissa << drop == high:
        mantissa = mantissa & ~_ONE
    mantissa = (mantissa + (mantissa & _ONE)) >> _ONE
    # A mantissa that rounds up to 2^53 is 2^52 times two: the same float64.
    return np.float64(mantissa) * 2.0 ** (exponent - 1075), True


@jit(nogil=True)
def _exponent(data: Any, here: int, end: int) -> tuple[int, int]:
    """Read "e-5" at `here`; return its value and where it ends (-1: it is none)."""
    if (data[here] != 101 and data[here] != 69) or end - here > 6:
        return 0, -1
    here += 1
    negative = here < end and data[here] == 45
    if here < end and (negative or data[here] == 43):
        here += 1
    if here == end:
        return 0, -1
    value = 0
    while here < end and 48 <= data[here] <= 57:
        value = 10 * value + (data[here] - 48)
        here += 1
    return (-value if negative else value), here


@jit(nogil=True)
def parse_number(data: Any, start: int, end: int) -> tuple[float, bool]:
    """Read the decimal number that fills data[start:end].

    Parameters
    ----------
    data : (N,) uint8
    start, end : int

    Returns
    -------
    value : float
    known : bool
        False where the text is no plain number, or one that Python's `float` must settle.
    """
    here = start
    negative = False
    if here < end and (data[here] == 45 or data[here] == 43):
        negative = data[here] == 45
        here += 1
    digits = np.uint64(0)
    n_digits, n_seen, power = 0, 0, 0
    point = False
    while here < end:
        byte = data[here]
        if 48 <= byte <= 57:
            if n_digits or byte != 48:
                n_digits += 1
            if n_digits > 19:
                return np.nan, False
            digits = digits * np.uint64(10) + np.uint64(byte - 48)
            n_seen += 1
            power -= point
        elif byte == 46 and not point:
            point = True
        else:
            break
        here += 1
    if n_seen == 0:
        return np.nan, False
    if here < end:
        exponent, here = _exponent(data, here, end)
        power += exponent
    if here != end:
        return np.nan, False
    value, known = _scaled(digits, power)
    return (-value if negative else value), known
