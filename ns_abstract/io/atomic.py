"""Atomic writes: other programs see a file whole or not at all."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from ns_abstract.io.folder import require_held


def write_atomic(
    path: str | os.PathLike[str], write: Callable[[BinaryIO], object], *, scratch: Path | None = None
) -> None:
    """Write a file under a temporary name on the same file system, then move it into place.

    Whoever opens ``path`` sees the old file or the whole new one, also after a crash, a kill or a loss of power between
    the two. ``scratch``: folder of the temporary file, on the same file system; the file's own by default. Raises
    OSError: the folder cannot be written, or is another one than this process has locked; ``path`` is as before.
    """
    path = Path(path)
    require_held(path)
    temporary = (scratch or path.parent) / f".{path.name}.{secrets.token_hex(4)}.part"
    try:
        with open(temporary, "xb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write text as UTF-8; errors as for `write_atomic`.

    A name of a file that is no UTF-8 has surrogates in Python, which stand as escapes that JSON reads back.
    """
    write_atomic(path, lambda stream: stream.write(text.encode(errors="backslashreplace")))


def write_json(path: str | os.PathLike[str], value: Any) -> Path:
    """Write a value as JSON that people can read, and return the file.

    Raises OSError: as `write_atomic`. Raises TypeError: JSON has no such value.
    """
    text = json.dumps(value, indent=1) + "\n"
    write_text(path, text)
    return Path(path)
