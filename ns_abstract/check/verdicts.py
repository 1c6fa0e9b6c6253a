"""Claims of certificates and of loops: what a network does on every picture of a cell."""

from __future__ import annotations

import dataclasses
import hashlib
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ns_abstract.check.forms import Affine, Array, fixed, product, rotation, total
from ns_abstract.check.inputs import BadInput
from ns_abstract.check.networks import CheckedNetwork
from ns_abstract.check.pictures import FIRST, Verdict, divided, units
from ns_abstract.check.poses import TURNS, CameraForms, CheckedCamera, Poses
from ns_abstract.check.results import StoredCells
from ns_abstract.check.splats import FLOAT, ActivatedScene, picture

#: Boxes whose pictures go through a network together.
BATCH = 8


class _Verdicts(ABC):
    """What certificates and loops share: cells that are drawn, and pictures that go through a network."""

    kinds: tuple[str, ...] = ("certified",)

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any], model: Path, about: Any) -> None:
        self.cells, self.scene, self.units = cells, scene, units(scene, report)
        self.rows = [k for k, v in enumerate(cells.verdicts or []) if v[0] in self.kinds]
        self.count = len(self.rows)
        if not isinstance(scene, ActivatedScene):
            raise BadInput("is of a NeRF, of which this program checks pictures alone", model, "renderer")
        self.shape = about.get("preprocess") or {}
        if not model.is_file():
            raise BadInput("no such network", model, fix="say with --model where it lies now")
        if hashlib.sha256(model.read_bytes()).hexdigest() != report["model"]["sha256"]:
            raise BadInput("is not the network of the result (sha256)", model, fix="say with --model where it lies now")
        if self.shape.get("layout", "NCHW") != "NCHW" or (report.get("picture") or "float") != "float":
            raise BadInput("takes pictures that this program does not make", model, "preprocess")
        own = report["fingerprint"].get("network_arithmetic") == "float32"
        try:
            self.network = CheckedNetwork(model, about.get("output"), FLOAT if own else 0.0)
        except Exception as error:  # onnx raises whatever a damaged file makes it run into
            raise BadInput(" ".join(str(error).split())[:160] or "cannot be read", model) from None

    @classmethod
    def claims(cls, cells: StoredCells) -> bool:
        """Whether something is claimed."""
        return any(v[0] in cls.kinds for v in cells.verdicts or [])

    def draw(self, rng: Any, hunted: bool) -> int:
        """A cell with a verdict; one that is hunted has the least margin of four."""
        found = [self.rows[int(rng.integers(self.count))] for _ in range(4 if hunted else 1)]
        return min(found, key=lambda k: (self.cells.verdicts or [])[k][1] or 0.0)

    def place(self, claim: int) -> dict[str, Any]:
        """The claim for check.json."""
        return {"cell": claim, "parameters": list(self.cells.names)}

    def resized(self, camera: CheckedCamera) -> CheckedCamera:
        """The camera at the size of the network's input."""
        height, width = self.shape.get("resize") or (camera.height, camera.width)
        down, across = height / camera.height, width / camera.width
        return dataclasses.replace(
            camera, fx=camera.fx * across, fy=camera.fy * down, cx=camera.cx * across, cy=camera.cy * down,
            width=int(width), height=int(height),
        )  # fmt: skip

    def inputs(self, camera: CheckedCamera, views: list[CameraForms], unit: float) -> Affine:
        """The network's inputs [B, 3, H, W] over boxes of poses, one view each."""
        parts = [picture(self.scene, camera, view, unit) for view in views]
        image = Affine(*(np.stack([getattr(p, name) for p in parts], axis=-4) for name in ("c", "g", "r")))
        image = image.of(lambda a: np.moveaxis(a, -1, -3))
        if self.shape.get("channels", "RGB") == "BGR":
            image = image.of(lambda a: a[..., ::-1, :, :])
        low, high = self.shape.get("range") or (0.0, 1.0)
        mean, std = (np.reshape(self.shape.get(k) or [d] * 3, (3, 1, 1)) for k, d in (("mean", 0.0), ("std", 1.0)))
        size = (abs(low) + abs(high) + np.abs(mean)) / np.abs(std)
        return ((image * (high - low) + (low - mean)) * (1.0 / std)).wider(16.0 * (self.network.unit + 2.0**-53) * size)

    def settle(self, claim: int, deadline: float) -> Verdict:
        """True: proved; False: refuted, with the pose; None: open when the time was over; and of which picture."""
        low, high = (self.cells.arrays[f"box_{s}"][claim] for s in ("lower", "upper"))
        verdict, _, example = (self.cells.verdicts or [])[claim]
        if verdict == "falsified":
            point = np.array(example, np.float64)[None]
            inside = (point >= low).all() and (point <= high).all()
            if not inside or self.margins(point, point, 0.0)[0] > 0.0:
                return False, "real", {"pose": point[0].tolist(), "margin": self.most(point), "excess": 0.0}
            return (True if self.most(point) <= 0.0 else None), "real", {}
        begin, claimed = time.monotonic(), max(0.0, (self.cells.verdicts or [])[claim][1] or 0.0)
        middle = 0.5 * (low + high)[None]
        for unit in self.units:
            end, stack = begin + (deadline - begin) * (FIRST if unit else 1.0), [(low, high)]
            while stack and time.monotonic() < end:
                most = self.most(middle)
                if most < claimed * (1.0 - 1e-9):
                    detail = {"pose": middle[0].tolist(), "margin": most, "excess": claimed - most}
                    return False, "float32" if unit else "real", detail
                batch = [stack.pop() for _ in range(min(BATCH, len(stack)))]
                first, last = (np.stack([b[k] for b in batch]) for k in (0, 1))
                open_ = np.flatnonzero(~(self.margins(first, last, unit) > 0.0))
                if len(open_):
                    middle = 0.5 * (first[open_[:1]] + last[open_[:1]])
                stack += [p for k in open_ for p in divided(first[k], last[k], last[k] - first[k], high - low)]
            if not stack:
                return True, "float32" if unit and self.network.unit else "real", {}
        return None, "", {}

    @abstractmethod
    def margins(self, low: Array, high: Array, unit: float) -> Array:
        """Lower bounds [B] of how far boxes are from failing."""

    @abstractmethod
    def most(self, point: Array) -> float:
        """An upper bound of that at one point [1, d]."""


class CheckedCertificate(_Verdicts):
    """The claims of a frame's cells: a class is the largest output on every picture of a cell, or not on one."""

    kinds = "certified", "falsified"

    def __init__(self, cells: StoredCells, scene: Any, poses: Poses, report: dict[str, Any], model: Path) -> None:
        about = report["property"]
        if about.get("type") != "classification":
            raise BadInput(f"{about.get('type')!r} is a property that this program does not check", model, "type")
        super().__init__(cells, scene, report, model, about)
        self.poses, self.label = poses, int(about["label"])
        self.camera = self.resized(poses.camera)
        rows = -torch.eye(int(report["model"]["output"][-1]), dtype=torch.float64)
        rows[:, self.label] += 1.0
        self.rivals = torch.cat([rows[: self.label], rows[self.label + 1 :]])

    def _inputs(self, low: Array, high: Array, unit: float) -> Affine:
        views = [self.poses.view(low[k : k + 1], high[k : k + 1]) for k in range(len(low))]
        return self.inputs(self.camera, views, unit)

    def margins(self, low: Array, high: Array, unit: float) -> Array:
        """Lower bounds [B] of the class' output less the largest other one."""
        return self.network.least(self._inputs(low, high, unit), self.rivals).min(dim=1).values.numpy()

    def most(self, point: Array) -> float:
        """An upper bound of that at one point [1, d]."""
        return float(-self.network.least(self._inputs(point, point, 0.0), -self.rivals).max())


class CheckedLoop(_Verdicts):
    """The claims of a question about a loop: no run from a cell comes to harm, and (question 1) all reach the goal."""

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any], model: Path) -> None:
        self.loop = loop = report["loop"]
        super().__init__(cells, scene, report, model, loop)
        if loop["dynamics"].get("type") != "affine":
            raise BadInput(
                "has dynamics that this program does not follow", model, "dynamics.type", "audit an affine loop"
            )
        height, width = self.shape["resize"]
        focal = float(height / 2.0 / np.tan(float(loop["camera"]["fov"]) * (np.pi / 180.0) / 2.0))
        pose = np.array(loop["camera"]["camera_to_world"], np.float64)[:3]
        self.camera = CheckedCamera(pose, focal, focal, width / 2.0, height / 2.0, int(width), int(height))
        self.steps, self.names = int(loop["steps"]), list(loop["state"])

    def _state(self, low: Array, high: Array) -> list[Affine]:
        poses = Poses(self.camera, self.cells.names)
        given, start = poses.given(low, high), self.loop["initial"]
        zero = given[""]
        ends = {n: v if isinstance(v, (int, float)) else v[0] for n, v in start.items()}
        return [given[n] if n in given else zero + float(ends[n]) for n in self.names]

    def _view(self, x: list[Affine]) -> CameraForms:
        about = self.loop["camera"]
        position = about.get("position") or {"offset": [0.0] * 3, "matrix": [[0.0] * len(x)] * 3}
        place = [_affine(row, x, o) for row, o in zip(position["matrix"], position["offset"], strict=True)]
        turn = fixed(self.camera.pose[:, :3], x[0])
        for name, axis in TURNS.items():
            if about.get(name):
                turn = product(turn, rotation(np.array(axis), _affine(about[name]["row"], x, about[name]["offset"])))
        return CameraForms(turn, place, self.camera.pose)

    def _next(self, x: list[Affine], unit: float) -> list[Affine]:
        law, control = self.loop["dynamics"], self.loop.get("control") or {}
        count = len(x[0].c)
        views = [self._view([e.of(lambda a, k=k: a[..., k : k + 1]) for e in x]) for k in range(count)]
        y = self.network.outputs(self.inputs(self.camera, views, unit))
        y = [y.of(lambda a, k=k: a[..., k]) for k in range(y.c.shape[-1])]
        goal = control.get("goal") or [0.0] * len(y)
        u = [_affine(row, [a + -float(b) for a, b in zip(y, goal, strict=True)], 0.0) for row in control["gain"]] if (
            control.get("gain")
        ) else y  # fmt: skip
        if control.get("clip"):
            u = [a.clamped(*map(float, ends)) for a, ends in zip(u, control["clip"], strict=True)]
        states = []
        for a, b, c, name in zip(law["A"], law["B"], law["c"], self.names, strict=True):
            push = (self.loop.get("disturbance") or {}).get(name, 0.0)
            least, most = (-push, push) if isinstance(push, (int, float)) else push
            e = _affine([*a, *b], [*x, *u], float(c)) + 0.5 * (least + most)
            # float64 evaluations of the law, too
            states.append(e.wider(0.5 * (most - least) * (1.0 + 1e-12) + 1e-13 * (1.0 + e.size())))
        return states

    def margins(self, low: Array, high: Array, unit: float) -> Array:
        """Lower bounds [B] of how far all runs from boxes stay from going wrong."""
        x, goal, found, inside = self._state(low, high), self.loop.get("goal"), [], []
        for step in range(self.steps + 1):
            x = self._next(x, unit) if step else x
            found += [_outside(area, x, self.names) for area in self.loop.get("unsafe") or []]
            if self.cells.index and goal:
                inside.append(-_outside(goal, x, self.names, inner=True))
            lost = ~np.isfinite(np.stack([e.r for e in x])).all(axis=0)
            if (lost | (np.min(found, axis=0, initial=np.inf) <= 0.0)).all():
                return np.full(len(low), -np.inf)
        if inside:
            found.append(inside[-1] if goal["when"] == "end" else np.max(inside, axis=0))
        return np.min(found, axis=0) if found else np.full(len(low), np.inf)

    def most(self, point: Array) -> float:
        """Runs are not refuted: what is not proved stays open."""
        return np.inf


def _affine(row: Any, x: list[Affine], constant: float) -> Affine:
    return total(e * float(v) for v, e in zip(row, x, strict=True)) + float(constant)


def _outside(area: dict[str, Any], x: list[Affine], names: list[str], inner: bool = False) -> Array:
    """How far states surely are outside of a closed set, or, negated, how far inside of an open box if ``inner``."""
    if "half_space" in area:
        return -(_affine(area["half_space"]["normal"], x, -float(area["half_space"]["at_least"])).range()[1])
    gaps = []
    for name, ends in area["box"].items():
        least, most = x[names.index(name)].range()
        low, high = (np.inf * s if e is None else float(e) for s, e in zip((-1.0, 1.0), ends, strict=True))
        gaps += [low - least, most - high] if inner else [low - most, least - high]
    return np.max(gaps, axis=0)
