"""The work of ``ns-abstract-certify``; imported only when it is asked for."""

from __future__ import annotations

import dataclasses
import io
import os
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ns_abstract.atomic import write_atomic
from ns_abstract.certification import Certification, CertifySettings, examine_block
from ns_abstract.engines import Cluster, Engine, Here, Processes, connected
from ns_abstract.jsonio import load_json
from ns_abstract.methods.runs import available_memory
from ns_abstract.pipeline import check_frames
from ns_abstract.report.certificate import CertifiedRun, certificate_document, coverage, write_certificate
from ns_abstract.report.certificate_page import certificate_page, percent
from ns_abstract.report.picture import preview, to_bytes
from ns_abstract.report.record import file_stamp
from ns_abstract.sets.box import ParameterBox
from ns_abstract.verify.cells import Grid
from ns_abstract.verify.search import Findings
from ns_abstract.verify.store import Block, Store, fractions
from ns_abstract.verify.substitution import MODES, STEP, Comparison, compare, gains, spread_by_volume

if TYPE_CHECKING:
    from ns_abstract.cli.certify import Certify

#: Seconds between looks at results and at a request to stop, between notes of progress, and between reports.
_PATIENCE, _TRACE, _REPORT = 0.5, 1.0, 30.0
#: Counterexamples in report.json by frame, and images of each kind on the page.
_EXAMPLES, _IMAGES = 5, 6
_PIXELS = 256
#: Cells that are bounded in weaker ways besides, part of the time for it, and seconds that it may always take.
_COMPARED, _COMPARE_SHARE, _COMPARE_LEAST = 5, 0.03, 1.0
#: Most bytes for the bounds of one process.
_BOUND_BYTES = 1 << 30


class _Run:
    """One command."""

    def __init__(self, options: Certify, console: Console) -> None:
        self.options, self.console = options, console
        self.workers = options.workers or len(os.sched_getaffinity(0))
        free = available_memory()
        limit = options.memory_limit * 2**30 if options.memory_limit else 0.8 * free if free is not None else 8 << 30
        names = {field.name for field in dataclasses.fields(CertifySettings)}
        given = {name: value for name, value in vars(options).items() if name in names}
        # half: images and torch need room beside the bounds; a power of two, so that it hardly depends on the moment
        memory = min(_BOUND_BYTES, 1 << int(np.log2(max(2.0, 0.5 * limit / self.workers))))
        self.settings = CertifySettings(**given, memory=memory).absolute()
        self.job = Certification(self.settings)
        self.frames = check_frames(options.frames, self.job.job.frame_count)
        self.grids: dict[int, Grid] = {}
        self.about = self._about()

    def _about(self) -> CertifiedRun:
        job, prop = self.job, self.job.property
        return CertifiedRun(
            guarantee=job.job.method.guarantee,
            network_guarantee=tuple(job.network.guarantee),
            renderer={"name": job.job.rasteriser.name, "version": job.job.rasteriser.version},
            scene=job.job.describe(),
            model={
                **file_stamp(self.settings.model),
                "input": job.network.input_shape,
                "output": job.network.output_shape,
            },
            property=load_json(self.settings.property),
            sentence=prop.sentence(),
            settings=dataclasses.asdict(self.options),
            fingerprint=job.fingerprint,
            command=("ns-abstract-certify", *sys.argv[1:]),
            plan=(*job.job.plan, *prop.notes),
        )

    def open(self) -> Store:
        """The store, with the frames begun."""
        folder = self.options.output_dir
        store = Store(
            folder, self.job.fingerprint, self.job.parameters, self.job.fixed, resume=self.options.resume
        )
        if not store.resumed:
            shutil.rmtree(folder / "counterexamples", ignore_errors=True)
        for index in self.frames:
            grid = store.grid(index, self.job.job.pose_sets[index].box)
            if grid is None:
                grid = self.job.grid(index)
                store.begin(index, grid, self.job.first_blocks(grid))
            self.grids[index] = grid
        # frames of an earlier command that were not asked for now
        for tally in store.tallies():
            if tally.frame not in self.grids:
                box = self.job.job.pose_sets[tally.frame].box
                stored = store.grid(tally.frame, box)
                assert stored is not None
                self.grids[tally.frame] = stored
        return store

    def engine(self, stack: ExitStack) -> Engine:
        """Where blocks are examined."""
        options = self.options
        if options.engine == "dask":
            engine: Engine = Cluster(stack.enter_context(connected(options.scheduler_address, self.workers)))
        else:
            engine = Here() if self.workers == 1 else Processes(self.workers)
        stack.callback(engine.close)
        return engine

    def search(self, store: Store, engine: Engine, deadline: float, stop: Callable[[], bool]) -> None:
        """Examine open blocks until none is left, the time is over or ``stop`` says so."""
        flying: dict[int, Block] = {}
        settled = 0
        traced = reported = time.perf_counter()
        with self._progress() as progress:
            task = progress.add_task("cells", total=1.0, state="")
            while not stop():
                # one block is always waited for, so that resuming with any budget gets on
                late = time.perf_counter() >= deadline
                if late and settled:
                    break
                if not late or not flying:
                    for block in store.pending(set(flying), engine.capacity - len(flying)):
                        flying[block.number] = block
                        grid = self.grids[block.frame]
                        fingerprint = self.job.fingerprint
                        engine.submit(
                            block.number, examine_block, self.settings, fingerprint, block.frame, grid, block.cells
                        )
                if not flying:
                    break
                for number, findings in engine.collect(_PATIENCE):
                    block = flying.pop(number)
                    self._keep_images(block, findings)
                    store.settle(block, findings, self.grids[block.frame])
                    settled += 1
                now = time.perf_counter()
                if now - traced >= _TRACE:
                    traced = now
                    store.trace()
                    self._tell(progress, task, store)
                if now - reported >= _REPORT:
                    reported = now
                    self.report(store, "running")
        store.trace()

    def _progress(self) -> Progress:
        console = self.console
        return Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn(),
            TimeRemainingColumn(), console=console, disable=not console.is_terminal, transient=True,
        )  # fmt: skip

    def _tell(self, progress: Progress, task: Any, store: Store) -> None:
        shares = [fractions(tally) for tally in store.tallies()]
        mean = {key: sum(s[key] for s in shares) / len(shares) for key in shares[0]}
        state = ", ".join(f"{key} {percent(mean[key])}" for key in ("certified", "falsified", "unknown"))
        progress.update(task, completed=1.0 - mean["open"], state=state)

    def _keep_images(self, block: Block, findings: Findings) -> None:
        """Store the images of counterexamples before the cells are said to be falsified."""
        for leaf in findings.leaves:
            if leaf.counterexample is None or leaf.image is None or leaf.outputs is None:
                continue
            folder = self.options.output_dir / "counterexamples"
            folder.mkdir(exist_ok=True)
            place = "_".join(f"{a}-{b}" for a, b in zip(leaf.cell.first, leaf.cell.past, strict=True)) or "pose"
            values = np.array(leaf.counterexample)
            buffer = io.BytesIO()
            np.savez(
                buffer,
                image=leaf.image,
                outputs=leaf.outputs,
                values=values,
                names=np.array(self.grids[block.frame].box.names, str),
                camera_to_world=self.job.job.pose_sets[block.frame].pose(values),
                margin=np.array(np.nan if leaf.margin is None else leaf.margin),
            )
            data = buffer.getvalue()
            file = folder / f"frame_{block.frame:05d}_{place}.npz"
            write_atomic(file, lambda stream, data=data: stream.write(data))

    # ---------------------------------------------------------------- weaker bounds

    def compare(self, store: Store) -> dict[str, Any]:
        """Bound a few certified cells in weaker ways as well, in a small part of the search's time."""
        allowed = max(_COMPARE_LEAST, _COMPARE_SHARE * store.seconds)
        cells = [
            (tally.frame, box)
            for tally in store.tallies()
            for row in store.leaves(tally.frame, "certified")
            if (box := self._box(tally.frame, row)).dimensions
        ]
        if not cells:
            return substitution_entry([], "no cell of more than one pose is certified")
        effort = store.effort
        each = effort["worker_seconds"] / max(1, effort["cells_bounded"]) * len(MODES)
        if each > allowed:
            reason = f"bounding one cell in {len(MODES)} ways takes about {each:.0f} s, {allowed:.0f} s may be used"
            return substitution_entry([], reason)
        found: list[tuple[int, Comparison]] = []
        begin = time.perf_counter()
        for number in spread_by_volume([_volume(self.grids[frame].box, box) for frame, box in cells], _COMPARED):
            frame, box = cells[number]
            result = compare(self.job.search(frame, self.grids[frame]), box, begin + allowed)
            if result is None:
                break
            found.append((frame, result))
        reason = None if found else f"the time for it, {allowed:.0f} s, was over before one cell was done"
        return substitution_entry(found, reason, time.perf_counter() - begin)

    def _box(self, frame: int, row: Mapping[str, Any]) -> ParameterBox:
        """A cell that was read back."""
        names, box = [name for name, _ in self.job.parameters], self.grids[frame].box
        for axis, name in enumerate(box.names):
            column = names.index(name)
            box = box.replace(axis, row["lower"][column], row["upper"][column])
        return box

    # ---------------------------------------------------------------- report

    def report(self, store: Store, state: str, substitution: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Write report.json and report.html; returns the former's content."""
        rows = {tally.frame: store.leaves(tally.frame) for tally in store.tallies()}
        entries = [self._entry(tally, rows[tally.frame]) for tally in store.tallies()]
        document = certificate_document(
            self.about,
            entries,
            state=state,
            trace=store.points,
            seconds=store.seconds,
            effort=store.effort,
            reasons=store.reasons,
            substitution=substitution or substitution_entry([], "made when the search ends without being interrupted"),
        )
        write_certificate(
            self.options.output_dir, document, certificate_page(document, rows, self._pictures(rows))
        )
        return document

    def _entry(self, tally: Any, rows: list[dict[str, Any]]) -> dict[str, Any]:
        shares = fractions(tally)
        names = [name for name, _ in self.job.parameters]
        box = self.job.job.pose_sets[tally.frame].box
        fixed = self.job.fixed[tally.frame]
        sides = {n: (low, high) for n, low, high in zip(box.names, box.lower, box.upper, strict=True)}
        counts = {kind: sum(row["verdict"] == kind for row in rows) for kind in ("certified", "falsified", "unknown")}
        # cells that an ended command has left open stand as unknown without a margin or a time
        left = sum(row["verdict"] == "unknown" and row["seconds"] == 0.0 for row in rows)
        broken = _worst(rows)
        proven = [row["margin"] for row in rows if row["verdict"] == "certified"]
        total = self.job.partitions(self.grids[tally.frame])
        return {
            "index": tally.frame,
            "parameters": [
                {
                    "name": name,
                    "unit": unit,
                    "lower": sides.get(name, (fixed.get(name, 0.0),) * 2)[0],
                    "upper": sides.get(name, (fixed.get(name, 0.0),) * 2)[1],
                }
                for name, unit in self.job.parameters
            ],
            "coverage": {
                "certified": shares["certified"],
                "falsified": shares["falsified"],
                "unknown": shares["unknown"] + shares["open"],
                "not_examined": shares["open"],
            },
            "cells": {**counts, "unknown": counts["unknown"] - left, "open": left if tally.open else 0},
            "sampled": {
                "poses": tally.poses,
                "right": tally.holding,
                "sampled_right": tally.holding / tally.poses if tally.poses else None,
            },
            # unknown units were sampled and no sample broke the property
            "partition": None
            if total is None
            else {
                "partitions": total,
                "certified": tally.certified,
                "right": tally.certified + tally.unknown,
                "not_examined": tally.open,
            },
            "least_margin": min(proven, default=None),
            "counterexamples": [
                {"values": dict(zip(names, row["counterexample"], strict=True)), "margin": row["margin"]}
                for row in broken[:_EXAMPLES]
            ],
        }

    def _pictures(self, rows: Mapping[int, list[dict[str, Any]]]) -> list[dict[str, Any]]:
        """A sample, the certified image with the smallest margin, and counterexamples."""
        names = [name for name, _ in self.job.parameters]
        wanted: list[tuple[str, str, int, list[float]]] = []
        first = min(rows)
        box = self.job.job.pose_sets[first].box
        middle = dict(zip(box.names, box.middle.tolist(), strict=True))
        wanted.append(("sample", f"frame {first}, middle of its set", first, [middle.get(n, 0.0) for n in names]))
        proven = [(r["margin"], k, r) for k, found in rows.items() for r in found if r["verdict"] == "certified"]
        if proven:
            margin, frame, row = min(proven, key=lambda item: item[:2])
            pose = [0.5 * (a + b) for a, b in zip(row["lower"], row["upper"], strict=True)]
            wanted.append(("worst certified", f"frame {frame}, margin at least {margin:.4g}", frame, pose))
        broken = [(_depth(row), frame, row) for frame, found in rows.items() for row in _worst(found)]
        for _, frame, row in sorted(broken, key=lambda item: item[:2])[:_IMAGES]:
            margin = row["margin"]
            text = f"frame {frame}, margin {'not a number' if margin is None else f'{margin:.4g}'}"
            wanted.append(("counterexample", text, frame, row["counterexample"]))
        found = []
        for title, text, frame, values in wanted:
            pictures = self.job.pictures(frame)
            known = dict(zip(names, values, strict=True))
            image = pictures.image(np.array([known[name] for name in pictures.box.names]))
            found.append({"title": title, "text": text, "png": preview(to_bytes(image), _PIXELS)})
        return found


def _volume(whole: ParameterBox, part: ParameterBox) -> float:
    """The part of a set that a cell is."""
    sides = zip(part.lower, part.upper, whole.lower, whole.upper, strict=True)
    return float(np.prod([(high - low) / (most - least) for low, high, least, most in sides]))


def substitution_entry(
    compared: Sequence[tuple[int, Comparison]], skipped: str | None, seconds: float = 0.0
) -> dict[str, Any]:
    """The key ``substitution`` of report.json.

    Args:
        compared: Frames and cells.
        skipped: Why there are none, or None.
        seconds: Spent on them.
    """

    def entry(frame: int, found: Comparison) -> dict[str, Any]:
        box = found.box
        half = [0.5 * (high - low) for low, high in zip(box.lower, box.upper, strict=True)]
        return {
            "frame": frame,
            "parameters": list(box.names),
            "lower": list(box.lower),
            "upper": list(box.upper),
            "margin": {mode: value if np.isfinite(value) else None for mode, value in found.margins.items()},
            "half_width": {
                mode: None if factor is None else [factor * h for h in half] for mode, factor in found.factors.items()
            },
            "at_least": list(found.open_ended),
        }

    return {
        "modes": dict(MODES),
        "cells": [entry(frame, found) for frame, found in compared],
        "wider_than": gains([found for _, found in compared]),
        "step": STEP,
        "skipped": skipped,
        "seconds": seconds,
    }


def _depth(row: Mapping[str, Any]) -> float:
    """The margin of a counterexample; what is no number is worse than all."""
    return -np.inf if row["margin"] is None else row["margin"]


def _worst(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Falsified cells, worst first; neighbours may share their counterexample, which counts once."""
    found = sorted((row for row in rows if row["verdict"] == "falsified"), key=_depth)
    return list({tuple(row["counterexample"]): row for row in reversed(found)}.values())[::-1]


def certify_path(options: Certify, stop: Callable[[], bool], budget: float) -> bool:
    """Search the frames and write the results; returns whether every frame has one.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    console = Console(stderr=True, highlight=False)
    run = _Run(options, console)
    scene, network = run.job.job.scene, run.job.network
    console.print(f"{scene.name}: {scene.count:,} Gaussians; {network.source.name}; {run.about.sentence}", markup=False)
    for note in run.about.plan:
        console.print(f"  {note}", markup=False, soft_wrap=True)
    with ExitStack() as stack:
        store = run.open()
        stack.callback(store.close)
        if store.resumed:
            console.print(f"  {store.count} cells kept from before, {store.open_blocks} blocks open", markup=False)
        run.report(store, "running")
        substitution = None
        try:
            deadline = time.perf_counter() + (1.0 - _COMPARE_SHARE) * budget
            with ExitStack() as engines:
                run.search(store, run.engine(engines), deadline, stop)
            if not stop():
                substitution = run.compare(store)
        finally:
            # also after a failure: what is finished is written
            store.finish(run.grids)
            state = "interrupted" if stop() else "budget" if store.open_blocks else "done"
            document = run.report(store, state, substitution)
        complete = all(entry["sampled"]["poses"] for entry in document["frames"])
    covered = coverage(document["frames"])
    parts = ", ".join(f"{kind} {percent(covered[kind])}" for kind in ("certified", "falsified", "unknown"))
    console.print(f"{document['verdict']}: {parts}", markup=False)
    if document["partitions"]:
        both = document["partitions"]
        console.print(f"PCP-V {percent(both['PCP-V'])}, PCP-S {percent(both['PCP-S'])}", markup=False)
    console.print(f"report: {Path(options.output_dir) / 'report.html'}", markup=False, soft_wrap=True)
    return complete


