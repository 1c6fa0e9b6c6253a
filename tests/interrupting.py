"""Signals at chosen moments of a command, wherever and however fast it runs."""

from __future__ import annotations

import importlib
import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from conftest import InProcess, environment
from waiting import LONG


def stored(folder: Path) -> int:
    """Cells that a command at work has stored."""
    try:
        with closing(sqlite3.connect(f"file:{folder / 'cells.sqlite'}?mode=ro", uri=True)) as base:
            return base.execute("SELECT COUNT(*) FROM cells").fetchone()[0]
    except sqlite3.OperationalError:
        # not there yet, or the log of a killed command that nobody has read
        return 0


def interrupted_at(place: str, monkeypatch: pytest.MonkeyPatch, number: int = signal.SIGINT) -> None:
    """Have a signal come when the command gets to a function, ``module:name`` or ``module:class.name``."""
    module, _, path = place.partition(":")
    owner = importlib.import_module(module)
    *outer, name = path.split(".")
    for part in outer:
        owner = getattr(owner, part)
    function = getattr(owner, name)

    def signalled(*arguments: Any, **more: Any) -> Any:
        os.kill(os.getpid(), number)
        return function(*arguments, **more)

    monkeypatch.setattr(owner, name, signalled)


def check_interrupted(in_process: InProcess, main: Callable[[], None], options: list[str], folder: Path) -> None:
    """A command that `interrupted_at` meets before its first result: code, words, and a report if it has begun one."""
    code, _, said = in_process(main, options)
    assert code == 3 and "Traceback" not in said and "error" not in said, said
    if folder.exists():
        check_report(folder)


def check_report(folder: Path) -> None:
    """It says interrupted, and that nothing is proved."""
    document = json.loads((folder / "report.json").read_text())
    assert document["state"] == "interrupted"
    assert document.get("verdict", "unknown") == "unknown"
    for entry in [*document.get("questions", {}).values(), *([document["coverage"]] if "coverage" in document else [])]:
        assert entry["certified"] == entry["falsified"] == 0.0 and entry["unknown"] == 1.0
    assert all(entry["status"] == "missing" for entry in document.get("frames", []) if "status" in entry)
    assert "</html>" in (folder / "report.html").read_text()
    assert not list(folder.glob(".*.part"))


#: Python does not get to handle a signal in the middle of this.
_STUCK = """
import ctypes, importlib, os, signal, sys, threading
module, place, *options = sys.argv[1:]
from ns_abstract.cli import common
common._PATIENCE = 0.1
command, name = importlib.import_module(module), place.rpartition(".")[2]

def stuck(*arguments):
    library, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(256)
    library.pthread_mutex_lock(mutex)
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM)).start()
    library.pthread_mutex_lock(mutex)

setattr(importlib.import_module(place.rpartition(".")[0]), name, stuck)
sys.argv = ["command", *options]
command.main()
"""


def check_ended_in_a_library_call(module: str, place: str, options: list[str], folder: Path) -> None:
    """A command is ended while a function, ``module.name``, is in a call that knows nothing of Python."""
    done = subprocess.run(
        [sys.executable, "-c", _STUCK, module, place, *options], capture_output=True, text=True, env=environment(),
        timeout=LONG, check=False,
    )  # fmt: skip
    assert done.returncode == 3 and done.stderr.endswith("interrupted\n") and "Traceback" not in done.stderr, done
    check_report(folder)
