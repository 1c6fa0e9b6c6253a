"""The bisection for the largest variation of a scene, on stand-ins whose truth is known."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from ns_abstract.api.margins import Margins
from ns_abstract.execution.cancellation import Deadline, WorkCancelledError, check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.verify.scene_margin import CellOutcome, CertifiedBox, VariationKind, check_scenes, largest_radius
from ns_abstract.verify.store import Store

KIND = VariationKind("color", "every colour", "of 1", 0.01, 1.0)
#: What may vary at x: less where x is large. Bounds lose a quarter of a cell's width.
TRUTHS = (lambda x: 0.5 - 0.3 * x, lambda x: 0.031 - 0.01 * x, lambda x: 0.2 + 0.0 * x)


def cells(count: int = 3) -> list[CertifiedBox]:
    """Cells of x, the last one first by what was proved of it."""
    return [
        CertifiedBox(k, ParameterBox(("x",), ("m",), (0.0,), (1.0,)), float(count - k), 1.0 / count)
        for k in range(count)
    ]


def settle(radius: float, frame: int, box: ParameterBox) -> CellOutcome:
    check_cancelled()
    (low,), (high,) = box.lower, box.upper
    if TRUTHS[frame](high) - radius - 0.25 * TRUTHS[frame](0.0) * (high - low) > 0.0:
        return CellOutcome("holds", "", np.ones(1))
    if TRUTHS[frame](high) <= radius:
        return CellOutcome("falsified", "", np.ones(1), {"radius": np.array(radius)})
    return CellOutcome("unknown", "the bound is wide", np.ones(1))


def test_the_margin_is_that_of_the_weakest_cell() -> None:
    found = largest_radius(KIND, cells(), settle, lambda: False)
    # of all cells at every x, less what bounds lose even in parts
    assert 0.017 < found.radius < 0.021 and found.state == "done" and found.part == pytest.approx(1.0)
    assert found.failing is not None and found.failing.radius <= 1.15 * found.radius
    assert found.falsified is not None and 0.021 <= found.falsified.radius < 0.05
    assert found.example is not None and found.example["radius"] == found.falsified.radius
    # what a report says was tried
    held = [trial for trial in found.trials if trial.outcome == "holds" and trial.radius >= found.radius]
    assert {trial.cell for trial in held} == {0, 1, 2}
    entry = found.entry
    assert entry["radius"] == found.radius and entry["runs"] == len(found.trials)
    assert f"off by {found.radius:.4g} of 1" in entry["text"] and float(f"{found.radius:.4g}") == found.radius


def test_parts_that_are_not_proved_count() -> None:
    """A cell holds but for its last part, however it is cut."""

    def hole(radius: float, frame: int, box: ParameterBox) -> CellOutcome:
        bad = box.upper[0] > 0.999 or box.upper[0] - box.lower[0] > 0.3
        return CellOutcome("unknown" if bad else "holds", "a hole", np.ones(1))

    found = largest_radius(KIND, cells(1), hole, lambda: False)
    assert found.radius == 0.0 and found.falsified is None and found.state == "done"
    assert "0: not even" in found.sentence and "a hole" in found.sentence


def test_no_radius_beyond_the_largest_is_claimed() -> None:
    found = largest_radius(KIND, cells(), lambda *_: CellOutcome("holds", "", np.ones(1)), lambda: False)
    assert found.radius == KIND.largest and found.failing is None and "no larger one was tried" in found.sentence


@pytest.mark.parametrize("asked", range(0, 24, 3))
def test_an_end_claims_no_more_than_was_proved(asked: int) -> None:
    """Wherever the work ends: what is told holds of cells that were looked at, or of all."""
    left = asked

    def over() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    found = largest_radius(KIND, cells(), settle, over)
    whole = largest_radius(KIND, cells(), settle, lambda: False)
    assert found.radius in (0.0, whole.radius)
    if found.radius == 0.0:
        assert found.state == "ended" and found.part < 1.0 and "ended first" in found.sentence
    assert found.trials == [] or [t.radius for t in found.trials] == [
        t.radius for t in whole.trials[: len(found.trials)]
    ]


def test_nothing_is_swallowed() -> None:
    def broken(radius: float, frame: int, box: ParameterBox) -> CellOutcome:
        raise RuntimeError("a fault")

    with pytest.raises(RuntimeError, match="a fault"):
        largest_radius(KIND, cells(), broken, lambda: False)

    def given_up(radius: float, frame: int, box: ParameterBox) -> CellOutcome:
        raise WorkCancelledError

    found = largest_radius(KIND, cells(), given_up, lambda: False)
    assert found.radius == 0.0 and found.state == "ended" and not found.trials


def test_a_resumed_command_settles_nothing_twice(tmp_path: Path) -> None:
    """Interrupted after any number of cells, a margin is what it is in one go."""

    def begun(resume: bool) -> Store:
        fixed: dict[int, dict[str, float]] = {k: {} for k in range(3)}
        return Store(tmp_path, {"scene": 1}, [("x", "m")], fixed, resume=resume)

    whole, asked = largest_radius(KIND, cells(), settle, lambda: False), []

    def counted(radius: float, frame: int, box: ParameterBox) -> CellOutcome:
        found = settle(radius, frame, box)
        asked.append((radius, frame, box, found.outcome))
        return found

    for stops in (1, 9, 1000):
        store, left = begun(bool(asked)), stops

        def stop() -> bool:
            nonlocal left
            left -= 1
            return left < 0

        margins = Margins(cells(), lambda kind: counted, store)
        margins.find(Deadline(1e6, stop), [KIND])
        assert margins.results[0].state == ("done" if stops == 1000 else "ended")
        store.close()
    (found,) = margins.results
    assert found.radius == whole.radius and found.example == whole.example
    assert [(t.cell, t.radius, t.outcome, t.parts) for t in found.trials] == [
        (t.cell, t.radius, t.outcome, t.parts) for t in whole.trials
    ]
    # scenes that break what is certified are found again, for they are not stored with the rest
    kept = [entry[:3] for entry in asked if entry[3] != "falsified"]
    assert len(kept) == len(set(kept)) > 10
    # what others put there is noticed
    with closing(sqlite3.connect(tmp_path / "cells.sqlite")) as base, base:
        assert base.execute("UPDATE search_settled SET outcome = 'holds' WHERE outcome = 'unknown'").rowcount > 0
    with pytest.raises(InputError, match="changed since it was written"):
        begun(True)


@pytest.mark.parametrize(("varied", "rays"), [(True, False), (False, True)])
def test_sets_without_a_margin_are_refused(varied: bool, rays: bool) -> None:
    with pytest.raises(InputError, match="--scene-margin"):
        check_scenes(varied, rays)
    check_scenes(False, False)


def test_single_poses_have_margins() -> None:
    one = CertifiedBox(0, ParameterBox((), (), (), ()), 0.5, 1.0)

    def work(radius: float, frame: int, box: ParameterBox) -> CellOutcome:
        return CellOutcome("holds" if radius < 0.07 else "unknown", "wide", np.zeros(0))

    found = largest_radius(KIND, [one], work, lambda: False)
    assert 0.06 < found.radius < 0.07 and len(found.trials) < 20
