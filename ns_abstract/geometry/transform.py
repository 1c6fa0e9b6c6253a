"""The transform from a data set's frame to the normalised frame of a run."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.jsonio import InputTuning


@dataclass(frozen=True)
class DataparserTransform:
    """Maps the units of transforms.json to the normalised frame of the run.

    ``x_normalised = scale * (matrix[:, :3] @ x_dataset + matrix[:, 3])``
    (nerfstudio/data/dataparsers/base_dataparser.py, ``DataparserOutputs``). ``stated``: whether the scene states it; if
    not, it is the identity. ``original``: whether the data set is COLMAP's own, from which a transforms.json differs by
    its applied_transform.
    """

    matrix: NDArray[np.float64] = field(default_factory=lambda: np.eye(3, 4))  # [3, 4]
    scale: float = 1.0
    stated: bool = True
    original: bool = False

    @property
    def stated_scale(self) -> float | None:
        """Normalised units per unit of the data set, with a scale of the matrix; None: not stated, or no one scale."""
        rotation = self.matrix[:, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            square = float((rotation**2).sum()) / 3.0
            apart = np.abs(rotation.T @ rotation - square * np.eye(3)).max()
        if not (self.stated and apart <= InputTuning.rotation * square < np.inf):
            return None
        length = square**0.5
        # a rotation of float32 is one
        return self.scale if abs(length - 1.0) <= InputTuning.rotation else self.scale * length

    def pose(self, camera_to_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a pose [4, 4] of the data set in the run's frame, [3, 4]."""
        moved = self.matrix @ camera_to_world
        moved[:, 3] *= self.scale
        return moved
