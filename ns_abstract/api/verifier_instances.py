"""Folders of instances for other verifiers: networks behind the linear renderer, queries, and where each comes from."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.api.certification import Certification
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.atomic import write_atomic, write_json
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import load_json, read_text
from ns_abstract.report.run import sides
from ns_abstract.verify.cells import CellGrid
from ns_abstract.verify.interop import Form, LibraryVersion

_LIST_LIMIT = 16 << 20
#: What an earlier command wrote, by file.
_KEPT = ("instances.csv", "boxes.json", "origins.json")


@dataclass
class InstanceFolder:
    """Collects the instances that are written into ``folder``.

    Attributes:
        folder: Made if missing.
        seconds: Time limit of each.
        form, version: As in `ns_abstract.verify.interop.write_vnnlib`.
        prefix: What their names begin with.
        pictures: Whether the picture at the middle of each box is written.
        lines, boxes, origins: Of instances.csv, boxes.json and origins.json.
    """

    folder: Path
    seconds: int
    form: Form = "slice"
    version: LibraryVersion = "1.0"
    prefix: str = ""
    pictures: bool = False
    lines: list[list[str]] = field(default_factory=list)
    boxes: dict[str, Any] = field(default_factory=dict)
    origins: dict[str, Any] = field(default_factory=dict)

    def keep_earlier(self) -> None:
        """Take the instances that an earlier command wrote into the folder.

        Raises:
            InputError: Its lists are damaged.
        """
        if not (self.folder / _KEPT[0]).exists():
            return
        text = read_text(self.folder / _KEPT[0], "list of instances", _LIST_LIMIT)
        self.lines = [row for row in csv.reader(io.StringIO(text)) if row]
        for name, target in zip(_KEPT[1:], (self.boxes, self.origins), strict=True):
            content = load_json(self.folder / name, "list of instances")
            if not isinstance(content, dict):
                raise InputError("is no object", file=self.folder / name, fix="remove it, or write to another folder")
            target.update(content)

    def add(self, job: Certification, frame: int, parts: Sequence[int], name: str = "") -> None:
        """Cut the set of poses of ``frame`` into boxes and write an instance of each.

        ``parts``: boxes along each parameter; empty: one. ``name``: of the network, in the names of the instances.
        Raises InputError where the property or the network cannot be written, or an instance of this name is there.
        """
        box = job.job.pose_sets[frame].box
        parts = tuple(parts) or (1,) * box.dimensions
        try:
            grid = CellGrid.fixed(box, parts, parts)
        except InputError as error:
            raise InputError(error.problem, field="--parts", fix=error.fix) from None
        self.folder.mkdir(parents=True, exist_ok=True)
        for k, cell in enumerate(grid.roots()):
            one = grid.box_of(cell)
            full = f"{self.prefix}{name}frame_{frame:05d}_box_{k:05d}"
            if full in self.boxes:
                raise InputError(f"holds {full} already", file=self.folder, field="--prefix", fix="give another one")
            written = job.write_vnnlib(frame, one, self.folder / full, self.form, self.version)
            self.lines.append([*(file.name for file in written), str(self.seconds)])
            self.boxes[full] = sides(one)
            self.origins[full] = self._provenance(job, frame, one, full)

    def _provenance(self, job: Certification, frame: int, box: ParameterBox, name: str) -> dict[str, Any]:
        """Return the origin of an instance (scene, property and pose), and write its picture."""
        middle = np.array([0.5 * (low + high) for low, high in zip(box.lower, box.upper, strict=True)])
        poses, camera = job.job.pose_sets[frame], job.pictures(frame).frame.camera
        origin: dict[str, Any] = {
            "frame": frame,
            "scene": job.job.describe()["source"],
            "fingerprint": dict(job.fingerprint),
            "network": job.question.name,
            "property": job.question.source.value,
            "middle": middle.tolist(),
            "camera_to_world": np.asarray(poses.pose(middle)).tolist(),
            "intrinsics": {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")},
        }
        if self.pictures:
            from PIL import Image

            from ns_abstract.report.picture import to_bytes

            image = Image.fromarray(to_bytes(job.pictures(frame).image(middle).astype(np.float32)))
            file = self.folder / "pictures" / f"{name}.png"
            file.parent.mkdir(exist_ok=True)
            write_atomic(file, lambda stream: image.save(stream, "png"))
            origin["picture"] = f"pictures/{file.name}"
        return origin

    def write_lists(self) -> None:
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerows(self.lines)
        content = stream.getvalue().encode()
        write_atomic(self.folder / "instances.csv", lambda target: target.write(content))
        for name, value in (("boxes.json", self.boxes), ("origins.json", self.origins)):
            write_json(self.folder / name, value)
