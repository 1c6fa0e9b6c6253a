"""Kernels for (leaky) ReLU lines with optimised slopes, and for values along these lines (design.md, N14, N16)."""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.network_charges import OWN_SUMS
from ns_abstract.arithmetic.simd.intrinsics import pointer


@njit(cache=True, error_model="numpy", nogil=True)
def _shifted(slope, low, high, size, unit, outward):
    """Return offsets below and above, relative to the references, of a line with stored ``slope`` (N4).

    Args:
        slope, low, high: The line's slope, and bounds of the function less the line.
        size: Magnitude of the terms of which ``low`` and ``high`` are sums.
        unit: As in `write_relu_lines`, of one neuron.
        outward: As in `write_relu_lines`.
    """
    lower, upper, reference, image, loose, room = unit
    base = slope * reference - image
    own = abs(reference) + abs(lower) + abs(upper)
    give = abs(slope) * loose + room + OWN_SUMS * (abs(image) + abs(low) + abs(high))
    give += OWN_SUMS * (size + abs(slope) * own)
    below, above = low + base - give, high + base + give
    return below - (outward[0] * abs(below) + outward[1]), above + (outward[0] * abs(above) + outward[1])


@njit(cache=True, error_model="numpy", nogil=True)
def write_relu_lines(parameter, phases, alpha, flat, units, outward, stored, lines):
    """Write the lines of unstable neurons for optimised slopes, or the exact piece where a row assumes the phase.

    Args:
        parameter: [R, U] optimised slopes of R rows at U neurons.
        phases: [R, U] 1 or -1 where a row assumes the neuron's phase, else 0; [0, U]: no row assumes any.
        alpha: The slope of the (leaky) ReLU below zero.
        flat: [U] flat positions of the neurons in the map.
        units: [6, U] lower bound, upper bound, reference of the input, reference of the result, charge per slope, and
            constant charge.
        outward: Relative and absolute amount by which an offset is moved outward before it is stored.
        stored: [R, U] of the lines' type: memory for slopes.
        lines: [6, R, N] as in `pass_activation`; written at the neurons.
    """
    count, width = parameter.shape
    for r in range(count):
        for u in range(width):
            lower, upper, at = units[0, u], units[1, u], flat[u]
            unit = lower, upper, units[2, u], units[3, u], units[4, u], units[5, u]
            side = phases[r, u] if len(phases) else 0
            exact = 1.0 if side > 0 else alpha
            stored[r, u] = parameter[r, u] if side == 0 else exact
            slope = float(stored[r, u])
            if side == 0:
                # the function is convex: above a line by most at an end, below it at the kink or, past the limits, at
                # an end
                one, two = alpha * lower - slope * lower, upper - slope * upper
                below, above = _shifted(slope, min(one, two, 0.0), max(one, two), upper - lower, unit, outward)
            else:
                # between 0 and the end on that side
                end = (exact - slope) * (upper if side > 0 else lower)
                below, above = _shifted(slope, min(end, 0.0), max(end, 0.0), upper - lower, unit, outward)
                lines[3, r, at], lines[4, r, at], lines[5, r, at] = stored[r, u], above, below
            lines[0, r, at], lines[1, r, at], lines[2, r, at] = stored[r, u], below, above


@njit(cache=True, error_model="numpy", nogil=True)
def along_lines(coefficients, values, lines, result):
    """Write to ``result`` the outputs [R, N] of the lines that ``coefficients`` [R, N] apply, at inputs ``values``.

    ``lines``: [6, R or 1, N] as in `pass_activation`.
    """
    count, size = coefficients.shape
    own = lines.shape[1] > 1
    plane = lines.shape[1] * size
    coefficient, value, line, target = pointer(coefficients), pointer(values), pointer(lines), pointer(result)
    for r in range(count):
        here, at = (r * size if own else 0), r * size
        for j in range(size):
            k = here + j
            s0, l0, s1, l1 = line[k], line[k + plane], line[k + 3 * plane], line[k + 4 * plane]
            positive = coefficient[at + j] >= 0.0
            target[at + j] = (s0 if positive else s1) * value[at + j] + (l0 if positive else l1)
