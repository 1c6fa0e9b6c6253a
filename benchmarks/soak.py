"""Kills renders and certificates again and again, short of memory and disk, and looks at what is left.

    python benchmarks/soak.py --seconds 600 --frames 200 --cells 5000

A path of ``--frames`` small pictures is bounded, and a set cut into ``--cells`` cells is certified, by commands that
get SIGKILL after a random time (5 to 20 s) and are run again with ``--resume``, each in its own memory limit and, every
few rounds, on a disk that is full (a limit on the size of files). Ends when both are done or the time is over. Printed:
kills, how far it got, tracebacks, files left over, workers left over, and the peak memory of the processes over time.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

#: Bytes that one file may have where the disk is played to be full; MiB of memory that commands may plan with.
_SMALL_FILE, _MEMORY = 1 << 16, 2048
#: Seconds between looks at a command, and those it may take to end.
_LOOK, _PATIENCE = 0.2, 60.0
_SIZE = 16


class Soak:
    """One command, killed until it is done.

    Args:
        name: Of the command.
        command: Its words.
        folder: Where it writes.
        pause: Least and most seconds before a kill.
        seed: Of the times of kills.
    """

    def __init__(self, name: str, command: list[str], folder: Path, pause: tuple[float, float], seed: int) -> None:
        self.name, self.command, self.folder, self.pause = name, command, folder, pause
        self.random = random.Random(seed)
        self.kills = self.full = self.rounds = self.tracebacks = self.orphans = 0
        self.peaks: list[int] = []
        self.unexpected: list[str] = []
        self.done = False

    def round(self) -> None:
        """Run the command once, and kill it or let it meet a full disk."""
        self.rounds += 1
        full = self.rounds % 5 == 0
        end = time.monotonic() + self.random.uniform(*self.pause)

        with tempfile.TemporaryFile("w+") as said:
            process = subprocess.Popen(
                [*self.command, "--resume"], stderr=said, stdout=said, start_new_session=True,
                env=os.environ | {"PYTHONPATH": str(ROOT)},
            )  # fmt: skip
            if full:
                resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (_SMALL_FILE, _SMALL_FILE))
            peak = 0
            while process.poll() is None and time.monotonic() < end:
                peak = max(peak, memory_of(process.pid))
                time.sleep(_LOOK)
            if process.poll() is None:
                self.kills += 1
                process.send_signal(signal.SIGKILL)
            process.wait()
            said.seek(0)
            text = said.read()
        self.peaks.append(peak)
        self.tracebacks += "Traceback" in text
        self.full += full and process.returncode == 2
        self.done = process.returncode == 0
        if process.returncode not in (0, -signal.SIGKILL, *((2,) if full else ())):
            self.unexpected.append(f"{process.returncode}: {text.strip()[-300:]}")
        self.orphans += left_over(process.pid)

    def summary(self) -> dict[str, Any]:
        """Figures so far."""
        third = max(1, len(self.peaks) // 3)
        return {
            "done": self.done,
            "rounds": self.rounds,
            "killed": self.kills,
            "full disks told": self.full,
            "tracebacks": self.tracebacks,
            "processes left over": self.orphans,
            "unexpected ends": self.unexpected,
            "peak MiB, first third": max(self.peaks[:third], default=0) >> 20,
            "peak MiB, last third": max(self.peaks[-third:], default=0) >> 20,
        }


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


def inputs(folder: Path, frames: int, cells: int) -> tuple[list[str], list[str]]:
    """Commands of a render and of a certificate over a small scene."""
    from certifying import linear  # pyright: ignore[reportMissingImports]
    from conftest import blob_scene, ring, write_json  # pyright: ignore[reportMissingImports]

    from ns_abstract.geometry.views import path_json
    from ns_abstract.methods.splat.write import write_splatfacto_run

    config = write_splatfacto_run(blob_scene(), folder, timestamp="2026-01-01_000000", experiment_name="blobs")
    path = write_json(folder / "path.json", path_json(ring(frames, _SIZE)))
    single = write_json(folder / "one.json", path_json(ring(1, _SIZE)))
    shift = write_json(folder / "shift.json", {"version": 1, "translation": {"x": 0.03}})
    sweep = write_json(folder / "sweep.json", {"version": 1, "translation": {"x": 0.15}})
    row = np.zeros((3, _SIZE, _SIZE))
    row[:, :, : _SIZE // 2], row[:, :, _SIZE // 2 :] = 1.0, -1.0
    rows = np.stack([row.reshape(-1), 0.0 * row.reshape(-1)]) / row.size
    net = linear(folder / "net.onnx", rows, np.array([0.0, 0.02]), _SIZE)
    prop = {"type": "classification", "label": 0, "partitions": [cells], "preprocess": {"resize": [_SIZE, _SIZE]}}
    memory = ["--memory-limit", str(_MEMORY / 1024), "--time-budget", "36000"]
    render = [sys.executable, "-m", "ns_abstract.cli.render", "--load-config", str(config), *memory,
              "--camera-path-filename", str(path), "--perturbation-filename", str(shift)]  # fmt: skip
    certify = [sys.executable, "-m", "ns_abstract.cli.certify", "--load-config", str(config), *memory,
               "--camera-path-filename", str(single), "--perturbation-filename", str(sweep), "--model", str(net),
               "--property", str(write_json(folder / "prop.json", prop)), "--workers", "2"]  # fmt: skip
    return render, certify


def verdicts(folder: Path) -> dict[str, Any]:
    """Cells by verdict, the part of the set they cover, and whether they overlap."""
    with sqlite3.connect(folder / "cells.sqlite") as base:
        rows = base.execute("SELECT lower, upper, verdict FROM cells").fetchall()
    ends = sorted((json.loads(low)[0], json.loads(high)[0]) for low, high, _ in rows)
    return {
        **{kind: sum(row[2] == kind for row in rows) for kind in ("certified", "falsified", "unknown")},
        "width": sum(high - low for low, high in ends),
        "overlaps": sum(left[1] > right[0] for left, right in itertools.pairwise(ends)),
    }


def main() -> None:
    """Run the soak and print its figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--cells", type=int, default=5000)
    parser.add_argument("--pause", type=float, nargs=2, default=(5.0, 20.0), help="seconds before a kill")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "inputs").mkdir()
        render, certify = inputs(folder / "inputs", options.frames, options.cells)
        soaks = []
        for k, (kind, command) in enumerate((("render", render), ("certify", certify))):
            out = folder / kind
            soaks.append(Soak(kind, [*command, "--output-dir", str(out)], out, options.pause, options.seed + k))
            out.mkdir()
            (out / "mine.txt").write_text("not ours")
        end = time.monotonic() + options.seconds
        while time.monotonic() < end and not all(soak.done for soak in soaks):
            for soak in soaks:
                if not soak.done:
                    soak.round()
        for soak in soaks:
            figures = soak.summary()
            figures["parts left over"] = len(list(soak.folder.rglob(".*.part"))) if soak.done else "-"
            figures["foreign file untouched"] = (soak.folder / "mine.txt").read_text() == "not ours"
            if soak.name == "render":
                figures["frames"] = len(list(soak.folder.glob("frame_*.npz")))
            elif (soak.folder / "cells.sqlite").exists():
                figures |= verdicts(soak.folder)
            print(json.dumps({soak.name: figures}, indent=1))


if __name__ == "__main__":
    main()
