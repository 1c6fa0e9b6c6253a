"""Error constants of networks: what bounds of their outputs are charged with (docs/dev/design.md, N2, N9-N11, N19-N22).

Beside `ns_abstract.arithmetic.rounding`, which holds those of pictures, this is the only place that knows how large a
rounding error is. The charges of a layer hold for every program that computes it as sums of products in float32 or
better:

* sums in any order and any tree, with or without fused multiply-add (N2, N20);
* norms by two passes, by one (mean of squares less square of the mean) or by an update of both (N11);
* scales and shifts folded into the layer before or behind (N2, N21);
* subnormal numbers kept or flushed to zero where they are read, written or stored (N21);
* library functions within the error named here (N10, N11).

A result that may be past `OVERFLOW`, in any grouping of scales, is not bounded at all (N22).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ns_abstract.io.errors import InputError

#: Unit roundoff of float32: of the bounded program, and of most rows.
UNIT = 2.0**-24
#: Unit roundoff of float64: of sums of offsets, and of rows of outputs in real arithmetic.
DOUBLE_UNIT = 2.0**-53
#: Smallest normal number of float32: what a flush to zero may lose.
FLUSH = 2.0**-126
#: Past this a float32 program may overflow: float32 ends at 2^128, and sums and products are charged within a factor 4.
OVERFLOW = 2.0**126
#: No stored constant, sum of squares or epsilon that is divided by may be smaller: it stays normal in every grouping.
LEAST_DIVISOR = 2.0**-100

# ---------------------------------------------------------------- layers of sums (N2, N21)

#: Roundings beside those of a layer's sums: a batch normalisation's factor (sum, root, quotient: 3), its product with a
#: weight (1), and as many again.
FOLDING = 8
#: Roundings of a layer beside its sums and folding: its products, a mean's quotient, a factor of a whole matrix.
PRODUCTS = 3
#: Flushed numbers of one product within a grouping of scales: either factor where it is read, the product, the
#: sum with it; twice, as a folded factor is written and read again.
FLUSHES = 8.0
#: Sums of n products |w|(|x| + |t|) that a shift t costs which is folded into the next layer: two for its share of the
#: partial sums, one for the folded bias itself (N21).
FOLDED_SHIFT = 3.0
#: Roundings of rows beside those of their sums: stored weights and slopes, products with them.
SPARE = 24

# ---------------------------------------------------------------- norms and maps (N11, N19)

#: Sums of n numbers, n + 4 roundings each (products, sums, two of 1/n, one to spare), that one pass makes an error of,
#: relative to the mean square: the mean of squares (1) and the square of the mean (2); an update of mean and squares
#: number by number loses 2.4 n + 17 units of it.
VARIANCE_PASSES = 3
#: Roundings of a position in a map that is resized: four of float32, relative to it and one.
POSITION = 4.0 * UNIT
#: What float32 makes of a cubic weight: about 112 roundings of 1, of a t^3 - 5 a t^2 + 8 a t - 4 a with t up to 2.
POLYNOMIAL = 128.0 * UNIT
#: The same roundings in float64, of the file's own weights in real arithmetic; as many to spare.
OWN_POSITIONS = 2.0 * DOUBLE_UNIT / UNIT

# ---------------------------------------------------------------- functions of one number (N10)

#: A float32 library's exponentials, logarithms, error functions, powers, sigmoid and tanh are taken to be within this:
#: 16 units; documented errors are 1 to 4 ulp (CUDA, SLEEF, oneMKL), one ulp at most 2 units.
LIBRARY = 16.0 * UNIT
#: `slope z + offset` clipped, or a leaky ReLU's product: constants (2), product, sum: 4 roundings.
AFFINE = 4.0 * UNIT
#: A square is one product, with 1 to spare.
SQUARE = 2.0 * UNIT
#: A quotient, 1, or its reciprocal and a product, 2; 2 to spare.
QUOTIENT = 4.0 * UNIT
#: A root (1) or an approximate reciprocal one (4 of CUDA's rsqrt), a quotient (2); 1 to spare.
ROOT = 8.0 * UNIT
#: `z min(max(z + 3, 0), 6) / 6`: sum, product, quotient and the constants 1/6 and 1/2: 6; 10 to spare.
HARD = 16.0 * UNIT
#: A product of two values: 1; 1 to spare.
PRODUCT = 2.0 * UNIT
#: Flushed numbers of a function of one number: what it reads, its constants, up to two numbers between, its result.
FUNCTION_FLUSHES = 8.0
#: A softmax's exponential: fused attentions compute two of them, each within 20 ulp (torch's `exp_u20`; 40 units),
#: beside what is subtracted first, a share's product and its quotient: 80 and 16 units.
ATTENTION = 96.0 * UNIT
#: By each number of its sum: such a program takes blocks of 64 numbers with exponentials within 2 ulp, or of 512 within
#: 20, and multiplies what it has by another exponential at each: 2 * 4 / 64 and 2 * 40 / 512 units, at most a quarter.
ATTENTION_BLOCKS = 0.25 * UNIT
#: More than exp(-30), what a softmax's share is at most where its sum is cut off.
LOST_SHARE = 2.0**-43
#: Largest argument of an exponential; 2^126 is past exp(87).
LARGEST_EXPONENT = 80.0
#: Values in steps: a quotient before the rounding, a product behind it, both of the largest step; 6 to spare.
STEPS = 8.0 * UNIT
#: Softplus above its switch: a library's exponential, taken to be within 16 units, at the file's limit.
SWITCH = 1.0 + LIBRARY
#: How far a constant in a file may be from the number that it stands for, relative: 2 roundings, 2 to spare.
NEAR = 4.0 * UNIT

# ---------------------------------------------------------------- constants that are computed (N23)


class FloatFormat(NamedTuple):
    """A floating-point type: unit roundoff, smallest normal number, and a number past which sums may overflow."""

    unit: float
    tiny: float
    largest: float


#: Half, single and double precision, by the bytes of a number; sums stay a factor 2, 4 or 2^24 below the largest one.
FORMATS = {
    2: FloatFormat(2.0**-11, 2.0**-14, 2.0**15),
    4: FloatFormat(UNIT, FLUSH, OVERFLOW),
    8: FloatFormat(DOUBLE_UNIT, 2.0**-1022, 2.0**1000),
}
#: One operation rounds once in the constant's own type, and 1 to spare.
ONCE = 2.0
#: Flushed numbers of one operation: two that are read, one that is written; 1 to spare.
ONCE_FLUSHES = 4.0
#: A float64 operation or library function, of up to three operations here: 4 units; 4 to spare.
OWN_CONSTANT = 8.0 * DOUBLE_UNIT
#: The argument of a sine or cosine, rounded as the middle of two numbers.
OWN_ARGUMENT = 2.0 * DOUBLE_UNIT
#: Roundings of sums beside their terms: a mean's quotient or a root, products; 2 to spare.
CONSTANT_SUMS = 4.0
#: A library's function in another type: 4 ulp.
OTHER_LIBRARY = 8.0
#: Exact constants, enclosed by float64 operations: nothing is flushed.
EXACT = FloatFormat(OWN_CONSTANT, 0.0, 2.0**1000)
#: How far a constant may be off, where what is off multiplies it: second order, far less than a sixteenth.
DOUBTS_UP = 1.0 + 2.0**-4
#: A file's numbers divided in float64, where a function is recognised: up to 2^4 roundings; as many to spare.
OWN_QUOTIENTS = 2.0**5 * DOUBLE_UNIT

# ---------------------------------------------------------------- the package's own float64 (N0, N1, N4, N5)

#: One or two float64 roundings of each term; as many to spare.
OWN_FEW = 8.0 * DOUBLE_UNIT
#: A line's slope times a size, sums of up to five terms, moved to the references: 16 roundings; 16 to spare.
OWN_LINE = 32.0 * DOUBLE_UNIT
#: Sums of up to 2^6 terms of two roundings each.
OWN_SUMS = 2.0**7 * DOUBLE_UNIT
#: torch's float64 functions are within 2^5 units; slopes and tangents of them multiply that by up to 2^4.
OWN_FUNCTION = 2.0**9 * DOUBLE_UNIT
#: A proof's last steps, joined sets, margins: up to 2^8 roundings of each term, twice.
OWN_MARGIN = 2.0**9 * DOUBLE_UNIT
#: Windows of maxima: sums of at most 2^8 terms, of 4 roundings, twice.
OWN_WINDOW = 2.0**11 * DOUBLE_UNIT
#: Radii: sums of at most 2^12 terms that are not negative, of two roundings each.
UP = 1.0 + 2.0**13 * DOUBLE_UNIT
#: Magnitudes |W| |x|: sums of at most 2^24 products, twice.
MAGNITUDES_UP = 1.0 + 2.0**25 * DOUBLE_UNIT
#: Rows on images: sums of at most 2^24 products of two roundings each, a middle and a half; what they have gathered
#: on the way is moved by up to 2^4 roundings, twice.
OWN_ROWS, OWN_GATHERED = 2.0**25 * DOUBLE_UNIT, 2.0**5 * DOUBLE_UNIT
#: An offset that is moved out in float64 before it is stored in float32: the rounding (1), what sums of up to 2^26
#: offsets lose (at most half a unit), and half a unit to spare; `FLUSH` besides, for offsets that are not normal.
OWN_STORED = 2.0 * UNIT
#: Ends of images: an offset and a reference, one difference of them, 1 each; 2 to spare.
OWN_IMAGE = 4.0 * DOUBLE_UNIT

# ---------------------------------------------------------------- pictures before a network, exchanged ones (V10, N8)

#: Roundings of one float32 evaluation of 255 x + 1/2, in steps: two of numbers below 256 (2^-16 each), and as many.
STEP = 4.0 * 256.0 * UNIT
#: A cell written for another verifier: columns beside those of its sum, and what may be flushed.
WRITTEN_TERMS, WRITTEN_FLUSH = 8, 64.0 * FLUSH


def gamma(count: Any, unit: float | None = None) -> Any:
    """Return the relative error of ``count`` roundings (a number or a tensor), in float32 by default.

    Raises:
        InputError: ``count`` times the unit reaches 1/2: no digit is left.
    """
    unit = UNIT if unit is None else unit
    product = count * unit
    largest = float(product.max()) if hasattr(product, "max") else float(product)
    if not largest < 0.5:
        raise InputError(
            f"sums of {largest / unit:,.0f} roundings have no digit left in this arithmetic",
            fix="split the layer's sums",
        )
    return product / (1.0 - product)
