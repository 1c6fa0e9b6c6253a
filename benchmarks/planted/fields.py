"""Faults in the bounds of NeRF fields."""

from planted.fault import Fault

_ZONOTOPE, _CELLS = "methods/nerf/zonotope.py", "methods/nerf/sample_cells.py"
_HSV, _OCCUPANCY, _RELU = "methods/nerf/hsv.py", "methods/nerf/occupancy.py", "methods/nerf/relu_kernel.py"
_LAYER = "methods/nerf/layer_kernel.py"
_PLANES, _STRIPS = "methods/nerf/planes.py", "methods/nerf/strips.py"
_SAMPLES, _PATHS = "methods/nerf/samples.py", "methods/nerf/sample_paths.py"
_PENCIL, _DIVISION, _OUTPUTS = "methods/nerf/ray_bundle.py", "methods/nerf/division.py", "methods/nerf/outputs.py"
_PARTS = "test_nerf_certify.py::test_planes_lie_beyond_every_part_exactly"
_FIELDS = "test_nerf_zonotope.py::test_fields_are_enclosed"
_LAYERS = "test_nerf_zonotope.py::test_linear_layers_are_enclosed"
_UNITS = "test_nerf_zonotope.py::test_every_unit_is_enclosed"
_NARROW = "test_nerf_zonotope.py::test_columns_in_float32_are_charged"
_PRODUCTS = "test_nerf_zonotope.py::test_products_leave_out_what_is_off"
_OPACITY = "test_nerf_zonotope.py::test_opacities_are_monotone_bounds"
_SETS = "test_nerf_frame.py::test_sets_of_poses_are_enclosed"
_STIFF = "test_nerf_frame.py::test_stiff_fields_are_enclosed"
_COLORS = "test_nerf_hsv.py::test_bounds_contain_every_shifted_colour"
_VOXELS = "test_nerf_occupancy.py::test_boxes_of_points_are_enclosed"
_POINTS = "test_nerf_occupancy.py::test_ranges_of_points_are_enclosed_and_tight"

FIELDS = (
    Fault(
        "fields: narrow sets are bounded no better than wide ones",
        "methods/nerf/frame.py", "FieldFrame._tolerance",
        "min(_TUNING.least_tolerance, max(_TUNING.finest_tolerance, _TUNING.least_share * self._variation))",
        "_TUNING.least_tolerance",
        "test_nerf_frame.py::test_a_tolerance_is_not_finer_than_bounds_are_kept",
    ),
    Fault(
        "fields: the encoding's interpolation error is not charged",
        _ZONOTOPE, "FieldBounds.encode", "remainder + lebesgue**j * error", "remainder", _FIELDS, True,
    ),
    Fault(
        "fields: a layer forgets the box before it",
        _ZONOTOPE, "FieldBounds._linear", "radius @ layer.absolute[seen_inputs:]",
        "0.0 * (radius @ layer.absolute[seen_inputs:])",
        _LAYERS + "[False-False]",
    ),
    Fault(
        "fields: a layer forgets its bias",
        _ZONOTOPE, "FieldBounds._linear", "poly[:, 0] += layer.bias", "pass", _LAYERS + "[False-False]",
    ),
    Fault(
        "layers: the compiled one forgets the box before it",
        _LAYER, "_box", "(size[j] + before[j]) * rounding + before[j]", "(size[j] + before[j]) * rounding",
        _LAYERS + "[True-True]",
    ),
    Fault(
        "layers: the compiled one forgets its bias",
        _LAYER, "linear", "poly[0, j] += bias[j]", "pass", _LAYERS + "[True-True]",
    ),
    Fault(
        "layers: the compiled one forgets what it sees of an encoded vector",
        _LAYER, "linear", "poly[k, j] += bias_absolute[k, j]", "pass", _PRODUCTS,
    ),
    Fault(
        "layers: the compiled one forgets the remainder of an encoded vector",
        _LAYER, "_box", "rest[j] + rounding * whole[j]", "rounding * whole[j]", _PRODUCTS,
    ),
    Fault(
        "fields: error terms of one neuron lose their size",
        _LAYER, "_columns", "size * wide[neuron, j]", "0.1 * size * wide[neuron, j]", _LAYERS + "[True-True]",
    ),
    Fault(
        "layers: gradual underflow of columns in float32 is not charged",
        "arithmetic/rounding.py", "", "UNDERFLOW_COLUMNS = 2.0**-90", "UNDERFLOW_COLUMNS = 0.0", _NARROW + "[1e-39]",
    ),
    Fault(
        "layers: columns in float32 are not charged",
        _LAYER, "_box", "narrow * spread[j] + underflow", "underflow", _NARROW + "[1.0]",
    ),
    Fault(
        "layers: the sum of error terms forgets those that are new",
        _ZONOTOPE, "FieldBounds._relu", "spread[which, neuron] += error", "pass", _UNITS + "[1-False]",
    ),
    Fault(
        "compiled units: the sum of error terms forgets those that are new",
        _RELU, "relu", "spread[piece[i], neuron[i]] += error[i]", "pass", _UNITS + "[1-True]",
    ),
    Fault(
        "layers: where torch works alone, sums of error terms are too small",
        _ZONOTOPE, "FieldBounds._linear", "column_sums(columns, owner, poly.shape[0])",
        "0.2 * column_sums(columns, owner, poly.shape[0])", _LAYERS + "[False-False]",
    ),
    Fault(
        "layers: where torch works alone, what a range shows to be on is off",
        _ZONOTOPE, "FieldBounds._relu", "slope[which, neuron] = now_active.to(torch.float64)", "pass",
        _UNITS + "[1-False]",
    ),
    Fault(
        "layers: all rows of a block are its first six",
        _LAYER, "multiply",
        "sums_of_rows(f, rows_from(first, count - 1, inputs), places, k, w, c, stride, line, nothing)",
        "sums_of_rows(f, rows_from(0, count - 1, inputs), places, k, w, c, stride, line, nothing)", _PRODUCTS,
    ),
    Fault(
        "layers: the end of a product's row is its last line's beginning",
        _LAYER, "multiply", "rest[r - first, j - c]", "rest[r - first, 0]", _PRODUCTS,
    ),
    Fault(
        "layers: a product takes the first rows of the weight, not those of what is live",
        "arithmetic/simd/products.py", "sums_of_rows", "load_line(elements, at + stride * k)",
        "load_line(elements, at + stride * i)", _PRODUCTS,
    ),
    Fault(
        "layers: open neurons are left out as those that are off",
        _LAYER, "linear", "size[j] != 0.0", "size[j] != 0.0 and z.slope[b, j] == 1.0", _LAYERS + "[True-True]",
    ),
    Fault(
        "fields: an open unit counts as active",
        _ZONOTOPE, "FieldBounds._relu", "low >= e + r", "high >= e + r", _UNITS + "[1-False]",
    ),
    Fault(
        "fields: a unit that may be active counts as dead",
        _ZONOTOPE, "FieldBounds._relu", "high <= -(e + r)", "low <= -(e + r)", _UNITS + "[1-False]",
    ),
    Fault(
        "fields: the radius of a unit forgets its columns",
        _ZONOTOPE, "FieldBounds._relu", "spread + rho + box", "0.2 * spread + 0.0 * rho + box",
        _UNITS + "[1-False]",
    ),
    Fault(
        "fields: the line's error is a quarter of what it is",
        _ZONOTOPE, "FieldBounds._relu", "(0.5 * line * -bottom + 4.0 * slack) * FIELD_UP",
        "(0.25 * line * -bottom + 4.0 * slack) * FIELD_UP", _UNITS + "[1-False]",
    ),
    Fault(
        "fields: the fit is not shifted to its middle",
        _ZONOTOPE, "FieldBounds._fitted", "q[:, 0] += shift", "pass", _UNITS + "[1-False]",
    ),
    Fault(
        "fields: the distance between grid and polynomial is not charged",
        _ZONOTOPE, "FieldBounds._fitted", "(positive - fitted).amax(dim=1) + torch.maximum(above, below)",
        "0.5 * (positive - fitted).amax(dim=1)", _UNITS + "[1-False]",
    ),
    Fault(
        "fields: what is no number does not fail",
        _ZONOTOPE, "FieldBounds._relu", "z.failed | (count > self.limit) | ~torch.isfinite(size).all(dim=1)",
        "z.failed | (count > self.limit)", "test_nerf_zonotope.py::test_numbers_that_are_none_fail[False]", True,
    ),
    Fault(
        "compiled units: what is no number does not fail",
        _RELU, "relu", "fails |= not math.isfinite(size[b, j])", "pass",
        "test_nerf_zonotope.py::test_numbers_that_are_none_fail[True]", True,
    ),
    Fault(
        "fields: the second chunk of pieces begins with the first one's columns",
        "methods/nerf/field_kernel.py", "_piecewise", "z.columns[first:last]", "z.columns[: last - first]",
        "test_nerf_zonotope.py::test_chunks_are_as_good_as_layer_after_layer", True,
    ),
    Fault(
        "fields: columns of failed pieces are kept",
        "methods/nerf/field_kernel.py", "_keep", "not failed[owner[c]]", "True",
        "test_nerf_zonotope.py::test_pieces_with_too_many_terms_are_given_up", True,
    ),
    Fault(
        "compiled units: values on the grid are without the highest degrees",
        _RELU, "_on_grid", "sums_of_rows(factors, rows, places, terms, elements, c, LANES, line, nothing)",
        "sums_of_rows(factors, rows, places, terms - 4, elements, c, LANES, line, nothing)", _UNITS + "[1-True]",
    ),
    Fault(
        "fields: what is left of a dim cell is its polynomial's alone",
        _OUTPUTS, "greatest", "value.radius + CHEBYSHEV_ROUNDING * (middle.abs() + spread)",
        "CHEBYSHEV_ROUNDING * (middle.abs() + spread)",
        "test_nerf_zonotope.py::test_greatest_values_on_whole_cells",
    ),
    Fault(
        "fields: rounding of a dim cell's sum is not charged",
        _OUTPUTS, "greatest", "CHEBYSHEV_ROUNDING * (middle.abs() + spread)", "0.0",
        "test_nerf_zonotope.py::test_greatest_values_on_whole_cells",
    ),
    Fault(
        "compiled units: the line's error is a quarter of what it is",
        _RELU, "_relax_unstable", "line_error = (0.5 * line * -bottom + 4.0 * slack) * FIELD_UP",
        "line_error = (0.25 * line * -bottom + 4.0 * slack) * FIELD_UP", _UNITS + "[1-True]",
    ),
    Fault(
        "compiled units: the fit is not shifted to its middle",
        _RELU, "_relax_unstable", "0.5 * (most[c] + least[c])", "0.0", _UNITS + "[1-True]",
    ),
    Fault(
        "compiled units: columns are halved without their error",
        _RELU, "_relax_unstable",
        "(new + 0.5 * e + 2.0 * slack) * FIELD_UP", "(new + 2.0 * slack) * FIELD_UP",
        _UNITS + "[1-True]",
    ),
    Fault(
        "compiled units: an open unit counts as dead",
        _RELU, "_decide", "most[c] <= -rest", "least[c] <= -rest", _UNITS + "[1-True]",
    ),
    Fault(
        "opacity: an upper bound is rounded down",
        _OUTPUTS, "opacity", "alpha * (1.0 + ACTIVATION_ROUNDING) + ACTIVATION_FLOOR",
        "alpha * (1.0 - 2.0**-40) + ACTIVATION_FLOOR", _OPACITY,
    ),
    Fault(
        "opacity: torch's threshold of softplus is forgotten",
        _OUTPUTS, "density", "z > SOFTPLUS_LINE", "z > 1e9", _OPACITY,
    ),
    Fault(
        "rays: the error of the pose is not charged to the direction",
        _PENCIL, "RayBundle.points", "self.origin_radius + far[:, None] * self.direction_radius[ray]",
        "0.0 * self.origin_radius + 0.0 * far[:, None] * self.direction_radius[ray]",
        "test_nerf_frame.py::test_rays_of_wide_sets_lie_in_their_polynomials",
    ),
    Fault(
        "rays: ranges on a part forget half of its width",
        _PENCIL, "RayBundle.ranges", "0.5 * (high - low)", "0.25 * (high - low)", _POINTS,
    ),
    Fault(
        "rays: parts of a cell change places",
        _DIVISION, "Division.members", "range(1, 2 * self.dimensions, 2)", "range(2 * self.dimensions - 1, 0, -2)",
        "test_nerf_frame.py::test_divisions_are_nested_covers",
    ),
    Fault(
        "compositing: brighter colours take the lower opacity",
        _CELLS, "SampleCellBounds._composited",
        "np.where(rise > 0.0, most, least)", "np.where(rise > 0.0, least, least)",
        _STIFF + "[rough]", True,
    ),
    Fault(
        "compositing: darker colours take the lower opacity",
        _CELLS, "SampleCellBounds._composited", "np.where(fall < 0.0, most, least)", "least", _STIFF + "[rough]", True,
    ),
    Fault(
        "colours: a batch that was given up keeps its numbers",
        _CELLS, "SampleCellBounds._bound_field", "density.failed[:, None]", "density.failed[:, None] & False",
        "test_nerf_frame.py::test_pieces_that_are_given_up_say_nothing", True,
    ),
    Fault(
        "bounds of parts: the network's own error is left out",
        _OUTPUTS, "bounds_by_part", "rounding + error[:, None]", "rounding", _STIFF, True,
    ),
    Fault(
        "known bounds: what is no number replaces what is known",
        _CELLS, "SampleCellBounds._keep", "(low <= high) & np.isfinite(low) & np.isfinite(high)", "low == low",
        "test_nerf_frame.py::test_what_is_known_is_only_replaced_by_bounds",
    ),
    Fault(
        "voxels: the room for rounding is forgotten",
        _OCCUPANCY, "OccupancyGrid.look",
        "VOXEL_ROUNDING * (np.maximum(np.abs(lower), np.abs(upper)) + np.abs(self.lower)) * self.scale",
        "0.0 * lower", _VOXELS,
    ),
    Fault(
        "voxels: boxes that reach beyond the grid are surely occupied",
        _OCCUPANCY, "OccupancyGrid.look", "(first >= 0) & (last < size)", "(last >= 0) & (first < size)", _VOXELS,
    ),
    Fault(
        "voxels: the sums of corners have a sign wrong",
        _OCCUPANCY, "OccupancyGrid.look",
        "s[x1, y1, z1] - s[x0, y1, z1]", "s[x1, y1, z1] - s[x0, y1, z0]", _VOXELS,
    ),
    Fault(
        "hue: all of the circle is missed where the order of channels is open",
        _HSV, "_hues", "first, last = 0.0, 6.0", "first, last = 0.0, 3.0", _COLORS + "[0.3-0.4]",
    ),
    Fault(
        "hue: a range of hues is its middle",
        _HSV, "_hues", "return first - HUE_ROOM, last + HUE_ROOM", "return 0.5 * (first + last), 0.5 * (first + last)",
        _COLORS + "[0.3-0.4]",
    ),
    Fault(
        "hue: the wrap at half a turn is forgotten",
        _HSV, "shift_box", "end - 6.0 if end >= 3.0 else end", "end", _COLORS,
    ),
    Fault(
        "hue: the range's end is forgotten",
        _HSV, "shift_box", "max(abs(start), abs(end))", "abs(start)", _COLORS,
    ),
    Fault(
        "saturation: the least channel takes the other end of the shift",
        _HSV, "shift_box", "max(saturation[1] * value_low, saturation[1] * value_high)",
        "min(saturation[1] * value_low, saturation[1] * value_high)", _COLORS,
    ),
    Fault(
        "hue: rounding is not charged",
        _HSV, "shift_box", "least + (value_low - least) * share_low - HUE_ROUNDING",
        "least + (value_low - least) * share_low + 0.0", _COLORS,
    ),
    Fault(
        "planes: parts have no width",
        _PLANES, "_offset", "rows - slope @ centre.T + np.abs(slope) @ half.T", "rows - slope @ centre.T",
        _PARTS + "[counts0]",
    ),
    Fault(
        "planes: of neighbours that are united one is forgotten",
        _PLANES, "unite_parts", "np.minimum.reduceat(low, starts, axis=axis + 1)",
        "np.maximum.reduceat(low, starts, axis=axis + 1)", _PARTS + "[counts3]",
    ),
    Fault(
        "strips: parts lie elsewhere in their strip",
        _STRIPS, "PoseStrips._part_ends", "ends[:-1, None] + (ends[1:] - ends[:-1])[:, None] * inner",
        "ends[:-1, None] + 0.5 * (ends[1:] - ends[:-1])[:, None] * inner",
        "test_nerf_certify.py::test_planted_faults_are_found", True,
    ),
    Fault(
        "samples: shares of light before a place are taken with the light behind it at its other end",
        _SAMPLES, "edge_bounds", "share(before[1], after[0])", "share(before[1], after[1])",
        "test_nerf_hierarchical.py::test_edges_of_samples_are_enclosed[any]",
    ),
    Fault(
        "samples: the rounding of shares is not charged",
        _SAMPLES, "edge_bounds", "EDGE_ROUNDING * (bins + EDGE_BINS)", "0.0",
        "test_nerf_hierarchical.py::test_edges_of_samples_are_enclosed[known]",
    ),
    Fault(
        "samples: a middle is looked for where it lies at least",
        _SAMPLES, "field_hulls", "far = 0.5 * (edges_high[r, i] + edges_high[r, i + 1])",
        "far = 0.5 * (edges_low[r, i] + edges_low[r, i + 1])",
        "test_nerf_hierarchical.py::test_sampled_parts_are_enclosed[0.003]",
    ),
    Fault(
        "samples: an interval that may lie over a segment is forgotten",
        _SAMPLES, "composite", "edges_high[r, first] > ends[k]", "edges_low[r, first] > ends[k]",
        "test_nerf_hierarchical.py::test_segments_take_every_interval_that_may_lie_over_them",
    ),
    Fault(
        "followed samples: a part's own motion is not in the rest",
        _PATHS, "SampleLines.around", "(low - along).min(axis=1) - room", "(low - along).min(axis=1)",
        "test_nerf_paths.py::test_lines_hold_the_places_of_every_part[False-counts2]",
    ),
    Fault(
        "followed samples: what is negligible costs nothing",
        _PATHS, "FollowedSamples.composite", "self.price.reshape(rows, 1) * FOLLOWED_UP",
        "0.0 * self.price.reshape(rows, 1)",
        "test_nerf_paths.py::test_what_is_negligible_is_charged",
    ),
    Fault(
        "followed samples: parts of a cell change places",
        _PATHS, "_Level.of", "part.ravel()", "part.ravel()[::-1]",
        "test_nerf_paths.py::test_parts_hold_their_renders[yaw]",
    ),
    Fault(
        "followed samples: the coarse pass is known better than it is",
        _PATHS, "SamplePaths.edges", "np.where(good, most, 1.0)", "np.where(good, least, 1.0)",
        "test_nerf_paths.py::test_samples_are_where_and_what_they_are_said_to_be[soft-False]", True,
    ),
    Fault(
        "followed samples: lengths end where intervals begin at least",
        _PATHS, "FollowedSamples._batch", "self.high[k, :, i + 1] - self.low[k, :, i]",
        "self.low[k, :, i + 1] - self.high[k, :, i]",
        "test_nerf_paths.py::test_samples_are_where_and_what_they_are_said_to_be[soft-False]", True,
    ),
    Fault(
        "followed samples: where density is declared 0 in part it is the field's",
        _PATHS, "FollowedSamples._batch", "np.where(good & sure[:, None], least, 0.0)", "np.where(good, least, 0.0)",
        "test_nerf_paths.py::test_samples_are_where_and_what_they_are_said_to_be[soft-True]", True,
    ),
    Fault(
        "parts are regrouped inward",
        _DIVISION, "regroup_parts", "-(-(np.arange(count) + 1) * size // count)",
        "np.maximum((np.arange(count) + 1) * size // count, starts + 1)",
        "test_nerf_paths.py::test_parts_are_regrouped_outward",
    ),
)  # fmt: skip
