"""Kills renders and certificates again and again, short of memory and disk, and looks at what is left.

    python benchmarks/soak.py --folder FOLDER --only certify --seconds 560 --cells 5000

A path of ``--frames`` small pictures is bounded, and a set in ``--cells`` parts is certified, by commands that get
SIGKILL after a random time (5 to 20 s) and are run again with ``--resume``, each with a limit on memory and, in one of
``--full`` rounds, on a disk with room for a few kB more (a limit on the size of files). Ends when both are done or the
time is over; the same command with the same FOLDER goes on. Before the clock starts, both run once for a moment, so
that kernels are compiled. Printed: kills, tracebacks, processes left over, the peak memory of a command over
time, how long after the start the first cell is stored, and, when a command is done, where its results differ from an
uninterrupted run's: nothing may be lost or there twice.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import resource
import shutil
import signal
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

#: Bytes that the largest file may grow by where the disk is played to be full; MiB that commands may plan with.
_ROOM, _MEMORY = 1 << 14, 2048
#: Seconds between looks at a command, and those its processes may take to end with it.
_LOOK, _PATIENCE = 0.2, 60.0
#: Pixels of a side of the render's and of the certificate's pictures, and Gaussians.
_SIZE, _SIDE, _GAUSSIANS = 16, 32, 400


@dataclass
class Counts:
    """What has happened to a command so far.

    Attributes:
        rounds, killed, full, tracebacks, orphans: Times it was started and killed, that it told of a full disk, that it
            printed a traceback, and processes that outlived it by a minute.
        seconds: Time it ran.
        peaks: Most bytes of its processes, by round.
        first: Seconds from its start to the first thing it stored, by round in which it stored anything.
        stored: Cells or frames after every round.
        unexpected: Ends that should not be.
        done: Whether it has ended by itself.
    """

    rounds: int = 0
    killed: int = 0
    full: int = 0
    tracebacks: int = 0
    orphans: int = 0
    seconds: float = 0.0
    peaks: list[int] = field(default_factory=list)
    first: list[float] = field(default_factory=list)
    stored: list[int] = field(default_factory=list)
    unexpected: list[str] = field(default_factory=list)
    done: bool = False


class Soak:
    """One command, killed until it is done.

    Args:
        kind: "render" or "certify".
        command: Its words, without the output folder.
        folder: Where it writes, and ``KIND.json`` beside for what has happened.
        pause: Least and most seconds before a kill.
        full: In every which round the disk is full.
        seed: Of the times of kills.
    """

    def __init__(
        self, kind: str, command: list[str], folder: Path, pause: tuple[float, float], full: int, seed: int
    ) -> None:
        self.kind, self.command, self.pause, self.full = kind, command, pause, full
        self.out, self.file = folder / kind, folder / f"{kind}.json"
        self.counts = Counts(**json.loads(self.file.read_text())) if self.file.exists() else Counts()
        self.random = random.Random(seed + self.counts.rounds)
        if not self.out.exists():
            self.out.mkdir()
            (self.out / "mine.txt").write_text("not ours")

    @property
    def stored(self) -> int:
        """Cells or frames that are kept."""
        if self.kind == "render":
            return len(list(self.out.glob("frame_*.npz")))
        return count(self.out)

    def round(self) -> None:
        """Run the command once, and kill it or let it meet a full disk."""
        counts = self.counts
        counts.rounds += 1
        full = counts.rounds % self.full == 0
        begin = time.monotonic()
        end = begin + self.random.uniform(*self.pause)
        before, peak, first = counts.stored[-1] if counts.stored else 0, 0, None
        with tempfile.TemporaryFile("w+") as said:
            process = started([*self.command, "--output-dir", str(self.out), "--resume"], said)
            if full:
                most = max((file.stat().st_size for file in self.out.rglob("*") if file.is_file()), default=0) + _ROOM
                resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most, most))
            while process.poll() is None and time.monotonic() < end:
                peak = max(peak, memory_of(process.pid))
                if first is None and self.stored > before:
                    first = time.monotonic() - begin
                time.sleep(_LOOK)
            if process.poll() is None:
                counts.killed += 1
                process.send_signal(signal.SIGKILL)
            process.wait()
            said.seek(0)
            text = said.read()
        counts.seconds += time.monotonic() - begin
        counts.peaks.append(peak)
        counts.stored.append(self.stored if self.kind == "render" else len(cells(self.out)))
        if first is not None:
            counts.first.append(first)
        counts.tracebacks += "Traceback" in text
        counts.full += full and process.returncode == 2
        counts.done = process.returncode == 0
        if process.returncode not in (0, -signal.SIGKILL, *((2,) if full else ())):
            counts.unexpected.append(f"{process.returncode}: {text.strip()[-300:]}")
        counts.orphans += left_over(process.pid)
        self.file.write_text(json.dumps(asdict(counts)))

    def summary(self) -> dict[str, Any]:
        """Figures so far."""
        counts = self.counts
        third = max(1, len(counts.peaks) // 3)
        found: dict[str, Any] = {
            "done": counts.done,
            "rounds": counts.rounds,
            "seconds": round(counts.seconds),
            "killed": counts.killed,
            "full disks told": counts.full,
            "tracebacks": counts.tracebacks,
            "processes left over": counts.orphans,
            "unexpected ends": counts.unexpected,
            "stored": counts.stored[-1:],
            "rounds that stored something": len(counts.first),
            "seconds to the first thing stored, median and most": [
                round(statistics.median(counts.first), 1), round(max(counts.first), 1)
            ] if counts.first else None,
            "peak MiB, thirds": [max(counts.peaks[k : k + third], default=0) >> 20 for k in (0, third, 2 * third)],
            "foreign file untouched": (self.out / "mine.txt").read_text() == "not ours",
        }  # fmt: skip
        if counts.done:
            found["parts left over"] = len(list(self.out.rglob(".*.part")))
        if self.kind == "certify":
            found |= verdicts(self.out)
        return found


def started(command: list[str], said: Any) -> subprocess.Popen[str]:
    """A command in a session of its own."""
    return subprocess.Popen(
        command, stderr=said, stdout=said, start_new_session=True, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip


def memory_of(group: int) -> int:
    """Bytes that the processes of a session have in memory together."""
    return sum(size for _, size in members(group))


def members(session: int) -> list[tuple[int, int]]:
    """Processes of a session, with their resident bytes."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(words[3]) == session and words[0] != "Z":
                found.append((int(entry.name), int(words[21]) * resource.getpagesize()))
        except (OSError, IndexError):
            continue
    return found


def left_over(session: int) -> int:
    """Processes of a session that do not end by themselves within a while."""
    end = time.monotonic() + _PATIENCE
    while members(session) and time.monotonic() < end:
        time.sleep(_LOOK)
    return len(members(session))


def inputs(folder: Path, frames: int, parts: int) -> dict[str, list[str]]:
    """Commands of a render and of a certificate over a small scene."""
    from certifying import linear  # pyright: ignore[reportMissingImports]
    from conftest import blob_scene, ring  # pyright: ignore[reportMissingImports]

    from ns_abstract.geometry.keyframe_cameras import path_json
    from ns_abstract.io.atomic import write_json
    from ns_abstract.methods.splat.write import write_splatfacto_run

    config = write_splatfacto_run(
        blob_scene(_GAUSSIANS), folder, timestamp="2026-01-01_000000", experiment_name="blobs"
    )
    path = write_json(folder / "path.json", path_json(ring(frames, _SIZE)))
    single = write_json(folder / "one.json", path_json(ring(1, _SIDE)))
    shift = write_json(folder / "shift.json", {"version": 1, "translation": {"x": 0.03}})
    sweep = write_json(folder / "sweep.json", {"version": 1, "translation": {"x": 0.15}})
    row = np.zeros((3, _SIDE, _SIDE))
    row[:, :, : _SIDE // 2], row[:, :, _SIDE // 2 :] = 1.0, -1.0
    rows = np.stack([row.reshape(-1), 0.0 * row.reshape(-1)]) / row.size
    net = linear(folder / "net.onnx", rows, np.array([0.0, 0.02]), _SIDE)
    prop = {"type": "classification", "label": 0, "partitions": [parts], "preprocess": {"resize": [_SIDE, _SIDE]}}
    memory = ["--memory-limit", str(_MEMORY / 1024), "--time-budget", "36000"]
    render = [sys.executable, "-m", "ns_abstract.cli.render", "--load-config", str(config), *memory,
              "--camera-path-filename", str(path), "--perturbation-filename", str(shift)]  # fmt: skip
    certify = [sys.executable, "-m", "ns_abstract.cli.certify", "--load-config", str(config), *memory,
               "--camera-path-filename", str(single), "--perturbation-filename", str(sweep), "--model", str(net),
               "--property", str(write_json(folder / "prop.json", prop)), "--workers", "2"]  # fmt: skip
    return {"render": render, "certify": certify}


def cells(folder: Path) -> list[tuple[Any, ...]]:
    """The stored cells, without the time that each took."""
    # a copy: who opens the file of a killed command folds the log into it
    with tempfile.TemporaryDirectory() as name:
        for file in folder.glob("cells.sqlite*"):
            shutil.copy(file, name)
        if not os.listdir(name):
            return []
        with closing(sqlite3.connect(Path(name) / "cells.sqlite")) as base:
            return base.execute("SELECT frame, lower, upper, verdict, margin, counterexample FROM cells").fetchall()


def count(folder: Path) -> int:
    """Number of stored cells, while a command works."""
    try:
        with closing(sqlite3.connect(f"file:{folder / 'cells.sqlite'}?mode=ro", uri=True)) as base:
            return base.execute("SELECT COUNT(*) FROM cells").fetchone()[0]
    except sqlite3.Error:
        # no file yet, or one with a log that nobody has read
        return 0


def verdicts(folder: Path) -> dict[str, Any]:
    """Cells by verdict, the part of the set they cover, and whether they overlap."""
    rows = cells(folder)
    ends = sorted((json.loads(low)[0], json.loads(high)[0]) for _, low, high, *_ in rows)
    return {
        **{kind: sum(row[3] == kind for row in rows) for kind in ("certified", "falsified", "unknown")},
        "width": sum(high - low for low, high in ends),
        "overlaps": sum(left[1] > right[0] for left, right in itertools.pairwise(ends)),
    }


def compared(kind: str, out: Path, whole: Path) -> dict[str, int]:
    """What a killed command's results lack or have beyond those of an uninterrupted run."""
    if kind == "certify":
        mine, theirs = Counter(cells(out)), Counter(cells(whole))
        return {"lost": (theirs - mine).total(), "too many": (mine - theirs).total(), "uninterrupted": theirs.total()}
    mine, theirs = ({file.name for file in folder.glob("frame_*.npz")} for folder in (out, whole))
    return {"lost": len(theirs - mine), "too many": len(mine - theirs), "uninterrupted": len(theirs)}


def uninterrupted(command: list[str], out: Path, seconds: float | None = None) -> list[int]:
    """Run a command, to its end or for a moment; the bytes of its processes, looked at once a second."""
    found = []
    with tempfile.TemporaryFile("w+") as said:
        budget = [] if seconds is None else ["--time-budget", str(seconds)]
        process = started([*command, *budget, "--output-dir", str(out)], said)
        while process.poll() is None:
            found.append(memory_of(process.pid))
            time.sleep(1.0)
        if process.returncode not in (0, 3):
            said.seek(0)
            raise SystemExit(said.read())
    return found


def main() -> None:
    """Run the soak and print its figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--folder", type=Path, help="where everything is kept; default: a temporary folder")
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--cells", type=int, default=5000, help="parts of the certificate's partition")
    parser.add_argument("--only", choices=("render", "certify"))
    parser.add_argument("--pause", type=float, nargs=2, default=(5.0, 20.0), help="seconds before a kill")
    parser.add_argument("--full", type=int, default=5, help="rounds of which one meets a full disk")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (options.folder or Path(name)).absolute()
        source = folder / "inputs"
        if not source.exists():
            source.mkdir(parents=True)
            (folder / "commands.json").write_text(json.dumps(inputs(source, options.frames, options.cells)))
        commands = json.loads((folder / "commands.json").read_text())
        kinds = [kind for kind in commands if options.only in (None, kind)]
        for kind in kinds:
            if not (folder / f"warm-{kind}").exists():
                uninterrupted(commands[kind], folder / f"warm-{kind}", 1.0)
        soaks = [
            Soak(kind, commands[kind], folder, options.pause, options.full, options.seed + 1000 * k)
            for k, kind in enumerate(kinds)
        ]
        end = time.monotonic() + options.seconds
        while time.monotonic() < end and not all(soak.counts.done for soak in soaks):
            for soak in soaks:
                if not soak.counts.done:
                    soak.round()
        for soak in soaks:
            figures = soak.summary()
            if soak.counts.done:
                begin = time.monotonic()
                sizes = uninterrupted(soak.command, folder / f"whole-{soak.kind}")
                figures |= compared(soak.kind, soak.out, folder / f"whole-{soak.kind}")
                third = max(1, len(sizes) // 3)
                figures |= {
                    "uninterrupted, seconds": round(time.monotonic() - begin),
                    "uninterrupted, peak MiB, thirds": [
                        max(sizes[k : k + third], default=0) >> 20 for k in (0, third, 2 * third)
                    ],
                }
            print(json.dumps({soak.kind: figures}, indent=1))


if __name__ == "__main__":
    main()
