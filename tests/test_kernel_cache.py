"""Compiled kernels that are kept on disk belong to the sources they were compiled from, and are what was written."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import ns_abstract
from ns_abstract.arithmetic import kernel_cache

PROGRAM = """
import logging
import numpy as np
logging.basicConfig(level=logging.INFO, format="%(message)s")
from ns_abstract.arithmetic.forms import set_norms
set_norms(np.zeros((4, 3)), 0, 1, 1)
print(sum(set_norms.stats.cache_hits.values()), sum(set_norms.stats.cache_misses.values()))
"""
HIT, MISS = "1 0", "0 1"


def environment(**changes: str) -> dict[str, str]:
    """The environment without settings of numba and of the cache."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "NS_ABSTRACT", "XDG"))}
    return kept | changes


def start(program: str = PROGRAM, **changes: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", program]
    return subprocess.Popen(
        command, env=environment(**changes), cwd="/", stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def run(program: str = PROGRAM, **changes: str) -> tuple[str, str]:
    """What the program printed and said."""
    process = start(program, **changes)
    printed, said = process.communicate()
    assert process.returncode == 0, said
    return printed.strip(), said.strip()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "kernels"


def version(folder: Path) -> Path:
    """The only version's folder."""
    (found,) = folder.iterdir()
    return found


@pytest.mark.slow
def test_other_module_changed(tmp_path: Path, folder: Path) -> None:
    """Kernels of one module are compiled again where another one, whose constants they hold, has changed."""
    package = tmp_path / "ns_abstract"
    shutil.copytree(Path(next(iter(ns_abstract.__path__))), package, ignore=shutil.ignore_patterns("__pycache__"))
    changes = {"PYTHONPATH": str(tmp_path), "NS_ABSTRACT_CACHE_DIR": str(folder)}
    assert run(**changes)[0] == MISS
    assert run(**changes)[0] == HIT
    units = package / "arithmetic" / "rounding.py"
    units.write_text(units.read_text(encoding="utf-8") + "\n# another version\n", encoding="utf-8")
    assert run(**changes)[0] == MISS
    assert run(**changes)[0] == HIT
    assert not list(package.rglob("*.nb?"))


SHARED = """
import subprocess, sys, os
from ns_abstract.arithmetic.kernel_cache import SESSION, store
program = '''
import sys, time
import numpy as np
from ns_abstract.arithmetic.forms import set_norms
from ns_abstract.arithmetic.kernel_cache import store
print("ready", flush=True)
sys.stdin.readline()
for dtype in (np.float64, np.float32):
    set_norms(np.zeros((4, 3), dtype), 0, 1, 1)
print(store().compiled, store().session)
'''
environment = os.environ | {SESSION: str(store().session)}
pipe = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
others = [subprocess.Popen([sys.executable, "-c", program], env=environment, **pipe) for _ in range(COUNT)]
for other in others:
    assert other.stdout.readline() == "ready\\n"
for other in others:
    other.stdin.write("\\n")
    other.stdin.flush()
found = [other.communicate()[0].split() for other in others]
assert not any(other.returncode for other in others)
assert {session for _, session in found} == {str(store().session)} and store().session.is_dir()
from ns_abstract.arithmetic.forms import set_norms
import numpy as np
set_norms(np.zeros((4, 3)), 0, 1, 1)
assert store().compiled == 0
print(sum(int(compiled) for compiled, _ in found))
"""


@pytest.mark.slow
def test_processes_of_one_session_compile_no_kernel_twice(tmp_path: Path) -> None:
    """Two that begin at once compile together what one compiles alone, and their kernels are kept."""
    alone, two = (run(SHARED.replace("COUNT", count), NS_ABSTRACT_CACHE_DIR=str(tmp_path / count))[0] for count in "13")
    assert alone == two and int(alone) >= 2
    # and published
    assert run(NS_ABSTRACT_CACHE_DIR=str(tmp_path / "3"))[0] == HIT


def test_session_of_another_version_is_not_shared(tmp_path: Path) -> None:
    other = kernel_cache.KernelStore(tmp_path, "0" * 64)
    store = kernel_cache.KernelStore(tmp_path, "1" * 64, other.session)
    assert not store.shared and store.session != other.session
    gone = kernel_cache.KernelStore(tmp_path, "0" * 64, other.session.with_name("session-none"))
    assert not gone.shared
    shared = kernel_cache.KernelStore(tmp_path, "0" * 64, other.session)
    assert shared.shared
    shared.close()
    assert other.session.is_dir()
    for each in (store, gone, other):
        each.close()
    assert not other.session.exists()


@pytest.mark.slow
def test_nothing_is_compiled_where_all_must_be_kept(folder: Path) -> None:
    program = """
import numpy as np
from ns_abstract.arithmetic.forms import set_norms
from ns_abstract.arithmetic.kernel_cache import KernelMissingError, store
try:
    with store().complete():
        set_norms(np.zeros((4, 3)), 0, 1, 1)
except KernelMissingError:
    print("missing", store().compiled, end=" ")
set_norms(np.zeros((4, 3)), 0, 1, 1)
with store().complete():
    set_norms(np.zeros((4, 3)), 0, 1, 1)
print(store().compiled > 0)
"""
    assert run(program, NS_ABSTRACT_CACHE_DIR=str(folder))[0] == "missing 0 True"
    assert run(program, NS_ABSTRACT_CACHE_DIR=str(folder))[0] == "False"


@pytest.mark.slow
@pytest.mark.parametrize("content", [b"", b"garbage", None], ids=["empty", "garbage", "truncated"])
@pytest.mark.parametrize("what", ["blobs", "manifest"])
def test_damaged_files(folder: Path, what: str, content: bytes | None) -> None:
    """What is not as it was written is compiled again."""
    changes = {"NS_ABSTRACT_CACHE_DIR": str(folder)}
    assert run(**changes)[0] == MISS
    files = list((version(folder) / "blobs").iterdir()) if what == "blobs" else [version(folder) / "manifest.json"]
    for file in files:
        file.write_bytes(file.read_bytes()[:-20] if content is None else content)
    assert run(**changes)[0] == MISS
    assert run(**changes)[0] == HIT


@pytest.mark.slow
def test_manifest_leads_nowhere_else(tmp_path: Path, folder: Path) -> None:
    """A manifest that names files elsewhere is not followed."""
    changes = {"NS_ABSTRACT_CACHE_DIR": str(folder)}
    run(**changes)
    file = version(folder) / "manifest.json"
    entries = json.loads(file.read_bytes())
    (name, files), *_ = entries.items()
    entries[name] = {"../../" + key: digest for key, digest in files.items()}
    file.write_text(json.dumps(entries), encoding="utf-8")
    before = set(tmp_path.rglob("*.nb?"))
    assert run(**changes)[0] == MISS
    assert set(tmp_path.rglob("*.nb?")) == before


@pytest.mark.slow
def test_no_place_to_write(tmp_path: Path) -> None:
    """Without a folder that can be written, one line says so and a temporary folder serves, which is removed."""
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    file = tmp_path / "file"
    file.write_text("")
    printed, said = run(NS_ABSTRACT_CACHE_DIR=str(file / "x"), TMPDIR=str(temporary))
    assert printed == MISS
    assert [line for line in said.splitlines() if "this run only" in line and "NS_ABSTRACT_CACHE_DIR" in line]
    assert not list(temporary.iterdir())


@pytest.mark.slow
def test_no_home(tmp_path: Path) -> None:
    """A home that does not exist and cannot be made is no error."""
    file = tmp_path / "file"
    file.write_text("")
    printed, said = run(HOME=str(file))
    assert printed == MISS
    assert "this run only" in said


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_folder(folder: Path) -> None:
    """Kernels are read from a folder that cannot be written."""
    changes = {"NS_ABSTRACT_CACHE_DIR": str(folder)}
    assert run(**changes)[0] == MISS
    version(folder).chmod(0o500)
    folder.chmod(0o500)
    try:
        assert run(**changes)[0] == HIT
    finally:
        folder.chmod(0o700)
        version(folder).chmod(0o700)


@pytest.mark.slow
def test_two_first_starts(folder: Path) -> None:
    """Processes that compile at once both work, and leave one whole set."""
    changes = {"NS_ABSTRACT_CACHE_DIR": str(folder)}
    both = [start(**changes) for _ in range(2)]
    said = [process.communicate() for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert run(**changes)[0] == HIT
    assert not list(version(folder).glob("session-*"))


@pytest.mark.slow
def test_killed(folder: Path) -> None:
    """What a killed process leaves behind is cleared by the next one."""
    changes = {"NS_ABSTRACT_CACHE_DIR": str(folder)}
    process = start(PROGRAM + "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)", **changes)
    process.communicate()
    assert list(version(folder).glob("session-*"))
    assert run(**changes)[0] == MISS
    assert run(**changes)[0] == HIT
    assert not list(version(folder).glob("session-*"))


@pytest.mark.slow
def test_old_versions_are_cleared(folder: Path) -> None:
    """Of the versions that are no longer used the last few stay; what is not ours stays."""
    changes = {"NS_ABSTRACT_CACHE_DIR": str(folder)}
    for k in range(8):
        old = folder / f"{k:032d}"
        (old / "blobs").mkdir(parents=True)
        os.utime(old, (k, k))
    (folder / "mine").mkdir()
    (folder / "mine" / "file").write_text("kept")
    run(**changes)
    assert sorted(path.name for path in folder.iterdir())[:3] == [f"{k:032d}" for k in (5, 6, 7)]
    assert (folder / "mine" / "file").exists()


def test_old_versions_in_use_stay(tmp_path: Path) -> None:
    """A process that began before an update goes on with its kernels."""
    first = kernel_cache.KernelStore(tmp_path, "0" * 64)
    for number in range(1, 9):
        kernel_cache.KernelStore(tmp_path, str(number) * 64).close()
    assert first.session.is_dir()
    first.close()
    os.utime(tmp_path / ("0" * 32), (0, 0))
    kernel_cache.KernelStore(tmp_path, "a" * 64).close()
    assert not (tmp_path / ("0" * 32)).exists()
