"""The demonstration scenes, from arrays that ship with the package; scripts in `benchmarks/` made these."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, look_at, path_json
from ns_abstract.io.arrays import open_archive
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.hash_field import DenseNet, HashEncoding, NerfactoField, NerfactoScene, ProposalField
from ns_abstract.methods.nerf.scene import Encoding, FieldWeights, Layer, NerfScene
from ns_abstract.methods.splat.scene import SplatScene

#: Part of the package: scenes, and the gate's network and loop.
DATA = Path(__file__).parent
_FIX = "install the package again"
#: Nerfstudio's encodings of positions and directions, and the columns that they have.
_POSITION, _DIRECTION = Encoding(10, 0.0, 8.0), Encoding(4, 0.0, 4.0)
#: Width and layers of the base of Nerfstudio's field, the layer that takes the encoding again, and the head's width.
_WIDTH, _LAYERS, _SKIP, _HEAD = 256, 8, 4, 128


#: abstract-nerfacto as the buoy's was trained, and its units by one of the buoy.
NERFACTO_SCALE = 0.8
_INIT_DENSITY, _NERFACTO_SAMPLES, _NERFACTO_FAR = 0.01, (64, 32, 24), 4.0


class _ArchiveUnpickler(Protocol):
    """Reads an array of a type and shape; None stands for any length."""

    def __call__(self, name: str, kind: type, *shape: int | None) -> NDArray[Any]: ...


@contextmanager
def _stored(file: Path) -> Iterator[_ArchiveUnpickler]:
    """Open an archive of the package.

    Raises:
        InputError: The file cannot be read, or an array is missing, has another type or shape, or is not finite.
    """
    with open_archive(file, "scene", _FIX) as archive:

        def read(name: str, kind: type, *shape: int | None) -> NDArray[Any]:
            if name not in archive.declared:
                raise InputError("is missing", field=name)
            stored_shape, stored = archive.declared[name]
            wanted = tuple(m if n is None else n for n, m in zip(shape, stored_shape, strict=False))
            if stored != kind or stored_shape != wanted or len(stored_shape) != len(shape):
                raise InputError(f"{stored}{list(stored_shape)}, not {kind.__name__}{list(shape)}", field=name)
            values = archive.read(name)
            if not np.isfinite(values).all():
                raise InputError("not finite", field=name)
            return values

        yield read


def splat_scene(name: str, file: Path | None = None) -> SplatScene:
    """Return the scene of the airfield or of the gate.

    The airfield: an airliner on short final over a small airfield, 17,564 Gaussians with spherical harmonics of
    degree 2; z is up, the runway lies along x. The gate: a ring on two posts on a meadow, 75 wide Gaussians, no two of
    them equally far along x, which is the course of a drone.

    Raises:
        InputError: The file is damaged.
    """
    with _stored(file or DATA / f"{name}.npz") as read:
        sh = read("sh", np.float32, None, None, 3)
        n = len(sh)
        return SplatScene(
            means=read("means", np.float32, n, 3),
            log_scales=read("log_scales", np.float32, n, 3),
            quats=read("quats", np.float32, n, 4),
            opacity_logits=read("opacity_logits", np.float32, n),
            sh=sh,
            sh_degree=round(sh.shape[1] ** 0.5) - 1,
            background=read("background", np.float32, 3),
            name=name,
        )


def buoy_weights(file: Path = DATA / "buoy.npz") -> FieldWeights:
    """Return a field of Nerfstudio's own size (8 x 256) that was fitted to a buoy on a round float.

    Args:
        file: Holds biases in float32, and matrices in int8 beside ``NAME.scale`` [rows, 1] in float32.

    Raises:
        InputError: The file is damaged.
    """
    with _stored(file) as read:

        def layer(name: str, rows: int, columns: int, skip: bool = False) -> Layer:
            weight = read(f"{name}.weight", np.int8, rows, columns)
            scale = read(f"{name}.weight.scale", np.float32, rows, 1)
            return Layer(weight * scale, read(f"{name}.bias", np.float32, rows), skip)

        position, direction = _POSITION.size, _DIRECTION.size
        widths = [position, *(_WIDTH + (position if i == _SKIP else 0) for i in range(1, _LAYERS))]
        return FieldWeights(
            tuple(layer(f"base.{i}", _WIDTH, width, i == _SKIP) for i, width in enumerate(widths)),
            layer("density", 1, _WIDTH),
            (layer("head.0", _HEAD, _WIDTH + direction), layer("head.1", _HEAD, _HEAD)),
            layer("color", 3, _HEAD),
            _POSITION,
            _DIRECTION,
        )


def buoy_scene() -> NerfScene:
    """Return a NeRF of Nerfstudio's own size that shows the buoy."""
    weights = buoy_weights()
    return NerfScene(weights, weights, background=np.array([1.0, 1.0, 1.0], np.float32), name="buoy")


def nerfacto_scene(file: Path = DATA / "buoy_nerfacto.npz") -> NerfactoScene:
    """Return a small nerfacto of the buoy, which Nerfstudio trained on pictures of it.

    Args:
        file: Holds networks in float32, and tables in int8 beside ``NAME.scale`` [levels, 1, 1] in float32.

    Raises:
        InputError: The file is damaged.
    """
    with _stored(file) as read:

        def grid(name: str) -> HashEncoding:
            table = read(f"{name}.table", np.int8, None, None, 2)
            scale = read(f"{name}.scale", np.float32, len(table), 1, 1)
            sizes = read(f"{name}.resolutions", np.int64, len(table))
            # float32, as the checkpoint that is written
            return HashEncoding((table * scale).astype(np.float64), sizes)

        def net(name: str, layers: int, inputs: int) -> DenseNet:
            weights, biases = [], []
            for k in range(layers):
                weights.append(read(f"{name}.{k}.weight", np.float32, None, inputs).astype(np.float64))
                inputs = len(weights[-1])
                biases.append(read(f"{name}.{k}.bias", np.float32, inputs).astype(np.float64))
            return DenseNet(tuple(weights), tuple(biases))

        def proposal(name: str) -> ProposalField:
            encoding = grid(name)
            return ProposalField(encoding, net(name, 2, encoding.size), _INIT_DENSITY)

        encoding = grid("field")
        density = net("density", 2, encoding.size)
        # 16 harmonics of the direction, and what the first network says beside the density
        color = net("color", 3, 15 + len(density.biases[-1]))
        rounds = proposal("proposal0"), proposal("proposal1")
    field = NerfactoField(
        encoding, density, color, _INIT_DENSITY, rounds, _NERFACTO_SAMPLES, far=_NERFACTO_FAR, background=np.zeros(3)
    )
    return NerfactoScene(field, name="buoy-nerfacto")


def nerfacto_path(size: int = 16) -> dict[str, Any]:
    """Return the view of `buoy_path` for nerfacto, with a set of yaws of up to 0.0001 rad."""
    return _buoy_path(size, NERFACTO_SCALE, 0.0001)


def buoy_views(count: int = 8, size: int = 64, scale: float = 1.0) -> list[KeyframeCamera]:
    """Return views all around the buoy for the run's data set; ``scale``: the run's units by one of the buoy."""
    angles = 2.0 * np.pi * np.arange(count) / count
    eyes = [(scale * 3.2 * np.cos(a), scale * 3.2 * np.sin(a), scale * 1.2) for a in angles]
    return [KeyframeCamera(look_at(eye, (0.0, 0.0, scale * 0.1)), 40.0, size, size) for eye in eyes]


def buoy_path(size: int = 16) -> dict[str, Any]:
    """Return one small view of the buoy, with a set of yaws of up to 0.002 rad."""
    return _buoy_path(size, 1.0, 0.002)


def _buoy_path(size: int, scale: float, yaw: float) -> dict[str, Any]:
    eye = tuple(scale * place for place in (2.6, -1.8, 1.2))
    view = KeyframeCamera(look_at(eye, (0.0, 0.0, scale * 0.1)), 40.0, size, size)
    return path_json([view], seconds=1.0, perturbation={"version": 1, "rotation": {"yaw": yaw}})
