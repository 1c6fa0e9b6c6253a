"""The viewer's panel for abstract images: sliders, buttons, figures."""

from __future__ import annotations

import json
import math
import os
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.viewer.render_state_machine import RenderAction
from nerfstudio.viewer.viewer_elements import (
    ViewerButton,
    ViewerControl,
    ViewerElement,
    ViewerNumber,
    ViewerSlider,
    ViewerText,
)
from viser import ViserServer

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera as PathView
from ns_abstract.geometry.keyframe_cameras import path_json
from ns_abstract.io.atomic import write_text
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import ROTATIONS, TRANSLATIONS, Perturbation, perturbation_object
from ns_abstract.perturbation.variations import VARIATIONS
from ns_abstract.report.figures import number
from ns_abstract.viewer.background import Status
from ns_abstract.viewer.views import Snapshot, ViewRequest, perturbation_of

#: Right ends of the sliders, in thousandths.
_MOST = 100.0
_MOST_VARIATION = 500.0
#: Side of the box around what is in the middle of the picture, as a part of its distance.
_BOX = 0.25
#: Units of the sliders: thousandths of what sets are stated in.
_UNITS = dict.fromkeys(TRANSLATIONS, "0.001 units") | dict.fromkeys(ROTATIONS, "mrad") | dict.fromkeys(
    VARIATIONS, "0.001"
)  # fmt: skip
_HINTS = {
    "x": "sideways, thousandths of a scene unit",
    "y": "up and down, thousandths of a scene unit",
    "z": "forward and back, thousandths of a scene unit",
    "yaw": "turn left and right, milliradians",
    "pitch": "look up and down, milliradians",
    "roll": "tilt, milliradians",
    "mean": "where each selected Gaussian stands, thousandths of a scene unit",
    "opacity": "opacity of each selected Gaussian, thousandths",
    "color": "colour channels of each selected Gaussian, thousandths",
}


class Figures(ViewerElement[str]):
    """Text that changes while the viewer runs."""

    def __init__(self, text: str) -> None:
        super().__init__(name="figures")
        self.text = text

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        self.gui_handle: Any = viser_server.gui.add_markdown(self.text, visible=self.visible)

    def install(self, viser_server: ViserServer) -> None:
        """Put the text into the panel."""
        self._create_gui_handle(viser_server)

    def show(self, text: str) -> None:
        self.text = text
        if self.gui_handle is not None and self.gui_handle.content != text:
            self.gui_handle.content = text


class Attached(ViewerControl):
    """Notices when a viewer has attached to the model, and triggers a redraw.

    Args:
        attached: Called once, when the viewer is there.
    """

    def __init__(self, attached: Callable[[], object]) -> None:
        self._attached = attached
        self._present = threading.Event()

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        self._present.set()
        self._attached()

    @property
    def present(self) -> bool:
        return self._present.is_set()

    @property
    def watched(self) -> bool:
        """Whether somebody looks."""
        return self.present and bool(self.viewer.render_statemachines)

    @property
    def folder(self) -> Path:
        return self.viewer.log_filename.parent

    def draw(self) -> None:
        """Ask every client's render thread for a new picture; never waits."""
        if not (self.present and self.viewer.ready):
            return
        for machine in list(self.viewer.render_statemachines.values()):
            machine.action(RenderAction("step", self.viewer.get_camera_state(machine.client)))


class RedrawUntilCurrent:
    """Redraws until the screen shows the latest snapshot.

    nerfstudio's render thread loses a request that comes while it takes up another (render_state_machine.py, run:
    ``next_action`` is read and then cleared).

    Args:
        draw: Asks for a new picture.
        current: Whether the last picture told what is known.
        seconds: From a request to the look whether it was heeded.
    """

    def __init__(self, draw: Callable[[], object], current: Callable[[], bool], seconds: float = 1.0) -> None:
        self._draw, self._current, self._seconds = draw, current, seconds
        self._lock, self._waiting = threading.Lock(), False

    def __call__(self) -> None:
        """Draw; never waits."""
        self._draw()
        with self._lock:
            if self._waiting:
                return
            self._waiting = True
        timer = threading.Timer(self._seconds, self._look)
        timer.daemon = True
        timer.start()

    def _look(self) -> None:
        with self._lock:
            self._waiting = False
        if not self._current():
            self()


class AbstractPanel(torch.nn.Module):
    """Elements that nerfstudio's viewer finds in a model (viewer/utils.py, parse_object).

    A module only because the viewer looks into nothing else; it has no parameters.

    Args:
        radii: Where the sliders start.
        select: Which Gaussians vary, as the perturbation file says it; None: no scene of Gaussians.
        seconds: Time for a view before "refine" is pressed.
        attached: Called once a viewer is there.
        refine: Called with seconds.
    """

    def __init__(
        self,
        radii: dict[str, float],
        select: str | None,
        seconds: float,
        attached: Callable[[], object],
        refine: Callable[[float], object],
    ) -> None:
        super().__init__()
        self._refine = refine
        self._last: ViewRequest | None = None
        #: what the text says of the background; None: nothing
        self.reported: Status | None = None
        self._certified = select is not None
        self._figures = Figures("Abstract images: no view yet")
        self._sliders: dict[str, ViewerSlider] = {}
        #: depth of the middle of the picture on screen
        self.depth: float | None = None
        varied = () if select is None else VARIATIONS
        for name in (*TRANSLATIONS, *ROTATIONS, *varied):
            start, most = 1000.0 * radii.get(name, 0.0), _MOST_VARIATION if name in ("opacity", "color") else _MOST
            label, hint = f"± {name} ({_UNITS[name]})", f"Radius of the set: {_HINTS[name]}"
            self._sliders[name] = ViewerSlider(label, start, 0.0, max(most, start), 0.1, hint=hint)
        self._select = ViewerText(
            "select",
            select or "",
            hint='Which Gaussians vary: {"box": [[x, y, z], [x, y, z]], "opacity": [low, high], '
            '"color": {"min": [r, g, b], "max": [r, g, b]}}; {} stands for all',
        )
        selection: list[ViewerElement] = [] if select is None else [
            self._select, ViewerButton("select what is in the middle", lambda _: self.select_middle())
        ]  # fmt: skip
        hint = "Time for every view, and for every press of refine"
        self._seconds = ViewerNumber("time by view (s)", seconds, hint=hint)
        self._file = ViewerText(
            "file", "", hint="Where to write the camera with its set; empty: in the working directory"
        )
        self.control = Attached(attached)
        self.elements: list[ViewerElement] = [
            self._figures,
            *self._sliders.values(),
            *selection,
            self._seconds,
            ViewerButton("refine", lambda _: self._refine(float(self._seconds.value))),
            self._file,
            ViewerButton("send to certify", lambda _: self.send()),
        ]
        # the viewer shows attributes in the order of their names
        for k, element in enumerate(self.elements):
            setattr(self, f"element_{k:02d}", element)

    def hide(self) -> None:
        """Show nothing in viewers that are started later."""
        for element in self.elements:
            element.visible = False

    @property
    def radii(self) -> dict[str, float]:
        """What the sliders say, in scene units and radians."""
        return {name: float(slider.value) / 1000.0 for name, slider in self._sliders.items()}

    @property
    def perturbation(self) -> Perturbation:
        """The set that the panel describes. Raises InputError where the selection cannot be read."""
        return perturbation_of(self.radii, str(self._select.value))

    def select_middle(self) -> None:
        """Select the Gaussians in a box around the surface in the middle of the picture."""
        if self._last is None or self.depth is None:
            self._figures.show("**Abstract images**: nothing to select, no picture with a depth is on screen")
            return
        pose = self._last.camera.camera_to_world
        middle, side = pose[:, 3] - self.depth * pose[:, 2], 0.5 * _BOX * self.depth
        self._select.value = json.dumps({"box": [np.round(middle + s, 4).tolist() for s in (-side, side)]})
        self.control.draw()

    @property
    def seconds(self) -> float:
        seconds = float(self._seconds.value)
        return min(max(seconds, 0.1), 86400.0) if math.isfinite(seconds) else 1.0

    def show(self, view: ViewRequest, snapshot: Snapshot | None, status: Status, about: str = "") -> None:
        """Say what is known of the view on screen; ``about`` as `ns_abstract.viewer.views.Source.about`."""
        self._last, self.reported = view, status
        self._figures.show(describe(view, snapshot, status, about))

    def refuse(self, error: InputError) -> None:
        """Say why there is no set."""
        self._last = self.reported = None
        self._figures.show(f"**Abstract images**: no bounds, [0, 1] is shown  \n{error}")

    def send(self) -> None:
        """Write the camera on screen and its set as a camera path; says where in the panel."""
        view = self._last
        if view is None:
            return
        folder = self.control.folder if self.control.present else None
        name = str(self._file.value).replace("\0", "").strip()
        file = Path(name) if name else _free_name(_outside(folder))
        if folder is not None and _within(file, folder):
            self._figures.show(f"{self._figures.text}\n\nThe run's folder stays as it is: give another **file**.")
            return
        # whoever reaches the viewer may write here
        if file.suffix.lower() != ".json" or os.path.lexists(file):
            wrong = "exists" if os.path.lexists(file) else "does not end in .json"
            self._figures.show(f"{self._figures.text}\n\n**{file}** {wrong}: give another **file**.")
            return
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            text = json.dumps(certify_path(view), indent=1) + "\n"
            write_text(file, text)
        except OSError as error:
            self._figures.show(f"{self._figures.text}\n\n**{file}** cannot be written ({error.strerror})")
            return
        # certificates are for poses of splats
        certified = not view.perturbation.scene and self._certified
        config = "RUN/config.yml" if folder is None else _short(folder / "config.yml")
        lines = [
            f"ns-abstract-{'certify' if certified else 'render'}",
            f"--load-config {config}",
            f"--camera-path-filename {_short(file)}",
            *(("--model NET.onnx", "--property PROP.json") if certified else ()),
            "--output-dir OUT",
        ]
        # an option a line: the panel is narrow
        command = " \\\n  ".join(lines)
        text = f"The camera and its set are in **{_short(file)}**. To {'certify' if certified else 'bound'} it, run"
        self._figures.show(f"{self._figures.text}\n\n{text}\n\n```\n{command}\n```")


def _within(file: Path, folder: Path) -> bool:
    return file.resolve().is_relative_to(folder.resolve())


def _outside(run: Path | None) -> Path:
    """Return the folder to write views to: the working directory, or the temporary one if that lies within ``run``."""
    here = Path()
    return Path(tempfile.gettempdir()) if run is not None and _within(here, run) else here


def _short(file: Path) -> str:
    """Return a path as seen from the working directory, where that is shorter."""
    return min(str(file), os.path.relpath(file), key=len)


def _free_name(folder: Path) -> Path:
    k = 0
    while (file := folder / f"view_{k:03d}.json").exists():
        k += 1
    return file


def certify_path(view: ViewRequest) -> dict[str, Any]:
    """Return a camera path of one entry, with the set under "perturbation", for the other commands."""
    camera, perturbation = view.camera, view.perturbation
    pose = np.concatenate([camera.camera_to_world, [[0.0, 0.0, 0.0, 1.0]]])
    fov = math.degrees(2.0 * math.atan(0.5 * camera.height / camera.fy))
    spec = perturbation_object(perturbation)
    return path_json([PathView(pose, fov, camera.height, camera.width)], seconds=1.0, perturbation=spec)


def describe(view: ViewRequest, snapshot: Snapshot | None, status: Status, about: str = "") -> str:
    """Return the figures of a view as Markdown."""
    states = {"off": "", "starting": "starting", "working": "refining …", "idle": "done", "failed": "stopped"}
    state = states[status.state] + (f": {status.detail}" if status.detail else "")
    if snapshot is None:
        return f"**Abstract images**: no bounds yet, [0, 1] is shown  \n{state}"
    height, width = snapshot.size
    size = f"{width} x {height}"
    if snapshot.size != (view.camera.height, view.camera.width):
        size += f", preview of {view.camera.width} x {view.camera.height}"
    figures = snapshot.figures
    lines = [
        f"**Abstract images** ({size})",
        f"MPG {number(figures['mpg'])}, XPG {number(figures['xpg'])}",
        f"of real renders: MPG {number(figures['mpg_witness'])}, XPG {number(figures['xpg_witness'])}",
        f"ratio {number(figures['ratio'])}, {snapshot.seconds:.1f} s, {snapshot.cells} cells",
        f"{snapshot.guarantee}; {state}",
    ]
    if about:
        lines.append(f"Bounds {about}; nothing is known yet of {snapshot.untreated:,} of {height * width:,} pixels")
    return "  \n".join(lines)


def camera_of(cameras: Any) -> PinholeCamera:
    """Return the first of Nerfstudio's ``Cameras`` as a pinhole camera without distortion, as in Splatfacto."""

    def first(value: Any) -> float:
        return float(value.reshape(-1)[0])

    pose = cameras.camera_to_worlds.reshape(-1, *cameras.camera_to_worlds.shape[-2:])[0, :3]
    return PinholeCamera(
        np.ascontiguousarray(pose.detach().cpu().numpy(), np.float64),
        first(cameras.fx),
        first(cameras.fy),
        first(cameras.cx),
        first(cameras.cy),
        int(first(cameras.width)),
        int(first(cameras.height)),
    )
