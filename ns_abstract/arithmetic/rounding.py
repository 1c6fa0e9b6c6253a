"""Rounding units and the error constants that bounds are charged with: only this place knows how large an error is.

A floating-point evaluation of ``x op y`` returns ``(x op y)(1 + d)``, ``|d| <= k u``, with ``u`` the unit of the format
and ``k`` the error of the operation in units of ``u``.
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

# What the package's own float64 evaluation is charged with, and how many roundings each constant stands for. Every one
# begins with its label in design.md, and is relative to the sum of absolute terms, if nothing else is said. Names
# in ``UP`` are factors of sums of numbers that are not negative, those in ``DOWN`` the same for lower bounds.

# ---------------------------------------------------------------- forms and functions (A, E)

#: A1: radii of forms, sums of at most 40 terms of at most 3 roundings each.
UP = 1.0 + 128.0 * UNIT64
#: A1: a rule of `forms`: a coefficient is a sum of at most four products, the centre of an order-1 product one of
#: 1 + d <= 9: 10 roundings; 2 to spare.
FORM_ROUNDING = 12.0 * UNIT64
#: A2: a product that is added to others: 1 + d + 2 (d + 1) <= 27 roundings of the oldest of three; 21 to spare.
ADDED_PRODUCT_ROUNDING = 4.0 * FORM_ROUNDING
#: A3: an end of a second derivative: two products, a root, a quotient: 4; 44 to spare.
CURVATURE_DOWN = 1.0 - 4.0 * FORM_ROUNDING
#: A4: the range of a form: at most 36 + 8 additions of terms of at most 4 roundings, 48; as many to spare.
RANGE_ROUNDING = 8.0 * FORM_ROUNDING
#: A3: no charge: between these, fourth powers and their reciprocals neither overflow nor lose digits to underflow.
SMALLEST, LARGEST = 1e-75, 1e75
#: A3: no charge: the same for third powers, which second-order remainders are.
SMALLEST_CUBED, LARGEST_CUBED = 2.0**-200, 2.0**200
#: A3: library functions in float64 (sine, cosine, logarithm): two units in the last place, absolute for values up to 1.
FUNCTION_ROUNDING = 4.0 * UNIT64
#: A3: an angle: 4 units of |angle| + 1 for how it was computed, 4 for the library's sine and cosine of it.
ANGLE_ROUNDING = 8.0 * UNIT64
#: E1: `exp_kernel`, relative: truncation 2.2 units, reduction 0.4, Estrin's scheme 3, scaling none; 2.4 to spare.
EXP_RELATIVE_ERROR = 2.0**-50

#: E1: the exponential and a product with this factor, 9; 7 to spare.
EXP_DOWN, EXP_UP = 1.0 - 2.0 * EXP_RELATIVE_ERROR, 1.0 + 2.0 * EXP_RELATIVE_ERROR

# ---------------------------------------------------------------- poses (P)

#: P1: a pose: fewer than 64 roundings of numbers of its size, five rotations. Sums of up to ten products likewise (P2).
POSE_ROUNDING = 64.0 * UNIT64
#: P1, S2, L1: half of a range's width about its rounded middle: a difference and this product, 2; 2 to spare.
HALF_UP = 1.0 + 4.0 * UNIT64

#: P3: what three more turns make of the rounding of a rotation, 2.83 times, and of a position; 12 units of twice it.
TURNED_ROTATION, TURNED_POSITION = 4.0, 8.0
#: P1: no charge: a row of a rotation whose radius is below is taken to stand still: 2^7 times `POSE_ROUNDING`.
STILL_ROOM = 1e-12
#: C1: no charge: a position that moves by less is one, and what it moves by is an error of it.
STILL_POSITION = 1e-9

# ---------------------------------------------------------------- splats (G, B, O, C, D, S)

#: G6: no charge: the least squared length of a quaternion. Each of its four squares may be flushed, which changes their
#: sum by 2^-24 of it at most.
LEAST_QUATERNION = 2.0**-100
#: G6: no charge: scales are so far inside float32's normal range that an exponential of 4 units, 2^-22, stays there.
NORMAL_ROOM = 1e-6
#: G5, G6, G7, G11, B8, C2: the rounding of sums of errors (at most 2^10 units), and products of relative errors that
#: are left out and below a hundredth.
SECOND_ORDER = 1.01
#: G1: three products, their sum and the sum with an offset, 6; 2 to spare.
SUM_ROUNDING = 8.0 * UNIT64
#: G3: an affine combination of two rotated coordinates: 9 terms of 3 roundings, and their sums, 12; 52 to spare.
CULL_ROUNDING = 8.0 * SUM_ROUNDING
#: B1: what the pixel stage adds up for a whitened offset, 12; 4 to spare.
WHITENED_ROUNDING = 2.0 * SUM_ROUNDING
#: B1, B7: a whitened offset, an alpha or a blend of forms, 12 at most; 4 to spare.
FRAGMENT_ROUNDING = 16.0 * UNIT64
#: B10: a curvature's range in centre and radius: sums of 8 sums of 8, 16, their middle and half, 2; 14 to spare.
CURVE_ROUNDING = 2.0 * FRAGMENT_ROUNDING
#: O1: a difference of places and its product of three, 4, of the centre and of slopes that are at most 7 together.
ORDER_ROUNDING = 2.0 * FRAGMENT_ROUNDING
#: O1: the same of an offset from the block's ray, a product and a difference more, 6; 16 to spare.
WINDOW_ROUNDING = 4.0 * FRAGMENT_ROUNDING
#: A4: the range of a pixel's form, as `RANGE_ROUNDING`: 48; 80 to spare.
PIXEL_RANGE_ROUNDING = 8.0 * FRAGMENT_ROUNDING
#: D3: a quotient of sums that the former bounds, the shift and what is common, at most 2^7; as many to spare.
DEPTH_ROUNDING = 16.0 * FRAGMENT_ROUNDING
#: B11: quadratic forms over a part of the box: a coefficient is a sum of at most 44 products (d <= 8) of two roundings
#: each; 40 to spare.
PART_ROUNDING = 128.0 * UNIT64
#: G3, G8, G9, G11: pixels, tiles and radii that are computed from bounds: at most 2^20 roundings.
REGION = 1.0 + 2.0**-30
#: G9, B4: a logarithm of a quotient near 1, absolute: at most 2^20 roundings.
LOGARITHM_ROOM = 2.0**-30
#: O1: by how much the turn of a block's central ray, a number below 1, may be more than computed, absolute: at most 8
#: sums of three products, 16 roundings of terms that together are below 2^18, as slopes and rays are below 2^6.
TURN_ROOM = 2.0**-30
#: B2: half of one less a square's share of another: 6 roundings, of at most 2^13.
TURN_DOWN = 1.0 - 2.0**-40
#: B3: two exponentials, of an exponent's least and of half its range, 16 units, and products; 10 to spare.
EXP_OF_ENDS = 4.0 * EXP_RELATIVE_ERROR
#: B12: two exponentials, of a part's exponent and of the compensation's, 16 units, and products; 40 to spare.
EXP_OF_PARTS = 8.0 * EXP_RELATIVE_ERROR
#: B3: a coefficient of the fitted exponential: at most 12 sums, 4 to spare; and two exponentials in its factor.
FIT_ROUNDING = FRAGMENT_ROUNDING + 2.0 * EXP_RELATIVE_ERROR
#: B3: what the Bessel functions' series, cut behind x^4, leave of x^5 for x <= 1: 1/14400 (1 + 1/36 + ...) of I0, twice
#: 1.2e-5 of 2 I1 / r, four times 1.7e-6 of the others, below 1.1e-4.
SERIES_REST = 1.2e-4
#: B3: the same with a fit of degree 3, whose coefficient leaves eight times 2.1e-7 and three times twice as much.
CUBIC_SERIES_REST = 1.5e-4
#: B7: a radius' own recursion, three roundings by layer of numbers that are not negative; 1 to spare.
LAYER_ROUNDING = 4.0 * UNIT64
#: B11: sums of what skipping changes, one rounding by fragment. O2: swaps, one by pair; 1 to spare.
CROSSING_ROUNDING, SWAP_ROUNDING = UNIT64, 2.0 * UNIT64
#: B12: by how much of a cell's half-width sub-boxes reach beyond their ends, so that they hold what lies between the
#: grid's lines however these are rounded; and the most, of that, that the lines' rounding may come to.
SUB_BOX_OVERLAP, SUB_BOX_LINES = 2.0**-24, 2.0**-26
#: B12: a grid's line and the middle and half-width of a cell, relative to the sizes of its ends: 6; 10 to spare.
SUB_BOX_LINE_ROUNDING = 16.0 * UNIT64
#: B16: a slope less its part along the motion, a product and two sums, and their sum of at most 8 terms, 11; and the
#: part's own sum of three terms, 3; 2 to spare, of sizes of both.
MOTION_ROUNDING = 16.0 * UNIT64
#: B16: no charge: a block's motion is scaled so that its rows' sizes, sums of at most 8 terms, are at most 1.
MOTION_SCALE = 1.0 - 2.0**-30
#: B15: differences of two products whose sizes add up to 1 at most, and a sum with 1/2, absolute: 4 roundings; the same
#: of a bound less 1/2 and its quotient by the scale: 3. 12 to spare.
CHANNEL_DIFFERENCE_ROUNDING = 16.0 * UNIT64
#: B14: by fragment, what is left in a band has 8 roundings and the part that is reached 2, of a range of colours that
#: is twice as wide as the brightest; 12 to spare.
BAND_ROUNDING = 32.0 * UNIT64
#: B12: a part's share of a swap bound: a quotient and two products, 3; 5 to spare.
MOVE_SHARE_UP = 1.0 + 8.0 * UNIT64
#: B11: light has two roundings by layer of `LAYER_ROUNDING`; a weight as many as so many layers more.
WEIGHT_LAYERS = 8
#: B11: roundings of planes' sums beside one by fragment: lines of two sums and two products, 24; 40 to spare.
PLANE_ROUNDINGS = 64.0
#: O1: two differences of means to the cell's middle, 2, in both directions: means no closer cannot fall together.
TIE_ROUNDING = 4.0 * UNIT64
#: G11: the compensation's own evaluation: roots, products, quotients and sums of bounds, at most 32; as many to spare.
COMPENSATION_ROUNDING = 64.0 * UNIT64
#: G11: a root of a bound of the squared compensation, 1, and the difference, 1; 14 to spare.
ROOT_ROUNDING = 16.0 * UNIT64
#: C3: sums of at most 16 products, 34; up to 2^13.
MAGNITUDE_UP = 1.0 + 2.0**-40
#: S4: an arc from its chord, up to an arc of 2, where the arcsine grows by less than twice its argument: 8; up to 2^13.
ARC_UP = 1.0 + 2.0**-40
#: C4: norms of 3x3 matrices and their sums, relative: at most 2^6; a product of two rotations and its difference from
#: the identity, absolute: 10 by entry, 2^5 for all nine; 2^7 are charged.
GRAM_UP, GRAM_ROOM = 1.0 + 2.0**-30, 2.0**-46
#: S4: a sum of colour and shift, the middle and half the width of their range, 4; as many to spare.
SHIFTED_ROUNDING = 8.0 * UNIT64
#: B9: radii and constant ends of linear sets: at most 44 sums; up to 2^13 of the radius, 2^9 of the others.
LINEAR_UP, LINEAR_ROUNDING = 1.0 + 2.0**-40, 2.0**-44
#: Y1, Y2, Y3: a difference of two bounds in at most 12 parameters, relative to the sum of all sizes: at most 92
#: differences and terms of a sum, each rounded at most 2^3 times, and the sum's 2^7 u: 2^8 u; twice as much is charged.
DIFFERENCE_ROUNDING = 2.0**-44
#: Y4: the last digits of a picture that is blended in float64 of some hundred Gaussians; two pictures that differ less
#: are taken for the same one, which breaks no tolerance.
RENDERED_DIGITS = 2.0**-40
#: B8: alphas below are left out by the paper's rasteriser, which draws all; so much is added for each that is.
NEGLIGIBLE_ALPHA = 2.0**-40
#: G7: the covariance's relative error x below which the exponent's is at most x (1 + 2 x), below 0.695: an inverse by
#: 1 - x, and 36 of the 80 charged units times ((1 + x) / (1 - x))^2.
COVARIANCE_ERROR = 0.39
#: G12: units of the program by which alpha may exceed its threshold where a tile is missed: 298 of a box (16 and 32 of
#: its side, 178 + 78 + 34 + 8 in the exponent), 2^17 of an ellipse, twice.
BOX_ROOM, ELLIPSE_ROOM = 2.0**9, 2.0**18
#: G12: what is asked for where the former hold: the covariance's relative error, coordinates in pixels, det / (a c)
#: squared in units, and det / (a c) times the thinner deviation in units of a coordinate.
ELLIPSE_ERROR, ELLIPSE_SPAN, ELLIPSE_SHARPNESS, ELLIPSE_TIPS = 2.0**-9, 4096.0, 256.0, 512.0
#: D4: no charge: a renderer's pixels at the edge of what a Gaussian may reach, in pixels, of at most 2^20 pixels: 2^12
#: roundings.
PIXEL_ROOM = 1e-6

# ---------------------------------------------------------------- fields (F)

#: F1: radii of Taylor models, sums of fewer than 2^10 terms, of two roundings each.
TAYLOR_UP = 1.0 + 2.0**11 * UNIT64
#: F1: coefficients of a function's Taylor polynomial (32 units) and their products with powers, at most 32.
TAYLOR_ROUNDING = 64.0 * UNIT64
#: F1: the remainder: powers up to degree + 1 and a factor, at most 2^7.
REMAINDER_UP = 1.0 + 128.0 * UNIT64
#: F1: the lower end of a range: at most 40 roundings of the range and of the centre; 24 to spare.
LOWER_ROUNDING = 64.0 * UNIT64
#: F1: the reciprocal of a factorial, 2; 6 to spare.
FACTORIAL_UP = 1.0 + 8.0 * UNIT64
#: F1: a pixel's ray and its rotation, 2 and 5, here and by the concrete renderer; 2 to spare. What normalises it, 6.
RAY_ROUNDING = 16.0 * UNIT64
#: F1: a point's polynomial at a pose: a sum of at most 35 products with products of powers, 48, and the concrete
#: renderer's product and sum, 2; 14 to spare.
POINT_ROUNDING = 64.0 * UNIT64
#: F16: the same twice, of origin and direction apart, where the place is a line in the pose.
FOLLOWED_ROUNDING = 128.0 * UNIT64
#: F3: a direction's polynomial at a node, as a point's: 48 roundings of coefficients that are at most 2 together.
DIRECTION_ROUNDING = 96.0 * UNIT64
#: F2: polynomials in Chebyshev's basis: more than the rounding of the matrices' entries (arguments and cosines: 40
#: units of degree at most 40) and of products with them (at most 2^11 terms).
CHEBYSHEV_ROUNDING = 2.0**-41
#: F2, F5: factors of a grid: a cosine, powers and quotients, or a product and a sum of at most 8 squares; up to 2^13.
GRID_UP = 1.0 + 1e-12
#: F3: powers of an ellipse's radius and their difference, which cancels to a tenth; at most 2^20.
ELLIPSE_UP = 1.0 + 2.0**-30
#: F3: a wave's argument: frequency and product, 3, here and by the concrete renderer; 10 to spare.
WAVE_ROUNDING = 16.0 * UNIT64
#: F3, F16: roundings of an interpolant's coefficients beside one by node, of the sum of the matrix' absolute entries:
#: the entries 33 on average (of degree 35), the function 4, the first product 1; 26 to spare.
INTERPOLATION_ROUNDINGS = 64
#: F4: sums over a layer, in any order; at most 2^12 terms.
FIELD_UP = 1.0 + 2.0**-40
#: F4: a bias that is added, here and by the concrete evaluation: 2; 2 to spare.
BIAS_ROUNDING = 4.0 * UNIT64
#: F4: one rounding of a column in float32, and what is of second order.
NARROW_ROUNDING = (1.0 + 2.0**-10) * UNIT32
#: F4: roundings of a float32 sum beside one by neuron: entry, slope, product and second evaluation.
NARROW_STEPS = 8
#: F4: more than what underflow in binary32 (2**-126 each, were subnormals flushed) adds to a neuron
#: before and behind a layer: at most 2^10 columns, of 2 roundings before and 2^13 behind.
UNDERFLOW_COLUMNS = 2.0**-90
#: F5: no charge: slopes are 0 or no less, so that their products with columns do not underflow.
LEAST_SLOPE = 2.0**-60
#: F5: a new polynomial and slopes: the series' scaling, a product and a sum, 4; as many to spare.
RELU_ROUNDING = 8.0 * UNIT64
#: F7: softplus and opacity, relative: exponential, logarithm (4 each), sums and products, here and by the concrete
#: renderer, at most 24; up to 2^7. Opacities are raised by as little as underflow may take.
ACTIVATION_ROUNDING, ACTIVATION_FLOOR = 2.0**-46, 2.0**-1000
#: F7: torch's softplus is its argument from 20 on: a lower bound is from here on.
SOFTPLUS_LINE = 19.0
#: F8: activations and compositing, absolute, by sample: at most 2^8 roundings of numbers up to 2.
COMPOSITE_ROUNDING = 2.0**-44
#: F8: compositing in both evaluations, absolute, by sample: at most 8 operations on numbers of at most 1, and shifts.
SAMPLE_ROUNDING = 4.0 * COMPOSITE_ROUNDING
#: F10: sums of weights of which the light is kept in float32, 1 of its units; 15 to spare.
KEPT_LIGHT_UP = 1.0 + 2.0**-20
#: F9: a shifted colour, and its hue in sixths of a turn: at most 2^8 roundings.
HUE_ROUNDING = 2.0**-44
#: F9: a hue of a box, in sixths of a turn, from four of them.
HUE_ROOM = 4.0 * HUE_ROUNDING
#: F11: a voxel's number: a difference and a product, here and by the concrete renderer, 4; as many to spare.
VOXEL_ROUNDING = 8.0 * UNIT64
#: F12: a part's end, slope and offset: at most 2^5.
PLANE_ROUNDING = 64.0 * UNIT64
#: F12: the ends of parts of a cell, of the parameter's values: quotient, product, sum, 4; 12 to spare.
PART_END_ROUNDING = 16.0 * UNIT64
#: F14: shares, places and edges, by bin: a product, a sum and a difference in both directions, at most 10; up to 2^7.
EDGE_ROUNDING = 2.0**-46
#: F14: bins' worth of these beside one by bin.
EDGE_BINS = 16
#: F14: a place in parts of a bin, of which there are at most 2^12: up to 2^11 roundings.
PLACE_ROOM = 2.0**-30
#: F14: a density from its opacity: a logarithm (4), a quotient, a product; up to 2^13.
DENSITY_ROUNDING = 2.0**-40
#: F16: a line that a sample is followed along, in parts of the ray: d + 4 roundings, here and where it is evaluated, of
#: numbers that are at most 2 d + 1 rays together: 408 for d = 8; 104 to spare.
LINE_ROUNDING = 2.0**-44
#: F16: rests of lines, light and weights: sums of at most 48 products, an exponential; up to 2^13. Light has 49 of its
#: logarithm's size, which is less than that while light is above 2^-240; what is off below is within `SAMPLE_ROUNDING`.
FOLLOWED_UP = 1.0 + 2.0**-40

# ---------------------------------------------------------------- hash-grid fields (H)

#: H1: sums of at most 2^12 numbers that are not negative, of a few roundings each.
HASH_UP = 1.0 + 2.0**-40
#: H1: a line's polynomial at a place: at most 84 terms of 12 roundings, and derivatives of at most 36 times their size;
#: 2^10 are charged of each term that many times.
HASH_RAY_ROUNDING = 2.0**10 * UNIT64
#: H2: a point, its contraction and normalisation, here and by the concrete renderer: at most 16; 16 to spare. Relative
#: to the sum of absolute terms of the point over the largest coordinate's size, and to 2.
POINT_PLACE_ROUNDING = 32.0 * UNIT64
#: H2: a distance from its place in the spacing, 6 here and there, 10 to spare.
SPACING_ROUNDING = 16.0 * UNIT64
#: H3: a coordinate in cells, 2; 2 to spare. A trilinear value and slopes, in both evaluations, 24; 8 to spare, of the
#: largest node's size.
CELL_ROUNDING, TRILINEAR_ROUNDING = 4.0 * UNIT64, 32.0 * UNIT64
#: H5: exponentials, logarithms and logistic functions, products with slopes and halves, here and by the concrete
#: renderer: at most 28; up to 2^7.
HASH_BAND_ROUNDING = 2.0**-46
#: H6: an interval's optical depth, 6 here and there, 10 to spare; a sum of depths one more by interval, twice.
DEPTH_PRODUCT_ROUNDING, DEPTH_SUM_ROUNDING = 16.0 * UNIT64, 4.0 * UNIT64
#: H6: shares of the distribution, by bin: weights 4, their sum and the cumulated shares one each, twice; up to 2^4.
SHARE_ROUNDING = 16.0 * UNIT64
#: H6: bins' worth of these beside one by bin.
SHARE_BINS = 16
#: H8: the middle of a piece of a box, half its width and the ends of its parts: quotients, products and sums, 8; as
#: many to spare; by the number of pieces where they are told in half-widths of a piece.
PIECE_END_ROUNDING = 16.0 * UNIT64
#: H6: middles, halves, what is left of shares, and a place of an edge at one pose: at most 3 roundings of numbers as
#: large as those beside; 1 to spare.
HASH_SUM_ROUNDING = 4.0 * UNIT64
#: H6, H7: light, weights and quotients of them, of numbers of at most 1: exponentials bounded by themselves, and at
#: most 5 differences, products and quotients; ends of a colour's form, a sum of few numbers; 3 to spare.
HASH_LIGHT_ROUNDING = 8.0 * UNIT64
#: H6: a place within one bin, by its form or its ends: at most 10 roundings of numbers of at most 1; 6 to spare.
HASH_PLACE_ROUNDING = 16.0 * UNIT64
#: H6: a place over several bins; H8: a form's ends over part of a box: at most 22; 10 to spare.
HASH_PLACES_ROUNDING = 32.0 * UNIT64
#: H6: a distance as a function of its place, with slope and bend: four times a distance's.
SPACING_BAND_ROUNDING = 4.0 * SPACING_ROUNDING
#: H1: a product of forms: twice a form's rule.
HASH_PRODUCT_ROUNDING = 2.0 * FORM_ROUNDING
#: H8: an end of a part in half-widths: twice a piece's.
PIECE_PART_ROUNDING = 2.0 * PIECE_END_ROUNDING
#: H6: no charge: what stands for a quotient's 0.
HASH_LEAST = 1e-300
#: H7: compositing in both evaluations, absolute, by sample: at most 12 operations on numbers of at most 1; 4 to spare.
HASH_SAMPLE_ROUNDING = 16.0 * UNIT64

# ---------------------------------------------------------------- refinement, certificates, loops (R, V, L)

#: R6: means of a picture's bounds, of at most 2^30 numbers summed in pairs, must not turn a sum of means around.
MEAN_DOWN = 1.0 - 2.0**-20
#: R7: where a part lies in a box, 6, its product, 1, and a sum of at most 4 d + 1 <= 41 of these; 16 to spare.
MAP_ROUNDING = 64.0 * UNIT64
#: R7: no charge: a guard, as leaves are those of all cells (R1): volumes of parts that are whole together, by sums of
#: up to 2^20 products of d <= 10 factors of 3 roundings each, lack at most 2^-32.
COVER_DOWN = 1.0 - 2.0**-30
#: V1: roundings of one float32 evaluation of the preprocessing, in units of the largest numbers met: 7; 3 to spare.
PREPROCESS_ROUNDING = 10.0 * UNIT32
#: V1: the package's own evaluation of it, 7; 1 to spare.
PREPROCESSED_ROUNDING = 8.0 * UNIT64
#: V14: relative error of a power or product, in float32 or better: at most eight of its roundings.
RESPONSE_ROUNDING = 8.0 * UNIT32
#: V14: the same of offsets of planes, absolute: of the camera's value, up to 1, and of the planes' own evaluation.
RESPONSE_ROUNDINGS = 2.0 * RESPONSE_ROUNDING
#: U1: a photo's value, the noise and the sums with them, absolute: 6 roundings of numbers below 4; up to 2^11.
PHOTO_ROOM = 2.0**-40
#: U6: two sums and a quotient, of the sum of all sizes over the least gain: 3 roundings; up to 2^4.
BRIGHTNESS_ROUNDING = 2.0**-49
#: U3: a constraint's room and its slopes' sum, of sums of at most d + 3 <= 11 terms: 16; up to 2^9 of their size.
REACH_ROUNDING = 2.0**-44
#: U3: a reach in [-1, 1], the cell's middle and half its width, and their sum, in half-widths: 2^4; up to 2^13. Whether
#: a line of the grid lies outside of a cut is compared with the line itself.
CUT_ROOM = 2.0**-40
#: U3: the same of the ends' own sizes: middle, product and sum, 3; 5 to spare.
CUT_VALUE_ROUNDING = 8.0 * UNIT64
#: L1: roundings on the longest way through a law: sums of up to 9 products, five more products, and four units of
#: a library's sine or cosine; twice that, to spare. Slack: the forms charge each of their operations for more than
#: float64 errs in it (rounding takes at most 0.15 of their radius, 0.45 where a library's sines are 16 units off), and
#: yet this stands, so that no law needs a proof of that.
STEP_ROUNDINGS = 40
#: L1: radii's own sums, 3; 1 to spare.
STEP_UP = 1.0 + 4.0 * UNIT64
#: L2: roundings of a few operations on one number: scaling, shifting, halving; and of a spread beside those of its sum.
SET_ROUNDINGS, SPREAD_ROUNDINGS = 16, 4
#: L2: no charge: half-width below which positions in a box are not told apart, so that quotients do not overflow.
NARROWEST = 2.0**-500
#: L3: a clip's ends less a line: slope, product, difference, middle and half, 5; 3 to spare. Radii's own sums, 4.
CLIP_ROUNDING, CLIP_UP = 8.0 * UNIT64, 1.0 + 8.0 * UNIT64
#: L1: the sum with a push and the disturbance, here and where a run is simulated, 2; 2 to spare.
PUSH_ROUNDING = 4.0 * UNIT64
#: L6: rounding to float32, relative to a number and at least; twice a unit, for what is rounded here.
STORED_ROUNDING, STORED_FLUSH = 2.0**-23, 2.0**-126
#: L6: its sum with a radius, one rounding; up to 2^3.
STORED_UP = 1.0 + 2.0**-50
#: L6: no charge: past this a float32 evaluation may overflow.
LARGEST32 = 2.0**126

#: No charge: stands for 0 where a quotient that decides about work alone divides by it.
NONZERO = 1e-300


def taylor_product_rounding(monomials: int) -> float:
    """Return charge of a product of Taylor models, whose coefficients sum at most one product by coefficient (F1)."""
    return (monomials + 2.0) * UNIT64


@dataclass(frozen=True)
class Arithmetic:
    """The floating-point arithmetic of the program whose pictures are bounded, as error constants.

    Every error is in units of ``unit``; the pair ``(unit, flush)`` says which floating-point evaluations of the gsplat
    formulas the bounds enclose. The real-number renderer and the package's own float64 evaluation are enclosed in both
    cases.

    Sources for the ``float32`` figures: CUDA C++ Programming Guide 12, "Mathematical Functions", tables of maximum ulp
    errors, with ``--use_fast_math`` (division 2 ulp, ``sqrt.approx`` 1 ulp on compute capability >= 5.2 and 3 ulp
    before, ``rsqrt`` 2 ulp, ``__expf(x)`` 2 + floor(|1.173 x|) ulp, ``expf`` 2 ulp under PyTorch's default flags). One
    ulp is at most 2 units.
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
    """Return the arithmetic called ``name`` ("float32" or "real")."""
    return {"float32": FLOAT32, "real": REAL}[name]


def gamma(operations: int, unit: float = UNIT64) -> float:
    """Return the relative error of ``operations`` successive roundings, ``n u / (1 - n u)`` (Higham, Lemma 3.1)."""
    product = operations * unit
    if not product < 0.5:
        raise ValueError(f"{operations} roundings of unit {unit} leave no digit")
    return product / (1.0 - product) * (1.0 + 4.0 * UNIT64)


class Charges(NamedTuple):
    """Error constants of the bounded program's rounding, by which splat kernels widen bounds; made by `charges`.

    Each is relative to the quantity that the label of design.md named in `charges` states, but for ``flush``, which is
    absolute, and ``overflow``, a limit.
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
    """Return every error constant of the splat kernels, with its count of roundings and label of design.md."""
    return Charges(
        flush=a.flush, overflow=a.overflow, **_gaussian_charges(a), **_color_charges(a.unit), **_pixel_charges(a)
    )


def _gaussian_charges(a: Arithmetic) -> dict[str, float]:
    u = a.unit
    return {
        # G2: R and C to float32, -R C, R mu, the last sum: 6 on |R||C|; 4 to spare
        "camera_coordinate": 10.0 * u,
        # G5: 1/z, and what is of second order
        "reciprocal_depth": (a.division + 1.0) * u,
        # G5: a product, and what is of second order
        "ratio": 2.0 * u,
        # G5: focal length and centre to float32, two products, a sum: 5; 3 to spare
        "mean": 8.0 * u,
        # G6: of the clamp's limits: divisions and products of the intrinsics, 8
        "clamp": 8.0 * u,
        # G6: focal length, clamped ratio, three products: 5; 3 to spare
        "jacobian": 8.0 * u,
        # G11: R rounded twice
        "rotation": 2.0 * u,
        # G6: 1/|q|: half of 4, rsqrt; a component: 1; products of two: 1; twice, their sum and 1: 33; 19 see there
        "rotation_entry": (2.0 * (2.0 * (3.0 + a.rsqrt) + 2.0) + 1.0 + 19.0) * u,
        # G6: products and sums of M M^T: 5 of 13, the others are in ``rotation_entry``
        "covariance_products": 5.0 * u,
        # G6: R twice, two products of matrices, two with J: 14; 6.5 to spare
        "covariance": 20.5 * u,
        # G6: of |Sigma| where its own error multiplies another
        "covariance_size": 64.0 * u,
        "covariance_size_products": 8.0 * u,
        # G6: 0.3 to float32, its sum
        "blur": 2.0 * u,
        # G8: two products, a difference, of ac + b^2: 3; 3 to spare
        "determinant": 6.0 * u,
        # G8: a sum, a product, 2 to spare; a square, a difference, 2 to spare
        "half_trace": 4.0 * u,
        "discriminant": 4.0 * u,
        # G8: a root and the sums and products beside it, as much again
        "radius": 2.0 * a.sqrt * u,
        # G7: 28 and 8; 44 to spare
        "conic": 80.0 * u,
        # G11: five products of matrices of three: 15; 1 to spare
        "gram": 16.0 * u,
        # G11: a division under the root, the root, the product with the opacity, 1 to spare
        "compensation": (0.5 * a.division + a.sqrt + 2.0) * u,
        # G9: 0.01 to float32; 3 to spare
        "near": 4.0 * u,
        # G8: mean -+ radius, 1; a division by 16, 4; 3 to spare
        "tile": 8.0 * u,
        # G9: a sigmoid is an exponential, a sum and a division; 3 to spare
        "opacity": (a.exp + 1.0 + a.division + 3.0) * u,
        # G9: __expf of at most 5.55, below 18, the product, the opacity; 33 to spare
        "exponent_limit": 64.0 * u,
        # G10: a product and two sums, 3, on |R||mu|; the last sum, 1, on z; second order
        "depth_products": 4.2 * u,
        "depth": 1.1 * u,
        # O1: R rounded twice, its product with the difference; 1 to spare
        "viewing_axis": 4.0 * u,
    }


def _color_charges(u: float) -> dict[str, float]:
    return {
        # C3: torch.inverse of the view matrix, of 1 + |T|
        "camera_position": 80.0 * u,
        # C3: mean minus camera, of |mean|
        "direction_mean": 2.0 * u,
        # C3: a normalised direction
        "direction": 16.0 * u,
        # C3: a basis function's polynomial, its product, 16 sums, of sum |sh| |basis|; the sum with 0.5
        "harmonics": 40.0 * u,
        "color_sum": u,
        # S4: a sum of colour and shift, the ends' own rounding
        "shifted_color": 4.0 * u,
        # C1: a product and a sum, or a sigmoid, at most 5; 3 to spare
        "plain_color": 8.0 * u,
    }


def _pixel_charges(a: Arithmetic) -> dict[str, float]:
    u = a.unit
    # what the package's own float64 evaluation of the same formula adds to each rounding
    both = u + 8.0 * UNIT64
    by_argument = a.fast_exp_per_unit_argument + 0.654
    return {
        # B4: a constant in the program's format, 1; a comparison is exact
        "threshold": 2.0 * u,
        # B3: __expf at 0, the product with the opacity; 25 to spare
        "exponential": (a.fast_exp + 1.0 + 25.0) * u,
        # B3: what __expf adds for each unit of the exponent, at its least and over its range
        "exponential_by_argument": by_argument * u,
        "exponential_by_range": 2.0 * by_argument * u,
        # B5, B6: a difference and a product of the running transmittance, 2; the stop's constant, 1
        "transmittance": 8.0 * u,
        # B6: what the light that a stop leaves may be off by: two steps and the threshold, 5
        "lost_light": 16.0 * u,
        # B8: a product with alpha, one with the light, a sum
        "blend_fragment": 3.0 * both,
        # B8: the background's product and sum, the clamp: 6; 10 to spare
        "blend_pixel": 16.0 * both,
        # B8: a sum, for each fragment that is left out
        "left_out": both,
        # D4: a division; a constant below it, 1
        "expected_depth": (a.division + 1.0) * u,
    }
