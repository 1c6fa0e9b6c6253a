"""Claims of certificates: a property holds at every pose of a cell, or fails at one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.check.claims import BoxClaim, ClaimMargins, Claims
from ns_abstract.check.forms import Affine, Array, U
from ns_abstract.check.inputs import BadInput, check_keys, same_network
from ns_abstract.check.networks import read_network
from ns_abstract.check.poses import CameraForms, CheckedCamera, Poses
from ns_abstract.check.results import StoredCells
from ns_abstract.check.splats import FLOAT, ActivatedScene, pictures
from ns_abstract.check.statements import FREE, parse_statement

#: Lower and upper bounds [B] of a margin over boxes [B, d]; the last argument is the unit of the pictures' rounding.
Bounds = Callable[[Array, Array, float], tuple[Array, Array]]


class Verdicts(Claims):
    """The claims of cells: certified, the margin is positive at all poses; falsified, it is not at one pose."""

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any], bounds: Bounds) -> None:
        super().__init__(cells, scene, report)
        # runs of loops that go wrong are not simulated again
        kinds = ("certified",) if report.get("kind") == "loop" else ("certified", "falsified")
        self.rows = [k for k, v in enumerate(cells.verdicts or []) if v[0] in kinds]
        self.count, self.bounds = len(self.rows), bounds
        self.units = self.units if network_unit(report) else (0.0,)
        for verdict, margin, example in ((cells.verdicts or [])[k] for k in self.rows):
            stated = [margin or 0.0, *(cells.lower if verdict == "certified" else example or ())]
            if len(stated) != 1 + len(cells.names) or not all(isinstance(x, (int, float)) for x in stated):
                raise BadInput("holds a margin or a counterexample that is none", "cells.sqlite", fix="make it again")
        if not isinstance(scene, ActivatedScene) or (report.get("picture") or "float") != "float":
            raise BadInput("is of a NeRF or of 8-bit pictures, whose cells are not checked", "report.json", "renderer")

    def draw_uniform(self, rng: Any) -> BoxClaim:
        return BoxClaim(self.rows[int(rng.integers(self.count))])

    def suspicion(self, claim: BoxClaim) -> float:
        """Return the negative of the claimed margin: small margins come first."""
        return -self.claimed_margin(claim)

    def claimed_margin(self, claim: BoxClaim) -> float:
        return max(0.0, (self.cells.verdicts or [])[claim.cell][1] or 0.0)

    def settle(self, claim: BoxClaim, deadline: float) -> tuple[bool | None, bool, dict[str, Any]]:
        """Settle as `Claims.settle`; of a falsified cell the counterexample alone is looked at."""
        verdict, _, example = (self.cells.verdicts or [])[claim.cell]
        if verdict != "falsified":
            return super().settle(claim, deadline)
        point, (low, high) = np.array(example, np.float64)[None], self.box(claim)
        least, most = self.bounds(point, point, 0.0)
        if not ((point >= low).all() and (point <= high).all()) or least[0] > 0.0:
            return False, False, self.refutation(claim, point)
        return (True if most[0] <= 0.0 else None), False, {}

    def refutation(self, claim: BoxClaim, point: Array) -> dict[str, Any]:
        """Return the pose, an upper bound of its margin, and how far that is below the claimed margin."""
        most = float(self.bounds(point, point, 0.0)[1][0])
        return {"pose": point[0].tolist(), "margin": most, "excess": max(self.claimed_margin(claim) - most, 0.0)}

    def margins(self, claim: BoxClaim, low: Array, high: Array, near: Array, unit: float) -> ClaimMargins:
        least, most = self.bounds(low, high, unit)
        return ClaimMargins(np.where(least > 0.0, least, -np.inf), most)


def network_unit(report: dict[str, Any]) -> float:
    """Return the unit roundoff of the network's evaluation: that of float32 unless the result's arithmetic is real."""
    return FLOAT if report["fingerprint"].get("network_arithmetic", "float32") == "float32" else 0.0


class NetworkOnPictures:
    """A network whose input is the scene's picture, after the ``preprocess`` of a property or loop."""

    def __init__(self, scene: ActivatedScene, report: dict[str, Any], model: Path, about: dict[str, Any]) -> None:
        self.scene, self.shape = scene, about.get("preprocess") or {}
        if not same_network(model, report["model"]):
            raise BadInput("is not the network of the result (sha256)", model, fix="say with --model where it lies now")
        check_keys(self.shape, "input")
        try:
            self.network = read_network(model, about.get("output"), network_unit(report))
        except Exception as error:  # onnx raises whatever a damaged file makes it run into
            raise BadInput(" ".join(str(error).split())[:160] or "cannot be read", model) from None

    def outputs(self, camera: CheckedCamera, view: CameraForms, unit: float, rows: Array | None = None) -> Affine:
        """Return the outputs over B boxes of poses; ``rows`` as in `CheckedNetwork.outputs`."""
        image = pictures(self.scene, camera, view, unit).reshaped(len(view.origin), camera.height, camera.width, 3)
        image = image.apply(lambda a: np.moveaxis(a, -1, -3))
        if self.shape.get("channels", "RGB") == "BGR":
            image = image.apply(lambda a: a[..., ::-1, :, :])
        low, high = self.shape.get("range") or (0.0, 1.0)
        mean, std = (np.reshape(self.shape.get(k) or [d] * 3, (3, 1, 1)) for k, d in (("mean", 0.0), ("std", 1.0)))
        size = (abs(low) + abs(high) + np.abs(mean)) / np.abs(std)
        image = ((image * (high - low) + (low - mean)) * (1.0 / std)).wider(16.0 * (self.network.unit + U) * size)
        return self.network.outputs(image, rows)


def class_margin(scene: Any, poses: Poses, report: dict[str, Any], model: Path) -> Bounds:
    """Return bounds of the label's output less the largest other output."""
    about = report["property"]
    if about.get("type") != "classification":
        raise BadInput(f"{about.get('type')!r} is a property that this program does not check", model, "type")
    check_keys({k: v for k, v in about.items() if k not in FREE}, "class")
    seeing, label = NetworkOnPictures(scene, report, model, about), int(about["label"])
    camera, unit_rows = resized(poses.camera, seeing.shape), np.eye(int(report["model"]["output"][-1]))
    rivals = np.delete(unit_rows[label] - unit_rows, label, axis=0)

    def bounds(low: Array, high: Array, unit: float) -> tuple[Array, Array]:
        least, most = seeing.outputs(camera, poses.view(low, high), unit, rivals).range()
        return least.min(axis=1), most.min(axis=1)

    return bounds


def statement_margin(scene: Any, poses: Poses, report: dict[str, Any], scale: float) -> Bounds:
    """Return bounds of the margin of a property of the picture itself."""
    camera = resized(poses.camera, report["property"].get("preprocess") or {})
    statement = parse_statement(report["property"], (camera.height, camera.width), scale)

    def bounds(low: Array, high: Array, unit: float) -> tuple[Array, Array]:
        view = poses.view(low, high)
        return statement.margin(lambda paint: pictures(scene.painted(paint), camera, view, unit))

    return bounds


def resized(camera: CheckedCamera, shape: dict[str, Any]) -> CheckedCamera:
    """Return the camera for pictures of the size that ``preprocess`` states."""
    height, width = shape.get("resize") or (camera.height, camera.width)
    down, across = height / camera.height, width / camera.width
    return dataclasses.replace(
        camera, fx=camera.fx * across, fy=camera.fy * down, cx=camera.cx * across, cy=camera.cy * down,
        width=int(width), height=int(height),
    )  # fmt: skip
