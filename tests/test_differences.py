"""Differences of two scenes: bounds hold every pair of renders exactly, verdicts say no more than is known."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import Inputs, blob_scene, ring
from nerfactos import tiny_nerfacto
from scene_files import nerf_run, path_of

import ns_abstract as nsa
from ns_abstract.api.comparing import ComparisonJob
from ns_abstract.api.job import Job
from ns_abstract.arithmetic.rounding import DIFFERENCE_ROUNDING
from ns_abstract.cli.compare import main
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.methods.nerf.write import write_nerfacto_run
from ns_abstract.methods.splat.frame import linear_sets
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.shared_order import extensions, groups, matched, uncertain
from ns_abstract.methods.splat.write import write_ply, write_splatfacto_run
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.refine.difference import DifferenceFrame, _polynomial_upper, linear_upper
from ns_abstract.refine.goal import RefinementGoal
from ns_abstract.refine.largest import TUNING, GainWatch, LargestDifference, LargestTuning
from ns_abstract.refine.result import PartResult
from ns_abstract.report.comparison import overall, verdict

InProcess = Callable[..., tuple[int, str, str]]
SHIFT = {"version": 1, "translation": {"x": 0.03}}
SHEARED = {"version": 1, "translation": {"x": 0.01, "z": 0.01}, "rotation": {"yaw": 0.008}}


def rounded(scene: SplatScene) -> SplatScene:
    """Colours, rotations and scales with few bits."""
    parts = {"sh": 0.08, "quats": 0.02, "log_scales": 0.05}
    return replace(
        scene,
        **{k: (np.round(getattr(scene, k) / step) * np.float32(step)).astype(np.float32) for k, step in parts.items()},
    )


def pruned(scene: SplatScene) -> SplatScene:
    """Without the fifth of least opacity."""
    kept = np.sort(np.argsort(scene.opacity_logits, kind="stable")[scene.count // 5 :])
    names = ("means", "log_scales", "quats", "opacity_logits", "sh")
    return replace(scene, **{name: getattr(scene, name)[kept] for name in names})


CHANGES = {"rounded": rounded, "pruned": pruned, "same": lambda scene: scene}


def difference(
    change: str, spec: dict[str, Any], arithmetic: str = "float32", **more: Any
) -> tuple[DifferenceFrame, DifferenceFrame]:
    """The difference of blobs and a changed version of them, in the set's parameters and sheared."""
    scene = blob_scene(**more)
    first, second = (SplatMethod(s, None, arithmetic) for s in (scene, CHANGES[change](scene)))
    given = ring()[1]
    camera = nsa.Camera(given.camera_to_world, given.fov, given.width, given.height)
    poses = PoseBox.around(camera, parse_perturbation(spec, field_prefix=""), None)
    frames = []
    for sheared in (False, True):
        frame = first.frame(poses, sheared)
        frames.append(DifferenceFrame(frame, second.frame(frame.pose_set)))
    return frames[0], frames[1]


@dataclass
class Parabolas:
    """Pictures clamp(c + s v + q v^2) of one parameter, with polynomials that bound them, at a distance."""

    seed: int
    change: float = 0.0
    side: int = 4
    across: int = 2
    down: int = 2
    broken: bool = False
    unsure: float = 0.0
    pose_set: Any = None
    tilewise: bool = False
    tiles_at_once: int | None = None
    witnesses: int = 1
    stages: tuple[str, ...] = ()
    channels: int = 3

    def __post_init__(self) -> None:
        # the last row of pixels lies outside of the picture
        self.camera = SimpleNamespace(width=8, height=7)
        self.box = ParameterBox(("x",), ("",), (-1.0,), (1.0,))
        random = np.random.default_rng(self.seed)
        self.terms = (
            random.normal(size=(3, 4, 4, 4, 3)) * np.array([0.4, 0.1, 0.3]).reshape(3, 1, 1, 1, 1) + self.change
        )
        self.terms[0] += 0.5

    @property
    def tile_count(self) -> int:
        return self.across * self.down

    def feasible(self, box: ParameterBox) -> ParameterBox:
        return box

    def motion(self, box: ParameterBox) -> np.ndarray:
        return np.array([2.0])

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        c, s, q = self.terms if tiles is None else self.terms[:, tiles]
        return np.clip(c + s * values[0] + q * values[0] ** 2, 0.0, 1.0).astype(np.float32)

    def bound_parts(self, boxes: Any, tiles: np.ndarray, within: Any, keep_linear: bool, pixels: Any) -> list[Any]:
        found = []
        for box in boxes:
            c, s, q = self.terms[:, tiles]
            m, h = float(box.middle[0]), 0.5 * (box.upper[0] - box.lower[0])
            parts = c + s * m + q * m * m, (s + 2.0 * q * m) * h, q * h * h, np.full_like(c, 1e-6 + 0.3 * h * h)
            forms = np.stack(parts, axis=-1)
            steep = np.abs(forms[..., 1:]).sum(axis=-1)
            low, high = (np.clip(forms[..., 0] + end, 0.0, 1.0) for end in (-steep, steep))
            linear = linear_sets(forms, low, high, 1)
            if self.broken and 0 in tiles:
                forms[0, 0, 0] = np.nan
            if self.unsure and tiles[0] == 0:
                # as where rounding decides whether a threshold is met: no cell is narrow enough
                forms[0, 0, 0, :, -1] += self.unsure
                low[0, 0, 0], high[0, 0, 0] = 0.0, 1.0
                linear = linear_sets(forms, low, high, 1)
            context = SimpleNamespace(nbytes=0)
            slopes = np.array([steep.mean()])
            found.append(
                SimpleNamespace(
                    lower=np.float32(low) - np.float32(1e-6), upper=np.float32(high) + np.float32(1e-6), slopes=slopes,
                    context=context, linear=linear, forms=forms,
                )
            )  # fmt: skip
        return found


def parabolas(**more: Any) -> DifferenceFrame:
    return DifferenceFrame(Parabolas(0), Parabolas(0, **more))  # type: ignore[arg-type]


@pytest.mark.parametrize("change", [0.01, -0.2])
def test_differences_of_parabolas_hold_every_render(change: float) -> None:
    frame = parabolas(change=change)
    some = np.zeros((4, 4, 4), bool)
    some[:, ::2] = True
    for parts in (1, 3, 16):
        for box in frame.box.split(0, parts):
            whole = frame.bound(box, np.arange(4))
            (inner,) = frame.bound_parts([box], np.arange(4), whole.context, True, some)
            assert (inner.upper[~some] == 1.0).all() and (inner.upper[some] == whole.upper[some]).all()
            pictures = np.stack([frame.render(box.at(np.array([p]))) for p in np.linspace(-1.0, 1.0, 33)])
            assert (pictures <= whole.upper).all()
            if change > 0.0 and parts == 16:
                # equal terms cancel; what is left is 0.03 at most and the radii, whatever the pictures do
                assert whole.upper.max() < 0.033


def unsheared(frame: DifferenceFrame, values: np.ndarray, sign: float = 1.0) -> np.ndarray:
    """The set's own parameters of those of a sheared frame."""
    names, moved = frame.box.names, values.copy()
    for name, factors in frame.pose_set.shear.items():
        moved[names.index(name)] += sign * sum(f * values[names.index(other)] for other, f in factors.items())
    return moved


def sheared(frame: DifferenceFrame, values: np.ndarray) -> np.ndarray:
    """The other way round."""
    return unsheared(frame, values, -1.0)


def exactly(values: np.ndarray) -> Iterator[Fraction]:
    return map(Fraction, np.asarray(values, np.float64).ravel().tolist())


def test_linear_bounds_hold_exact_differences() -> None:
    random = np.random.default_rng(0)
    for d in (0, 1, 3):
        a, b = (
            SimpleNamespace(
                linear=tuple(
                    random.normal(size=(40, *((d,) if k % 2 == 0 else ()))).astype(np.float32) for k in range(4)
                ),
                upper=np.ones(40, np.float32),
            )
            for _ in range(2)
        )
        found = linear_upper(a, b)  # type: ignore[arg-type]
        for n in range(40):
            most = Fraction(-100)
            for corner in itertools.product((-1, 1), repeat=d):
                at = [
                    [
                        sum(
                            (s * Fraction(float(x)) for s, x in zip(corner, side.linear[2 * k][n], strict=True)),
                            Fraction(0),
                        )
                        + Fraction(float(side.linear[2 * k + 1][n]))
                        for k in range(2)
                    ]
                    for side in (a, b)
                ]
                most = max(most, at[0][1] - at[1][0], at[1][1] - at[0][0])
            assert most <= Fraction(float(found[n])) <= most + Fraction(1, 10**9)


@pytest.mark.slow
@pytest.mark.parametrize(("d", "order"), [(1, 2), (1, 1), (2, 2), (3, 1)])
def test_polynomials_hold_exact_values(d: int, order: int) -> None:
    random = np.random.default_rng(d)
    squares = [(k, l) for k in range(d) for l in range(k, d)] if order == 2 else []
    coefficients = random.normal(size=(60, 1 + d + len(squares) + 1))
    found = _polynomial_upper(coefficients, d)
    steps = [Fraction(k, 32) for k in range(-32, 33)] if d == 1 else [Fraction(k, 4) for k in range(-4, 5)]
    for row, upper in zip(coefficients, found, strict=True):
        terms = list(exactly(row[:-1]))
        most = max(
            terms[0]
            + sum((s * p for s, p in zip(terms[1:], point, strict=False)), Fraction(0))
            + sum((q * point[k] * point[l] for q, (k, l) in zip(terms[1 + d :], squares, strict=True)), Fraction(0))
            for point in itertools.product(steps, repeat=d)
        )
        assert most <= Fraction(float(upper)) + Fraction(DIFFERENCE_ROUNDING) * sum(map(abs, terms))
        if d == 1:
            assert float(upper) <= float(most) + 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "spec", "arithmetic"),
    [
        ("rounded", SHIFT, "float32"), ("pruned", SHIFT, "float32"), ("rounded", SHEARED, "float32"),
        ("pruned", SHEARED, "float32"), ("rounded", SHIFT, "real"), ("pruned", SHIFT, "real"),
    ],
)  # fmt: skip
def test_differences_of_cells_hold_every_render(change: str, spec: dict[str, Any], arithmetic: str) -> None:
    given, frame = difference(change, spec, arithmetic)
    random = np.random.default_rng(3)
    tiles = np.arange(frame.tile_count)
    for parts in (4, 32, 1024, 2**20):
        box = frame.box
        inside = unsheared(frame, box.sample(1, random)[0])
        while not given.box.contains(inside):
            inside = unsheared(frame, box.sample(1, random)[0])
        values = sheared(frame, inside)
        for axis in range(box.dimensions):
            box = next(part for part in box.split(axis, parts) if part.lower[axis] <= values[axis] <= part.upper[axis])
        whole = frame.bound(box, tiles)
        some = np.zeros((frame.tile_count, frame.side, frame.side), bool)
        some[:, ::3] = True
        (inner,) = frame.bound_parts([box], tiles, whole.context, True, some)
        for at in (values, *box.sample(6, random), *box.corners()):
            if not given.box.contains(unsheared(frame, at)):
                # no pose of the set
                continue
            picture = frame.render(at)
            assert (picture <= whole.upper).all() and (picture <= inner.upper).all()
        assert (inner.upper[~some] == 1.0).all()
        if parts >= 1024:
            assert float(whole.upper.max()) < 0.9


def swapping(change: float) -> tuple[DifferenceFrame, float]:
    """Three wide blobs of two of which the nearer one changes at one yaw, and that yaw; B has other colours."""
    scene = blob_scene(3)
    means = np.array([[0.0, 0.2, 0.0], [0.0, -0.2, 0.0], [-0.5, 0.0, 0.0]], np.float32)
    scene = replace(
        scene, means=means, log_scales=np.full((3, 3), -1.0, np.float32), opacity_logits=np.full(3, 2.0, np.float32)
    )
    other = replace(scene, sh=(scene.sh + np.float32(change)).astype(np.float32))
    look = np.eye(4)
    # from +x towards the origin: the blobs' depths are equal where the camera looks along x
    look[:3, :3] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    look[0, 3] = 3.0
    camera = nsa.Camera(look, 30.0, 16, 16)
    poses = PoseBox.around(camera, parse_perturbation({"version": 1, "rotation": {"yaw": 0.02}}, field_prefix=""), None)
    first, second = (SplatMethod(s, None, "float32").frame(poses) for s in (scene, other))
    return DifferenceFrame(first, second), 0.0


@pytest.mark.parametrize("change", [0.0, 0.03, -0.03])
def test_one_order_holds_every_render(change: float) -> None:
    whole, at = swapping(change)
    low, high = (whole.render(np.array([at + yaw])) for yaw in (-1e-5, 1e-5))
    first = whole.first
    jump = np.abs(first.render(np.array([at - 1e-5])) - first.render(np.array([at + 1e-5]))).max()
    assert jump > 0.1, "nothing changes places"
    random, tiles = np.random.default_rng(2), np.arange(whole.tile_count)
    for width in (1e-3, 1e-5, 1e-7):
        for middle in (at, at + 0.4 * width, 0.013):
            box = whole.box.replace(0, middle - width, middle + width)
            separate = whole.bound(box, tiles)
            some = separate.upper.max(axis=-1) > 0.02
            # few enough pixels to be looked at
            some &= np.cumsum(some.ravel()).reshape(some.shape) <= 60
            pixels = some if some.any() else None
            (found,) = whole.above(0.02).bound_parts([box], tiles, separate.context, True, pixels)
            for values in (*box.sample(12, random), *box.corners(), box.middle):
                assert (whole.render(values) <= found.upper).all()
            if middle == at and width < 1e-4:
                assert separate.upper[some].max() > 0.1 > max(low.max(), high.max()) + 0.03 > found.upper[some].max()


def test_orders_keep_what_is_certain() -> None:
    slope = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    delta = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 1.05], [0.0, 0.0, 1.08], [0.0, 0.0, 2.0]])
    open_pairs = uncertain(delta, np.zeros(4), slope)
    assert open_pairs.tolist() == [
        [False, True, False, False], [True, False, True, False], [False, True, False, False], [False] * 4
    ]  # fmt: skip
    assert list(groups(open_pairs)) == [(0, 3), (3, 4)]
    ends = np.zeros((4, 4), bool)
    ends[0, 2] = ends[2, 0] = True
    assert list(groups(ends)) == [(0, 3), (3, 4)]
    # the first and the third keep their order wherever the second goes
    orders = {tuple(order) for order in extensions(open_pairs[:3, :3], 0)}
    assert orders == {(0, 1, 2), (1, 0, 2), (0, 2, 1)}
    # an error of the depths, or a turn over the cell, makes the others uncertain
    assert uncertain(delta, np.full(4, 0.05), slope)[0, 2]
    turned = slope.copy()
    turned[1, 2] = 1.0
    assert uncertain(delta, np.zeros(4), turned)[0, 3]


def test_gaussians_are_matched_in_order() -> None:
    means = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0], [2, 0, 0]])
    assert matched(means, means.copy()).tolist() == [0, 1, 2, 3]  # type: ignore[union-attr]
    assert matched(means, means[[1, 2, 3]]).tolist() == [1, 2, 3]  # type: ignore[union-attr]
    # another order: what is drawn first of equal depths may differ
    assert matched(means, means[[3, 1]]).tolist() == [3, 5]  # type: ignore[union-attr]
    assert matched(means, means + 5.0) is None


def test_what_is_no_number_is_no_bound() -> None:
    frame = parabolas(change=0.01, broken=True)
    assert np.isnan(frame.bound(frame.box, np.arange(4)).upper[0, 0, 0]).all()
    found = LargestDifference(frame, frame, 0, RefinementGoal(1.05, 60.0, 40)).run()
    # nothing is known of that pixel
    assert (found.upper[0, 0, 0] == 1.0).all() and found.upper[0, 0, 1].max() < 0.1


def check_passes(whole: DifferenceFrame, goal: RefinementGoal, tuning: LargestTuning = TUNING) -> PartResult:
    """All passes over a frame: bounds hold renders, and what is told as rendered was rendered."""
    found = LargestDifference(whole, whole, 0, goal, tuning=tuning).run()
    assert found.bounded and found.largest is not None
    assert (found.witness_upper <= found.upper).all() and (found.lower == 0.0).all()
    inside = whole._inside
    for values in whole.box.sample(40, np.random.default_rng(5)):
        assert (whole.render(values) <= found.upper)[inside].all()
    assert (found.upper[~inside] == 0.0).all()
    assert whole.render(np.array(found.largest.pose)).max() == np.float32(found.largest.value)
    assert found.largest.value == found.witness_upper.max()
    return found


@pytest.mark.parametrize("change", [0.02, 0.1])
def test_floors_leave_nothing_out(change: float) -> None:
    found = check_passes(parabolas(change=change), RefinementGoal(1.05, 60.0, 200))
    assert found.upper.max() <= 1.051 * found.largest.value
    # a floor is never taken for something rendered
    assert (found.witness_upper < found.largest.value).mean() > 0.5


def test_a_tolerance_is_not_rounded_up() -> None:
    """Bounds come down to it though its float32 is larger, and though they are near enough to renders before."""
    most = check_passes(parabolas(change=0.1), RefinementGoal(1.05, 60.0, 400)).largest
    assert most is not None
    tolerance = float(np.nextafter(np.float64(np.float32(1.03 * most.value)), 0.0))
    assert float(np.float32(tolerance)) > tolerance
    whole = parabolas(change=0.1)
    found = LargestDifference(whole, whole, 0, RefinementGoal(3.0, 60.0, 4000), tolerance=tolerance).run()
    assert most.value < float(found.upper.max()) <= tolerance


def test_a_pass_ends_where_narrower_cells_gain_nothing() -> None:
    whole = parabolas(change=0.1, unsure=0.9)
    found = check_passes(whole, RefinementGoal(1.05, 600.0, 4000), LargestTuning(patience=(2.0, 30)))
    assert found.largest is not None
    # one pixel stays open however narrow cells are; the others are as tight as without it
    most = np.sort(found.upper.max(axis=-1).ravel())
    assert most[-1] > 0.5 and most[-2] <= 1.051 * found.largest.value
    # the last pass, which has no floor, has all of its cells; those before it give up soon
    assert found.cells < 4000 + 300


def test_what_gains_goes_on() -> None:
    watch = GainWatch(LargestTuning(gain=0.01, patience=(2.0, 10)))
    left_open = 1.0
    for cells in range(0, 100, 5):
        left_open *= 0.98
        watch.look(cells, left_open)
        assert not watch.idle
    for cells in range(100, 201, 5):
        watch.look(cells, 0.995 * left_open)
        assert not watch.idle
    watch.look(205, 0.995 * left_open)
    assert watch.idle


@pytest.mark.slow
@pytest.mark.parametrize("change", ["rounded", "same"])
def test_floors_of_splats(change: str) -> None:
    whole, _ = difference(change, SHIFT)
    found = check_passes(whole, RefinementGoal(1.2, 60.0, 150))
    most = found.upper.max()
    assert most < 0.05 if change == "same" else most <= 1.5 * found.largest.value


def test_sheared_sets_and_groups_of_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ns_abstract.api.poses.checked_scene", lambda opened: opened)
    scene, given = blob_scene(count=20), ring()[1]
    first, second = (_opened(s) for s in (scene, rounded(scene)))
    camera = nsa.Camera(given.camera_to_world, given.fov, given.width, given.height)
    poses = nsa.PoseSet.from_json(camera, SHEARED).of(first)
    job = ComparisonJob(first, second, [poses])
    goal = RefinementGoal(1.5, 60.0, 30)
    tiles = np.arange(job.frame(0).tile_count)
    parts = [job.bound_part(0, goal, some) for some in np.array_split(tiles, 2)]
    found = job.joined(parts)
    assert found.box == poses.box and found.largest is not None
    a, b = job.pictures(0, found.largest.pose)
    assert np.isclose(np.abs(a.astype(float) - b).max(), found.largest.value, atol=1e-7)
    for values in poses.box.sample(30, np.random.default_rng(1)):
        assert (assemble(job.frame(0).render(values), poses.camera) <= found.upper).all()


def test_results_name_both_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ns_abstract.api.poses.checked_scene", lambda opened: opened)
    given = ring()[1]
    camera = nsa.Camera(given.camera_to_world, given.fov, given.width, given.height)
    first, second = (_opened(s) for s in (blob_scene(count=5), rounded(blob_scene(count=5))))
    poses = nsa.PoseSet(camera, translation={"x": 0.01}).of(first)
    prints = [ComparisonJob(first, other, [poses]).fingerprint for other in (first, second)]
    assert prints[0] != prints[1] and prints[0] != Job(first, [poses]).fingerprint


def _opened(scene: SplatScene) -> Any:
    """A scene without a file."""
    method = SplatMethod(scene, None, "float32")
    source = SimpleNamespace(
        file=Path("blobs.ply"), options=SimpleNamespace(renderer=None, gsplat_version=None, sampling=None)
    )
    return SimpleNamespace(
        source=source, rays=False, method=lambda *_: method, run_frame=None, assumptions=(), name="blobs"
    )


def test_verdicts() -> None:
    def result(upper: float, rendered: float, bounded: bool = True) -> Any:
        return SimpleNamespace(
            upper=np.full((1, 1, 3), upper), largest=SimpleNamespace(value=rendered), bounded=bounded
        )

    assert verdict(result(0.03, 0.02), 0.03, "float32-sound") == "certified"
    assert verdict(result(0.04, 0.02), 0.03, "float32-sound") == "unknown"
    assert verdict(result(0.04, 0.03), 0.03, "float32-sound") == "unknown"
    assert verdict(result(0.04, 0.031), 0.03, "float32-sound") == "falsified"
    assert verdict(result(0.03, 0.02), 0.03, "sampled") == "unknown"
    assert verdict(result(np.nan, 0.02), 0.03, "float32-sound") == "unknown"
    assert verdict(result(0.01, 0.01, bounded=False), 0.03, "float32-sound") == "unknown"
    assert overall(["certified", "falsified"], False) == "falsified"
    assert overall(["certified"], False) == overall([], True) == overall(["certified", "unknown"], True) == "unknown"
    assert overall(["certified", "certified"], True) == "certified"


def test_last_digits_of_renders_break_no_tolerance() -> None:
    """Two versions that draw the same picture but for its last digits in float64; a difference of 1e-9 is one."""
    scene, given = blob_scene(), ring()[0]
    camera = nsa.Camera(given.camera_to_world, given.fov, given.width, given.height)
    poses = PoseBox.around(camera, parse_perturbation({"rotation": {"yaw": 0.1}}, field_prefix=""), None)
    first, second = (SplatMethod(scene, None, "float32", version) for version in ("1.4.0", "1.6.0"))
    frame = DifferenceFrame(first.frame(poses), second.frame(poses))
    rendered = [f.precise(frame.box.middle) for f in (first.frame(poses), second.frame(poses))]
    assert 0.0 < np.abs(rendered[0] - rendered[1]).max() < 1e-13
    assert frame.render(frame.box.middle).max() == 0.0 and frame.largest is not None and frame.largest.value == 0.0
    moved = SplatMethod(replace(scene, sh=scene.sh + np.float32(1e-7)), None, "float32")
    assert DifferenceFrame(first.frame(poses), moved.frame(poses)).render(frame.box.middle).max() > 1e-9


# ---------------------------------------------------------------- the command


def write(folder: Path, scene: SplatScene, name: str) -> Path:
    return write_splatfacto_run(scene, folder, timestamp="2026-01-01_120000", experiment_name=name)


@pytest.mark.slow
def test_a_run_and_its_changed_version(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    other, out = write(tmp_path / "other", rounded(blob_scene()), "rounded"), tmp_path / "out"
    options = blobs.options(out, other=other, time_budget=8, target_ratio=1.3, frames=[0])
    code, _, said = in_process(main, options)
    assert code == 0, said
    document = json.loads((out / "report.json").read_text())
    (entry,) = document["frames"]
    assert document["kind"] == "comparison" and "verdict" not in document
    assert entry["largest_lower"] <= entry["largest_upper"] and entry["mean_lower"] <= entry["mean_upper"]
    with np.load(out / "frame_00000.npz", allow_pickle=False) as stored:
        upper, lower = stored["difference_upper"], stored["difference_lower"]
    assert upper.dtype == lower.dtype == np.float32 and upper.shape == (32, 32, 3)
    assert float(upper.max()) == entry["largest_upper"] and float(lower.max()) == entry["largest_lower"]
    # another command goes on from there, and asks about a tolerance that one pose exceeds
    again = [*options, "--resume", "--tolerance", str(0.5 * entry["worst"]["difference"])]
    code, _, said = in_process(main, again)
    assert code == 0 and "falsified" in said, said
    after = json.loads((out / "report.json").read_text())
    assert after["verdict"] == after["frames"][0]["verdict"] == "falsified"
    assert after["frames"][0]["largest_upper"] <= entry["largest_upper"]
    page = (out / "report.html").read_text()
    assert "Some picture differs by more" in page and "Worst pose found" in page
    first, second = nsa.load_scene(blobs.config), nsa.load_scene(other)
    path = nsa.load_camera_path(blobs.path)
    pose = entry["worst"]["pose"]
    job = ComparisonJob(first, second, [nsa.PoseSet.from_json(path.cameras[0], SHIFT).of(first)])
    a, b = (picture.astype(np.float64) for picture in job.pictures(0, pose))
    assert np.abs(a - b).max() == pytest.approx(entry["worst"]["difference"], abs=1e-7)


@pytest.mark.slow
def test_a_run_and_its_export(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    scene = blob_scene()
    other = tmp_path / "blobs.ply"
    write_ply(scene, other)
    # a .ply has no background; the tolerance is wide: one cover decides
    options = blobs.options(
        tmp_path / "out", other=other, background=[0.1, 0.2, 0.3], tolerance=0.3, frames=[1], time_budget=20
    )
    code, _, said = in_process(main, options)
    assert code == 0 and "certified: tolerance 0.3" in said and "states none" in said, said
    document = json.loads((tmp_path / "out" / "report.json").read_text())
    assert document["verdict"] == "certified" and document["largest_lower"] <= 1e-6
    # behind A is another colour than black, and so behind B
    alone = blobs.options(tmp_path / "alone", other=other, tolerance=0.3, frames=[1], time_budget=20)
    code, _, said = in_process(main, alone)
    document = json.loads((tmp_path / "alone" / "report.json").read_text())
    behind = {entry["name"]: entry for entry in document["assumptions"]}
    assert behind["other background"]["value"] == behind["background"]["value"]
    assert "A's, the file of B states none" in behind["other background"]["origin"] and "background: " in said
    assert code == 0 and document["largest_lower"] <= 1e-6, said
    # behind B is another colour now
    code, _, said = in_process(main, [*options, "--other-background", "0.9", "0.9", "0.9"])
    assert code == 0 and "falsified" in said, said


def lighter(scene: SplatScene, by: float) -> SplatScene:
    """The scene with more light in every band of degree 0."""
    bands = np.where(np.arange(scene.sh.shape[1]) == 0, np.float32(by), np.float32(0.0))
    return replace(scene, sh=scene.sh + bands[:, None])


@pytest.mark.slow
def test_another_question_is_worked_on_when_it_is_resumed(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    """What is tight enough for a tolerance need not be for a ratio, and the other way round."""
    other = write(tmp_path / "other", lighter(blob_scene(), 0.5), "lighter")
    options = blobs.options(tmp_path / "out", other=other, time_budget=5, target_ratio=1, frames=[0])
    again = [["--resume"], ["--resume", "--tolerance", "0.9"]]
    for more, worked in zip([["--tolerance", "0.9"], *again], (True, True, False), strict=True):
        code, _, said = in_process(main, [*options, *more])
        assert code == 0 and ("frame 0: largest" in said) == worked, said


@pytest.mark.slow
def test_a_tolerance_is_decided_whatever_its_float32_is(tmp_path: Path) -> None:
    """Bounds are brought below it, also where they are near enough to renders, and its float32 is above it."""
    plain, given, tolerance = blob_scene(), ring()[0], 0.016
    scenes = {"a": plain, "b": lighter(plain, 0.05)}
    first, second = (nsa.load_scene(write(tmp_path / name, scene, name)) for name, scene in scenes.items())
    poses = nsa.PoseSet(nsa.Camera(given.camera_to_world, given.fov, 8, 8), translation={"x": 0.02})
    assert float(np.float32(tolerance)) > tolerance
    found = nsa.compare(first, second, poses, tolerance=tolerance, target_ratio=3.0, time_budget=60.0)
    assert found.verdict == "certified" and 0.01 < found.largest_lower <= found.largest_upper <= tolerance


def test_the_python_function(tmp_path: Path) -> None:
    scene = nsa.load_scene(write(tmp_path, blob_scene(count=10), "blobs"))
    given = ring()[0]
    camera = nsa.Camera(given.camera_to_world, given.fov, 16, 16)
    found = nsa.compare(scene, scene, nsa.PoseSet(camera, translation={"x": 0.01}), tolerance=0.2, time_budget=10.0)
    assert found.verdict == "certified" and found.worst_difference == 0.0 and found.bounded
    assert found.difference_upper.shape == (16, 16, 3) and found.guarantee == "float32-sound"
    with pytest.raises(nsa.InputError, match="tolerance"):
        nsa.compare(scene, scene, nsa.PoseSet(camera), tolerance=float("nan"))


def _moved(folder: Path) -> dict[str, Any]:
    frame = DataparserTransform(np.array([[1.0, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0]]), 1.0)
    return {"other": write(folder, replace(blob_scene(), dataparser=frame), "moved")}


def _scaled(folder: Path) -> dict[str, Any]:
    return {"other": write(folder, replace(blob_scene(), dataparser=DataparserTransform(scale=2.0)), "scaled")}


def _turned(folder: Path) -> dict[str, Any]:
    """Two runs of a data set far from its origin, which stand alike but for a turn of a degree."""
    runs = []
    for name, angle in (("far", 0.0), ("far-turned", np.radians(1.0))):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        frame = DataparserTransform(np.column_stack([turn, [4.5e6, 3e5, 100.0]]), 0.01)
        runs.append(write(folder, replace(blob_scene(), dataparser=frame), name))
    return {"load_config": runs[0], "other": runs[1]}


def _varied(folder: Path) -> dict[str, Any]:
    spec = folder / "varied.json"
    spec.write_text(json.dumps({**SHIFT, "scene": [{"select": {"opacity": [0, 1]}, "opacity": 0.1}]}))
    return {"perturbation_filename": spec}


@pytest.mark.parametrize(
    ("change", "mentions"),
    [
        (_moved, ["dataparser_transforms.json", "--other"]),
        (_scaled, ["dataparser_transforms.json", "--other"]),
        (_turned, ["dataparser_transforms.json", "--other"]),
        (_varied, ["scene", "remove the key"]),
        (lambda folder: {"other": nerf_run(folder)}, ["NeRF", "--other"]),
        (lambda folder: {"other": folder / "absent.ply"}, ["absent.ply"]),
        (lambda folder: {"tolerance": 1.5}, ["--tolerance"]),
        (lambda folder: {"tolerance": "nan"}, ["--tolerance"]),
        (lambda folder: {"target_ratio": 0.9}, ["--target-ratio"]),
        (lambda folder: {"time_budget": 0}, ["--time-budget"]),
        (lambda folder: {"other_background": [0, 0, 2]}, ["--other-background"]),
    ],
)
def test_mistakes_are_one_line(
    change: Callable[[Path], dict[str, Any]], mentions: list[str], blobs: Inputs, tmp_path: Path, in_process: InProcess
) -> None:
    options = blobs.options(tmp_path / "out", **({"other": blobs.config} | change(tmp_path)))
    code, _, said = in_process(main, options)
    assert code == 2 and said.count("\n") == 1 and all(word in said for word in mentions), said
    assert not (tmp_path / "out").exists()


def test_a_run_that_lost_its_frame_is_taken_to_be_in_the_others(tmp_path: Path) -> None:
    """And the report says that nothing compared them."""
    scene = blob_scene(count=10)
    runs = [write(tmp_path, scene, name) for name in "ab"]
    frame = PoseBox.around(ring()[0], parse_perturbation(SHIFT))
    origins = []
    for lost in (False, True):
        if lost:
            (runs[1].parent / "dataparser_transforms.json").unlink()
        job = ComparisonJob(*map(nsa.load_scene, runs), [frame])
        origins.append(job.frame_choice.origin)
    assert origins == ["equal dataparser_transforms.json", "default: the file of B states none"]


@pytest.mark.slow
def test_two_nerfs(tmp_path: Path, in_process: InProcess) -> None:
    run = nerf_run(tmp_path)
    options = [
        "--load-config",
        run,
        "--other",
        run,
        "--camera-path-filename",
        path_of(tmp_path),
        "--translation",
        "0.001",
    ]
    more = ["--num-samples", "4", "--output-dir", tmp_path / "out", "--workers", "1", "--time-budget", "3"]
    code, _, said = in_process(main, list(map(str, [*options, *more])))
    document = json.loads((tmp_path / "out" / "report.json").read_text())
    assert code == 0 and document["largest_lower"] == 0.0, said


@pytest.mark.slow
@pytest.mark.parametrize("behind", ["last_sample", "black"])
def test_two_nerfactos(behind: str, tmp_path: Path, in_process: InProcess) -> None:
    """Their runs always say what is behind them; A's background is not taken for B's."""
    scene, runs = tiny_nerfacto(), []
    for name in "ab":
        field = replace(scene.field, background=behind if behind == "last_sample" else np.zeros(3))
        runs.append(write_nerfacto_run(replace(scene, field=field), tmp_path, timestamp="t", experiment_name=name))
    options = ["--load-config", runs[0], "--other", runs[1], "--camera-path-filename", path_of(tmp_path)]
    more = ["--downscale-factor", "4", "--output-dir", tmp_path / "out", "--workers", "1", "--time-budget", "3"]
    code, _, said = in_process(main, list(map(str, [*options, *more])))
    assert code == 0, said
    document = json.loads((tmp_path / "out" / "report.json").read_text())
    assert document["largest_lower"] == 0.0 and not any("A's" in entry["origin"] for entry in document["assumptions"])
