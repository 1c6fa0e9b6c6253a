"""The frame of a run against that of its data set."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DataparserTransform:
    """Maps the units of transforms.json to the normalised frame of the run.

    ``x_normalised = scale * (matrix[:, :3] @ x_dataset + matrix[:, 3])``
    (nerfstudio/data/dataparsers/base_dataparser.py, ``DataparserOutputs``). ``stated``: whether the scene says so; the
    identity stands for what it does not say.
    """

    matrix: NDArray[np.float64] = field(default_factory=lambda: np.eye(3, 4))  # [3, 4]
    scale: float = 1.0
    stated: bool = True

    @property
    def stated_scale(self) -> float | None:
        """Normalised units per unit of the data set; None: the scene does not say."""
        return self.scale if self.stated else None

    def pose(self, camera_to_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """A pose [4, 4] of the data set in the run's frame, [3, 4]."""
        moved = self.matrix @ camera_to_world
        moved[:, 3] *= self.scale
        return moved
