"""Faults in what comes before and behind a network: preprocessing, properties, the search, the store."""

from planted.fault import Fault

_PREPROCESS, _PROPERTIES, _VNNLIB = "verify/preprocess.py", "verify/properties.py", "verify/vnnlib.py"
_SEARCH, _STORE, _CELLS = "verify/search.py", "verify/store.py", "verify/cells.py"
_SETS = "test_certify_properties.py::test_sets_contain_what_float32_preprocessing_gives"
_TIGHT = "test_certify_properties.py::test_sets_are_tight_and_contain_rounding"
_LINEAR = "test_certify_properties.py::test_classification"
_UNSAFE = "test_certify_properties.py::test_vnnlib"
_REGRESSION = "test_certify_properties.py::test_regression"
_FOLLOWS = "test_certify_properties.py::test_regression_uses_correlation"
_TRUTH = "test_certify_properties.py::test_truth_forms_contain_the_truth"
_DETECTION = "test_certify_properties.py::test_detection"
_OVERLAP = "test_certify_properties.py::test_overlap_against_sampling"
_VERDICTS = "test_certify_search.py::test_verdicts_are_the_truth"
_IMAGES = "test_certify_search.py::test_bad_image_bounds_certify_nothing"
_NETWORKS = "test_certify_search.py::test_bad_network_bounds_certify_nothing"
_CHEAP = "test_certify_search.py::test_networks_are_asked_only_where_that_may_prove"
_SCENES = "test_certify_search.py::test_scenes_of_a_set"
_IMPOSSIBLE = "test_certify_search.py::test_impossible_leaves_are_refused_and_nothing_is_stored"
_RESUMED = "test_certify_search.py::test_resumed_store_equals_an_uninterrupted_one"

_REGISTRATION = "verify/registration.py"
_PLACES = "test_registration.py::test_bounds_hold_for_every_place_of_the_scene"
_ROUNDED = "verify/eight_bit.py"
_BOXES = "verify/box_decisions.py"
_EITHER = "test_vnnlib_runner.py::test_proofs_alone_never_decide_unsafe_instances"
_SLOPES = "verify/network/slope_optimisation.py"
_MARGINS = "test_network_branching.py::test_margins_that_branches_prove"
_BRANCHES = "test_network_branching.py::test_claims_next_to_the_exact_minimum"
_TREE, _LINES = "verify/network/phase_tree.py", "verify/network/relu_lines.py"
_HELD = "test_phase_tree.py::test_branches_hold_for_the_images_in_them[small-1.0]"
_LEVELS = "test_eight_bit.py::test_sets_hold_rounded_pictures"

_FAMILY, _COVER = "verify/network/shared_coefficients.py", "verify/sub_box_proof.py"
_HULL, _SAMPLES = "verify/picture_sets.py", "verify/cell_samples.py"
_SHARED = "test_cover.py::test_rows_of_one_cell_hold_every_value"

CERTIFICATES = (
    Fault(
        "families: parts are taken about their own reference",
        _FAMILY, "_ReusingCells.about", "np.repeat(self.first.intermediate.middle, len(middle), axis=0)", "middle",
        _SHARED + "[product]",
    ),
    Fault(
        "families: parts follow their own winners of windows",
        _FAMILY, "_ReusingCells.winner", "self.first.winners[k].expand_as(winner).contiguous()", "winner",
        "test_cover.py::test_parts_have_the_references_and_winners_of_the_whole",
    ),
    Fault(
        "families: rows that were passed back with a negative sign keep it",
        _FAMILY, "_ReusingCells._stored_bounds", "middle * stored.sign", "middle", _SHARED + "[]",
    ),
    Fault(
        "families: the cell's own width is left out",
        _FAMILY, "_ReusingCells._stored_bounds", "half[0] + spread", "0.0 * half[0] + spread", _SHARED + "[]",
    ),
    Fault(
        "families: activations are taken to follow the first cell's slopes",
        _FAMILY, "_ReusingCells._stored_bounds", "spread[here] += sizes[:, -1]", "spread[here] += 0.0 * sizes[:, -1]",
        _SHARED + "[]",
    ),
    Fault(
        "families: what rows gathered at products is forgotten",
        _FAMILY, "_ReusingCells._stored_bounds", "middle + 0.5 * (low + high)", "middle",
        "test_cover.py::test_products_of_rows_are_charged[product]",
    ),
    Fault(
        "families: what float32 products lose is not charged",
        _FAMILY, "_ReusingCells._stored_bounds", "loses / (1.0 - loses)", "0.0",
        "test_cover.py::test_products_of_rows_are_charged[]",
    ),
    Fault(
        "families: rounding is charged by the first part's sizes",
        _FAMILY, "_ReusingCells.rounding_form", "form.upper.amax(0, keepdim=True)", "form.upper[:1]",
        "test_cover.py::test_rounding_is_charged_by_all_parts_at_once",
    ),
    Fault(
        "families: an activation's range forgets the kink",
        "verify/network/layers.py", "LeakyRelu.offsets", "least.clamp(max=0.0)", "least", _SHARED + "[]",
    ),
    Fault(
        "families: what follows the parameters has no width",
        "verify/network/propagation.py", "_around_slope", "z.r * UP", "0.0 * z.r", _SHARED + "[]",
    ),
    Fault(
        "families: what is between the offsets does not follow the parameters",
        "verify/network/propagation.py", "_around_slope", "t[:, None] * z.a", "0.0 * t[:, None] * z.a", _SHARED + "[]",
    ),
    Fault(
        "parts: joined sets forget that slopes differ",
        _HULL, "hull_of_sets", "np.abs(a_low - by * common).sum(axis=-1)", "0.0",
        "test_cover.py::test_joined_sets_hold_every_part[0.0]",
    ),
    Fault(
        "parts: ends of boxes are taken to be exact",
        _HULL, "hull_of_sets", "(np.abs(lower) + np.abs(upper)).max(axis=0) / reach", "0.0 * reach",
        "test_cover.py::test_joined_sets_hold_every_part[300000.0]",
    ),
    Fault(
        "parts: one without a proof is passed over",
        _COVER, "SubBoxProof._unproved", "not margins[k] > 0.0", "margins[k] == 0.0",
        "test_cover.py::test_one_part_without_a_proof_leaves_the_cell_without",
    ),
    Fault(
        "parts: a cell's slanted box is that of narrower rotations",
        "geometry/poses.py", "PoseBox.within", "(low, high)", "(low, 0.5 * (low + high))",
        "test_cover.py::test_poses_of_a_cell_are_in_its_slanted_parts[six]",
    ),
    Fault(
        "scene margin: scenes of a tenth of the radius",
        "api/certification.py", "Certification._varied", "kind.variation(radius)", "kind.variation(0.1 * radius)",
        "test_certify_cli.py::test_scene_margin", True,
    ),
    Fault(
        "scene margin: what is known of one radius is taken for all",
        _STORE, "Store.settled", '"kind = ? AND radius = ? AND frame = ? AND lower = ? AND upper = ?"',
        '"kind = ? AND 0.0 < ? AND frame = ? AND lower = ? AND upper = ?"',
        "test_scene_margin.py::test_a_resumed_command_settles_nothing_twice",
    ),
    Fault(
        "registration: the worst place of the scene is not taken",
        _REGISTRATION, "RegisteredModel.bound",
        "output_bounds.b - lost - OWN_LINE * (np.abs(output_bounds.b) + lost)", "output_bounds.b", _PLACES,
    ),
    Fault(
        "registration: pictures of one corner of the places",
        _REGISTRATION, "RegisteredImages.widened",
        "(*box.upper, *whole.upper[-PLACE:])", "(*box.upper, *whole.lower[-PLACE:])", _PLACES,
    ),
    Fault(
        "scene margin: parts that are not proved are passed over",
        "verify/scene_margin.py", "_Bisection._examined", 'return "unknown", outcome.reason, count, None', "continue",
        "test_scene_margin.py::test_parts_that_are_not_proved_count",
    ),
    Fault(
        "scene margin: the largest radius of a cell is told",
        "verify/scene_margin.py", "largest_radius",
        "margin.reached, margin.part = radius, margin.part + cells[number].part",
        "margin.reached, margin.part = max(radius, margin.reached), margin.part + cells[number].part",
        "test_scene_margin.py::test_the_margin_is_that_of_the_weakest_cell",
    ),
    Fault(
        "8 bits: linear sets are not widened",
        _ROUNDED, "rounded_sets", "(0.5 + STEP) / _STEPS + QUOTIENT", "0.0", _LEVELS,
    ),
    Fault(
        "8 bits: the rounding of 255 x is not charged",
        "arithmetic/network_charges.py", "", "STEP = 4.0 * 256.0 * UNIT", "STEP = 0.0", _LEVELS,
    ),
    Fault(
        "8 bits: the level above the lower bound",
        _ROUNDED, "rounded_sets", "np.ceil(low - 0.5 - STEP)", "np.floor(low + 0.5 + STEP)", _LEVELS,
    ),
    Fault(
        "8 bits: bounds that cross become one level",
        _ROUNDED, "rounded_sets", "np.where(lower <= upper, least, np.nan)", "least",
        "test_eight_bit.py::test_wrong_bounds_stay_wrong",
    ),
    Fault(
        "preprocessing: rounding is not charged",
        _PREPROCESS, "Preprocess.input_sets.move",
        "PREPROCESS_ROUNDING * size + PREPROCESSED_ROUNDING * np.abs(b * factor)", "0.0 * np.abs(b * factor)", _TIGHT,
    ),
    Fault(
        "preprocessing: the upper set is moved down",
        _PREPROCESS, "Preprocess.input_sets", "move(b_upper, slopes[1], 1.0)", "move(b_upper, slopes[1], -1.0)", _TIGHT,
    ),
    Fault(
        "preprocessing: slopes forget the range",
        _PREPROCESS, "Preprocess.input_sets", "self._ordered(a, 1) * factor[:, None]",
        "self._ordered(a, 1) / std[:, None]", _SETS,
    ),
    Fault(
        "preprocessing: channels are not turned round",
        _PREPROCESS, "Preprocess._ordered", "np.flip(array, array.ndim - 1 - after)", "array", _SETS + "[NCHW-BGR]",
    ),
    Fault(
        "preprocessing: layouts are mixed up",
        _PREPROCESS, "Preprocess._flat", "np.moveaxis(array, array.ndim - 1 - after, 1)", "array",
        _SETS + "[NCHW-RGB]",
    ),
    Fault(
        "classification: a margin counts for the other class",
        _PROPERTIES, "Classification.bind", "rows[:, self.label] = 1.0", "rows[:, self.label] = 2.0", _LINEAR,
    ),
    Fault(
        "linear claims: one group is enough",
        _PROPERTIES, "LinearClaim.proved",
        "np.min([lower[:, list(group)].max(axis=1) for group in self.groups], axis=0)",
        "np.max([lower[:, list(group)].max(axis=1) for group in self.groups], axis=0)", _UNSAFE,
    ),
    Fault(
        "linear claims: bounds that are no numbers are left in",
        _PROPERTIES, "LinearClaim.proved", "np.where(np.isnan(bounds.lower), -np.inf, bounds.lower)",
        "np.where(np.isnan(bounds.lower), np.inf, bounds.lower)", _LINEAR,
    ),
    Fault(
        "regression: the error's lower side is forgotten",
        _PROPERTIES, "RegressionClaim._cell", "np.maximum(-sides[0], -sides[1])", "-sides[0]", _REGRESSION,
    ),
    Fault(
        "regression: ranges take the near end of the truth",
        _PROPERTIES, "RegressionClaim._cell", "np.stack([high, -low])", "np.stack([low, -high])", _REGRESSION,
    ),
    Fault(
        "regression: lines forget their slope",
        _PROPERTIES, "RegressionClaim._cell",
        "b - signs * truth.center - truth.radius - np.abs(slope).sum(axis=-1) - OWN_MARGIN * size",
        "b - signs * truth.center - truth.radius - OWN_MARGIN * size", _FOLLOWS,
    ),
    Fault(
        "regression: the tolerance is relative to the farthest truth",
        _PROPERTIES, "RegressionClaim._cell", "np.minimum(np.abs(low), np.abs(high))",
        "np.maximum(np.abs(low), np.abs(high))", _REGRESSION,
    ),
    Fault(
        "regression: bounds that are no numbers prove",
        _PROPERTIES, "RegressionClaim.proved", "margin if math.isfinite(margin) else -np.inf", "abs(margin)",
        _FOLLOWS,
    ),
    Fault(
        "truth: the object is seen in OpenCV's axes",
        _PROPERTIES, "TrueValues.forms", "np.array([1.0, -1.0, -1.0])", "np.array([1.0, 1.0, 1.0])", _TRUTH,
    ),
    Fault(
        "truth: the distance is squared",
        _PROPERTIES, "TrueValues.forms", "camera.square().sum(0).sqrt()", "camera.square().sum(0)", _TRUTH,
    ),
    Fault(
        "detection: other classes are left out of the score",
        _PROPERTIES, "DetectionClaim._candidate",
        "score / (1.0 + np.exp(-lower[:, 1:count]).sum(axis=1)) * (1.0 - OWN_MARGIN)", "score * (1.0 - OWN_MARGIN)",
        _DETECTION + "[None-7]",
    ),
    Fault(
        "detection: the overlap is not asked for",
        _PROPERTIES, "DetectionClaim._candidate",
        "np.minimum(margin, self._overlap(lower[:, count : count + 4], -lower[:, count + 4 :], number))", "margin",
        _DETECTION + "[0.2-None]",
    ),
    Fault(
        "overlap: the box's own side does not cut it",
        _PROPERTIES, "DetectionClaim._overlap", "last - centre_high + 0.5 * side_low",
        "last - centre_low + 0.5 * side_low", _OVERLAP,
    ),
    Fault(
        "overlap: the union takes the smaller area",
        _PROPERTIES, "DetectionClaim._overlap", "area_high * (side_high + charge)", "area_high * side_low", _OVERLAP,
    ),
    Fault(
        "overlap: rows and columns change places",
        _PROPERTIES, "DetectionClaim._overlap", "((0, column), (1, row))", "((0, row), (1, column))", _OVERLAP,
    ),
    Fault(
        "unsafe sets: at least is read as at most",
        _VNNLIB, "_disjunction", "(left, right) if head == '<=' else (right, left)", "(left, right)", _UNSAFE,
    ),
    Fault(
        "unsafe sets: differences are sums",
        _VNNLIB, "_disjunction", "_sum(low, high, -1.0)", "_sum(low, high, 1.0)", _UNSAFE,
    ),
    Fault(
        "unsafe sets: of joined assertions the last counts",
        _VNNLIB, "_disjunction", "way += more[0]", "way[:] = more[0]",
        _UNSAFE,
    ),
    Fault(
        "boxes: one group of rows is enough",
        _BOXES, "proves", "proved &= positive[:, list(group)].any(1)",
        "proved = positive[:, list(group)].any(1)", _EITHER,
    ),
    Fault(
        "boxes: a half is dropped",
        _BOXES, "_halves", "[(lower, left), (right, upper)]", "[(lower, left)]", _EITHER,
    ),
    Fault(
        "branching: multipliers of either sign",
        _SLOPES, "DualAscent.climb", "np.maximum(moved, 0.0).astype(np.float32)", "moved.astype(np.float32)", _BRANCHES,
    ),
    Fault(
        "branching: multipliers forget the reference",
        _SLOPES, "SplitNeurons.lagrangian_terms", "gained.astype(np.float64) @ self.reference - room", "-room",
        _BRANCHES,
    ),
    Fault(
        "branching: the margin is that of the last group",
        "verify/model.py", "NetworkModel.branch", "min(least, result.least)", "result.least", _MARGINS,
    ),
    Fault(
        "branching: a group that fails is passed over",
        "verify/model.py", "NetworkModel.branch", "break", "least = 1.0", _MARGINS,
    ),
    Fault(
        "phase tree: the margin is that of the best branch",
        _TREE, "PhaseTree._climbed", "best[~open_].max(1).min()", "best[~open_].max(1).max() + 1.0", _MARGINS,
    ),
    Fault(
        "phase tree: one half is left out",
        _TREE, "_Branch.halves", "(1, -1)", "(1,)", "test_phase_tree.py::test_claims_next_to_the_exact_minimum[real]",
    ),
    Fault(
        "phase tree: lines of the other phase",
        _LINES, "write_relu_lines", "phases[r, u] if len(phases) else 0", "-phases[r, u] if len(phases) else 0", _HELD,
    ),
    Fault(
        "phase tree: what a stored slope of an assumed phase misses is left out",
        _LINES, "write_relu_lines", "(exact - slope) * (upper if side > 0 else lower)", "0.0 * upper",
        "test_phase_tree.py::test_lines_of_assumed_phases_enclose_the_piece[float32]",
    ),
    Fault(
        "phase tree: a half is bounded from what another branch has chosen",
        _TREE, "PhaseTree._ascent", "np.repeat(owner, g)",
        "np.repeat(0 * owner, g)",
        "test_phase_tree.py::test_halves_are_bounded_as_the_branches_that_they_become",
    ),
    Fault(
        "chosen lines: many rows are those of the first thread",
        "verify/network/row_ascent.py", "RowAscent._climb", "coefficients[own]", "coefficients[own - own[0]]",
        "test_phase_tree.py::test_several_threads_bound_the_same_rows",
    ),
    Fault(
        "phase tree: a branch that fails by little is proved",
        _TREE, "PhaseTree._climbed", "~(best > 0.0).any(1)", "~(best > -0.5).any(1)",
        "test_phase_tree.py::test_claims_next_to_the_exact_minimum[real]",
    ),
    Fault(
        "phase tree: a cell that was given up is proved",
        _TREE, "PhaseTree.prove", "not self.intermediate.usable[0]", "False",
        "test_phase_tree.py::test_what_is_not_known_is_not_proved",
    ),
    Fault(
        "phase tree: what is left where all phases are assumed is proved",
        _TREE, "PhaseTree.prove", "ended and self._climbed(rows, ended, self.tuning.last_steps)", "False",
        "test_phase_tree.py::test_claims_next_to_the_exact_minimum[real]",
    ),
    Fault(
        "phase tree: an infinite bound proves a row",
        _TREE, "_GroupRows.lower", "np.isfinite(lower)", "~np.isnan(lower)",
        "test_phase_tree.py::test_what_is_not_known_is_not_proved",
    ),
    Fault(
        "intermediate bounds: lines are chosen for the end far from zero",
        "verify/network/neuron_bounds.py", "NeuronBounds._climb", "side * (high + low) >= 0.0",
        "side * (high + low) <= 0.0", "test_phase_tree.py::test_ends_of_unstable_neurons_gain_by_lines_of_their_own",
    ),
    Fault(
        "intermediate bounds: a raised end is the negative one",
        "verify/network/neuron_bounds.py", "NeuronBounds._climb", "ends[at] = side * best.lower",
        "ends[at] = np.abs(best.lower) * side",
        "test_phase_tree.py::test_ends_of_unstable_neurons_gain_by_lines_of_their_own",
    ),
    Fault(
        "boxes: the later attack takes its part of the time for every group",
        "verify/box_decisions.py", "_BoxSearch._later_attack", "self.seconds_by_input * groups",
        "self.seconds_by_input",
        "test_phase_tree.py::test_the_later_attack_takes_a_part_of_the_time",
    ),
    Fault(
        "weighted means: any sum is a mean's",
        "verify/network/weighted_means.py", "_mean", "bool((total.weight == 1.0).all())", "True",
        "test_weighted_means.py::test_numbers_that_are_no_shares_stay",
    ),
    Fault(
        "weighted means: differences of weights are rounded",
        "verify/network/weighted_means.py", "_moved", "np.isfinite(moved).all() and all(exact)",
        "np.isfinite(moved).all()", "test_weighted_means.py::test_numbers_that_are_no_shares_stay",
    ),
    Fault(
        "weighted means: float32 computes the same",
        "verify/box_decisions.py", "_BoxSearch.decide", 'self.arithmetic == "real"', "True",
        "test_weighted_means.py::test_float32_computes_something_else",
    ),
    Fault(
        "rows in float32 are charged as float64",
        "verify/network/intermediate_bounds.py", "IntermediateBounds.__init__",
        "Relaxations(torch.float32, UNIT, sums)", "Relaxations(torch.float32, DOUBLE_UNIT, sums)",
        "test_dependence.py::test_rows_in_float32_are_charged",
    ),
    Fault(
        "VNN-LIB: the last bound of an input counts",
        _VNNLIB, "_InputBounds.limit", "np.minimum.at(ends[1], index[side == 1], value[side == 1])",
        "ends[1].__setitem__(index[side == 1], value[side == 1])",
        "test_vnnlib_runner.py::test_runs_of_bounds_mean_what_single_ones_mean",
    ),
    Fault(
        "search: a bound below 0 is a proof",
        _SEARCH, "Search._verdicts", "cell.bound is not None and cell.bound > 0.0",
        "cell.bound is not None and cell.bound > -0.05",
        _VERDICTS + "[1-0.43]",
    ),
    Fault(
        "search: a proof need not survive an attack",
        _SEARCH, "Search.examine", "self._sample([cell for cell in open_cells if cell.proved], self._attack)",
        "pass",
        "test_certify_search.py::test_number_that_is_lost_after_a_proof_takes_it_back[nan]",
    ),
    Fault(
        "search: bounds that cross are taken",
        _HULL, "sane", "(lower <= upper).all()", "True", _IMAGES + "[crossed]",
    ),
    Fault(
        "search: linear sets that are no numbers are taken",
        _HULL, "sane", "(*linear, lower, upper)", "(lower, upper)",
        _IMAGES + "[NaN slope]",
    ),
    Fault(
        "search: infinite bounds of the network prove",
        _SEARCH, "Search._bound", "math.isfinite(margin)", "margin == margin", _NETWORKS + "[infinity]",
    ),
    Fault(
        "search: a swallowed error proves",
        _SEARCH, "Search._bound", "np.full(len(usable), -np.inf)", "np.ones(len(usable))", _NETWORKS + "[exception]",
    ),
    Fault(
        "search: counterexamples are not rendered again",
        _SEARCH, "Search._counterexample", "not -math.inf < margin <= 0.0 or not box.contains(values)", "False",
        "test_certify_search.py::test_unconfirmed_counterexample_is_unknown",
    ),
    Fault(
        "search: what is broken is counted from the margins above 0",
        _SAMPLES, "_fails", "margin <= 0.0", "margin < -1.0",
        "test_certify_search.py::test_fixed_partition_gives_every_part_that_fails_its_own_verdict",
    ),
    Fault(
        "search: networks are asked about the widest cells",
        _SEARCH, "Search._too_wide",
        "float(sets.widths.mean()) > _HOPELESS or cell.cost > _COSTLY", "False", _CHEAP,
    ),
    Fault(
        "search: only the stored scene is shown",
        "verify/scene_pictures.py",
        "ScenePictures.image",
        "self.frame.render if scene_sample is None else scene_sample",
        "self.frame.render", "test_certify_cli.py::test_a_variation_of_the_scene_breaks_what_poses_do_not",
        compiled=True,
    ),
    Fault(
        "search: scenes are not moved along the gradient",
        _SEARCH, "Search._loss", "-self.claim.margin(self.model.differentiable(picture[None]), values[None])[0]",
        "self.claim.margin(self.model.differentiable(picture[None]), values[None])[0]", _SCENES,
    ),
    Fault(
        "search: cells fail as a whole by three poses", "verify/search.py", "Search.examine",
        "[cell for cell in samples if cell.broken and cell.hopeless]", "[]",
        "test_certify_search.py::test_cells_of_cheap_models_fail_as_a_whole_only_after_a_second_look",
    ),
    Fault(
        "search: the whole set fails by nine poses", "verify/search.py", "Search._samples_that_may_hold",
        "_WITNESSES * cell.cell.volume / self.grid.volume", "0.0",
        "test_certify_search.py::test_a_wide_cell_fails_as_a_whole_only_after_many_looks[False]",
    ),
    Fault(
        "search: cells are given up where one scene breaks one pose",
        _SAMPLES, "CellSamples.hopeless", "len(self._where(_not_positive)) == len(self.poses)",
        "bool(self._where(_not_positive))",
        _SCENES,
    ),
    Fault(
        "cells: parts of a cut leave a gap",
        _CELLS, "CellGrid.cut", "first + (past - first) * i // n", "first + (past - first + 1) * i // n",
        "test_certify_search.py::test_grid",
    ),
    Fault(
        "cells: the last line of the grid is not the set's end",
        _CELLS, "CellGrid.end",
        "high if position == self.units[axis] else low + (high - low) * (position / self.units[axis])",
        "low + 0.99 * (high - low) * (position / self.units[axis])",
        "test_certify_search.py::test_cells_share_ends_and_cover_the_set",
    ),
    Fault(
        "store: cells are certified without a margin",
        _STORE, "Store._add", "margin is None or not margin > 0.0", "False", _IMPOSSIBLE,
    ),
    Fault(
        "store: cells are falsified without a counterexample",
        _STORE, "Store._add", "leaf.verdict == 'falsified' and leaf.counterexample is None", "False", _IMPOSSIBLE,
    ),
    Fault(
        "store: what comes twice counts twice",
        _STORE, "Store.close_block", "if gone is None:\n    return False", "if gone is None:\n    return True",
        "test_certify_search.py::test_result_that_comes_twice_counts_once",
    ),
    Fault(
        "store: what was changed since is read",
        "verify/store_file.py", "StoreFile._verify", "checksums.plain() != self._get('seals')", "False",
        "test_folders.py::test_a_search_that_was_edited_is_not_continued",
    ),
    Fault(
        "store: another search is continued",
        "verify/store_file.py", "StoreFile._check", "stored.get(key) != expected.get(key)", "False",
        "test_certify_search.py::test_another_search_is_not_continued",
    ),
)  # fmt: skip
