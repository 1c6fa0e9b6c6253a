"""Bounds of a path in formats that other programs read: OpenEXR pictures and safetensors."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError
from ns_abstract.report.export import Results
from ns_abstract.report.files import IMAGES, LEAVES, frame_name, load_frame


def optional_package(module: str, extra: str, command: str) -> ModuleType:
    """Return the imported ``module``, which the extra ``extra`` installs.

    Raises:
        InputError: It is missing; the error names the line for pip.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        fix = f"pip install 'ns-abstract[{extra}]'"
        raise InputError(f"needs the package {module.partition('.')[0]}", field=command, fix=fix) from None


def write_exr(results: Results, folder: Path) -> list[Path]:
    """Write ``frame_00000.exr`` for every frame, and return the files.

    Its parts ``lower``, ``upper``, ``witness_lower``, ``witness_upper`` and ``image`` hold RGB as float32, bit for bit
    those of the npz: display-referred values in [0, 1], not linear light.

    Raises:
        InputError: The package OpenEXR is missing.
    """
    exr: Any = optional_package("OpenEXR", "exr", "exr")
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for result in results:  # pyright: ignore[reportGeneralTypeIssues]
        header = {
            "compression": exr.ZIP_COMPRESSION,
            "type": exr.scanlineimage,
            "comments": "display-referred values in [0, 1] as the renderer returns them, not linear light",
        }
        parts = [exr.Part(dict(header), {"RGB": np.ascontiguousarray(getattr(result, n))}, n) for n in IMAGES]
        file = folder / frame_name(result.index, "exr")
        # the library writes to a name, not to a stream
        scratch = folder / f".{file.name}.part.exr"
        try:
            exr.File(parts).write(str(scratch))
            scratch.replace(file)
        finally:
            scratch.unlink(missing_ok=True)
        files.append(file)
    return files


def write_safetensors(results: Results, folder: Path) -> list[Path]:
    """Write ``frame_00000.safetensors`` for every frame, and return the files.

    They hold the arrays of the npz by the same names: the bounds, and of leaf cells ``box_lower``, ``box_upper``,
    ``tile``, ``A_lower``, ``b_lower``, ``A_upper`` and ``b_upper``. The metadata are texts: ``format``,
    ``guarantee``, and ``parameters`` as JSON.

    Raises:
        InputError: The package safetensors is missing, or a frame keeps no linear sets.
    """
    safetensors: Any = optional_package("safetensors.numpy", "safetensors", "safetensors")
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for place, (index, source) in enumerate(results.files.items()):
        stored = load_frame(source)
        leaves = stored.result.leaves
        if leaves is None:
            raise InputError("keeps no linear sets", file=source, fix="run ns-abstract-render with --save-cells")
        arrays = {name: np.ascontiguousarray(getattr(stored.result, name)) for name in IMAGES}
        arrays |= {name: np.ascontiguousarray(getattr(leaves, name)) for name in LEAVES}
        about = {
            "format": "ns-abstract frame 1",
            "guarantee": str(stored.about.get("guarantee", "unknown")),
            "parameters": json.dumps(results.parameters[place]),
        }
        content = safetensors.save(arrays, about)
        file = folder / frame_name(index, "safetensors")
        write_atomic(file, lambda stream, content=content: stream.write(content))
        files.append(file)
    return files
