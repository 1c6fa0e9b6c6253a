"""Concrete rendering on the CPU, in float64, with gsplat's evaluation semantics.

This is the picture that all bounds refer to: gsplat 1.4.0 as Splatfacto calls it in evaluation
(splatfacto.py:547-640; fully_fused_projection_fwd.cu, isect_tiles.cu, rasterize_to_pixels_fwd.cu).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.elementary import exp_kernel
from ns_abstract.arithmetic.rounding import LOGARITHM_ROOM, NONZERO, REGION
from ns_abstract.arithmetic.simd.intrinsics import borrowed, pointer, taken
from ns_abstract.execution.threads import threads
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.tiles import assemble, tile_grid
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.colors import sh_color
from ns_abstract.methods.splat.constants import ACCUMULATION_MIN, Rasteriser, raster_rules
from ns_abstract.methods.splat.lists import (
    BLOCK,
    PIXELS,
    TileLists,
    block_lists,
    depth_order,
    longest_first,
    pixel_sets,
    summed_area,
    tile_lists,
    tile_mask,
    touching,
)
from ns_abstract.methods.splat.work_sharing import CHUNK, run_by_tiles, run_in_chunks

_EXPONENT_LIMIT = 60.0

# columns of a projected Gaussian
_MEAN_X, _MEAN_Y, _P, _Q, _S, _OPACITY, _RED = range(7)
_COLUMNS = 9


class _SceneArrays(NamedTuple):
    """A scene's activated Gaussians as kernels take them; see `Splats`."""

    means: np.ndarray
    axes: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    degree: int
    color_shift: np.ndarray
    color_max: float


class _Projected(NamedTuple):
    """Projected Gaussians of one picture.

    Attributes:
        record: [N, _COLUMNS] mean in pixels, whitening P, Q, S (design.md, G4), opacity, colour.
        box: [N, 4] pixels x0, x1, y0, y1 where alpha reaches the threshold.
        tiles: [N, 4] their ranges of tiles x0, x1, y0, y1 (ends exclusive).
        depth: [N] world units.
        visible: [N] 1 if any pixel may show it, else 0; the other rows are then not set.
    """

    record: np.ndarray
    box: np.ndarray
    tiles: np.ndarray
    depth: np.ndarray
    visible: np.ndarray


@njit(cache=True, error_model="numpy", inline="always")
def _covariance(jx, jy, u, v, r0, r1, r2, axes):
    """Return the projected covariance a, b, c without blur, square pixels, and its determinant without cancellation.

    ``jx``, ``jy`` are focal lengths over depth, (u, v) the clamped ratios, r0, r1, r2 the rotation's rows, ``axes`` [3,
    3] the Gaussian's.
    """
    a0 = jx * (r0[0] - u * r2[0])
    a1 = jx * (r0[1] - u * r2[1])
    a2 = jx * (r0[2] - u * r2[2])
    b0 = jy * (r1[0] - v * r2[0])
    b1 = jy * (r1[1] - v * r2[1])
    b2 = jy * (r1[2] - v * r2[2])
    m00 = a0 * axes[0, 0] + a1 * axes[1, 0] + a2 * axes[2, 0]
    m01 = a0 * axes[0, 1] + a1 * axes[1, 1] + a2 * axes[2, 1]
    m02 = a0 * axes[0, 2] + a1 * axes[1, 2] + a2 * axes[2, 2]
    m10 = b0 * axes[0, 0] + b1 * axes[1, 0] + b2 * axes[2, 0]
    m11 = b0 * axes[0, 1] + b1 * axes[1, 1] + b2 * axes[2, 1]
    m12 = b0 * axes[0, 2] + b1 * axes[1, 2] + b2 * axes[2, 2]
    k0 = m00 * m11 - m01 * m10
    k1 = m00 * m12 - m02 * m10
    k2 = m01 * m12 - m02 * m11
    return (
        m00 * m00 + m01 * m01 + m02 * m02,
        m00 * m10 + m01 * m11 + m02 * m12,
        m10 * m10 + m11 * m11 + m12 * m12,
        k0 * k0 + k1 * k1 + k2 * k2,
    )


@njit(cache=True, error_model="numpy", inline="always")
def _region(mean_x, mean_y, a, b, c, alpha, camera, rules):
    """Return pixels x0, x1, y0, y1 where a Gaussian of covariance a, b, c shows, and whether any is in the image."""
    # pixels where alpha reaches the threshold
    exponent = 2.0 * math.log(alpha / rules.alpha_min) * REGION + LOGARITHM_ROOM
    extent_x = math.sqrt(exponent * a) * REGION
    extent_y = math.sqrt(exponent * c) * REGION
    x0, x1 = mean_x - extent_x, mean_x + extent_x
    y0, y1 = mean_y - extent_y, mean_y + extent_y
    visible = True
    tile = rules.tile_size
    if tile > 0.0:
        half = 0.5 * (a - c)
        spread = math.sqrt(max(rules.discriminant_min, half * half + b * b))
        # np.ceil: math.ceil is an int64, which a huge Gaussian overflows
        radius = np.ceil(rules.radius_sigmas * math.sqrt(0.5 * (a + c) + spread))
        visible = not (
            mean_x + radius <= 0.0
            or mean_x - radius >= camera.width
            or mean_y + radius <= 0.0
            or mean_y - radius >= camera.height
        )
        # the tiles hit by the radius cut the region off
        x0 = max(x0, np.floor((mean_x - radius) / tile) * tile)
        x1 = min(x1, np.ceil((mean_x + radius) / tile) * tile)
        y0 = max(y0, np.floor((mean_y - radius) / tile) * tile)
        y1 = min(y1, np.ceil((mean_y + radius) / tile) * tile)
    outside = x1 < 0.5 or x0 > camera.width - 0.5 or y1 < 0.5 or y0 > camera.height - 0.5 or x1 < x0 or y1 < y0
    return x0, x1, y0, y1, visible and not outside


@njit(cache=True, error_model="numpy", inline="always")
def _set_color(sh, shift, degree, most, i, direction, basis, color):
    """Write the colour of Gaussian i, seen along ``direction`` [3] (not of unit length), to ``color`` [>= 3].

    ``sh``, ``shift``, ``degree`` and ``most`` are those of `_SceneArrays`; numba would count references to a record's
    arrays at every call.
    """
    if degree == 0:
        for channel in range(3):
            color[channel] = sh[i, 0, channel]
    else:
        sh_color(sh[i], direction, degree, basis, color)
    if shift.shape[0] > 0:
        for channel in range(3):
            color[channel] = min(most, max(0.0, color[channel] + shift[i, channel]))


@njit(cache=True, error_model="numpy", inline="always")
def _ratio_limits(camera, margin):
    """Return magnitudes of x/z and y/z, left, right, top and bottom, to which the Jacobian is clamped."""
    left = right = top = bottom = np.inf
    if margin >= 0.0:
        left = camera.cx / camera.fx + margin * 0.5 * camera.width / camera.fx
        right = (camera.width - camera.cx) / camera.fx + margin * 0.5 * camera.width / camera.fx
        top = camera.cy / camera.fy + margin * 0.5 * camera.height / camera.fy
        bottom = (camera.height - camera.cy) / camera.fy + margin * 0.5 * camera.height / camera.fy
    return left, right, top, bottom


@njit(cache=True, error_model="numpy", nogil=True)
def _project_worker(counter_, scene, rotation, position, eye, camera, rules, out):
    """Project one thread's Gaussians; see `ns_abstract.methods.splat.constants` for the rules' sources.

    ``counter_``: see `run_in_chunks`. The ``rotation`` [3, 3] is from world to camera, OpenCV axes; the camera's
    ``position`` and ``eye``, from which colours are seen, are [3], world. ``out``: `_Projected`, the output.
    """
    counter = pointer(counter_)
    means, axes, opacity = borrowed(scene.means), borrowed(scene.axes), borrowed(scene.opacity)
    sh, shift, degree, most = borrowed(scene.sh), borrowed(scene.color_shift), scene.degree, scene.color_max
    records, box, tiles = borrowed(out.record), borrowed(out.box), borrowed(out.tiles)
    depth, visible = borrowed(out.depth), borrowed(out.visible)
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    tile, alpha_min, eps2d = rules.work_tile, rules.alpha_min, rules.eps2d
    tiles_x = int(math.ceil(camera.width / tile))
    tiles_y = int(math.ceil(camera.height / tile))
    left, right, top, bottom = _ratio_limits(camera, rules.view_margin)
    r0 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r1 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r2 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    basis_, direction_ = np.empty(16), np.empty(3)
    basis, direction = borrowed(basis_), borrowed(direction_)
    while True:
        start = taken(counter) * CHUNK
        if start >= means.shape[0]:
            break
        for i in range(start, min(means.shape[0], start + CHUNK)):
            visible[i] = 0
            d0 = means[i, 0] - position[0]
            d1 = means[i, 1] - position[1]
            d2 = means[i, 2] - position[2]
            z = r2[0] * d0 + r2[1] * d1 + r2[2] * d2
            alpha = opacity[i]
            if not (rules.near <= z and z <= rules.far) or alpha < alpha_min:
                continue
            inverse = 1.0 / z
            u = (r0[0] * d0 + r0[1] * d1 + r0[2] * d2) * inverse
            v = (r1[0] * d0 + r1[1] * d1 + r1[2] * d2) * inverse
            mean_x = fx * u + cx
            mean_y = fy * v + cy
            u = min(right, max(-left, u))
            v = min(bottom, max(-top, v))
            a, b, c, sharp = _covariance(fx * inverse, fy * inverse, u, v, r0, r1, r2, axes[i])
            det = sharp + eps2d * (a + c) + eps2d * eps2d
            a += eps2d
            c += eps2d
            if not det > 0.0:
                continue
            if rules.antialiased:
                alpha *= max(rules.compensation_min, math.sqrt(sharp / det))
            if alpha < alpha_min or alpha == 0.0:
                continue
            x0, x1, y0, y1, in_image = _region(mean_x, mean_y, a, b, c, alpha, camera, rules)
            if not in_image:
                continue
            tiles[i, 0] = int(max(0.0, np.floor(x0 / tile)))
            tiles[i, 1] = int(min(float(tiles_x), np.floor(x1 / tile) + 1.0))
            tiles[i, 2] = int(max(0.0, np.floor(y0 / tile)))
            tiles[i, 3] = int(min(float(tiles_y), np.floor(y1 / tile) + 1.0))
            box[i, 0], box[i, 1], box[i, 2], box[i, 3] = x0, x1, y0, y1
            p = math.sqrt(c / det)
            record = records[i]
            record[_MEAN_X], record[_MEAN_Y] = mean_x, mean_y
            record[_P], record[_Q], record[_S] = p, p * (b / c), 1.0 / math.sqrt(c)
            record[_OPACITY] = alpha
            for k in range(3):
                direction[k] = means[i, k] - eye[k]
            _set_color(sh, shift, degree, most, i, direction, basis, record[_RED:])
            depth[i] = z
            visible[i] = 1
    # the owners of what is borrowed live to here
    return basis_.size + direction_.size


# rows of a block's state: transmittance, colours, whether the pixel still takes light
_LIGHT, _R, _G, _B, _LIVE = range(0, 5 * PIXELS, PIXELS)


@njit(cache=True, error_model="numpy")
def _add_gaussian(record, i, ox, oy, n, state, rules):
    """Composite Gaussian i into the first ``n`` pixels of ``state``, whose first pixel is at offset (ox, oy)."""
    p, s, skew, opacity = record[i, _P], record[i, _S], record[i, _Q], record[i, _OPACITY]
    red, green, blue = record[i, _RED], record[i, _RED + 1], record[i, _RED + 2]
    alpha_min, alpha_max, stop = rules.alpha_min, rules.alpha_max, rules.transmittance_min
    for q in range(n):
        ax = ox + (q % BLOCK)
        ay = oy + (q // BLOCK)
        y1 = p * ax - skew * ay
        y2 = s * ay
        sigma = 0.5 * (y1 * y1 + y2 * y2)
        alpha = min(alpha_max, opacity * exp_kernel(-min(sigma, _EXPONENT_LIMIT)))
        live = state[_LIVE + q]
        alpha = alpha * live if alpha >= alpha_min else 0.0
        light = state[_LIGHT + q]
        after = light * (1.0 - alpha)
        stops = after <= stop
        weight = 0.0 if stops else alpha * light
        state[_LIVE + q] = 0.0 if stops else live
        state[_LIGHT + q] = light if stops else after
        state[_R + q] += weight * red
        state[_G + q] += weight * green
        state[_B + q] += weight * blue


@njit(cache=True, error_model="numpy")
def _blend_block(numbers, pixels, x0, y0, record, box, rules, state):
    """Composite the Gaussians ``numbers``, nearest first, into a block's ``state`` [5, PIXELS], flat.

    Only ``pixels``, a set of 64 bits, are drawn.
    """
    for q in range(PIXELS):
        state[_LIGHT + q] = 1.0
        state[_R + q] = 0.0
        state[_G + q] = 0.0
        state[_B + q] = 0.0
        state[_LIVE + q] = float((pixels >> q) & 1)
    since = 0
    for i in numbers:
        # only the rows of pixels that the Gaussian reaches
        top = int(math.ceil(min(max(box[i, 2] - 0.5 - y0, 0.0), float(BLOCK))))
        bottom = int(math.floor(min(max(box[i, 3] - 0.5 - y0, -1.0), BLOCK - 1.0)))
        if top > bottom:
            continue
        ox, oy = x0 + 0.5 - record[i, _MEAN_X], y0 + top + 0.5 - record[i, _MEAN_Y]
        _add_gaussian(record, i, ox, oy, (bottom - top + 1) * BLOCK, state[top * BLOCK :], rules)
        since += 1
        if since == 8:
            since = 0
            live = 0.0
            for q in range(PIXELS):
                live += state[_LIVE + q]
            if live == 0.0:
                break


@njit(cache=True, error_model="numpy", nogil=True)
def _rasterise_worker(share, lists, sets_, record_, box_, camera, rules, background, image_):
    """Composite one thread's ``share`` of the tiles of ``lists.wanted`` into ``image_`` [t, side, side, 3], in [0, 1].

    ``sets_`` [t, blocks] int64 are the requested pixels of each block; the others show the ``background`` [3].
    ``record_`` and ``box_`` are those of `_Projected`.
    """
    sequence, counter = borrowed(share.sequence), pointer(share.counter)
    record, box, image, sets = borrowed(record_), borrowed(box_), borrowed(image_), borrowed(sets_)
    tile = image.shape[1]
    tiles_x = int(math.ceil(camera.width / tile))
    blocks = tile // BLOCK
    state_ = np.empty(5 * PIXELS)
    state = borrowed(state_)
    block_offsets = np.empty(blocks * blocks + 1, np.int64)
    block_entries = np.empty(4096, np.uint32)
    while True:
        turn = taken(counter)
        if turn >= sequence.size:
            break
        number = sequence[turn]
        t = lists.wanted[number]
        left = (t % tiles_x) * tile
        above = (t // tiles_x) * tile
        of_tile = lists.entries[lists.offsets[t] : lists.offsets[t + 1]]
        block_entries = block_lists(of_tile, box, left, above, tile, block_offsets, block_entries)
        for b in range(blocks * blocks):
            x0 = left + (b % blocks) * BLOCK
            y0 = above + (b // blocks) * BLOCK
            if x0 >= camera.width or y0 >= camera.height:
                continue
            some = block_entries[block_offsets[b] : block_offsets[b + 1]]
            _blend_block(some, sets[number, b], x0, y0, record, box, rules, state)
            for q in range(PIXELS):
                row = y0 - above + q // BLOCK
                column = x0 - left + q % BLOCK
                for channel in range(3):
                    value = state[(1 + channel) * PIXELS + q] + state[_LIGHT + q] * background[channel]
                    image[number, row, column, channel] = min(1.0, max(0.0, value))
    # the owner of the borrowed state lives to here
    return state_.size


class Renderer:
    """Renders one scene; reuses its buffers between calls."""

    def __init__(self, splats: Splats, rasteriser: Rasteriser) -> None:
        n = splats.count
        self.splats = splats
        self.rules = raster_rules(rasteriser, splats.antialiased)
        self._eye_from_view = rasteriser.eye_from_view
        self.side = rasteriser.work_tile
        self._projected = _Projected(
            record=np.empty((n, _COLUMNS)),
            box=np.empty((n, 4)),
            tiles=np.empty((n, 4), np.int32),
            depth=np.empty(n),
            visible=np.empty(n, np.uint8),
        )

    def tiles(
        self,
        camera: PinholeCamera,
        rotation: np.ndarray,
        position: np.ndarray,
        wanted: np.ndarray | None = None,
        scene_sample: Splats | None = None,
        pixels: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the tiles ``wanted`` (numbers, row-major; all if None) as float64 [t, side, side, 3].

        Args:
            camera: Intrinsics and size; its own pose is not used.
            rotation: [3, 3] world to camera, OpenCV axes.
            position: [3] camera position, world.
            scene_sample: The scene to render in place of the stored one: as many Gaussians, of the same degree.
            pixels: [t, side, side] which of the tiles' pixels to draw, others show the background; all if None.
        """
        splats = self.splats if scene_sample is None else scene_sample
        across, down = tile_grid(camera, self.side)
        if wanted is None:
            wanted = np.arange(across * down)
        lists = self.lists(splats, camera, rotation, position, wanted)
        return self._blend(camera, lists, self._projected.record, splats.background, pixels)

    def lists(
        self, splats: Splats, camera: PinholeCamera, rotation: np.ndarray, position: np.ndarray, wanted: np.ndarray
    ) -> TileLists:
        """Project every Gaussian, and return the lists of the tiles ``wanted``."""
        scene = _SceneArrays(
            splats.means, splats.axes, splats.opacity, splats.sh, splats.degree, splats.color_shift, splats.color_max
        )
        projected = self._projected
        rotation = np.ascontiguousarray(rotation, np.float64)
        position = np.ascontiguousarray(position, np.float64)
        run_in_chunks(
            _project_worker,
            splats.count,
            scene,
            rotation,
            position,
            rotation.T @ (rotation @ position) if self._eye_from_view else position,
            camera.intrinsics,
            self.rules,
            projected,
        )
        across, down = tile_grid(camera, self.side)
        mask = tile_mask(wanted, across * down)
        visible = np.flatnonzero(projected.visible)
        if not mask.all():
            visible = touching(visible, projected.tiles, summed_area(mask.reshape(down, across)))
        offsets, entries = tile_lists(depth_order(visible, projected.depth), projected.tiles, mask, across)
        return TileLists(np.asarray(wanted, np.int64), offsets, entries)

    def _blend(
        self, camera: PinholeCamera, lists: TileLists, record: np.ndarray, background: np.ndarray,
        pixels: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        image = np.zeros((lists.wanted.size, self.side, self.side, 3))
        sets = pixel_sets(pixels, lists.wanted.size, self.side)
        box = self._projected.box
        run_by_tiles(
            _rasterise_worker, longest_first(lists.wanted, lists.offsets), threads(),
            lists, sets, record, box, camera.intrinsics, self.rules, background, image,
        )  # fmt: skip
        return image

    def image(
        self, camera: PinholeCamera, rotation: np.ndarray, position: np.ndarray, scene_sample: Splats | None = None
    ) -> np.ndarray:
        """Return the whole image, float64 [H, W, 3] in [0, 1]; see `tiles`."""
        return assemble(self.tiles(camera, rotation, position, scene_sample=scene_sample), camera)

    def layers(
        self, camera: PinholeCamera, rotation: np.ndarray, position: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return Splatfacto's outputs in evaluation (splatfacto.py:620-665; gsplat's render mode RGB+ED).

        Returns:
            Image [H, W, 3] and accumulation [H, W, 1] in [0, 1]; expected depth [H, W, 1], where nothing is hit the
                largest one of the image.
        """
        whole_image = assemble(self.layer_tiles(camera, rotation, position), camera)
        image, accumulation, depth = whole_image[..., :3], whole_image[..., 3:4], whole_image[..., 4:]
        drawn = accumulation > 0.0
        return image, accumulation, np.where(drawn, depth, depth[drawn].max(initial=0.0))

    def layer_tiles(
        self,
        camera: PinholeCamera,
        rotation: np.ndarray,
        position: np.ndarray,
        wanted: np.ndarray | None = None,
        scene_sample: Splats | None = None,
    ) -> np.ndarray:
        """Return `tiles` with two more channels, [t, side, side, 5].

        The fourth is the accumulation, the fifth the expected depth in world units, NaN where nothing is drawn.
        """
        across, down = tile_grid(camera, self.side)
        wanted = np.arange(across * down) if wanted is None else np.asarray(wanted, np.int64)
        splats = self.splats if scene_sample is None else scene_sample
        lists = self.lists(splats, camera, rotation, position, wanted)
        projected = self._projected
        image = self._blend(camera, lists, projected.record, splats.background)
        # the same weights, with depths as colours; the blending clamps to [0, 1]
        visible = projected.visible.astype(bool)
        farthest = max(float(projected.depth[visible].max(initial=0.0)), NONZERO)
        record = projected.record.copy()
        record[visible, _RED] = 1.0
        record[visible, _RED + 1] = projected.depth[visible] / farthest
        record[visible, _RED + 2] = 0.0
        sums = self._blend(camera, lists, record, np.zeros(3))
        accumulation = sums[..., :1]
        depth = farthest * sums[..., 1:2] / np.maximum(accumulation, ACCUMULATION_MIN)
        return np.concatenate([image, accumulation, np.where(accumulation > 0.0, depth, np.nan)], axis=-1)
