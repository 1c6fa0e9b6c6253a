"""The keys of camera paths that Nerfstudio's viewers and its Blender add-on write.

Lines are those of Nerfstudio 1.1.5; `docs/keys.md` is made from these tables.
"""

from __future__ import annotations

from ns_abstract.io.keys import Key, KeyTable

_READ, _RENDER, _PANEL = "cameras/camera_paths.py", "scripts/render.py", "viewer/render_panel.py"
_SAVE_AGAIN = "choose Perspective in the viewer's Render tab and save the path again"
_NO_CROP = "switch the crop off in the viewer and save the path again"
_CROP = "a crop box changes the picture and is not supported"
_TYPE = "only perspective cameras are bounded"
_TIME = "time of a scene that moves; such runs are refused"
_EDITOR = "how the viewer makes its path from keyframes; the path itself is in camera_path"
_EXTRA = Key("perturbation", "used", "the set of poses (ns-abstract)")
_INTRINSICS = (
    Key("fx", "used", "focal length in pixels, in place of fov, which ns-render takes (ns-abstract)"),
    Key("fy", "used", "vertical focal length in pixels; without it fx (ns-abstract)"),
    Key("cx", "used", "principal point from the left edge in pixels; without it the middle (ns-abstract)"),
    Key("cy", "used", "principal point from the top edge in pixels; without it the middle (ns-abstract)"),
)

PATH = KeyTable(
    "The camera path",
    (
        Key("camera_path", "used", "the cameras", f"{_READ}:152"),
        Key("keyframes", "used", "the camera, where camera_path is empty and there is one keyframe", f"{_PANEL}:1086"),
        Key("camera_type", "refused", _TYPE, f"{_READ}:142", ("perspective",), fix=_SAVE_AGAIN),
        Key("render_height", "used", "height of the picture", f"{_READ}:133"),
        Key("render_width", "used", "width of the picture", f"{_READ}:134"),
        Key("default_fov", "used", "the field of view of entries that have none", f"{_PANEL}:1082"),
        Key("fps", "irrelevant", "frames per second in the viewer", f"{_PANEL}:1090"),
        Key("is_cycle", "used", 'with "sweep": "segments": the leg from the last entry to the first', f"{_PANEL}:1092"),
        Key("crop", "refused", _CROP, f"{_RENDER}:395", (None,), fix=_NO_CROP),
        Key("seconds", "irrelevant", "length of the video", f"{_RENDER}:463"),
        Key("default_time", "irrelevant", _TIME, f"{_PANEL}:1084"),
        Key("default_transition_sec", "irrelevant", _EDITOR, f"{_PANEL}:1085"),
        Key("smoothness_value", "irrelevant", _EDITOR, f"{_PANEL}:1093"),
        _EXTRA,
        *_INTRINSICS,
        Key("$schema", "irrelevant", "of editors"),
    ),
)

ENTRY = KeyTable(
    "An entry of `camera_path`",
    (
        Key("camera_to_world", "used", "the pose", f"{_READ}:154"),
        Key("fov", "used", "the vertical field of view; null is refused", f"{_READ}:167"),
        Key("aspect", "irrelevant", "the picture has render_width and render_height", f"{_PANEL}:1113"),
        Key("render_time", "irrelevant", _TIME, f"{_READ}:173"),
        Key("camera_type", "refused", _TYPE, "", ("perspective",), fix=_SAVE_AGAIN),
        Key("crop", "refused", _CROP, "", (None,), fix=_NO_CROP),
        _EXTRA,
        *_INTRINSICS,
    ),
)

KEYFRAME = KeyTable(
    "An entry of `keyframes`",
    (
        Key("matrix", "used", "the pose, where camera_path is empty and this is the one keyframe", f"{_PANEL}:1070"),
        Key("fov", "used", "its vertical field of view", f"{_PANEL}:1071"),
        *_INTRINSICS,
        Key("aspect", "irrelevant", "the picture has render_width and render_height", f"{_PANEL}:1072"),
        Key("override_transition_enabled", "irrelevant", _EDITOR, f"{_PANEL}:1073"),
        Key("override_transition_sec", "irrelevant", _EDITOR, f"{_PANEL}:1074"),
        Key("override_time_enabled", "irrelevant", _TIME, f"{_PANEL}:1080"),
        Key("render_time", "irrelevant", _TIME, f"{_PANEL}:1077"),
        Key("properties", "irrelevant", "names, times and fields of view of the viewer before 1.0; fov holds the last"),
    ),
)

TABLES = (PATH, ENTRY, KEYFRAME)
