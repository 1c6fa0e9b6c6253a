"""Abstract images in the background: sound, remembered, never in the way, and alive whatever happens to a worker."""

from __future__ import annotations

import dataclasses
import itertools
import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Inputs, blob_scene, ring
from nerfs import tiny_scene
from nerfs import view as nerf_camera
from test_cli import call, one_line  # noqa: F401
from waiting import until

from ns_abstract.cli import viewer as viewer_command
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame, TileBounds
from ns_abstract.perturbation.specification import Perturbation, parse_perturbation, perturbation_object
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.viewer.background import Background
from ns_abstract.viewer.views import NerfSource, Snapshot, Source, SplatSource, ViewRequest, perturbation_of

Call = Callable[..., tuple[int, str]]


def camera(width: int = 96, height: int = 80, k: int = 0) -> PinholeCamera:
    pose = ring()[k].camera_to_world[:3]
    focal = 0.5 * height / np.tan(np.radians(22.5))
    return PinholeCamera(pose, focal, focal, 0.5 * width, 0.5 * height, width, height)


def view(x: float = 0.01, k: int = 0, **size: int) -> ViewRequest:
    return ViewRequest(camera(k=k, **size), perturbation_of({"x": x}))


@dataclass(frozen=True, eq=False)
class Odd(SplatSource):
    """Does odd things for sets that vary y, or all its life."""

    odd: str = ""

    def frame(self, camera: PinholeCamera, perturbation: Perturbation) -> SplatFrame:
        frame = super().frame(camera, perturbation)
        if "y" not in perturbation.translation:
            return frame
        if self.odd == "dies":
            os._exit(9)
        if self.odd == "hangs":
            signal.pause()
        if self.odd == "fails":
            raise ValueError("no such frame")
        return Unsound(frame) if self.odd == "unsound" else frame


class Unsound(SplatFrame):
    """A frame whose upper bounds are too low."""

    def __init__(self, frame: SplatFrame) -> None:
        vars(self).update(vars(frame))

    def bound(self, *arguments: Any, **options: Any) -> TileBounds:
        found = super().bound(*arguments, **options)
        return dataclasses.replace(found, upper=np.maximum(found.lower, found.upper - np.float32(0.05)))


def source(odd: str = "") -> SplatSource:
    scene = blob_scene()
    splats = activate(scene, GSPLAT_1_4_0)
    return Odd(splats, scene, odd=odd) if odd else SplatSource(splats, scene)


@pytest.fixture
def background(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Background]]:
    """Makes a background that shows a source and is closed in the end."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))
    made: list[Background] = []

    def make(odd: str = "", scene: Source | None = None, **options: Any) -> Background:
        found = Background(**options)
        made.append(found)
        found.show(source(odd) if scene is None else scene)
        return found

    yield make
    for one in made:
        one.close()


def answer(
    background: Background, view: ViewRequest, seconds: float = 1.0, size: tuple[int, int] | None = None
) -> Snapshot:
    """The last snapshot of the work on ``view``."""

    def look() -> Snapshot | None:
        found = background.best(view, seconds)
        state = background.status
        assert state.state != "failed", state.detail
        return found if state.state == "idle" else None

    return until(look, "an abstract image")


def violations(snapshot: Snapshot, view: ViewRequest, count: int = 30) -> int:
    """Values of real renders outside the bounds, at the snapshot's size, without tolerance."""
    at = view.camera.rescaled(view.side / max(snapshot.size))
    frame = source().frame(at, view.perturbation)
    box = frame.box
    values = [box.middle, *box.corners(), *box.sample(count, np.random.default_rng(3))]
    pictures = [frame.renderer.image(at, *frame.pose_set.world_to_camera(v)) for v in values]
    return sum(int(((p < snapshot.lower) | (p > snapshot.upper)).sum()) for p in pictures)


@pytest.mark.slow
def test_pictures_grow_and_hold(background: Callable[..., Background]) -> None:
    one, asked = background(), view(width=160, height=120)
    seen: dict[tuple[int, int], Snapshot] = {}

    def look() -> bool:
        found = one.best(asked, 1.0)
        if found is not None:
            seen[found.size] = found
        return one.status.state == "idle"

    until(look, "the last picture")
    sizes = list(seen)
    assert sizes[-1] == (120, 160)
    assert sizes == sorted(sizes)
    assert seen[sizes[-1]].final
    for snapshot in seen.values():
        assert snapshot.guarantee == "float32-sound"
        assert violations(snapshot, asked) == 0
        # the check can fail: a bound that is a little too low is noticed
        low = dataclasses.replace(snapshot, upper=snapshot.upper - np.float32(0.02))
        assert violations(low, asked) > 0


@pytest.mark.slow
def test_two_who_look_both_get_their_bounds(background: Callable[..., Background]) -> None:
    """Each asks again whenever there is news, as browsers do; work on one must not end that on the other."""
    one, views = background(), [view(x=0.01), view(x=0.02)]
    found: dict[int, Snapshot | None] = {}

    def look() -> bool:
        for k, asked in enumerate(views):
            found[k] = one.best(asked, 1.0)
        return (
            all(snapshot is not None and snapshot.final for snapshot in found.values()) and one.status.state == "idle"
        )

    until(look, "both pictures")
    for k, asked in enumerate(views):
        snapshot = found[k]
        assert snapshot is not None and snapshot.size == (asked.camera.height, asked.camera.width)
        assert violations(snapshot, asked) == 0


@pytest.mark.slow
def test_who_comes_back_to_a_view_need_not_wait_for_the_one_left(background: Callable[..., Background]) -> None:
    one, wide = background(), ViewRequest(camera(), perturbation_of({"x": 0.05, "y": 0.05}))
    one.best(view(), 1.0)
    one.best(wide, 3600.0)
    until(lambda: (found := one.best(view(), 1.0)) is not None and found.final, "the view that was left")


@pytest.mark.slow
def test_a_view_is_remembered(background: Callable[..., Background]) -> None:
    one = background()
    first = answer(one, view())
    answer(one, view(x=0.02))
    asked = one._wanted
    assert one.best(view(), 1.0) is first
    assert one._wanted is asked
    # another size of the same view starts from what is known
    assert one.best(view(width=120, height=100), 1.0) is first
    # another shape is another picture
    assert one.best(view(width=96, height=96), 1.0) is None
    # and so is another scene
    one.show(source())
    assert one.best(view(), 1.0) is None


@pytest.mark.slow
def test_more_goes_on_with_the_last_view(background: Callable[..., Background]) -> None:
    # the goal takes hundreds of cells: no machine gets there in the first time
    one, wide = background(), ViewRequest(camera(), perturbation_of({"x": 0.05, "y": 0.05}))
    first = answer(one, wide, 0.01)
    one.more(2.0)
    second = answer(one, wide, 0.01)
    assert second.cells > first.cells and second.size == first.size
    assert (second.lower >= first.lower).all() and (second.upper <= first.upper).all()
    assert (second.upper - second.lower).sum() < (first.upper - first.lower).sum()
    assert violations(second, wide) == 0


def odd_view() -> ViewRequest:
    return ViewRequest(camera(), perturbation_of({"y": 0.01}))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("odd", "said"),
    [("dies", "ended with code 9"), ("fails", "no such frame"), ("unsound", "not sound")],
)
def test_trouble_is_told_and_over(background: Callable[..., Background], odd: str, said: str) -> None:
    one = background(odd)
    until(lambda: one.best(odd_view(), 1.0) or one.status.state == "failed", "the failure")
    assert said in one.status.detail
    # nothing is shown, and it is not tried again and again
    asked = one._wanted
    assert one.best(odd_view(), 1.0) is None
    assert one._wanted is asked
    assert violations(answer(one, view()), view()) == 0


@pytest.mark.slow
def test_a_worker_that_is_stuck_is_replaced(background: Callable[..., Background]) -> None:
    one = background("hangs")
    until(lambda: [w.scene for w in one._workers] == [0, 0], "two workers")
    stuck = one._workers[0]
    assert one.best(odd_view(), 1.0) is None
    until(lambda: stuck.busy is not None, "the hanging work")
    assert violations(answer(one, view()), view()) == 0
    assert stuck not in one._workers
    assert stuck.process.wait(30) != 0


@pytest.mark.slow
def test_asking_never_waits(background: Callable[..., Background]) -> None:
    one = background("hangs")
    until(lambda: [w.scene for w in one._workers] == [0, 0], "two workers")
    stuck = one._workers[0]
    one.best(odd_view(), 1.0)
    until(lambda: stuck.busy is not None, "the hanging work")
    # who waited for the worker would never come to the end of this line
    assert [one.best(view(x=0.001 * (k + 1)), 1.0) for k in range(100)] == [None] * 100
    assert answer(one, view(x=0.1)).final


@pytest.mark.slow
def test_who_looks_may_be_gone(background: Callable[..., Background], capfd: pytest.CaptureFixture[str]) -> None:
    def gone() -> None:
        raise KeyError("client")

    one = background(changed=gone)
    assert answer(one, view()).final
    assert "the viewer was not told of new bounds: KeyError" in capfd.readouterr().err


@pytest.mark.slow
def test_close_ends_the_workers(background: Callable[..., Background]) -> None:
    one = background()
    processes = [worker.process for worker in one._workers]
    assert len(processes) == 2
    one.close()
    assert [p.wait(30) for p in processes] == [-9, -9]
    assert one.best(view(), 1.0) is None and one.status.state == "off"


def test_nothing_to_show() -> None:
    one = Background()
    assert one.best(view(), 1.0) is None and one.status.state == "off"
    one.more(1.0)
    one.close()


def test_key_and_shape() -> None:
    assert view().key == view(width=48, height=40).key
    for other in (view(x=0.02), view(k=1), ViewRequest(camera(), perturbation_of({"yaw": 0.01}))):
        assert other.key != view().key
    for other in ({"fx": 31.0}, {"cx": 3.0}, {"cy": 30.0}):
        assert replace(view(), camera=replace(camera(), **other)).key != replace(view(), camera=camera()).key
    assert view().fits(40, 48) and view().fits(41, 48) and not view().fits(48, 48)
    assert perturbation_of({"x": 0.0, "roll": 0.1}) == Perturbation(rotation={"roll": (-0.1, 0.1)})
    stages = view(width=300, height=150).stages(9.0, known=64)
    assert [(c.width, c.height) for c, _ in stages] == [(128, 64), (256, 128), (300, 150)]
    assert stages[-1][1] == 9.0


def test_refinement_can_be_looked_at_and_continued() -> None:
    found: list[tuple[int, Snapshot]] = []
    frame = source().frame(camera(), perturbation_of({"x": 0.05}))
    # how many cells are first is a matter of what one takes, without compiling
    frame.warm_up()
    refinement = Refinement(frame, 0, RefinementGoal(1.0, 60.0, cells=9))

    def look(point: Any, share: float) -> None:
        if refinement.covered:
            found.append((point.cells, Snapshot.of(refinement.snapshot(), final=False, guarantee="float32-sound")))

    refinement.progress = look
    first = refinement.run()
    assert first.cells <= 9 and len(found) > 1
    spent = first.seconds
    second = refinement.proceed(RefinementGoal(1.0, spent + 60.0, cells=30))
    assert second.cells > first.cells and second.seconds > spent
    assert (second.lower >= first.lower).all() and (second.upper <= first.upper).all()
    whole = Refinement(
        source().frame(camera(), perturbation_of({"x": 0.05})), 0, RefinementGoal(1.0, 60.0, cells=9)
    ).run()
    np.testing.assert_array_equal(whole.lower, first.lower)
    for _, snapshot in found:
        assert violations(snapshot, view(x=0.05)) == 0


# ---------------------------------------------------------------- variations of the scene

#: About a third of the Gaussians of `blob_scene`.
SELECT = '{"box": [[-9, -9, -9], [0, 9, 9]], "opacity": [0.2, 1]}'


def varied_view(select: str = SELECT, **radii: float) -> ViewRequest:
    return ViewRequest(camera(), perturbation_of(radii, select))


def outside(snapshot: Snapshot, view: ViewRequest, count: int = 24) -> int:
    """Values of pictures of scene samples of ``view``'s set outside the bounds."""
    at = view.camera.rescaled(view.side / max(snapshot.size))
    frame = source().frame(at, view.perturbation)
    rng, found = np.random.default_rng(5), 0
    for scene_sample in itertools.islice(frame.varied.scene_samples(rng), count):
        values = frame.box.middle if frame.box.dimensions == 0 else frame.box.sample(1, rng)[0]
        picture = frame.renderer.image(at, *frame.pose_set.world_to_camera(values), scene_sample)
        found += int(((picture < snapshot.lower) | (picture > snapshot.upper)).sum())
    return found


@pytest.mark.slow
@pytest.mark.parametrize("quantity", ["mean", "opacity", "color"])
def test_a_variation_slider_widens_the_abstract_image(background: Callable[..., Background], quantity: str) -> None:
    one = background()
    narrow, wide = (varied_view(**{quantity: radius}) for radius in (0.01, 0.04))
    still = answer(one, ViewRequest(camera(), perturbation_of({})))
    first, second = answer(one, narrow), answer(one, wide)
    assert outside(first, narrow) == outside(second, wide) == 0
    # what is asked for is what is bounded: the wider set leaves the narrower one's bounds, and the smaller gap's
    assert outside(first, wide) > 0 and outside(still, narrow) > 0
    gaps = [float((s.upper - s.lower).mean()) for s in (still, first, second)]
    assert gaps[0] < gaps[1] < gaps[2]
    assert all(s.figures["mpg_witness"] > 0.0 for s in (first, second))  # type: ignore[operator]
    # and the other way: the slider back at 0 is the picture of before
    assert one.best(ViewRequest(camera(), perturbation_of({quantity: 0.0})), 1.0) is still


@pytest.mark.slow
def test_variations_and_poses_together(background: Callable[..., Background]) -> None:
    asked = varied_view(x=0.005, color=0.02, mean=0.002)
    found = answer(background(), asked, 2.0)
    assert outside(found, asked) == 0
    assert outside(found, varied_view(x=0.005, color=0.1)) > 0


def test_sets_of_the_sliders_are_read_back() -> None:
    every = perturbation_of(dict.fromkeys(("x", "yaw", "mean", "opacity", "color"), 0.25), SELECT)
    assert parse_perturbation(perturbation_object(every)) == every
    assert every.scene[0].mean == (-0.25, 0.25) and every.scene[0].select.opacity == (0.2, 1.0)
    rules = {
        "select": {"color": {"max": [0.5, 1.0, 1.0]}, "indices": [3, 1]},
        "opacity": [-0.1, 0.3],
    }
    spec = {
        "version": 1, "frame": "world", "sweep": "segments", "translation": {"y": [0, 0.5]},
        "orbit": {"target": [0, 0, 1], "axis": [0, 1, 0], "azimuth": [0, 1]},
        "scene": [rules, {"select": {}, "mean": 1}],
    }  # fmt: skip
    given = parse_perturbation(spec)
    assert parse_perturbation(perturbation_object(given)) == given
    # the views of different sets of scenes are different views
    keys = {varied_view(**r).key for r in ({"mean": 0.1}, {"opacity": 0.1}, {"mean": 0.2})}
    assert len(keys | {varied_view("{}", mean=0.1).key}) == 4


@pytest.mark.parametrize("text", ["{", "[]", '{"sphere": 1}', '{"box": [[0, 0, 0]]}', '{"opacity": [NaN, 1]}'])
def test_selections_that_cannot_be_read(text: str) -> None:
    with pytest.raises(InputError, match="select"):
        perturbation_of({"mean": 0.1}, text)
    # nobody looks at them where nothing varies
    assert perturbation_of({"x": 0.1, "mean": 0.0}, text) == perturbation_of({"x": 0.1})


def test_selections_of_the_panel_read_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some.json").write_text("[3, 1]")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"select\.indices"):
        perturbation_of({"mean": 0.1}, '{"indices": "some.json"}')
    assert perturbation_of({"mean": 0.1}, '{"indices": [3, 1]}').scene[0].select.indices == (1, 3)


@pytest.mark.slow
def test_an_empty_selection_is_told(background: Callable[..., Background]) -> None:
    one = background()
    nothing = varied_view('{"box": [[8, 8, 8], [9, 9, 9]]}', mean=0.1)
    until(lambda: one.best(nothing, 1.0) or one.status.state == "failed", "the failure")
    assert "picks none of 50 Gaussians" in one.status.detail
    assert answer(one, view()).final


# ---------------------------------------------------------------- NeRFs


@pytest.mark.slow
def test_bounds_of_a_nerf_ray_by_ray(background: Callable[..., Background]) -> None:
    scene = NerfSource(tiny_scene(3))
    asked = ViewRequest(nerf_camera(6, 5), perturbation_of({"x": 0.002}))
    # compiled kernels are kept, and time is for rays
    scene.frame(asked.camera, asked.perturbation).warm_up()
    one = background(scene=scene)
    seen: list[Snapshot] = []

    def look() -> bool:
        found = one.best(asked, 300.0)
        if found is not None and (not seen or found is not seen[-1]):
            seen.append(found)
        assert one.status.state != "failed", one.status.detail
        return one.status.state == "idle"

    until(look, "the end of the work")
    assert seen[-1].final and seen[-1].guarantee == "real-sound" and seen[-1].size == (5, 6)
    # rays that were not reached are [0, 1], and fewer and fewer
    assert [s.untreated for s in seen] == sorted((s.untreated for s in seen), reverse=True)
    assert seen[-1].untreated < 15
    frame = scene.frame(asked.camera, asked.perturbation)
    pictures = [
        frame.renderer.image(frame.camera, frame.pose_set.pose(v))
        for v in [*frame.box.corners(), *frame.box.sample(20, np.random.default_rng(0))]
    ]
    for found in seen:
        assert all(((p >= found.lower) & (p <= found.upper)).all() for p in pictures)
    tight = dataclasses.replace(seen[-1], upper=seen[-1].upper - np.float32(0.05))
    assert not all((p <= tight.upper).all() for p in pictures)


def test_nerfs_are_bounded_in_small_pictures() -> None:
    scene = NerfSource(tiny_scene(3))
    shown = ViewRequest(camera(512, 384), perturbation_of({"x": 0.01}))
    small = shown.at_most(scene.most)
    assert (small.camera.width, small.camera.height) == (32, 24)
    assert small.key == shown.key and small.at_most(64) is small and shown.at_most(None) is shown
    assert [c.width for c, _ in small.stages(9.0, 0, scene.ladder)] == [8, 16, 32]
    with pytest.raises(InputError, match="no Gaussians"):
        scene.frame(shown.camera, perturbation_of({"mean": 0.1}))


def test_a_larger_picture_of_which_less_is_known_waits() -> None:
    def snapshot(size: int, untreated: int, *, final: bool) -> Snapshot:
        lower = np.full((size, size, 3), 0.5, np.float32)
        upper = lower.copy()
        lower.reshape(-1, 3)[:untreated], upper.reshape(-1, 3)[:untreated] = 0.0, 1.0
        return Snapshot(lower, upper, lower, upper, {}, 0.0, 1, final, "real-sound")

    one, asked = Background(), ViewRequest(camera(64, 64), perturbation_of({"x": 0.01}))
    steps = ((8, 16, True, 8), (16, 200, False, 8), (16, 50, False, 16), (32, 900, True, 32))
    for size, untreated, final, shown in steps:
        one._store(asked.key, asked, snapshot(size, untreated, final=final))
        assert one._cache[asked.key].size == (shown, shown)


# ---------------------------------------------------------------- the command


@pytest.mark.slow
def test_viewer_needs_nerfstudio(monkeypatch: pytest.MonkeyPatch, blobs: Inputs, call: Call) -> None:  # noqa: F811
    monkeypatch.delitem(sys.modules, "ns_abstract.nerfstudio.viewing", raising=False)
    monkeypatch.setitem(sys.modules, "nerfstudio.configs.base_config", None)
    found = call(["--load-config", str(blobs.config)], viewer_command.main)
    one_line(*found, "nerfstudio", "pip install")


@pytest.mark.slow
def test_viewer_refuses_what_is_no_run(blobs: Inputs, call: Call) -> None:  # noqa: F811
    pytest.importorskip("viser", reason="nerfstudio is not installed (extra nerfstudio)")
    for file in (blobs.config.parent / "none.yml", blobs.path):
        one_line(*call(["--load-config", str(file)], viewer_command.main), file.name)
    one_line(*call([], viewer_command.main), "load-config")
