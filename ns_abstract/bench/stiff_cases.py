"""The stiff cases: tiny scenes at the limits of what can be loaded."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import SH_C0
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import parse_perturbation

_EYE = np.eye(3, 4)
#: Opacities whose logit would be infinite get this one: its sigmoid underflows to 0.
_NEVER = -2000.0
_TURN = 2.0 * math.pi
_DISC = (1.0, 1.0, 1e-6)
_NEEDLE = (1.0, 1e-6, 1e-6)


@dataclass(frozen=True)
class Case:
    """One scene, camera and set, with a short unique name; at most about a thousand Gaussians and 48x48 pixels.

    ``spec`` is a perturbation object (the file's version 1), ``following`` the end of the segment where the sweep is
    over segments. ``blank``: whether every pose shows nothing but the background.
    """

    name: str
    scene: SplatScene = field(repr=False)
    camera: PinholeCamera = field(repr=False)
    spec: dict[str, Any]
    following: PinholeCamera | None = field(default=None, repr=False)
    blank: bool = False

    def pose_set(self) -> PoseBox:
        """Return the set of poses of the case."""
        return PoseBox.around(self.camera, parse_perturbation(self.spec), self.following)


def _camera(
    width: int = 20, height: int | None = None, fov: float = 60.0, focal: float | None = None, pose: ArrayLike = _EYE
) -> PinholeCamera:
    """Return a camera (vertical ``fov`` in degrees, or ``focal`` in pixels) that looks along its -z axis."""
    height = width if height is None else height
    focal = 0.5 * height / math.tan(math.radians(0.5 * fov)) if focal is None else focal
    return PinholeCamera(np.array(pose, np.float64), focal, focal, 0.5 * width, 0.5 * height, width, height)


def _scene(
    means: ArrayLike,
    scales: ArrayLike = 0.2,
    opacity: ArrayLike = 0.8,
    colors: ArrayLike | None = None,
    *,
    quats: ArrayLike | None = None,
    bands: ArrayLike | None = None,
    background: float = 0.0,
    antialiased: bool = False,
    model: Literal["sh", "sigmoid"] = "sh",
) -> SplatScene:
    """Return a scene of Gaussians with these standard deviations, opacities and colours, broadcast to it.

    ``means`` and ``scales`` are [N, 3], ``opacity`` [N] in [0, 1), ``colors`` [N, 3], logits for ``model`` "sigmoid",
    random if None; ``quats`` [N, 4]; ``bands`` [N, K - 1, 3] coefficients beyond band 0. ``antialiased``: whether
    opacities are compensated for the blur.
    """
    means = np.asarray(means, np.float64).reshape(-1, 3)
    n = means.shape[0]
    colors = np.random.default_rng(n).uniform(0.05, 0.95, (n, 3)) if colors is None else np.asarray(colors, np.float64)
    band = np.broadcast_to(colors, (n, 3))[:, None]
    sh = band if model == "sigmoid" else (band - 0.5) / SH_C0
    rest = np.zeros((n, 0, 3)) if bands is None else np.asarray(bands, np.float64)
    opacity = np.broadcast_to(np.asarray(opacity, np.float64), (n,))
    with np.errstate(divide="ignore"):
        logits = np.maximum(np.log(opacity) - np.log1p(-opacity), _NEVER)
    values = {
        "means": means,
        "log_scales": np.broadcast_to(np.log(np.asarray(scales, np.float64)), (n, 3)),
        "quats": np.broadcast_to((1.0, 0.0, 0.0, 0.0) if quats is None else np.asarray(quats, np.float64), (n, 4)),
        "opacity_logits": logits,
        "sh": np.concatenate([sh, rest], axis=1),
        "background": np.full(3, background),
    }
    return SplatScene(
        **{name: value.astype(np.float32) for name, value in values.items()},  # type: ignore[arg-type]
        color_model=model,
        sh_degree=math.isqrt(1 + rest.shape[1]) - 1,
        rasterize_mode="antialiased" if antialiased else "classic",
        name="stiff",
    )


def _cloud(count: int, seed: int = 0, *, depth: float = 2.0, spread: float = 0.7) -> np.ndarray:
    """Return [count, 3] points of a cube of half-side ``spread`` whose middle lies ``depth`` in front of the camera."""
    return np.random.default_rng(seed).uniform(-spread, spread, (count, 3)) - (0.0, 0.0, depth)


def _quats(count: int, seed: int = 1) -> np.ndarray:
    """Return [count, 4] quaternions of random rotations."""
    return np.random.default_rng(seed).normal(size=(count, 4))


def _turned(angle: float, position: ArrayLike) -> np.ndarray:
    """Return the pose [3, 4] at ``position``, turned by ``angle`` (radians) about the y axis."""
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return np.concatenate([turn, np.asarray(position, np.float64).reshape(3, 1)], axis=1)


def _orbit(low: float, high: float, target: ArrayLike = (0.0, 0.0, -2.0)) -> dict[str, Any]:
    return {
        "orbit": {"target": np.asarray(target, np.float64).tolist(), "axis": [0.0, 1.0, 0.0], "azimuth": [low, high]}
    }


def _shapes() -> list[Case]:
    """Return cases of extreme sizes and proportions of Gaussians."""
    camera, few = _camera(), _cloud(6)
    needles: dict[str, Any] = {"scales": _NEEDLE, "quats": _quats(6), "opacity": 0.95}
    # thick enough for the compensated opacity to stay above the threshold
    wires: dict[str, Any] = {"scales": 1e4 * np.array(_NEEDLE)}
    faint: dict[str, Any] = wires | {"opacity": 0.003}
    discs: dict[str, Any] = {"scales": 0.3 * np.array(_DISC), "opacity": 0.95}
    # a disc that the set turns through its edge
    edge = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
    # directions at which rounding leaves the blurred determinant smaller than the sharp one
    lying = (-0.15922501683235168, 0.5408455729484558, 0.21465912461280823, 0.35537269711494446)
    longer = (0.6333526372909546, -2.20350980758667, 0.052028972655534744, 0.6836861968040466)
    spike: dict[str, Any] = {"means": [[0.3, 0.2, -2.0]], "scales": (1e4, 0.01, 0.01), "quats": lying}
    spike |= {"antialiased": True, "colors": 1.0}
    javelin: dict[str, Any] = spike | {"scales": (1e9, 0.01, 0.01), "quats": longer}
    small = _camera(8)
    inside = [[0.0, 0.0, 0.0], [0.1, 0.1, -0.05], [0.3, 0.0, -1.0]]
    return [
        Case("needles", _scene(few, **needles), camera, _SHIFT),
        Case("needles yaw", _scene(few, **needles), camera, _YAW),
        Case("needles antialiased", _scene(few, **(needles | wires), antialiased=True), camera, _YAW),
        Case("needles antialiased away", _scene(few, **needles, antialiased=True), camera, _YAW, blank=True),
        Case("needles antialiased faint", _scene(few, **(needles | faint), antialiased=True),
             camera, _YAW, blank=True),
        Case("compensation above 1", _scene(**spike, opacity=0.5), small, {}),
        Case("compensation above 1, faint", _scene(**spike, opacity=0.0035), small, {}, blank=True),
        Case("compensation above 1 in float64", _scene(**javelin, opacity=0.5), small, {}),
        Case("needle along the ray", _scene([[0.0, 0.0, -2.0]], (1e-6, 1e-6, 1.0), 0.95), camera, _SHIFT),
        Case("needle across the camera", _scene([[0.0, 0.3, -0.05]], (1e-6, 1e-6, 2.0), 0.95), camera, _YAW),
        Case("needle across the camera antialiased",
             _scene([[0.0, 0.3, -0.05]], (0.01, 0.01, 2e3), 0.95, antialiased=True),
             camera, _YAW),
        Case("discs edge-on", _scene(few, **discs, quats=edge), camera, {"rotation": {"yaw": 0.3}}),
        Case("discs edge-on antialiased", _scene(few, **discs, quats=edge, antialiased=True), camera, _YAW),
        Case("sub-pixel", _scene(few, 1e-5, 0.99), camera, _SHIFT),
        Case("sub-pixel antialiased", _scene(few, 0.01, 0.99, antialiased=True), camera, _SHIFT),
        Case("screen-filling", _scene(_cloud(8), 50.0, 0.4), camera, _SIX),
        Case("screen-filling antialiased", _scene(_cloud(8), 50.0, 0.4, antialiased=True), camera, _YAW),
        Case("smallest scales", _scene(few, math.exp(-87.0), 0.99), camera, _YAW),
        Case("smallest scales antialiased", _scene(few, math.exp(-87.0), 0.99, antialiased=True),
             camera, _YAW, blank=True),
        Case("denormal squares", _scene(few, (1e-22, 0.1, 1e-20), 0.9, quats=_quats(6)), camera, _YAW),
        Case("largest scales", _scene(few, math.exp(88.0), 0.5), camera, _SHIFT),
        Case("largest scales antialiased", _scene(few, math.exp(88.0), 0.5, antialiased=True), camera, _SHIFT),
        Case("squares at the overflow", _scene(few, (1.8e19, 1e18, 1e19), 0.5, quats=_quats(6)), camera, _YAW),
        Case("all scales at once", _scene(few, (1e18, 1.0, 1e-18), 0.5, quats=_quats(6)), camera, _YAW),
        Case("camera inside", _scene(inside, (0.5, 0.7, 0.6), 0.9, quats=_quats(3)), camera, _SIX),
        Case("quaternion lengths", _scene(few, (0.3, 0.1, 0.02), quats=_quats(6) * np.tile([[1e-17], [1e17]], (3, 1))),
             camera, _YAW),
    ]  # fmt: skip


def _opacities() -> list[Case]:
    """Return cases at the skipped alpha, the largest alpha, and the stop."""
    camera, few = _camera(), _cloud(6)
    line = [[0.0, 0.0, -1.0 - 0.25 * k] for k in range(6)]
    # float32 neighbours of the logit at which alpha is 1/255
    skip = np.float32(-math.log(254.0))
    ends = np.array([np.nextafter(skip, np.float32(-9)), skip, np.nextafter(skip, np.float32(0))], np.float64)
    wide = [[0.0, 0.0, -2.0], [0.1, 0.0, -2.5], [-0.1, 0.0, -3.0]]
    stop: dict[str, Any] = {"scales": 0.4, "colors": np.array([[0.0], [0.0], [40.0]]), "background": 1.0}
    three = [[0.0, 0.0, -1.0], [0.0, 0.0, -1.5], [0.0, 0.0, -2.0]]
    return [
        Case("opacity 0", _scene(few, 0.3, 0.0), camera, _YAW, blank=True),
        Case("opacity 1e-12", _scene(few, 0.3, 1e-12), camera, _YAW, blank=True),
        Case("opacity 1 - 1e-12", _scene(few, 0.3, 1.0 - 1e-12), camera, _YAW),
        Case("opacity 1 - 1e-12 antialiased", _scene(few, 0.05, 1.0 - 1e-12, antialiased=True), camera, _SHIFT),
        # so wide that alpha is the opacity in every pixel
        Case("alpha at 1/255", _scene(wide, 1e4, 1.0 / (1.0 + np.exp(-ends)), 60.0), camera, _SHIFT),
        Case("alpha through 1/255", _scene(few, 0.2, 0.01, 60.0), camera, {"translation": {"z": 0.5}}),
        Case("alpha at 0.999", _scene(wide, (0.5, 0.5, 1e-3), 0.999, [[0.0], [900.0], [0.5]]), camera, _SHIFT),
        Case("alpha through 0.999", _scene(wide, 0.4, 0.9995, [[0.0], [900.0], [0.5]]), camera, _SHIFT),
        # 0.1 * (1 - 0.999) is the threshold: rounding alone decides whether the second layer is drawn
        Case("transmittance at 1e-4", _scene(three, (9.0, 9.0, 1e-3), [0.9, 0.9995, 0.9], background=1.0),
             camera, _SHIFT),
        Case("transmittance through 1e-4", _scene(three, opacity=[0.9, 0.998, 0.99], **stop), camera, _SHIFT),
        Case("transmittance, orders", _scene(_cloud(12, 3), 0.4, 0.99, background=1.0),
             camera, {"rotation": {"yaw": 0.2}}),
        Case("many thin layers", _scene(np.repeat(line, 100, axis=0), 0.6, 0.02), camera, _SHIFT),
        Case("white background", _scene(few, 0.2, 0.7, background=1.0), camera, _SIX),
        Case("black background", _scene(few, 0.2, 0.7, background=0.0), camera, _SIX),
    ]  # fmt: skip


def _orders() -> list[Case]:
    """Return cases of depth ties, coincident Gaussians, far-away coordinates and scales of whole scenes."""
    camera, few = _camera(), _cloud(6)
    tie = [[-0.2, 0.0, -2.0], [0.0, 0.1, -2.0], [0.2, 0.0, -2.0], [0.0, -0.1, -2.0]]
    after = float(np.nextafter(np.float32(2.0), np.float32(3.0)))
    near = [[x, y, -(after if k % 2 else 2.0)] for k, (x, y, _) in enumerate(tie)]
    same = np.tile([[0.1, 0.0, -2.0]], (1000, 1))
    offset = np.array([1e6, -1e6, 1e6])
    away = _camera(pose=np.concatenate([np.eye(3), offset[:, None]], axis=1))
    tiny = _camera(focal=1.2e5)
    return [
        Case("depth ties", _scene(tie, 0.3, 0.9), camera, _SHIFT),
        Case("depth ties yaw", _scene(tie, 0.3, 0.9), camera, _YAW),
        Case("depth ties pose", _scene(tie, 0.3, 0.9), camera, {}),
        Case("one-ulp ties", _scene(near, 0.3, 0.9), camera, _SHIFT),
        Case("one-ulp ties yaw", _scene(near, 0.3, 0.9), camera, {"rotation": {"yaw": 1e-6}}),
        Case("one-ulp ties six", _scene(near, 0.3, 0.9), camera, _SIX),
        Case("coincident", _scene(same, 0.3, 0.05), camera, _SHIFT),
        Case("coincident yaw", _scene(same[:300], 0.3, 0.5), camera, _YAW),
        Case("coincident antialiased", _scene(same[:200], 0.02, 0.3, antialiased=True), camera, _YAW),
        Case("offset 1e6", _scene(4.0 * few + offset, 0.8, 0.8), away, {"translation": {"x": 0.1}}),
        Case("offset 1e6 yaw", _scene(4.0 * few + offset, 0.8, 0.8), away, _YAW),
        Case("offset 1e6 orbit", _scene(4.0 * few + offset, 0.8, 0.8), away, _orbit(-0.1, 0.1, offset - (0, 0, 8))),
        Case("scene scale 1e-6", _scene(_cloud(8, depth=0.0) * 1e-6 - (0, 0, 0.0125), 3e-7),
             tiny, {"translation": {"x": 1e-7}}),
        Case("scene scale 1e6", _scene(1e6 * few, 2e5),
             camera, {"translation": {"x": 5e4}, "rotation": {"roll": 0.05}}),
        Case("scene scale 1e6, tiny set", _scene(1e6 * few, 2e5), camera, {"translation": {"x": 1e-3}}),
        Case("far plane", _scene([[0, 0, -1e10], [1e9, 0, -1.0001e10], [0, 1e9, -2e10]], 1e9),
             camera, {"translation": {"z": 1e6}}),
    ]  # fmt: skip


def _places() -> list[Case]:
    """Return cases at the near plane, image and tile borders, and of fields of view."""
    camera, few = _camera(), _cloud(6)
    close = [[0.0, 0.0, -0.01], [0.002, 0.001, -0.012], [0.0, 0.0, -2.0]]
    # 0.01 as a float32 and its neighbours
    plane = np.float32(0.01)
    depths = [np.nextafter(plane, np.float32(0)), plane, np.nextafter(plane, np.float32(1))]
    exact = [[0.0, 0.0, -float(z)] for z in depths]
    around = np.concatenate([_cloud(5, 4, depth=-1.0), _cloud(3, 5)])
    # one pixel is 1/32 of a unit here; the radius is 19 pixels and ends on a tile border at x = 16
    tiles = _camera(48, 32, focal=32.0)
    border = _scene([[11.0 / 32.0, 0.0, -1.0]], (6.0 / 32.0, 6.0 / 32.0, 1e-3), 0.999, 80.0)
    pixel = 2.0 / camera.fx
    rim = [[sx * 10.0 * pixel, sy * 10.0 * pixel, -2.0] for sx, sy in ((-1, 0), (1, 0), (0, -1), (1, 1), (1.4, 0))]
    wide = np.concatenate([_cloud(8, 6, spread=2.0), [[20.0, 0.0, -2.0], [0.0, -22.0, -1.9]]])
    return [
        Case("near plane", _scene(close, [[0.002], [0.001], [0.2]], 0.9), camera, {"translation": {"z": 0.005}}),
        Case("near plane, wide", _scene(close, [[0.02], [0.5], [0.2]], 0.9), camera, {"translation": {"z": 0.005}}),
        Case("near plane antialiased", _scene(close, 0.002, 0.9, antialiased=True),
             camera, {"translation": {"z": 0.005}}),
        Case("near plane, one pose", _scene(exact, 0.002, 0.9), camera, {}),
        Case("behind the camera", _scene(around, 0.3), camera, _SIX),
        Case("behind, turned to", _scene(around, 0.3), camera, {"rotation": {"yaw": [2.6, 3.3]}}),
        Case("all behind", _scene(_cloud(5, depth=-2.0), 0.3), camera, _YAW, blank=True),
        Case("tile border inside the set", border, tiles, {"translation": {"x": 1.0 / 32.0}}),
        Case("tile border at the set's end", border, tiles, {"translation": {"x": [0.0, 2.0 / 32.0]}}),
        Case("tile border, one pose", border, tiles, {}),
        Case("image border", _scene(rim, 0.1, 0.9), camera, _SHIFT),
        Case("image border roll", _scene(rim, (0.3, 0.05, 0.1), 0.9, antialiased=True), camera, _ROLL),
        Case("fov 1", _scene(_cloud(8, spread=0.015), 0.003), _camera(fov=1.0), {"translation": {"x": 1e-3}}),
        Case("fov 1 yaw", _scene(_cloud(8, spread=0.015), 0.003), _camera(fov=1.0), {"rotation": {"yaw": 1e-3}}),
        Case("fov 170", _scene(wide, 0.4), _camera(fov=170.0), _SHIFT),
        Case("fov 170 yaw", _scene(wide, 0.4), _camera(fov=170.0), _YAW),
        Case("one pixel", _scene(few, 0.4), _camera(1), _SIX),
        Case("long image", _scene(few, 0.4), _camera(48, 3), _YAW),
    ]  # fmt: skip


def _poses() -> list[Case]:
    """Return cases of set widths: none, an ulp, whole turns, through the object."""
    camera, few = _camera(), _cloud(6)
    ball: dict[str, Any] = {"means": _cloud(8, 2), "scales": (0.3, 0.1, 0.05), "quats": _quats(8)}
    half = _camera(pose=_turned(math.pi - 1e-3, (0.0, 0.0, -4.0)))
    back = _camera(pose=_turned(-math.pi + 1e-9, (0.5, 0.2, -4.0)))
    ulp = [0.1, float(np.nextafter(0.1, 1.0))]
    return [
        Case("one pose", _scene(**ball), camera, {}),
        Case("one pose, moved", _scene(**ball),
             camera, {"translation": {"x": [0.1, 0.1]}, "rotation": {"roll": [1, 1]}}),
        Case("one ulp", _scene(**ball), camera, {"translation": {"x": ulp}, "rotation": {"yaw": ulp}}),
        Case("width 1e-9", _scene(**ball), camera, {"rotation": {"yaw": 1e-9, "roll": 1e-9}}),
        Case("whole orbit", _scene(**ball), camera, _orbit(0.0, _TURN)),
        Case("whole orbit antialiased", _scene(**ball, antialiased=True), camera, _orbit(0.0, _TURN)),
        Case("whole yaw", _scene(**ball), camera, {"rotation": {"yaw": [-math.pi, math.pi]}}),
        Case("whole roll", _scene(**ball), camera, {"rotation": {"roll": [0.0, _TURN]}}),
        Case("all rotations", _scene(**ball), camera, {"rotation": dict.fromkeys(("yaw", "pitch", "roll"), math.pi)}),
        Case("through the object", _scene(**ball), camera, {"translation": {"z": [-4.0, 0.0]}}),
        Case("through the object antialiased", _scene(**ball, antialiased=True),
             camera, {"translation": {"z": [-4.0, 0.0]}}),
        Case("far and wide", _scene(**ball), camera, {"translation": {"x": 1e3, "y": 1e3, "z": 1e3}}),
        Case("six parameters", _scene(**ball), camera, _SIX),
        Case("six wide parameters", _scene(**ball),
             camera, {"translation": dict.fromkeys("xyz", 0.5), "rotation": {"yaw": 0.5, "pitch": 0.5, "roll": 0.5}}),
        Case("eight parameters", _scene(**ball),
             camera, {**_SIX, **_orbit(0.0, 0.05), "sweep": "segments"}, _camera(pose=_turned(0.1, (0.2, 0.0, 0.0)))),
        Case("half a turn", _scene(**ball), camera, {"sweep": "segments"}, half),
        Case("half a turn, 1e-9 less", _scene(few, 0.3), camera, {"sweep": "segments"}, back),
    ]  # fmt: skip


def _colors() -> list[Case]:
    """Return cases of spherical harmonics and sigmoid colours."""
    camera, few = _camera(), _cloud(6)
    rng = np.random.default_rng(8)
    loud, quiet = 1e3 * rng.normal(size=(6, 15, 3)), 0.2 * rng.normal(size=(6, 15, 3))
    here = [[0.0, 0.0, -0.03], [0.02, 0.01, -0.05], *_cloud(4, 9)]
    return [
        Case("harmonics 1e3", _scene(few, 0.3, bands=loud), camera, _SHIFT),
        Case("harmonics 1e3 yaw", _scene(few, 0.3, bands=loud), camera, _YAW),
        Case("harmonics 1e3 orbit", _scene(few, 0.3, bands=loud), camera, _orbit(-0.05, 0.05)),
        Case("harmonics 1e3 antialiased", _scene(few, 0.1, bands=loud, antialiased=True), camera, _SIX),
        Case("harmonics beside the camera", _scene(here, 0.02, bands=quiet), camera, {"translation": {"x": 0.04}}),
        Case("sigmoid colours", _scene(few, 0.3, 0.9, rng.normal(size=(6, 3)), model="sigmoid"), camera, _SIX),
        Case("sigmoid colours, saturated", _scene(few, 0.3, 0.9, [[80.0, -80.0, 1e3]], model="sigmoid"), camera, _YAW),
    ]


def all_cases() -> list[Case]:
    """Return every case, in the order of the table."""
    return [*_shapes(), *_opacities(), *_orders(), *_places(), *_poses(), *_colors()]


_SHIFT: dict[str, Any] = {"translation": {"x": 0.05}}
_YAW: dict[str, Any] = {"rotation": {"yaw": 0.05}}
_ROLL: dict[str, Any] = {"rotation": {"roll": 0.3}}
_SIX: dict[str, Any] = {
    "translation": {"x": 0.02, "y": 0.02, "z": 0.02},
    "rotation": {"yaw": 0.01, "pitch": 0.01, "roll": 0.02},
}
