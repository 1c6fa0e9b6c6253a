"""One frame of a nerfacto, ready for refinement and certificates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ns_abstract.execution.cancellation import WorkCancelledError
from ns_abstract.execution.threads import each
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.nerf.frame import FieldFrame
from ns_abstract.methods.nerf.hash_bounds.bounds import HashBounds
from ns_abstract.methods.nerf.hash_field import NerfactoScene
from ns_abstract.methods.nerf.nerfacto_render import NerfactoRenderer
from ns_abstract.methods.nerf.ray_field import RayBounds

#: Rays that are bounded together, and shares of a worker between two looks at the goal. Preferences.
_SHARE, _SHARES = 4, 4


class NerfactoFrame(FieldFrame):
    """Bounds and renders one frame's set of poses of a nerfacto.

    Args:
        workers: Threads that bound rays side by side; results do not depend on their number.
    """

    def __init__(self, scene: NerfactoScene, pose_set: PoseBox, workers: int = 1) -> None:
        bounds = HashBounds(scene.field, pose_set.geometry.box.dimensions)
        at_once = workers * _SHARE * _SHARES
        super().__init__(pose_set, NerfactoRenderer(scene.field), bounds, _SHARE, at_once, workers)

    def _tried(self, calls: Sequence[Sequence[Any]]) -> list[RayBounds | None]:
        """See `FieldFrame`; in threads."""

        def bounded(call: Sequence[Any]) -> RayBounds | None:
            try:
                return self.bounds.rays(*call)
            except WorkCancelledError:
                return None

        return each(bounded, calls) if self.workers > 1 else [bounded(call) for call in calls]
