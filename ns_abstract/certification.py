"""From files to examined cells: a scene, a network and a property, opened together."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ns_abstract.arithmetic.selfcheck import check_functions
from ns_abstract.errors import InputError
from ns_abstract.jsonio import load_json
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.pipeline import Job, Settings, check_content, with_whole_paths
from ns_abstract.report.record import file_stamp
from ns_abstract.sets.box import ParameterBox
from ns_abstract.sets.perturbation import Perturbation
from ns_abstract.sets.tiles import assemble
from ns_abstract.sets.twin import pose_twin
from ns_abstract.verify.cells import Cell, Grid, coarse_parts
from ns_abstract.verify.network import ImageSets, Network, OutputBounds, Substitution, bound_outputs, load_network
from ns_abstract.verify.preprocess import Preprocess
from ns_abstract.verify.properties import Claim, LinearClaim, Property, Query, load_property
from ns_abstract.verify.search import BLOCK, Findings, Search

if TYPE_CHECKING:
    from ns_abstract.verify.interop import Form

#: Of the search's rules: results of different ones are not mixed.
_RULES = 1
#: Pixels that the picture moves by over a first cell: with one parameter, and with more.
_MOTION_LINE, _MOTION = 0.08, 0.5
#: Numbers that a network's layers may have together in a block's cells.
_BLOCK_NUMBERS = 1 << 18
#: Frames whose bounds a process keeps at hand.
_KEPT = 4


@dataclass(frozen=True)
class CertifySettings:
    """What to certify, as the command line says it.

    Attributes:
        load_config: config.yml of a Splatfacto run, or a standard 3DGS .ply.
        camera_path_filename: Camera path JSON.
        model: Network, .onnx or .pt2.
        property: PROP.json.
        perturbation_filename: Perturbation JSON; None: the camera path holds it.
        renderer: "gsplat" or "paper"; None: gsplat.
        arithmetic: "float32" or "real"; None: float32.
        memory: Bytes for the bounds of one process.
    """

    load_config: Path
    camera_path_filename: Path
    model: Path
    property: Path
    perturbation_filename: Path | None = None
    renderer: str | None = None
    arithmetic: str | None = None
    memory: int = 1 << 30

    def absolute(self) -> CertifySettings:
        """The same for a process with another working directory."""
        return with_whole_paths(self)


class FramePictures:
    """One frame's pictures, for `ns_abstract.verify.search.Search`.

    Args:
        job: The scene.
        index: Entry of the camera path.
    """

    def __init__(self, job: Job, index: int) -> None:
        self.frame: SplatFrame = job.frame(index)
        self.box = self.frame.box
        self._job = job
        self._tiles = np.arange(self.frame.tile_count)

    @property
    def pose_set(self) -> Any:
        """The frame's poses."""
        return self.frame.pose_set

    def image(self, values: np.ndarray) -> np.ndarray:
        return assemble(self.frame.render(np.asarray(values, np.float64)), self.frame.camera)

    def sets(self, box: ParameterBox) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
        found = self.frame.bound(box, self._tiles, keep_linear=True)
        assert found.linear is not None
        whole = [assemble(part, self.frame.camera) for part in (*found.linear, found.lower, found.upper)]
        return tuple(whole[:4]), whole[4], whole[5], found.slopes

    @cached_property
    def _twin(self) -> tuple[Reference, Any]:
        return Reference(self._job.scene, self._job.rasteriser), pose_twin(self.frame.pose_set)

    def twin(self, values: torch.Tensor) -> torch.Tensor:
        reference, pose = self._twin
        return reference.image(self.frame.camera, pose(values))


class NetworkModel:
    """A network with its preprocessing, for `ns_abstract.verify.search.Search`.

    Args:
        network: The network.
        preprocess: What comes before it.
        memory: Bytes that its bounds may take.
    """

    def __init__(self, network: Network, preprocess: Preprocess, memory: int) -> None:
        self.network, self.preprocess, self.memory = network, preprocess, memory

    @cached_property
    def _session(self) -> Any:
        """onnxruntime's session, or None for other files than ONNX."""
        if self.network.source.suffix.lower() != ".onnx":
            return None
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        return onnxruntime.InferenceSession(str(self.network.source), options, providers=["CPUExecutionProvider"])

    def outputs(self, images: np.ndarray) -> np.ndarray:
        """[B, n] of onnxruntime (torch for .pt2 files), in float32, picture by picture."""
        with torch.no_grad():
            inputs = self.preprocess.apply(torch.from_numpy(np.asarray(images, np.float32)))
            if self._session is None:
                return np.concatenate([self.network(x[None]).numpy() for x in inputs])
        name = self._session.get_inputs()[0].name
        # one at a time: the same picture gives the same bits whatever stands beside it
        return np.stack([self._session.run(None, {name: x[None].numpy()})[0].reshape(-1) for x in inputs])

    def differentiable(self, images: torch.Tensor) -> torch.Tensor:
        return self.network(self.preprocess.apply(images))

    def input_sets(self, linear: tuple[np.ndarray, ...], lower: np.ndarray, upper: np.ndarray) -> ImageSets:
        return self.preprocess.sets((linear[0], linear[1], linear[2], linear[3]), lower, upper)

    def bound(self, images: ImageSets, query: Query, substitution: Substitution = "everywhere") -> OutputBounds:
        d = images.dimensions
        found = bound_outputs(
            self.network, parametric(images), query.rows, query.offset, substitution=substitution, memory=self.memory
        )
        return found if d else dataclasses.replace(found, a=found.a[..., :0])


def parametric(images: ImageSets) -> ImageSets:
    """The same sets with at least one parameter: that of a single pose moves nothing."""
    if images.dimensions:
        return images
    still = np.zeros((*images.b_lower.shape, 1))
    return dataclasses.replace(images, a_lower=still, a_upper=still)


class Certification:
    """An opened scene, camera path, network and property.

    Args:
        settings: What to certify.

    Raises:
        InputError: A file or a field cannot be used, or the platform's arithmetic is not sound.
    """

    def __init__(self, settings: CertifySettings) -> None:
        self.settings = settings
        self.network = load_network(settings.model)
        self.property: Property = load_property(settings.property, self.network.input_shape, self.network.output_shape)
        size = self.property.preprocess.size(self.network.input_shape)
        job_settings = Settings(
            load_config=settings.load_config,
            camera_path_filename=settings.camera_path_filename,
            perturbation_filename=settings.perturbation_filename,
            renderer=settings.renderer,
            arithmetic=settings.arithmetic,
            resize=size if self.property.preprocess.resize is not None else None,
        )
        self.job = Job(job_settings, default=Perturbation())
        if not isinstance(self.job.method, SplatMethod):
            raise InputError(
                f"certificates are for splats, this run is a {self.job.method.content}",
                file=settings.load_config,
                fix="give a run of splatfacto or a .ply; ns-abstract-render bounds the pictures of a NeRF",
            )
        if any(perturbation.scene for perturbation in self.job.perturbations):
            raise InputError(
                "certificates are for sets of poses",
                file=settings.perturbation_filename or settings.camera_path_filename,
                field="scene",
                fix="leave the key out",
            )
        camera = self.job.path.cameras[0]
        if (camera.height, camera.width) != size:
            raise InputError(
                f"the camera path has {camera.width} x {camera.height} pixels, the network's input "
                f"{size[1]} x {size[0]}",
                file=settings.property,
                field="preprocess.resize",
                fix=f"write [{size[0]}, {size[1]}]",
            )
        problems = check_functions()
        if problems:
            raise InputError(
                f"the platform's arithmetic failed the self-check ({problems[0]})",
                fix="nothing can be certified here; use another machine",
            )
        self.model = NetworkModel(self.network, self.property.preprocess, settings.memory)
        self._searches: dict[tuple[int, Grid], Search] = {}

    @property
    def parameters(self) -> list[tuple[str, str]]:
        """Names and units of all frames' parameters, in the order of boxes."""
        found: dict[str, str] = {}
        for poses in sorted(self.job.pose_sets, key=lambda p: -p.box.dimensions):
            found |= {n: u for n, u in zip(poses.box.names, poses.box.units, strict=True) if n not in found}
        return list(found.items())

    @property
    def fixed(self) -> dict[int, dict[str, float]]:
        """Values of parameters that do not vary, by frame."""
        return {k: dict(poses.fixed) for k, poses in enumerate(self.job.pose_sets)}

    @cached_property
    def fingerprint(self) -> dict[str, Any]:
        """What a stored search must agree with to be continued."""
        prop = dict(load_json(self.settings.property))
        if "file" in prop:
            prop["file"] = file_stamp(self.settings.property.parent / prop["file"])["sha256"]
        text = json.dumps(prop, sort_keys=True)
        return {
            **self.job.fingerprint,
            "model": file_stamp(self.settings.model)["sha256"],
            "property": hashlib.sha256(text.encode()).hexdigest(),
            "rules": _RULES,
        }

    def pictures(self, index: int) -> FramePictures:
        """Frame ``index``, ready to be rendered and bounded."""
        return FramePictures(self.job, index)

    def claim(self, pictures: FramePictures) -> Claim:
        """What is to hold in a frame.

        Raises:
            InputError: The property makes no sense there.
        """

        def nominal() -> np.ndarray:
            return self.model.outputs(pictures.image(pictures.box.middle)[None])[0]

        return self.property.bind(pictures.pose_set, nominal)

    def grid(self, index: int) -> Grid:
        """The cells of a frame whose search begins.

        Raises:
            InputError: The partition that was asked for does not fit the parameters.
        """
        pictures = self.pictures(index)
        box = pictures.box
        pixels = _MOTION_LINE if box.dimensions == 1 else _MOTION
        coarse = coarse_parts(pictures.frame.motion(box), pixels)
        if self.property.partitions is None:
            return Grid.adaptive(box, coarse)
        try:
            return Grid.fixed(box, self.property.partitions, coarse)
        except InputError as error:
            raise error.within(self.settings.property) from None

    @cached_property
    def block(self) -> int:
        """Cells examined together: few where each takes long, so that little is lost and progress is seen."""
        numbers = sum(math.prod(self.network.shape(k)) for k in range(len(self.network.nodes) + 1))
        return max(1, min(BLOCK, _BLOCK_NUMBERS // numbers))

    def first_blocks(self, grid: Grid) -> list[list[Cell]]:
        """What a frame's search begins with."""
        roots = grid.roots()
        return [roots[i : i + self.block] for i in range(0, len(roots), self.block)]

    def search(self, index: int, grid: Grid) -> Search:
        """The search of a frame; kept at hand."""
        key = (index, grid)
        if key not in self._searches:
            while len(self._searches) >= _KEPT:
                self._searches.pop(next(iter(self._searches)))
            pictures = self.pictures(index)
            every_unit = self.property.partitions is not None
            self._searches[key] = Search(
                pictures, self.model, self.claim(pictures), grid, every_unit=every_unit, block=self.block
            )
        return self._searches[key]

    def write_vnnlib(self, index: int, box: ParameterBox, target: Path, form: Form) -> tuple[Path, Path]:
        """Write the abstract image of a cell, the network and the property for other verifiers.

        Args:
            index: Entry of the camera path.
            box: The cell.
            target: Path without ending.
            form: As in `ns_abstract.verify.interop.write_vnnlib`.

        Returns:
            The .onnx and the .vnnlib file.

        Raises:
            InputError: The property is not linear in the outputs, or the network cannot be extended.
        """
        from ns_abstract.verify.interop import write_vnnlib

        pictures = self.pictures(index)
        claim = self.claim(pictures)
        if not isinstance(claim, LinearClaim):
            raise InputError(
                "is not linear in the network's outputs",
                file=self.settings.property,
                field="type",
                fix="give a property of type classification or vnnlib",
            )
        linear, lower, upper, _ = pictures.sets(box)
        images = parametric(self.model.input_sets(tuple(part[None] for part in linear), lower[None], upper[None]))
        return write_vnnlib(self.settings.model, images, claim.rows, claim.offset, target, form, claim.groups)

    def partitions(self, grid: Grid) -> int | None:
        """Number of parts of the fixed partition, if there is one."""
        return math.prod(grid.units) if self.property.partitions is not None else None


_opened: dict[CertifySettings, Certification] = {}


def examine_block(
    settings: CertifySettings, fingerprint: dict[str, Any], index: int, grid: Grid, cells: tuple[Cell, ...]
) -> Findings:
    """Examine one block on a worker, which opens the files once and keeps them.

    Raises:
        InputError: The worker reads other files under the same names than the command did.
    """
    if settings not in _opened or _opened[settings].fingerprint != fingerprint:
        _opened.clear()
        import numba

        # as many workers as cores; more threads would only wait for each other
        numba.set_num_threads(1)
        torch.set_num_threads(1)
        job = Certification(settings)
        check_content(job.fingerprint, fingerprint, settings.load_config)
        _opened[settings] = job
    return _opened[settings].search(index, grid).examine(cells)
