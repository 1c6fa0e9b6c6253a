"""Preprocessing from rendered pictures to a network's input, for pictures and for linear sets of pictures.

Resizing is done by the renderer, which draws at the network's resolution (docs/dev/design.md, V1).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ns_abstract.arithmetic.rounding import PREPROCESS_ROUNDING, PREPROCESSED_ROUNDING
from ns_abstract.io.errors import InputError
from ns_abstract.io.fields import fail, known
from ns_abstract.io.jsonio import FIX_MODERATE, is_moderate, unusable

if TYPE_CHECKING:
    from ns_abstract.verify.network import ImageSets

KEYS = ("resize", "mean", "std", "layout", "channels", "range")


@dataclass(frozen=True)
class Preprocess:
    """``y = (low + x (high - low) - mean) / std`` per channel, in the network's order of channels.

    Attributes:
        resize: Height and width of the network's input, or None if the camera path has them already.
        mean, std: Three numbers each, in the network's order of channels.
        range: The values that the picture's 0 and 1 become, before mean and std.
    """

    resize: tuple[int, int] | None = None
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    layout: str = "NCHW"
    channels: str = "RGB"
    range: tuple[float, float] = (0.0, 1.0)

    def size(self, input_shape: tuple[int, ...]) -> tuple[int, int]:
        """Return height and width of a network's input of this layout.

        Raises:
            InputError: The input is no picture with three channels, or contradicts ``resize``.
        """
        shape = input_shape if self.layout == "NCHW" else input_shape[-1:] + input_shape[:-1]
        if len(shape) != 3 or shape[0] != 3:
            raise InputError(
                f"the network's input is {list(input_shape)}, not three channels in layout {self.layout}",
                field="preprocess.layout",
                fix="write the network's layout, or use a network of RGB pictures",
            )
        size = (shape[1], shape[2])
        if self.resize not in (None, size):
            raise InputError(
                f"found {list(self.resize or ())}, the network's input has {size[0]} rows and {size[1]} columns",
                field="preprocess.resize",
                fix=f"write [{size[0]}, {size[1]}]",
            )
        return size

    @property
    def whole_numbers(self) -> bool:
        """Whether 8-bit pictures become their whole numbers from 0 to 255."""
        return self.range == (0.0, 255.0) and not any(self.mean) and all(part == 1.0 for part in self.std)

    def loading(self, output: str | None) -> dict[str, Any]:
        """Return keyword arguments for `load_network`: the output, the size of pictures where it is free, samples."""
        return {
            "output": output,
            "picture": self.resize,
            "layout": self.layout,
            "whole_numbers": self.whole_numbers,
            "shown": self._samples,
        }

    def _samples(self, input_shape: tuple[int, ...]) -> Iterator[np.ndarray]:
        """Yield inputs [1, *input_shape] of dark, bright and random pictures; none if the network takes no pictures."""
        try:
            height, width = self.size(input_shape)
        except InputError:
            return
        random = torch.rand((2, height, width, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float32)
        for picture in (torch.zeros_like(random[0]), torch.ones_like(random[0]), *random):
            yield self.apply(picture[None]).numpy()

    def _constants(self) -> tuple[np.ndarray, np.ndarray, float, float]:
        low, high = self.range
        return np.array(self.mean), np.array(self.std), low, high - low

    def apply(self, images: torch.Tensor) -> torch.Tensor:
        """Return network inputs [B, *input_shape] for pictures [B, H, W, 3] (RGB in [0, 1]), in their type."""
        if self.channels == "BGR":
            images = images.flip(-1)
        mean, std, low, scale = self._constants()
        constants = [torch.tensor(v, dtype=images.dtype) for v in (low, scale, mean, std)]
        values = (images * constants[1] + constants[0] - constants[2]) / constants[3]
        return values.permute(0, 3, 1, 2) if self.layout == "NCHW" else values

    def input_sets(
        self, linear: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], lower: np.ndarray, upper: np.ndarray
    ) -> ImageSets:
        """Return linear sets of network inputs, for those of pictures, with every float32 evaluation of `apply` (V1).

        Args:
            linear: A_lower [m, H, W, 3, d], b_lower [m, H, W, 3], A_upper, b_upper of m cells.
            lower, upper: [m, H, W, 3] interval bounds.
        """
        from ns_abstract.verify.network import ImageSets

        mean, std, low, scale = self._constants()
        a_lower, b_lower, a_upper, b_upper = (np.asarray(v, np.float64) for v in linear)
        factor = scale / std
        size = (abs(scale) + abs(low) + np.abs(mean)) / std

        def move(b: np.ndarray, a: np.ndarray | None, sign: float) -> np.ndarray:
            b = self._ordered(b, 0)
            value = (b * scale + low - mean) / std
            charge = PREPROCESS_ROUNDING * size + PREPROCESSED_ROUNDING * np.abs(b * factor)
            if a is not None:
                charge = charge + PREPROCESSED_ROUNDING * np.abs(a).sum(axis=-1)
            return self._flat(value + sign * charge, 0)

        slopes = [self._ordered(a, 1) * factor[:, None] for a in (a_lower, a_upper)]
        return ImageSets(
            a_lower=self._flat(slopes[0], 1),
            b_lower=move(b_lower, slopes[0], -1.0),
            a_upper=self._flat(slopes[1], 1),
            b_upper=move(b_upper, slopes[1], 1.0),
            lower=move(np.asarray(lower, np.float64), None, -1.0),
            upper=move(np.asarray(upper, np.float64), None, 1.0),
        )

    def _ordered(self, array: np.ndarray, after: int) -> np.ndarray:
        """Return the array with channels in the network's order; ``after``: number of axes behind the channels."""
        return np.flip(array, array.ndim - 1 - after) if self.channels == "BGR" else array

    def _flat(self, array: np.ndarray, after: int) -> np.ndarray:
        """Return [m, H, W, 3, ...] as [m, n, ...] in the layout's order."""
        if self.layout == "NCHW":
            array = np.moveaxis(array, array.ndim - 1 - after, 1)
        rest = array.shape[array.ndim - after :]
        # spelled out: -1 has no meaning where a set has no parameters
        count = math.prod(array.shape[1 : array.ndim - after])
        return np.ascontiguousarray(array).reshape(array.shape[0], count, *rest)


def parse_preprocess(value: Any) -> Preprocess:
    """Parse and check the object under the key ``preprocess`` of a property file."""

    def refused(name: str, found: Any, fix: str) -> InputError:
        return unusable(found, field=f"preprocess{name}", fix=fix)

    if not isinstance(value, dict):
        raise refused("", value, "write an object")
    known(value, KEYS, "preprocess.", fail)

    def numbers(name: str, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
        numbers = value.get(name, list(default))
        if not (isinstance(numbers, list) and len(numbers) == count and all(is_moderate(v) for v in numbers)):
            raise refused(f".{name}", numbers, f"write {count} numbers, each {FIX_MODERATE}")
        return tuple(float(v) for v in numbers)

    def choice(name: str, choices: tuple[str, str]) -> str:
        chosen = value.get(name, choices[0])
        if chosen not in choices or not isinstance(chosen, str):
            raise refused(f".{name}", chosen, f"write {' or '.join(choices)}")
        return chosen

    resize = value.get("resize")
    if resize is not None and not (
        isinstance(resize, list) and len(resize) == 2 and all(type(v) is int and 1 <= v <= 16384 for v in resize)
    ):
        raise refused(".resize", resize, "write [height, width] in pixels")
    std = numbers("std", 3, (1.0, 1.0, 1.0))
    if not min(std) > 0.0:
        raise refused(".std", value["std"], "write three numbers above 0")
    ends = numbers("range", 2, (0.0, 1.0))
    if not ends[0] < ends[1]:
        raise refused(".range", value["range"], "write the smaller end first")
    return Preprocess(
        resize=None if resize is None else (resize[0], resize[1]),
        mean=numbers("mean", 3, (0.0, 0.0, 0.0)),
        std=std,
        layout=choice("layout", ("NCHW", "NHWC")),
        channels=choice("channels", ("RGB", "BGR")),
        range=(ends[0], ends[1]),
    )
