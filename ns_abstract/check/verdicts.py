"""Claims of certificates: what holds of every picture of a cell."""

from __future__ import annotations

import dataclasses
import hashlib
from abc import abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ns_abstract.check.claims import ClaimMargins, Claims
from ns_abstract.check.forms import Affine, Array, U
from ns_abstract.check.inputs import BadInput
from ns_abstract.check.networks import read_network
from ns_abstract.check.poses import CameraForms, CheckedCamera, Poses
from ns_abstract.check.results import StoredCells
from ns_abstract.check.splats import FLOAT, ActivatedScene, pictures
from ns_abstract.check.statements import parsed


class Verdicts(Claims):
    """Cells with verdicts: of all their poses a margin is positive, or of one pose it is not."""

    kinds: tuple[str, ...] = ("certified", "falsified")

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any]) -> None:
        super().__init__(cells, scene, report)
        self.rows = [k for k, v in enumerate(cells.verdicts or []) if v[0] in self.kinds]
        self.count = len(self.rows)
        for verdict, margin, example in ((cells.verdicts or [])[k] for k in self.rows):
            stated = [margin or 0.0, *(cells.lower if verdict == "certified" else example or ())]
            if len(stated) != 1 + len(cells.names) or not all(isinstance(x, (int, float)) for x in stated):
                raise BadInput("holds a margin or a counterexample that is none", "cells.sqlite", fix="make it again")
        if not isinstance(scene, ActivatedScene) or (report.get("picture") or "float") != "float":
            raise BadInput("is of a NeRF or of 8-bit pictures, whose cells are not checked", "report.json", "renderer")

    def one(self, rng: Any) -> int:
        """A cell with a verdict."""
        return self.rows[int(rng.integers(self.count))]

    def interest(self, claim: int) -> float:
        """Margins that are small."""
        return -self.floor(claim)

    def place(self, claim: int) -> dict[str, Any]:
        """The claim for check.json."""
        return {"cell": claim, "parameters": list(self.cells.names)}

    def floor(self, claim: int) -> float:
        """The margin that is claimed of every pose."""
        return max(0.0, (self.cells.verdicts or [])[claim][1] or 0.0)

    def settle(self, claim: int, deadline: float) -> tuple[bool | None, bool, dict[str, Any]]:
        """As `Claims.settle`; where a pose is claimed to fail it is looked at alone."""
        verdict, _, example = (self.cells.verdicts or [])[claim]
        if verdict != "falsified":
            return super().settle(claim, deadline)
        point, (low, high) = np.array(example, np.float64)[None], self.box(claim)
        least, most = self.bounds(point, point, 0.0)
        if not ((point >= low).all() and (point <= high).all()) or least[0] > 0.0:
            return False, False, self.detail(claim, point)
        return (True if most[0] <= 0.0 else None), False, {}

    def detail(self, claim: int, point: Array) -> dict[str, Any]:
        """The pose, the margin there at most, and by how much that is below what is claimed."""
        most = float(self.bounds(point, point, 0.0)[1][0])
        return {"pose": point[0].tolist(), "margin": most, "excess": max(self.floor(claim) - most, 0.0)}

    def margins(self, claim: int, low: Array, high: Array, near: Array, unit: float) -> ClaimMargins:
        """Over boxes [B, d]."""
        least, most = self.bounds(low, high, unit)
        return ClaimMargins(np.where(least > 0.0, least, -np.inf), most)

    @abstractmethod
    def bounds(self, low: Array, high: Array, unit: float) -> tuple[Array, Array]:
        """`ClaimMargins.least` and `ClaimMargins.most`."""


class OfNetwork(Verdicts):
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
            self.network = read_network(model, about.get("output"), FLOAT if self.in_float32 else 0.0)
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


class CertificateClaims(OfNetwork):
    """The claims of a frame's cells: a class is the largest output on every picture of a cell, or not on one."""

    def __init__(self, cells: StoredCells, scene: Any, poses: Poses, report: dict[str, Any], model: Path) -> None:
        about = report["property"]
        if about.get("type") != "classification":
            raise BadInput(f"{about.get('type')!r} is a property that this program does not check", model, "type")
        super().__init__(cells, scene, report, model, about)
        self.poses, self.camera, label = poses, resized(poses.camera, self.shape), int(about["label"])
        rows = -torch.eye(int(report["model"]["output"][-1]), dtype=torch.float64)
        rows[:, label] += 1.0
        self.rivals = torch.cat([rows[:label], rows[label + 1 :]])

    def bounds(self, low: Array, high: Array, unit: float) -> tuple[Array, Array]:
        """Of the class' output less the largest other one."""
        x = self.inputs(self.camera, self.poses.view(low, high), unit)
        least, most = self.network.outputs(x, self.rivals).range()
        return least.min(axis=1), most.min(axis=1)


class StatementClaims(Verdicts):
    """The claims of a frame's cells about the picture itself."""

    def __init__(self, cells: StoredCells, scene: Any, poses: Poses, report: dict[str, Any], scale: float) -> None:
        super().__init__(cells, scene, report)
        self.poses, self.camera = poses, resized(poses.camera, report["property"].get("preprocess") or {})
        self.statement = parsed(report["property"], (self.camera.height, self.camera.width), scale)

    def bounds(self, low: Array, high: Array, unit: float) -> tuple[Array, Array]:
        """Of the statement's margin."""
        view = self.poses.view(low, high)
        return self.statement.margin(lambda paint: pictures(self.scene.painted(paint), self.camera, view, unit))


def resized(camera: CheckedCamera, shape: dict[str, Any]) -> CheckedCamera:
    """The camera at the size that ``preprocess`` names."""
    height, width = shape.get("resize") or (camera.height, camera.width)
    down, across = height / camera.height, width / camera.width
    return dataclasses.replace(
        camera, fx=camera.fx * across, fy=camera.fy * down, cx=camera.cx * across, cy=camera.cy * down,
        width=int(width), height=int(height),
    )  # fmt: skip
