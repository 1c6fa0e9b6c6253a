"""Sine and cosine of forms."""

from __future__ import annotations

import numpy as np

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import Float64Array
from ns_abstract.arithmetic.rounding import ANGLE_ROUNDING, FUNCTION_ROUNDING


def _cosine_range(low: Float64Array, high: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return bounds of cos over [low, high], rounded outward by four units."""
    at_low, at_high = np.cos(low), np.cos(high)
    least = np.minimum(at_low, at_high) - FUNCTION_ROUNDING
    most = np.maximum(at_low, at_high) + FUNCTION_ROUNDING
    # a multiple of 2 pi (or an odd multiple of pi) inside, tested with room for the rounding of pi
    slack = ANGLE_ROUNDING * (np.abs(low) + np.abs(high) + 1.0)
    turn = 2 * np.pi
    has_top = np.floor((high + slack) / turn) >= np.ceil((low - slack) / turn)
    has_bottom = np.floor((high + slack) / turn - 0.5) >= np.ceil((low - slack) / turn - 0.5)
    return np.where(has_bottom, -1.0, np.maximum(least, -1.0)), np.where(has_top, 1.0, np.minimum(most, 1.0))


def cos_sin(angle: FormArray) -> tuple[FormArray, FormArray]:
    """Return the cosine and sine of an angle in radians (design.md, A3 with |f'''| <= 1).

    The angle is taken to carry an absolute error of four units of ``|angle| + 1``, which covers
    its computation from a parameter and the library's sine and cosine.
    """
    low, high = angle.bounds()
    middle = angle.center
    cosine, sine = np.cos(middle), np.sin(middle)
    slack = ANGLE_ROUNDING * (np.abs(middle) + 2.0)
    if angle.basis.order == 2:
        cos_form = angle.compose(cosine, -sine, -0.5 * cosine, -0.5 * cosine, 1.0 / 6.0)
        sin_form = angle.compose(sine, cosine, -0.5 * sine, -0.5 * sine, 1.0 / 6.0)
    else:
        cos_low, cos_high = _cosine_range(low, high)
        sin_low, sin_high = _cosine_range(low - np.pi / 2, high - np.pi / 2)
        cos_form = angle.compose(cosine, -sine, -0.5 * cos_high, -0.5 * cos_low, 0.0)
        sin_form = angle.compose(sine, cosine, -0.5 * sin_high, -0.5 * sin_low, 0.0)
    for form in (cos_form, sin_form):
        form.data[form.basis.monomials] += np.ravel(slack)
    return cos_form, sin_form
