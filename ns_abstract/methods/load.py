"""Open a run of any supported method."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ns_abstract.io.errors import InputError
from ns_abstract.methods import runs
from ns_abstract.methods.nerf.representation import NERF, NERFACTO
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.representation import Representation
from ns_abstract.methods.splat.formats.readers import scene_file
from ns_abstract.methods.splat.method import SPLAT

#: What is asked in turn; the last one explains what it cannot read.
REPRESENTATIONS: list[Representation] = [NERF, NERFACTO, SPLAT]


def open_scene(path: str | os.PathLike[str], overrides: Overrides | None = None) -> tuple[Representation, Any]:
    """Read the scene of a run (by the method that its config.yml names) or of a 3DGS ``.ply``.

    Returns the representation, and its scene. Raises InputError: for any content of the files that cannot be used.
    """
    source: runs.RunConfig | Path = Path(path)
    folder = os.path.isdir(path) and scene_file(Path(path), None) is None
    if folder or Path(path).suffix.lower() in (".yml", ".yaml"):
        source = runs.read_config(path)
    for representation in REPRESENTATIONS:
        if representation.reads(source):
            return representation, representation.load(source, overrides or Overrides())
    raise InputError(
        "holds no scene known here", file=str(path), fix="give config.yml of a run, or a scene file such as a .ply"
    )


def load_any(path: str | os.PathLike[str], overrides: Overrides | None = None) -> Any:
    """Return the scene alone; see `open_scene`."""
    return open_scene(path, overrides)[1]
