"""Claims of a result, drawn at random and proved, refuted or left open; see docs/check.md."""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.check.inputs import BadInput, dataset_scale, given_set, read_poses, read_scene
from ns_abstract.check.pictures import Picture
from ns_abstract.check.results import StoredCells, read_cells, read_report, read_verdicts, structure
from ns_abstract.check.splats import RULES
from ns_abstract.check.verdicts import CheckedCertificate, CheckedLoop, CheckedStatement

#: Part of the claims that must be settled; level of what is stated of all claims.
ENOUGH, CONFIDENCE = 0.8, 0.95


@dataclass
class Audit:
    """What came of the claims.

    Attributes:
        claims: Number of claims that were looked at.
        proved, refuted, unsettled: Their numbers by outcome.
        float32: Number of those proved of every float32 evaluation; the others concern the picture in real numbers.
        refutations: By refuted claim: frame, cell, pose, what is wrong.
        uniform: Claims and proofs of the uniform sample, and the least part of all claims that holds, at 95 %.
        structure: What is wrong with the cells; empty: they tile every set, every pixel is bounded, counts are right.
        seconds, median_seconds: Of all claims, and of one.
        picture: What all proved claims hold of: "real numbers", or "every float32 evaluation".
    """

    claims: int = 0
    proved: int = 0
    refuted: int = 0
    unsettled: int = 0
    float32: int = 0
    refutations: list[dict[str, Any]] = field(default_factory=list)
    uniform: dict[str, Any] = field(default_factory=dict)
    structure: list[str] = field(default_factory=list)
    seconds: float = 0.0
    median_seconds: float = 0.0
    picture: str = "real numbers"

    @property
    def exit_code(self) -> int:
        """0 nothing refuted, 1 refuted, 3 too few claims settled."""
        if self.refuted or self.structure:
            return 1
        return 3 if self.proved < ENOUGH * self.claims or not self.claims else 0


def run(
    folder: Path, *, claims: int, seconds: float, seed: int, moved: dict[str, Path | None] | None = None,
    on_claim: Callable[[Audit], object] | None = None,
) -> Audit:  # fmt: skip
    """Audit the result in ``folder`` and write ``check.json`` there.

    Args:
        folder: Output folder of a command.
        claims: Number of claims to draw.
        seconds: Time for all of them.
        seed: Of the draws.
        moved: Where files lie that have been moved since, by the name of their setting.
        on_claim: Called after every claim; False ends the audit.

    Raises:
        BadInput: A file cannot be used.
    """
    begin = time.monotonic()
    report = read_report(folder)
    try:
        parts, subjects = opened(folder, report, moved or {})
    except (KeyError, TypeError, AttributeError, IndexError, OverflowError):
        raise BadInput("is not the report of a result", folder / "report.json", fix="make the result again") from None
    if not parts:
        raise BadInput("claims nothing yet: no cell has a result", folder / "report.json", fix="finish it: --resume")
    audit = Audit(structure=[f"frame {c.index}: {text}" for c in parts for text in structure(c, report)])
    rng, sizes = np.random.default_rng(seed), np.array([s.count for s in subjects], np.float64)
    spent, uniform, sure = [], [0, 0], 0
    for number in range(0 if audit.structure else claims):
        subject = subjects[int(rng.choice(len(subjects), p=sizes / sizes.sum()))]
        claim = subject.draw(rng, hunted=number % 2 == 1)
        start = time.monotonic()
        left = begin + seconds - start
        share = min(max(4.0 * left / (claims - number), 0.0), left)
        verdict, picture, detail = subject.settle(claim, start + share) if left > 0.0 else (None, "", {})
        spent.append(time.monotonic() - start)
        audit.claims, audit.unsettled = audit.claims + 1, audit.unsettled + (verdict is None)
        audit.proved, audit.refuted = audit.proved + (verdict is True), audit.refuted + (verdict is False)
        audit.float32 += verdict is True and picture == "float32"
        if verdict is False:
            audit.refutations.append({"frame": subject.cells.index, **subject.place(claim), **detail})
        if number % 2 == 0:
            uniform, sure = [uniform[0] + 1, uniform[1] + (verdict is True)], sure + (picture == "float32")
        if on_claim is not None and on_claim(audit) is False:
            break
    audit.uniform = {"claims": uniform[0], "proved": uniform[1], "holds_at_least": least_part(uniform[1], uniform[0])}
    audit.uniform |= {"float32": sure, "float32_at_least": least_part(sure, uniform[0])}
    audit.seconds, audit.median_seconds = time.monotonic() - begin, statistics.median(spent) if spent else 0.0
    audit.picture = "every float32 evaluation" if audit.proved == audit.float32 > 0 else audit.picture
    (folder / "check.json").write_text(
        json.dumps({"version": 1, "seed": seed, **vars(audit)}, indent=1, allow_nan=False)
    )
    return audit


def opened(folder: Path, report: dict[str, Any], moved: dict[str, Path | None]) -> tuple[list[StoredCells], list[Any]]:
    """All cells of a result, and what its claims are about."""
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
    scene = read_scene(config, report)
    if report.get("kind") == "loop":
        parts = read_verdicts(folder, report)
        model = moved.get("model") or file("loop").parent / report["loop"]["network"]
        return parts, [
            CheckedLoop(c, scene, report, model, dataset_scale(config)) for c in parts if CheckedLoop.claims(c)
        ]
    path, given = file("camera_path_filename"), given_set(settings, moved.get("perturbation_filename"))
    without = "sha256" not in report.get("model", {})
    if (folder / "cells.sqlite").exists():
        parts, model = read_verdicts(folder, report), Path() if without else file("model")
    else:
        parts, model = [], None
        for entry in report["frames"]:
            npz, trace = (entry.get("files") or {}).get("npz"), entry.get("trace") or [{}]
            # where the cells do not cover the set yet nothing is claimed
            if npz is None or entry.get("status") == "missing" or trace[-1].get("covered", 1.0) < 1.0:
                continue
            if npz != f"frame_{entry['index']:05d}.npz":
                raise BadInput(f"found {npz!r}", name, "frames.files.npz")
            parts.append(read_cells(folder, npz, entry["index"], report["sha256"].get(npz)))
    subjects = []
    for cells in parts:
        poses, free = read_poses(path, given, cells.index, settings, dataset_scale(config))
        size = cells.arrays["lower"].shape[:2] if model is None else (poses.camera.height, poses.camera.width)
        ranges = list(zip(cells.names, cells.lower.tolist(), cells.upper.tolist(), strict=True))
        if ranges != free or size != (poses.camera.height, poses.camera.width):
            fix = "give the camera path and the set of the result"
            raise BadInput(f"frame {cells.index} of the result is another set of poses or size", path, fix=fix)
        if model is None:
            subjects.append(Picture(cells, scene, poses, report))
        elif CheckedCertificate.claims(cells) and without:
            subjects.append(CheckedStatement(cells, scene, poses, report, dataset_scale(config)))
        elif CheckedCertificate.claims(cells):
            subjects.append(CheckedCertificate(cells, scene, poses, report, model))
    return parts, subjects


def least_part(proved: int, count: int) -> float:
    """Clopper and Pearson's lower limit, at 95 %, of the part of all claims that holds: ``proved`` of ``count`` do."""
    if proved == 0:
        return 0.0
    low, high = 0.0, 1.0
    logs = [math.lgamma(count + 1) - math.lgamma(k + 1) - math.lgamma(count - k + 1) for k in range(proved, count + 1)]
    for _ in range(60):
        p = 0.5 * (low + high)
        rest = [(count - k) * math.log1p(-p) if count > k else 0.0 for k in range(proved, count + 1)]
        tail = sum(math.exp(c + k * math.log(p) + e) for k, (c, e) in enumerate(zip(logs, rest, strict=True), proved))
        low, high = (p, high) if tail <= 1.0 - CONFIDENCE else (low, p)
    return low
