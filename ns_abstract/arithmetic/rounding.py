"""Rounding units and the error constants that bounds are charged with.

This is the only place that knows how large a rounding error is.

A floating-point evaluation of ``x op y`` returns ``(x op y)(1 + d)``, ``|d| <= k u``, with
``u`` the unit of the format and ``k`` the error of the operation in units of ``u``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

#: Unit roundoff of IEEE binary64, round to nearest.
UNIT64 = 2.0**-53
#: Unit roundoff of IEEE binary32, round to nearest.
UNIT32 = 2.0**-24
#: Larger than any absolute error that gradual underflow adds to a short sum of products
#: in binary64 (one operation: 2**-1075).
UNDERFLOW64 = 2.0**-1060
#: Larger than any absolute error that flushing binary32 subnormals to zero (``-ftz=true``)
#: adds to a short sum of products (one operation: 2**-126).
UNDERFLOW32 = 2.0**-116

# What the package's own float64 evaluation is charged with: relative to the sum of absolute terms, if nothing else is
# said. Names in ``UP`` are factors of sums of numbers that are not negative.

#: Radii of forms: sums of at most 40 terms of at most 3 roundings each.
UP = 1.0 + 128.0 * UNIT64
#: A rule of `forms`: a coefficient is a sum of at most four products, the centre of an order-1 product one of
#: 1 + d <= 9: 10 roundings; 2 to spare.
FORM_ROUNDING = 12.0 * UNIT64
#: Three products, their sum and the sum with an offset, 6; 2 to spare.
SUM_ROUNDING = 8.0 * UNIT64
#: A whitened offset, an alpha or a blend of forms, 12 at most; 4 to spare.
FRAGMENT_ROUNDING = 16.0 * UNIT64
#: Quadratic forms over a part of the box: a coefficient is a sum of at most 44 products (d <= 8) of two roundings each.
PART_ROUNDING = 128.0 * UNIT64
#: Pixels, tiles and radii that are computed from bounds: at most 2^20 roundings.
REGION = 1.0 + 2.0**-30
#: Taylor models: radii are sums of fewer than 2^10 terms, of two roundings each.
TAYLOR_UP = 1.0 + 2.0**11 * UNIT64
#: Polynomials in Chebyshev's basis: more than the rounding of the matrices' entries (arguments and cosines: 40 units of
#: degree at most 40) and of products with them (at most 2^11 terms).
CHEBYSHEV_ROUNDING = 2.0**-41
#: Fields of NeRFs: sums over a layer, in any order; at most 2^12 terms.
FIELD_UP = 1.0 + 2.0**-40
#: More than what underflow in binary32 (2**-126 each, were subnormals flushed) adds to a neuron
#: before and behind a layer: at most 2^10 columns, of 2 roundings before and 2^13 behind.
UNDERFLOW_COLUMNS = 2.0**-90
#: A shifted colour, and its hue in sixths of a turn: at most 2^8 roundings.
HUE_ROUNDING = 2.0**-44
#: Activations and compositing, absolute, by sample: at most 2^8 roundings of numbers up to 2.
COMPOSITE_ROUNDING = 2.0**-44
#: A pose: fewer than 64 roundings of numbers of its size, five rotations. Sums of up to ten products likewise.
POSE_ROUNDING = 64.0 * UNIT64


@dataclass(frozen=True)
class Arithmetic:
    """What the bounded program computes with.

    Every error is in units of ``unit``; the pair ``(unit, flush)`` says which floating-point
    evaluations of the gsplat formulas the bounds enclose. The real-number renderer and the
    package's own float64 evaluation are enclosed in both cases.

    Sources for the ``float32`` figures: CUDA C++ Programming Guide 12, "Mathematical Functions",
    tables of maximum ulp errors, with ``--use_fast_math`` (division 2 ulp, ``sqrt.approx`` 1 ulp on
    compute capability >= 5.2 and 3 ulp before, ``rsqrt`` 2 ulp, ``__expf(x)`` 2 + floor(|1.173 x|)
    ulp, ``expf`` 2 ulp under PyTorch's default flags). One ulp is at most 2 units.
    """

    name: Literal["float32", "real"]
    unit: float
    flush: float
    #: units of error of one operation
    division: float = 4.0
    sqrt: float = 6.0
    rsqrt: float = 4.0
    exp: float = 4.0
    fast_exp: float = 4.0
    #: products beyond this may overflow
    overflow: float = 2.0**1000
    fast_exp_per_unit_argument: float = 2.346


FLOAT32 = Arithmetic("float32", UNIT32, UNDERFLOW32, overflow=2.0**120)
REAL = Arithmetic("real", UNIT64, UNDERFLOW64)


def arithmetic(name: str) -> Arithmetic:
    """The arithmetic called ``name`` ("float32" or "real")."""
    return {"float32": FLOAT32, "real": REAL}[name]


def gamma(operations: int, unit: float = UNIT64) -> float:
    """Relative error of ``operations`` successive roundings, ``n u / (1 - n u)`` (Higham, Lemma 3.1)."""
    product = operations * unit
    if not product < 0.5:
        raise ValueError(f"{operations} roundings of unit {unit} leave no digit")
    return product / (1.0 - product) * (1.0 + 4.0 * UNIT64)


class Charges(NamedTuple):
    """What splat bounds are charged for the bounded program's rounding, as kernels take it; made by `charges`.

    Each is relative to what the label of docs/design.md that `charges` names beside it says, but for ``flush``, which
    is absolute, and ``overflow``, a limit.
    """

    flush: float
    overflow: float
    # one Gaussian
    camera_coordinate: float
    reciprocal_depth: float
    ratio: float
    mean: float
    clamp: float
    jacobian: float
    rotation: float
    rotation_entry: float
    covariance_products: float
    covariance: float
    covariance_size: float
    covariance_size_products: float
    blur: float
    determinant: float
    half_trace: float
    discriminant: float
    radius: float
    conic: float
    gram: float
    compensation: float
    near: float
    tile: float
    opacity: float
    exponent_limit: float
    depth_products: float
    depth: float
    viewing_axis: float
    # colours
    camera_position: float
    direction_mean: float
    direction: float
    harmonics: float
    color_sum: float
    shifted_color: float
    plain_color: float
    # one pixel
    threshold: float
    exponential: float
    exponential_by_argument: float
    exponential_by_range: float
    transmittance: float
    lost_light: float
    blend_fragment: float
    blend_pixel: float
    left_out: float
    expected_depth: float


def charges(a: Arithmetic) -> Charges:
    """Every charge of the splat kernels, with the count of roundings it covers (docs/design.md, the label named)."""
    u = a.unit
    # what the package's own float64 evaluation of the same formula adds to each rounding
    both = u + 8.0 * UNIT64
    by_argument = a.fast_exp_per_unit_argument + 0.654
    return Charges(
        flush=a.flush,
        overflow=a.overflow,
        # G2: R and C to float32, -R C, R mu, the last sum: 6 on |R||C|; 4 to spare
        camera_coordinate=10.0 * u,
        # G5: 1/z, and what is of second order
        reciprocal_depth=(a.division + 1.0) * u,
        # G5: a product, and what is of second order
        ratio=2.0 * u,
        # G5: focal length and centre to float32, two products, a sum: 5; 3 to spare
        mean=8.0 * u,
        # G6: of the clamp's limits: divisions and products of the intrinsics, 8
        clamp=8.0 * u,
        # G6: focal length, clamped ratio, three products: 5; 3 to spare
        jacobian=8.0 * u,
        # G11: R rounded twice
        rotation=2.0 * u,
        # G6: 1/|q|: half of 4, rsqrt; a component: 1; products of two: 1; twice, their sum and 1: 33; 19 see there
        rotation_entry=(2.0 * (2.0 * (3.0 + a.rsqrt) + 2.0) + 1.0 + 19.0) * u,
        # G6: products and sums of M M^T: 5 of 13, the others are in ``rotation_entry``
        covariance_products=5.0 * u,
        # G6: R twice, two products of matrices, two with J: 14; 6.5 to spare
        covariance=20.5 * u,
        # G6: of |Sigma| where its own error multiplies another
        covariance_size=64.0 * u,
        covariance_size_products=8.0 * u,
        # G6: 0.3 to float32, its sum
        blur=2.0 * u,
        # G8: two products, a difference, of ac + b^2: 3; 3 to spare
        determinant=6.0 * u,
        # G8: a sum, a product, 2 to spare; a square, a difference, 2 to spare
        half_trace=4.0 * u,
        discriminant=4.0 * u,
        # G8: a root and the sums and products beside it, as much again
        radius=2.0 * a.sqrt * u,
        # G7: 28 and 8; 44 to spare
        conic=80.0 * u,
        # G11: five products of matrices of three: 15; 1 to spare
        gram=16.0 * u,
        # G11: a division under the root, the root, the product with the opacity, 1 to spare
        compensation=(0.5 * a.division + a.sqrt + 2.0) * u,
        # G9: 0.01 to float32; 3 to spare
        near=4.0 * u,
        # G8: mean -+ radius, 1; a division by 16, 4; 3 to spare
        tile=8.0 * u,
        # G9: a sigmoid is an exponential, a sum and a division; 3 to spare
        opacity=(a.exp + 1.0 + a.division + 3.0) * u,
        # G9: __expf of at most 5.55, below 18, the product, the opacity; 33 to spare
        exponent_limit=64.0 * u,
        # G10: a product and two sums, 3, on |R||mu|; the last sum, 1, on z; second order
        depth_products=4.2 * u,
        depth=1.1 * u,
        # O1: R rounded twice, its product with the difference; 1 to spare
        viewing_axis=4.0 * u,
        # C3: torch.inverse of the view matrix, of 1 + |T|
        camera_position=80.0 * u,
        # C3: mean minus camera, of |mean|
        direction_mean=2.0 * u,
        # C3: a normalised direction
        direction=16.0 * u,
        # C3: a basis function's polynomial, its product, 16 sums, of sum |sh| |basis|; the sum with 0.5
        harmonics=40.0 * u,
        color_sum=u,
        # S4: a sum of colour and shift, the ends' own rounding
        shifted_color=4.0 * u,
        # C1: a product and a sum, or a sigmoid, at most 5; 3 to spare
        plain_color=8.0 * u,
        # B4: a constant in the program's format, 1; a comparison is exact
        threshold=2.0 * u,
        # B3: __expf at 0, the product with the opacity; 25 to spare
        exponential=(a.fast_exp + 1.0 + 25.0) * u,
        # B3: what __expf adds for each unit of the exponent, at its least and over its range
        exponential_by_argument=by_argument * u,
        exponential_by_range=2.0 * by_argument * u,
        # B5, B6: a difference and a product of the running transmittance, 2; the stop's constant, 1
        transmittance=8.0 * u,
        # B6: what the light that a stop leaves may be off by: two steps and the threshold, 5
        lost_light=16.0 * u,
        # B8: a product with alpha, one with the light, a sum
        blend_fragment=3.0 * both,
        # B8: the background's product and sum, the clamp: 6; 10 to spare
        blend_pixel=16.0 * both,
        # B8: a sum, for each fragment that is left out
        left_out=both,
        # D4: a division; a constant below it, 1
        expected_depth=(a.division + 1.0) * u,
    )
