"""Pictures of blending weights and depths beside the picture that they are read off, for people."""

from __future__ import annotations

import numpy as np

from ns_abstract.report.picture import heat, to_bytes

#: Columns of white between two pictures, and most planes that are drawn.
_GAP, _MOST = 2, 3
#: What pixels that are not read are darkened to, and the colours of planes.
_DIM, _MAP = 0.35, "viridis"


def planes_picture(image: np.ndarray, wanted: np.ndarray, depth: int | None) -> np.ndarray:
    """Return a picture [h, w, 3] of bytes: the colours with what is not read darkened, then the planes side by side.

    Args:
        image: [H, W, C] colours, then planes in [0, 1]; one of them may be depths.
        wanted: [H, W] the pixels that are read.
        depth: Channel of the depths, or None.
    """
    colors = np.clip(image[..., :3], 0.0, 1.0)
    images = [to_bytes(np.where(wanted[..., None], colors, _DIM * colors))]
    for channel in range(3, min(image.shape[2], 3 + _MOST)):
        plane, top = image[..., channel], 1.0
        if channel == depth:
            near = plane < np.max(plane)
            top = float(plane[near].max(initial=0.0)) or 1.0
        images.append(heat(np.clip(plane, 0.0, top), top, _MAP))
    gap = np.full((image.shape[0], _GAP, 3), 255, np.uint8)
    parts = [part for one in images for part in (one, gap)][:-1]
    return np.concatenate(parts, axis=1)
