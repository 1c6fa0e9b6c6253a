"""The film of a tube: abstract images of all pictures that the camera may take, step by step."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.reach.tubes import Tube, TubeBuilder
from ns_abstract.refine.protocol import Method
from ns_abstract.refine.result import FrameResult
from ns_abstract.report.export import encoded, panels, picture
from ns_abstract.report.figures import metrics, number
from ns_abstract.report.picture import preview
from ns_abstract.verify.scene_pictures import ScenePictures

#: Steps of a film and of the page at most; pictures a second.
_MOST_STEPS, _MOST_SHOWN, _FPS = 100, 10, 4.0
#: Pixels along the longer side below which the camera of the film has more of them than the network's.
_LEAST_SIDE = 64
#: Pixels along the longer side of a picture in the page.
_SMALL = 64
SHOWN = ("lower", "upper", "gap", "image")


@dataclass(frozen=True)
class Film:
    """The abstract images along a tube.

    Attributes:
        about: For report.json: the cell, its verdict, picture size; by step the gaps and the box of camera parameters.
    """

    about: dict[str, Any]
    steps: tuple[FrameResult, ...]

    @property
    def largest(self) -> float:
        """The largest gap over all steps, which is the end of every gap scale."""
        return max(self.about["largest_gap"], default=0.0)

    def encoded(self) -> tuple[str, bytes]:
        """Return the file's suffix and its content (mp4 or gif); see `ns_abstract.report.export.encoded`."""

        def frames() -> Iterator[np.ndarray]:
            for result in self.steps:
                mean = number(metrics(result)["mpg"])
                text = f"step {result.index}   mean gap {mean}   brightest gap {number(self.largest)}"
                yield panels(result, SHOWN, self.largest, text)

        return encoded(frames(), _FPS)

    def strips(self) -> list[tuple[int, bytes]]:
        """Return the numbers of a few steps and a PNG of each step's pictures below each other."""
        strips = []
        for k in _some(len(self.steps), _MOST_SHOWN):
            result = self.steps[k]
            side = _SMALL * max(1, round(max(result.image.shape[:2]) / _SMALL))
            pictures = [picture(result, name, self.largest) for name in SHOWN]
            strips.append((result.index, preview(np.concatenate(pictures), side * len(SHOWN))))
        return strips


def _some(count: int, most_steps: int) -> list[int]:
    """Return at most ``most_steps`` of the numbers 0 .. ``count`` - 1, evenly spread, with both ends."""
    return np.unique(np.linspace(0, count - 1, min(count, most_steps)).round().astype(int)).tolist() if count else []


def film_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return height and width of the film's pictures: a whole multiple of the network's ``size``."""
    times = -(-_LEAST_SIDE // max(size))
    return size[0] * max(1, times), size[1] * max(1, times)


def along(reacher: TubeBuilder, method: Method, size: tuple[int, int], tube: Tube) -> Iterator[FrameResult]:
    """Yield, step by step, bounds of all pictures that the camera may take, and the picture at the middle pose.

    Each step is bounded as one cell, as it is for the tube.
    """
    small = reacher.view.pose_set.camera
    camera = reacher.loop.camera.enlarged(size[0] / small.height, size[1] / small.width)
    poses = camera.poses(size)
    view, begin = ScenePictures(method.frame(poses)), time.perf_counter()
    for step in _some(len(tube.state_sets), _MOST_STEPS):
        check_cancelled()
        pose = reacher.poses(tube.state_sets[step])
        low, high = pose.hull()
        outer = poses.box
        if not pose.finite or not ((low >= outer.lower) & (high <= outer.upper)).all():
            return
        box = outer.with_ends(low, high)
        _, lower, upper, _ = view.linear_sets(box)
        image = view.image(np.clip(camera.values(tube.state_sets[step].center), low, high))
        seconds = time.perf_counter() - begin
        yield FrameResult(step, box, lower, upper, image, image, image, seconds, 1)


def made(steps: Sequence[FrameResult], lower: Sequence[float], upper: Sequence[float], verdict: str) -> Film:
    """Return the film of a cell [m] from the bounds of its steps."""
    figures = [metrics(result) for result in steps]
    about = {
        "lower": list(lower),
        "upper": list(upper),
        "verdict": verdict,
        "size": list(steps[0].image.shape[:2]) if steps else None,
        "steps": [result.index for result in steps],
        "mean_gap": [entry["mpg"] for entry in figures],
        "largest_gap": [entry["xpg"] for entry in figures],
        "camera": [[list(result.box.lower), list(result.box.upper)] for result in steps],
    }
    return Film(about, tuple(steps))
