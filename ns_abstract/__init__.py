"""Sound bounds of what Nerfstudio renders over sets of camera poses, and certificates of networks behind them.

The public names; each is imported when it is first used.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING

from ns_abstract.io import version as _version

if TYPE_CHECKING:
    from ns_abstract.api.abstract_image import BoundResult
    from ns_abstract.api.bounding import Progress, bound
    from ns_abstract.api.certifying import Certificate, CertifiedCell, CertifyProgress, certify
    from ns_abstract.api.checking import Audit, check
    from ns_abstract.api.comparing import Comparison, compare
    from ns_abstract.api.locating import Located, LocatedCell, LocateProgress, locate
    from ns_abstract.api.poses import Camera, PoseSet
    from ns_abstract.api.reaching import ReachCell, ReachProgress, ReachResult, reach
    from ns_abstract.api.scenes import Scene, load_scene, render
    from ns_abstract.geometry.camera_path import CameraPath, load_camera_path
    from ns_abstract.io.errors import InputError
    from ns_abstract.report.progress import ProgressBar

__version__ = _version.VERSION

_HOMES = {
    "api.bounding": ("BoundResult", "Progress", "bound"),
    "api.certifying": ("Certificate", "CertifiedCell", "CertifyProgress", "certify"),
    "api.checking": ("Audit", "check"),
    "api.comparing": ("Comparison", "compare"),
    "api.locating": ("Located", "LocatedCell", "LocateProgress", "locate"),
    "api.poses": ("Camera", "PoseSet"),
    "api.reaching": ("ReachCell", "ReachProgress", "ReachResult", "reach"),
    "api.scenes": ("Scene", "load_scene", "render"),
    "geometry.camera_path": ("CameraPath", "load_camera_path"),
    "io.errors": ("InputError",),
    "report.progress": ("ProgressBar",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Audit",
    "BoundResult",
    "Camera",
    "CameraPath",
    "Certificate",
    "CertifiedCell",
    "CertifyProgress",
    "Comparison",
    "InputError",
    "LocateProgress",
    "Located",
    "LocatedCell",
    "PoseSet",
    "Progress",
    "ProgressBar",
    "ReachCell",
    "ReachProgress",
    "ReachResult",
    "Scene",
    "__version__",
    "bound",
    "certify",
    "check",
    "compare",
    "load_camera_path",
    "load_scene",
    "locate",
    "reach",
    "render",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return globals()[name]


class _Interface(ModuleType):
    """This package; importing a folder of the same name as a function (check, reach) does not take its place."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Interface


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
