"""Makes the demo's airfield: an airliner on short final over a small airfield, without data from elsewhere.

    python benchmarks/airfield.py ns_abstract/demo/airfield.npz

Frame: z up, the runway lies along x, the aircraft flies towards +x. The ground is the plane
z = ``GROUND``; aircraft and airfield lie within [-1.2, 1.2]^3, hills and the sky dome up to 4 away.

Every surface is covered by rows of flat Gaussians that are aligned with it; colours hold baked
sunlight, sky light and shadows. Paint and glass get spherical harmonics of degree 2, fitted to
what a glossy surface reflects of the sky, the ground and the sun.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ns_abstract.io.atomic import write_atomic
from ns_abstract.methods.splat.scene import SplatScene

Array = NDArray[np.float64]
Surface = Callable[[Array, Array], Array]  # (u [n], v [n]) -> points [n, 3]

GROUND = -0.26  # z of the ground
TARGET = (0.0, 0.0, 0.01)  # a good point to look at: the middle of the aircraft
PLANE_LENGTH = 0.64
_HORIZON = 3.2  # radius of the ground

_PLANE_ORIGIN = np.array([0.0, 0.0, 0.02])
_PLANE_PITCH = 0.07  # radians, nose up
_SUN = np.array([-0.22, -0.38, 0.90]) / np.linalg.norm([-0.22, -0.38, 0.90])  # towards the sun
_SUNLIGHT = np.array([0.74, 0.70, 0.62])
_SKYLIGHT = np.array([0.40, 0.44, 0.50])
_BOUNCE = np.array([0.25, 0.26, 0.20])
_HAZE = np.array([0.86, 0.91, 0.95])
_ZENITH = np.array([0.36, 0.60, 0.90])

_WHITE = np.array([0.90, 0.91, 0.93])
_NAVY = np.array([0.05, 0.16, 0.42])
_ORANGE = np.array([0.95, 0.42, 0.08])
_GREY = np.array([0.62, 0.65, 0.68])
_GLASS = np.array([0.05, 0.07, 0.10])
_ASPHALT = np.array([0.25, 0.26, 0.28])
_CONCRETE = np.array([0.56, 0.55, 0.52])
_PAINT = np.array([0.88, 0.88, 0.86])

# Runway cells: the lattice carries the markings, so cells are the unit of every marking.
_CELL = 0.0155
_ROWS = 19
_RUNWAY_END = 1.16
_RUNWAY_HALF = 0.5 * _ROWS * _CELL


@dataclass(frozen=True)
class _Surfels:
    """n oriented discs before shading.

    Attributes:
        points: [n, 3], world.
        tangents: [n, 3], unit, direction of sigma[:, 0].
        normals: [n, 3], unit, outward.
        sigma: [n, 3] standard deviations along tangent, normal x tangent, normal.
        albedo: [n, 3] RGB in [0, 1].
        opacity: [n] in (0, 1).
        gloss: [n] reflectance at normal incidence; 0 means matt.
        lit: [n] share of the sunlight model; 0 takes the albedo as the final colour.
    """

    points: Array
    tangents: Array
    normals: Array
    sigma: Array
    albedo: Array
    opacity: Array
    gloss: Array
    lit: Array

    def __len__(self) -> int:
        return self.points.shape[0]

    def keep(self, mask: NDArray[np.bool_]) -> _Surfels:
        return _Surfels(*(getattr(self, f.name)[mask] for f in fields(self)))

    def placed(self, rotation: Array, origin: Array, scale: float = 1.0) -> _Surfels:
        """The surfels after ``x -> scale * rotation @ x + origin``."""
        return replace(
            self,
            points=scale * self.points @ rotation.T + origin,
            tangents=self.tangents @ rotation.T,
            normals=self.normals @ rotation.T,
            sigma=scale * self.sigma,
        )


def _surfels(
    points: Array,
    tangents: ArrayLike,
    normals: ArrayLike,
    sigma: ArrayLike,
    albedo: ArrayLike,
    *,
    opacity: ArrayLike = 0.95,
    gloss: ArrayLike = 0.0,
    lit: ArrayLike = 1.0,
) -> _Surfels:
    n = len(points)

    def vectors(value: ArrayLike) -> Array:
        return np.array(np.broadcast_to(value, (n, 3)), np.float64)

    def scalars(value: ArrayLike) -> Array:
        return np.array(np.broadcast_to(value, (n,)), np.float64)

    normals = _unit(vectors(normals))
    tangents = vectors(tangents)
    tangents = _unit(tangents - normals * _dot(tangents, normals)[:, None])
    return _Surfels(
        points,
        tangents,
        normals,
        vectors(sigma),
        vectors(albedo),
        scalars(opacity),
        scalars(gloss),
        scalars(lit),
    )


def _join(parts: list[_Surfels]) -> _Surfels:
    return _Surfels(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(_Surfels)))


def _unit(x: Array) -> Array:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)


def _dot(a: Array, b: Array) -> Array:
    return np.sum(a * b, axis=-1)


def _smooth(x: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """0 at ``low``, 1 at ``high`` (which may be the smaller), smooth in between."""
    x, low, high = (np.asarray(value, np.float64) for value in (x, low, high))
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _mix(a: ArrayLike, b: ArrayLike, weight: ArrayLike) -> Array:
    w = np.asarray(weight, np.float64)[..., None]
    return (1.0 - w) * np.asarray(a, np.float64) + w * np.asarray(b, np.float64)


def _lattice(
    surface: Surface,
    spacing: float,
    paint: Callable[[Array, Array, Array], Array] | ArrayLike,
    *,
    cover: float = 0.66,
    flip: bool = False,
    gloss: float = 0.0,
    opacity: float = 0.95,
) -> _Surfels:
    """Cover ``surface`` over (u, v) in [0, 1]^2 by rows of constant v.

    Points stand ``spacing`` apart by arc length within a row and between rows; random points
    would leave holes and clumps, which show as speckle. Rows hold an even number of points, placed
    alike about u = 1/2, so that edges and stripes along v come out straight.

    Args:
        paint: RGB, or a function of (points, u, v) that gives [n, 3].
        cover: Standard deviation in units of the local spacing.
        flip: Turn the normals dP/du x dP/dv round.
    """
    fine = np.linspace(0.0, 1.0, 97)
    grid_u, grid_v = np.meshgrid(fine[::8], fine, indexing="ij")
    columns = surface(grid_u.ravel(), grid_v.ravel()).reshape(*grid_u.shape, 3)
    steps = np.linalg.norm(np.diff(columns, axis=1), axis=2).max(axis=0)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    rows = max(1, round(along[-1] / spacing))
    row_v = np.interp((np.arange(rows) + 0.5) * along[-1] / rows, along, fine)
    step_v = np.gradient(row_v) if rows > 1 else np.ones(1)

    us, vs, du, dv = [], [], [], []
    for i, v in enumerate(row_v):
        curve = surface(fine, np.full_like(fine, v))
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        n = max(2, 2 * round(0.5 * arc[-1] / spacing))
        us.append(np.interp((np.arange(n) + 0.5) * arc[-1] / n, arc, fine))
        vs.append(np.full(n, v))
        du.append(np.full(n, arc[-1] / n))
        dv.append(np.full(n, step_v[i]))
    u, v, length_u, delta_v = (np.concatenate(x) for x in (us, vs, du, dv))

    points = surface(u, v)
    h = 1e-3
    tangent_u = surface(np.clip(u + h, 0, 1), v) - surface(np.clip(u - h, 0, 1), v)
    span_v = np.clip(v + h, 0, 1) - np.clip(v - h, 0, 1)
    tangent_v = (surface(u, np.clip(v + h, 0, 1)) - surface(u, np.clip(v - h, 0, 1))) / span_v[:, None]
    tangent_u = _unit(tangent_u)
    across = tangent_v - tangent_u * _dot(tangent_u, tangent_v)[:, None]
    length_v = np.linalg.norm(across, axis=1) * delta_v
    normals = np.cross(tangent_u, _unit(across)) * (-1.0 if flip else 1.0)
    sigma = np.stack(
        [
            cover * length_u,
            cover * np.clip(length_v, 0.3 * spacing, 1.5 * spacing),
            np.full(len(u), 0.10 * spacing),
        ],
        axis=1,
    )
    albedo = paint(points, u, v) if callable(paint) else paint
    return _surfels(points, tangent_u, normals, sigma, albedo, opacity=opacity, gloss=gloss)


def _revolution(radius: Callable[[Array], Array], centre: Callable[[Array], Array], x0: float, x1: float) -> Surface:
    """Circles of ``radius(v)`` around ``centre(v)`` ([n, 2] y, z), for x from x0 to x1; u turns once."""

    def surface(u: Array, v: Array) -> Array:
        angle = 2 * np.pi * u
        offset = radius(v)[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)
        return np.concatenate([(x0 + (x1 - x0) * v)[:, None], centre(v) + offset], axis=1)

    return surface


def _plate(corner: ArrayLike, side_u: ArrayLike, side_v: ArrayLike) -> Surface:
    corner, side_u, side_v = (np.asarray(x, np.float64) for x in (corner, side_u, side_v))
    return lambda u, v: corner + u[:, None] * side_u + v[:, None] * side_v


def _loft(
    lead0: ArrayLike, lead1: ArrayLike, chord: tuple[float, float], thick: tuple[float, float], up: ArrayLike
) -> Surface:
    """An aerofoil skin from leading-edge point ``lead0`` to ``lead1``; u runs round the section."""
    lead0, lead1, up = (np.asarray(x, np.float64) for x in (lead0, lead1, up))

    def surface(u: Array, v: Array) -> Array:
        angle = 2 * np.pi * u
        s = 0.5 * (1.0 + np.cos(angle))
        half = 5.0 * (0.2969 * np.sqrt(s) - 0.126 * s - 0.3516 * s**2 + 0.2843 * s**3 - 0.1036 * s**4)
        c = chord[0] + (chord[1] - chord[0]) * v
        t = thick[0] + (thick[1] - thick[0]) * v
        lift = np.sign(np.sin(angle)) * half * t * c
        lead = lead0 + v[:, None] * (lead1 - lead0)
        return lead - (c * s)[:, None] * np.array([1.0, 0.0, 0.0]) + lift[:, None] * up

    return surface


# ---------------------------------------------------------------- aircraft (length 1, x forward)

_TUBE = 0.062  # fuselage radius


def _fuselage_shape(v: Array) -> tuple[Array, Array]:
    """Radius [n] and centre line height [n] at v = 0 (nose) to 1 (tail)."""
    nose = np.clip(v / 0.15, 0.0, 1.0)
    tail = np.clip((v - 0.62) / 0.38, 0.0, 1.0)
    radius = _TUBE * np.sqrt(1.0 - (1.0 - nose) ** 2.1) * (1.0 - 0.86 * tail**1.7)
    height = -0.016 * (1.0 - nose) ** 2 + 0.040 * tail**1.7
    return np.maximum(radius, 2e-3), height


def _fuselage_paint(points: Array, u: Array, v: Array) -> Array:
    radius, height = _fuselage_shape(v)
    z = (points[:, 2] - height) / radius
    colour = np.tile(_WHITE, (len(u), 1))
    # The navy belly starts in a curve behind the nose, below an orange line.
    edge = -0.62 + 0.55 * _smooth(v, 0.03, 0.24)
    colour = _mix(colour, _ORANGE, _smooth(z, edge + 0.26, edge + 0.14))
    colour = _mix(colour, _NAVY, _smooth(z, edge + 0.06, edge - 0.02))
    colour = _mix(colour, _GREY, _smooth(z, edge - 0.40, edge - 0.50))
    # The colours sweep up over the tail, as far as the fin root.
    sweep = v + 0.10 * z
    colour[(sweep > 0.80) & (z > -0.6)] = _NAVY
    colour[(sweep > 0.775) & (sweep <= 0.80) & (z > -0.6)] = _ORANGE
    angle = np.abs((u + 0.5) % 1.0 - 0.5) * 2 * np.pi  # from the top
    lower = 0.030 + 0.010 * angle
    screen = _smooth(v, lower - 0.003, lower + 0.004) * _smooth(v, lower + 0.032, lower + 0.026)
    colour = _mix(colour, _GLASS, screen * _smooth(angle, 1.30, 1.10))
    colour[(v > 0.985)] = _ASPHALT
    return colour


def _cabin_windows(spacing: float) -> _Surfels:
    """A row of small dark panes on either side, a hair above the skin."""
    v = np.concatenate([np.arange(0.135, 0.36, 0.0185), np.arange(0.385, 0.755, 0.0185)])
    parts = []
    for side in (-1.0, 1.0):
        radius, height = _fuselage_shape(v)
        angle = np.full_like(v, 1.22)
        normal = np.stack([np.zeros_like(v), side * np.sin(angle), np.cos(angle)], axis=1)
        centre = np.stack([0.5 - v, np.zeros_like(v), height], axis=1)
        points = centre + (radius + 0.0008)[:, None] * normal
        size = [0.0042, 0.0052, 0.1 * spacing]
        parts.append(_surfels(points, [1.0, 0, 0], normal, size, _GLASS, opacity=0.97, gloss=0.08))
    return _join(parts)


def _without(base: _Surfels, other: _Surfels, radius: float) -> _Surfels:
    """``base`` less everything within ``radius`` of a point of ``other``."""
    distance = np.linalg.norm(base.points[:, None] - other.points[None], axis=2).min(axis=1)
    return base.keep(distance > radius)


def _wing_paint(points: Array, u: Array, v: Array) -> Array:
    # Slats and flaps read as slightly different greys.
    s = 0.5 * (1.0 + np.cos(2 * np.pi * u))
    colour = np.tile(np.array([0.74, 0.76, 0.79]), (len(u), 1))
    colour[s < 0.10] = [0.86, 0.87, 0.88]
    colour[(s > 0.76) & (v < 0.75)] = [0.64, 0.66, 0.70]
    return colour


# Leading edge at root and tip (y for the +y side), chords, thickness ratios, lean (1: the section's
# upper side faces the aircraft), paint: wing, winglet, tailplane.
_LIFTING = (
    ((0.130, 0.030, -0.034), (-0.135, 0.460, 0.024), (0.235, 0.072), (0.13, 0.10), 0.0, _wing_paint),
    ((-0.135, 0.460, 0.024), (-0.190, 0.476, 0.098), (0.072, 0.034), (0.11, 0.11), 1.0, _NAVY),
    ((-0.375, 0.012, 0.046), (-0.462, 0.175, 0.066), (0.112, 0.048), (0.11, 0.10), 0.0, [0.80, 0.82, 0.84]),
)


def _aircraft(spacing: float, *, gear: bool = True) -> _Surfels:
    """An airliner of length 1 along x, nose at +0.5; ``spacing`` in that unit."""
    parts: list[_Surfels] = []

    def centre_line(v: Array) -> Array:
        return np.stack([np.zeros_like(v), _fuselage_shape(v)[1]], axis=1)

    def skin(x0: float, x1: float) -> Surface:
        def part(v: Array) -> Array:
            return 0.5 - (x0 + (x1 - x0) * v)

        return _revolution(lambda v: _fuselage_shape(part(v))[0], lambda v: centre_line(part(v)), x0, x1)

    def skin_paint(points: Array, u: Array, v: Array) -> Array:
        return _fuselage_paint(points, u, 0.5 - points[:, 0])

    # The nose carries the windscreen, so it gets a finer lattice.
    hull = _join(
        [
            _lattice(skin(0.5, 0.36), 0.66 * spacing, skin_paint, gloss=0.08),
            _lattice(skin(0.36, -0.5), 0.94 * spacing, skin_paint, gloss=0.08),
        ]
    )
    glass = hull.albedo.sum(axis=1) < 0.3
    hull = replace(hull, gloss=np.where(glass, 0.12, hull.gloss))
    panes = _cabin_windows(spacing)
    parts += [_without(hull, panes, 0.0036), panes]

    for side in (-1.0, 1.0):
        for (x0, y0, z0), (x1, y1, z1), chord, thick, lean, paint in _LIFTING:
            up = np.array([0.0, -side * lean, 1.0 - 0.8 * lean])
            shape = _loft([x0, side * y0, z0], [x1, side * y1, z1], chord, thick, up)
            parts.append(_lattice(shape, spacing, paint, gloss=0.08, flip=side < 0))
        parts += _engine(np.array([0.115, side * 0.165, -0.068]), spacing)
        pylon = _loft(
            [0.075, side * 0.165, -0.04], [0.065, side * 0.165, -0.012], (0.11, 0.10), (0.14, 0.14), [0, 1, 0]
        )
        parts.append(_lattice(pylon, spacing, _WHITE, gloss=0.08, flip=True))

    def fin_paint(points: Array, u: Array, v: Array) -> Array:
        x, z = points[:, 0] + 0.455, points[:, 2] - 0.150
        colour = np.tile(_NAVY, (len(u), 1))
        ring = np.hypot(x, z)
        colour[ring < 0.034] = _ORANGE
        colour[ring < 0.016] = _WHITE
        colour[v > 0.93] = _WHITE
        return colour

    fin = _loft([-0.310, 0, 0.045], [-0.470, 0, 0.238], (0.165, 0.072), (0.10, 0.09), [0, 1, 0])
    parts.append(_lattice(fin, 0.75 * spacing, fin_paint, gloss=0.08, flip=True))
    if gear:
        parts.append(_landing_gear())
    return _join(parts)


def _engine(front: Array, spacing: float) -> list[_Surfels]:
    """Cowl, bright lip, dark fan with a spinner, and exhaust cone; ``front`` is the inlet centre."""
    length, radius = 0.150, 0.036
    parts: list[_Surfels] = []

    def centre(v: Array) -> Array:
        return np.tile(front[1:], (len(v), 1))

    def cowl(v: Array) -> Array:
        return (
            radius * (0.86 + 0.14 * np.sin(np.pi * np.clip(0.15 + 0.75 * v, 0, 1))) * (1 - 0.30 * _smooth(v, 0.55, 1.0))
        )

    def paint(points: Array, u: Array, v: Array) -> Array:
        colour = np.tile(_NAVY, (len(u), 1))
        colour[v < 0.10] = [0.82, 0.83, 0.85]
        colour[(v > 0.10) & (v < 0.19)] = _ORANGE
        colour[v > 0.88] = [0.45, 0.45, 0.47]
        return colour

    fine = 0.9 * spacing
    parts.append(_lattice(_revolution(cowl, centre, front[0], front[0] - length), fine, paint, gloss=0.07))
    parts.append(
        _lattice(
            _revolution(lambda v: radius * 0.84 * (1 - v) + 1e-4, centre, front[0] - 0.014, front[0] - 0.015),
            fine,
            lambda p, u, v: _mix([0.62, 0.63, 0.66], [0.07, 0.07, 0.09], _smooth(1 - v, 1.0, 0.7)),
            flip=False,
        )
    )
    parts.append(
        _lattice(
            _revolution(lambda v: radius * 0.24 * np.sqrt(v) + 1e-4, centre, front[0] + 0.004, front[0] - 0.012),
            fine,
            [0.55, 0.56, 0.60],
        )
    )
    parts.append(
        _lattice(
            _revolution(
                lambda v: radius * 0.56 * (1 - 0.75 * v),
                centre,
                front[0] - length + 0.01,
                front[0] - length - 0.035,
            ),
            fine,
            [0.30, 0.29, 0.28],
        )
    )
    return parts


def _landing_gear() -> _Surfels:
    """Struts as long Gaussians, wheels as discs of a tyre and a bright hub."""
    parts = []
    for x, y, top, wheel in (
        (0.385, 0.0, -0.055, 0.013),
        (-0.03, 0.07, -0.04, 0.017),
        (-0.03, -0.07, -0.04, 0.017),
    ):
        bottom = -0.125
        z = np.linspace(top, bottom, 7)
        strut = np.stack([np.full(7, x), np.full(7, y), z], axis=1)
        parts.append(_surfels(strut, [0, 0, 1], [0, 1, 0], [0.010, 0.0032, 0.0032], [0.75, 0.76, 0.78], opacity=0.97))
        for offset in (-0.012, 0.012):
            angle = np.arange(14) * 2 * np.pi / 14
            tyre = np.stack(
                [x + wheel * np.cos(angle), np.full(14, y + offset), bottom + wheel * np.sin(angle)], axis=1
            )
            along = np.stack([-np.sin(angle), np.zeros(14), np.cos(angle)], axis=1)
            parts.append(_surfels(tyre, along, [0, np.sign(offset), 0], [0.0050, 0.0048, 0.0042], 0.09, opacity=0.98))
            hub = np.array([[x, y + 1.25 * offset, bottom]])
            parts.append(_surfels(hub, [1, 0, 0], [0, np.sign(offset), 0], [0.0055, 0.0055, 0.003], 0.7, opacity=0.98))
    return _join(parts)


# ---------------------------------------------------------------- airfield

_DIGITS = {"0": "111101101101111", "9": "111101111001111", "2": "111001111100111", "7": "111001010010010"}


def _runway_markings(columns: int) -> NDArray[np.bool_]:
    """[columns, rows] True where a runway cell is painted; both ends are marked alike."""
    paint = np.zeros((columns, _ROWS), bool)
    middle = _ROWS // 2
    paint[:, [0, -1]] = True
    paint[np.arange(columns) % 8 < 5, middle] = True
    for number, flip in (("09", False), ("27", True)):
        end = np.zeros((columns, _ROWS), bool)
        end[2:10, [2, 4, 6, 12, 14, 16]] = True  # threshold stripes
        for k, digit in enumerate(number):
            bitmap = np.array([int(b) for b in _DIGITS[digit]], bool).reshape(5, 3)
            # The pilot reads them along +x with +y to the left: bitmap rows run backwards.
            left = middle + 4 - k * 4
            for r in range(5):
                for c in range(3):
                    end[12 + 2 * (4 - r) : 14 + 2 * (4 - r), left - c] = bitmap[r, c]
        end[28:34, [3, 4, 14, 15]] = True  # aiming point
        end[40:43, [3, 5, 13, 15]] = True  # touchdown zone
        end_zone = np.arange(columns) < 24
        if flip:
            end, end_zone = end[::-1, ::-1], end_zone[::-1]
        paint[end_zone, middle] = False
        paint |= end
    return paint


def _runway(rng: np.random.Generator) -> _Surfels:
    columns = 2 * round(_RUNWAY_END / _CELL)
    i, j = np.meshgrid(np.arange(columns), np.arange(_ROWS), indexing="ij")
    x = (i - 0.5 * (columns - 1)) * _CELL
    y = (j - 0.5 * (_ROWS - 1)) * _CELL
    points = np.asarray(np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND)], axis=1), np.float64)
    painted = _runway_markings(columns).ravel()
    patches = 0.03 * _waves(points[:, :2], rng, 9.0) + 0.012 * rng.standard_normal(len(points))
    albedo = _ASPHALT * (1.0 + patches[:, None])
    # Rubber left by tyres around both touchdown zones.
    rubber = np.exp(-0.5 * ((np.abs(points[:, 0]) - 0.62) / 0.16) ** 2) * np.exp(
        -0.5 * ((np.abs(points[:, 1]) - 0.03) / 0.02) ** 2
    )
    albedo = albedo * (1.0 - 0.45 * rubber[:, None])
    albedo[painted] = _PAINT * (1.0 - 0.35 * rubber[painted, None])
    # Paint is narrower than asphalt: crisp edges there, no light joints here.
    sigma = np.where(painted, 0.60, 0.72)[:, None] * _CELL * np.array([1.0, 1.0, 0.06])
    return _surfels(points, [1.0, 0, 0], [0, 0, 1.0], sigma, albedo, opacity=np.where(painted, 0.97, 0.93))


def _waves(xy: Array, rng: np.random.Generator, frequency: float) -> Array:
    """Smooth noise of unit scale at [n, 2] points: a sum of plane waves."""
    total = np.zeros(len(xy))
    for octave in (1.0, 2.1, 4.3):
        for _ in range(4):
            angle, phase = rng.uniform(0, 2 * np.pi, 2)
            wave = frequency * octave * np.array([np.cos(angle), np.sin(angle)])
            total += np.sin(xy @ wave + phase) / octave
    return total / 2.5


_TAXIWAYS = (  # centre x, centre y, half length x, half length y
    (0.0, 0.345, 0.95, 0.030),
    (-0.80, 0.23, 0.030, 0.085),
    (0.05, 0.23, 0.030, 0.085),
    (0.80, 0.23, 0.030, 0.085),
)
_APRON = (-0.10, 0.475, 0.52, 0.10)
_PAVED = ((0.0, 0.0, _RUNWAY_END, _RUNWAY_HALF), *_TAXIWAYS, _APRON)


def _pavement_distance(xy: Array) -> Array:
    """Distance [n] of ground points [n, 2] from the nearest pavement, 0 on it."""
    gaps = [
        np.hypot(np.maximum(np.abs(xy[:, 0] - x) - half_x, 0), np.maximum(np.abs(xy[:, 1] - y) - half_y, 0))
        for x, y, half_x, half_y in _PAVED
    ]
    return np.min(gaps, axis=0)


def _fringe(offset: float = 0.0065, step: float = 0.021) -> tuple[Array, Array]:
    """Points [n, 2] just outside every pavement, and the direction [n, 3] of the edge there."""
    points, along = [], []
    for x, y, half_x, half_y in _PAVED:
        for axis, half, other in ((0, half_x, half_y), (1, half_y, half_x)):
            n = round(2 * (half + offset) / step)
            t = (np.arange(n) + 0.5) / n * 2 * (half + offset) - (half + offset)
            for side in (-1.0, 1.0):
                line = np.empty((n, 2))
                line[:, axis] = t
                line[:, 1 - axis] = side * (other + offset)
                points.append(line + np.array([x, y]))
                along.append(np.tile(np.eye(3)[axis], (n, 1)))
    xy = np.concatenate(points)
    free = _pavement_distance(xy) > 0.5 * offset
    return xy[free], np.concatenate(along)[free]


def _pavements(rng: np.random.Generator) -> _Surfels:
    """Taxiways with a yellow centre line, and a concrete apron."""
    parts = []
    step = 0.0225
    for x, y, half_x, half_y in (*_TAXIWAYS, _APRON):
        nx, ny = max(3, round(2 * half_x / step)), max(3, round(2 * half_y / step))
        nx, ny = nx | 1, ny | 1  # odd, so that a centre row exists
        i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
        cell = np.array([2 * half_x / nx, 2 * half_y / ny])
        xy = np.array([x, y]) + (np.stack([i.ravel(), j.ravel()], axis=1) - 0.5 * np.array([nx - 1, ny - 1])) * cell
        points = np.concatenate([xy, np.full((len(xy), 1), GROUND)], axis=1)
        tone = 1.0 + 0.04 * _waves(xy, rng, 8.0)[:, None] + 0.02 * rng.standard_normal((len(xy), 1))
        if (x, y, half_x, half_y) == _APRON:
            joint = ((i % 6 == 0) | (j % 5 == 4)).ravel()
            albedo = _CONCRETE * tone * np.where(joint, 0.88, 1.0)[:, None]
        else:
            albedo = np.array([0.36, 0.36, 0.37]) * tone
            centre = ((j == ny // 2) if half_x > half_y else (i == nx // 2)).ravel()
            albedo = np.where(centre[:, None], _mix(albedo, [0.85, 0.66, 0.10], np.full(len(xy), 0.8)), albedo)
        parts.append(_surfels(points, [1, 0, 0], [0, 0, 1], [*(0.70 * cell), 0.05 * step], albedo, opacity=0.95))
    return _join(parts)


def _grass(rng: np.random.Generator, finest: float = 0.030) -> _Surfels:
    """A disc of grass: a sunflower spiral whose spacing grows outwards, with the paved areas left out."""
    table = np.linspace(0.0, _HORIZON, 2000)
    gap = finest * np.maximum(1.0, table / 0.6) ** 1.35
    inside = np.concatenate([[0.0], np.cumsum(np.diff(table) * 2 * np.pi * table[1:] / gap[1:] ** 2)])
    count = int(inside[-1])
    k = np.arange(count) + 0.5
    radius = np.interp(k, inside, table)
    spacing = np.interp(radius, table, gap)
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    xy = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy += 0.10 * spacing[:, None] * rng.standard_normal((count, 2))
    sigma = 0.64 * spacing

    # A fringe of small Gaussians follows every pavement, and the spiral shrinks towards it, so that
    # grass neither spills over an edge nor leaves a gap there.
    fringe, along = _fringe()
    edge = _pavement_distance(xy)
    free = edge > 0.007
    sigma = np.minimum(sigma, 0.90 * edge + 0.004)[free]
    xy, spacing, radius = (
        np.concatenate(pair)
        for pair in (
            (xy[free], fringe),
            (spacing[free], np.full(len(fringe), 0.02)),
            (radius[free], np.hypot(*fringe.T)),
        )
    )
    size = np.concatenate(
        [np.stack([sigma, sigma, 0.06 * sigma], axis=1), np.tile([0.0145, 0.0068, 0.001], (len(fringe), 1))]
    )
    direction = np.concatenate([np.tile([1.0, 0, 0], (len(sigma), 1)), along])
    count = len(xy)

    noise = _waves(xy, rng, 5.0)
    albedo = _mix([0.26, 0.42, 0.15], [0.44, 0.51, 0.21], np.clip(0.5 + 0.35 * noise, 0, 1))
    mown = (np.abs(xy[:, 1]) < 0.30) & (np.abs(xy[:, 0]) < 1.2)
    stripe = np.where(np.floor(xy[:, 0] / 0.11) % 2 == 0, 1.07, 0.95)
    albedo *= np.where(mown, stripe, 1.0)[:, None]
    albedo *= 1.0 + 0.05 * rng.standard_normal((count, 1))
    fields_tone = np.where(np.floor(xy[:, 0] * 2.2 + 0.7 * xy[:, 1]) % 3 == 0, 1.0, 0.0) * _smooth(radius, 0.85, 0.95)
    albedo = _mix(albedo, [0.62, 0.57, 0.29], 0.5 * fields_tone)
    haze = 0.70 * _smooth(radius, 0.7, 0.85 * _HORIZON)
    points = np.concatenate([xy, np.full((count, 1), GROUND - 0.002)], axis=1)
    grass = _surfels(points, direction, [0, 0, 1], size, albedo, opacity=rng.uniform(0.90, 0.97, count))
    return _hazed(grass, haze)


def _hazed(surfels: _Surfels, haze: Array) -> _Surfels:
    """Mix shaded colours towards the haze; the result takes no more light."""
    albedo = _mix(_shaded(surfels, np.ones(len(surfels))), _HAZE, haze)
    blend = np.where(haze > 1e-3, 0.0, 1.0)
    return replace(surfels, albedo=np.where(blend[:, None] > 0, surfels.albedo, albedo), lit=surfels.lit * blend)


def _box(
    low: ArrayLike,
    high: ArrayLike,
    spacing: float,
    paint: Callable[[Array, Array, Array], Array] | ArrayLike,
    roof: ArrayLike,
    *,
    gloss: float = 0.0,
) -> _Surfels:
    """Four walls and a roof; ``paint`` gets u along the wall and v upwards."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, np.float64), np.asarray(high, np.float64)
    up = [0.0, 0.0, z1 - z0]
    walls = (
        ([x0, y0, z0], [x1 - x0, 0, 0]),
        ([x1, y0, z0], [0, y1 - y0, 0]),
        ([x1, y1, z0], [x0 - x1, 0, 0]),
        ([x0, y1, z0], [0, y0 - y1, 0]),
    )
    parts = [_lattice(_plate(c, s, up), spacing, paint, cover=0.58, gloss=gloss) for c, s in walls]
    parts.append(_lattice(_plate([x0, y0, z1], [x1 - x0, 0, 0], [0, y1 - y0, 0]), spacing, roof, cover=0.58))
    return _join(parts)


def _buildings() -> _Surfels:
    """A terminal with a glass front, two hangars with round roofs, and a control tower."""

    def front(points: Array, u: Array, v: Array) -> Array:
        band = (v > 0.22) & (v < 0.72)
        mullion = np.floor(points[:, 0] / 0.020) % 3 == 0
        colour = np.tile(np.array([0.84, 0.82, 0.78]), (len(u), 1))
        colour[band & ~mullion] = [0.14, 0.22, 0.30]
        colour[v > 0.86] = _ORANGE * 0.9
        return colour

    parts = [_box([-0.34, 0.60, GROUND], [0.16, 0.70, GROUND + 0.085], 0.017, front, [0.74, 0.74, 0.72])]
    parts.append(_box([-0.16, 0.62, GROUND + 0.085], [0.00, 0.70, GROUND + 0.12], 0.018, front, [0.68, 0.69, 0.70]))
    for x in (-0.78, -0.58):
        parts += _hangar(x)
    tower = np.array([0.36, 0.62])

    def shaft(v: Array) -> Array:
        return 0.019 * (1 - 0.25 * v)

    def cab(v: Array) -> Array:
        return 0.028 + 0.010 * v

    def turned(radius: Callable[[Array], Array], z0: float, z1: float) -> Surface:
        def surface(u: Array, v: Array) -> Array:
            angle = 2 * np.pi * u
            ring = radius(v)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1) + tower
            return np.concatenate([ring, (z0 + (z1 - z0) * v)[:, None]], axis=1)

        return surface

    z = GROUND
    parts.append(
        _lattice(
            turned(shaft, z, z + 0.20),
            0.013,
            lambda p, u, v: _mix([0.86, 0.85, 0.82], _ORANGE, ((v > 0.80) & (v < 0.9)).astype(float)),
        )
    )
    parts.append(
        _lattice(
            turned(cab, z + 0.20, z + 0.245),
            0.010,
            lambda p, u, v: _mix([0.10, 0.18, 0.24], [0.85, 0.85, 0.83], ((v < 0.2) | (v > 0.88)).astype(float)),
            gloss=0.10,
        )
    )
    parts.append(_lattice(turned(lambda v: 0.040 * (1 - v) + 1e-3, z + 0.245, z + 0.256), 0.012, [0.80, 0.80, 0.78]))
    mast = np.stack([np.full(5, tower[0]), np.full(5, tower[1]), z + np.linspace(0.256, 0.31, 5)], axis=1)
    parts.append(_surfels(mast, [0, 0, 1], [0, -1, 0], [0.009, 0.0022, 0.0022], _ORANGE, opacity=0.97))
    return _join(parts)


def _hangar(x: float) -> list[_Surfels]:
    width, depth, wall, rise = 0.165, 0.13, 0.035, 0.055
    y0 = 0.60

    def roof(u: Array, v: Array) -> Array:
        angle = np.pi * u
        return np.stack([x - 0.5 * width * np.cos(angle), y0 + depth * v, GROUND + wall + rise * np.sin(angle)], axis=1)

    def gable(u: Array, v: Array) -> Array:
        top = wall + rise * np.sqrt(np.maximum(0.0, 1.0 - (2 * u - 1.0) ** 2))
        return np.stack([x + (u - 0.5) * width, np.full_like(u, y0), GROUND + v * top], axis=1)

    def doors(points: Array, u: Array, v: Array) -> Array:
        door = (np.abs(u - 0.5) < 0.36) & (v < 0.66)
        colour = np.tile(np.array([0.70, 0.73, 0.76]), (len(u), 1))
        colour[door] = [0.26, 0.36, 0.46]
        colour[door & (np.abs((u * 8) % 1.0 - 0.5) < 0.12)] = [0.20, 0.28, 0.36]
        return colour

    parts = [
        _lattice(roof, 0.017, lambda p, u, v: _mix([0.60, 0.64, 0.67], [0.50, 0.54, 0.58], np.floor(v * 8) % 2)),
        _lattice(gable, 0.015, doors),
    ]
    for side in (-0.5, 0.5):
        plate = _plate([x + side * width, y0, GROUND], [0, depth, 0], [0, 0, wall])
        parts.append(_lattice(plate, 0.017, [0.62, 0.65, 0.68], flip=side < 0))
    return parts


def _trees(rng: np.random.Generator) -> _Surfels:
    """Round crowns: leaves on a lumpy ball, with a trunk below."""
    parts = []
    spots = [(x, 0.80 + 0.05 * np.sin(9.0 * x)) for x in np.linspace(-0.95, 0.95, 12)]
    spots += [
        (-0.92, -0.62),
        (-0.55, -0.74),
        (0.60, -0.80),
        (0.90, -0.52),
        (0.53, 0.60),
        (0.64, 0.66),
        (0.95, 0.50),
    ]
    for spot in spots:
        x, y = np.array(spot) + rng.uniform(-0.025, 0.025, 2)
        size = rng.uniform(0.034, 0.052)
        n = 46
        k = np.arange(n) + 0.5
        z = 1.0 - 2.0 * k / n
        angle = k * np.pi * (3.0 - np.sqrt(5.0)) + rng.uniform(0, 6.28)
        normal = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
        lump = 1.0 + 0.14 * _waves(normal[:, :2] + normal[:, 2:], rng, 2.5)
        centre = np.array([x, y, GROUND + 1.75 * size])
        points = centre + size * lump[:, None] * normal * np.array([0.95, 0.95, 1.1])
        green = _mix([0.13, 0.27, 0.09], [0.30, 0.42, 0.14], rng.uniform(0, 1, n)) * rng.uniform(0.85, 1.15)
        leaf = size * rng.uniform(0.26, 0.36, (n, 1)) * np.array([1.0, 0.9, 0.45])
        parts.append(
            _surfels(
                points,
                rng.standard_normal((n, 3)),
                normal + 0.35 * rng.standard_normal((n, 3)),
                leaf,
                green,
                opacity=rng.uniform(0.70, 0.92, n),
            )
        )
        inner = np.array([centre])
        parts.append(_surfels(inner, [1, 0, 0], [0, 0, 1], 0.48 * size, [0.09, 0.15, 0.06], opacity=0.97))
        trunk = np.stack([np.full(3, x), np.full(3, y), GROUND + size * np.array([0.1, 0.45, 0.8])], axis=1)
        parts.append(
            _surfels(trunk, [0, 0, 1], [0, -1, 0], [0.25 * size, 0.09 * size, 0.09 * size], [0.26, 0.19, 0.12])
        )
    return _join(parts)


def _windsock() -> _Surfels:
    """A mast with a striped cone that the wind blows towards -x."""
    x, y, top = 0.47, -0.27, GROUND + 0.115
    mast = np.stack([np.full(8, x), np.full(8, y), np.linspace(GROUND, top, 8)], axis=1)
    parts = [_surfels(mast, [0, 0, 1], [0, -1, 0], [0.009, 0.0022, 0.0022], 0.85, opacity=0.97)]

    def centre(v: Array) -> Array:
        return np.stack([np.full_like(v, y) - 0.012 * v, top - 0.008 - 0.022 * v**2], axis=1)

    parts.append(
        _lattice(
            _revolution(lambda v: 0.014 * (1 - 0.55 * v), centre, x - 0.004, x - 0.085),
            0.0075,
            lambda p, u, v: _mix(_ORANGE, [0.93, 0.93, 0.92], np.floor(v * 5) % 2),
        )
    )
    return _join(parts)


def _hills(rng: np.random.Generator) -> _Surfels:
    """Two hazy ranges on the horizon."""
    parts = []
    for radius, height, sag, count, colour in (
        (3.25, 0.30, 0.40, 96, [0.60, 0.71, 0.78]),
        (2.95, 0.17, 0.9, 110, [0.50, 0.62, 0.56]),
    ):
        angle = (np.arange(count) + 0.5) * 2 * np.pi / count
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ridge = height * (1.0 + sag * 0.6 * _waves(ring, rng, 3.0))
        ridge = np.maximum(ridge, 0.2 * height)
        width = 0.62 * 2 * np.pi * radius / count
        for level in (0.15, 0.55, 0.9):
            points = np.concatenate([radius * ring, (GROUND + level * ridge)[:, None]], axis=1)
            tangent = np.stack([-ring[:, 1], ring[:, 0], np.zeros(count)], axis=1)
            normal = np.concatenate([-ring, np.zeros((count, 1))], axis=1)
            sigma = np.stack([np.full(count, width), 0.24 * ridge, np.full(count, 0.01)], axis=1)
            tone = _mix(colour, _HAZE, np.full(count, 0.30 - 0.2 * level))
            parts.append(_surfels(points, tangent, normal, sigma, tone, opacity=0.85, lit=0.0))
    return _join(parts)


def _sky(rng: np.random.Generator) -> _Surfels:
    """A dome of wide, faint Gaussians that turns the background bluer towards the zenith, and clouds."""
    radius, count = 4.0, 190
    k = np.arange(count) + 0.5
    z = -0.10 + 1.10 * k / count
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    out = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    spacing = np.sqrt(2 * np.pi * 1.1 / count) * radius
    colour = _mix(_HAZE, _ZENITH, _smooth(z, -0.05, 0.75))
    size = [0.72 * spacing, 0.72 * spacing, 0.02]
    dome = _surfels(
        radius * out,
        np.cross(out, [0.0, 0, 1.0]),
        -out,
        size,
        colour,
        opacity=0.35 + 0.35 * _smooth(z, -0.1, 0.4),
        lit=0.0,
    )
    parts = [dome]
    for bearing in np.deg2rad([68, 96, 128, 20, 165, -35, -80, 215, 255, 300]):
        azimuth = bearing + rng.uniform(-0.1, 0.1)
        n, lift = 9, rng.uniform(0.08, 0.26)
        spread = np.sort(rng.uniform(-0.16, 0.16, n))
        a = azimuth + spread
        bulge = np.sqrt(np.maximum(0.05, 1.0 - (spread / 0.17) ** 2))
        z = lift + 0.035 * bulge * rng.uniform(0.2, 1.0, n)
        points = 3.5 * np.stack([np.cos(a), np.sin(a), z], axis=1)
        normal = -_unit(points)
        size = np.stack([0.16 * bulge + 0.04, 0.08 * bulge + 0.015, np.full(n, 0.02)], axis=1)
        parts.append(
            _surfels(
                points,
                np.cross([0.0, 0, 1.0], normal),
                normal,
                size,
                [0.98, 0.98, 0.985],
                opacity=rng.uniform(0.25, 0.55, n),
                lit=0.0,
            )
        )
    return _join(parts)


# ---------------------------------------------------------------- light


def _shaded(surfels: _Surfels, sun: Array) -> Array:
    """Diffuse colour [n, 3]: sunlight (``sun`` [n] is the unshadowed share), sky light and bounce."""
    up = 0.5 + 0.5 * surfels.normals[:, 2:]
    light = (
        _SUNLIGHT * (np.maximum(_dot(surfels.normals, _SUN), 0.0) * sun)[:, None]
        + (_SKYLIGHT * up + _BOUNCE * (1.0 - up)) * (0.72 + 0.28 * sun)[:, None]
    )
    return surfels.albedo * (1.0 - surfels.lit[:, None] + surfels.lit[:, None] * light)


def _sun_share(receivers: Array, casters: _Surfels, blur: float) -> Array:
    """Share of sunlight [n] left at ground points by ``casters``: their shadow, blurred by ``blur``."""
    size, limit = 512, 1.4
    height = casters.points[:, 2] - GROUND
    shadow = casters.points[:, :2] - (height / _SUN[2])[:, None] * _SUN[:2]
    area = casters.sigma[:, 0] * casters.sigma[:, 1] * np.abs(_dot(casters.normals, _SUN)) * 2 * np.pi * 0.45
    index = np.floor((shadow + limit) / (2 * limit) * size).astype(int)
    inside = np.all((index >= 0) & (index < size), axis=1)
    cell = 2 * limit / size
    mass = np.zeros((size, size))
    np.add.at(mass, (index[inside, 0], index[inside, 1]), area[inside] / cell**2)
    frequency = np.fft.fftfreq(size, cell)
    kernel = np.exp(-2 * (np.pi * blur * frequency) ** 2)
    cover = np.fft.ifft2(np.fft.fft2(mass) * kernel[:, None] * kernel[None]).real
    share = np.exp(-1.4 * np.maximum(cover, 0.0))
    at = np.clip(np.floor((receivers[:, :2] + limit) / (2 * limit) * size).astype(int), 0, size - 1)
    return share[at[:, 0], at[:, 1]]


def _sh_basis(direction: Array) -> Array:
    """Real spherical harmonics [n, 9] of degree 2 at unit vectors, signed as gsplat signs them."""
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    c1, c2 = 0.48860251190292, 1.092548430592079
    return np.stack(
        [
            np.full_like(x, 0.28209479177387814),
            -c1 * y,
            c1 * z,
            -c1 * x,
            c2 * x * y,
            -c2 * y * z,
            0.9461746957575601 * z * z - 0.3153915652525201,
            -c2 * x * z,
            0.5 * c2 * (x * x - y * y),
        ],
        axis=-1,
    )


def _reflected(direction: Array) -> Array:
    """Radiance [..., 3] that arrives from unit directions: ground, sky and a broad sun."""
    z = direction[..., 2]
    sky = _mix(_HAZE, 0.85 * _ZENITH, _smooth(z, 0.0, 0.8))
    ground = _mix([0.50, 0.55, 0.45], [0.26, 0.30, 0.22], _smooth(-z, 0.0, 0.7))
    radiance = _mix(ground, sky, _smooth(z, -0.12, 0.12))
    lobe = np.maximum(direction @ _SUN, 0.0) ** 10
    return radiance + 5.5 * lobe[..., None] * np.array([1.0, 0.97, 0.90])


def _glossy_sh(diffuse: Array, normals: Array, gloss: Array) -> Array:
    """Least-squares SH [n, 9, 3] of a varnished diffuse surface, over the directions that see it.

    The ridge keeps the unseen hemisphere, where no data stand, from swinging far off.
    """
    count = 160
    k = np.arange(count) + 0.5
    z = k / count
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    local = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0, 1.0]], [[1.0, 0, 0]])
    e1 = _unit(np.cross(helper, normals))
    frame = np.stack([e1, np.cross(normals, e1), normals], axis=1)  # [n, 3, 3], rows are axes
    coefficients = np.empty((len(normals), 9, 3))
    for start in range(0, len(normals), 1024):
        part = slice(start, start + 1024)
        view = local @ frame[part]  # [m, count, 3], from the surface to the camera
        cosine = local[:, 2]
        mirror = 2.0 * cosine[None, :, None] * normals[part, None] - view
        fresnel = gloss[part, None] + (1.0 - gloss[part, None]) * 0.6 * (1.0 - cosine) ** 4
        target = diffuse[part, None] * (1.0 - fresnel[..., None]) + fresnel[..., None] * _reflected(mirror)
        # gsplat evaluates at the direction from the camera to the Gaussian.
        basis = _sh_basis(-view)
        weighted = basis * (0.25 + cosine)[None, :, None]
        normal_matrix = weighted.transpose(0, 2, 1) @ basis
        ridge = 0.02 * count * np.diag([0.0, 0.5, 0.5, 0.5, 1, 1, 1, 1, 1])
        coefficients[part] = np.linalg.solve(normal_matrix + ridge, weighted.transpose(0, 2, 1) @ (target - 0.5))
    return coefficients


def _quaternions(tangents: Array, normals: Array) -> Array:
    """Unit quaternions [n, 4] (w, x, y, z) of the frames (tangent, normal x tangent, normal)."""
    a, b, c = tangents, np.cross(normals, tangents), normals
    # Four candidate formulas; the largest denominator keeps each division well conditioned.
    w = 1 + a[:, 0] + b[:, 1] + c[:, 2]
    x = 1 + a[:, 0] - b[:, 1] - c[:, 2]
    y = 1 - a[:, 0] + b[:, 1] - c[:, 2]
    z = 1 - a[:, 0] - b[:, 1] + c[:, 2]
    p, q, r = b[:, 2] - c[:, 1], c[:, 0] - a[:, 2], a[:, 1] - b[:, 0]
    s, t, o = a[:, 1] + b[:, 0], a[:, 2] + c[:, 0], b[:, 2] + c[:, 1]
    options = np.stack(
        [np.stack(row, axis=1) for row in ((w, p, q, r), (p, x, s, t), (q, s, y, o), (r, t, o, z))], axis=1
    )
    best = np.argmax(np.stack([w, x, y, z], axis=1), axis=1)
    return _unit(options[np.arange(len(a)), best])


def airfield(seed: int = 0) -> SplatScene:
    """The demonstration scene, about 17,500 Gaussians; equal seeds give equal arrays.

    Returns:
        A scene with SH of degree 2 (bands 1 and 2 are zero on matt surfaces), classic
        rasterisation and a white background behind the sky dome.
    """
    rng = np.random.default_rng(seed)
    turn = np.array(
        [
            [np.cos(_PLANE_PITCH), 0, -np.sin(_PLANE_PITCH)],
            [0, 1, 0],
            [np.sin(_PLANE_PITCH), 0, np.cos(_PLANE_PITCH)],
        ]
    )
    plane = _aircraft(0.0128).placed(turn, _PLANE_ORIGIN, PLANE_LENGTH)
    about = np.deg2rad(-70.0)
    parked_turn = np.array([[np.cos(about), -np.sin(about), 0], [np.sin(about), np.cos(about), 0], [0, 0, 1]])
    parked = _aircraft(0.040).placed(parked_turn, np.array([0.27, 0.475, GROUND + 0.034]), 0.24)

    solids = _join([_buildings(), _trees(rng), _windsock(), parked])
    ground = _join([_runway(rng), _pavements(rng), _grass(rng)])
    sun = _sun_share(ground.points, plane, 0.010) * _sun_share(ground.points, solids, 0.008)
    # Whatever touches the ground also takes sky light from it.
    flat = replace(solids, normals=np.tile(_SUN, (len(solids), 1)))
    sun *= _sun_share(ground.points, flat.keep(solids.points[:, 2] < GROUND + 0.04), 0.018) ** 0.4
    matt_ground = replace(
        ground, albedo=ground.albedo * np.where(ground.lit[:, None] > 0, 1.0, 0.55 + 0.45 * sun[:, None])
    )

    parts = [(matt_ground, sun), *((p, np.ones(len(p))) for p in (plane, solids, _hills(rng), _sky(rng)))]
    surfels = _join([p for p, _ in parts])
    diffuse = _shaded(surfels, np.concatenate([s for _, s in parts]))

    sh = np.zeros((len(surfels), 9, 3))
    sh[:, 0] = (diffuse - 0.5) / 0.28209479177387814
    glossy = surfels.gloss > 0
    sh[glossy] = _glossy_sh(diffuse[glossy], surfels.normals[glossy], surfels.gloss[glossy])
    opacity = surfels.opacity
    return SplatScene(
        means=surfels.points.astype(np.float32),
        log_scales=np.log(np.maximum(surfels.sigma, 2e-4)).astype(np.float32),
        quats=_quaternions(surfels.tangents, surfels.normals).astype(np.float32),
        opacity_logits=np.log(opacity / (1.0 - opacity)).astype(np.float32),
        sh=sh.astype(np.float32),
        color_model="sh",
        sh_degree=2,
        rasterize_mode="classic",
        background=np.ones(3, np.float32),
        name="airfield",
    )


def write_scene(file: Path, scene: SplatScene) -> None:
    """Write the arrays that `ns_abstract.demo.scenes.splat_scene` reads."""
    names = "means", "log_scales", "quats", "opacity_logits", "sh", "background"
    arrays = {name: getattr(scene, name) for name in names}
    write_atomic(file, lambda stream: np.savez_compressed(stream, **arrays))


if __name__ == "__main__":
    write_scene(Path(sys.argv[1]), airfield())
