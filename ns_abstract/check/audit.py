"""Draws claims of a result at random and settles each: proved, refuted or not settled in time (docs/check.md)."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.claims import Claims
from ns_abstract.check.inputs import BadInput, dataset_scale, read_json, read_poses, read_scene, reading, stated_set
from ns_abstract.check.loops import LoopRuns
from ns_abstract.check.pictures import Picture
from ns_abstract.check.results import StoredCells, entries_of, read_cells, read_report, read_verdicts, structural_faults
from ns_abstract.check.splats import RULES
from ns_abstract.check.verdicts import Verdicts, class_margin, statement_margin


class ClaimOutcome(NamedTuple):
    """The outcome of one claim."""

    #: True: proved; False: refuted; None: open when its time was over.
    verdict: bool | None
    #: Whether of every float32 evaluation, else of real numbers.
    float32: bool
    #: Whether it was drawn so.
    uniform: bool
    #: Pose and excess of a refuted claim, else empty.
    refutation: dict[str, Any]


def open_result(folder: Path, moved: dict[str, Path | None]) -> tuple[list[str], list[Claims], list[int]]:
    """Return the faults of a result's files as sentences, its kinds of claims, and the frames without claims.

    A frame has no claims where it is missing or its cells do not cover the set. ``moved``: where input files lie now,
    by setting. Raises BadInput where a file cannot be used.
    """
    report, name = read_report(folder), folder / "report.json"
    with reading(name, "is not the report of a result", "make the result again"):
        parts, subjects, frames = _open_parts(folder, report, moved)
        wrong = [f"frame {c.index}: {text}" for c in parts for text in structural_faults(c, report)]
        wrong += [] if not parts or parts[0].verdicts is None else _overall(report, parts, frames)
        if not subjects and not wrong:
            raise BadInput("claims nothing: no cell has a result or verdict", name, fix="finish it: --resume")
    return wrong, subjects, sorted(frames.difference(c.index for c in parts))


def _overall(report: dict[str, Any], parts: list[StoredCells], frames: Collection[int] | None = None) -> list[str]:
    """Return contradictions of the report's verdict and coverage to the cells, ``parts``, and the frames asked for."""
    entries, kinds = entries_of(report), {c.index: {v[0] for v in c.verdicts or ()} for c in parts}
    wrong = [
        f"frame {k}: no cells" for k, e in entries.items() if k not in kinds and (e["certified"] or e["falsified"])
    ]
    for kind, said in (report.get("coverage") or {}).items():
        if not abs(sum(e[kind] for e in entries.values()) / len(entries) - said) <= 1e-9:
            wrong.append(f"the report says {said:.9g} of all sets are {kind}, its frames do not")
    whole, verdict = [k for k in entries if kinds.get(k) == {"certified"}], "unknown"
    if any("falsified" in verdicts for verdicts in kinds.values()):
        verdict = "falsified"
    elif report.get("kind") == "loop" and whole:
        verdict = ("safe", "reaches")[whole[-1]]
    elif report.get("kind") != "loop" and len(whole) == len(report["frames"]) == len(frames or entries):
        verdict = "certified"
    return wrong + [f"the verdict is {verdict}, the report says {report['verdict']}"] * (report["verdict"] != verdict)


def settle_claims(subjects: list[Claims], claims: int, seconds: float, seed: int) -> Iterator[ClaimOutcome]:
    """Draw claims while there is time, every second one uniformly, else to hunt for faults; yield their outcomes."""
    end, rng = time.monotonic() + seconds, np.random.default_rng(seed)
    sizes = np.array([s.count for s in subjects], np.float64)
    for number in (number for number in range(claims) if time.monotonic() < end):
        subject, start = subjects[int(rng.choice(len(subjects), p=sizes / sizes.sum()))], time.monotonic()
        claim, share = subject.draw(rng, hunted=number % 2 == 1), 4.0 * (end - start) / (claims - number)
        with reading("report.json", "says what this program cannot follow", "make the result again"):
            settled = subject.settle(claim, min(start + share, end))
        refutation = {"frame": subject.cells.index, **subject.label(claim), **settled[2]} if settled[0] is False else {}
        yield ClaimOutcome(*settled[:2], number % 2 == 0, refutation)


def _open_parts(folder: Path, report: dict[str, Any], moved: dict[str, Path | None]) -> tuple[Any, ...]:
    """Return the cells by frame or question, the claims about them, and the numbers of all frames asked for."""
    settings, renderer, name = report["settings"], report["renderer"], folder / "report.json"
    if not (renderer["name"] == "gsplat" and renderer["version"] in RULES) and renderer["name"] != "nerf-uniform":
        problem = f"found {renderer['name']} {renderer.get('version')}, and this program checks gsplat and nerf-uniform"
        raise BadInput(problem, name, "renderer", "give a result of a splat, or of vanilla-nerf at uniform samples")
    if report.get("guarantee") not in ("float32-sound", "real-sound"):
        raise BadInput(f"found {report.get('guarantee')!r}: nothing is claimed", name, "guarantee")

    def file(key: str) -> Path:
        value = moved.get(key) or settings.get(key)
        if not isinstance(value, (str, Path)):
            raise BadInput("missing", name, f"settings.{key}", f"give --{key.replace('_', '-')}")
        return Path(value)

    config = file("load_config")
    scene, scale = read_scene(config, report), dataset_scale(config)
    # in units of another data set nothing is claimed
    scale = scale if scale == report["scene"]["units"]["dataset_scale"] else float("nan")
    certificate, subjects = (folder / "cells.sqlite").exists(), []
    parts = read_verdicts(folder, report) if certificate else _covered_frames(folder, report)
    for key in {"property", "loop"} & report.keys():
        stated = Path(moved.get(key) or settings.get(key) or folder)
        # a file that is gone says nothing, unless it is given
        if (moved.get(key) or stated.is_file()) and read_json(stated, key) != report[key]:
            raise BadInput(f"is not the {key} of the result", stated, fix=f"say with --{key} where that lies now")
    if report.get("kind") == "loop":
        model = moved.get("model") or file("loop").parent / report["loop"]["network"]
        subjects = [Verdicts(c, scene, report, LoopRuns(c, scene, report, model).bounds) for c in parts]
        return parts, [s for s in subjects if s.count], set()
    path, perturbation = file("camera_path_filename"), stated_set(settings, moved.get("perturbation_filename"))
    for cells in parts:
        poses, free = read_poses(path, perturbation, cells.index, settings, scale, cells.names)
        size = (poses.camera.height, poses.camera.width)
        ranges = list(zip(cells.names, cells.lower.tolist(), cells.upper.tolist(), strict=True))
        if ranges != free or (not certificate and cells.arrays["lower"].shape[:2] != size):
            fix = "give the camera path and the set of the result"
            raise BadInput(f"frame {cells.index} of the result is another set of poses or size", path, fix=fix)
        if not certificate:
            subjects.append(Picture(cells, scene, poses, report))
        elif "sha256" in report.get("model", {}):
            subjects.append(Verdicts(cells, scene, report, class_margin(scene, poses, report, file("model"))))
        else:
            subjects.append(Verdicts(cells, scene, report, statement_margin(scene, poses, report, scale)))
    asked = settings["frames"] if settings.get("frames") else range(len(read_json(path, "camera path")["camera_path"]))
    return parts, [s for s in subjects if s.count], {*asked, *(f["index"] for f in report["frames"])}


def _covered_frames(folder: Path, report: dict[str, Any]) -> list[StoredCells]:
    """Return the stored frames whose cells cover their whole set; nothing is claimed of the others."""
    parts = []
    for entry in report["frames"]:
        npz, trace = (entry.get("files") or {}).get("npz"), entry.get("trace") or [{}]
        if npz is None or entry.get("status") == "missing" or trace[-1].get("covered", 1.0) < 1.0:
            continue
        if npz != f"frame_{entry['index']:05d}.npz":
            raise BadInput(f"found {npz!r}", folder / "report.json", "frames.files.npz")
        parts.append(read_cells(folder, npz, entry["index"], report["sha256"].get(npz)))
    return parts
