"""A network and what is to hold of it, as a certification asks."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

from ns_abstract.api.assumptions import choice
from ns_abstract.api.files import resized
from ns_abstract.api.frame_pictures import FramePictures, PropertySource
from ns_abstract.api.job import Job
from ns_abstract.api.network_stamp import network_prints
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.digests import recorded
from ns_abstract.io.errors import InputError
from ns_abstract.refine.protocol import Method
from ns_abstract.verify.eight_bit import Picture
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import NetworkArithmetic, load_network
from ns_abstract.verify.network.explain import check_cell
from ns_abstract.verify.properties import Property
from ns_abstract.verify.property_reading import loading, parse_property


class Question:
    """A network and the property to prove of it. Raises InputError where a file or a field cannot be used."""

    #: Pixels that the picture moves by over a first cell: with one parameter, and with more.
    motion = (0.08, 0.5)
    #: Frames whose bounds a process keeps at hand.
    frames = 4

    def __init__(self, model: Path, source: PropertySource) -> None:
        self.model, self.source = model, source
        try:
            load_options = loading(source.value)
        except InputError as error:
            raise source.within(error) from None
        self.network = load_network(model, **load_options)
        shapes = self.network.input_shape, self.network.output_shape
        try:
            with recorded(source.digests):
                self.property: Property = parse_property(source.value, source.folder, *shapes)
        except InputError as error:
            raise source.within(error) from None
        #: height and width of the network's pictures
        self.size = self.property.preprocess.size(self.network.input_shape)

    def drawn(self, poses: PoseBox) -> PoseBox:
        """Return the set with pictures of the size that the property asks for."""
        return poses if self.property.preprocess.resize is None else resized(poses, *self.size)

    def opened(self, job: Job) -> None:
        """Check that the pictures of a scene with its sets are those of the network.

        Raises:
            InputError: They have another size.
        """
        camera, size = job.pose_sets[0].camera, self.size
        if (camera.height, camera.width) != size:
            raise InputError(
                f"the camera path has {camera.width} x {camera.height} pixels, the network's input "
                f"{size[1]} x {size[0]}",
                file=self.source.file,
                field="preprocess.resize",
                fix=f"write [{size[0]}, {size[1]}]",
            )

    def searched(self, memory: int, arithmetic: NetworkArithmetic, picture: Picture) -> NetworkModel:
        """Return the network as a model of the search, whose bounds may take so many bytes.

        Raises:
            InputError: It takes whole numbers, and pictures are not of 8 bits.
        """
        if self.network.whole_numbers and picture != "8-bit":
            fix = "give --picture 8-bit"
            raise InputError("takes whole numbers from 0 to 255", file=self.model, field="input", fix=fix)
        return NetworkModel(self.network, self.property.preprocess, memory, arithmetic)

    def pictures(self, method: Method, poses: PoseBox, picture: Picture) -> FramePictures:
        """Return the pictures of a set that are shown to the network."""
        return FramePictures(method, poses, picture)

    @property
    def name(self) -> str:
        """What the property is about."""
        return self.network.source.name

    @property
    def numbers(self) -> int:
        """How many numbers the network computes for one picture."""
        return sum(math.prod(self.network.shape(k)) for k in range(len(self.network.nodes) + 1))

    def guarantee(self, arithmetic: NetworkArithmetic) -> tuple[str, ...]:
        """Return sentences on the evaluations of the network that the certificate covers."""
        return self.network.guarantee(arithmetic)

    def check_memory(self, dimensions: int, memory: float) -> None:
        """Refuse a network one cell of which, of so many parameters, takes more bytes than there are.

        Raises:
            InputError: It does, about.
        """
        check_cell(self.network, max(1, dimensions), memory)

    def describe(self) -> dict[str, Any]:
        """Return the network for reports."""
        shapes = {"input": self.network.input_shape, "output": self.network.output_shape}
        return {**self.network.stamp, **shapes}

    def fingerprint(self, arithmetic: NetworkArithmetic) -> dict[str, Any]:
        """Return the identity of the network; a stored search with another one is not continued."""
        return {**network_prints("model", self.network), "network_arithmetic": arithmetic}

    def choices(self, arithmetic: NetworkArithmetic, picture: Picture) -> tuple[Assumption, ...]:
        """Return the assumptions of verdicts about the network, each with its origin."""
        name, output = self.source.name, self.source.value.get("output")
        return (
            choice("network output", self.network.output or "the only one", output, f"{name}: output"),
            choice(
                "network_arithmetic", arithmetic, None if arithmetic == "float32" else arithmetic,
                "--network-arithmetic",
            ),
            choice("picture", picture, None if picture == "float" else picture, "--picture"),
        )  # fmt: skip

    def absolute(self) -> partial[Question]:
        """Return a partial that opens the same question in a process with another working directory."""
        return partial(Question, self.model.absolute(), self.source.absolute())
