"""Claims of certificates and of loops: what holds of every picture of a cell."""

from __future__ import annotations

import dataclasses
import hashlib
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ns_abstract.check.forms import Affine, Array, U, fixed, parameters, product, rotation, total
from ns_abstract.check.inputs import BadInput, lens
from ns_abstract.check.networks import CheckedNetwork
from ns_abstract.check.pictures import FIRST, Verdict, divided, units
from ns_abstract.check.poses import TURNS, CameraForms, CheckedCamera, Poses
from ns_abstract.check.results import StoredCells
from ns_abstract.check.splats import FLOAT, ActivatedScene, pictures
from ns_abstract.check.statements import parsed

#: Boxes that are looked at together.
BATCH = 8


class _Verdicts(ABC):
    """Cells that are drawn, and divided until a lower bound of their margin is positive."""

    kinds: tuple[str, ...] = ("certified", "falsified")
    in_float32 = True

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any]) -> None:
        self.cells, self.scene, self.units = cells, scene, units(scene, report)
        self.rows = [k for k, v in enumerate(cells.verdicts or []) if v[0] in self.kinds]
        self.count = len(self.rows)
        if not isinstance(scene, ActivatedScene) or (report.get("picture") or "float") != "float":
            raise BadInput("is of a NeRF or of 8-bit pictures, whose cells are not checked", "report.json", "renderer")

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

    def settle(self, claim: int, deadline: float) -> Verdict:
        """True: proved; False: refuted, with the pose; None: open when the time was over; and of which picture."""
        low, high = (self.cells.arrays[f"box_{s}"][claim] for s in ("lower", "upper"))
        verdict, margin, example = (self.cells.verdicts or [])[claim]
        if verdict == "falsified":
            point = np.array(example, np.float64)[None]
            inside = (point >= low).all() and (point <= high).all()
            if not inside or self.margins(point, point, self.units[0])[0] > 0.0:
                return False, "real", {"pose": point[0].tolist(), "margin": self.most(point), "excess": 0.0}
            return (True if self.most(point) <= 0.0 else None), "real", {}
        begin, claimed = time.monotonic(), max(0.0, margin or 0.0)
        middle = 0.5 * (low + high)[None]
        for unit in self.units:
            end, stack = begin + (deadline - begin) * (FIRST if unit else 1.0), [(low, high)]
            while stack and time.monotonic() < end:
                most = self.most(middle)
                if most < claimed * (1.0 - 1e-9):
                    return False, "real", {"pose": middle[0].tolist(), "margin": most, "excess": claimed - most}
                batch = [stack.pop() for _ in range(min(BATCH, len(stack)))]
                first, last = (np.stack([b[k] for b in batch]) for k in (0, 1))
                open_ = np.flatnonzero(~(self.margins(first, last, unit) > 0.0))
                if len(open_):
                    middle = 0.5 * (first[open_[:1]] + last[open_[:1]])
                stack += [p for k in open_ for p in divided(first[k], last[k], last[k] - first[k], high - low)]
            if not stack:
                return True, "float32" if unit and self.in_float32 else "real", {}
        return None, "", {}

    @abstractmethod
    def margins(self, low: Array, high: Array, unit: float) -> Array:
        """Lower bounds [B] of how far boxes are from failing."""

    @abstractmethod
    def most(self, point: Array) -> float:
        """An upper bound of that at one point [1, d], of the picture in real numbers."""


class _OfNetwork(_Verdicts):
    """Verdicts about a network that sees the pictures."""

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any], model: Path, about: Any) -> None:
        super().__init__(cells, scene, report)
        self.shape = about.get("preprocess") or {}
        if not model.is_file() or hashlib.sha256(model.read_bytes()).hexdigest() != report["model"]["sha256"]:
            raise BadInput("is not the network of the result (sha256)", model, fix="say with --model where it lies now")
        if self.shape.get("layout", "NCHW") != "NCHW":
            raise BadInput("takes pictures that this program does not make", model, "preprocess.layout")
        self.in_float32 = report["fingerprint"].get("network_arithmetic") == "float32"
        try:
            self.network = CheckedNetwork(model, about.get("output"), FLOAT if self.in_float32 else 0.0)
        except Exception as error:  # onnx raises whatever a damaged file makes it run into
            raise BadInput(" ".join(str(error).split())[:160] or "cannot be read", model) from None

    def inputs(self, camera: CheckedCamera, view: CameraForms, unit: float) -> Affine:
        """The network's inputs [B, 3, H, W] over B boxes of poses."""
        image = pictures(self.scene, camera, view, unit).of(lambda a: np.moveaxis(a, -1, -3))
        if self.shape.get("channels", "RGB") == "BGR":
            image = image.of(lambda a: a[..., ::-1, :, :])
        low, high = self.shape.get("range") or (0.0, 1.0)
        mean, std = (np.reshape(self.shape.get(k) or [d] * 3, (3, 1, 1)) for k, d in (("mean", 0.0), ("std", 1.0)))
        size = (abs(low) + abs(high) + np.abs(mean)) / np.abs(std)
        return ((image * (high - low) + (low - mean)) * (1.0 / std)).wider(16.0 * (self.network.unit + U) * size)


class CheckedCertificate(_OfNetwork):
    """The claims of a frame's cells: a class is the largest output on every picture of a cell, or not on one."""

    def __init__(self, cells: StoredCells, scene: Any, poses: Poses, report: dict[str, Any], model: Path) -> None:
        about = report["property"]
        if about.get("type") != "classification":
            raise BadInput(f"{about.get('type')!r} is a property that this program does not check", model, "type")
        super().__init__(cells, scene, report, model, about)
        self.poses, self.camera, self.label = poses, resized(poses.camera, self.shape), int(about["label"])
        rows = -torch.eye(int(report["model"]["output"][-1]), dtype=torch.float64)
        rows[:, self.label] += 1.0
        self.rivals = torch.cat([rows[: self.label], rows[self.label + 1 :]])

    def _inputs(self, low: Array, high: Array, unit: float) -> Affine:
        return self.inputs(self.camera, self.poses.view(low, high), unit)

    def margins(self, low: Array, high: Array, unit: float) -> Array:
        """Lower bounds [B] of the class' output less the largest other one."""
        return self.network.least(self._inputs(low, high, unit), self.rivals).min(dim=1).values.numpy()

    def most(self, point: Array) -> float:
        """An upper bound of that at one point [1, d]."""
        return float(-self.network.least(self._inputs(point, point, 0.0), -self.rivals).max())


class CheckedStatement(_Verdicts):
    """The claims of a frame's cells about the picture itself."""

    def __init__(self, cells: StoredCells, scene: Any, poses: Poses, report: dict[str, Any], scale: float) -> None:
        super().__init__(cells, scene, report)
        self.poses, self.camera = poses, resized(poses.camera, report["property"].get("preprocess") or {})
        self.statement = parsed(report["property"], (self.camera.height, self.camera.width), scale)

    def margins(self, low: Array, high: Array, unit: float) -> Array:
        """Lower bounds [B] of the statement's margin."""
        return self._margin(low, high, unit)[0]

    def most(self, point: Array) -> float:
        """An upper bound of that at one point [1, d]."""
        return float(self._margin(point, point, 0.0)[1][0])

    def _margin(self, low: Array, high: Array, unit: float) -> tuple[Array, Array]:
        view = self.poses.view(low, high)
        return self.statement.margin(lambda paint: pictures(self.scene.painted(paint), self.camera, view, unit))


class CheckedLoop(_OfNetwork):
    """The claims of a question about a loop: no run from a cell comes to harm, and (question 1) all reach the goal."""

    kinds = ("certified",)

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any], model: Path, scale: float) -> None:
        self.loop = loop = report["loop"]
        super().__init__(cells, scene, report, model, loop)
        if loop["dynamics"].get("type") != "affine":
            problem = "has dynamics that this program does not follow"
            raise BadInput(problem, "report.json", "loop.dynamics.type", "audit an affine loop")
        height, width = self.shape["resize"]
        stated = lens(loop["camera"], loop["camera"].get("fov", 45.0), width, height)
        pose = np.array(loop["camera"]["camera_to_world"], np.float64)[:3]
        self.camera = CheckedCamera(pose, *stated, int(width), int(height))
        self.steps, self.names = int(loop["steps"]), list(loop["state"])
        empty = {"offset": [0.0] * 3, "matrix": [[0.0] * len(self.names)] * 3}
        self.position = loop["camera"].get("position") or empty
        self.turns = {name: loop["camera"][name] for name in TURNS if loop["camera"].get(name)}
        rows = [*self.position["matrix"], *(about["row"] for about in self.turns.values())]
        self.seen = [k for k in range(len(self.names)) if any(row[k] for row in rows)]
        stated = [*(loop.get("unsafe") or []), loop.get("goal") or {}]
        self.areas, self.statements = [a for a in stated[:-1] if "box" in a or "half_space" in a], []
        for about in stated:
            if about and "box" not in about and "half_space" not in about:
                camera = resized(self.camera, about.get("preprocess") or {})
                self.statements.append((camera, parsed(about, (camera.height, camera.width), scale)))
        self.goal_stated = bool(stated[-1]) and "box" not in stated[-1]

    def _state(self, low: Array, high: Array) -> list[Affine]:
        given = Poses(self.camera, self.cells.names).given(low, high)
        ends = {n: v if isinstance(v, (int, float)) else v[0] for n, v in self.loop["initial"].items()}
        return [given[n] if n in given else given[""] + float(ends[n]) for n in self.names]

    def _view(self, x: list[Affine]) -> CameraForms:
        rows = zip(self.position["matrix"], self.position["offset"], strict=True)
        place, turn = [_affine(row, x, o) for row, o in rows], fixed(self.camera.pose[:, :3], x[0])
        for name, about in self.turns.items():
            turn = product(turn, rotation(np.array(TURNS[name]), _affine(about["row"], x, about["offset"])))
        return CameraForms(turn, place, self.camera.pose)

    def _local(self, x: list[Affine]) -> tuple[list[Affine], Array, Array]:
        """The states that the camera sees as forms in symbols of their own, middles and half widths of their box."""
        low, high = (np.stack([e.range()[k] for e in x], axis=-1) for k in (0, 1))
        middle = 0.5 * (low + high)
        half = np.maximum(high - middle, middle - low) * (1.0 + 4.0 * U)
        own = parameters(middle[:, self.seen], half[:, self.seen])
        local = [own[self.seen.index(k)] if k in self.seen else own[0] * 0.0 + middle[:, k] for k in range(len(x))]
        return local, middle, half

    def _stated(self, x: list[Affine], unit: float) -> list[Array]:
        """Lower bounds [B] of the margins of the statements about pictures, the goal's last."""
        if not self.statements:
            return []
        view = self._view(self._local(x)[0])

        def least(camera: CheckedCamera, statement: Any) -> Array:
            return statement.margin(lambda paint: pictures(self.scene.painted(paint), camera, view, unit))[0]

        return [least(*entry) for entry in self.statements]

    def _outputs(self, x: list[Affine], unit: float) -> list[Affine]:
        """The network's outputs in the symbols of the state.

        They are bounded by forms in the states that the camera sees, over their box, whose symbols are these states
        themselves, scaled.
        """
        local, middle, half = self._local(x)
        y, outputs = self.network.outputs(self.inputs(self.camera, self._view(local), unit)), []
        inverse = np.where(half > 1e-150, 1.0 / np.maximum(half, 1e-150), 0.0)
        scaled = [(x[k] + -middle[:, k]) * inverse[:, k] for k in self.seen]
        for j in range(y.c.shape[-1]):
            parts = [s * y.g[k, :, j] for k, s in enumerate(scaled)]
            # what moves by almost nothing is an error
            still = sum(np.where(inverse[:, k] == 0.0, np.abs(y.g[n, :, j]), 0.0) for n, k in enumerate(self.seen))
            outputs.append(total([Affine.constant(y.c[:, j], x[0], y.r[:, j] + still), *parts]))
        return outputs

    def _next(self, x: list[Affine], unit: float) -> list[Affine]:
        law, control, x = self.loop["dynamics"], self.loop.get("control") or {}, _lifted(x)
        u = self._outputs(x, unit)
        if control.get("gain"):
            error = [a + -float(b) for a, b in zip(u, control.get("goal") or [0.0] * len(u), strict=True)]
            u = [_affine(row, error, 0.0) for row in control["gain"]]
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
            margins = self._stated(x, unit)
            found += [_outside(area, x, self.names) for area in self.areas]
            found += margins[:-1] if self.goal_stated else margins
            if self.cells.index and goal:
                inside.append(margins[-1] if self.goal_stated else -_outside(goal, x, self.names, inner=True))
            lost = ~np.isfinite(np.stack([e.width for e in x])).all(axis=0)
            if (lost | (np.min(found, axis=0, initial=np.inf) <= 0.0)).all():
                return np.full(len(low), -np.inf)
        if inside:
            found.append(inside[-1] if goal.get("when", "end") == "end" else np.max(inside, axis=0))
        least = np.min(found, axis=0) if found else np.full(len(low), np.inf)
        return np.where(np.isnan(least) | lost, -np.inf, least)

    def most(self, point: Array) -> float:
        """Runs are not refuted: what is not proved stays open."""
        return np.inf


def resized(camera: CheckedCamera, shape: dict[str, Any]) -> CheckedCamera:
    """The camera at the size that ``preprocess`` names."""
    height, width = shape.get("resize") or (camera.height, camera.width)
    down, across = height / camera.height, width / camera.width
    return dataclasses.replace(
        camera, fx=camera.fx * across, fy=camera.fy * down, cx=camera.cx * across, cy=camera.cy * down,
        width=int(width), height=int(height),
    )  # fmt: skip


def _affine(row: Any, x: list[Affine], constant: float) -> Affine:
    return total(e * float(v) for v, e in zip(row, x, strict=True)) + float(constant)


def _lifted(x: list[Affine]) -> list[Affine]:
    """The same with a symbol for every error, so that what an error does to later states is followed."""
    errors = np.eye(len(x))[:, :, None] * np.stack([e.r for e in x])[None]
    return [Affine(e.c, np.concatenate([e.g, errors[:, k]]), 0.0 * e.c) for k, e in enumerate(x)]


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
