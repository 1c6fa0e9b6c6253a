"""A certification: scene, sets of poses, network and property, and the examination of cells."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ns_abstract.api.files import Settings, open_job
from ns_abstract.api.frame_pictures import FramePictures, PropertySource
from ns_abstract.api.job import Job, require_sound_platform, warm_up
from ns_abstract.api.network_question import Question
from ns_abstract.api.picture_question import PictureQuestion
from ns_abstract.arithmetic.forms import MAX_DIMENSIONS
from ns_abstract.execution.cancellation import cancel_when
from ns_abstract.execution.worker_cache import Recipe, built
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import show
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.refine.protocol import RayFrame
from ns_abstract.verify.camera_response import CameraResponse
from ns_abstract.verify.cells import Cell, CellGrid, initial_divisions
from ns_abstract.verify.eight_bit import Picture
from ns_abstract.verify.model import NetworkModel, parametric
from ns_abstract.verify.network import NetworkArithmetic
from ns_abstract.verify.picture_properties import PICTURE_TYPES, MeasureModel, is_of_picture
from ns_abstract.verify.properties import Claim, LinearClaim, Property
from ns_abstract.verify.protocol import FrameImages as SearchedScene
from ns_abstract.verify.protocol import Model as SearchedModel
from ns_abstract.verify.registration import RegisteredImages, RegisteredModel
from ns_abstract.verify.scene_margin import KINDS, CellOutcome, ProveCell, VariationKind, bounded_kinds
from ns_abstract.verify.search import BLOCK, Search
from ns_abstract.verify.search_results import BlockResult, ContradictionError
from ns_abstract.verify.sub_box_proof import SubBoxProof, pixel_costs

if TYPE_CHECKING:
    from ns_abstract.verify.interop import Form, LibraryVersion

#: Of the search's rules: results of different ones are not mixed.
_RULES = 10
#: Numbers that a network's layers may have together in a block's cells.
_BLOCK_NUMBERS = 1 << 18
#: Slanted parts of a cell at most, about: narrower cells need more of them in all.
_MOST_SHEARED = 512
#: What their sets may cost of the margin at first.
_AIM_SHEARED = 0.32
#: Cells of the first blocks: early results, of which a kill leaves the more.
_FIRST_BLOCKS = (1, 1, 1, 1, 2, 2, 4, 4)
#: Part of the time in which it must show how long a ray takes.
_FORESEEN = 0.25
#: Bytes for the bounds of one process, where nothing is said.
MEMORY = 1 << 30


#: What a certification is about.
AnyQuestion = Question | PictureQuestion


def question_of(model: Path | None, source: PropertySource) -> AnyQuestion:
    """Return the question of a property, about a network's outputs or about the picture.

    Raises:
        InputError: A file or a field cannot be used, or the property needs a network, or has none.
    """
    if model is not None and is_of_picture(source.value):
        raise InputError(
            "given with a property of the picture, which asks no network", field="--model", fix="leave it out"
        )
    if model is not None:
        return Question(model, source)
    if not is_of_picture(source.value):
        kind = source.value.get("type") if isinstance(source.value, dict) else None
        raise source.within(
            InputError(
                f"{'missing' if kind is None else show(kind)}, and no --model is given",
                field="type",
                fix=f"write one of {', '.join(PICTURE_TYPES)}, or give the network with --model",
            )
        )
    return PictureQuestion(source)


class Certification:
    """An opened scene with sets of poses, and a property of a network or of the picture.

    Args:
        job: The scene and the sets, one by frame, as `Question.drawn` makes them.
        memory: Bytes for the network's bounds of one process.
        network_arithmetic: Whether every float32 evaluation of the network is meant, or the exact one alone.
        picture: Whether the network is shown floats or pictures of 8 bits.

    Raises:
        InputError: The question does not go with the sets, or the platform's arithmetic is not sound.
    """

    def __init__(
        self,
        job: Job,
        question: AnyQuestion,
        memory: int = MEMORY,
        network_arithmetic: NetworkArithmetic = "float32",
        picture: Picture = "float",
    ) -> None:
        self.job, self.question = job, question
        self.picture: Picture = picture
        if job.method.differentiable(job.pose_sets[0]) is None:
            raise InputError(
                f"pictures of {job.method.content} have no slopes that the search could follow",
                file=job.source.file,
                fix="give another scene; ns-abstract-render bounds the pictures of this one",
            )
        question.opened(job)
        require_sound_platform()
        self.memory: int = memory
        self.arithmetic: NetworkArithmetic = network_arithmetic
        self.model: NetworkModel | MeasureModel = question.searched(memory, network_arithmetic, picture)
        self.property: Property = question.property
        #: the search of a frame, by its number and cells; some are kept at hand
        self.search = lru_cache(question.frames)(self._search)

    @property
    def recipe(self) -> Recipe[Certification]:
        question = self.question
        parts = self.job.recipe.open, question.absolute()
        again = partial(
            built, Certification, parts, self.memory, network_arithmetic=self.arithmetic, picture=self.picture
        )
        return Recipe(again, self.fingerprint, self.job.source.file)

    @property
    def scenes(self) -> tuple[str, ...]:
        """Sentence that the set contains variations of the scene, if it does."""
        if not any(poses.perturbation.scene for poses in self.job.pose_sets):
            return ()
        return (
            "every pose stands for the images of all scenes of the set: each Gaussian that the key scene picks varies "
            "by itself; falsified cells name a pose and a scene",
        )

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        resize = self.property.preprocess.resize
        drawn = {} if resize is None else {"picture size": f"{self.question.source.name}: preprocess.resize"}
        return (
            *(replace(entry, origin=drawn.get(entry.name, entry.origin)) for entry in self.job.assumptions),
            *self.question.choices(self.arithmetic, self.picture),
        )

    @property
    def fingerprint(self) -> dict[str, Any]:
        return self._fingerprint

    @cached_property
    def _fingerprint(self) -> dict[str, Any]:
        text = json.dumps(self.question.source.stamped, sort_keys=True)
        return {
            **self.job.fingerprint,
            **self.question.fingerprint(self.arithmetic),
            "property": hashlib.sha256(text.encode()).hexdigest(),
            **({} if self.picture == "float" else {"picture": self.picture}),
            "rules": _RULES,
        }

    def pictures(self, index: int) -> FramePictures:
        """Return the pictures of frame ``index``, ready to be rendered and bounded."""
        return self.question.pictures(self.job.method, self.job.pose_sets[index], self.picture)

    def claim(self, pictures: FramePictures, poses: PoseBox | None = None) -> Claim:
        """Return the property's claim on a frame.

        ``poses``: the frame's set, if the pictures use sheared parameters. Raises InputError if the property does not
        fit the frame.
        """

        def nominal() -> np.ndarray:
            return self.model.outputs(pictures.image(pictures.box.middle)[None])[0]

        return self.property.bind(pictures.pose_set if poses is None else poses, nominal)

    def grid(self, index: int) -> CellGrid:
        """Return the grid of cells with which a frame's search begins.

        Raises:
            InputError: The partition that was asked for does not fit the parameters.
        """
        pictures = self.pictures(index)
        box = pictures.box
        pixels = self.question.motion[0 if box.dimensions == 1 else 1]
        coarse = initial_divisions(pictures.frame.motion(box), pixels)
        if self.property.partitions is None:
            return CellGrid.adaptive(box, coarse)
        try:
            return CellGrid.fixed(box, self.property.partitions, coarse)
        except InputError as error:
            raise self.question.source.within(error) from None

    @cached_property
    def block(self) -> int:
        """Cells examined together: few where each takes long, so that little is lost and progress is seen."""
        return max(1, min(BLOCK, _BLOCK_NUMBERS // self.question.numbers))

    def first_blocks(self, grid: CellGrid) -> list[list[Cell]]:
        """Return the blocks of cells that a frame's search examines first."""
        roots = grid.roots()
        ends = [0, *itertools.accumulate(size for size in _FIRST_BLOCKS if size < self.block)]
        ends += range(ends[-1] + self.block, len(roots) + self.block, self.block)
        return [roots[a:b] for a, b in itertools.pairwise(ends) if a < len(roots)]

    def _search(self, index: int, grid: CellGrid) -> Search:
        pictures = self.pictures(index)
        every_unit = self.property.partitions is not None
        claim = self.claim(pictures)
        pictures.weigh = partial(pixel_costs, pictures, self.model, claim)
        cover = self._cover(pictures)
        costly = isinstance(self.model, NetworkModel)
        return Search(
            pictures, self.model, claim, grid, every_unit=every_unit, block=self.block, cover=cover, costly=costly
        )

    def examine(self, number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> BlockResult:
        return self.search(number, grid).examine(cells)

    def _cover(self, pictures: FramePictures, response: CameraResponse | None = None) -> SubBoxProof | None:
        """Return the prover of a frame's cells by sub-boxes; None: one parameter, or rays cost more than networks."""
        model = self.model
        if not isinstance(model, NetworkModel) or pictures.box.dimensions < 2 or pictures.frame.tilewise:
            return None
        poses, straight = pictures.pose_set, SubBoxProof(pictures, model, model, self.claim(pictures))
        sheared = FramePictures(self.job.method, poses, self.picture, response, sheared=True)
        if not (shear := sheared.pose_set.shear):
            return straight

        def frame(cell: ParameterBox) -> tuple[ParameterBox, Callable[[ParameterBox], ParameterBox | None]]:
            sheared_poses = poses.within(cell).sheared(shear)
            return sheared_poses.box, sheared_poses.feasible

        claim = self.claim(pictures, sheared.pose_set)
        return SubBoxProof(
            sheared, model, model, claim, frame, most_parts=_MOST_SHEARED, block=1, aim=_AIM_SHEARED, other=straight
        )

    def places(self, kind: VariationKind) -> bool:
        """Whether the parameters of a kind of variation can be bounded together with those of every set."""
        room = all(poses.box.dimensions + len(kind.place) <= MAX_DIMENSIONS for poses in self.job.pose_sets)
        return isinstance(self.model, NetworkModel) and room

    @property
    def kinds(self) -> tuple[VariationKind, ...]:
        """Kinds of variations for the scene margin; for a property of the picture those of Gaussians alone."""
        return bounded_kinds(self.places) if isinstance(self.model, NetworkModel) else KINDS

    def _varied(
        self, kind: VariationKind, radius: float, frame: int
    ) -> tuple[FramePictures, SearchedScene, SearchedModel, SubBoxProof | None]:
        """Return a frame's pictures under a variation, the searched scene and network, and the sub-box prover (V13)."""
        method, poses, model = self.job.method, self.job.pose_sets[frame], self.model
        if kind.place:
            assert isinstance(model, NetworkModel)
            pictures = FramePictures(method, poses.registered(kind.place, radius), self.picture)
            return pictures, RegisteredImages(pictures, pictures.frame), RegisteredModel(model), None
        response = None
        if kind.response is not None:
            response = CameraResponse(kind.response, radius)
            pictures = FramePictures(method, poses, self.picture, response)
        else:
            pictures = self.question.pictures(method, self.job.varied(frame, kind.variation(radius)), self.picture)
        return pictures, pictures, model, self._cover(pictures, response)

    def prover(self, kind: VariationKind) -> ProveCell:
        """Return a function that bounds and attacks cells for all scenes around the stored one (V13)."""

        # radii come one after the other; what is claimed does not depend on the scenes
        @lru_cache(1)
        def varied(
            radius: float, frame: int
        ) -> tuple[FramePictures, SearchedScene, SearchedModel, SubBoxProof | None, Claim]:
            return *self._varied(kind, radius, frame), self.claim(self.pictures(frame))

        def prove(radius: float, frame: int, box: ParameterBox) -> CellOutcome:
            pictures, scene, model, cover, claim = varied(radius, frame)
            search = Search(scene, model, claim, CellGrid.adaptive(box, [1] * box.dimensions), cuts=False, cover=cover)
            (leaf,) = search.examine(search.grid.roots()).leaves
            if leaf.verdict == "certified":
                return CellOutcome("holds", "", np.zeros(box.dimensions))
            if leaf.verdict == "unknown":
                # the network's bounds are there, and not above 0
                reason = leaf.reason if leaf.margin is None else "the margin's bound is not above 0"
                whole = scene.widened(box) if isinstance(scene, RegisteredImages) else box
                return CellOutcome("unknown", reason, pictures.frame.motion(whole)[: box.dimensions])
            if leaf.scene is None:
                raise ContradictionError(
                    f"internal error: the stored scene breaks at {leaf.counterexample} what was proved there"
                )
            assert leaf.image is not None and leaf.outputs is not None
            example = {"image": leaf.image, "outputs": leaf.outputs, "values": np.array(leaf.counterexample)}
            example |= {"names": np.array(box.names, str), "radius": np.array(radius)}
            example |= {f"scene_{name}": array for name, array in leaf.scene.items()}
            return CellOutcome("falsified", "a scene breaks it", np.zeros(box.dimensions), example)

        return prove

    def foresee(self, index: int, seconds: float) -> None:
        """Raise InputError, with the time needed, if ``seconds`` are too few for the first part of a frame of rays."""
        if not self.job.rays:
            return
        pictures = cast("FramePictures", self.search(index, self.grid(index)).scene)
        frame, rays = cast("tuple[RayFrame, int]", pictures.effort)
        # compiling says nothing about rays
        warm_up(frame)
        begin = time.perf_counter()
        with cancel_when(lambda: time.perf_counter() - begin > _FORESEEN * seconds):
            by_ray, parts = frame.effort()
        more = ""
        if by_ray is None:
            # not even one was done
            by_ray, more = _FORESEEN * seconds, "more than "
        workers = self.job.workers
        least = by_ray * rays / workers
        if more or least > seconds:
            cut = f"over one of {parts:,} parts of the set " if parts > 1 else ""
            raise InputError(
                f"{self.job.method.content}: {rays:,} rays {cut}take {more}{least:,.0f} s with {workers} "
                f"{'process' if workers == 1 else 'processes'} ({more}{by_ray:.2g} s a ray), {seconds:,.0f} s given",
                file=self.job.source.file,
                field="--time-budget",
                fix="give more, a smaller network or picture, fewer --num-samples, or declare an --occupancy-grid",
            )

    def write_vnnlib(
        self, index: int, box: ParameterBox, target: Path, form: Form, version: LibraryVersion = "1.0"
    ) -> tuple[Path, Path]:
        """Write the abstract image of a cell, the network and the property for other verifiers.

        ``form``, ``version``: as in `ns_abstract.verify.interop.write_vnnlib`. Returns the .onnx and the .vnnlib file.
        Raises InputError where the property is not linear in the outputs, or the network cannot be extended.
        """
        from ns_abstract.verify.interop import write_vnnlib

        pictures = self.pictures(index)
        claim = self.claim(pictures)
        if not isinstance(self.question, Question) or not isinstance(claim, LinearClaim):
            raise InputError(
                "is not linear in a network's outputs",
                file=self.question.source.file,
                field="type",
                fix="give a property of type classification or vnnlib",
            )
        linear, lower, upper, _ = pictures.linear_sets(box)
        model = self.question.searched(self.memory, self.arithmetic, self.picture)
        images = parametric(model.input_sets(tuple(part[None] for part in linear), lower[None], upper[None]))
        network = self.question.network
        return write_vnnlib(network, images, claim.rows, claim.offset, target, form, claim.groups, version)

    def partitions(self, grid: CellGrid) -> int | None:
        """Return the number of parts of the fixed partition; None without one."""
        return math.prod(grid.units) if self.property.partitions is not None else None


@dataclass(frozen=True)
class CertifySettings:
    """Options of the command line that state what to certify.

    ``model``: network, .onnx; None: the property is one of the picture. ``network_arithmetic``: "float32" or "real".
    ``picture``: whether the network is shown floats or pictures of 8 bits. ``memory``: bytes for the bounds of one
    process.
    """

    files: Settings
    model: Path | None
    property: Path
    network_arithmetic: NetworkArithmetic = "float32"
    picture: Picture = "float"
    memory: int = MEMORY


def open_certification(settings: CertifySettings) -> Certification:
    """Open the files of a command line. Raises InputError where a file or a field cannot be used."""
    question = question_of(settings.model, PropertySource.of(settings.property))
    job = open_job(settings.files, default=Perturbation(), drawn=question.drawn)
    return Certification(job, question, settings.memory, settings.network_arithmetic, settings.picture)
