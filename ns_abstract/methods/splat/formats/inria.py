"""Folders of Inria's 3-D Gaussian splatting: ``point_cloud/iteration_N/point_cloud.ply`` and ``cfg_args``.

``cfg_args`` is the text of a Python ``Namespace``; its literals are parsed, nothing is evaluated.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import read_text, unusable

ARGUMENTS = "cfg_args"
_LIMIT = 2**16
_FIX = "copy cfg_args again, or give the .ply outside this folder with --background"
_BACKGROUNDS = {True: (1.0, 1.0, 1.0), False: (0.0, 0.0, 0.0)}


def point_cloud(folder: Path, iteration: int | None) -> Path:
    """Return .ply of a trained folder: of ``iteration``, or of the last one. Raises InputError where there is none."""
    clouds = {}
    outer = folder / "point_cloud"
    for inner in outer.iterdir() if outer.is_dir() else ():
        match = re.fullmatch(r"iteration_(\d{1,12})", inner.name)
        if match is not None and (inner / "point_cloud.ply").is_file():
            clouds[int(match[1])] = inner / "point_cloud.ply"
    if iteration is None and clouds:
        return clouds[max(clouds)]
    if iteration not in clouds:
        there = f"there are {', '.join(map(str, sorted(clouds)[:20]))}" if clouds else "there are none"
        what = "point_cloud.ply" if iteration is None else f"iteration_{iteration}/point_cloud.ply"
        raise InputError(f"no {what}: {there}", file=outer, fix="give --load-step one of these, or the .ply itself")
    return clouds[iteration]


def arguments_beside(ply: Path) -> Path | None:
    """Return the ``cfg_args`` of the folder that a .ply was trained in; None where it lies elsewhere."""
    place = ply.absolute()
    if place.name != "point_cloud.ply" or not place.parent.name.startswith("iteration_"):
        return None
    file = place.parents[2] / ARGUMENTS
    return file if file.is_file() else None


def read_arguments(file: Path) -> dict[str, Any]:
    """Return names and literals of ``cfg_args``. Raises InputError where it is not a Namespace of literals."""
    text = read_text(file, ARGUMENTS, _LIMIT)
    try:
        call = ast.parse(text.strip(), mode="eval").body
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.func.id != "Namespace":
            raise ValueError("no Namespace")
        if call.args or any(keyword.arg is None for keyword in call.keywords):
            raise ValueError("values without names")
        return {str(keyword.arg): ast.literal_eval(keyword.value) for keyword in call.keywords}
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        raise InputError("not the text of a Namespace of literals", file=file, fix=_FIX) from None


def background(arguments: dict[str, Any], file: Path) -> tuple[float, float, float] | None:
    """Return the colour behind the scene; None where the arguments do not state it.

    Raises:
        InputError: It is neither True nor False.
    """
    white = arguments.get("white_background")
    if white is not None and not isinstance(white, bool):
        raise unusable(white, file=file, field="white_background", fix="write True or False")
    return None if white is None else _BACKGROUNDS[white]
