"""Abstract images in the background: sound, remembered, never in the way, and alive whatever happens to a worker."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import until
from conftest import Inputs, blob_scene, ring
from test_cli import call, one_line  # noqa: F401

from ns_abstract.cli import viewer as viewer_command
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame, TileBounds
from ns_abstract.refine.engine import Goal, Refinement
from ns_abstract.sets.path import Camera
from ns_abstract.sets.perturbation import Perturbation
from ns_abstract.viewer.background import Background
from ns_abstract.viewer.views import Snapshot, SplatSource, View, perturbation_of

PATIENCE = 120.0
Call = Callable[..., tuple[int, str]]


def camera(width: int = 96, height: int = 80, k: int = 0) -> Camera:
    pose = ring()[k].camera_to_world[:3]
    focal = 0.5 * height / np.tan(np.radians(22.5))
    return Camera(pose, focal, focal, 0.5 * width, 0.5 * height, width, height)


def view(x: float = 0.01, k: int = 0, **size: int) -> View:
    return View(camera(k=k, **size), perturbation_of({"x": x}))


@dataclass(frozen=True, eq=False)
class Odd(SplatSource):
    """Does odd things for sets that vary y, or all its life."""

    odd: str = ""

    def frame(self, camera: Camera, perturbation: Perturbation) -> SplatFrame:
        frame = super().frame(camera, perturbation)
        if "y" not in perturbation.translation:
            return frame
        if self.odd == "dies":
            os._exit(9)
        if self.odd == "hangs":
            time.sleep(600.0)
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
    splats = activate(blob_scene(), GSPLAT_1_4_0)
    return Odd(splats, odd=odd) if odd else SplatSource(splats)


@pytest.fixture
def background(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Background]]:
    """Makes a background that shows a source and is closed in the end."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    made: list[Background] = []

    def make(odd: str = "", **options: Any) -> Background:
        found = Background(**options)
        made.append(found)
        found.show(source(odd))
        return found

    yield make
    for one in made:
        one.close()


def answer(background: Background, view: View, seconds: float = 1.0, size: tuple[int, int] | None = None) -> Snapshot:
    """The last snapshot of the work on ``view``."""

    def look() -> Snapshot | None:
        found = background.best(view, seconds)
        state = background.status
        assert state.state != "failed", state.detail
        return found if state.state == "idle" else None

    return until(look, PATIENCE, "an abstract image")


def violations(snapshot: Snapshot, view: View, count: int = 30) -> int:
    """Values of real renders outside the bounds, at the snapshot's size, without tolerance."""
    at = view.camera.rescaled(view.side / max(snapshot.size))
    frame = source().frame(at, view.perturbation)
    box = frame.box
    values = [box.middle, *box.corners(), *box.sample(count, np.random.default_rng(3))]
    pictures = [frame.renderer.image(at, *frame.pose_set.world_to_camera(v)) for v in values]
    return sum(int(((p < snapshot.lower) | (p > snapshot.upper)).sum()) for p in pictures)


def test_pictures_grow_and_hold(background: Callable[..., Background]) -> None:
    one, asked = background(), view(width=160, height=120)
    seen: dict[tuple[int, int], Snapshot] = {}

    def look() -> bool:
        found = one.best(asked, 1.0)
        if found is not None:
            seen[found.size] = found
        return one.status.state == "idle"

    until(look, PATIENCE, "the last picture")
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


def test_more_goes_on_with_the_last_view(background: Callable[..., Background]) -> None:
    one = background()
    # hardly any time: one cell or a few
    first = answer(one, view(x=0.05), 0.01)
    one.more(2.0)
    second = answer(one, view(x=0.05), 0.01)
    assert second.cells > first.cells and second.size == first.size
    assert (second.lower >= first.lower).all() and (second.upper <= first.upper).all()
    assert (second.upper - second.lower).sum() < (first.upper - first.lower).sum()
    assert violations(second, view(x=0.05)) == 0


def odd_view() -> View:
    return View(camera(), perturbation_of({"y": 0.01}))


@pytest.mark.parametrize(
    ("odd", "said"),
    [("dies", "ended with code 9"), ("fails", "no such frame"), ("unsound", "not sound")],
)
def test_trouble_is_told_and_over(background: Callable[..., Background], odd: str, said: str) -> None:
    one = background(odd)
    until(lambda: one.best(odd_view(), 1.0) or one.status.state == "failed", PATIENCE, "the failure")
    assert said in one.status.detail
    # nothing is shown, and it is not tried again and again
    asked = one._wanted
    assert one.best(odd_view(), 1.0) is None
    assert one._wanted is asked
    assert violations(answer(one, view()), view()) == 0


def test_a_worker_that_is_stuck_is_replaced(background: Callable[..., Background]) -> None:
    one = background("hangs")
    until(lambda: [w.scene for w in one._workers] == [0, 0], PATIENCE, "two workers")
    stuck = one._workers[0]
    assert one.best(odd_view(), 1.0) is None
    until(lambda: stuck.busy is not None, PATIENCE, "the hanging work")
    assert violations(answer(one, view()), view()) == 0
    assert stuck not in one._workers
    assert stuck.process.wait(30) != 0


def test_asking_never_waits(background: Callable[..., Background]) -> None:
    one = background("hangs")
    one.best(odd_view(), 1.0)
    start = time.perf_counter()
    for k in range(100):
        one.best(view(x=0.001 * (k + 1)), 1.0)
    # a cell takes longer than all of these
    assert time.perf_counter() - start < 2.0
    assert one.best(view(x=0.1), 1.0) is None
    assert answer(one, view(x=0.1)).final


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
    for other in (view(x=0.02), view(k=1), View(camera(), perturbation_of({"yaw": 0.01}))):
        assert other.key != view().key
    assert view().fits(40, 48) and view().fits(41, 48) and not view().fits(48, 48)
    assert perturbation_of({"x": 0.0, "roll": 0.1}) == Perturbation(rotation={"roll": (-0.1, 0.1)})
    stages = view(width=300, height=150).stages(9.0, known=64)
    assert [(c.width, c.height) for c, _ in stages] == [(128, 64), (256, 128), (300, 150)]
    assert stages[-1][1] == 9.0


def test_refinement_can_be_looked_at_and_continued() -> None:
    found: list[tuple[int, Snapshot]] = []
    frame = source().frame(camera(), perturbation_of({"x": 0.05}))
    refinement = Refinement(frame, 0, Goal(1.0, 60.0, cells=9))

    def look(point: Any, share: float) -> None:
        if refinement.covered:
            found.append((point.cells, Snapshot.of(refinement.snapshot(), final=False, guarantee="float32-sound")))

    refinement.progress = look
    first = refinement.run()
    assert first.cells <= 9 and len(found) > 1
    spent = first.seconds
    second = refinement.proceed(Goal(1.0, spent + 60.0, cells=30))
    assert second.cells > first.cells and second.seconds > spent
    assert (second.lower >= first.lower).all() and (second.upper <= first.upper).all()
    whole = Refinement(source().frame(camera(), perturbation_of({"x": 0.05})), 0, Goal(1.0, 60.0, cells=9)).run()
    np.testing.assert_array_equal(whole.lower, first.lower)
    for _, snapshot in found:
        assert violations(snapshot, view(x=0.05)) == 0


# ---------------------------------------------------------------- the command


def test_viewer_needs_nerfstudio(monkeypatch: pytest.MonkeyPatch, blobs: Inputs, call: Call) -> None:  # noqa: F811
    monkeypatch.delitem(sys.modules, "ns_abstract.nerfstudio.viewing", raising=False)
    monkeypatch.setitem(sys.modules, "nerfstudio.configs.base_config", None)
    found = call(["--load-config", str(blobs.config)], viewer_command.main)
    one_line(*found, "nerfstudio", "pip install")


def test_viewer_refuses_what_is_no_run(blobs: Inputs, call: Call) -> None:  # noqa: F811
    pytest.importorskip("viser", reason="nerfstudio is not installed (extra nerfstudio)")
    for file in (blobs.config.parent / "none.yml", blobs.path):
        one_line(*call(["--load-config", str(file)], viewer_command.main), file.name)
    one_line(*call([], viewer_command.main), "load-config")
