"""Keeps numba from loading kernels that were compiled from other sources of this package.

numba keeps compiled code by the file of each function alone, but that code holds the functions and constants of other
modules, too: after an update of one of them it would compute with both versions.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from numba.core import caching

PACKAGE = Path(__file__).resolve().parents[1]
#: Folders of the package that kernels lie in or use.
FOLDERS = ("arithmetic", "sets", "methods")


@cache
def source_key() -> str:
    """Hash of the names and contents of all sources that kernels may use."""
    found = hashlib.sha256()
    for path in sorted(path for folder in FOLDERS for path in (PACKAGE / folder).rglob("*.py")):
        found.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()


def _stamped(locator: Any) -> Any:
    stamp = _by_file(locator)
    inside = any(PACKAGE / folder in Path(locator._py_file).resolve().parents for folder in FOLDERS)
    return (stamp, source_key()) if inside else stamp


_by_file = caching._SourceFileBackedLocatorMixin.get_source_stamp
caching._SourceFileBackedLocatorMixin.get_source_stamp = _stamped  # pyright: ignore[reportAttributeAccessIssue]
