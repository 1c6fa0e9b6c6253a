"""A claim about the picture alone is searched, stored and reported by `CellSearch`; nothing here knows of a network."""

from __future__ import annotations

import errno
import json
import math
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waves import Waves

from ns_abstract.api.cell_search import CellQuestion, CellSearch, Request, cell_place
from ns_abstract.execution.cancellation import Deadline, WorkCancelledError, check_cancelled
from ns_abstract.execution.engines import SerialEngine
from ns_abstract.execution.stopping import StopRequest
from ns_abstract.execution.worker_cache import Recipe
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.search_results import BlockResult, FinishedCell
from ns_abstract.verify.store import Store, fractions

BOX = ParameterBox(("x", "y"), ("m", "rad"), (-1.5, -1.0), (1.5, 1.0))
#: Certified, falsified and too narrow cells, all of them.
LEAST = 0.5


class Brightness:
    """Whether the mean of a region is more than ``least``; the margin's bound comes from linear sets alone."""

    def __init__(self, least: float = LEAST) -> None:
        self.scene, self.least = Waves((4, 4), 2), least
        self.examined: list[Cell] = []

    @property
    def fingerprint(self) -> dict[str, Any]:
        return {"least": self.least}

    @property
    def recipe(self) -> Recipe[Brightness]:
        return Recipe(Brightness, self.fingerprint, Path("brightness"))

    def margin(self, values: np.ndarray) -> float:
        return float(self.scene.image(values)[1:3, 1:3].mean(dtype=np.float64)) - self.least

    def proved(self, box: ParameterBox) -> tuple[float, np.ndarray]:
        (slopes, offsets, _, _), _, _, _ = self.scene.linear_sets(box)
        slope = slopes[1:3, 1:3].mean(axis=(0, 1, 2))
        return float(offsets[1:3, 1:3].mean() - np.abs(slope).sum()) - self.least - 1e-6, np.abs(slope)

    def examine(self, number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> BlockResult:
        leaves, children = [], []
        for cell in cells:
            check_cancelled()
            self.examined.append(cell)
            box = grid.box_of(cell)
            bound, slopes = self.proved(box)
            parts = grid.divide(cell, slopes, 0.5, 4)
            pose = min((box.middle, *box.corners()), key=self.margin)
            if bound > 0.0:
                leaves.append(FinishedCell(cell, "certified", bound, 0.0))
            elif max(map(self.margin, box.corners())) <= 0.0 or (not parts and self.margin(pose) <= 0.0):
                leaves.append(FinishedCell(cell, "falsified", self.margin(pose), 0.0, tuple(pose.tolist())))
            elif parts:
                children += [(part,) for part in parts]
            else:
                leaves.append(FinishedCell(cell, "unknown", None, 0.0, reason="the finest cell"))
        return BlockResult(tuple(leaves), tuple(children), (), len(cells), 0.0)


class BrightnessQuestion(CellQuestion[float]):
    """The claim for two sets, with a report of fractions."""

    def __init__(self, examiner: Brightness, numbers: tuple[int, ...] = (0, 1)) -> None:
        half = BOX.replace(0, 0.0, 1.5)
        self.all = {0: BOX, 1: half}
        super().__init__(examiner, [("x", "m"), ("y", "rad")], {n: self.all[n] for n in numbers}, {})
        self.states: list[str] = []

    def grid(self, number: int) -> CellGrid:
        return CellGrid.fixed(self.sets[number], (32, 32), (2, 1))

    def stored_set(self, number: int) -> ParameterBox | None:
        return self.all[number]

    def counterexamples(self, number: int, grid: CellGrid, findings: Any) -> Iterator[tuple[str, dict[str, Any]]]:
        for leaf in findings.leaves:
            if leaf.counterexample is not None:
                yield f"set_{number}_{cell_place(leaf.cell, 'pose')}", {"values": np.array(leaf.counterexample)}

    def progress(self, store: Store) -> float:
        return fractions(store.tallies()[0])["open"]

    def report(self, search: CellSearch[float], state: str) -> dict[str, Any]:
        self.states.append(state)
        document = {"state": state, "sets": {t.frame: fractions(t) for t in search.store.tallies()}}
        document |= {"fingerprint": dict(self.examiner.fingerprint)}
        document |= {"cells_seal": {"rows": search.store.seal.rows, "sum": search.store.seal.text}}
        search.last.write(document, lambda: "<html></html>")
        return document


def run(question: BrightnessQuestion, folder: Path, stop: StopRequest | None = None, **more: Any) -> CellSearch[float]:
    search = CellSearch(question, folder)
    search.run(lambda stack: SerialEngine(), stop or StopRequest(), Request(**{"budget": 600.0} | more))
    return search


def timeless(search: CellSearch[float]) -> Any:
    return {n: [{**row, "seconds": 0.0} for row in rows] for n, rows in search.rows.items()}


def test_verdicts_of_a_claim_about_the_picture(tmp_path: Path) -> None:
    """Cells tile the sets; the claim holds at every pose of certified ones, and breaks where they say."""
    examiner, opened = Brightness(), []
    question = BrightnessQuestion(examiner)
    search = run(question, tmp_path, on_open=opened.append)
    assert question.states[0] == "running" and question.states[-1] == "done" and len(opened) == 1
    rng = np.random.default_rng(0)
    for number, rows in search.rows.items():
        box = question.sets[number]
        kinds = {row["verdict"] for row in rows}
        assert {"certified", "falsified"} <= kinds
        sizes = [np.prod(np.subtract(row["upper"], row["lower"])) for row in rows]
        assert math.fsum(sizes) == pytest.approx(float(np.prod(np.subtract(box.upper, box.lower))))
        for row in rows:
            if row["verdict"] == "certified":
                cell = search.box(number, row)
                poses = [*cell.corners(), *cell.sample(10, rng)]
                assert min(map(examiner.margin, poses)) >= row["margin"] > 0.0
            elif row["verdict"] == "falsified":
                assert examiner.margin(np.array(row["counterexample"])) == row["margin"] <= 0.0
    stored = list((tmp_path / "counterexamples").glob("set_*.npz"))
    assert len(stored) == sum(row["verdict"] == "falsified" for rows in search.rows.values() for row in rows)


@pytest.mark.parametrize("fails", ["examine", "store"])
def test_a_search_that_fails_is_told_as_interrupted(
    fails: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not as one that the time budget ended, or as one that goes on."""

    def fail(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    question = BrightnessQuestion(Brightness())
    monkeypatch.setattr(question.examiner, "examine", fail)
    if fails == "store":
        # then the last report cannot be made
        monkeypatch.setattr(Store, "finish", fail)
    with pytest.raises((InputError, OSError), match="No space left"):
        run(question, tmp_path)
    assert json.loads((tmp_path / "report.json").read_text())["state"] == "interrupted"
    assert question.states == ["running", "interrupted"][: 2 if fails == "examine" else 1]


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [0, 1, 7])
def test_an_ended_search_loses_nothing(tmp_path: Path, blocks: int) -> None:
    whole = timeless(run(BrightnessQuestion(Brightness()), tmp_path / "whole"))
    examiner, stop = Brightness(), StopRequest()
    question = BrightnessQuestion(examiner)
    examine, calls = examiner.examine, []

    def ends(number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> BlockResult:
        calls.append(cells)
        if len(calls) > blocks:
            stop.ask()
        return examine(number, grid, cells)

    examiner.examine = ends  # type: ignore[method-assign]
    search = run(question, tmp_path / "out", stop)
    assert question.states[-1] == "interrupted" and len(calls) == blocks + 1
    assert {row["verdict"] for rows in search.rows.values() for row in rows} >= {"unknown"}
    again = BrightnessQuestion(Brightness(), (0,))
    found = run(again, tmp_path / "out", resume=True)
    # the set that was not asked for now is reported and continued, too
    assert timeless(found) == whole and again.states[-1] == "done"
    with pytest.raises(InputError, match="another least"):
        run(BrightnessQuestion(Brightness(0.4)), tmp_path / "out", resume=True)


def test_no_time_is_one_block(tmp_path: Path) -> None:
    """Of two cells: resuming with any budget gets on; none where a block may take longer than there is time."""
    for waits, count in ((True, 1), (False, 0)):
        examiner = Brightness()
        question = BrightnessQuestion(examiner)
        question.finish_one = waits
        run(question, tmp_path / str(waits), budget=0.0)
        assert len(examiner.examined) == 2 * count and question.states[-1] == "budget"
        assert json.loads((tmp_path / str(waits) / "report.json").read_text())["state"] == "budget"


def test_deadlines_divide_time_and_hear_requests() -> None:
    stop = StopRequest()
    whole = Deadline(100.0, stop)
    assert 99.0 < whole.left <= 100.0 and 39.0 < whole.within(40.0).left <= 40.0
    assert whole.within(500.0).left <= 100.0 and 69.0 < whole.before(30.0).left <= 70.0
    assert whole.extended(5.0).left > 100.0 and Deadline().left == math.inf
    parts = [whole, whole.within(1.0), whole.before(1.0), whole.extended(1.0)]
    assert not any(part() for part in parts)
    with whole.enforced():
        check_cancelled()
    stop.ask()
    assert all(part() for part in parts) and not whole.late
    with pytest.raises(WorkCancelledError), parts[1].enforced():
        check_cancelled()
    begin = time.perf_counter()
    late = Deadline(0.01)
    while not late():
        time.sleep(0.001)
    assert late.late and late.left <= 0.0 and time.perf_counter() - begin >= 0.01
