"""Result folders: locked for one command at a time; files that this program did not write are never touched."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import stat
import weakref
from pathlib import Path
from typing import BinaryIO

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import load_json

#: Lock file that marks a result folder; it is locked while a command writes there.
MARK = ".ns-abstract.lock"
#: Names of results; see files.py and verdict_picture.py of `ns_abstract.report`, and `ns_abstract.verify.store`.
_RESULT = re.compile(
    r"frame_\d{5,}\.(npz|png)|report\.(json|html)|cells\.sqlite(-wal|-shm)?|verdicts_(\d{5,}|path)\.(svg|png)|cameras\.(svg|png)"
)
#: Names of images of counterexamples, in a folder below.
_IMAGE = re.compile(r"frame_\d{5,}_(pose|\d[\d_-]*)(_\d+)?\.npz")
#: The film of a loop.
_FILM = re.compile(r"film(_\d+)?\.(mp4|gif)")
#: Names of unfinished results of killed commands; see `ns_abstract.io.atomic`.
_PART = re.compile(rf"\.({_RESULT.pattern}|{_IMAGE.pattern}|{_FILM.pattern})\.[0-9a-f]{{8}}\.part")
#: Keys that report.json of every command has.
_REPORT_KEYS = {"version", "guarantee", "fingerprint", "command"}
_REPORT_LIMIT = 2**30
_FULL = "make room there and --resume, or choose a folder on another disk; finished results are kept"
_FIXES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _FULL),
    **dict.fromkeys((errno.ENOTDIR, errno.EEXIST, errno.EISDIR), "name a folder, not a file or what is below one"),
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ESTALE: "run the command again, and leave its folder where it is",
}


class LockedFolder:
    """A result folder that this process has locked; open until `close`, or the end of a ``with`` statement."""

    def __init__(self, folder: Path, lock: BinaryIO) -> None:
        self.folder, self._lock = folder.absolute(), lock
        self._folder_stat = os.stat(folder)
        _held.add(self)

    def holds(self) -> bool:
        """Whether the folder is still the one that was locked, and no other command has locked it anew."""
        if not os.path.samestat(os.stat(self.folder), self._folder_stat):
            return False
        try:
            return os.path.samestat(os.lstat(self.folder / MARK), os.fstat(self._lock.fileno()))
        except FileNotFoundError:
            return True

    def close(self) -> None:
        """Unlock the folder."""
        _held.discard(self)
        self._lock.close()

    def __enter__(self) -> LockedFolder:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


#: The folders that this process has locked.
_held: weakref.WeakSet[LockedFolder] = weakref.WeakSet()


def require_held(file: Path) -> None:
    """Raise OSError if ``file`` lies in a folder that this process locked and that was removed or replaced since."""
    within = file.absolute().parents
    for one in list(_held):
        if one.folder in within and not one.holds():
            raise OSError(errno.ESTALE, "the folder was removed or replaced since the command began")


def claim(folder: Path) -> LockedFolder:
    """Create a result folder, or take one over, for one command.

    Returns the claim; the folder is locked until it is closed, or its process ends. Raises InputError where another
    command writes there, the folder cannot be written, or files that this program did not write stand where results
    would.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _refuse_strangers(folder)
        return LockedFolder(folder, _locked(folder))
    except OSError as error:
        raise unwritable(folder, error) from None


def first_command(folder: Path) -> list[str] | None:
    """Return the words of the command that began the results in a folder's report.json; None: not readable."""
    try:
        document = load_json(folder / "report.json", "report", _REPORT_LIMIT)
    except InputError:
        return None
    command = (document.get("first_command") or document.get("command")) if isinstance(document, dict) else None
    return command if isinstance(command, list) and all(isinstance(word, str) for word in command) else None


def _refuse_strangers(folder: Path) -> None:
    if (folder / MARK).exists():
        return
    results = sorted(entry.name for entry in os.scandir(folder) if _RESULT.fullmatch(entry.name))
    if results and not _is_report(folder / "report.json"):
        raise InputError(
            f"{results[0]} stands there and was not written by this program",
            file=folder,
            field="--output-dir",
            fix="choose another folder, or move it away",
        )


def _is_report(file: Path) -> bool:
    try:
        content = load_json(file, "report", limit=_REPORT_LIMIT)
    except InputError:
        return False
    return isinstance(content, dict) and (content.keys() >= _REPORT_KEYS or content.get("kind") == "sequence")


def _locked(folder: Path) -> BinaryIO:
    # a link would make another file of it
    descriptor = os.open(folder / MARK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    stream = os.fdopen(descriptor, "r+b")
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise InputError(
            "locked by a command that is still running",
            file=folder,
            field="--output-dir",
            fix="wait for it, or choose another folder",
        ) from None
    return stream


def remove_parts(folder: Path) -> None:
    """Remove unfinished results of killed commands; the folder, or the one above it, must be locked."""
    for entry in list(os.scandir(folder)):
        if _PART.fullmatch(entry.name) and stat.S_ISREG(entry.stat(follow_symlinks=False).st_mode):
            Path(entry.path).unlink(missing_ok=True)


def unwritable(folder: Path, error: OSError) -> InputError:
    """Return the error for results that cannot be written."""
    return InputError(
        f"cannot be written: {error.strerror or type(error).__name__}",
        file=folder,
        field="--output-dir",
        fix=_FIXES.get(error.errno or 0, "choose a folder where files may be made"),
    )
