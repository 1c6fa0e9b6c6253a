"""Parts of the pixels become numbers of pixels, and no rounding takes one away or adds one."""

import math

import numpy as np
import pytest

from ns_abstract.check.statements import Measured, parse_statement
from ns_abstract.verify.photo import Photo
from ns_abstract.verify.picture_measures import Region
from ns_abstract.verify.picture_properties import Leaf
from ns_abstract.verify.pixel_parts import fewest_reaching, most_within


@pytest.mark.parametrize("count", [1, 22, 25, 100, 307])
def test_numbers_of_pixels_are_the_nearest_to_their_part(count: int) -> None:
    lost = 0
    for k in range(1, count + 1):
        part = k / count
        assert most_within(part, count) == fewest_reaching(part, count) == k
        lost += math.floor(part * count) != k or math.ceil(part * count) != k
    # products are rounded to the wrong side of some
    assert lost > 0 or count == 1
    for part in np.random.default_rng(0).uniform(1e-3, 1.0, 200).tolist():
        assert most_within(part, count) == max(k for k in range(count + 1) if k / count <= part)
        assert fewest_reaching(part, count) == min(k for k in range(count + 1) if k / count >= part)


def test_photos_may_miss_as_many_pixels_as_is_said() -> None:
    """29 of 100 pixels are outliers, and 0.29 may be."""
    photo = Photo(np.zeros((10, 10, 3), np.uint8), 0.0, 0.29, np.ones((10, 10), bool))
    assert photo.allowed == 29


def test_no_more_pixels_are_asked_for_than_is_said() -> None:
    """Seven of 100 pixels have the weight, and 0.07 of them are asked for; the audit counts them by itself."""
    root = {"type": "visible", "select": {"box": [[0, 0, 0], [1, 1, 1]]}, "weight": 0.5}
    for part, number in ((0.07, 7), (0.55, 55), (1.0, 100), (0.001, 1), (0.0701, 8)):
        leaf = Leaf("", "depth", "rank", Region(), pixels=part)
        audited = parse_statement({**root, "fraction": part}, (10, 10), 1.0)
        assert isinstance(audited, Measured)
        assert leaf.measure(10, 10).rank == audited.rank == number
