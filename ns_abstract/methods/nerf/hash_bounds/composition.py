"""Composites the colours of rays from transmittances and sample colours, as intervals and forms (design.md, F8, H7).

``light`` is a `Light`, ``count`` the number N of its intervals, ``line`` as in `forms`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import HASH_LIGHT_ROUNDING, HASH_SAMPLE_ROUNDING, HASH_UP
from ns_abstract.methods.nerf.hash_bounds.forms import UNCOUNTED, exp_above, exp_below, pose_range
from ns_abstract.methods.nerf.hash_bounds.light import depths_functional, times
from ns_abstract.methods.nerf.hsv import shift_box


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def interval_colors(light, count, low, high, background, last, out):
    """Write bounds ``out`` [2, 3] of a ray's colour from bounds of its samples alone (design.md, F8).

    ``low`` and ``high`` [N, 3] bound the samples' colours. With ``last``, the last sample's colour is the background,
    and ``background`` [3] is not used.
    """
    for c in range(3):
        out[0, c] = low[count - 1, c] if last else background[c]
        out[1, c] = high[count - 1, c] if last else background[c]
    for i in range(count - 1, -1, -1):
        least = max(1.0 - exp_above(-light.least[i]), 0.0)
        most = 1.0 - exp_below(-light.most[i])
        for c in range(3):
            rise, fall = high[i, c] - out[1, c], low[i, c] - out[0, c]
            out[1, c] += (most if rise > 0.0 else least) * rise
            out[0, c] += (most if fall < 0.0 else least) * fall
    slack = HASH_SAMPLE_ROUNDING * (count + 4.0)
    for c in range(3):
        out[0, c] -= slack
        out[1, c] += slack


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def shifted_interval_colors(light, count, colors, shift, background, last, room, out):
    """Do `interval_colors` [2, 3] with hue and saturation added to all samples' colours (design.md, F9).

    ``colors`` [2, N, 3] are bounds of colours before the ``shift`` [2, 2], intervals of hue (turns) and saturation;
    ``room`` [2, N, 3] is scratch, ``out`` [2, 3] in [0, 1].
    """
    for i in range(count):
        shift_box(colors[0, i], colors[1, i], shift[0], shift[1], room[0, i], room[1, i])
    interval_colors(light, count, room[0], room[1], background, last, out)
    for c in range(3):
        out[0, c], out[1, c] = min(max(out[0, c], 0.0), 1.0), min(max(out[1, c], 0.0), 1.0)
        if not out[0, c] <= out[1, c]:
            out[0, c], out[1, c] = 0.0, 1.0


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def weight_bounds(light, i, last):
    """Return bounds of the weight of sample i; with ``last``, the last sample's weight includes the background's."""
    if last:
        return light.left[i, 0], light.left[i, 1]
    low = light.left[i, 0] * max(1.0 - exp_above(-light.least[i]), 0.0)
    high = light.left[i, 1] * (1.0 - exp_below(-light.most[i]))
    return max(low - HASH_LIGHT_ROUNDING, 0.0), high + HASH_LIGHT_ROUNDING


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _products(light, count, i, whole, color, line):
    """Return the product of the deviations of sample i's weight and colour: centre's shift, its coefficient, rest.

    Args:
        light, count: `Light` and N.
        whole: Whether all light that reaches the sample is its weight.
        color: [n + 4] the deviation of its colour: symbols and radius.
    """
    n = color.shape[0] - 4
    here, there = light.light[i], light.light[i + 1]
    slope = 0.0 if whole else there[1]
    center = here[0] if whole else here[0] - there[0]
    low, high = weight_bounds(light, i, whole)
    reach = 0.0
    for s in range(1, n + 4):
        reach += abs(color[s])
    apart = max(high - center, center - low) * reach
    if not line:
        return 0.0, 0.0, apart
    moved = slope * light.total[i + 1, 1] - here[1] * light.total[i, 1]
    other = abs(slope * light.total[i + 1, 2] - here[1] * light.total[i, 2]) + here[3]
    other += abs(here[2]) if whole else there[3] + abs(there[2] - here[2])
    other += depths_functional(light, i + 1, i, 0.0, -here[1], slope, (0.0, 0.0), 1.0)
    bend = moved * color[1]
    followed = abs(moved) * (reach - abs(color[1])) + other * reach
    if followed < apart:
        return 0.5 * bend, 0.5 * bend, followed
    return 0.0, 0.0, apart


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def form_color(light, count, colors, background, last, line, out):
    """Write one channel of a ray's colour as a form (design.md, H7); ``last``, ``background``: see `interval_colors`.

    ``colors`` [N, n + 4] are forms with the symbols of the samples' starts and ends, and radii; ``out`` [n + 3]
    receives the centre, pose symbols, and the radius in the last place.
    """
    n = colors.shape[1] - 4
    out[:] = 0.0
    center, rest, own = colors[0, 0], 0.0, 0.0
    # what the colour gains by a unit of the depth of sample i: the light that then is lost behind it
    gain, ahead = 0.0, 0.0
    for i in range(count - 1, -1, -1):
        k = i + 1
        whole = last and k == count
        behind, here = light.light[k], light.light[i]
        if not whole:
            step = (background if k == count else colors[k, 0]) - colors[i, 0]
            center += behind[0] * step
            gain -= behind[1] * step
            rest += times(step, behind[3]) if step > 0.0 else times(-step, behind[3])
            if line:
                out[2] += behind[2] * step
        weight = here[0] if whole else here[0] - behind[0]
        for s in range(1, n + 1):
            out[s] += gain * light.depth[i, s] + weight * colors[i, s]
        rest += times(abs(gain), light.depth[i, n + 3]) + abs(weight) * colors[i, n + 3]
        # the symbol of the edge behind the sample: of this sample and of the next
        rest += abs(gain * light.depth[i, n + 2] + weight * colors[i, n + 2] + ahead)
        ahead = gain * light.depth[i, n + 1] + weight * colors[i, n + 1]
        shift, bend, products = _products(light, count, i, whole, colors[i], line)
        own += shift
        if line:
            out[2] += bend
        rest += products
    rest += abs(ahead)
    out[0] = center + own
    size = abs(center) + abs(own) + rest + 1.0
    out[n + 2] = (rest + HASH_SAMPLE_ROUNDING * (count + 4.0) * size) * HASH_UP


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def form_bounds(form, line):
    """Return bounds of a form of `form_color`; infinite ones where it is not finite."""
    n = form.shape[0] - 3
    low, high = pose_range(form, line, n)
    rest = form[n + 2] + HASH_LIGHT_ROUNDING * (abs(low) + abs(high) + abs(form[0]))
    if not rest < np.inf:
        return -np.inf, np.inf
    return form[0] + low - rest, form[0] + high + rest
