"""Concrete rendering on the CPU, in float64, with gsplat's evaluation semantics.

This is the picture that all bounds refer to: gsplat 1.4.0 as Splatfacto calls it in evaluation
(splatfacto.py:547-640; fully_fused_projection_fwd.cu, isect_tiles.cu, rasterize_to_pixels_fwd.cu).
"""

from __future__ import annotations

import math

import numpy as np
from numba import get_num_threads, njit, prange

from ns_abstract.arithmetic.compiled import borrowed, pointer, taken
from ns_abstract.arithmetic.elementary import exp_kernel
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.colors import sh_color
from ns_abstract.methods.splat.constants import Rasteriser, rules_array
from ns_abstract.methods.splat.lists import (
    BLOCK,
    PIXELS,
    block_lists,
    depth_order,
    longest_first,
    tile_lists,
    tile_mask,
    touching,
)
from ns_abstract.sets.path import Camera
from ns_abstract.sets.tiles import assemble, tile_grid

_CHUNK = 1024
_EXPONENT_LIMIT = 60.0
_REGION = 1.0 + 2.0**-30

# columns of a projected Gaussian
_MEAN_X, _MEAN_Y, _P, _Q, _S, _OPACITY, _RED = range(7)
_COLUMNS = 9


@njit(cache=True, error_model="numpy")
def _project_chunk(
    chunk, means, axes, opacity, sh, degree, shift, color_max, rotation, position, camera, rules, antialiased, tile,
    record, box, tiles, depth, visible,
):  # fmt: skip
    """Project one chunk of Gaussians; see `ns_abstract.methods.splat.constants` for the rules' sources."""
    n = means.shape[0]
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    near, far, eps2d, cutoff, sigmas, discriminant_min, margin, alpha_min = (
        rules[0], rules[1], rules[2], rules[3], rules[4], rules[5], rules[6], rules[7],
    )  # fmt: skip
    tiles_x = int(math.ceil(width / tile))
    tiles_y = int(math.ceil(height / tile))
    if margin >= 0.0:
        right = (width - cx) / fx + margin * 0.5 * width / fx
        left = cx / fx + margin * 0.5 * width / fx
        bottom = (height - cy) / fy + margin * 0.5 * height / fy
        top = cy / fy + margin * 0.5 * height / fy
    else:
        right = left = bottom = top = np.inf
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    basis = np.empty(16)
    direction = np.empty(3)
    for i in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
        visible[i] = 0
        d0 = means[i, 0] - position[0]
        d1 = means[i, 1] - position[1]
        d2 = means[i, 2] - position[2]
        z = r20 * d0 + r21 * d1 + r22 * d2
        if not (near <= z and z <= far) or opacity[i] < alpha_min:
            continue
        x = r00 * d0 + r01 * d1 + r02 * d2
        y = r10 * d0 + r11 * d1 + r12 * d2
        inverse = 1.0 / z
        u = x * inverse
        v = y * inverse
        mean_x = fx * u + cx
        mean_y = fy * v + cy
        u = min(right, max(-left, u))
        v = min(bottom, max(-top, v))
        jx = fx * inverse
        jy = fy * inverse
        a0 = jx * (r00 - u * r20)
        a1 = jx * (r01 - u * r21)
        a2 = jx * (r02 - u * r22)
        b0 = jy * (r10 - v * r20)
        b1 = jy * (r11 - v * r21)
        b2 = jy * (r12 - v * r22)
        m00 = a0 * axes[i, 0, 0] + a1 * axes[i, 1, 0] + a2 * axes[i, 2, 0]
        m01 = a0 * axes[i, 0, 1] + a1 * axes[i, 1, 1] + a2 * axes[i, 2, 1]
        m02 = a0 * axes[i, 0, 2] + a1 * axes[i, 1, 2] + a2 * axes[i, 2, 2]
        m10 = b0 * axes[i, 0, 0] + b1 * axes[i, 1, 0] + b2 * axes[i, 2, 0]
        m11 = b0 * axes[i, 0, 1] + b1 * axes[i, 1, 1] + b2 * axes[i, 2, 1]
        m12 = b0 * axes[i, 0, 2] + b1 * axes[i, 1, 2] + b2 * axes[i, 2, 2]
        a = m00 * m00 + m01 * m01 + m02 * m02
        c = m10 * m10 + m11 * m11 + m12 * m12
        b = m00 * m10 + m01 * m11 + m02 * m12
        k0 = m00 * m11 - m01 * m10
        k1 = m00 * m12 - m02 * m10
        k2 = m01 * m12 - m02 * m11
        sharp = k0 * k0 + k1 * k1 + k2 * k2
        det = sharp + eps2d * (a + c) + eps2d * eps2d
        a += eps2d
        c += eps2d
        if not det > 0.0:
            continue
        alpha = opacity[i]
        if antialiased:
            alpha *= math.sqrt(sharp / det)
        if alpha < alpha_min or alpha == 0.0:
            continue
        # pixels where alpha reaches the threshold
        exponent = 2.0 * math.log(alpha / alpha_min) * _REGION + 2.0**-30
        extent_x = math.sqrt(exponent * a) * _REGION
        extent_y = math.sqrt(exponent * c) * _REGION
        x0, x1 = mean_x - extent_x, mean_x + extent_x
        y0, y1 = mean_y - extent_y, mean_y + extent_y
        if cutoff > 0.0:
            half = 0.5 * (a - c)
            # np.ceil: math.ceil is an int64, which a huge Gaussian overflows
            radius = np.ceil(
                sigmas * math.sqrt(0.5 * (a + c) + math.sqrt(max(discriminant_min, half * half + b * b)))
            )
            if (
                mean_x + radius <= 0.0
                or mean_x - radius >= width
                or mean_y + radius <= 0.0
                or mean_y - radius >= height
            ):
                continue
            # the tiles hit by the radius cut the region off
            x0 = max(x0, np.floor((mean_x - radius) / tile) * tile)
            x1 = min(x1, np.ceil((mean_x + radius) / tile) * tile)
            y0 = max(y0, np.floor((mean_y - radius) / tile) * tile)
            y1 = min(y1, np.ceil((mean_y + radius) / tile) * tile)
        if x1 < 0.5 or x0 > width - 0.5 or y1 < 0.5 or y0 > height - 0.5 or x1 < x0 or y1 < y0:
            continue
        tiles[i, 0] = int(max(0.0, np.floor(x0 / tile)))
        tiles[i, 1] = int(min(float(tiles_x), np.floor(x1 / tile) + 1.0))
        tiles[i, 2] = int(max(0.0, np.floor(y0 / tile)))
        tiles[i, 3] = int(min(float(tiles_y), np.floor(y1 / tile) + 1.0))
        box[i, 0], box[i, 1], box[i, 2], box[i, 3] = x0, x1, y0, y1
        p = math.sqrt(c / det)
        record[i, _MEAN_X], record[i, _MEAN_Y] = mean_x, mean_y
        record[i, _P], record[i, _Q], record[i, _S] = p, p * (b / c), 1.0 / math.sqrt(c)
        record[i, _OPACITY] = alpha
        if degree == 0:
            for channel in range(3):
                record[i, _RED + channel] = sh[i, 0, channel]
        else:
            direction[0], direction[1], direction[2] = d0, d1, d2
            sh_color(sh[i], direction, degree, basis, record[i, _RED:])
        if shift.shape[0] > 0:
            for channel in range(3):
                record[i, _RED + channel] = min(color_max, max(0.0, record[i, _RED + channel] + shift[i, channel]))
        depth[i] = z
        visible[i] = 1


@njit(cache=True, parallel=True, error_model="numpy")
def _project(
    means, axes, opacity, sh, degree, shift, color_max, rotation, position, camera, rules, antialiased, tile,
    record, box, tiles, depth, visible,
):  # fmt: skip
    """Project every Gaussian."""
    for chunk in prange((means.shape[0] + _CHUNK - 1) // _CHUNK):
        _project_chunk(
            chunk, means, axes, opacity, sh, degree, shift, color_max, rotation, position, camera, rules,
            antialiased, tile, record, box, tiles, depth, visible,
        )  # fmt: skip


# rows of a block's state: transmittance, colours, whether the pixel still takes light
_LIGHT, _R, _G, _B, _LIVE = range(0, 5 * PIXELS, PIXELS)


@njit(cache=True, error_model="numpy")
def _add_gaussian(record, i, ox, oy, n, state, alpha_min, alpha_max, stop):
    """Blend Gaussian i into the first ``n`` pixels of ``state``, whose first pixel lies at offset (ox, oy)."""
    p, s, skew, opacity = record[i, _P], record[i, _S], record[i, _Q], record[i, _OPACITY]
    red, green, blue = record[i, _RED], record[i, _RED + 1], record[i, _RED + 2]
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
def _rasterise_worker(
    sequence_, counter_, wanted, offsets, entries, record_, box_, camera, rules, background, tile, image_
):  # fmt: skip
    """One thread's tiles: the next of ``sequence`` that none has taken yet; see `_rasterise`."""
    sequence, counter = borrowed(sequence_), pointer(counter_)
    record, box, image = borrowed(record_), borrowed(box_), borrowed(image_)
    width, height = camera[4], camera[5]
    alpha_min, alpha_max, stop = rules[7], rules[8], rules[9]
    tiles_x = int(math.ceil(width / tile))
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
        t = wanted[number]
        left = (t % tiles_x) * tile
        above = (t // tiles_x) * tile
        block_entries = block_lists(
            entries[offsets[t] : offsets[t + 1]], box, left, above, tile, block_offsets, block_entries
        )
        for b in range(blocks * blocks):
            x0 = left + (b % blocks) * BLOCK
            y0 = above + (b // blocks) * BLOCK
            if x0 >= width or y0 >= height:
                continue
            for q in range(PIXELS):
                state[_LIGHT + q] = 1.0
                state[_R + q] = 0.0
                state[_G + q] = 0.0
                state[_B + q] = 0.0
                state[_LIVE + q] = 1.0
            since = 0
            for k in range(block_offsets[b], block_offsets[b + 1]):
                i = block_entries[k]
                # only the rows of pixels that the Gaussian reaches
                top = int(math.ceil(min(max(box[i, 2] - 0.5 - y0, 0.0), float(BLOCK))))
                bottom = int(math.floor(min(max(box[i, 3] - 0.5 - y0, -1.0), BLOCK - 1.0)))
                if top > bottom:
                    continue
                _add_gaussian(
                    record, i, x0 + 0.5 - record[i, _MEAN_X], y0 + top + 0.5 - record[i, _MEAN_Y],
                    (bottom - top + 1) * BLOCK, state[top * BLOCK :], alpha_min, alpha_max, stop,
                )  # fmt: skip
                since += 1
                if since == 8:
                    since = 0
                    live = 0.0
                    for q in range(PIXELS):
                        live += state[_LIVE + q]
                    if live == 0.0:
                        break
            for q in range(PIXELS):
                row = y0 - above + q // BLOCK
                column = x0 - left + q % BLOCK
                for channel in range(3):
                    value = state[(1 + channel) * PIXELS + q] + state[_LIGHT + q] * background[channel]
                    image[number, row, column, channel] = min(1.0, max(0.0, value))
    # the owner of the borrowed state lives to here
    return state_.size


@njit(cache=True, parallel=True, error_model="numpy")
def _rasterise(wanted, offsets, entries, record, box, camera, rules, background, tile, threads, image):
    """Blend the tiles ``wanted`` into ``image`` [t, tile, tile, 3]."""
    sequence = longest_first(wanted, offsets)
    counter = np.zeros(1, np.int64)
    for _ in prange(threads):
        _rasterise_worker(
            sequence, counter, wanted, offsets, entries, record, box, camera, rules, background, tile, image
        )


def camera_array(camera: Camera) -> np.ndarray:
    """Intrinsics and size in the order the kernels expect."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, float(camera.width), float(camera.height)])


class Renderer:
    """Renders one scene; keeps its buffers between calls.

    Args:
        splats: The activated scene.
        rasteriser: The rules.
    """

    def __init__(self, splats: Splats, rasteriser: Rasteriser) -> None:
        n = splats.count
        self.splats = splats
        self.rules = rules_array(rasteriser)
        self.side = rasteriser.work_tile
        self._record = np.empty((n, _COLUMNS))
        self._box = np.empty((n, 4))
        self._tiles = np.empty((n, 4), np.int32)
        self._depth = np.empty(n)
        self._visible = np.empty(n, np.uint8)

    def tiles(
        self,
        camera: Camera,
        rotation: np.ndarray,
        position: np.ndarray,
        wanted: np.ndarray | None = None,
        member: Splats | None = None,
    ) -> np.ndarray:
        """The tiles ``wanted`` (numbers, row-major; all if None) as float64 [t, side, side, 3].

        Args:
            camera: Intrinsics and size; its own pose is not used.
            rotation: [3, 3] world to camera, OpenCV axes.
            position: [3] camera position, world.
            member: What to show in place of the scene: as many Gaussians, of the same degree.
        """
        splats = self.splats if member is None else member
        across, down = tile_grid(camera, self.side)
        if wanted is None:
            wanted = np.arange(across * down)
        offsets, entries = self.lists(splats, camera, rotation, position, wanted)
        return self._blend(camera, wanted, offsets, entries, self._record, splats.background)

    def lists(
        self, splats: Splats, camera: Camera, rotation: np.ndarray, position: np.ndarray, wanted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Project every Gaussian; offsets and entries of the lists of the tiles ``wanted``, nearest first."""
        _project(
            splats.means, splats.axes, splats.opacity, splats.sh, splats.degree, splats.color_shift,
            splats.color_max, np.ascontiguousarray(rotation, np.float64), np.ascontiguousarray(position, np.float64),
            camera_array(camera), self.rules, splats.antialiased, self.side, self._record, self._box, self._tiles,
            self._depth, self._visible,
        )  # fmt: skip
        across, down = tile_grid(camera, self.side)
        mask = tile_mask(wanted, across * down)
        seen = np.flatnonzero(self._visible)
        if not mask.all():
            seen = touching(seen, self._tiles, mask, across)
        return tile_lists(depth_order(seen, self._depth), self._tiles, mask, across)

    def _blend(
        self,
        camera: Camera,
        wanted: np.ndarray,
        offsets: np.ndarray,
        entries: np.ndarray,
        record: np.ndarray,
        background: np.ndarray,
    ) -> np.ndarray:
        image = np.zeros((len(wanted), self.side, self.side, 3))
        _rasterise(
            np.asarray(wanted, np.int64), offsets, entries, record, self._box, camera_array(camera), self.rules,
            background, self.side, get_num_threads(), image,
        )  # fmt: skip
        return image

    def image(
        self, camera: Camera, rotation: np.ndarray, position: np.ndarray, member: Splats | None = None
    ) -> np.ndarray:
        """The whole image, float64 [H, W, 3] in [0, 1]; see `tiles`."""
        return assemble(self.tiles(camera, rotation, position, member=member), camera)

    def layers(
        self, camera: Camera, rotation: np.ndarray, position: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What Splatfacto outputs in evaluation (splatfacto.py:620-665; gsplat's render mode RGB+ED).

        Returns:
            Image [H, W, 3] and accumulation [H, W, 1] in [0, 1]; expected depth [H, W, 1], the largest
            one of the image where nothing is hit.
        """
        across, down = tile_grid(camera, self.side)
        wanted = np.arange(across * down)
        offsets, entries = self.lists(self.splats, camera, rotation, position, wanted)
        image = self._blend(camera, wanted, offsets, entries, self._record, self.splats.background)
        # the same weights, with depths as colours; the blending clamps to [0, 1]
        seen = self._visible.astype(bool)
        farthest = max(float(self._depth[seen].max(initial=0.0)), 1e-300)
        record = self._record.copy()
        record[seen, _RED] = 1.0
        record[seen, _RED + 1] = self._depth[seen] / farthest
        record[seen, _RED + 2] = 0.0
        sums = assemble(self._blend(camera, wanted, offsets, entries, record, np.zeros(3)), camera)
        accumulation = sums[..., :1]
        depth = farthest * sums[..., 1:2] / np.maximum(accumulation, 1e-10)
        return assemble(image, camera), accumulation, np.where(accumulation > 0.0, depth, depth.max())
