"""Elementary functions on vectors: branch-free, no library calls, within 2 units in the last place (the tangent: 3).

Each function takes a `VectorBuilder` and vector values and returns vector values. The method is the
classic one (Cody and Waite 1980, Software Manual for the Elementary Functions; W. Kahan's and K. C. Ng's fdlibm for the
logarithm): reduce the argument with a constant split into parts, evaluate one polynomial, combine the parts.

Coefficients: relative minimax fits by a Remez exchange in 60-digit arithmetic, weighted so that the error of the
function (not of the polynomial) is equalised, then rounded to the dtype. The number beside each is the error's log2.
"""

from fractions import Fraction
from math import inf, nan

import numpy as np

from ce_gym.compile.lowering.vector import Value, VectorBuilder

SINE = {  # (sin(r)/r - 1)/r^2 in r^2, |r| <= pi/4: -58.0, -28.0
    "float64": (-0.16666666666666632, 0.00833333333332237, -0.00019841269829771097, 2.7557313678647987e-06,
                -2.5050755959308602e-08, 1.58966664112969e-10),
    "float32": (-0.16666655, 0.008332176, -0.00019516978),
}  # fmt: skip
COSINE = {  # (cos(r) - 1 + r^2/2)/r^4 in r^2, |r| <= pi/4: -64.2, -33.3
    "float64": (0.0416666666666666, -0.0013888888888874064, 2.4801587289443543e-05, -2.7557314340677814e-07,
                2.0875721626217756e-09, -1.135955945633136e-11),
    "float32": (0.041666646, -0.0013887364, 2.4438092e-05),
}  # fmt: skip
EXPONENTIAL = {  # (exp(r) - 1 - r)/r^2 in r, |r| <= log(2)/2: -58.0, -28.2
    "float64": (0.5000000000000013, 0.166666666666667, 0.04166666666651432, 0.00833333333330703,
                0.0013888888947331977, 0.00019841269917770594, 2.4801489589754594e-05, 2.7557215948254373e-06,
                2.763141408414928e-07, 2.5117974886990544e-08),
    "float32": (0.5, 0.16666518, 0.041666206, 0.008368953, 0.0013950596),
}  # fmt: skip
LOGARITHM = {  # (2 atanh(s) - 2 s)/s^3 in s^2, s = (m - 1)/(m + 1), sqrt(1/2) <= m <= sqrt(2): -58.5, -29.2
    "float64": (0.6666666666666735, 0.39999999999411107, 0.28571428743260424, 0.2222219847613202,
                0.18183569735442148, 0.1531390329783266, 0.14797507658565714),
    "float32": (0.66666776, 0.39977497, 0.29873073),
}  # fmt: skip
ARCTANGENT = {  # (atan(t)/t - 1)/t^2 in t^2, |t| <= 1/2: -57.8, -31.9
    "float64": (-0.33333333333332993, 0.19999999999905269, -0.14285714276557562, 0.11111110666443012,
                -0.0909089640148812, 0.07692076182018098, -0.06663832138767067, 0.058584346219527815,
                -0.051225696893413844, 0.041879877631670434, -0.027457339067067457, 0.0101316165760539),
    "float32": (-0.33333328, 0.19999498, -0.14272234, 0.109422095, -0.079884775, 0.038782317),
}  # fmt: skip
HYPERBOLIC_TANGENT = {  # (tanh(x)/x - 1)/x^2 in x^2, |x| <= 0.625: -61.3, -27.8
    "float64": (-0.33333333333333315, 0.13333333333329855, -0.05396825396611606, 0.021869488470148538,
                -0.008863234333450295, 0.0035921141909452917, -0.0014557270934707931, 0.0005894563630441713,
                -0.00023702371057274374, 9.157831285898615e-05, -3.020617793223887e-05, 6.050356836937014e-06),
    "float32": (-0.33333284, 0.13331485, -0.053742938, 0.020648653, -0.0057147793),
}  # fmt: skip

PI = Fraction("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803")
LN2 = Fraction("0.693147180559945309417232121458176568075500134360255254120680009493393621969694715605863")
MANTISSA_BITS = {"float64": 52, "float32": 23}
EXPONENT_BIAS = {"float64": 1023, "float32": 127}


def split(number: Fraction, dtype: str, parts: int) -> list[float]:
    """Return a number as a sum of `parts` floats of falling size, each the rounded remainder of the sum before."""
    result = []
    for _ in range(parts):
        part = float(np.dtype(dtype).type(float(number)))
        result.append(part)
        number -= Fraction(part)
    return result


def _nearest_integer(v: VectorBuilder, x: Value, factor: float) -> tuple[Value, Value]:
    """Nearest integer of `factor * x` as a float, and bits whose lowest ones are that integer's.

    Adding 1.5 * 2^mantissa_bits leaves no room for a fraction: the sum's last bits are the integer.
    """
    shift = v.const(1.5 * 2.0 ** MANTISSA_BITS[v.dtype])
    shifted = v.fma(x, v.const(factor), shift)
    return v.sub(shifted, shift), v.to_bits(shifted)


def sin_cos(v: VectorBuilder, x: Value) -> tuple[Value, Value]:
    """Sine and cosine of x [rad]; exact to 2 ulp at least for |x| <= 1e5; meaningless beyond 2^51 (f32: 2^22)."""
    quarters, bits = _nearest_integer(v, x, float(2 / PI))
    r = x
    for part in split(PI / 2, v.dtype, 3):  # the first step is exact: the leading digits cancel
        r = v.fma(quarters, v.const(-part), r)
    z = v.mul(r, r)
    sine = v.fma(v.mul(r, z), v.polynomial(z, SINE[v.dtype]), r)
    cosine = v.fma(z, v.fma(z, v.polynomial(z, COSINE[v.dtype]), v.const(-0.5)), v.const(1.0))
    odd = v.is_odd(bits)
    next_bits = v.builder.add(bits, v.int_const(1))
    return (
        _flip_sign(v, v.select(odd, cosine, sine), bits),
        _flip_sign(v, v.select(odd, sine, cosine), next_bits),
    )


def _flip_sign(v: VectorBuilder, value: Value, bits: Value) -> Value:
    """Change the sign where bit 1 of `bits` is set: the quarter turns 2 and 3."""
    sign = v.builder.and_(v.builder.shl(bits, v.int_const(v.bits - 2)), v.int_const(1 << (v.bits - 1)))
    return v.from_bits(v.builder.xor(v.to_bits(value), sign))


def exp(v: VectorBuilder, x: Value) -> Value:
    """Exponential; overflows to inf, underflows through the subnormal numbers to 0."""
    mantissa, bias = MANTISSA_BITS[v.dtype], EXPONENT_BIAS[v.dtype]
    # Beyond these the result is inf or 0 anyway; the comparisons let a NaN through.
    high, low = v.const((bias + 2) * float(LN2)), v.const(-(bias + mantissa + 2) * float(LN2))
    x = v.select(v.compare(">", x, high), high, x)
    x = v.select(v.compare("<", x, low), low, x)
    exponent, bits = _nearest_integer(v, x, float(1 / LN2))
    r = x
    for part in split(LN2, v.dtype, 2):
        r = v.fma(exponent, v.const(-part), r)
    mantissa_value = v.fma(v.mul(r, r), v.polynomial(r, EXPONENTIAL[v.dtype]), r)
    result = v.add(mantissa_value, v.const(1.0))
    whole = v.builder.sub(bits, v.int_const(_bits_of(1.5 * 2.0**mantissa, v.dtype)))
    half = v.builder.ashr(whole, v.int_const(1))  # in two factors: 2^1024 and 2^-1074 have no normal float
    for part in (half, v.builder.sub(whole, half)):
        biased = v.builder.add(part, v.int_const(bias))
        result = v.mul(result, v.from_bits(v.builder.shl(biased, v.int_const(mantissa))))
    return result


def log(v: VectorBuilder, x: Value) -> Value:
    """Natural logarithm; -inf at 0, NaN below."""
    mantissa, bias = MANTISSA_BITS[v.dtype], EXPONENT_BIAS[v.dtype]
    tiny = v.compare("<", x, v.const(2.0 ** (1 - bias)))
    normal = v.select(tiny, v.mul(x, v.const(2.0 ** (mantissa + 2))), x)
    bits = v.to_bits(normal)
    offset = v.builder.sub(bits, v.int_const(_bits_of(0.5**0.5, v.dtype)))
    exponent = v.builder.ashr(offset, v.int_const(mantissa))
    m = v.from_bits(v.builder.sub(bits, v.builder.shl(exponent, v.int_const(mantissa))))
    k = v.builder.sitofp(exponent, v.float_type)
    k = v.select(tiny, v.sub(k, v.const(mantissa + 2.0)), k)
    f = v.sub(m, v.const(1.0))
    s = v.div(f, v.add(f, v.const(2.0)))
    z = v.mul(s, s)
    series = v.mul(z, v.polynomial(z, LOGARITHM[v.dtype]))
    half_square = v.mul(v.mul(f, f), v.const(0.5))
    ln2_high, ln2_low = _short_ln2(v.dtype)
    correction = v.fma(s, v.add(half_square, series), v.mul(k, v.const(ln2_low)))
    rest = v.sub(v.sub(half_square, correction), f)
    result = v.sub(v.mul(k, v.const(ln2_high)), rest)
    at_most_zero = v.select(v.compare("==", x, v.const(0.0)), v.const(-inf), v.const(nan))
    result = v.select(v.compare(">", x, v.const(0.0)), result, at_most_zero)
    return v.select(v.compare("==", x, v.const(inf)), v.const(inf), result)


def _short_ln2(dtype: str) -> tuple[float, float]:
    """log(2) in two parts, the first so short that its product with any exponent is exact."""
    bits = MANTISSA_BITS[dtype] - 12
    high = Fraction(round(LN2 * 2**bits), 2**bits)
    return float(high), float(LN2 - high)


def atan2(v: VectorBuilder, y: Value, x: Value) -> Value:
    """Angle [rad] of the point (x, y), signed zeros as in C; NaN if both are infinite or x^2 + y^2 > the range."""
    steep_side, flat_side = v.intrinsic("fabs", y), v.intrinsic("fabs", x)
    steep = v.compare(">", steep_side, flat_side)
    low = v.select(steep, flat_side, steep_side)
    high = v.select(steep, steep_side, flat_side)
    # Above 1/2 the angle is taken from the diagonal: atan(low/high) = pi/4 + atan((low - high)/(low + high)). From
    # there on the difference is exact.
    wide = v.compare(">", low, v.mul(high, v.const(0.5)))
    numerator = v.select(wide, v.sub(low, high), low)
    denominator = v.select(wide, v.add(low, high), high)
    at_origin = v.compare("==", denominator, v.const(0.0))
    denominator = v.select(at_origin, v.const(1.0), denominator)
    t = v.div(numerator, denominator)
    # t + rest is the quotient to twice the digits; `lost` is the rounding error of the sum low + high.
    lost = v.select(wide, v.sub(low, v.sub(denominator, high)), v.const(0.0))
    remaining = v.fma(v.neg(t), lost, v.fma(v.neg(t), denominator, numerator))
    rest = v.div(remaining, denominator)
    rest = v.select(v.compare("<", denominator, v.const(inf)), rest, v.const(0.0))
    z = v.mul(t, t)
    angle = v.add(t, v.fma(v.mul(t, z), v.polynomial(z, ARCTANGENT[v.dtype]), rest))
    # The angle is `turn +- angle` with turn a multiple of pi/4: pi/2 - and pi - change its sign and add to the turn.
    turn = v.select(wide, v.const(0.25), v.const(0.0))
    turn, angle = _reflect(v, steep, 0.5, turn, angle)
    negative = v.builder.icmp_signed("<", v.to_bits(x), v.int_const(0))
    turn, angle = _reflect(v, negative, 1.0, turn, angle)
    pi_high, pi_low = split(PI, v.dtype, 2)
    result = v.fma(turn, v.const(pi_high), v.fma(turn, v.const(pi_low), angle))
    return v.intrinsic("copysign", result, y)


def _reflect(v: VectorBuilder, mask: Value, by: float, turn: Value, angle: Value) -> tuple[Value, Value]:
    """`by * pi - (turn * pi + angle)` where the mask is true."""
    return (
        v.select(mask, v.sub(v.const(by), turn), turn),
        v.select(mask, v.neg(angle), angle),
    )


def atan(v: VectorBuilder, x: Value) -> Value:
    """Arc tangent [rad]."""
    return atan2(v, x, v.const(1.0))


def asin(v: VectorBuilder, x: Value) -> Value:
    """Arc sine [rad]; NaN outside [-1, 1]."""
    return atan2(v, x, _cathetus(v, x))


def acos(v: VectorBuilder, x: Value) -> Value:
    """Arc cosine [rad]; NaN outside [-1, 1]."""
    return atan2(v, _cathetus(v, x), x)


def _cathetus(v: VectorBuilder, x: Value) -> Value:
    """sqrt(1 - x^2), rounded once under the root."""
    return v.intrinsic("sqrt", v.fma(v.neg(x), x, v.const(1.0)))


def tan(v: VectorBuilder, x: Value) -> Value:
    """Tangent."""
    sine, cosine = sin_cos(v, x)
    return v.div(sine, cosine)


def tanh(v: VectorBuilder, x: Value) -> Value:
    """Hyperbolic tangent: a polynomial below 0.625, the exponential above."""
    z = v.mul(x, x)
    near = v.fma(v.mul(x, z), v.polynomial(z, HYPERBOLIC_TANGENT[v.dtype]), x)
    magnitude = v.intrinsic("fabs", x)
    grown = v.add(exp(v, v.add(magnitude, magnitude)), v.const(1.0))
    far = v.sub(v.const(1.0), v.div(v.const(2.0), grown))
    far = v.intrinsic("copysign", far, x)
    return v.select(v.compare("<", magnitude, v.const(0.625)), near, far)


def power(v: VectorBuilder, x: Value, y: Value) -> Value:
    """Power, x to the y, for x >= 0, as exp(y log x): the relative error grows with |y log x|."""
    result = exp(v, v.mul(y, log(v, x)))
    return v.select(v.compare("==", y, v.const(0.0)), v.const(1.0), result)


def integer_power(v: VectorBuilder, x: Value, exponent: int) -> Value:
    """Power, x to a constant integer power by repeated squaring."""
    result, square, rest = None, x, abs(exponent)
    while rest:
        if rest & 1:
            result = square if result is None else v.mul(result, square)
        rest >>= 1
        square = v.mul(square, square) if rest else square
    if result is None:
        return v.const(1.0)
    return result if exponent > 0 else v.div(v.const(1.0), result)


def remainder(v: VectorBuilder, x: Value, y: Value, rounding: str) -> Value:
    """`x - n y` with n = x/y rounded by `trunc` (C's fmod) or `rint` (C's remainder); exact while |n| < 2^mantissa."""
    quotient = v.intrinsic(rounding, v.div(x, y))
    return v.fma(v.neg(quotient), y, x)


def _bits_of(number: float, dtype: str) -> int:
    """Bit pattern of a float of that dtype."""
    value = np.array(number, dtype)
    return int(value.view(np.int64 if dtype == "float64" else np.int32))
