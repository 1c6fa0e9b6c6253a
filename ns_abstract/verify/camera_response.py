"""Cameras with uncertain response: brightness, white balance and gamma of the whole picture (design.md, V14)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ns_abstract.arithmetic.rounding import RESPONSE_ROUNDING, RESPONSE_ROUNDINGS
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.tiles import assemble
from ns_abstract.refine.protocol import Bounds, Frame, LinearSets, Score
from ns_abstract.verify.picture_sets import flatter_where_better

ResponseName = Literal["brightness", "white balance", "gamma"]


@dataclass(frozen=True)
class CameraResponse:
    """A set of camera responses around the nominal one, whose factor or power is within ``radius`` < 1 of 1.

    "brightness": one factor for all values; "white balance": one factor by channel; "gamma": one power for all values.
    The result is clipped to [0, 1].
    """

    name: ResponseName
    radius: float

    def applied(self, picture: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the float32 picture [..., 3] of a camera with factors or powers ``values`` [3] by channel."""
        clipped = np.clip(np.asarray(picture, np.float64), 0.0, 1.0)
        applied = clipped**values if self.name == "gamma" else clipped * values
        return np.clip(applied, 0.0, 1.0).astype(np.float32)

    def scene_samples(self, frame: Frame, seed: int) -> Iterator[ResponseSample]:
        """Yield camera responses of the set without end, the extreme ones first."""
        rng, count = np.random.default_rng(seed), 3 if self.name == "white balance" else 1
        for signs in itertools.product((-1.0, 1.0), repeat=count):
            yield ResponseSample(frame, self, np.broadcast_to(1.0 + self.radius * np.array(signs), 3))
        while True:
            away = rng.uniform(-1.0, 1.0, count)
            yield ResponseSample(frame, self, np.broadcast_to(1.0 + self.radius * away, 3))

    def applied_to_sets(
        self, linear: LinearSets, lower: np.ndarray, upper: np.ndarray
    ) -> tuple[LinearSets, np.ndarray, np.ndarray]:
        """Return sets that contain the pictures of every camera for pictures in ``linear``, ``lower``, ``upper`` (V14).

        All are float32, rounded outward: A_lower [..., d], b_lower [...], A_upper, b_upper; lower, upper [...].
        """
        low, high = (np.clip(np.asarray(bound, np.float64), 0.0, 1.0) for bound in (lower, upper))
        r = self.radius
        if self.name == "gamma":
            least, most = low ** (1.0 + r), high ** (1.0 - r)
            # both differences are concave, with their largest values at these places
            dark = np.clip((1.0 + r) ** (-1.0 / r), low, high) if r else low
            light = np.clip((1.0 - r) ** (1.0 / r), low, high) if r else low
            fall, rise, shrink, grow = dark - dark ** (1.0 + r), light ** (1.0 - r) - light, 1.0, 1.0
        else:
            least, most = low * (1.0 - r), np.minimum(high * (1.0 + r), 1.0)
            fall, rise, shrink, grow = 0.0, 0.0, 1.0 - r, 1.0 + r
        least, most = least * (1.0 - RESPONSE_ROUNDING), np.minimum(most * (1.0 + RESPONSE_ROUNDING), 1.0)
        # what crosses is no number afterwards, so that it is noticed
        least = np.where(lower <= upper, least, np.nan)
        a_lower, b_lower, a_upper, b_upper = (np.asarray(part, np.float64) for part in linear)
        a_below, a_above = (a_lower * shrink).astype(np.float32), (a_upper * grow).astype(np.float32)
        # slopes rounded to float32, and the relative error of values up to 1
        slack = np.abs(a_below - a_lower * shrink).sum(axis=-1) + RESPONSE_ROUNDINGS
        below = b_lower * shrink - fall - slack
        slack = np.abs(a_above - a_upper * grow).sum(axis=-1) + RESPONSE_ROUNDINGS
        above = b_upper * grow + rise + slack
        return flatter_where_better((a_below, a_above), (below, above), least, most)


def response_sets(
    bounds: Bounds, camera: PinholeCamera, response: CameraResponse | None
) -> tuple[LinearSets, np.ndarray, np.ndarray]:
    """Return linear sets, lower and upper bounds [H, W, 3] of whole pictures under every camera response."""
    assert bounds.linear is not None
    whole = [assemble(part, camera) for part in (*bounds.linear, bounds.lower, bounds.upper)]
    sets = (whole[0], whole[1], whole[2], whole[3]), whole[4], whole[5]
    return sets if response is None else response.applied_to_sets(*sets)


@dataclass(frozen=True)
class ResponseSample:
    """One camera response of a set, factors or powers [3] by channel; see `ns_abstract.refine.protocol.SceneSample`."""

    frame: Frame
    response: CameraResponse
    values: np.ndarray

    def __call__(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        return self.response.applied(self.frame.render(values, tiles), self.values)

    def signed_gradient_step(
        self, box: ParameterBox, values: np.ndarray, score: Score, size: float
    ) -> tuple[np.ndarray, ResponseSample]:
        """Return the pose and the other extreme response; there are few responses, and no slopes."""
        return values, ResponseSample(self.frame, self.response, 2.0 - self.values)

    @property
    def nearest(self) -> ResponseSample:
        """Return the first of the extreme responses."""
        return next(self.response.scene_samples(self.frame, 0))

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Return factors or powers by channel."""
        return {"response": np.array(self.values)}
