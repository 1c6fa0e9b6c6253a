"""Error constants of networks: what bounds of their outputs are charged with (docs/design.md, N2, N9-N11, N19-N22).

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

from typing import Any

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
#: More than exp(-30), what a softmax's share is at most where its sum is cut off.
LOST_SHARE = 2.0**-43
#: Largest argument of an exponential; 2^126 is past exp(87).
LARGEST_EXPONENT = 80.0
#: How far a constant in a file may be from the number that it stands for, relative: 2 roundings, 2 to spare.
NEAR = 4.0 * UNIT

# ---------------------------------------------------------------- the package's own float64 (N0, N1, N4, N5)

#: One or two float64 roundings of each term; as many to spare.
OWN_FEW = 8.0 * DOUBLE_UNIT
#: A line's slope times a size, sums of up to five terms, moved to the references: 16 roundings; 16 to spare.
OWN_LINE = 32.0 * DOUBLE_UNIT
#: Sums of up to 2^6 terms of two roundings each.
OWN_SUMS = 2.0**7 * DOUBLE_UNIT
#: torch's float64 functions are within 2^5 units; slopes and tangents of them multiply that by up to 2^4.
OWN_FUNCTION = 2.0**9 * DOUBLE_UNIT
#: Slopes of sigmoid and tanh, which torch gives within 2^-44, from below.
SLOPES_DOWN = 1.0 - 2.0**23 * DOUBLE_UNIT
#: A proof's last steps, joined sets, margins: up to 2^8 roundings of each term, twice.
OWN_MARGIN = 2.0**9 * DOUBLE_UNIT
#: Windows of maxima: sums of at most 2^8 terms, of 4 roundings, twice.
OWN_WINDOW = 2.0**11 * DOUBLE_UNIT
#: Radii: sums of at most 2^12 terms that are not negative, of two roundings each.
UP = 1.0 + 2.0**13 * DOUBLE_UNIT
#: Magnitudes |W| |x|: sums of at most 2^24 products, twice.
MAGNITUDES_UP = 1.0 + 2.0**25 * DOUBLE_UNIT
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
        InputError: They leave no digit.
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
