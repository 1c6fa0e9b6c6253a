"""Faults in what is read of other programs' files, and in the legs of paths."""

from planted.fault import Fault

_PATH, _KEYS, _CONFIG = "geometry/camera_path.py", "io/keys.py", "methods/config_keys.py"
_SAID = "test_keys.py::test_keys_that_may_change_the_picture_are_refused"

INPUTS = (
    Fault(
        "a closed path ends at its last entry",
        _PATH,
        "CameraPath.following",
        "self.is_cycle and len(self.cameras) > 1",
        "False",
        "test_cycle.py::test_every_entry_of_a_closed_path_sweeps_its_leg",
    ),
    Fault(
        "the closing leg leads to the second entry",
        _PATH,
        "CameraPath.following",
        "self.cameras[0]",
        "self.cameras[1]",
        "test_cycle.py::test_poses_of_the_closing_leg[3]",
    ),
    Fault(
        "fingerprints do not know where a leg ends",
        "api/job.py",
        "Job._fingerprint",
        "poses.target_camera is not None",
        "False",
        "test_cycle.py::test_fingerprints_know_where_a_leg_ends",
    ),
    Fault(
        "segments of one camera are taken for its pose alone",
        "api/poses.py",
        "PoseSet.from_json",
        "following is _UNSAID",
        "False",
        "test_cycle.py::test_segments_without_the_next_keyframe_are_refused",
    ),
    Fault(
        "unknown keys of a model are not refused",
        _CONFIG,
        "check_keys",
        "inner and refuse_unknown",
        "False",
        _SAID,
    ),
    Fault(
        "keys below a listed one are not looked at",
        _KEYS,
        "KeyTable.unknown",
        "mapping(value) if name in self._sections else None",
        "None",
        _SAID,
    ),
    Fault(
        "values that are refused are taken",
        _KEYS,
        "Key.refused",
        'self.status == "refused"',
        "False",
        _SAID,
    ),
    Fault(
        "values that are not supported are taken",
        _KEYS,
        "Key.refused",
        "_among(value, self.refuses)",
        "False",
        _SAID,
    ),
    Fault(
        "keys of our own files are ignored where they are unknown",
        "io/fields.py",
        "known",
        "key not in keys",
        "False",
        "test_keys.py::test_unknown_keys_of_a_perturbation_file_are_errors[]",
    ),
    Fault(
        "unknown keys of an entry of a camera path are not named",
        _PATH,
        "_entries",
        'unknown += [f"{name}[].{key}" for key in table.unknown(entry, f"{field}.")]',
        'table.unknown(entry, f"{field}.")',
        "test_keys.py::test_unknown_keys_of_a_path_are_named_in_the_report",
    ),
    Fault(
        "three.js' matrix of a keyframe in the origin is read row by row",
        _PATH,
        "_keyframe_matrix",
        "numbers[3::4] != [0, 0, 0, 1]",
        "True",
        "test_keys.py::test_a_text_of_rows_is_told_from_one_of_columns",
    ),
    Fault(
        "sets of single entries are lost",
        "perturbation/specification.py",
        "_refuse_overrides",
        'entry.get("perturbation") is not None',
        "False",
        "test_keys.py::test_sets_of_entries_are_not_lost_in_a_path_that_serves_as_perturbation_file",
    ),
)
