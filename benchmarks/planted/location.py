"""Faults in what a photo excludes, and in the boxes of poses that are left."""

from planted.fault import Fault

_PHOTO, _SEARCH, _COVER = "verify/photo.py", "verify/location.py", "verify/location_cover.py"
_CELLS, _ROUNDS, _MOTION = "verify/cell_boxes.py", "verify/pixel_rounds.py", "verify/motion_boxes.py"
_MET = "test_motion_boxes.py::test_sub_boxes_are_excluded_by_all_motion_cells_of_their_poses[2-1]"
_ENDS = "test_locate.py::test_a_photo_allows_its_noise_and_every_rounding"
_BRIGHT = "test_locate_sequence.py::test_values_before_any_brightness_are_held"
_DIFFERENCES = (
    "test_channel_differences.py::test_pictures_that_explain_a_pixel_have_differences_within_its_ends[brightness0]"
)
_REACH = "test_locate.py::test_contraction_keeps_every_pose_that_explains_the_photo"
_NUMBERS = "test_locate.py::test_what_is_no_number_explains_and_excludes_nothing"
_SLABS = "test_locate.py::test_slabs_and_the_inner_cell_tile_a_cell"
_EMPTY = "test_locate.py::test_sub_boxes_that_are_left_are_kept"
_LINES = "test_locate.py::test_numbers_of_sub_boxes_divide_the_units"
_HEIRS = "test_pixel_rounds.py::test_a_part_inherits_what_excludes_all_of_it"
_SEQUENCE, _FOLLOWED = "api/sequence.py", "test_locate_sequence.py::test_a_sequence_is_followed_and_resumed"
_KNOWN = "test_locate.py::test_known_outliers_exclude_a_cell_without_bounds"
_BOXES = "test_locate.py::test_a_cover_holds_every_pose_of_sheared_boxes"

LOCATION = (
    Fault(
        "photos: values of 16 bits are cut", "io/photos.py", "other_bits", 're.search(r";\\d\\d", str(raw))', "False",
        "test_photos.py::test_values_that_are_no_bytes_are_refused[16 bits.png]",
    ),
    Fault(
        "location: gains above 1 alone are looked at",
        _PHOTO, "Brightness.before", "[moved / gain for gain in self.gain]", "[moved / self.gain[1]]", _BRIGHT,
    ),
    Fault(
        "location: what a camera clips is taken for what it shows",
        _PHOTO, "Brightness.before", "np.where(high >= 1.0, np.inf, ends[1])", "ends[1]", _BRIGHT,
    ),
    Fault(
        "location: the offset brightens one end and darkens the other",
        _PHOTO, "Brightness.before", "(low, -1.0, self.offset[1])", "(low, -1.0, self.offset[0])", _BRIGHT,
    ),
    Fault(
        "location: a set grows to one side alone",
        "api/sequence.py", "grown", "hull[name][0] + low", "hull[name][0]",
        "test_locate_sequence.py::test_a_grown_set_holds_every_pose_that_a_motion_leads_to",
    ),
    Fault(
        "location: a camera stays on its segment",
        "api/sequence.py", "following", '_along_path(sets)', "False",
        "test_locate_sequence.py::test_a_camera_leaves_one_segment_for_another",
    ),
    Fault(
        "location: a camera stays on the segments of the first photo",
        _SEQUENCE, "PhotoSequence.__post_init__", "_along_path(self.sets)", "False",
        "test_locate_sequence.py::test_a_camera_leaves_the_segments_that_it_began_in", compiled=True,
    ),
    Fault(
        "location: offsets of one segment alone go on",
        "api/sequence.py", "following", "max(high for _, high in ranges)", "ranges[0][1]",
        "test_locate_sequence.py::test_a_camera_leaves_one_segment_for_another",
    ),
    Fault(
        "location: offsets that are fixed in a segment are taken for 0",
        "api/sequence.py", "following", "(value, value)", "(0.0, 0.0)",
        "test_locate_sequence.py::test_an_offset_that_is_fixed_in_one_segment_is_taken_to_the_next[0.05]",
    ),
    Fault(
        "location: photos in the order of their names alone",
        "io/photos.py", "sequence_photos", "_numbered(after) < _numbered(before)", "False",
        "test_locate_sequence.py::test_photos_come_in_the_order_of_their_numbers",
    ),
    Fault(
        "location: a rounded product takes an outlier away",
        "verify/pixel_parts.py", "most_within", "max(k for k in (near - 1, near, near + 1) if k / count <= part)",
        "near", "test_pixel_parts.py::test_photos_may_miss_as_many_pixels_as_is_said",
    ),
    Fault(
        "location: rounding to 8 bits is left out of the noise",
        _PHOTO, "Photo.shown", "(0.5 + STEP) / _STEPS", "STEP / _STEPS", _ENDS,
    ),
    Fault(
        "location: the photo's own rounding is not charged",
        _PHOTO, "Photo.shown", "self.noise + (0.5 + STEP) / _STEPS + QUOTIENT + PHOTO_ROOM",
        "self.noise + 0.5 / _STEPS", _ENDS,
    ),
    Fault(
        "location: differences of clamped values are taken for what they are",
        _PHOTO, "TiledPhoto.differences", "np.where(self.high >= 1.0, np.inf, self.high)", "self.high", _DIFFERENCES,
    ),
    Fault(
        "location: differences of values clamped at 0 are taken for what they are",
        _PHOTO, "TiledPhoto.differences", "np.where(self.low <= 0.0, -np.inf, self.low)", "self.low", _DIFFERENCES,
    ),
    Fault(
        "location: both channels of a difference at the same end",
        _PHOTO, "TiledPhoto.differences", "low[..., FIRST_CHANNELS] - high[..., SECOND_CHANNELS]",
        "low[..., FIRST_CHANNELS] - low[..., SECOND_CHANNELS]",
        _DIFFERENCES,
    ),
    Fault(
        "location: pixels of one kind take the bounds of the other",
        "methods/splat/frame.py", "SplatFrame.sub_box_ends",
        "difference_ends(bounds, scale) if chosen is differences else part_ends(bounds)", "part_ends(bounds)",
        "test_channel_differences.py::test_a_frame_bounds_differences_of_blocks_of_many_orders",
    ),
    Fault(
        "location: what reaches beyond the set is within it",
        "geometry/enclosing_boxes.py", "box_of_motion",
        "whole.contains(np.array(cell.lower)) and whole.contains(np.array(cell.upper))",
        "whole.contains(np.array(cell.lower))",
        "test_enclosing_cells.py::test_what_reaches_beyond_the_set_has_none_around_it",
    ),
    Fault(
        "location: a cell around another shows what its middle does",
        "methods/splat/frame.py", "SplatFrame._context", "self.pose_set.enclosure(box, self.order)",
        "self.pose_set.enclosure(box.with_ends(box.middle, box.middle), self.order)",
        "test_enclosing_cells.py::test_pixels_have_the_ends_that_all_gaussians_leave",
    ),
    Fault(
        "location: differences are compared with channels",
        _PHOTO, "TiledPhoto._explaining", "differences is None or not differences.any()", "True",
        "test_channel_differences.py::test_differences_exclude_what_channels_leave",
    ),
    Fault(
        "location: as many pixels as are allowed cut a cell",
        _PHOTO, "TiledPhoto.reach", "np.partition(up, self.allowed)[self.allowed]",
        "np.partition(up, self.allowed)[max(0, self.allowed - 1)]", _REACH,
    ),
    Fault(
        "location: a pixel's reach forgets the other parameters",
        _PHOTO, "TiledPhoto.reach", "(room + (steep - np.abs(slope))) / slope", "room / slope", _REACH,
    ),
    Fault(
        "location: reaches are not charged for rounding",
        _PHOTO, "TiledPhoto.reach", "room + REACH_ROUNDING * (size + steep)", "room - 1e-9 * (size + steep)", _REACH,
    ),
    Fault(
        "location: upper bounds are taken for lower ones",
        _PHOTO, "TiledPhoto.reach", "b_upper - low", "b_lower - low", _REACH,
    ),
    Fault(
        "location: bounds that cross exclude pixels",
        _PHOTO, "TiledPhoto.beyond", "(lower <= upper).all(axis=-1)", "np.isfinite(lower).all(axis=-1)", _NUMBERS,
    ),
    Fault(
        "location: what is no number explains a pixel",
        _PHOTO, "TiledPhoto.outside", "~((picture >= self.low) & (picture <= self.high)).all(axis=-1)",
        "((picture < self.low) | (picture > self.high)).any(axis=-1)", _NUMBERS,
    ),
    Fault(
        "location: cuts are rounded inward",
        _CELLS, "between", "middle + half * float(most[k]) + room", "middle + half * float(most[k]) - 1e-9", _REACH,
    ),
    Fault(
        "location: the last slab is left out",
        _CELLS, "slabs", "inner.past[k] < cell.past[k]", "inner.past[k] < cell.past[k] and k > 0", _SLABS,
    ),
    Fault(
        "location: sub-boxes whose bounds cross are excluded",
        _PHOTO, "TiledPhoto.excluding", "(lower <= upper).all(axis=1)", "np.ones(lower.shape[::2], bool)", _NUMBERS,
    ),
    Fault(
        "location: a sub-box that is left is called empty",
        _CELLS, "divided", "replace(inner, past=(*inner.past[:axis], line, *inner.past[axis + 1 :]))",
        "replace(inner, past=(*cell.past[:axis], line, *cell.past[axis + 1 :]))", _EMPTY,
    ),
    Fault(
        "location: rounding of lines may exceed the overlap of sub-boxes",
        _CELLS, "resolved", "SUB_BOX_LINES * 0.5 * (high - low)", "(high - low)", _LINES,
    ),
    Fault(
        "location: sub-boxes do not divide a cell's units",
        _CELLS, "sub_box_counts", "np.minimum(sizes & -sizes, most)", "np.minimum(sizes, most)", _LINES,
    ),
    Fault(
        "location: a round counts a pixel twice",
        _ROUNDS, "PixelRounds.take", "(pixels & ~self.bounded)[pixels]", "pixels[pixels]",
        "test_pixel_rounds.py::test_a_pixel_counts_once",
    ),
    Fault(
        "location: a pixel that is inherited counts again",
        _ROUNDS, "PixelRounds.__init__", "self.bounded = self.inherited.copy()",
        "self.bounded = np.zeros_like(self.inherited)", _HEIRS,
    ),
    Fault(
        "location: a pixel that excludes one sub-box of a part is inherited",
        _ROUNDS, "PixelRounds.excluded", "excluding[:, sub_boxes].all(axis=1)",
        "excluding[:, sub_boxes].any(axis=1)", _HEIRS,
    ),
    Fault(
        "location: the last sub-box that meets a part is left out",
        _CELLS, "meeting", "-((first - b) // unit)", "max((b - first) // unit, (a - first) // unit + 1)", _HEIRS,
    ),
    Fault(
        "location: as many known outliers as are allowed exclude a cell",
        _SEARCH, "_Examination.run", "self.inherited.sum() > search.tiled.allowed",
        "self.inherited.sum() >= search.tiled.allowed", _KNOWN,
    ),
    Fault(
        "location: a wide set begins without its last part",
        _SEARCH, "LocationSearch.first_cells", "return examination.children", "return examination.children[:-1]",
        "test_locate.py::test_sub_boxes_are_shared_out_by_motion[xyz-turns2]",
    ),
    Fault(
        "location: the outliers allowed are those of the pixels bounded",
        _ROUNDS, "PixelRounds.left", "self.photo.allowed",
        "self.photo.allowed * self.bounded.sum() // self.photo.counted.sum()",
        "test_pixel_rounds.py::test_the_outliers_are_those_of_the_whole_photo",
    ),
    Fault(
        "location: a pixel that was not bounded counts as outside",
        _ROUNDS, "BoundedPixels.__init__",
        "self.lower, self.upper = np.full(shape, np.nan), np.full(shape, np.nan)",
        "self.lower, self.upper = np.zeros(shape), np.zeros(shape)",
        "test_pixel_rounds.py::test_pixels_that_were_not_bounded_exclude_and_cut_nothing",
    ),
    Fault(
        "location: pixels that do not count exclude sub-boxes",
        _PHOTO, "TiledPhoto.excluding", "beyond & self.counted[pixels][:, None]", "beyond",
        "test_pixel_rounds.py::test_pixels_that_do_not_count_exclude_nothing",
    ),
    Fault(
        "motion cells: slopes beside the motion are left out",
        "methods/splat/alphas.py", "_along_motion", "rest + abs(load8(rows, at + 16 * (k + 1)) - along)", "rest",
        "test_bounds.py::test_motion_cells_hold_every_map", compiled=True,
    ),
    Fault(
        "motion cells: the first axis of the motion alone widens a part",
        "methods/splat/alphas.py", "_along_motion", "half[1]", "0.0 * half[1]",
        "test_bounds.py::test_motion_cells_hold_every_map", compiled=True,
    ),
    Fault(
        "motion cells: a pixel takes its neighbour's motion",
        "methods/splat/pixel_block.py", "take_motion", "place.x0 + q % BLOCK", "place.x0 + (q + 1) % BLOCK",
        "test_bounds.py::test_motion_cells_hold_every_map", compiled=True,
    ),
    Fault(
        "motion cells: the image of a box is its middle's",
        _MOTION, "_excluded", "(q0 + reach0)", "q0", _MET, compiled=True,
    ),
    Fault(
        "motion cells: the last one that a box meets is left out",
        _MOTION, "_excluded", "min(max(int(0.5 * columns * (q1 + reach1)), 0), columns - 1) + 1",
        "min(max(int(0.5 * columns * (q1 + reach1)), 0), columns - 1)", _MET, compiled=True,
    ),
    Fault(
        "motion cells: a pixel in tiles has the motion of another",
        _MOTION, "MotionBoxes.excluded", "across * side + column", "column", _MET,
    ),
    Fault(
        "motion cells: the motion leaves its square",
        "geometry/motion_cells.py", "MotionField.cells", "MOTION_SCALE * self.pixels", "2.0 * self.pixels", _MET,
    ),
    Fault(
        "location: a shear moves the ends of boxes one way",
        _COVER, "ShearedBoxes.within", "least + np.minimum(a, b)", "least + np.maximum(a, b)", _BOXES,
    ),
    Fault(
        "location: poses at the edge of a set are left out of what is possible",
        _COVER, "ShearedBoxes.volume_within", "np.maximum(first - shift, shift - last)",
        "np.maximum(shift - first, last - shift)",
        "test_locate.py::test_the_volume_of_sheared_boxes_within_a_set[shear1]",
    ),
    Fault(
        "location: a cell is possible by a pose beside it",
        _SEARCH, "_Examination._approximate_tiles", "picture, self.nearby = nearby", "picture, self.best = nearby",
        "test_locate.py::test_a_pose_beside_a_cell_does_not_make_it_possible", compiled=True,
    ),
    Fault(
        "a sequence goes on with what others have made of its report",
        _SEQUENCE, "PhotoSequence._stored", 'e.get("sha256") == _seal(e)', "True", _FOLLOWED, compiled=True,
    ),
    Fault(
        "a sequence goes on without photos that it had",
        _SEQUENCE, "PhotoSequence._stored", "itertools.zip_longest(entries, self.images[: len(entries)])",
        "zip(entries, self.images, strict=False)", _FOLLOWED, compiled=True,
    ),
    Fault(
        "a sequence replaces files of others",
        _SEQUENCE, "PhotoSequence.follow", "claim(self.folder)",
        "__import__('contextlib').nullcontext(self.folder.mkdir(exist_ok=True))",
        "test_locate_sequence.py::test_files_of_others_are_not_replaced_by_a_sequence", compiled=True,
    ),
)  # fmt: skip
