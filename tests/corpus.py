"""Hostile and clumsy input for every command: files to damage, rows to say how, and a process that tries them.

A `Row` is one case: command, what is changed, expected exit code and words. `Bench` writes its files (a few kB)
into a folder of its own and has the command run by a server, which imports the packages once and forks for each
case: so every case runs the command's real ``main`` with its own limit on memory, which is also measured, a guard
against hanging, and bystander files that nothing may touch.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import io
import json
import os
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ns_abstract.nerfstudio.torchvision_operators import declare_missing

#: Bytes of memory that a case may take beside what a process has that has imported everything.
MEMORY = 256 << 20
#: Seconds after which a command hangs; what does not hang takes one or two, on a busy machine a few more.
HANG = 240.0
#: Seconds of computing that no case may take, however busy the machine is.
COMPUTING = 30.0
#: Address space beside the memory: stacks of threads, mapped files and libraries, the allocator's arenas.
_ADDRESSES = 768 << 20
#: Address space that the commands ask for at least.
_LEAST = 4 << 30

MODULES = {
    "render": "ns_abstract.cli.render",
    "nerf": "ns_abstract.cli.render",
    "certify": "ns_abstract.cli.certify",
    "reach": "ns_abstract.cli.reach",
    "npz": "ns_abstract.cli.export",
    "png": "ns_abstract.cli.export",
    "mp4": "ns_abstract.cli.export",
    "ply": "ns_abstract.cli.export",
    "vnnlib": "ns_abstract.cli.export",
    "exr": "ns_abstract.cli.export",
    "safetensors": "ns_abstract.cli.export",
    "rrd": "ns_abstract.cli.export",
    "viser": "ns_abstract.cli.export",
    "statement": "ns_abstract.cli.export",
    "occupancy": "ns_abstract.cli.export",
    "bench": "ns_abstract.cli.bench",
    "demo": "ns_abstract.cli.demo",
    "viewer": "ns_abstract.cli.viewer",
}
#: Imported by the server before it forks.
_IMPORTS = (
    *sorted(set(MODULES.values())), "torch", "onnx", "onnxruntime", "plyfile", "ns_abstract.cli.rendering",
    "ns_abstract.cli.searching", "ns_abstract.bench.sets", "ns_abstract.bench.stiff", "ns_abstract.report.export",
    "ns_abstract.api.reaching", "ns_abstract.methods.splat.write", "ns_abstract.verify.interop",
    "ns_abstract.report.picture", "ns_abstract.report.recordings", "ns_abstract.api.statement",
)  # fmt: skip
#: Names of files by what they are; a change may give another.
_FILES = {
    "path": "path.json", "spec": "spec.json", "prop": "prop.json", "lib": "unsafe.vnnlib", "net": "net.onnx",
    "grid": "grid.npz", "scene": "scene.ply", "indices": "chosen.txt", "loop": "loop.json",
}  # fmt: skip
#: Options of the commands and the files that they name.
_OPTIONS: dict[str, dict[str, str]] = {
    "render": {"load-config": "config", "camera-path-filename": "path", "perturbation-filename": "spec"},
    "nerf": {
        "load-config": "config", "camera-path-filename": "path", "perturbation-filename": "spec",
        "occupancy-grid": "grid",
    },
    "certify": {
        "load-config": "config", "camera-path-filename": "path", "perturbation-filename": "spec", "model": "net",
        "property": "prop",
    },
    "vnnlib": {
        "load-config": "config", "camera-path-filename": "path", "perturbation-filename": "spec", "model": "net",
        "property": "prop",
    },
    "reach": {"load-config": "config", "loop": "loop"},
    "npz": {"input-dir": "results"}, "png": {"input-dir": "results"}, "mp4": {"input-dir": "results"},
    "exr": {"input-dir": "results"}, "safetensors": {"input-dir": "results"}, "rrd": {"input-dir": "results"},
    "viser": {"input-dir": "results", "camera-path-filename": "path"}, "statement": {"input-dir": "search"},
    "ply": {"load-config": "config"}, "occupancy": {"load-config": "config"},
    "bench": {"load-config": "config", "camera-path-filename": "path"}, "demo": {}, "viewer": {"load-config": "config"},
}  # fmt: skip
_FILES_WRITTEN = ("npz", "mp4", "ply", "occupancy", "rrd", "viser", "statement")
_OUTPUT: dict[str, str] = dict.fromkeys(_FILES_WRITTEN, "output-filename")

#: Files of a folder of results that a command may replace.
_RESULTS = ("report.json", "report.html", *(f"frame_{k:05d}.{kind}" for k in range(2) for kind in ("npz", "png")))

#: The same of a search.
_SEARCH = ("report.json", "report.html", *(f"cells.sqlite{more}" for more in ("", "-wal", "-shm")))

#: What a file becomes: bytes, text, a JSON value, or a function that writes it (and may return another path).
Change = bytes | str | Mapping[str, Any] | list[Any] | Callable[..., Any]


@dataclass(frozen=True)
class Row:
    """One case.

    Attributes:
        command: Key of `MODULES`.
        title: What is wrong, in a few words.
        words: What the error says (or, where the code is 0, what the command says).
        changes: By kind of file; ``yml`` is a function from text to text, ``ckpt`` one of the file.
        options: More of the command line; ``{here}`` is the case's folder, ``{spec}`` an unharmed file.
        code: Expected exit code.
        memory: Bytes that it may take.
        signals: Sent one after another, each once the words of ``after`` have been said.
        after: What the command says before.
        room: Bytes that a file may have: the disk is full beyond them.
    """

    command: str
    title: str
    words: tuple[str, ...]
    changes: Mapping[str, Change]
    options: tuple[str, ...] = ()
    code: int = 2
    memory: int = MEMORY
    signals: tuple[int, ...] = ()
    after: str = ""
    room: int | None = None

    @property
    def name(self) -> str:
        """What pytest calls it."""
        return f"{self.command}: {self.title}"


def row(
    command: str,
    title: str,
    *words: str,
    options: tuple[str, ...] | str = (),
    code: int = 2,
    memory: int = MEMORY,
    signals: tuple[int, ...] = (),
    after: str = "",
    room: int | None = None,
    **changes: Change,
) -> Row:
    """A `Row` on one line."""
    given = tuple(options.split()) if isinstance(options, str) else options
    return Row(command, title, words, changes, given, code, memory, signals, after, room)


@dataclass(frozen=True)
class Outcome:
    """What a command did: exit code (negative: killed by a signal; None: it hung), words and cost.

    Attributes:
        peak: Bytes beyond those of a process that has imported everything.
        seconds, computing: By the clock, and of this process on a core.
    """

    code: int | None
    said: str
    peak: int
    seconds: float
    computing: float


class Server:
    """A process that has imported everything and forks for every command."""

    def __init__(self, folder: Path) -> None:
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]),
            "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1",
            "COLUMNS": "200", "TERM": "dumb",
        }  # fmt: skip
        self._log = (folder / "server.txt").open("w+")
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log,
            text=True, env=environment,
        )  # fmt: skip

    def run(self, case: Row, arguments: list[str], folder: Path) -> Outcome:
        """Run a command's main in ``folder`` within the case's limits."""
        assert self._process.stdin is not None and self._process.stdout is not None
        asked = {
            "module": MODULES[case.command], "arguments": arguments, "folder": str(folder), "memory": case.memory,
            "signals": [int(number) for number in case.signals], "after": case.after, "room": case.room,
        }  # fmt: skip
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            self._log.seek(0)
            raise RuntimeError(f"the server has ended: {self._log.read()[-2000:]}")
        return Outcome(**json.loads(answer))

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        self._log.close()


class Bench:
    """Base files, and the cases made of them.

    Args:
        folder: For the base files and a folder by case.
        base: Paths of unharmed files: config, nerf (a config.yml each), path, spec, prop, lib, net, grid, loop,
            results, search (a folder of ns-abstract-certify).

    Attributes:
        outcomes: Of all cases so far.
        greedy, foreign: Cases that took more memory than they may, and files that were not theirs and were touched.
        held: What changes leave open until their case has ended: locks, sockets.
    """

    def __init__(self, folder: Path, base: Mapping[str, Path]) -> None:
        self.folder, self.base = folder, base
        self.server = Server(folder)
        self.outcomes: list[Outcome] = []
        self.greedy = self.foreign = 0
        self.held = ExitStack()
        self.port = ""
        self._count = 0

    @property
    def summary(self) -> str:
        """Figures of all cases so far."""
        found = self.outcomes
        lines = sum("Traceback" in outcome.said for outcome in found)
        hung = sum(outcome.code is None or outcome.computing > COMPUTING for outcome in found)
        return (
            f"{len(found)} cases: {lines} tracebacks, {hung} hung or computed for more than {COMPUTING:.0f} s, "
            f"{self.greedy} took more memory than they may, {self.foreign} foreign files touched; at most "
            f"{max((o.computing for o in found), default=0.0):.1f} s of computing and "
            f"{max((o.seconds for o in found), default=0.0):.1f} s by the clock, at most "
            f"{max((o.peak for o in found), default=0) >> 20} MiB"
        )

    def run(self, case: Row) -> Outcome:
        """Write the case's files, run it, and check that nothing else was touched."""
        with self.held:
            outcome = self._run(case)
        self.outcomes.append(outcome)
        self.greedy += outcome.peak > case.memory
        return outcome

    def _run(self, case: Row) -> Outcome:
        self._count += 1
        here = self.folder / f"case_{self._count:04d}"
        here.mkdir()
        files = self._written(case, here)
        out = here / "out"
        if case.command not in _OUTPUT:
            out.mkdir()
            (out / "mine.txt").write_text("not to be touched")
        arguments = [case.command] if MODULES[case.command].endswith("export") else []
        if case.command == "bench":
            arguments = [case.options[0]]
        given = {option for option in case.options if option.startswith("--")}
        for option, kind in _OPTIONS[case.command].items():
            if kind in files and f"--{option}" not in given and f"--no-{option}" not in given:
                arguments += [f"--{option}", str(files[kind])]
        target = _OUTPUT.get(case.command, "output-dir")
        if case.command != "viewer" and f"--{target}" not in given:
            name = f"out.{'npz' if case.command == 'occupancy' else case.command}" if case.command in _OUTPUT else None
            arguments += [f"--{target}", str(out if name is None else here / name)]
        more = case.options[1:] if case.command == "bench" else case.options
        arguments += [
            text.replace("{here}", str(here)).replace("{spec}", str(self.base["spec"])).replace("{port}", self.port)
            for text in more
            if not text.startswith("--no-")
        ]
        before = _tree(here) | _tree(self.folder / "base")
        outcome = self.server.run(case, arguments, here)
        after = _tree(here) | _tree(self.folder / "base")
        own = (str(out), str(here / "out."))
        kept = dict(before)
        for folder, names in (("results", _RESULTS), ("search", _SEARCH)):
            if f"{{here}}/{folder}" in case.options:
                # where results are continued, what is not one of them is to stay
                own = (*own, str(here / folder))
                ours = {str(here / folder / name) for name in names}
                kept = {name: digest for name, digest in kept.items() if name not in ours}
        changed = sorted(name for name, digest in kept.items() if after.get(name) != digest)
        fresh = [name for name in after if name not in before and not name.startswith(own)]
        self.foreign += len(changed) + len(fresh)
        assert not changed, f"touched {changed}"
        assert not fresh, f"left {fresh} outside of the output"
        shutil.rmtree(here)
        return outcome

    def _written(self, case: Row, here: Path) -> dict[str, Path]:
        """The case's files by kind."""
        files = {kind: path for kind, path in self.base.items() if kind not in ("nerf", "grid", "nerf_path")}
        if case.command in ("nerf", "occupancy"):
            files |= {"config": self.base["nerf"], "path": self.base["nerf_path"]}
        changes = dict(case.changes)
        run: dict[str, Any] = {kind: changes.pop(kind) for kind in ("yml", "ckpt", "transforms") if kind in changes}
        if run:
            copied = here / "run"
            shutil.copytree(files["config"].parent, copied)
            files["config"] = copied / "config.yml"
            if "yml" in run:
                text: Any = run["yml"](files["config"].read_text()) if callable(run["yml"]) else run["yml"]
                files["config"].write_bytes(text if isinstance(text, bytes) else text.encode())
            if "ckpt" in run:
                _write(run["ckpt"], next((copied / "nerfstudio_models").glob("step-*.ckpt")))
            if "transforms" in run:
                _write(run["transforms"], copied / "dataparser_transforms.json")
        for kind in ("results", "search"):
            if kind in changes:
                change = changes.pop(kind)
                files[kind] = here / kind
                shutil.copytree(self.base[kind], files[kind])
                assert callable(change)
                if isinstance(held := change(files[kind]), AbstractContextManager):
                    self.held.enter_context(held)
                (files[kind] / "mine.txt").write_text("not to be touched")
        if "listener" in changes:
            change = changes.pop("listener")
            assert callable(change)
            self.port = str(self.held.enter_context(change()))
        for kind, change in changes.items():
            file = here / _FILES[kind]
            if kind in self.base and callable(change):
                shutil.copy(self.base[kind], file)
            files[kind] = _write(change, file) or file
        if case.command == "reach" and "net" not in changes:
            # beside the loop's file, wherever that is
            shutil.copy(self.base["net"], here / _FILES["net"])
        if "lib" in changes and "prop" not in changes:
            prop = json.loads(self.base["prop"].read_text())
            files["prop"] = here / "prop.json"
            files["prop"].write_text(
                json.dumps({"type": "vnnlib", "file": "unsafe.vnnlib"} | {"preprocess": prop["preprocess"]})
            )
        if "scene" in files:
            files["config"] = files["scene"]
        return files


def _write(change: Change, file: Path) -> Path | None:
    """Bring ``file`` to what a row says."""
    if callable(change):
        found = change(file)
        return found if isinstance(found, Path) else None
    if isinstance(change, bytes):
        file.write_bytes(change)
    else:
        file.write_text(change if isinstance(change, str) else json.dumps(change))
    return None


def _tree(folder: Path) -> dict[str, str]:
    """Digests of the regular files below a folder; what else there is by its kind."""
    found = {}
    for path in folder.rglob("*"):
        status = path.lstat()
        if path.is_dir() and not path.is_symlink():
            continue
        large = status.st_size > 1 << 20
        plain = path.is_file() and not path.is_symlink() and not large
        content = hashlib.sha256(path.read_bytes()).hexdigest() if plain and os.access(path, os.R_OK) else ""
        found[str(path)] = f"{status.st_mode} {status.st_size} {content}"
    return found


#: Control characters that a terminal may act upon.
CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def check(case: Row, outcome: Outcome) -> None:
    """The rules that every case is held to."""
    said = outcome.said
    assert outcome.code is not None, f"hung: {said}"
    assert "Traceback" not in said, said
    assert outcome.computing <= COMPUTING, f"{outcome.computing:.0f} s: {said}"
    assert outcome.code == case.code, said
    assert not CONTROL.search(said), ascii(said)
    for word in case.words:
        assert word in said, said
    assert outcome.peak <= case.memory, f"took {outcome.peak >> 20} MiB: {said}"
    if case.code == 2:
        errors = [line for line in said.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1 and said.splitlines()[-1] == errors[0], said
        assert "; " in errors[0], f"no fix is named: {errors[0]}"
        assert len(errors[0]) < 1000, "an error of more than 1,000 characters"


# ---------------------------------------------------------------- the server's side


def _serve() -> None:
    """Fork for every line of stdin; answers on stdout."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    # whoever started the tests with nohup ignores it
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    for name in _IMPORTS:
        importlib.import_module(name)
    loaded = False
    for line in sys.stdin:
        asked = json.loads(line)
        if asked["module"].endswith("viewer") and not loaded:
            loaded = True
            declare_missing()
            importlib.import_module("ns_abstract.nerfstudio.viewing")
        print(json.dumps(dataclasses.asdict(_tried(**asked))), file=answers, flush=True)


def _tried(
    module: str,
    arguments: list[str],
    folder: str,
    memory: int,
    signals: list[int],
    after: str,
    room: int | None,
) -> Outcome:
    """Run one command in a child."""
    reader, writer = os.pipe()
    wait, go = os.pipe()
    child = os.fork()
    if not child:
        os.close(go)
        os.close(reader)
        os.read(wait, 1)
        os.close(wait)
        _child(module, arguments, folder, memory, writer, room)
    os.close(wait)
    os.close(writer)
    before = int(Path(f"/proc/{child}/statm").read_text().split()[1]) * resource.getpagesize() >> 10
    begin = time.perf_counter()
    os.close(go)
    said = io.BytesIO()
    hung = False
    while True:
        ready, _, _ = select.select([reader], [], [], max(0.0, begin + HANG - time.perf_counter()))
        if not ready:
            hung = True
            os.kill(child, signal.SIGKILL)
            break
        part = os.read(reader, 1 << 16)
        if not part:
            break
        said.write(part)
        if signals and after.encode() in said.getvalue():
            os.kill(child, signals.pop(0))
            after = "stopping" if signals else after
    os.close(reader)
    _, status, usage = os.wait4(child, 0)
    code = None if hung else os.waitstatus_to_exitcode(status)
    text = said.getvalue().decode(errors="backslashreplace")
    peak = max(0, usage.ru_maxrss - before) << 10
    return Outcome(code, text, peak, time.perf_counter() - begin, usage.ru_utime + usage.ru_stime)


def _child(module: str, arguments: list[str], folder: str, memory: int, writer: int, room: int | None) -> None:
    """The command itself."""
    from ns_abstract.execution import cluster

    code = 99
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(writer, 1)
        os.dup2(writer, 2)
        os.close(writer)
        os.chdir(folder)
        sizes = Path("/proc/self/statm").read_text().split()
        limit = max(_LEAST, int(sizes[0]) * resource.getpagesize() + memory + _ADDRESSES)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        if room is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
        # a scheduler that does not answer is asked for that long
        cluster._CONNECT = 1.0
        sys.argv = ["command", *arguments]
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        importlib.import_module(module).main()
    except SystemExit as leave:
        code = leave.code if isinstance(leave.code, int) else 98
    except BaseException:
        traceback.print_exc()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            pass
    os._exit(code)


def rows_by_name(rows: list[Row]) -> Iterator[tuple[str, Row]]:
    """Names are unique."""
    names = set()
    for case in rows:
        assert case.name not in names, f"two rows {case.name}"
        names.add(case.name)
        yield case.name, case


if __name__ == "__main__":
    _serve()
