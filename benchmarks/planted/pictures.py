"""Faults in properties of the picture: blending weights, depths, measures and claims."""

from planted.fault import Fault

_WEIGHTS, _WHITE = "methods/splat/weights.py", "methods/nerf/white.py"
_MEASURES, _PROPERTIES, _QUESTION = (
    "verify/picture_measures.py", "verify/picture_properties.py", "api/picture_question.py",
)  # fmt: skip
_CROSS = "test_picture_weights.py::test_what_crosses_the_distance_counts_as_both"
_SAMPLES = "test_picture_weights.py::test_weights_of_samples_stay_inside[spec0]"
_INSIDE = "test_picture_properties.py::test_measures_stay_inside[2]"
_TREES = "test_picture_properties.py::test_claims_are_trees"
_DEPTHS = "test_picture_properties.py::test_depths_where_nothing_may_be_drawn"
_SETTLED, _ENCLOSING, _NEARBY = (
    "verify/settled_pixels.py", "geometry/enclosing_boxes.py", "api/nearby_pictures.py",
)  # fmt: skip
_PARTS, _HOLD = "verify/part_proofs.py", "test_part_proofs.py::test_parts_that_are_decided_are_so_everywhere[2]"
_LEFT = "test_nearby_pictures.py::test_parts_of_a_cell_bound_what_its_sub_boxes_leave_open"
_CHANGE = "test_nearby_pictures.py::test_settled_pixels_change_no_verdict"
_NEAR = "test_nearby_pictures.py::test_pictures_near_a_cell_are_those_of_the_set"
_RAYS = "test_picture_weights.py::test_the_brightest_rays_are_bounded_first"

PICTURES = (
    Fault(
        "properties of the picture: a rounded product asks for one more pixel",
        "verify/pixel_parts.py", "fewest_reaching", "min(k for k in (near - 1, near, near + 1) if k / count >= part)",
        "near", "test_pixel_parts.py::test_no_more_pixels_are_asked_for_than_is_said",
    ),
    Fault(
        "depths: both ends of tiles that lie one below the other are the last one",
        "geometry/tiles.py", "assemble", "image.copy() if np.may_share_memory(image, tiles) else image", "image",
        "test_picture_properties.py::test_depths_stay_inside_whatever_tiles_pictures_have[16-16]", compiled=True,
    ),
    Fault(
        "weights: what may be nearer is not", _WEIGHTS, "WhiteGaussians.between", "~(low[:, None] >= self.nearer)",
        "high[:, None] < self.nearer", _CROSS,
    ),
    Fault(
        "weights: what may be nearer surely is", _WEIGHTS, "WhiteGaussians.between", "high[:, None] < self.nearer",
        "low[:, None] < self.nearer", _CROSS,
    ),
    Fault(
        "weights: what depths have in common does not move", _WEIGHTS, "WeightBounds._camera_depth_bounds",
        "forms.offset.data[:m + 1, 2]", "forms.offset.data[0, 2] * (np.arange(m + 1) == 0)", _CROSS,
    ),
    Fault(
        "weights: the depth's own rounding is forgotten", _WEIGHTS, "WeightBounds._camera_depth_bounds",
        "np.abs(depths[:, 1:]).sum(axis=1)", "np.abs(depths[:, 1:m]).sum(axis=1)",
        "test_picture_weights.py::test_depths_are_rounded",
    ),
    Fault(
        "weights: the background stays", _WEIGHTS, "SplatWeightFrame.__init__", "np.zeros(3)", "splats.background",
        "test_picture_weights.py::test_weights_stay_inside[pose-classic]",
    ),
    Fault(
        "weights: samples that may be in the box are not", _WHITE, "WhiteSamples.between",
        "((high < self.lower) | (low > self.upper)).any(axis=2)", "~surely", _SAMPLES,
    ),
    Fault(
        "weights: samples that may be in the box surely are", _WHITE, "WhiteSamples.between",
        "((low >= self.lower) & (high <= self.upper)).all(axis=2)",
        "((high >= self.lower) & (low <= self.upper)).all(axis=2)", _SAMPLES,
    ),
    Fault(
        "measures: parts are looked at in their middles", _MEASURES, "PlaneSets.over",
        "sign * (parts.halves @ np.abs(slopes))", "0.0", _INSIDE,
    ),
    Fault(
        "measures: a difference takes the lower side of both", _MEASURES, "Measure.bounds", "low - taken[1]",
        "low - taken[0]", _INSIDE,
    ),
    Fault(
        "measures: one rank too high", _MEASURES, "Measure._statistic_bounds", "len(pixels) - self.rank",
        "min(len(pixels) - 1, len(pixels) - self.rank + 1)", _INSIDE,
    ),
    Fault(
        "measures: means of the upper planes from below", _MEASURES, "Measure._mean_bounds",
        "0 if sign * weight > 0.0 else 2", "2 if sign * weight > 0.0 else 0", _INSIDE,
    ),
    Fault(
        "measures: what all rows share is not sorted", _MEASURES, "ranked", "np.sort(values[0, ~varies])",
        "values[0, ~varies]", "test_picture_properties.py::test_ranks_are_those_of_whole_rows",
    ),
    Fault(
        "settled pixels: one bright pixel too few is enough", _SETTLED, "unsettled",
        "int(above.sum()) < needed <= total - int(below.sum())",
        "int(above.sum()) < needed - 1 < total - int(below.sum())", _CHANGE,
    ),
    Fault(
        "settled pixels: too few may be bright where one more may", _SETTLED, "unsettled",
        "int(above.sum()) < needed <= total - int(below.sum())",
        "int(above.sum()) < needed < total - int(below.sum())", _CHANGE,
    ),
    Fault(
        "settled pixels: what may be bright is dark", _SETTLED, "unsettled", "ends[1] < limit - _TUNING.room",
        "ends[0] < limit - _TUNING.room", _CHANGE,
    ),
    Fault(
        "enclosing boxes: lines of the grid cut cells", _ENCLOSING, "_aligned",
        "min(high, max(upper, cell.upper[axis]))", "min(high, upper)",
        "test_nearby_pictures.py::test_enclosing_boxes_hold_cells_and_are_shared",
    ),
    Fault(
        "enclosing boxes: those around them are cut as finely along all parameters", _ENCLOSING, "shared_box",
        "[max(0, level - less) for less in spared]", "[max(0, level) for less in spared]",
        "test_nearby_pictures.py::test_boxes_around_enclosing_boxes_hold_them_and_are_few",
    ),
    Fault(
        "near cells: cuts are compared by the uncut cell", _NEARBY, "NearbyPictures.cut_gains",
        "(box, *halves)", "[box] * (1 + len(halves))",
        "test_nearby_pictures.py::test_cuts_are_compared_by_what_they_narrow",
    ),
    Fault(
        "cells: compared cuts are not made", "verify/search.py", "Search._verdicts",
        "scene.cut_gains(cell.box) if isinstance(scene, ComparedCuts) else cell.slopes", "cell.slopes",
        "test_certify_search.py::test_cells_are_cut_where_bounds_narrow_most",
    ),
    Fault(
        "proved parts: what misses a proof by little is proved", _PARTS, "PartQuestion.parts", "low > 0.0",
        "low > -0.05", _HOLD,
    ),
    Fault(
        "proved parts: what misses a refutation by little is refuted", _PARTS, "PartQuestion.parts", "high <= 0.0",
        "high <= 0.05", _HOLD,
    ),
    Fault(
        "proved parts: lower bounds refute, too", _PROPERTIES, "PictureClaim.refuted",
        "[-fall - low]", "[rise - low]", _HOLD,
    ),
    Fault(
        "proved parts: the best of some parts counts for all", _PARTS, "_tiled",
        "margins[0][equal].min()", "margins[0][equal].max()",
        "test_part_proofs.py::test_a_part_s_margin_is_its_least",
    ),
    Fault(
        "proved parts: the worst of some parts counts for all that are refuted", _PARTS, "_tiled",
        "margins[1][equal].max()", "margins[1][equal].min()",
        "test_part_proofs.py::test_a_part_s_margin_is_its_least",
    ),
    Fault(
        "proved parts: they end at grid lines that are rounded", _PARTS, "PartQuestion.parts",
        "not resolved(box, counts)", "False", "test_part_proofs.py::test_parts_overlap",
    ),
    Fault(
        "proved parts: they do not overlap", _MEASURES, "CellParts.equal", "halves + overlap", "halves",
        "test_part_proofs.py::test_parts_overlap",
    ),
    Fault(
        "proved parts: those of the other end are meant", _PROPERTIES, "MeasureModel.bound_parts",
        "rows.reshape(len(rows), -1)", "rows[::-1].reshape(len(rows), -1)", _HOLD,
    ),
    Fault(
        "proved parts: they are not attacked", "verify/search.py", "Search._verdicts",
        "cell.check_proof(within, part.margin)", "pass", "test_part_proofs.py::test_parts_are_attacked",
    ),
    Fault(
        "proved parts: refuted ones are not attacked", "verify/cell_samples.py", "CellSamples.check_refutation",
        "0.0 < margin < math.inf", "False",
        "test_part_proofs.py::test_parts_that_are_refuted_are_attacked",
    ),
    Fault(
        "proved parts: sets of a part that are no numbers decide it", _PARTS, "PartQuestion.bounded",
        "not sane(linear, lower, upper)", "False",
        "test_part_proofs.py::test_sets_of_a_part_that_cross_decide_nothing",
    ),
    Fault(
        "proved parts: units of a fixed partition are refuted together", "verify/search.py", "Search._decided_parts",
        "not self.every_unit", "True",
        "test_part_proofs.py::test_refuted_parts_are_falsified_at_once",
    ),
    Fault(
        "near cells: settled pixels have their lower bounds", _NEARBY, "NearbyPictures._sets",
        "box_bounds.upper.copy()", "box_bounds.lower.copy()", _NEAR,
    ),
    Fault(
        "near cells: sub-boxes are those of the other end", _NEARBY, "NearbyPictures._sets",
        "part[:, source].T", "part[:, source, ::-1].T",
        "test_nearby_pictures.py::test_bounds_over_sub_boxes_are_those_of_their_pictures",
    ),
    Fault(
        "near cells: pixels have their neighbours' bounds over sub-boxes", _NEARBY, "NearbyPictures._sets",
        "places[elements.tiles][pixels]", "places[elements.tiles][pixels][::-1]",
        "test_nearby_pictures.py::test_bounds_over_sub_boxes_are_those_of_their_pictures",
    ),
    Fault(
        "proved parts: bounds over sub-boxes are those of the other end", _MEASURES, "PlaneSets.over",
        "side[:, read, cut]", "side[::-1, found, cut]",
        "test_part_proofs.py::test_ends_over_sub_boxes_are_those_of_their_pixels",
    ),
    Fault(
        "near cells: enclosing boxes are believed", _NEARBY, "KnownBoxes._attack",
        "inside[bounded][:, self._channels].all()", "inside.size",
        "test_nearby_pictures.py::test_bounds_of_enclosing_boxes_are_attacked",
    ),
    Fault(
        "near cells: what a box leaves open is not drawn in the boxes inside", _NEARBY, "KnownBoxes._attack",
        "pictures.image(box.middle)", "0.5 * (lower + upper)",
        "test_nearby_pictures.py::test_bounds_inside_of_enclosing_boxes_are_attacked",
    ),
    Fault(
        "near parts: the best of the sub-boxes' lower ends counts", _NEARBY, "NearbyPictures.narrowed",
        "ends.lower[chosen].min(axis=0)", "ends.lower[chosen].max(axis=0)", _LEFT,
    ),
    Fault(
        "near parts: the best of the sub-boxes' upper ends counts", _NEARBY, "NearbyPictures.narrowed",
        "ends.upper[chosen].max(axis=0)", "ends.upper[chosen].min(axis=0)", _LEFT,
    ),
    Fault(
        "near parts: the sub-boxes are those of the other end", _NEARBY, "NearbyPictures.narrowed",
        "sub_boxes.ravel()", "sub_boxes.ravel()[::-1]", _LEFT,
    ),
    Fault(
        "near parts: ends that cross settle pixels", _NEARBY, "NearbyPictures.narrowed",
        "(ends.lower[chosen] <= ends.upper[chosen]).all(axis=0)", "np.isfinite(least)",
        "test_nearby_pictures.py::test_sub_boxes_without_bounds_settle_nothing",
    ),
    Fault(
        "near parts: a part has what is known of the whole cell's first sub-boxes", _PARTS, "narrowed",
        "meeting(cell, ends.counts, part)", "np.arange(ends.counts.prod()).reshape(ends.counts) < 1",
        "test_part_proofs.py::test_parts_are_narrowed_by_their_own_sub_boxes",
    ),
    Fault(
        "near cells: a Gaussian is not drawn", _WEIGHTS, "SplatWeightFrame.drawn_alone",
        "np.sort(some)", "np.sort(some)[1:]", _NEAR,
    ),
    Fault(
        "renders: neighbours of the pixels that are wanted are drawn", "methods/splat/render.py", "_blend_block",
        "pixels >> q", "pixels >> (q ^ 1)", "test_nearby_pictures.py::test_pixels_that_are_not_wanted_take_no_light",
    ),
    Fault(
        "rays: those that are left out are dark", "methods/nerf/frame.py", "FieldFrame.cell_bounds",
        "np.pad(upper, missing[:2], constant_values=1)", "np.pad(upper, missing[:2])", _RAYS,
    ),
    Fault(
        "rays: planes of those that are left out are dark", "methods/nerf/frame.py", "FieldFrame.cell_bounds",
        "k == 3", "k < 0", _RAYS,
    ),
    Fault(
        "rays: the brightest are put back in order", "methods/nerf/frame.py", "FieldFrame._every",
        "whole[self.rays] = part", "whole[np.sort(self.rays)] = part", _RAYS,
    ),
    Fault(
        "claims: any part of a cell will do", _PROPERTIES, "PictureClaim.proved",
        "_joined(self.statement, iter(lower), np.minimum, np.maximum).min(axis=1)",
        "_joined(self.statement, iter(lower), np.minimum, np.maximum).max(axis=1)",
        "test_picture_properties.py::test_parts_of_a_cell_must_all_hold",
    ),
    Fault(
        "claims: all is any", _PROPERTIES, "_joined", "least if statement.all else most", "most", _TREES,
    ),
    Fault(
        "claims: what is no number proves something", _PROPERTIES, "PictureClaim._ends",
        "np.where(np.isnan(side), -np.inf, side)", "np.nan_to_num(side)", _TREES,
    ),
    Fault(
        "depths: what may be empty is drawn", _QUESTION, "depth_range", "nothing | maybe", "nothing", _DEPTHS,
    ),
)  # fmt: skip
