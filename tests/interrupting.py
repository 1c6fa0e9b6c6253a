"""Signals at chosen moments of a command, wherever and however fast it runs."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import InProcess, environment
from waiting import LONG

#: Waits at the first block after which so many more cells are stored.
_HELD = """
import importlib, sys
from ns_abstract.verify.store import Store
module, cells, *options = sys.argv[1:]
close_block, least = Store.close_block, []

def held(store, *arguments):
    least or least.append(store.count + int(cells))
    closed = close_block(store, *arguments)
    if len(least) == 1 and store.count >= least[0]:
        print("held", flush=True)
        least.append(sys.stdin.read())
    return closed

Store.close_block = held
sys.argv = ["command", *options]
importlib.import_module(module).main()
"""


def held_at(cells: int, module: str, options: list[str]) -> subprocess.Popen[str]:
    """A command that has stored ``cells`` new cells, and waits until it is ended or its stdin is closed.

    It goes on where it is asked to communicate, and then handles the signals that came before.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", _HELD, module, str(cells), *options],
        text=True, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    assert "held\n" in iter(process.stdout.readline, ""), process.communicate()[1]
    return process


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
