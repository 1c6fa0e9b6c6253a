"""The table of what network bounds are charged with: a row for every kind of layer (docs/dev/network-charges.md).

The names in an expression are constants of `ns_abstract.arithmetic.network_charges`, with their counts, attributes of
the layer, and the symbols of `SYMBOLS`. Expressions of functions of one number are Python, and tests evaluate them
beside the layers.
"""

from __future__ import annotations

from dataclasses import dataclass

#: What stands in the expressions beside constants and attributes of layers.
SYMBOLS = {
    "lower": "the least value that the input is known to take",
    "upper": "the greatest one",
    "size": "the greatest absolute value that the input is known to take",
    "S": "the absolute products of a sum together, with its bias (N2)",
    "P": "the largest partial sum: positive products, or negative ones, together; N20 says what takes the place of n P",
    "n": "roundings of a sum: its products that may differ from zero, its bias, what may be added within it",
    "q": "inputs of the layer",
    "A": "what products of scales alone may grow to, in any grouping (N21)",
    "B": "the same with one layer of sums among them",
    "g": "the gain of the layer (N21)",
    "T": "the sizes of the shifts since the last layer of sums or activation",
    "W": "the layer's absolute weights",
}
_SUMS = "sums in any order and tree, fused multiply-add, "
_FOLDED = "scales and shifts folded backwards and forwards, "
_FLUSHED = "subnormal numbers flushed where they are read, written or stored"
_LIBRARY = "library functions within 16 units (documented: at most 4 ulp, 8 units), "


@dataclass(frozen=True)
class Row:
    """A kind of layer and its charge.

    Attributes:
        kind: The layer in the field's words.
        layers: Classes of `ns_abstract.verify.network` that it is the row of.
        charge: How far a float32 evaluation may be from the exact value of the layer.
        programs: What that covers.
        labels: Proofs in docs/dev/design.md.
        real: Whether the charge is made with network arithmetic "real", too.
    """

    kind: str
    layers: tuple[str, ...]
    charge: str
    programs: str
    labels: str
    real: bool = False


_OVERFLOWS = "every grouping of scales, sums before they are divided, one-pass sums of squares"
_CONSTANTS = "constants folded by the exporter, by the program when it loads, or at every evaluation, "

#: Layers of sums, scales and maps; their expressions are formulas of docs/dev/design.md.
SUMS = (
    Row(
        "layer of sums: fully connected, (transposed) convolution, mean, average pooling",
        ("Matrix", "Convolution", "TransposedConvolution", "SparseMatrix", "PairwiseDifferences"),
        "gamma(n) (P + gamma(n + FOLDING + 1) S) + gamma(PRODUCTS + q) S, FOLDING more where a scale is connected",
        _SUMS + _FOLDED + _FLUSHED,
        "N2, N20",
    ),
    Row(
        "shift folded into the sums behind it",
        ("Matrix", "Convolution", "TransposedConvolution"),
        "gamma(n + FOLDING + 1) (FOLDED_SHIFT W T + |bias|)",
        _SUMS + "a bias that is computed when the program loads",
        "N21",
    ),
    Row(
        "scale, shift, batch normalisation",
        ("ScaleLayer",),
        "gamma(n) |offset| (1 + gamma(n + FOLDING)) + gamma(FOLDING + PRODUCTS + q) S",
        _FOLDED + "a sum before it that starts with the shift, " + _FLUSHED,
        "N2, N21",
    ),
    Row(
        "sum of nodes",
        ("Sum",),
        "max(gamma(n) S of the others) + gamma(FOLDING + PRODUCTS + q) S",
        "sums of one branch that start with the others, " + _FLUSHED,
        "N2",
    ),
    Row(
        "flushed numbers of every linear layer",
        (
            "LinearLayer",
            "Pad",
            "ChannelEmbedding",
            "Gather",
            "Matrix",
            "Convolution",
            "ScaleLayer",
            "Sum",
            "SparseMatrix",
        ),
        "FLUSHES FLUSH (A + B + g + 1)",
        _FLUSHED + ", for scales that are grouped in any way",
        "N21",
    ),
    Row(
        "variance of a norm",
        ("Variance",),
        "gamma(n + FOLDING) S + gamma(VARIANCE_PASSES n) E[x^2] + FLUSHES FLUSH; at least "
        "(1 - gamma((1 + VARIANCE_PASSES) n + FOLDING)) of it, less gamma(VARIANCE_PASSES n) E[x]^2",
        "two passes, one pass (mean of squares less square of the mean), updates of both",
        "N11",
    ),
    Row(
        "sums over windows of channels",
        ("ChannelWindows",),
        "gamma(n) S + gamma(n) 2 w L + n FLUSHES FLUSH (1 + w), L what has left the window, n of all channels",
        "sums of each window, or running ones that add a channel and subtract another",
        "N11",
    ),
    Row(
        "resized map",
        ("Resize",),
        "POSITION (|place| + 1) times the interpolant's slope, POLYNOMIAL of cubic weights; OWN_POSITIONS of that with "
        "real arithmetic",
        "places by quotients or reciprocal scales, rows before columns or together",
        "N19",
    ),
    Row(
        "maximum, minimum",
        ("MaxPool",),
        "FLUSHES FLUSH",
        "comparisons of flushed numbers, in any order",
        "N12, N21",
    ),
    Row(
        "product of two values, matrix product",
        ("Product",),
        "PRODUCT |x| |y| + FUNCTION_FLUSHES FLUSH (1 + |x| + |y|)",
        "factors scaled before or behind, fused multiply-add, " + _FLUSHED,
        "N9, N21",
    ),
    Row(
        "overflow",
        (),
        "unknown where A + B, an image or a result may reach OVERFLOW",
        _OVERFLOWS,
        "N22",
    ),
    Row(
        "computed constants",
        ("InexactLayer", "InexactConvolution", "InexactMatrix", "InexactScale", "InexactTransposedConvolution"),
        "gamma(n + CONSTANT_SUMS) of sums, ONCE of one operation, LIBRARY, OTHER_LIBRARY; ONCE_FLUSHES flushed numbers",
        _CONSTANTS + _SUMS + _FLUSHED,
        "N23",
    ),
)

#: Functions of one number; their expressions are Python.
FUNCTIONS = (
    Row(
        "ReLU",
        ("LeakyRelu",),
        "FUNCTION_FLUSHES * FLUSH * (upper > 0 and lower < FLUSH)",
        _FLUSHED,
        "N21",
    ),
    Row(
        "leaky ReLU",
        ("LeakyRelu",),
        "AFFINE * alpha * size + FUNCTION_FLUSHES * FLUSH * (1 + size)",
        "one product, or a product of each part and their sum, " + _FLUSHED,
        "N10, N21",
    ),
    Row("sigmoid, tanh", ("Sigmoid", "Tanh"), "LIBRARY", _LIBRARY + "rational approximations, " + _FLUSHED, "N10"),
    Row("clip", ("Clip",), "FUNCTION_FLUSHES * FLUSH * (1 + factor + size)", _FLUSHED, "N10, N21"),
    Row(
        "hard sigmoid",
        ("Clip",),
        "AFFINE * (factor * size + abs(offset)) + FUNCTION_FLUSHES * FLUSH * (1 + factor + size)",
        "fused multiply-add, " + _FLUSHED,
        "N10, N21",
    ),
    Row("absolute value", ("Abs",), "FUNCTION_FLUSHES * FLUSH", _FLUSHED, "N21"),
    Row(
        "hard swish",
        ("HardSwish", "GatedClip"),
        "HARD * size + FUNCTION_FLUSHES * FLUSH",
        "a sixth as constant or quotient, before or behind the product, " + _FLUSHED,
        "N10, N24",
    ),
    Row(
        "square",
        ("Power",),
        "SQUARE * size**2 + FUNCTION_FLUSHES * FLUSH * (1 + size)",
        "a product or a library's power, " + _FLUSHED,
        "N10, N21",
    ),
    Row(
        "power of a whole number",
        ("Power",),
        "LIBRARY * size**exponent + FUNCTION_FLUSHES * FLUSH * (1 + size)",
        "products in any order, " + _LIBRARY + _FLUSHED,
        "N10, N21",
    ),
    Row(
        "reciprocal, quotient",
        ("Reciprocal", "SoftmaxReciprocal"),
        "QUOTIENT / min(abs(lower), abs(upper)) + FUNCTION_FLUSHES * FLUSH",
        "a division, or a reciprocal and a product, " + _FLUSHED,
        "N10, N21",
    ),
    Row(
        "root",
        ("Root",),
        "ROOT * sqrt(upper) + FUNCTION_FLUSHES * FLUSH",
        _FLUSHED + "; unknown below FLUSH",
        "N10, N21",
    ),
    Row(
        "reciprocal root",
        ("Root",),
        "ROOT / sqrt(lower) + FUNCTION_FLUSHES * FLUSH",
        "a root and a division, approximate reciprocal roots within 2 ulp; unknown below FLUSH",
        "N10, N21",
    ),
    Row(
        "power of positive numbers",
        ("PositivePower",),
        "LIBRARY * max(exp(exponent * log(lower)), exp(exponent * log(upper))) + FUNCTION_FLUSHES * FLUSH",
        _LIBRARY + _FLUSHED + "; unknown below FLUSH",
        "N10, N21",
    ),
    Row(
        "exponential",
        ("Exp",),
        "2 * LIBRARY * exp(upper) + FUNCTION_FLUSHES * FLUSH",
        _LIBRARY + _FLUSHED + "; unknown past LARGEST_EXPONENT",
        "N10, N22",
    ),
    Row(
        "softmax's exponentials",
        ("CappedExp",),
        "(ATTENTION + ATTENTION_BLOCKS * count) * exp(min(upper, cap)) + FUNCTION_FLUSHES * FLUSH"
        " if lower <= cap + 1 else 0",
        "fused attention with exponentials within 20 ulp, in blocks that are rescaled; the greatest subtracted or not, "
        + _FLUSHED,
        "N11",
    ),
    Row(
        "share of a sum that is cut off",
        ("SoftmaxReciprocal",),
        "LOST_SHARE * (upper > exp(30) / 2)",
        "sums of exponentials that overflow or do not",
        "N11",
        real=True,
    ),
    Row(
        "logarithm",
        ("Log",),
        "LIBRARY * (1 + max(abs(log(lower)), abs(log(upper))))",
        _LIBRARY + "; unknown below FLUSH",
        "N10",
    ),
    Row(
        "softplus",
        ("Softplus", "SwitchedSoftplus"),
        "2 * LIBRARY * (1 + size)",
        "with or without log1p, with a switch to the argument from 16 on, " + _LIBRARY + _FLUSHED,
        "N10, N24",
    ),
    Row(
        "switched softplus",
        ("SwitchedSoftplus",),
        "(exp(-limit) * SWITCH + (excess + OWN_QUOTIENTS) * size) * (upper >= limit * (2 - SWITCH))",
        "comparisons of scaled arguments, constants of the file",
        "N24",
        real=True,
    ),
    Row(
        "ELU, SELU, CELU",
        ("Elu",),
        "2 * LIBRARY * scale * (alpha + size)"
        " + FUNCTION_FLUSHES * FLUSH * (1 + scale) * (1 + alpha) * (1 + size)",
        "with or without expm1, factors in any order, " + _LIBRARY + _FLUSHED,
        "N10, N21",
    ),
    Row("error function", ("Erf",), "2 * LIBRARY", _LIBRARY + "rational approximations, " + _FLUSHED, "N10"),
    Row(
        "SiLU, GELU, Mish",
        ("Silu", "Gelu", "GeluTanh", "Mish", "ScaledGelu"),
        "4 * LIBRARY * size + FUNCTION_FLUSHES * FLUSH",
        "one function, or a product with a gate of up to two library functions, " + _LIBRARY + _FLUSHED,
        "N10, N24",
    ),
    Row(
        "functions with constants of the file",
        ("ScaledGelu", "GatedClip"),
        "OWN_QUOTIENTS * size",
        "quotients of the file's constants",
        "N24",
        real=True,
    ),
    Row(
        "values in steps",
        ("Quantised",),
        "0.5 * step * SWITCH + STEPS * max(abs(least), abs(most))",
        "quotients or products with the reciprocal, ties to either side, whole numbers of 8 and 16 bits",
        "N25",
        real=True,
    ),
)  # fmt: skip

ROWS = SUMS + FUNCTIONS
