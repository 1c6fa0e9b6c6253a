"""Compiled kernels, kept between runs in the user's cache folder.

numba keeps compiled code by the file of each function alone, but that code holds functions of other modules, too. Here,
kernels belong to a hash of all sources that they may use, and what is read back is what was written:

* ``ROOT/<hash of the sources>/manifest.json`` names the files of every kernel and their SHA-256;
* ``ROOT/<hash>/blobs/<SHA-256>`` are these files; one that is damaged is dropped, and its kernel compiled again;
* ``ROOT/<hash>/session-<host>-<process>-*`` is where numba reads and writes in one process, and new files are published
  from. Processes that compile for another one share its session: a lock for every kernel keeps two from compiling it.

ROOT is ``$NS_ABSTRACT_CACHE_DIR``, or ``kernels`` in the platform's cache folder; where that cannot be written, a
temporary folder. Kept are kernels that Python calls; they hold what they call (`kernel_linking`). Kernels that an
installation brings along (`shipped_kernels`) are taken where none are kept.
"""

from __future__ import annotations

import glob
import hashlib
import json
import logging
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

import numba
import numba.core.config as settings
import platformdirs
from numba.core.caching import FunctionCache

from ns_abstract.arithmetic import kernel_linking
from ns_abstract.arithmetic.compile_progress import CompileProgress
from ns_abstract.arithmetic.shipped_kernels import adopt, shipped_folder
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError

PACKAGE = Path(__file__).resolve().parents[1]
#: Folders of the package that kernels lie in or use.
FOLDERS = ("arithmetic", "geometry", "methods", "perturbation")
#: Folder of kernels that use these, and themselves alone besides: they do not make the others be compiled again.
OUTER = "verify"
#: Variable that names the folder of compiled kernels.
VARIABLE = "NS_ABSTRACT_CACHE_DIR"
#: Variable that names the session that a process shares; set for processes that compile for another one.
SESSION = "NS_ABSTRACT_KERNEL_SESSION"
#: Versions of the sources whose kernels are kept.
_KEPT = 4
#: Bytes that have to be free where kernels are written.
_FREE = 32 << 20
#: Seconds between two words on progress, and between two times that kernels are published.
_PACE = 5.0

#: What numba asks by default.
_LOCATORS = "UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,IPythonCacheLocator,ZipCacheLocator"

_log = logging.getLogger("ns_abstract.kernels")


@cache
def source_key() -> str:
    """Return the hash of all sources that kernels may use, and of the compiler's version."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(path for folder in FOLDERS for path in (PACKAGE / folder).rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


class KernelMissingError(Exception):
    """Raised inside `KernelStore.complete` for a kernel that is not in the cache."""


class KernelStore:
    """One process' cache, in the folder ``root``, of the kernels of the sources whose hash is ``key``.

    ``session``: the session folder of the process that this one compiles for; None: a folder of its own.

    Raises:
        OSError: ``root`` cannot be written.
    """

    def __init__(self, root: Path, key: str, session: Path | None = None) -> None:
        self._folder = root / key[:32]
        self._sources = [self._folder]
        self._shipped: Path | None = None
        self._blobs = self._folder / "blobs"
        self._blobs.mkdir(parents=True, exist_ok=True)
        owner = f"session-{socket.gethostname()}-{os.getpid()}-"
        # of another version's session nothing can be used
        self.shared = session is not None and session.parent == self._folder and session.is_dir()
        if session is not None and self.shared:
            self.session = session
        else:
            self.session = Path(tempfile.mkdtemp(prefix=owner, dir=self._folder))
        self._claims: dict[str, ExitStack] = {}
        self._complete = False
        self._published: dict[Path, tuple[int, int]] = {}
        self._entries = _read_manifest(self._folder)
        self.compiled, self.functions = 0, 0
        #: When the last function was compiled, by `time.perf_counter`.
        self.latest = 0.0
        self._said = time.monotonic()
        self._progress: CompileProgress | None = None
        self._before = 0
        with suppress(OSError):
            os.utime(self._folder)
        self._clear(root)

    @property
    def empty(self) -> bool:
        """Whether the cache held no kernel of this version when the process began."""
        return not self._entries

    def also_from(self, folder: Path, shipped: bool = False) -> None:
        """Add a read-only ``folder`` from which missing kernels are read; ``shipped``: for a processor level."""
        self._sources.append(folder)
        if shipped:
            self._shipped = folder
        self._entries = _read_manifest(folder) | self._entries

    def fetch(self, place: str, stamp: str) -> str:
        """Return the session's folder for module ``place``, with those of its cached files that are not damaged."""
        folder = self.session / place
        if not folder.exists():
            with _locked(self.session / "lock"):
                if not folder.exists():
                    folder.mkdir(parents=True)
                    self._link(place, stamp)
        return str(folder)

    @contextmanager
    def complete(self) -> Iterator[None]:
        """Return a context in which a kernel that is not cached raises `KernelMissingError` and is not compiled."""
        self._complete = True
        try:
            yield
        finally:
            self._complete = False

    def claim(self, kernel: str, load: Callable[[], Any]) -> Any:
        """Return the kernel that ``load`` finds, after another process compiled it if one does; None: compile it here.

        After None, others wait for this process until it calls `saved`. They do not wait for each other in a circle,
        since kernels do not call each other in one.

        Raises:
            KernelMissingError: It is not cached, inside `complete`.
        """
        loaded = load()
        if loaded is None and self._complete:
            raise KernelMissingError(kernel)
        if loaded is not None or not self.shared or kernel in self._claims:
            return loaded
        claims = self.session / "claims"
        claims.mkdir(exist_ok=True)
        with ExitStack() as stack:
            stack.enter_context(_locked(claims / hashlib.sha256(kernel.encode()).hexdigest()))
            if (loaded := load()) is None:
                self._claims[kernel] = stack.pop_all()
        return loaded

    def saved(self, kernel: str, save: Callable[[], Any]) -> None:
        """Call ``save`` to write a kernel that was compiled here, and release it for the session's other processes."""
        if not self.shared:
            save()
            return
        # the index of a function's kernels is read, changed and written
        with self._claims.pop(kernel, ExitStack()), _locked(self.session / "lock"):
            save()

    def _link(self, place: str, stamp: str) -> None:
        """Link the cached files of module ``place``, of source ``stamp``, into the session's folder."""
        folder = self.session / place
        for name, wanted in self._entries.items():
            if name.rpartition("/")[0] != place or (folder / f"{name.rpartition('/')[2]}.nbi").exists():
                continue
            blobs = {file: blob for file, digest in wanted.items() if (blob := self._blob(digest)) is not None}
            if len(blobs) < len(wanted):
                continue
            for file, blob in blobs.items():
                path = folder / file
                try:
                    os.link(blob, path)
                except OSError:
                    shutil.copyfile(blob, path)
            if any(blob.parent.parent == self._shipped for blob in blobs.values()):
                adopt(folder, name.rpartition("/")[2], stamp)
            self._published |= {folder / file: _stamp(folder / file) for file in blobs}

    def _blob(self, digest: str) -> Path | None:
        for source in self._sources:
            path = source / "blobs" / digest
            with suppress(OSError):
                if hashlib.sha256(path.read_bytes()).hexdigest() == digest:
                    return path
                if source == self._folder:
                    path.unlink()
        return None

    def publish(self) -> None:
        """Add the kernels that this process has compiled to the cache."""
        changed: dict[str, dict[str, str]] = {}
        for index in self.session.rglob("*.nbi"):
            base = index.name.removesuffix(".nbi")
            files = [index, *index.parent.glob(f"{glob.escape(base)}.*.nbc")]
            if len(files) > 1 and any(self._published.get(path) != _stamp(path) for path in files):
                place = index.parent.relative_to(self.session).as_posix()
                changed[f"{place}/{base}"] = {path.name: self._keep(path) for path in files}
        if not changed:
            return
        with _locked(self._folder / "lock"):
            entries = _read_manifest(self._folder) | changed
            text = json.dumps(entries, indent=0).encode()
            write_atomic(self._folder / "manifest.json", lambda stream: stream.write(text))

    def _keep(self, path: Path) -> str:
        self._published[path] = _stamp(path)
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        if not (self._blobs / digest).exists():
            write_atomic(self._blobs / digest, lambda stream: stream.write(content))
        return digest

    def before_saving(self) -> None:
        """Check the disk and count the kernel before a compiled one is written to the session's folder.

        Raises:
            InputError: The disk is full.
        """
        free = shutil.disk_usage(self.session).free
        if free < _FREE:
            raise InputError(
                f"{free >> 20} MiB are left on the disk of the compiled kernels",
                file=self._folder,
                fix=f"free some, or set {VARIABLE} to a folder elsewhere",
            )
        self.compiled += 1

    @contextmanager
    def expecting(self, functions: int, seconds: float) -> Iterator[None]:
        """Return a context that prints progress for about ``functions`` to compile in ``seconds``; 0: not known."""
        self._progress = CompileProgress(functions, seconds, _PACE) if functions else None
        self._before, self._said = self.functions, time.monotonic()
        try:
            yield
        finally:
            self._progress = None

    def function_done(self) -> None:
        """Count one more compiled function, a kernel or one that a kernel calls, for the progress."""
        self.functions += 1
        self.latest = time.perf_counter()
        now = time.monotonic()
        first = self._progress is not None and self.functions == self._before + 1
        if first or now - self._said > _PACE:
            self._said = now
            if self.shared:
                return
            # not after every kernel: it looks at all files of the session
            self.publish()
            if self._progress is None:
                _log.info("compiling kernels (first use only): functions done: %d", self.functions)
            else:
                _log.info(self._progress.line(self.functions - self._before))

    def close(self) -> None:
        """Publish this session's kernels, and remove its folder unless another process owns it."""
        if self.shared:
            return
        with suppress(OSError):
            self.publish()
        shutil.rmtree(self.session, ignore_errors=True)

    def _clear(self, root: Path) -> None:
        """Remove versions not used for long, and sessions of processes that are gone."""
        with suppress(OSError):
            versions = [path for path in root.iterdir() if (path / "blobs").is_dir()]
            versions.sort(key=lambda path: path.stat().st_mtime, reverse=True)
            for path in versions[_KEPT:]:
                if path != self._folder and not any(map(_in_use, path.glob("session-*"))):
                    shutil.rmtree(path, ignore_errors=True)
            for path in self._folder.glob(f"session-{socket.gethostname()}-*"):
                if not _in_use(path):
                    shutil.rmtree(path, ignore_errors=True)


def _read_manifest(folder: Path) -> dict[str, dict[str, str]]:
    """Return a manifest: by function, its files and their SHA-256; empty if the manifest is missing or damaged."""
    try:
        manifest = json.loads((folder / "manifest.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(manifest, dict):
        return {}
    return {name: files for name, files in manifest.items() if _are_files(files)}


def _are_files(files: object) -> bool:
    # names and digests become paths
    return isinstance(files, dict) and all(
        isinstance(name, str)
        and isinstance(digest, str)
        and not set(name + digest) & set("/\0")
        and name.endswith((".nbi", ".nbc"))
        and len(digest) == 64
        for name, digest in files.items()
    )


def _stamp(path: Path) -> tuple[int, int]:
    # numba replaces files, it does not change them
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def _in_use(session: Path) -> bool:
    """Whether the process of a session's folder may still run; true for processes of other machines."""
    host, process = session.name.removeprefix("session-").rsplit("-", 2)[:2]
    return host != socket.gethostname() or not process.isdigit() or _alive(int(process))


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold the lock of a file; where there are no locks the last writer wins, and what it loses is compiled again."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with open(path, "ab") as stream:
        with suppress(OSError):
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def _open() -> KernelStore:
    named = os.environ.get(VARIABLE)
    key = source_key()
    root: Path | None = None
    session = os.environ.get(SESSION)
    try:
        root = Path(named) if named else platformdirs.user_cache_path("ns-abstract") / "kernels"
        return KernelStore(root.absolute(), key, Path(session) if session else None)
    except (OSError, RuntimeError) as error:
        problem = error
    try:
        temporary = Path(tempfile.mkdtemp(prefix="ns-abstract-kernels-"))
        opened_store = KernelStore(temporary, key)
    except OSError as error:
        raise InputError(
            f"no folder for compiled kernels can be written ({error.strerror})",
            fix=f"set {VARIABLE} to a folder that can be written",
        ) from error
    if root is not None:
        opened_store.also_from(root / key[:32])
    # processes that this one starts share it
    os.environ[VARIABLE] = str(temporary)
    process = os.getpid()
    Finalize(None, lambda: os.getpid() == process and shutil.rmtree(temporary, ignore_errors=True), exitpriority=-90)
    reason = getattr(problem, "strerror", None) or problem
    _log.warning(
        "compiled kernels are kept for this run only (%s); set %s to a folder that can be written", reason, VARIABLE
    )
    return opened_store


@cache
def store() -> KernelStore:
    """Return the kernel store of these sources. Raises InputError: no folder can be written."""
    opened_store = _open()
    if (shipped := shipped_folder(PACKAGE, source_key())) is not None:
        opened_store.also_from(shipped, shipped=True)
    process = os.getpid()
    Finalize(None, lambda: os.getpid() == process and opened_store.close(), exitpriority=-80)
    if opened_store.empty:
        _log.info("kernels are compiled at first use, which takes a minute or two")
    return opened_store


@cache
def _kernel_module(file: str) -> tuple[str, str] | None:
    """Return name and source stamp of one of the package's modules that hold kernels; None: it is another file."""
    path = Path(file).resolve()
    if not any(PACKAGE / folder in path.parents for folder in (*FOLDERS, OUTER)):
        return None
    outer = hashlib.sha256(path.read_bytes()).hexdigest() if PACKAGE / OUTER in path.parents else ""
    return path.relative_to(PACKAGE).with_suffix("").as_posix(), source_key() + outer


class KernelLocator:
    """numba's cache locator for this package's kernels: names the folder of their files."""

    def __init__(self, py_func: Any, place: str, stamp: str) -> None:
        self._line = py_func.__code__.co_firstlineno
        self._stamp = stamp
        self._path = store().fetch(place, stamp)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelLocator | None:
        """Return the locator of a kernel of this package, else None."""
        module = _kernel_module(py_file)
        return None if module is None else cls(py_func, *module)

    def get_cache_path(self) -> str:
        """Return the folder of the function's files."""
        return self._path

    def get_source_stamp(self) -> str:
        """Return the hash of the sources that the cached files belong to."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Return a text that distinguishes functions of one name."""
        return str(self._line)

    def ensure_cache_path(self) -> None:
        """Make the folder and check the disk; numba calls this before it writes a compiled function."""
        # makes it again where it was cleared away
        self.get_cache_path()
        store().before_saving()


_load, _save = FunctionCache.load_overload, FunctionCache.save_overload


def _kernel(cache: FunctionCache, signature: Any) -> str | None:
    """Return the name of one of this package's kernels with a signature; None: the function is no kernel of it."""
    if not isinstance(cache._impl.locator, KernelLocator):  # pyright: ignore[reportAttributeAccessIssue]
        return None
    return f"{cache.cache_path} {cache._impl.filename_base} {signature}"  # pyright: ignore[reportAttributeAccessIssue]


def _load_overload(cache: FunctionCache, signature: Any, context: Any) -> Any:
    kernel = _kernel(cache, signature)
    if kernel is None:
        return _load(cache, signature, context)
    if kernel_linking.within_kernel():
        # it becomes a part of that one
        return None
    return store().claim(kernel, lambda: _load(cache, signature, context))


def _save_overload(cache: FunctionCache, signature: Any, data: Any) -> None:
    kernel = _kernel(cache, signature)
    if kernel is None:
        _save(cache, signature, data)
    elif not kernel_linking.within_kernel():
        store().saved(kernel, lambda: _save(cache, signature, data))


def install() -> None:
    """Make numba use `KernelLocator` for cache folders, and ask `KernelStore` before it compiles a kernel."""
    FunctionCache.load_overload = _load_overload  # pyright: ignore[reportAttributeAccessIssue]
    FunctionCache.save_overload = _save_overload  # pyright: ignore[reportAttributeAccessIssue]
    ours = f"{KernelLocator.__module__}.{KernelLocator.__name__}"
    others = settings.CACHE_LOCATOR_CLASSES or _LOCATORS  # pyright: ignore[reportAttributeAccessIssue]
    if ours not in others:
        settings.CACHE_LOCATOR_CLASSES = f"{ours},{others}"  # pyright: ignore[reportAttributeAccessIssue]
    kernel_linking.install(lambda: store().function_done())


install()
