"""Mutation check of the soundness tests: each planted fault must be caught by the test named beside it.

Every mutant is one change of one file of a copy of the package, and one test that has to fail on it. Those below
name the text to change, those of the folder `planted` a function and an expression or statement in it.
The compiled kernels run interpreted (NUMBA_DISABLE_JIT=1), so that nothing is compiled per mutant; ``--compiled``
compiles instead, into a cache of each mutant's own. Each test is also run once on the unchanged copy, where it
has to pass.

    python benchmarks/mutants.py [--only NAME ...] [--compiled] [--list]

writes benchmarks/mutants.md and exits with 1 if a mutant survives.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from planted import FAULTS, Fault, apply

ROOT = Path(__file__).resolve().parents[1]
REPORT = Path(__file__).with_suffix(".md")
_TIMEOUT_S = 600.0
# pytest's exit codes
_PASSED, _FAILED = 0, 1

FORMS = "arithmetic/forms.py"
LINE_FORMS = "arithmetic/line_forms.py"
ELEMENTARY = "arithmetic/elementary.py"
TRIGONOMETRY = "arithmetic/trigonometry.py"
UNITS = "arithmetic/rounding.py"
POSES = "geometry/poses.py"
BOX = "geometry/box.py"
ENGINE = "refine/engine.py"
GAUSSIANS = "methods/splat/gaussians.py"
FORM_PROJECTION = "methods/splat/form_projection.py"
WIDE = "arithmetic/simd/wide_forms.py"
LINE = "methods/splat/line_projection.py"
RECORDS = "methods/splat/records.py"
ALPHAS = "methods/splat/alphas.py"
FRAGMENTS = "methods/splat/fragments.py"
BLEND = "methods/splat/blend.py"
BLOCK = "methods/splat/block.py"
BOUNDS = "methods/splat/bounds.py"
COLORS = "methods/splat/colors.py"
FORM_COLORS = "methods/splat/form_colors.py"
LINE_COLORS = "methods/splat/line_colors.py"
NETWORK = "verify/network/bounds.py"


@dataclass(frozen=True)
class Mutant:
    """One planted fault.

    Attributes:
        name: What is wrong, in a few words.
        file: The mutated file, relative to the package.
        old: Text that stands in it exactly once.
        new: What replaces it.
        test: The test that has to fail, as pytest names it, relative to ``tests``.
    """

    name: str
    file: str
    old: str
    new: str
    test: str


MUTANTS = (
    # forms: remainders, signs, roundings
    Mutant(
        "product drops the linear terms' remainder",
        FORMS,
        "        for q in range(n):\n            out[m, q] += a[m + 1, q] * b[m + 1, q]\n"
        "        for k in range(1, d + 1):\n            for q in range(n):\n                half = ",
        "        for k in range(1, d + 1):\n            for q in range(n):\n                half = ",
        "test_forms.py::test_binary_contains[plain-mul-d2o1]",
    ),
    Mutant(
        "product drops one operand's radius",
        FORMS,
        "out[m, q] = pa * b[m, q] + pb * a[m, q] + a[m, q] * b[m, q] + _COEFFICIENT * (pa * pb)",
        "out[m, q] = pa * b[m, q] + a[m, q] * b[m, q] + _COEFFICIENT * (pa * pb)",
        "test_forms.py::test_binary_contains[plain-mul-d1o2]",
    ),
    Mutant(
        "product's rounding is dropped",
        FORMS,
        "pb * a[m, q] + a[m, q] * b[m, q] + _COEFFICIENT * (pa * pb)\n        out[0, q]",
        "pb * a[m, q] + a[m, q] * b[m, q]\n        out[0, q]",
        "test_forms.py::test_binary_contains[exact-mul-d2o2]",
    ),
    Mutant(
        "sum's rounding is dropped",
        FORMS,
        "absolute_t * b[m, q] + _COEFFICIENT * magnitude)",
        "absolute_t * b[m, q])",
        "test_forms.py::test_binary_contains[exact-scale_add-d3o1]",
    ),
    Mutant(
        "accumulated product's rounding is dropped",
        FORMS,
        "a[m, q] * b[m, q] + 4.0 * _COEFFICIENT * (pa * pb)",
        "a[m, q] * b[m, q]",
        "test_forms.py::test_binary_contains[exact-three_products-d2o2]",
    ),
    Mutant(
        "underflow is not charged",
        UNITS,
        "UNDERFLOW64 = 2.0**-1060",
        "UNDERFLOW64 = 0.0",
        "test_forms.py::test_binary_contains[tiny-mul-d2o2]",
    ),
    Mutant(
        "row sums are not rounded up",
        FORMS,
        "        out[m + 1, q] *= _UP\n        out[m + 2, q] *= _UP",
        "        pass",
        "test_forms.py::test_settle[d6o2]",
    ),
    Mutant(
        "second derivative's bounds are swapped",
        FORMS,
        "            low = min(0.0, f2_low[q]) * (e * e)\n            high = max(0.0, f2_high[q]) * (e * e)",
        "            low = min(0.0, f2_high[q]) * (e * e)\n            high = max(0.0, f2_low[q]) * (e * e)",
        "test_forms.py::test_function_contains[plain-rsqrt-d2o1]",
    ),
    Mutant(
        "reciprocal takes its remainder at the far end",
        FORMS,
        "work[4, q] = 1.0 / (low2 * low2) * _UP if inside else np.inf",
        "work[4, q] = 1.0 / (c * c * c * c) * _UP if inside else np.inf",
        "test_forms.py::test_function_contains[plain-reciprocal-d1o2]",
    ),
    Mutant(
        "third-order remainder is dropped",
        FORMS,
        " + f3[q] * e * e * e + rounding",
        " + rounding",
        "test_forms.py::test_compose[d2o2]",
    ),
    Mutant(
        "reciprocal accepts 0",
        FORMS,
        "work[3, q] = 1.0 / (low * low * low) * _UP if inside else np.inf",
        "work[3, q] = 1.0 / (low * low * low) * _UP",
        "test_forms.py::test_domain[reciprocal-d1o1]",
    ),
    Mutant(
        "bounds ignore the vertex",
        FORMS,
        "            if abs(g) < 2.0 * abs(s):\n",
        "            if False:\n",
        "test_forms.py::test_bounds[d2o2]",
    ),
    Mutant(
        "bounds take the vertex for the wrong side",
        FORMS,
        "                if s > 0.0:\n                    bottom = vertex",
        "                if s < 0.0:\n                    bottom = vertex",
        "test_forms.py::test_bounds[d1o2]",
    ),
    Mutant(
        "bounds forget the mixed terms",
        FORMS,
        "                high[q] += abs(a[row, q])\n                low[q] -= abs(a[row, q])",
        "                pass",
        "test_forms.py::test_bounds[d3o2]",
    ),
    Mutant(
        "clamp's chord starts at the wrong end",
        FORMS,
        "s = above / (above + below)",
        "s = below / (above + below)",
        "test_forms.py::test_clamp_below[0.0-d2o1]",
    ),
    Mutant(
        "clamp keeps half the chord's error",
        FORMS,
        "a[m, q] = (s * a[m, q] + shift + ",
        "a[m, q] = (s * a[m, q] + 0.5 * shift + ",
        "test_forms.py::test_clamp_below[0.0-d1o1]",
    ),
    Mutant(
        "exponential loses its last term",
        ELEMENTARY,
        "    c = fma(r4, _C12, c)\n",
        "",
        "test_elementary.py::test_exp_hard",
    ),
    Mutant(
        "exponential reduces with one part of ln 2",
        ELEMENTARY,
        "    r = fma(-k, _LN2_LOW, r)\n",
        "",
        "test_elementary.py::test_exp_any",
    ),
    # sets of poses
    Mutant(
        "cosine misses its maximum in a cell",
        TRIGONOMETRY,
        "np.where(has_top, 1.0, np.minimum(most, 1.0))",
        "np.minimum(most, 1.0)",
        "test_elementary.py::test_cos_sin_dense[1]",
    ),
    Mutant(
        "angle's rounding is dropped",
        TRIGONOMETRY,
        "slack = 8 * UNIT64 * (np.abs(middle) + 2.0)",
        "slack = 0.0 * middle",
        "test_elementary.py::test_cos_sin_absolute_error",
    ),
    Mutant(
        "rotations in the wrong order",
        "perturbation/specification.py",
        'ROTATIONS = ("yaw", "pitch", "roll")',
        'ROTATIONS = ("pitch", "yaw", "roll")',
        "test_poses.py::test_enclosure[six-1]",
    ),
    Mutant(
        "camera's translation in world axes",
        POSES,
        "position = position + rotation[:, k] * shift",
        "position = position + shift * np.eye(3)[k]",
        "test_poses.py::test_enclosure[translation-1]",
    ),
    Mutant(
        "offset ignores the camera's motion",
        POSES,
        "offset = world_to_camera @ (origin - position)",
        "offset = world_to_camera @ (origin - position.center)",
        "test_poses.py::test_enclosure[x-1]",
    ),
    Mutant(
        "orbit about the origin",
        POSES,
        "turn @ rotation, turn @ (position - target) + target",
        "turn @ rotation, turn @ position",
        "test_poses.py::test_enclosure[orbit_six-2]",
    ),
    Mutant(
        "slanted box loses its ends",
        POSES,
        "box = box.replace(axis, low - sum(b for _, b in ends) - room, high - sum(a for a, _ in ends) + room)",
        "box = box.replace(axis, low - room, high + room)",
        "test_slanted.py::test_every_pose_has_slanted_parameters[six]",
    ),
    Mutant(
        "slanted cells are bounded upright",
        POSES,
        "found = found + plain(other) * factor",
        "found = found - plain(other) * factor",
        "test_slanted.py::test_enclosure[six-1]",
    ),
    Mutant(
        "feasible part forgets the other terms",
        POSES,
        "bottom, top = low - room - (most - ends[i][1]), high + room - (least - ends[i][0])",
        "bottom, top = low - room, high + room",
        "test_slanted.py::test_feasible_loses_no_pose[six]",
    ),
    Mutant(
        "a part is dropped where some of its poses are none of the set's",
        ENGINE,
        "            if inside is not None:\n                first",
        "            if inside == box:\n                first",
        "test_engine.py::test_parts_without_poses_take_no_work_and_leave_nothing_open[True-0.0]",
    ),
    Mutant(
        "split leaves a gap",
        BOX,
        "[self.replace(axis, ends[i], ends[i + 1]) for i in range(parts)]",
        "[self.replace(axis, ends[i], min(ends[i + 1], high - (high - low) * 1e-9)) for i in range(parts)]",
        "test_box.py::test_split",
    ),
    # forms of one parameter
    Mutant(
        "one parameter: product without its slopes' product",
        LINE_FORMS,
        "a[0] * b[2] + b[0] * a[2] + a[1] * b[1],",
        "a[0] * b[2] + b[0] * a[2],",
        "test_line_forms.py::test_pairs[multiplied-plain]",
    ),
    Mutant(
        "one parameter: third order is dropped",
        LINE_FORMS,
        " + f3 * e * e * e + rounding",
        " + rounding",
        "test_line_forms.py::test_functions[inverse-exact]",
    ),
    Mutant(
        "one parameter: rounding of products is dropped",
        LINE_FORMS,
        " + _COEFFICIENT * (pa * pb) + l * w",
        " + l * w",
        "test_line_forms.py::test_pairs[multiplied-constant]",
    ),
    Mutant(
        "one parameter: the vertex is no end",
        LINE_FORMS,
        "    inside = g < 2.0 * abs(s)\n",
        "    inside = False\n",
        "test_line_forms.py::test_ends[exact]",
    ),
    Mutant(
        "one parameter: a clamp without its chord",
        LINE_FORMS,
        "    shift = 0.5 * (s * below)\n",
        "    shift = 0.0 * (s * below)\n",
        "test_line_forms.py::test_raised[exact-0.0]",
    ),
    # Gaussians
    Mutant(
        "near plane is not uncertain",
        RECORDS,
        "front = (s[ZLOW + q] >= near * (1.0 + charges.near)) & (z_high < np.inf)",
        "front = (s[ZLOW + q] > 0.0) & (z_high < np.inf)",
        "test_bounds.py::test_near_plane_alone[2]",
    ),
    Mutant(
        "near plane culls what crosses it",
        GAUSSIANS,
        "gone = (farthest + spread_z < rules.near)",
        "gone = (nearest + spread_z < rules.near)",
        "test_bounds.py::test_near_plane[2]",
    ),
    Mutant(
        "tile cut-off taken for sure",
        FRAGMENTS,
        "core[0] <= place.tile_x\n                and place.tile_x < core[1]",
        "True",
        "test_bounds.py::test_tile_cut[2]",
    ),
    Mutant(
        "tile cut-off by the smallest radius",
        RECORDS,
        "left, right = mean_x_low - radius_high - snap_x, mean_x_high + radius_high + snap_x",
        "left, right = mean_x_low - radius_low + 1.0, mean_x_high + radius_low - 1.0",
        "test_bounds.py::test_tile_cut[1]",
    ),
    Mutant(
        "Jacobian without its clamp",
        FORM_PROJECTION,
        "        # the Jacobian's clamped ratios\n        if margin >= 0.0:",
        "        if False:",
        "test_bounds.py::test_jacobian_clamp[1]",
    ),
    Mutant(
        "Jacobian without its clamp, one parameter",
        LINE,
        "    left, right, top, bottom = np.inf, np.inf, np.inf, np.inf\n    if margin >= 0.0:",
        "    left, right, top, bottom = np.inf, np.inf, np.inf, np.inf\n    if False:",
        "test_bounds.py::test_jacobian_clamp[2]",
    ),
    Mutant(
        "clamped on one side only, one parameter",
        LINE,
        "    a = raised((-a[0], -a[1], -a[2], a[3]), -limit_high, -high, -low)\n",
        "    a = (-a[0], -a[1], -a[2], a[3])\n",
        "test_bounds.py::test_jacobian_clamp_all_sides[2]",
    ),
    Mutant(
        "clamped on one side only",
        WIDE,
        "    if bits(high > limit_high) != 0:",
        "    if False:",
        "test_bounds.py::test_jacobian_clamp_all_sides[1]",
    ),
    Mutant(
        "no compensation when antialiased",
        FORM_PROJECTION,
        "scale_add(w, _LOG * one, -0.5, _LOG * one, 0.0, 0.0, k, d, order, m)",
        "scale_add(w, _LOG * one, 0.0, _LOG * one, 0.0, 0.0, k, d, order, m)",
        "test_bounds.py::test_antialiased[1]",
    ),
    Mutant(
        "no compensation when antialiased, one parameter",
        LINE,
        "store(scaled((out[0, q], out[1, q], out[2, q], out[3, q]), -0.5)",
        "store(scaled((out[0, q], out[1, q], out[2, q], out[3, q]), 0.0)",
        "test_bounds.py::test_antialiased[2]",
    ),
    Mutant(
        "compensation without its additive error",
        RECORDS,
        "        error = 1.01 * (error + charges.determinant * (a + error_a) * (c + error_c) + flush) / det\n",
        "        error = 0.0\n",
        "test_antialiased.py::test_computed_factor[thin-one pose]",
    ),
    Mutant(
        "compensation without a form not lowered",
        RECORDS,
        "* shrink if formed else bottom",
        "* shrink if formed else top",
        "test_antialiased.py::test_computed_factor[thin-one pose]",
    ),
    Mutant(
        "compensation beside its form not raised",
        RECORDS,
        "        s[CHIGH + q] = np.sqrt((1.0 + change) / (1.0 - spread)) * grow if formed else top\n",
        "        s[CHIGH + q] = 1.0 if formed else top\n",
        "test_antialiased.py::test_computed_factor[thin-x]",
    ),
    Mutant(
        "compensated twice where its form is of no use",
        GAUSSIANS,
        "store(s, at, where(formless, 0.0, load8(s, at)))",
        "store(s, at, load8(s, at))",
        "test_antialiased.py::test_computed_factor[thin-one pose]",
    ),
    Mutant(
        "compensated layers dropped too early",
        RECORDS,
        "gone = gone | (all_of_it * (1.0 + charges.faint) < alpha_min)",
        "gone = gone | (0.9 * all_of_it * (1.0 + charges.faint) < alpha_min)",
        "test_antialiased.py::test_computed_factor[tiny-x]",
    ),
    Mutant(
        "compensated layers reach too few pixels",
        RECORDS,
        "reached = faint + s[CTOPLOG + q]",
        "reached = faint + 1.5 * s[CTOPLOG + q]",
        "test_antialiased.py::test_pictures[x]",
    ),
    Mutant(
        "blur left out of the determinant",
        FORM_PROJECTION,
        "        add_product(w, t1, z2, 1.0, det, d, order, m)\n",
        "",
        "test_bounds.py::test_depth_swap[1]",
    ),
    Mutant(
        "blur left out of the determinant, one parameter",
        LINE,
        "det = combined(k, 1.0, multiplied(blurred, z2), 1.0)",
        "det = k",
        "test_bounds.py::test_depth_swap[2]",
    ),
    Mutant(
        "a ratio's slope has the wrong sign",
        LINE,
        "n00 = _lowered(_rotated(r0, b0, b1, b2, still, 0.0, 0.0), u, deep)",
        "n00 = _lowered(_rotated(r0, b0, b1, b2, still, 0.0, 0.0), (u[0], -u[1], u[2], u[3]), deep)",
        "test_bounds.py::test_needle[2]",
    ),
    Mutant(
        "the vertical ratio's slope has the wrong sign",
        LINE,
        "n10 = _lowered(_rotated(r1, b0, b1, b2, still, 0.0, 0.0), v, deep)\n        b0, b1, b2 = s[row.B01",
        "n10 = _lowered(_rotated(r1, b0, b1, b2, still, 0.0, 0.0), (v[0], -v[1], v[2], v[3]), deep)\n"
        "        b0, b1, b2 = s[row.B01",
        "test_bounds.py::test_needle[2]",
    ),
    Mutant(
        "a product of eight forms drops what linear terms make",
        WIDE,
        "        radius = radius + la * lb\n",
        "",
        "test_wide_forms.py::test_pairs",
    ),
    Mutant(
        "a Gaussian's reach without its mean's error",
        GAUSSIANS,
        "                spread = spread + mean_error\n",
        "",
        "test_bounds.py::test_reach_counts_every_error",
    ),
    Mutant(
        "pixels are blended as others",
        BLEND,
        "        row, column = above + q // BLOCK, left + q % BLOCK",
        "        row, column = above + q // BLOCK, left + BLOCK - 1 - q % BLOCK",
        "test_bounds.py::test_one_layer[2]",
    ),
    Mutant(
        "region of pixels without the mean's range",
        RECORDS,
        "left, right = mean_x_low - extent_x, mean_x_high + extent_x",
        "left, right = mean_x_low - extent_x, mean_x_low + extent_x",
        "test_bounds.py::test_alpha_threshold_of_all[2]",
    ),
    # pixels
    Mutant(
        "order swap is ignored",
        FRAGMENTS,
        "    return not (abs(center) > (spread + radius)",
        "    return False and not (abs(center) > (spread + radius)",
        "test_bounds.py::test_depth_swap[2]",
    ),
    Mutant(
        "order swap raises but does not lower",
        BLEND,
        "            p0 = p0 + 0.5 * (rises - falls)\n"
        "            r = r + 0.5 * (rises + falls)\n"
        "            ends = _Ends(ends.low - falls,",
        "            p0 = p0 + 0.5 * (rises - falls)\n"
        "            r = r + 0.5 * (rises + falls)\n"
        "            ends = _Ends(ends.low,",
        "test_bounds.py::test_depth_swap[2]",
    ),
    Mutant(
        "equal depths keep the list's order",
        FRAGMENTS,
        "return not (abs(center) > (spread + radius) * UP + rounding + depth_error[i] + depth_error[j])",
        "return center != 0.0 and not (\n"
        "        abs(center) > (spread + radius) * UP + rounding + depth_error[i] + depth_error[j])",
        "test_bounds.py::test_ties[2]",
    ),
    Mutant(
        "layers of one mean keep their order though it varies",
        BOUNDS,
        "return self.varied.mean_radius.shape[0] == 0 and self._least_step",
        "return self._least_step",
        "test_variations.py::test_one_mean_that_varies",
    ),
    Mutant(
        "means are taken for one that the camera cannot tell apart",
        BOUNDS,
        "self._least_step > 4.0 * UNIT64 * largest",
        "True",
        "test_bounds.py::test_nearly_coincident",
    ),
    Mutant(
        "antichain sorted the wrong way",
        BLEND,
        "keys[e] = colors[ends] if side == 0 else -colors[ends + 4]",
        "keys[e] = -colors[ends] if side == 0 else colors[ends + 4]",
        "test_bounds.py::test_three_layers_swap[1]",
    ),
    Mutant(
        "layers that share a pixel are taken for apart",
        FRAGMENTS,
        "shown & int(theirs) == 0",
        "shown & int(theirs) & 1 == 0",
        "test_bounds.py::test_depth_swap[2]",
    ),
    Mutant(
        "order swap counts at the first pixel only",
        BLEND,
        "both = reordering.drawn[front] & reordering.drawn[back]",
        "both = reordering.drawn[front] & reordering.drawn[back] & 1",
        "test_bounds.py::test_depth_swap[2]",
    ),
    Mutant(
        "1/255 is not a jump",
        ALPHAS,
        "jump = where(skips, minimum(limits.alpha_min_high, a_high), 0.0)",
        "jump = 0.0 * a_high",
        "test_bounds.py::test_alpha_threshold[2]",
    ),
    Mutant(
        "1/255 does not make 0 possible",
        ALPHAS,
        "a_low = where(skips, 0.0, limits.sure * a_low)",
        "a_low = limits.sure * a_low",
        "test_bounds.py::test_alpha_threshold[2]",
    ),
    Mutant(
        "0.999 clamp missing from the interval",
        ALPHAS,
        "    a_low = minimum(a_low, alpha_max * (1.0 - charges.threshold))\n",
        "",
        "test_bounds.py::test_alpha_clamp[2]",
    ),
    Mutant(
        "0.999 clamp missing from the form",
        ALPHAS,
        "excess = maximum(0.0, a_high - alpha_max)",
        "excess = 0.0 * a_high",
        "test_bounds.py::test_alpha_clamp_crossed[2]",
    ),
    Mutant(
        "stop ignored",
        FRAGMENTS,
        "        if t_low <= stop.high:",
        "        if False:",
        "test_bounds.py::test_stop[2]",
    ),
    Mutant(
        "what is left out in dim light shows the background",
        BLEND,
        "    if passed > 0.0:",
        "    if False:",
        "test_bounds.py::test_layers_in_dim_light_are_left_out[0.0-False-2]",
    ),
    Mutant(
        "light that comes to what is left out by its least",
        FRAGMENTS,
        "lanes[OPEN + q] = lanes[THI + q]",
        "lanes[OPEN + q] = lanes[TLO + q]",
        "test_bounds.py::test_layers_in_dim_light_are_left_out[1.0-True-2]",
    ),
    Mutant(
        "what is left out is left out of cells inside, too",
        FRAGMENTS,
        "            marks[i] = 1\n        color = advanced",
        "            marks[i] = 0\n        color = advanced",
        "test_bounds.py::test_layers_that_were_left_out_are_there_for_cells_inside[2]",
    ),
    Mutant(
        "left out are layers that may come before listed ones",
        FRAGMENTS,
        "        if lanes[REACH + q] <= k:",
        "        if True:",
        "test_bounds.py::test_left_out_layers_that_swap_with_listed_ones[2]",
    ),
    Mutant(
        "colours are kept where the camera moves",
        BOUNDS,
        "self._seen_from is None or self._seen_from[0] != view",
        "self._seen_from is None",
        "test_bounds.py::test_colors_are_shared_by_cells_that_turn_and_not_by_others",
    ),
    Mutant(
        "stop drops layers that may be drawn",
        FRAGMENTS,
        "        if t_high <= stop.low:",
        "        if t_low <= stop.low:",
        "test_bounds.py::test_stop[2]",
    ),
    Mutant(
        "stop ignored where orders are uncertain",
        FRAGMENTS,
        "            if t_low > stop_high:\n                continue\n            before = e",
        "            if True:\n                continue\n            before = e",
        "test_bounds.py::test_stop_and_swap[2]",
    ),
    Mutant(
        "remainder of the exponential's fit is dropped",
        ALPHAS,
        "    fit = fma(1.2e-4 * x, x2 * x2, fma(1.0 - quadratic, 2.0 * x * j2, fit))",
        "    fit = 0.0 * x",
        "test_bounds.py::test_linear[x-1]",
    ),
    Mutant(
        "exponent's vertex counted for the wrong end",
        BLOCK,
        "bottom = where(inside, minimum(bottom, vertex), bottom)",
        "bottom = top",
        "test_bounds.py::test_one_layer[2]",
    ),
    Mutant(
        "blend picks alpha's other end",
        BLEND,
        "fma(where(v > 0.0, a_high, a_low), v, behind.high)",
        "fma(where(v > 0.0, a_low, a_high), v, behind.high)",
        "test_bounds.py::test_one_layer[2]",
    ),
    Mutant(
        "blend drops the radius of alpha",
        BLEND,
        "fma(values[at + FORM + 3], size, fma(ROUND, fma(1.0 + a1 + a2, size, abs(p0)), added))",
        "fma(ROUND, fma(1.0 + a1 + a2, size, abs(p0)), added)",
        "test_bounds.py::test_linear[x-2]",
    ),
    Mutant(
        "pixels that the batch has hidden take further layers",
        FRAGMENTS,
        "            if live != begun:\n",
        "            if False:\n",
        "test_bounds.py::test_stop_everywhere[2]",
    ),
    Mutant(
        "columns that a Gaussian may reach without the forms' spread",
        FRAGMENTS,
        "half = (root(maximum(rest, 0.0)) + spread1) * inverse * _ROOM",
        "half = root(maximum(rest, 0.0)) * inverse",
        "test_bounds.py::test_alpha_threshold[2]",
    ),
    # colours
    Mutant(
        "colour forms lose their radius",
        FORM_COLORS,
        "+ weight * load8(w, form + 8 * m) + rounding",
        "+ rounding",
        "test_bounds.py::test_view_dependence_alone[1]",
    ),
    Mutant(
        "wrong sign in band 1",
        FORM_COLORS,
        "_scaled(w, y, -0.48860251190292,",
        "_scaled(w, y, 0.48860251190292,",
        "test_bounds.py::test_view_dependence[1-1]",
    ),
    Mutant(
        "wrong sign in band 1, one parameter",
        LINE_COLORS,
        "_multiple(s, n, _Y, -0.48860251190292)",
        "_multiple(s, n, _Y, 0.48860251190292)",
        "test_bounds.py::test_view_dependence[2-2]",
    ),
    Mutant(
        "colours are not clamped at 0",
        COLORS,
        "    clamp_below(form, 0.0, low, high, d, order, m)\n    if least_of",
        "    if least_of",
        "test_bounds.py::test_view_dependence[3-2]",
    ),
    # verdicts
    Mutant(
        "a margin that is no number breaks the property",
        "verify/search.py",
        "return math.isfinite(margin) and margin <= 0.0",
        "return not margin > 0.0",
        "test_certify_search.py::test_network_without_a_number_decides_nothing[nan]",
    ),
    Mutant(
        "a proof outlives the loss of a picture's margin",
        "verify/search.py",
        "                if not cell.undecided:\n                    leaves",
        "                if True:\n                    leaves",
        "test_certify_search.py::test_number_that_is_lost_after_a_proof_takes_it_back[nan]",
    ),
    Mutant(
        "huge factors of a constraint are rescaled without its constant",
        "verify/vnnlib.py",
        "return np.ldexp(row, shift), moved",
        "return np.ldexp(row, shift), constant",
        "test_certify_properties.py::test_vnnlib_factors_change_no_verdict[1e300]",
    ),
    # gsplat's versions, against gsplat's own kernels
    Mutant(
        "an exponent that is no number leaves the opacity",
        RECORDS,
        "upper = upper if finite else max(1.0, upper)",
        "upper = upper if finite else upper",
        "test_gsplat_kernels.py::test_stiff_cases_hold[squares at the overflow-1.4.0]",
    ),
    Mutant(
        "boxes of 1.5.3 have three standard deviations at most",
        "methods/splat/constants.py",
        'GSPLAT_1_5_3 = Rasteriser("gsplat", "1.5.3", axis_sigmas=3.33)',
        'GSPLAT_1_5_3 = Rasteriser("gsplat", "1.5.3", axis_sigmas=3.0)',
        "test_gsplat_kernels.py::test_tile_lists[classic-1.5.3]",
    ),
    Mutant(
        "network: half of a sum's roundings are charged",
        NETWORK,
        "_gamma(count + _FOLDING) * size",
        "_gamma(0.5 * (count + _FOLDING)) * size",
        "test_network_rounding.py::test_sums_that_lose_as_much_as_they_can[1]",
    ),
    Mutant(
        "network: the first layer's rounding is dropped",
        NETWORK,
        "noise = (moves + rows * width)",
        "noise = ((moves if k > 1 else 0.0 * moves) + rows * width)",
        "test_network_rounding.py::test_sums_that_lose_as_much_as_they_can[2]",
    ),
    Mutant(
        "network: rounding before an activation is dropped",
        NETWORK,
        "give = give + rounded.abs() * self.noise[source]",
        "give = give + 0.0 * self.noise[source]",
        "test_network_rounding.py::test_sums_that_lose_as_much_as_they_can[3]",
    ),
    Mutant(
        "network: rounding is charged at the middle of a set alone",
        NETWORK,
        "size = torch.maximum(f.interval.size, f.reference.abs())",
        "size = f.reference.abs() + 0.0 * f.interval.size",
        "test_network_rounding.py::test_rounding_counts_the_largest_image_of_a_set",
    ),
    Mutant(
        "network: rows' own rounding is dropped",
        NETWORK,
        "noise = (moves + rows * width)",
        "noise = (moves + 0.0 * width)",
        "test_network_rounding.py::test_rounding_of_rows_over_sets",
    ),
    Mutant(
        "network: references' own rounding is dropped",
        NETWORK,
        "own = (layer.terms + len(inputs) + 8) * 2.0**-52",
        "own = 0.0",
        "test_network_rounding.py::test_exact_network_at_single_images[1024.0-False]",
    ),
    Mutant(
        "network: units that may be on count as zeros",
        NETWORK,
        "form.active = upper > 0.0",
        "form.active = lower > 0.0",
        "test_network_rounding.py::test_units_that_may_be_on_are_terms",
    ),
)


@dataclass
class Outcome:
    """What became of one mutant: how it ended and how long its test took, seconds."""

    mutant: Mutant | Fault
    verdict: str
    seconds: float


def copy_package(folder: Path) -> None:
    """The package, its tests and nothing else, so that the tests import the copy."""
    skip = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
    shutil.copytree(ROOT / "ns_abstract", folder / "ns_abstract", ignore=skip)
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=skip)


def mutate(folder: Path, mutant: Mutant | Fault) -> str:
    """Apply the change to the copy; returns the original text.

    Raises:
        ValueError: ``old`` does not stand in its place exactly once.
    """
    path = folder / "ns_abstract" / mutant.file
    text = path.read_text()
    if isinstance(mutant, Fault):
        path.write_text(apply(text, mutant))
        return text
    count = text.count(mutant.old)
    if count != 1:
        raise ValueError(f"{mutant.name}: the text to change stands {count} times in {mutant.file}, not once")
    path.write_text(text.replace(mutant.old, mutant.new))
    return text


def run_test(folder: Path, test: str, compiled: bool) -> tuple[int, str, float]:
    """pytest's exit code, its output and the seconds it took, on the copy in ``folder``."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {
            "PYTHONPATH": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
            "NS_ABSTRACT_CACHE_DIR": cache,
            "NUMBA_DISABLE_JIT": "0" if compiled else "1",
            "NUMBA_NUM_THREADS": "1",
        }
        command = [
            sys.executable, "-W", "ignore", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider",
            "--hypothesis-seed=1", f"tests/{test}",
        ]  # fmt: skip
        start = time.perf_counter()
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        )
        return done.returncode, done.stdout + done.stderr, time.perf_counter() - start


def table(outcomes: list[Outcome]) -> str:
    """The outcomes as a Markdown table."""
    rows = ["| mutant | file | killed by | seconds |", "| --- | --- | --- | --- |"]
    for outcome in outcomes:
        m = outcome.mutant
        killer = f"`{m.test}`" if outcome.verdict == "killed" else f"**{outcome.verdict}** (`{m.test}`)"
        rows.append(f"| {m.name} | {m.file} | {killer} | {outcome.seconds:.1f} |")
    return "\n".join(rows)


def main() -> int:
    """Run the mutants one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], help="run the mutants whose names contain one of these")
    parser.add_argument("--compiled", action="store_true", help="compile the kernels, into a private cache")
    parser.add_argument("--list", action="store_true", help="check that every change applies, and stop")
    options = parser.parse_args()
    chosen = [m for m in (*MUTANTS, *FAULTS) if not options.only or any(part in m.name for part in options.only)]
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        copy_package(folder)
        for mutant in chosen:
            original = mutate(folder, mutant)
            (folder / "ns_abstract" / mutant.file).write_text(original)
        if options.list:
            print(f"{len(chosen)} mutants apply")
            return 0
        healthy: dict[str, bool] = {}
        for mutant in chosen:
            compiled = options.compiled or (isinstance(mutant, Fault) and mutant.compiled)
            if mutant.test not in healthy:
                code, output, _ = run_test(folder, mutant.test, compiled)
                healthy[mutant.test] = code == _PASSED
                if code != _PASSED:
                    print(output[-2000:])
            verdict, seconds = "its test fails without it", 0.0
            if healthy[mutant.test]:
                original = mutate(folder, mutant)
                code, output, seconds = run_test(folder, mutant.test, compiled)
                (folder / "ns_abstract" / mutant.file).write_text(original)
                # an assertion that fails, not a crash
                asserted = code == _FAILED and "AssertionError" in output
                verdicts = {_PASSED: "survived", _FAILED: "killed" if asserted else "crashed"}
                verdict = verdicts.get(code, f"pytest {code}")
            outcomes.append(Outcome(mutant, verdict, seconds))
            print(f"{verdict:10s} {seconds:6.1f} s  {mutant.name}", flush=True)
    killed = sum(outcome.verdict == "killed" for outcome in outcomes)
    summary = f"{killed} of {len(outcomes)} mutants killed, {sum(o.seconds for o in outcomes):.0f} s."
    print(summary)
    if not options.only:
        header = "# Planted faults and the tests that catch them\n\nWritten by `python benchmarks/mutants.py`. "
        REPORT.write_text(f"{header}{summary}\n\n{table(outcomes)}\n")
    return 0 if killed == len(outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
