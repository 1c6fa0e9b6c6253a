"""Sets of scenes whose Gaussians vary: their ranges, and scene samples of the set (docs/dev/design.md, S1)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ns_abstract.arithmetic.rounding import HALF_UP
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.activate import SH_C0, Splats
from ns_abstract.methods.splat.scene import Float64Array, SplatScene
from ns_abstract.perturbation.variations import SceneVariation, Selection

_NONE = np.empty((0, 3))


@dataclass(frozen=True)
class VariedSplats:
    """The set of all scenes whose Gaussians lie in their own ranges, independently of each other.

    Attributes:
        mean_low, mean_high: [N, 3] world, or [0, 3] where no mean varies.
        opacity_low, opacity_high: [N] in [0, 1].
        shift_low, shift_high: [N, 3] shifts of the activated colours, or [0, 3].
    """

    stored: Splats
    mean_low: Float64Array
    mean_high: Float64Array
    opacity_low: Float64Array
    opacity_high: Float64Array
    shift_low: Float64Array
    shift_high: Float64Array

    @classmethod
    def fixed(cls, splats: Splats) -> VariedSplats:
        """Return the set that contains ``splats`` alone."""
        return cls(splats, _NONE, _NONE, splats.opacity, splats.opacity, _NONE, _NONE)

    @cached_property
    def mean_middle(self) -> Float64Array:
        """Middles [N, 3] of the means' ranges; stored means where fixed."""
        if not self.mean_low.size:
            return self.stored.means
        middle = 0.5 * (self.mean_low + self.mean_high)
        return np.where(self.mean_low == self.mean_high, self.mean_low, middle)

    @cached_property
    def mean_radius(self) -> Float64Array:
        """Largest distances [N, 3] of means from their middles, rounded up; or [0, 3]."""
        if not self.mean_low.size:
            return _NONE
        middle = self.mean_middle
        return np.maximum(self.mean_high - middle, middle - self.mean_low) * HALF_UP

    @cached_property
    def counts(self) -> dict[str, int]:
        """The number of Gaussians that vary in each quantity."""
        return {
            "mean": int((self.mean_low != self.mean_high).any(axis=1).sum()),
            "opacity": int((self.opacity_low != self.opacity_high).sum()),
            "color": int((self.shift_low != self.shift_high).any(axis=1).sum()),
        }

    @property
    def varies(self) -> bool:
        """Whether the set has more than one scene."""
        return any(self.counts.values())

    def scene_sample(
        self, mean: Float64Array | float, opacity: Float64Array | float, color: Float64Array | float
    ) -> Splats:
        """Return one scene, at positions in [-1, 1] between the ranges' ends, broadcast to [N, 3], [N], [N, 3]."""
        return self.at(
            _between(self.mean_low, self.mean_high, mean) if self.mean_low.size else self.stored.means,
            _between(self.opacity_low, self.opacity_high, opacity),
            _between(self.shift_low, self.shift_high, color) if self.shift_low.size else _NONE,
        )

    def at(self, means: Float64Array, opacity: Float64Array, shift: Float64Array) -> Splats:
        """Return the scene with these values, clipped into the set: [N, 3], [N], [N, 3]."""
        return replace(
            self.stored,
            means=np.clip(means, self.mean_low, self.mean_high) if self.mean_low.size else self.stored.means,
            opacity=np.clip(opacity, self.opacity_low, self.opacity_high),
            color_shift=np.clip(shift, self.shift_low, self.shift_high) if self.shift_low.size else _NONE,
        )

    @cached_property
    def nearest(self) -> Splats:
        """The scene of the set nearest to the stored one: itself where the ranges contain 0."""
        if not self.varies and not self.mean_low.size and not self.shift_low.size:
            return self.stored
        return self.at(self.stored.means, self.stored.opacity, np.zeros_like(self.shift_low))

    def scene_samples(self, generator: np.random.Generator) -> Iterator[Splats]:
        """Yield scenes of the set without end: first extremes that brighten, darken or shift pictures, then random.

        Where a Gaussian is brighter than most, more opacity tends to brighten the picture (design.md, S5).
        """
        stored = self.stored
        brightness = stored.sh[:, 0].sum(axis=1)
        bright = np.where(brightness >= np.median(brightness), 1.0, -1.0)
        zero = np.zeros(3)
        for sign in (1.0, -1.0):
            yield self.scene_sample(zero, sign * bright, sign)
        for opacity, color in ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)):
            yield self.scene_sample(zero, opacity, color)
        if self.mean_low.size:
            for axis, sign in itertools.product(range(3), (1.0, -1.0)):
                yield self.scene_sample(sign * np.eye(3)[axis], 0.0, 0.0)
            for corner in itertools.product((1.0, -1.0), repeat=3):
                yield self.scene_sample(np.array(corner), corner[0] * bright, corner[0])
        n = stored.count
        for k in itertools.count():
            values = generator.uniform(-1.0, 1.0, (n, 7))
            if k % 2 == 0:
                values = np.where(values < 0.0, -1.0, 1.0)
            yield self.scene_sample(values[:, :3], values[:, 3], values[:, 4:])


def _between(low: Float64Array, high: Float64Array, place: Float64Array | float) -> Float64Array:
    return np.clip(low + 0.5 * (np.asarray(place) + 1.0) * (high - low), low, high)


def base_colors(scene: SplatScene) -> Float64Array:
    """Return activated colours [N, 3] of band 0, which the colour rule of a selection compares."""
    band = scene.sh[:, 0].astype(np.float64)
    if scene.color_model == "sigmoid":
        return 1.0 / (1.0 + np.exp(-band))
    return np.maximum(0.0, 0.5 + SH_C0 * band)


def selected(scene: SplatScene, opacity: Float64Array, select: Selection) -> np.ndarray:
    """Return [N] bool the Gaussians that ``select`` picks; ``opacity`` [N] is the activated one.

    Raises:
        InputError: A number is beyond the last Gaussian of the source.
    """
    mask = np.ones(scene.count, bool)
    if select.box is not None:
        means = scene.means.astype(np.float64)
        mask &= ((means >= select.box[0]) & (means <= select.box[1])).all(axis=1)
    if select.opacity is not None:
        mask &= (opacity >= select.opacity[0]) & (opacity <= select.opacity[1])
    if select.color_min is not None or select.color_max is not None:
        colors = base_colors(scene)
        if select.color_min is not None:
            mask &= (colors >= select.color_min).all(axis=1)
        if select.color_max is not None:
            mask &= (colors <= select.color_max).all(axis=1)
    if select.indices is not None:
        total = scene.count + sum(scene.dropped.values())
        if select.indices[-1] >= total:
            raise InputError(
                f"found {select.indices[-1]}", field="indices", fix=f"the scene has Gaussians 0 to {total - 1}"
            )
        stored = np.arange(scene.count) if scene.stored is None else scene.stored
        mask &= np.isin(stored, np.array(select.indices, np.int64))
    return mask


def vary(scene: SplatScene, splats: Splats, variations: Sequence[SceneVariation]) -> VariedSplats:
    """Return the set of scenes that ``variations`` describe; Gaussians picked twice get the hull of both ranges.

    Raises:
        InputError: An entry picks no Gaussian, or a number beyond the last one.
    """
    offsets: dict[str, tuple[Float64Array, Float64Array]] = {}
    for entry in variations:
        try:
            mask = selected(scene, splats.opacity, entry.select)
        except InputError as error:
            raise InputError(error.problem, field=f"{entry.name}.select.{error.field}", fix=error.fix) from None
        if not mask.any():
            raise InputError(
                f"picks none of {scene.count} Gaussians", field=f"{entry.name}.select", fix="widen the selection"
            )
        for quantity, limits in (("mean", entry.mean), ("opacity", entry.opacity), ("color", entry.color)):
            if limits is None:
                continue
            low, high = offsets.setdefault(quantity, (np.full(splats.count, np.inf), np.full(splats.count, -np.inf)))
            low[mask], high[mask] = np.minimum(low[mask], limits[0]), np.maximum(high[mask], limits[1])
    for low, high in offsets.values():
        untouched = low > high
        low[untouched], high[untouched] = 0.0, 0.0
    varied = VariedSplats.fixed(splats)
    if "mean" in offsets:
        low, high = (splats.means + end[:, None] for end in offsets["mean"])
        varied = replace(varied, mean_low=low, mean_high=high)
    if "opacity" in offsets:
        low, high = (np.clip(splats.opacity + end, 0.0, 1.0) for end in offsets["opacity"])
        varied = replace(varied, opacity_low=low, opacity_high=high)
    if "color" in offsets:
        low, high = (np.repeat(end[:, None], 3, axis=1) for end in offsets["color"])
        varied = replace(varied, shift_low=low, shift_high=high)
    return varied
