"""Pictures divided into square tiles, row by row; tiles may extend past the right and lower edge."""

from __future__ import annotations

import numpy as np

from ns_abstract.geometry.camera_path import PinholeCamera


def tile_grid(camera: PinholeCamera, side: int) -> tuple[int, int]:
    """Return numbers of tiles across and down of a camera's picture, for tiles of ``side`` pixels."""
    return -(-camera.width // side), -(-camera.height // side)


def in_tiles(image: np.ndarray, side: int) -> np.ndarray:
    """Return the tiles [T, side, side, ...] of an image [H, W, ...] in row-major order, with 0 beyond its edges."""
    height, width, *rest = image.shape
    down, across = -(-height // side), -(-width // side)
    padded = np.zeros((down * side, across * side, *rest), image.dtype)
    padded[:height, :width] = image
    return padded.reshape(down, side, across, side, *rest).swapaxes(1, 2).reshape(-1, side, side, *rest)


def assemble(tiles: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Return a new image [H, W, ...] from all its tiles [T, side, side, ...] in row-major order."""
    across, _ = tile_grid(camera, tiles.shape[1])
    image = np.ascontiguousarray(laid_out(tiles, across)[: camera.height, : camera.width])
    # one column of tiles is a view of their memory
    return image.copy() if np.may_share_memory(image, tiles) else image


def laid_out(tiles: np.ndarray, across: int) -> np.ndarray:
    """Return all pixels [rows, columns, ...] of row-major tiles [T, side, side, ...], ``across`` tiles in a row."""
    side, rest = tiles.shape[1], tiles.shape[3:]
    down = len(tiles) // across
    grid = tiles.reshape(down, across, side, side, *rest).swapaxes(1, 2)
    return grid.reshape(down * side, across * side, *rest)
