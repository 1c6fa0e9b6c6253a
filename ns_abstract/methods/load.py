"""Open a run of any supported method."""

from __future__ import annotations

import os
from pathlib import Path

from ns_abstract.methods import runs
from ns_abstract.methods.nerf.load import holds_nerf, load_nerf
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.scene import SplatScene


def load_any(path: str | os.PathLike[str]) -> SplatScene | NerfScene:
    """Read the scene of a run (by the method that its config.yml names) or of a 3DGS ``.ply``.

    Raises:
        InputError: For any content of the files that cannot be used.
    """
    if not os.path.isdir(path) and Path(path).suffix.lower() not in (".yml", ".yaml"):
        return load_scene(path)
    run = runs.read_config(path)
    return load_nerf(run) if holds_nerf(run) else load_scene(path)
