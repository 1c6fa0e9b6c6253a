"""Wide cells, bounded by intervals over parts of them (design.md, B12)."""

from __future__ import annotations

import itertools

import mpmath
import numpy as np
import pytest
from numba import njit
from test_bounds import Case, moves, scene

from ns_abstract.arithmetic.rounding import FLOAT32, REAL, UNIT64, charges
from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.geometry.box import shared_out
from ns_abstract.methods.splat.block_buffers import block_of, new_buffers
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0, raster_rules
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.intervals import blend_parts
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    EXPONENT,
    color_ends,
    color_size,
    exponent_ends,
    fragment_width,
    set_unknown,
)
from ns_abstract.methods.splat.stage_data import FormShape, Parts, PixelInputs, SubBoxes, cell_parts
from ns_abstract.perturbation.specification import Perturbation

BACKGROUND = np.array([0.25, 0.5, 0.75])


@njit(error_model="numpy")
def _blended(values, palette, shape, parts, rules, charges_, unknown, out, slopes):
    """`blend_parts` of a pixel whose fragments are rows of ``values``, nearest first; of some nothing is known."""
    buffers = new_buffers(shape, 1, 1, BACKGROUND)
    block = block_of(buffers, shape, 1)
    count, width = values.shape
    for e in range(count):
        for k in range(width):
            buffers.values[e * width + k] = values[e, k]
        buffers.lists[0, e, 0], buffers.lists[0, e, 1], buffers.lists[0, e, 2] = e, e, 0
        if unknown[e]:
            set_unknown(block.fragments, e * width, values[e, ALPHA_HIGH], shape.monomials)
    buffers.palette[: palette.size] = palette
    of_parts = Parts(
        pointer(parts.middles), pointer(parts.half), pointer(parts.slope), parts.levels, parts.motion, parts.side
    )
    inputs = PixelInputs(None, None, None, None, rules, charges_, None, shape, of_parts)
    ends = blend_parts(0, count, False, block, inputs, pointer(slopes))
    for k in range(4):
        out[k], out[4 + k] = block.part_ends[k], block.part_ends[4 + k]
    # the owner of the block's memory lives to here
    return len(buffers) + 0 * len(ends)


class _Pixel:
    """Fragments of exact exponents: centres and slopes have few bits, so that radii over parts are exact as well."""

    def __init__(self, counts: tuple[int, ...], fragments: int, seed: int, size: float = 1.0) -> None:
        generator = np.random.default_rng(seed)
        self.d, self.counts = len(counts), np.array(counts)
        self.parts = cell_parts(self.counts)
        self.shape = FormShape(self.d, 1, self.d + 1, int(self.counts.prod()))
        scale = 2.0**-10
        self.centers = np.round(generator.uniform(-3.0, 3.0, (fragments, 2)) / scale) * scale
        self.slopes = np.round(generator.uniform(-size, size, (fragments, self.d, 2)) / scale) * scale
        self.radii = np.round(generator.uniform(0.0, 0.05, (fragments, 2)) / scale) * scale
        self.opacity = generator.uniform(0.02, 1.0, fragments)
        self.colors = generator.uniform(-0.2, 1.4, (fragments, 3))
        self.unknown = generator.random(fragments) < 0.1
        self.rules, self.charges = raster_rules(GSPLAT_1_4_0, False), charges(REAL)

    def bounds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower and upper [3], slopes [d, 3]."""
        count, m = len(self.opacity), self.shape.monomials
        values, ends = np.zeros((count, int(fragment_width(self.shape)))), exponent_ends(m)
        values[:, ALPHA_HIGH] = np.minimum(self.opacity, self.rules.alpha_max)
        values[:, EXPONENT : EXPONENT + 2] = self.centers
        values[:, EXPONENT + 2 : ends] = self.slopes.reshape(count, -1)
        over = np.abs(self.slopes) * self.parts.half[:, None]
        values[:, ends : ends + 2] = over.sum(axis=1) + self.radii
        # as for real arithmetic: eight relative errors of the exponential kernel
        values[:, ends + 2], values[:, ends + 3] = self.opacity * (1 - 2.0**-47), self.opacity * (1 + 2.0**-47)
        values[:, ends + 4] = self.rules.alpha_min
        palette = np.zeros((count, int(color_size(1)) // 4, 4))
        first = int(color_ends(1)) // 4
        palette[:, 0, :3] = palette[:, first, :3] = palette[:, first + 1, :3] = self.colors
        out, slopes = np.zeros(8), np.zeros(4 * self.d + 8)
        _blended(values, palette.ravel(), self.shape, self.parts, self.rules, self.charges, self.unknown, out, slopes)
        return out[:3], out[4:7], slopes[: 4 * self.d].reshape(self.d, 4)[:, :3]

    def picture(self, place: np.ndarray, generator: np.random.Generator) -> list[mpmath.mpf]:
        """The exact blend at a place, every radius used by chance, to its ends in most cases."""
        shown = [mpmath.mpf(float(b)) for b in BACKGROUND]
        for e in reversed(range(len(self.opacity))):
            off = generator.choice([-1.0, 1.0, generator.uniform(-1.0, 1.0)], 2) * self.radii[e]
            slopes, at = self.slopes[e], [mpmath.mpf(float(p)) for p in place]
            y = [mpmath.mpf(float(self.centers[e, i])) + mpmath.mpf(float(off[i])) for i in range(2)]
            y = [y[i] + sum(mpmath.mpf(float(slopes[k, i])) * at[k] for k in range(self.d)) for i in range(2)]
            alpha = mpmath.mpf(float(self.opacity[e])) * mpmath.exp(-(y[0] ** 2 + y[1] ** 2) / 2)
            alpha = min(alpha, mpmath.mpf(self.rules.alpha_max))
            if self.unknown[e]:
                alpha = generator.choice([0.0, 1.0]) * min(self.opacity[e], self.rules.alpha_max)
            elif alpha < mpmath.mpf(self.rules.alpha_min):
                continue
            shown = [old + alpha * (mpmath.mpf(float(c)) - old) for c, old in zip(self.colors[e], shown, strict=True)]
        return shown


@pytest.mark.slow
@pytest.mark.parametrize("counts", [(8,), (4, 2), (2, 2, 2), (4, 4, 2), (8, 1, 1), (2, 1, 4, 1, 1, 2)])
@pytest.mark.parametrize("size", [0.3, 2.0])
def test_blends_over_parts_hold_every_exact_blend(counts, size):
    """Poses in all parts, at their corners too, every radius used: in high precision, but for the blend's rounding."""
    generator = np.random.default_rng(7)
    with mpmath.workdps(40):
        for seed in range(3):
            pixel = _Pixel(counts, 24, seed, size)
            low, high, _ = pixel.bounds()
            # what `_slack` charges for the package's own blend
            room = 24.0 * UNIT64 * len(pixel.opacity)
            assert (low >= -0.3).all() and (high <= 1.5).all()
            corners = list(itertools.product(*([-1.0, 1.0] for _ in counts)))
            places = [np.array(c) for c in corners[:16]] + list(generator.uniform(-1.0, 1.0, (40, len(counts))))
            middles = pixel.parts.middles.T
            edges = middles + pixel.parts.half * generator.choice([-1.0, 1.0], middles.shape)
            for place in [*places, *edges]:
                for channel, value in enumerate(pixel.picture(place, generator)):
                    assert low[channel] - room <= value <= high[channel] + room


@pytest.mark.slow
def test_one_fragment_over_parts():
    """A fragment that moves along one axis: its least and most alpha are those at the ends, parts or not."""
    pixel = _Pixel((4, 2), 1, 0)
    pixel.centers[:], pixel.slopes[:], pixel.radii[:] = (0.75, 0.5), 0.0, 0.0
    pixel.slopes[0, 0, 0], pixel.opacity[:], pixel.unknown[:], pixel.colors[:] = 0.5, 0.8, False, 1.0
    low, high, slopes = pixel.bounds()
    for found, place in ((high, -1.0), (low, 1.0)):
        with mpmath.workdps(40):
            (value, *_) = pixel.picture(np.array([place, 0.0]), np.random.default_rng(0))
        assert found[0] == pytest.approx(float(value), abs=1e-12)
    assert (low[0] - high[0]) / 2.0 == pytest.approx(-abs(slopes[0, 0]), rel=0.1)


@pytest.mark.parametrize("counts", [(8,), (4, 2), (1, 16), (2, 1, 4, 1, 1, 2)])
def test_parts_cover_the_cell(counts):
    """Every point, ends included, is in a part, exactly."""
    parts = cell_parts(np.array(counts))
    low, high = parts.middles.T - parts.half, parts.middles.T + parts.half
    assert parts.middles.shape == (len(counts), np.prod(counts)) and np.prod(parts.half) * np.prod(counts) == 1.0
    generator = np.random.default_rng(0)
    places = [np.ones(len(counts)), -np.ones(len(counts)), *generator.uniform(-1.0, 1.0, (200, len(counts)))]
    for place in [*places, *low, *high]:
        assert ((low <= place) & (place <= high)).all(axis=1).any()


@pytest.mark.slow
def test_more_parts_say_more():
    """Parts of parts are never worse, and with many of them hardly more is left than what poses show."""
    pixel = _Pixel((2, 2, 2), 24, 1, 0.5)
    pixel.radii[:] = 0.0
    pixel.unknown[:] = False
    widths = []
    for counts in ((2, 2, 2), (4, 4, 4), (16, 16, 16)):
        pixel.counts = np.array(counts)
        pixel.parts = cell_parts(pixel.counts)
        pixel.shape = pixel.shape._replace(parts=int(pixel.counts.prod()))
        low, high, _ = pixel.bounds()
        widths.append(high - low)
    generator = np.random.default_rng(0)
    places = [*itertools.product((-1.0, 1.0), repeat=3), *generator.uniform(-1.0, 1.0, (400, 3))]
    with mpmath.workdps(20):
        seen = np.array([pixel.picture(np.array(place), generator) for place in places], np.float64)
    assert (widths[1] <= widths[0] + 1e-13).all() and (widths[2] <= widths[1] + 1e-13).all()
    assert widths[0].mean() > 1.2 * widths[2].mean()
    assert widths[2].mean() < 1.3 * np.ptp(seen, axis=0).mean()


@pytest.mark.slow
def test_slopes_tell_what_varies():
    """The slope of a parameter that moves things more is larger, and 0 for one whose axis is not divided."""
    pixel = _Pixel((4, 2, 1), 8, 2, 0.1)
    pixel.slopes[:, 0] *= 4.0
    _, _, slopes = pixel.bounds()
    assert np.abs(slopes[0]).sum() > 2.0 * np.abs(slopes[1]).sum() > 0.0
    assert (slopes[2] == 0.0).all()


def wide_case(antialiased: bool, degree: int, **limits: float) -> Case:
    """A hundred layers that move by about a pixel."""
    generator = np.random.default_rng(4)
    layers = [
        {
            "mean": (*generator.uniform(-2.2, 2.2, 2), generator.uniform(-7.0, -5.0)),
            "scale": generator.uniform(0.1, 0.5),
            "opacity": generator.uniform(0.1, 0.9),
            "sh": generator.normal(0.0, 0.4, ((degree + 1) ** 2, 3)),
        }
        for _ in range(100)
    ]
    return Case(scene(*layers, background=(0.5, 0.4, 0.6), antialiased=antialiased), moves(**limits))


@pytest.mark.parametrize("arithmetic", [REAL, FLOAT32], ids=["real", "float32"])
@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
@pytest.mark.parametrize(
    "limits, degree, forms, most",
    [
        ({"x": 0.15, "y": 0.15}, 0, 0.8, 1.8),
        ({"x": 0.15, "yaw": 0.03}, 1, 0.8, 1.8),
        (dict.fromkeys("xyz", 0.15), 0, 0.8, 2.0),
        ({**dict.fromkeys("xyz", 0.1), **dict.fromkeys(("yaw", "pitch", "roll"), 0.01)}, 0, 0.9, 2.2),
    ],
    ids=["two", "turned", "three", "six"],
)
def test_wide_cells_are_tighter_over_parts(limits, degree, forms, most, antialiased, arithmetic):
    """Where things move by a pixel, bounds over parts hold all that poses show and are far tighter than forms."""
    case = wide_case(antialiased, degree, **limits)
    box = case.poses.box
    by_forms = case.bounds(box, 1, arithmetic)
    over_parts = case.bounds(box, 1, arithmetic, parts=shared_out(np.ones(box.dimensions), 32))
    pictures = np.stack([case.image(values) for values in case.samples(box, 200)])
    lower, upper = over_parts.lower.reshape(16, 16, 3), over_parts.upper.reshape(16, 16, 3)
    assert (lower <= pictures).all() and (pictures <= upper).all()
    gap = (upper - lower).mean()
    assert gap < forms * (by_forms.upper - by_forms.lower).mean()
    assert gap < most * np.ptp(pictures, axis=0).mean()


def _asked(frame: SplatFrame, monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray | None]:
    """Numbers of parts that cells of the frame are bounded over from now on, one after the other."""
    asked, cell = [], SplatBounds.cell

    def spied(self, *arguments, **options):
        asked.append(arguments[8] if len(arguments) > 8 else options.get("parts"))
        return cell(self, *arguments, **options)

    monkeypatch.setattr(SplatBounds, "cell", spied)
    return asked


def test_frames_take_parts_for_wide_cells_of_several_parameters(monkeypatch):
    """Narrow cells, one parameter, and what is asked for linear sets or layers keep to forms."""
    case = wide_case(False, 0, x=0.15, y=0.15, z=0.15)
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, REAL, case.poses)
    asked, tiles = _asked(frame, monkeypatch), np.arange(frame.tile_count)
    wide = frame.bound(frame.box, tiles)
    assert asked[-1].prod() == 32 and asked[-1][2] < asked[-1][0]
    assert (wide.slopes > 0.0).all() and wide.slopes[2] < wide.slopes[0]
    frame.bound(frame.box, tiles, keep_linear=True)
    assert asked[-1] is None
    narrow = frame.box
    for axis in range(3):
        narrow = narrow.split(axis, 64)[0]
    frame.bound(narrow, tiles)
    assert asked[-1] is None
    layered = SplatFrame(case.splats, GSPLAT_1_4_0, REAL, case.poses, layers=True)
    layered.bound(layered.box, tiles)
    assert asked[-1] is None
    one = wide_case(False, 0, x=0.5)
    SplatFrame(one.splats, GSPLAT_1_4_0, REAL, one.poses).bound(one.poses.box, tiles)
    assert asked[-1] is None


def test_axes_that_are_not_divided_have_slopes():
    """A parameter that moves things little is split too when the others' cells have become narrow."""
    case = wide_case(False, 0, x=0.3, y=0.01)
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, REAL, case.poses)
    assert frame._parts(frame.box).tolist() == [32, 1]
    slopes = frame.bound(frame.box, np.arange(frame.tile_count)).slopes
    assert slopes[1] > 0.0 and slopes[0] / slopes[1] == pytest.approx(30.0, rel=0.05)


@pytest.mark.parametrize("counts", [[3, 4], [2, 2], [8], [0, 8], [-2, -4], [8, 8, 1]])
def test_numbers_of_parts_are_checked(counts):
    case = wide_case(False, 0, x=0.15, y=0.15)
    with pytest.raises(ValueError, match="no numbers of parts along 2 axes"):
        case.bounds(case.poses.box, 1, parts=np.array(counts))


def test_parts_have_no_linear_sets_and_no_layers():
    case = wide_case(False, 0, x=0.15, y=0.15)
    for option in ("keep_linear", "layers"):
        with pytest.raises(ValueError, match="no linear sets and no layers"):
            case.bounds(case.poses.box, 1, parts=np.array([4, 2]), **{option: True})
    with pytest.raises(ValueError, match="nor sub-boxes"):
        case.bounds(case.poses.box, 1, parts=np.array([4, 2]), sub_boxes=SubBoxes(np.array([4, 2])))
    one = wide_case(False, 0, x=0.15)
    with pytest.raises(ValueError, match="one parameter have no parts"):
        one.bounds(one.poses.box, 2, parts=np.array([8]))


def test_a_set_of_one_pose_has_no_parts():
    case = wide_case(False, 0)
    case.poses = case.poses.around(case.camera, Perturbation())
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, REAL, case.poses)
    assert frame._parts(frame.box) is None
