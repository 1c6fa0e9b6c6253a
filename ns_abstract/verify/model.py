"""A network with its preprocessing, as the search for certificates uses it (docs/dev/design.md, V6)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import get_args

import numpy as np
import torch

from ns_abstract.io.arguments import one_of
from ns_abstract.verify.network import (
    ImageSets,
    Network,
    NetworkArithmetic,
    OutputBounds,
    SharedCoefficients,
    bound_outputs,
    reusable_anywhere,
)
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.load import onnx_runner, require_unchanged
from ns_abstract.verify.network.phase_tree import PhaseTree
from ns_abstract.verify.network.subnormals import subnormals_kept
from ns_abstract.verify.preprocess import Preprocess
from ns_abstract.verify.properties import Query


class NetworkModel:
    """A network with its preprocessing, for `ns_abstract.verify.search.Search`; bounds take ``memory`` bytes.

    Raises:
        InputError: ``arithmetic`` is none of the two.
    """

    def __init__(
        self, network: Network, preprocess: Preprocess, memory: int, arithmetic: NetworkArithmetic = "float32"
    ) -> None:
        self.network, self.preprocess, self.memory = network, preprocess, memory
        # another word would be bounded as the exact network, and reported as every float32 evaluation
        one_of(arithmetic, get_args(NetworkArithmetic), "network_arithmetic")
        self.arithmetic: NetworkArithmetic = arithmetic

    @cached_property
    def _run(self) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that runs the file in onnxruntime. InputError where the file has changed meanwhile."""
        run = onnx_runner(self.network.source, self.network.output, self.network.input_shape)
        require_unchanged(self.network)
        return run

    def outputs(self, images: np.ndarray) -> np.ndarray:
        """Return outputs [B, n] of onnxruntime in float32, picture by picture.

        With network arithmetic "real": of the same weights in float64.
        """
        with torch.no_grad():
            inputs = self.preprocess.apply(torch.from_numpy(np.asarray(images, np.float32)))
            if self.arithmetic == "real":
                # onnxruntime is given whole numbers by its runner
                inputs = inputs.round() if self.network.whole_numbers else inputs
                return np.concatenate([self.network(x[None].double()).numpy() for x in inputs])
        # one at a time: the same picture gives the same bits whatever stands beside it
        return np.stack([self._run(x[None].numpy()) for x in inputs])

    def differentiable(self, images: torch.Tensor) -> torch.Tensor:
        return self.network(self.preprocess.apply(images))

    def input_sets(self, linear: tuple[np.ndarray, ...], lower: np.ndarray, upper: np.ndarray) -> ImageSets:
        return self.preprocess.input_sets((linear[0], linear[1], linear[2], linear[3]), lower, upper)

    @property
    def reusable_anywhere(self) -> bool:
        return reusable_anywhere(self.network)

    def shared_bounds(self, images: ImageSets) -> ModelSharedBounds:
        """Return bounds of one cell, whose coefficients can bound others (N15)."""
        shared = SharedCoefficients(self.network, parametric(images), memory=self.memory, arithmetic=self.arithmetic)
        return ModelSharedBounds(shared)

    def bound(self, images: ImageSets, query: Query) -> OutputBounds:
        d = images.dimensions
        output_bounds = bound_outputs(
            self.network, parametric(images), query.rows, query.offset, memory=self.memory, arithmetic=self.arithmetic
        )
        return output_bounds if d else dataclasses.replace(output_bounds, a=output_bounds.a[..., :0])

    @subnormals_kept()
    def branch(self, images: ImageSets, query: Query, groups: Sequence[Sequence[int]], most_branches: int) -> float:
        """Return a lower bound of the margin ``min over groups of max over its rows`` in the one cell of ``images``.

        It is positive if at most ``most_branches`` branches on activation phases prove every group (N16).
        """
        cells = NetworkBounds(self.network, parametric(images), self.memory, self.arithmetic, 1)
        tree, least = PhaseTree(cells, query.rows, query.offset), np.inf
        for group in groups:
            result = tree.prove(group, most_branches)
            least = min(least, result.least)
            if not result.proved:
                break
        return least


@dataclasses.dataclass(frozen=True)
class ModelSharedBounds:
    """Bounds of a cell, and of others with its coefficients; with ``fresh`` the last activation is refined anew."""

    shared_bounds: SharedCoefficients

    def first(self, query: Query) -> OutputBounds:
        return self.shared_bounds.first(query.rows, query.offset)

    def others(self, images: ImageSets, query: Query, *, fresh: bool = False) -> OutputBounds:
        return self.shared_bounds.others(parametric(images), query.rows, query.offset, fresh=fresh)


def parametric(images: ImageSets) -> ImageSets:
    """Return the sets with at least one parameter; single poses get one that moves nothing."""
    if images.dimensions:
        return images
    still = np.zeros((*images.b_lower.shape, 1))
    return dataclasses.replace(images, a_lower=still, a_upper=still)
