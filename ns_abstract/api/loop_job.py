"""A network in the loop, opened: scene, camera, law of motion and network (docs/dev/design.md, L1 to L5)."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.api.assumptions import choice, set_choices
from ns_abstract.api.certification import MEMORY
from ns_abstract.api.files import resized
from ns_abstract.api.frame_pictures import PropertySource
from ns_abstract.api.job import Job, require_sound_platform
from ns_abstract.api.network_stamp import network_prints
from ns_abstract.api.picture_question import PlanePictures
from ns_abstract.api.scenes import Scene
from ns_abstract.arithmetic.forms import MAX_DIMENSIONS
from ns_abstract.execution.worker_cache import Recipe, built
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.digests import recorded
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import TRANSLATIONS
from ns_abstract.reach.learned import LearnedDynamics
from ns_abstract.reach.loop import Loop, load_loop, parse_loop, within_field
from ns_abstract.reach.pictures import PropertyView
from ns_abstract.reach.search import QUESTIONS, LoopBlockResult, LoopSearch
from ns_abstract.reach.tubes import ControlBounds, Dependence, TubeBuilder
from ns_abstract.verify.camera_response import CameraResponse
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import NetworkArithmetic, load_network
from ns_abstract.verify.network.explain import check_cell
from ns_abstract.verify.scene_margin import REGISTRATION, CellOutcome, ProveCell, VariationKind
from ns_abstract.verify.scene_pictures import ScenePictures

#: Of the search's rules: results of different ones are not mixed.
_RULES = 5


class LoopJob:
    """An opened scene and a loop.

    ``job``: the scene, with the poses of the loop's camera as its only set. ``network_arithmetic``: whether every
    float32 evaluation of the network is meant, or the exact one alone. Raises InputError where the loop does not go
    with the network, or the platform's arithmetic is not sound.
    """

    def __init__(self, job: Job, loop: Loop, network_arithmetic: NetworkArithmetic = "float32") -> None:
        require_sound_platform()
        #: Of masks and lists of Gaussians, as they were read.
        self._digests: dict[str, str] = {}
        if loop.views:
            with recorded(self._digests):
                loop = parse_loop(dict(loop.value), loop.network.absolute().parent, job.method.dataset_scale)
        self.job, self.loop = job, loop
        # selections and regions are checked before anything is computed
        self._seen = self._views(job.pose_sets[0])
        self.network = load_network(loop.network, **loop.loading)
        self.model = NetworkModel(self.network, loop.preprocess, MEMORY, network_arithmetic)
        outputs = loop.control.gain.shape[1]
        if self.network.output_size != outputs:
            raise InputError(
                f"the network has {self.network.output_size} outputs, the gain {outputs} columns",
                field="control.gain",
                fix=f"write one column by output, {self.network.output_size}",
            )

    def reacher(self, dependence: Dependence = "kept") -> TubeBuilder:
        """Return a builder of the loop's tubes (boxes of all states by step), with this ``dependence``."""
        view = ScenePictures(self.job.method.frame(self.job.pose_sets[0]))
        return TubeBuilder(self.loop, view, ControlBounds(self.model, self.loop.control), dependence, views=self._seen)

    def _views(self, poses: PoseBox) -> tuple[PropertyView, ...]:
        """Return views by which the loop's picture properties are evaluated over the poses of a set, one per property.

        Raises:
            InputError: A selection picks nothing, or a region reaches beyond the picture.
        """
        views = []
        for key, prop in self.loop.views.items():
            size = prop.preprocess.resize or (poses.camera.height, poses.camera.width)
            try:
                model, pictures = prop.model(*size), PlanePictures(self.job.method, resized(poses, *size), prop)
            except InputError as error:
                raise within_field(error, key) from None
            views.append(PropertyView(prop, pictures, model))
        return tuple(views)

    @cached_property
    def search(self) -> LoopSearch:
        return LoopSearch(self.reacher())

    def examine(self, number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> LoopBlockResult:
        return self.search.examine(number, grid, cells)

    @property
    def _moves(self) -> bool:
        # a place that does not depend on the state is no parameter that could be off
        return set(TRANSLATIONS) <= set(self.loop.camera.names)

    def places(self, kind: VariationKind) -> bool:
        """Whether motions of the scene (``kind``) can be bounded: as part of the pose, or as more parameters."""
        fits = len(self.loop.camera.names) + len(kind.place) <= MAX_DIMENSIONS
        return fits or (kind is REGISTRATION and self._moves)

    def _varied(self, kind: VariationKind, radius: float) -> TubeBuilder:
        """Computes tubes for all scenes around the stored one (V13)."""
        method, poses = self.job.method, self.job.pose_sets[0]
        if kind is REGISTRATION and self._moves:
            return replace(self.reacher(), registration=radius)
        if kind.place:
            placed = poses.registered(kind.place, radius)
            return replace(self.reacher(), view=ScenePictures(method.frame(placed)), views=self._views(placed))
        if kind.response is not None:
            view = ScenePictures(method.frame(poses), CameraResponse(kind.response, radius))
        else:
            view = ScenePictures(method.frame(self.job.varied(0, kind.variation(radius))))
        return replace(self.reacher(), view=view)

    def prover(self, kind: VariationKind) -> ProveCell:
        """Return a function that bounds and attacks cells for all scenes around the stored one (V13)."""

        # radii come one after the other
        @lru_cache(1)
        def search(radius: float) -> LoopSearch:
            return LoopSearch(self._varied(kind, radius))

        def prove(radius: float, number: int, box: ParameterBox) -> CellOutcome:
            outcome = search(radius).prove_cell(QUESTIONS[number], box)
            if outcome.example is None:
                return outcome
            return replace(outcome, example={**outcome.example, "radius": np.array(radius)})

        return prove

    @property
    def questions(self) -> list[int]:
        """Numbers of the questions that are asked."""
        wanted = self.loop.unsafe or self.loop.required, self.loop.goal
        return [number for number, name in enumerate(QUESTIONS) if wanted[name == "reaches"]]

    @property
    def recipe(self) -> Recipe[LoopJob]:
        loop = self.loop
        # laws of motion do not travel
        parts = self.job.recipe.open, partial(parse_loop, dict(loop.value), loop.network.absolute().parent)
        again = partial(built, LoopJob, parts, self.model.arithmetic)
        return Recipe(again, self.fingerprint, self.job.source.file)

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        output = self.loop.value.get("output")
        arithmetic = None if self.model.arithmetic == "float32" else self.model.arithmetic
        return (
            *self.job.assumptions,
            choice("network output", self.network.output or "the only one", output, "loop file: output"),
            choice("network_arithmetic", self.model.arithmetic, arithmetic, "--network-arithmetic"),
        )

    @property
    def fingerprint(self) -> dict[str, Any]:
        return self._fingerprint

    @cached_property
    def _fingerprint(self) -> dict[str, Any]:
        text = json.dumps(self.loop.value, sort_keys=True)
        law = self.loop.dynamics
        learned = network_prints("dynamics", law.network) if isinstance(law, LearnedDynamics) else {}
        if self.loop.views:
            # masks and lists of Gaussians are files of their own
            stated = [self.loop.value.get(key) for key in ("unsafe", "goal")]
            learned["views"] = PropertySource(stated, self.loop.network.absolute(), self._digests).stamped
            # distances may be stated in units of the data set
            learned["dataset_scale"] = self.job.method.dataset_scale
        return {
            **self.job.fingerprint,
            **learned,
            **network_prints("network", self.network),
            "loop": hashlib.sha256(text.encode()).hexdigest(),
            "network_arithmetic": self.model.arithmetic,
            "rules": _RULES,
        }


def open_loop(
    scene: Scene,
    file: Path,
    arithmetic: str | None = None,
    network_arithmetic: NetworkArithmetic = "float32",
    workers: int = 1,
) -> LoopJob:
    """Open LOOP.json with its network.

    Raises:
        InputError: A file or a field cannot be used, or there is not the memory for ``workers`` processes.
    """
    loop = load_loop(file)
    try:
        require_sound_platform()
        size = loop.preprocess.size(load_network(loop.network, **loop.loading).input_shape)
        job = LoopJob(_seen(scene, loop, size, arithmetic), loop, network_arithmetic)
        dimensions = job.job.pose_sets[0].box.dimensions
        check_cell(job.network, dimensions, job.job.memory / workers, "fewer --workers")
        return job
    except InputError as error:
        raise error.within(file) if error.field and not error.field.startswith("--") else error from None


def _seen(scene: Scene, loop: Loop, size: tuple[int, int], arithmetic: str | None) -> Job:
    """Return a job of the scene and the poses of the loop's camera. Raises InputError: loops are not for this scene."""
    poses = loop.camera.poses(size)
    origin = "the network's input" if loop.preprocess.resize is None else "loop file: preprocess.resize"
    job = Job(scene, [poses], arithmetic=arithmetic, set_choices=set_choices([poses], origin, "loop file: camera"))
    if job.rays:
        raise InputError(
            f"loops are for splats, this run is a {job.method.content}",
            file=scene.source.file,
            fix="give a run of splatfacto or a .ply",
        )
    return job
