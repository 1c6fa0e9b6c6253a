"""Claims about loops: no run from a cell becomes unsafe, and every run reaches the goal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.check.forms import Affine, Array, U, fixed, parameters, product, rotation, total
from ns_abstract.check.inputs import BadInput, check_keys, intrinsics
from ns_abstract.check.poses import TURNS, CameraForms, CheckedCamera, Poses
from ns_abstract.check.results import StoredCells
from ns_abstract.check.statements import FREE
from ns_abstract.check.verdicts import NetworkOnPictures

#: Keys of a loop that name things.
_NAMES = ("network", "state", "units")


class LoopRuns:
    """Encloses all runs of a loop from boxes of initial states; question 0: none is unsafe, 1: all reach the goal."""

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any], model: Path) -> None:
        self.loop, self.cells = report["loop"], cells
        loop, self.seeing = self.loop, NetworkOnPictures(scene, report, model, report["loop"])
        check_keys({k: v for k, v in loop.items() if k not in (*FREE, *_NAMES)}, "loop", loop["state"])
        pose = np.array(loop["camera"]["camera_to_world"], np.float64)[:3]
        # nothing is reached without a goal
        unclear = (cells.index and "box" not in loop["goal"]) or pose[:, 3].any()
        if unclear or any(len(area) != 1 for area in loop.get("unsafe") or []):
            raise BadInput("has an area or a camera that this program does not follow", "report.json", "loop")
        height, width = self.seeing.shape["resize"]
        stated = intrinsics(loop["camera"], loop["camera"].get("fov", 45.0), width, height)
        self.camera = CheckedCamera(pose, *stated, int(width), int(height))
        self.steps, self.names = int(loop["steps"]), list(loop["state"])
        self.position = {"offset": [0.0] * 3} | loop["camera"]["position"]
        still = {"offset": 0.0, "row": [0.0] * len(self.names)}
        self.turns = {name: still | loop["camera"][name] for name in TURNS if loop["camera"].get(name)}
        rows = [*self.position["matrix"], *(about["row"] for about in self.turns.values())]
        self.seen = [k for k in range(len(self.names)) if any(row[k] for row in rows)]

    def _state(self, low: Array, high: Array) -> list[Affine]:
        coordinates = Poses(self.camera, self.cells.names).given(low, high)
        ends = {n: v if isinstance(v, (int, float)) else v[0] for n, v in self.loop["initial"].items()}
        return [coordinates[n] if n in coordinates else coordinates[""] + float(ends[n]) for n in self.names]

    def _view(self, x: list[Affine]) -> CameraForms:
        rows = zip(self.position["matrix"], self.position["offset"], strict=True)
        place, turn = [_affine(row, x, o) for row, o in rows], fixed(self.camera.pose[:, :3], x[0])
        for name, about in self.turns.items():
            turn = product(turn, rotation(np.array(TURNS[name]), _affine(about["row"], x, about["offset"])))
        return CameraForms(turn, place, self.camera.pose)

    def _outputs(self, x: list[Affine], unit: float) -> list[Affine]:
        """Return the network's outputs over all pictures at the states ``x``, as forms in the same symbols as ``x``.

        Pictures and outputs are bounded over the box of the states that move the camera, with these states as symbols;
        then each is replaced by its form.
        """
        low, high = (np.stack([e.range()[k] for e in x], axis=-1) for k in (0, 1))
        middle = 0.5 * (low + high)
        half = np.maximum(np.maximum(high - middle, middle - low) * (1.0 + 4.0 * U), 1e-150)
        own = parameters(middle[:, self.seen], half[:, self.seen])
        local = [own[self.seen.index(k)] if k in self.seen else own[0] * 0.0 + middle[:, k] for k in range(len(x))]
        y = self.seeing.outputs(self.camera, self._view(local), unit)
        scaled = [(x[k] - middle[:, k]) * (1.0 / half[:, k]) for k in self.seen]
        forms = (Affine.constant(y.c[:, j], x[0], y.r[:, j]) for j in range(y.c.shape[-1]))
        return [total([form, *(s * y.g[k, :, j] for k, s in enumerate(scaled))]) for j, form in enumerate(forms)]

    def _next(self, x: list[Affine], unit: float) -> list[Affine]:
        law, control, x = self.loop["dynamics"], self.loop.get("control") or {}, _with_symbols(x)
        u = self._outputs(x, unit)
        u = [a + -float(b) for a, b in zip(u, control.get("goal") or [0.0] * len(u), strict=True)]
        if control.get("gain"):
            u = [_affine(row, u, 0.0) for row in control["gain"]]
        if control.get("clip"):
            u = [a.clamped(*map(float, ends)) for a, ends in zip(u, control["clip"], strict=True)]
        states = []
        for a, b, c, name in zip(law["A"], law["B"], law.get("c") or [0.0] * len(x), self.names, strict=True):
            push = (self.loop.get("disturbance") or {}).get(name) or 0.0
            least, most = (-push, push) if isinstance(push, (int, float)) else push
            e = _affine([*a, *b], [*x, *u], float(c)) + 0.5 * (least + most)
            # float64 evaluations of the law, too
            states.append(e.wider(0.5 * (most - least) * (1.0 + 1e-12) + 1e-13 * (1.0 + e.size())))
        return states

    def bounds(self, low: Array, high: Array, unit: float) -> tuple[Array, Array]:
        """Return bounds [B] of the least margin over all runs from the boxes; the upper bound is infinite."""
        x, goal, margins, inside = self._state(low, high), self.loop.get("goal"), [], []
        for step in range(self.steps + 1):
            x = self._next(x, unit) if step else x
            margins += [_outside(area, x, self.names) for area in self.loop.get("unsafe") or []]
            if self.cells.index and goal:
                inside.append(-_outside(goal, x, self.names, inner=True))
            lost = ~np.isfinite(np.stack([e.width for e in x])).all(axis=0)
            if (lost | (np.min(margins, axis=0, initial=np.inf) <= 0.0)).all():
                return np.full(len(low), -np.inf), np.full(len(low), np.inf)
        if inside:
            margins.append(inside[-1] if goal.get("when", "end") == "end" else np.max(inside, axis=0))
        least = np.min(margins, axis=0) if margins else np.full(len(low), np.inf)
        return np.where(np.isnan(least) | lost, -np.inf, least), np.full(len(low), np.inf)


def _affine(row: Any, x: list[Affine], constant: float) -> Affine:
    return total(e * float(v) for v, e in zip(row, x, strict=True)) + float(constant)


def _with_symbols(x: list[Affine]) -> list[Affine]:
    """Return the states with a symbol for each error, so that later states follow it."""
    whole = Affine.joined(x, -1, np.stack).with_symbols(len(x))
    return [whole.apply(lambda a, k=k: a[..., k]) for k in range(len(x))]


def _outside(area: dict[str, Any], x: list[Affine], names: list[str], inner: bool = False) -> Array:
    """Return a lower bound of states' distance outside of a closed area; ``inner``: negative, inside of an open box."""
    if "half_space" in area:
        return -(_affine(area["half_space"]["normal"], x, -float(area["half_space"]["at_least"])).range()[1])
    gaps = []
    for name, ends in area["box"].items():
        least, most = x[names.index(name)].range()
        low, high = (np.inf * s if e is None else float(e) for s, e in zip((-1.0, 1.0), ends, strict=True))
        gaps += [low - least, most - high] if inner else [low - most, least - high]
    return np.max(gaps, axis=0)
