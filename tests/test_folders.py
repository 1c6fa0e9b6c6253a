"""Output folders: nothing of others is touched, one command at a time, and forged results are not taken."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import InProcess, Inputs
from test_certify_search import fill, open_store, search_of
from test_report import frame, read, run

import ns_abstract
from ns_abstract.api import certificate_report
from ns_abstract.cli.render import main as render_main
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.io.folder import MARK, claim, remove_parts, unwritable
from ns_abstract.io.version import computed_by
from ns_abstract.report.export import Results
from ns_abstract.report.files import load_frame, save_frame
from ns_abstract.report.record import Report
from ns_abstract.verify import store_file as store_module
from ns_abstract.verify.store import Store
from ns_abstract.verify.store_file import IMAGES, TableChecksum

FOREIGN = {
    "notes.txt": b"mine",
    ".notes.12345678.part": b"mine",
    ".frame_00000.npz.notmine8.part": b"mine",
    "frame.npz": b"mine",
    "counterexamples/holiday.jpg": b"mine",
    "counterexamples/frame_00000_0-1.npz": b"mine",
}


def put(folder: Path, files: dict[str, bytes] = FOREIGN) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def untouched(folder: Path, files: dict[str, bytes] = FOREIGN) -> None:
    for name, content in files.items():
        assert (folder / name).read_bytes() == content, name


# ---------------------------------------------------------------- files of others


def test_a_search_leaves_the_files_of_others_alone(tmp_path: Path) -> None:
    put(tmp_path)
    for resume in (False, True, False):
        store = open_store(tmp_path, resume=resume)
        fill(store, search_of())
        for data in (b"first", b"first", b"second"):
            store.keep_image("frame_00000_0-1", data)
        store.close()
        untouched(tmp_path)
    names = {file.name for file in (tmp_path / IMAGES).iterdir()}
    assert names == {"holiday.jpg", "frame_00000_0-1.npz", "frame_00000_0-1_2.npz"}
    assert (tmp_path / IMAGES / "frame_00000_0-1_2.npz").read_bytes() == b"second"


def test_a_stored_image_that_claims_too_much_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who has a copy of a result may have changed it: an image is read if it is of the pose and has a usual size."""
    pose, image, file = np.array([0.25]), np.ones((8, 8, 3), np.float32), tmp_path / "image.npz"

    def stored(**arrays: Any) -> Any:
        np.savez_compressed(file, **{"values": pose, "image": image, **arrays})
        return certificate_report._image_at(file, pose)

    assert np.array_equal(stored(), image)
    assert stored(values=pose + 1.0) is None and stored(image=image.astype(np.float64)) is None
    assert stored(image=image[0]) is None and stored(values=np.zeros(3)) is None
    monkeypatch.setattr(certificate_report, "_MOST_NUMBERS", 191)
    assert stored() is None
    file.write_bytes(b"none")
    assert certificate_report._image_at(file, pose) is None
    np.savez(file, values=pose)
    assert certificate_report._image_at(file, pose) is None


def test_a_new_search_removes_the_images_of_the_last_one(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    store.keep_image("frame_00000_0-1", b"ours")
    store.keep_image("frame_00000_1-2", b"ours, then changed")
    store.close()
    (tmp_path / IMAGES / "frame_00000_1-2.npz").write_bytes(b"changed by hand")
    open_store(tmp_path).close()
    assert [file.name for file in (tmp_path / IMAGES).iterdir()] == ["frame_00000_1-2.npz"]


def test_frames_are_bounded_beside_the_files_of_others(tmp_path: Path) -> None:
    put(tmp_path)
    claim(tmp_path).close()
    for start in (Report, partial(Report, keep_stored=True)):
        report = start(tmp_path, run(frames=(0,)))
        report.add(frame(0), picture=False)
        untouched(tmp_path)


def test_a_search_does_not_go_on_with_a_report_of_another_command(tmp_path: Path) -> None:
    claim(tmp_path).close()
    Report(tmp_path, run(frames=(0,))).add(frame(0), picture=False)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(InputError) as caught:
        open_store(tmp_path, resume=True)
    assert caught.value.field == "--resume" and str(tmp_path / "report.json") in str(caught.value)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
    # who does not resume begins a search
    open_store(tmp_path).close()


@pytest.mark.parametrize("name", ["frame_00003.npz", "frame_00000.png", "report.json", "report.html", "cells.sqlite"])
def test_results_of_others_are_not_replaced(tmp_path: Path, name: str) -> None:
    put(tmp_path, {name: b"mine"})
    with pytest.raises(InputError, match=f"{name} stands there"):
        claim(tmp_path)
    with pytest.raises(InputError, match=f"{name} stands there"):
        open_store(tmp_path)
    untouched(tmp_path, {name: b"mine"})
    assert os.listdir(tmp_path) == [name]


def test_own_results_are_known_without_the_mark(tmp_path: Path) -> None:
    report = Report(tmp_path, run(frames=(0,)))
    report.add(frame(0), picture=False)
    claim(tmp_path).close()
    (tmp_path / MARK).unlink()
    claim(tmp_path).close()


def test_only_own_parts_are_removed(tmp_path: Path) -> None:
    claim(tmp_path).close()
    parts = [".frame_00001.npz.0123abcd.part", ".report.html.0123abcd.part", ".cells.sqlite.01234567.part"]
    foreign = {".frame_00001.npz.0123abcg.part": b"", ".thesis.docx.0123abcd.part": b"", "frame_1.npz.part": b""}
    put(tmp_path, foreign | dict.fromkeys(parts, b"half"))
    (tmp_path / ".frame_00002.npz.0123abcd.part").mkdir()
    (tmp_path / ".report.json.0123abcd.part").symlink_to(tmp_path / "frame_1.npz.part")
    remove_parts(tmp_path)
    left = {".frame_00002.npz.0123abcd.part", ".report.json.0123abcd.part", MARK, *foreign}
    assert set(os.listdir(tmp_path)) == left


def test_parts_of_images_are_removed(tmp_path: Path) -> None:
    """A kill while the image of a counterexample is written."""
    names = [
        f".{name}.npz.0123abcd.part" for name in ("frame_00000_3-4", "frame_00012_3-4_0-1_2", "frame_00000_pose_7")
    ]
    images = tmp_path / "out" / IMAGES
    put(images, dict.fromkeys(names, b"half"))
    put(tmp_path / "out", FOREIGN)
    open_store(tmp_path / "out").close()
    assert not [name for name in names if (images / name).exists()]
    untouched(tmp_path / "out")
    # a link leads to a folder that is not locked
    put(tmp_path / "elsewhere", dict.fromkeys(names, b"half"))
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / IMAGES).symlink_to(tmp_path / "elsewhere")
    open_store(tmp_path / "new").close()
    untouched(tmp_path / "elsewhere", dict.fromkeys(names, b"half"))


# ---------------------------------------------------------------- one at a time


def _mark_anew(folder: Path) -> None:
    (folder / MARK).unlink()
    (folder / MARK).touch()


@pytest.mark.parametrize("change, held", [
    (lambda folder: None, True),
    (lambda folder: (folder / MARK).unlink(), True),
    (_mark_anew, False),
    (lambda folder: shutil.rmtree(folder) or claim(folder).close(), False),
    (lambda folder: folder.rename(folder.with_name("moved")) and folder.mkdir(), False),
    (shutil.rmtree, False),
])  # fmt: skip
def test_results_are_not_written_to_a_folder_that_replaced_the_locked_one(
    change: Callable[[Path], object], held: bool, tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    first = claim(folder)
    (folder / "below").mkdir()
    change(folder)
    if folder.exists():
        (folder / "below").mkdir(exist_ok=True)
    for file in (folder / "report.json", folder / "below" / "report.json"):
        if held:
            write_json(file, 1)
            continue
        with pytest.raises(OSError):
            write_json(file, 1)
        assert not file.exists()
    write_json(tmp_path / "elsewhere.json", 1)
    # what is no longer claimed is free
    first.close()
    (folder / "below").mkdir(parents=True, exist_ok=True)
    write_json(folder / "below" / "report.json", 2)


def test_a_command_whose_folder_was_replaced_ends_with_one_line(
    blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_process: InProcess
) -> None:
    """The folder belongs to another command by the time that the first result comes: nothing is written there."""
    folder = tmp_path / "out"
    add = Report.add

    def replaced(self: Report, *given: Any, **more: Any) -> Any:
        if not (folder / "other").exists():
            shutil.rmtree(folder)
            claim(folder).close()
            (folder / "other").touch()
        return add(self, *given, **more)

    monkeypatch.setattr(Report, "add", replaced)
    code, _, err = in_process(render_main, blobs.options(folder, frames=0, workers=1, time_budget=5))
    assert code == 2 and "removed or replaced" in err and err.count("error:") == 1
    assert sorted(file.name for file in folder.iterdir()) == [MARK, "other"]


def test_a_folder_is_claimed_by_one_command(tmp_path: Path) -> None:
    first = claim(tmp_path / "new" / "out")
    with pytest.raises(InputError, match="locked by a command"):
        claim(tmp_path / "new" / "out")
    with pytest.raises(InputError, match="locked by a command"):
        open_store(tmp_path / "new" / "out")
    first.close()
    claim(tmp_path / "new" / "out").close()


def test_the_lock_ends_with_its_process(tmp_path: Path) -> None:
    code = "import sys, time; from pathlib import Path; from ns_abstract.io.folder import claim\n"
    code += "held = claim(Path(sys.argv[1])); print('held', flush=True); time.sleep(600)"
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="locked"):
            claim(tmp_path)
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    claim(tmp_path).close()


def test_the_mark_is_no_way_to_other_files(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / MARK).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="cannot be written"):
        claim(tmp_path / "out")
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENOSPC, "make room"), (errno.ENOTDIR, "name a folder"), (errno.EROFS, "where files may be made")],
)
def test_what_to_do_depends_on_what_went_wrong(number: int, words: str) -> None:
    assert words in str(unwritable(Path("out"), OSError(number, os.strerror(number))))


def test_a_file_as_output_folder(tmp_path: Path) -> None:
    put(tmp_path, {"file": b"mine"})
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="name a folder"):
            claim(folder)
    untouched(tmp_path, {"file": b"mine"})


# ---------------------------------------------------------------- forged results


def forge(file: Path, text: str) -> None:
    with sqlite3.connect(file) as base:
        base.execute(text)


@pytest.mark.slow_cases(every=4)
@pytest.mark.parametrize(
    "text",
    [
        "UPDATE cells SET margin = margin + 1e-9 WHERE rowid = (SELECT min(rowid) FROM cells WHERE margin IS NOT NULL)",
        "UPDATE cells SET verdict = 'certified', margin = 1.0 WHERE verdict != 'certified'",
        "DELETE FROM cells WHERE rowid = 1",
        "INSERT INTO cells SELECT * FROM cells LIMIT 1",
        "DELETE FROM search_blocks",
        "UPDATE search_frames SET certified = total, falsified = '0', unknown = '0'",
        "UPDATE parameters SET unit = 'km'",
        "UPDATE search_state SET value = '[1, 2]' WHERE key = 'open_rows'",
        "UPDATE search_state SET value = 'text' WHERE key = 'open_rows'",
        "UPDATE search_state SET value = '3 4' WHERE key = 'seconds'",
        "UPDATE search_state SET value = '[]' WHERE key = 'fingerprint'",
        "DELETE FROM search_state WHERE key = 'fingerprint'",
        "DELETE FROM search_state WHERE key = 'seals'",
        "DROP TABLE search_blocks",
        "DROP TABLE cells",
    ],
)
def test_a_search_that_was_edited_is_not_continued(tmp_path: Path, text: str) -> None:
    store = open_store(tmp_path)
    fill(store, search_of(), 3)
    store.finish({0: search_of().grid})
    store.close()
    forge(tmp_path / "cells.sqlite", text)
    with pytest.raises(InputError, match=r"cells\.sqlite") as caught:
        open_store(tmp_path, resume=True)
    assert caught.value.fix is not None
    # and the lock is given back
    open_store(tmp_path).close()


@pytest.mark.slow_cases(every=5)
@pytest.mark.parametrize("place", range(0, 100, 7))
def test_damage_is_noticed_or_without_effect(tmp_path: Path, place: int) -> None:
    store = open_store(tmp_path)
    fill(store, search_of(), 9)
    before = store.tallies(), store.leaves(0), store.open_blocks
    store.close()
    file = tmp_path / "cells.sqlite"
    data = bytearray(file.read_bytes())
    begin = len(data) * place // 100
    data[begin : begin + 64] = bytes(b ^ 0x5A for b in data[begin : begin + 64])
    file.write_bytes(data)
    try:
        store = open_store(tmp_path, resume=True)
    except InputError as error:
        assert "cells.sqlite" in str(error)
    else:
        assert (store.tallies(), store.leaves(0), store.open_blocks) == before
        store.close()


def test_the_report_knows_the_cells(tmp_path: Path) -> None:
    """Who edits the search together with its own seal has to edit the report as well."""
    store = open_store(tmp_path)
    fill(store, search_of(), 9)
    seal = {"rows": store.seal.rows, "sum": store.seal.text}
    (tmp_path / "report.json").write_text(json.dumps({"fingerprint": store._get("fingerprint"), "cells_seal": seal}))
    fill(store, search_of(), 2)
    store.close()
    open_store(tmp_path, resume=True).close()
    forge(tmp_path / "cells.sqlite", "UPDATE cells SET seconds = seconds + 1 WHERE rowid = 2")
    with sqlite3.connect(tmp_path / "cells.sqlite") as base:
        whole = TableChecksum()
        for row in base.execute("SELECT * FROM cells"):
            whole.add(row)
        seals = json.loads(base.execute("SELECT value FROM search_state WHERE key = 'seals'").fetchone()[0])
        seals["cells"] = [whole.rows, whole.text]
        base.execute("UPDATE search_state SET value = ? WHERE key = 'seals'", (json.dumps(seals),))
    with pytest.raises(InputError, match=r"not those of report\.json"):
        open_store(tmp_path, resume=True)


def test_a_search_killed_at_its_beginning_is_begun_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is there with its tables or not at all: half a file would be refused for ever."""

    def killed(*files: Any) -> None:
        raise KeyboardInterrupt

    for target, name in ((store_module.os, "replace"), (Store, "_put")):
        monkeypatch.setattr(target, name, killed)
        with pytest.raises(KeyboardInterrupt):
            open_store(tmp_path)
        monkeypatch.undo()
        assert {entry.name for entry in tmp_path.iterdir()} == {MARK}
        store = open_store(tmp_path, resume=True)
        assert not store.resumed and fill(store, search_of(), 1) == 1
        store.close()
        for entry in tmp_path.glob("cells.sqlite*"):
            entry.unlink()


def test_the_database_of_another_program_is_left_as_it_is(tmp_path: Path) -> None:
    open_store(tmp_path / "out").close()
    file, other = tmp_path / "out" / "cells.sqlite", tmp_path / "other.sqlite"
    forge(other, "CREATE TABLE search_state(key TEXT, value TEXT)")
    content = other.read_bytes()
    file.unlink()
    file.symlink_to(other)
    with pytest.raises(InputError, match="no regular file"):
        open_store(tmp_path / "out", resume=True)
    file.unlink()
    file.write_bytes(content)
    with pytest.raises(InputError, match="another version"):
        open_store(tmp_path / "out", resume=True)
    assert other.read_bytes() == file.read_bytes() == content
    assert not other.with_name("other.sqlite-wal").exists()


def test_a_search_that_another_program_holds_is_not_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "_BUSY", 0.1)
    store = open_store(tmp_path)
    fill(store, search_of(), 2)
    count = store.count
    store.close()
    with closing(sqlite3.connect(tmp_path / "cells.sqlite", isolation_level=None)) as base:
        base.execute("PRAGMA locking_mode=EXCLUSIVE")
        base.execute("BEGIN EXCLUSIVE")
        with pytest.raises(InputError, match="locked") as caught:
            open_store(tmp_path, resume=True)
        assert caught.value.fix is not None and "--resume; finished cells are kept" in caught.value.fix
        base.execute("ROLLBACK")
    store = open_store(tmp_path, resume=True)
    assert store.count == count
    store.close()


@pytest.mark.parametrize("said", ["database or disk is full", "disk I/O error", "attempt to write a readonly database"])
def test_no_room_is_no_reason_to_begin_anew(tmp_path: Path, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store(tmp_path)
    fill(store, search_of(), 2)
    store.close()

    def fails(*rest: Any) -> None:
        raise sqlite3.OperationalError(said)

    monkeypatch.setattr(Store, "_verify", fails)
    with pytest.raises(InputError, match=said) as caught:
        open_store(tmp_path, resume=True)
    assert caught.value.fix is not None and "without --resume" not in caught.value.fix


def test_seals_know_rows_and_no_order() -> None:
    rows = [(0, "[0.0]", 0.5, None), (1, "[0.0]", 0.5, None), (0, "[0.0]", 0.25, None)]
    one, other, less = TableChecksum(), TableChecksum(), TableChecksum()
    for row in rows:
        one.add(row)
    for row in reversed(rows):
        other.add(row)
    for row in rows[:2]:
        less.add(row)
    assert one == other != less
    one.add(rows[2], -1)
    assert one == less and len(one.text) == 64
    one.add(rows[1], -1)
    one.add(rows[0], -1)
    assert one == TableChecksum()


def test_an_edited_frame_is_computed_again(tmp_path: Path) -> None:
    report = Report(tmp_path, run(frames=(0, 1), fingerprint=computed_by()))
    for index in (0, 1):
        report.add(frame(index, witness=0.97), picture=False)
    file = tmp_path / "frame_00000.npz"
    stored = load_frame(file)
    middle = np.float32(0.5) * (stored.result.lower + stored.result.witness_lower)
    save_frame(file, dataclasses.replace(stored.result, lower=middle), about=stored.about)
    with pytest.raises(InputError, match=r"frame_00000\.npz: not as report\.json knows it"):
        Results(tmp_path)
    again = Report(tmp_path, run(frames=(0, 1), fingerprint=computed_by()), keep_stored=True)
    assert again.kept == [1] and again.pending == [0] and "frame_00000.npz" in again.ignored[0]
    again.add(frame(0, witness=0.97), picture=False)
    np.testing.assert_array_equal(load_frame(file).result.lower, frame(0).lower)
    assert Results(tmp_path).checked
    # a frame that is edited while a command works is not made part of its own
    file = tmp_path / "frame_00001.npz"
    stored = load_frame(file)
    middle = np.float32(0.5) * (stored.result.lower + stored.result.witness_lower)
    save_frame(file, dataclasses.replace(stored.result, lower=middle), about=stored.about)
    again.add(frame(1, witness=0.97), picture=False)
    np.testing.assert_array_equal(load_frame(file).result.lower, frame(1).lower)
    # without its report nothing is believed, and exports say so
    (tmp_path / "report.json").unlink()
    assert not Results(tmp_path).checked
    assert Report(tmp_path, run(frames=(0, 1), fingerprint=computed_by()), keep_stored=True).kept == []


def test_stored_frames_are_read_where_their_digests_are_known() -> None:
    """By the report that goes on with them and by exports; what the viewer shows, it has computed itself."""
    package = Path(ns_abstract.__file__).parent
    readers = {
        path.relative_to(package).as_posix(): text
        for path in package.rglob("*.py")
        if re.search(r"\bload_frame\b", text := path.read_text())
    }
    # these read what the report, or the export's results, have checked
    checked = {"report/recordings.py": "report.export import Results"}
    assert readers.keys() == {"report/files.py", "report/record.py", "report/export.py", *checked}
    assert all("frame_digests" in readers[name] for name in ("report/record.py", "report/export.py"))
    assert all(word in readers[name] for name, word in checked.items())


def test_digests_of_a_damaged_report(tmp_path: Path) -> None:
    Report(tmp_path, run(frames=(0,))).add(frame(0), picture=False)
    document = read(tmp_path)
    for digests in (None, [], [1], {"frame_00000.npz": 3}, {"a": "b"}, "sha256"):
        (tmp_path / "report.json").write_text(json.dumps(document | {"sha256": digests}))
        assert Report(tmp_path, run(frames=(0,)), keep_stored=True).kept == []
        (tmp_path / "frame_00000.npz").unlink()
        Report(tmp_path, run(frames=(0,))).add(frame(0), picture=False)
