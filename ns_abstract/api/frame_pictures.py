"""One frame's pictures as the search for certificates sees them, and the file that states a property."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io import digests
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import load_json
from ns_abstract.io.stamps import file_stamp
from ns_abstract.refine.protocol import Bounds, Frame, Method, RayFrame, SceneSample
from ns_abstract.report.picture import to_bytes
from ns_abstract.verify.camera_response import CameraResponse
from ns_abstract.verify.eight_bit import Picture, rounded, rounded_sets
from ns_abstract.verify.scene_pictures import ScenePictures

#: Pictures of a frame that are kept where they are made ray by ray.
_IMAGES = 64


@dataclass(frozen=True)
class PropertySource:
    """A property and the file that states it.

    ``file``: the file, or None. ``digests``: SHA-256 of the files that it names, as they were read inside `recorded`.
    """

    value: Any
    file: Path | None = None
    digests: dict[str, str] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def of(cls, given: Mapping[str, Any] | str | Path) -> PropertySource:
        """Return the source of a property given as a mapping or a file. Raises InputError: an unreadable file."""
        if isinstance(given, Mapping):
            return cls(dict(given))
        return cls(load_json(Path(given), "property file"), Path(given))

    @property
    def name(self) -> str:
        """The file's name."""
        return "property" if self.file is None else self.file.name

    @property
    def stamped(self) -> Any:
        """The content, with the SHA-256 of every file, as it was read, in place of its name."""
        return self._stamped(self.value)

    def _stamped(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self._stamped(part) for part in value]
        if not isinstance(value, dict):
            return value
        files = ("file", "mask", "indices")
        return {
            key: self._digest(self.folder / part) if key in files and isinstance(part, str) else self._stamped(part)
            for key, part in value.items()
        }

    def _digest(self, file: Path) -> str:
        # what was not read has no part in the property
        return self.digests.get(digests.key(file)) or file_stamp(file)["sha256"]

    @property
    def folder(self) -> Path:
        """Folder to which file names in the property are relative."""
        return Path() if self.file is None else self.file.parent

    def absolute(self) -> PropertySource:
        """Return the same source with an absolute path, for a process with another working directory."""
        return PropertySource(self.value, (self.file or Path("property")).absolute())

    def within(self, error: InputError) -> InputError:
        """Return ``error`` with the property's file named in it."""
        return error if self.file is None else error.within(self.file)


class FramePictures(ScenePictures):
    """One frame's pictures, for `ns_abstract.verify.search.Search`.

    Args:
        picture: Whether the network is shown floats or rounded pictures.
        response: The cameras that may show them; None: one that shows what is rendered.
        sheared: Whether parameters may be counted otherwise than the set does, where that is tighter (P2).
    """

    def __init__(
        self,
        method: Method,
        poses: PoseBox,
        picture: Picture = "float",
        response: CameraResponse | None = None,
        sheared: bool = False,
    ) -> None:
        super().__init__(self._frame(method, poses, sheared), response)
        self._rounded = picture == "8-bit"
        #: What pixels of a cell cost, where pictures are made ray by ray: see `pixel_costs`.
        self.weigh: Callable[[ParameterBox], np.ndarray | None] = lambda box: None
        self._images: dict[bytes, np.ndarray] = {}
        self._method = method

    def _frame(self, method: Method, poses: PoseBox, sheared: bool) -> Frame:
        return method.frame(poses, sheared)

    def image(self, values: np.ndarray, scene_sample: SceneSample | None = None) -> np.ndarray:
        values = np.asarray(values, np.float64)
        key = values.tobytes()
        image = None if scene_sample is not None else self._images.get(key)
        if image is None:
            image = super().image(values, scene_sample)
            if self.frame.tilewise and scene_sample is None:
                # costly, and neighbouring cells share their ends
                while len(self._images) >= _IMAGES:
                    self._images.pop(next(iter(self._images)))
                self._images[key] = image
        return rounded(image) if self._rounded else image

    def _bounds(self, box: ParameterBox) -> Bounds:
        if self.frame.tilewise:
            return cast("RayFrame", self.frame).cell_bounds(box, partial(self.weigh, box))
        return super()._bounds(box)

    def linear_sets(self, box: ParameterBox) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
        linear, lower, upper, slopes = super().linear_sets(box)
        return (*rounded_sets(linear, lower, upper), slopes) if self._rounded else (linear, lower, upper, slopes)

    @cached_property
    def _differentiable(self) -> Callable[[torch.Tensor], torch.Tensor]:
        renderer = self._method.differentiable(self.pose_set)
        assert renderer is not None
        return renderer

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Return the float picture without rounding to 8 bits, so that it has a gradient."""
        return self._differentiable(values)

    @property
    def effort(self) -> tuple[Frame, int]:
        """A frame whose bounds a cell takes, and how many of its tiles, where pictures are made ray by ray."""
        return self.frame, self.frame.tile_count

    def completed(self, image: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return an `image` at parameter values [d] with its colours, where the search leaves them out."""
        return image

    def shown(self, image: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return an `image` at parameter values [d] as bytes [h, w, 3], for people."""
        return to_bytes(image)
