"""Parts and poses of a set, as the Python interface takes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import is_number, show


def sub_box(whole: ParameterBox, given: Any) -> ParameterBox:
    """The part of a set that ``given`` names: a box, or ranges (low, high) by name; None: the whole set.

    Raises:
        InputError: It names other parameters, or reaches out of the set.
    """
    if given is None:
        return whole
    if isinstance(given, ParameterBox):
        given = dict(zip(given.names, zip(given.lower, given.upper, strict=True), strict=True))
    if not isinstance(given, Mapping):
        raise InputError(f"found {show(given)}", field="box", fix='give ranges by name, such as {"x": (0.0, 0.01)}')
    box = whole
    for name, ends in given.items():
        if name not in whole.names:
            raise InputError(f"found {show(name)}", field="box", fix=f"the parameters are {', '.join(whole.names)}")
        axis = whole.names.index(name)
        low, high = whole.lower[axis], whole.upper[axis]
        pair = [float(end) if isinstance(end, np.number) else end for end in ends] if isinstance(ends, Sequence) else []
        if len(pair) != 2 or not all(map(is_number, pair)) or not low <= pair[0] <= pair[1] <= high:
            raise InputError(
                f"found {show(ends)}", field=f"box.{name}", fix=f"give (low, high) within {low:g} and {high:g}"
            )
        box = box.replace(axis, float(pair[0]), float(pair[1]))
    return box


def point_of(whole: ParameterBox, values: Any) -> NDArray[np.float64]:
    """Values [d] of a pose of the set, from numbers in the order of the parameters or by name.

    Raises:
        InputError: They are none, or outside of the set.
    """
    if isinstance(values, Mapping) and set(values) == set(whole.names):
        values = [values[name] for name in whole.names]
    try:
        point = np.asarray(values, np.float64).reshape(-1)
    except (TypeError, ValueError):
        point = np.full(whole.dimensions, np.nan)
    if point.shape != (whole.dimensions,) or not whole.contains(point):
        ends = zip(whole.names, whole.lower, whole.upper, strict=True)
        sides = ", ".join(f"{name} from {low:g} to {high:g}" for name, low, high in ends)
        raise InputError("no pose of the set", field="p", fix=f"give {sides}" if sides else "give no numbers")
    return point
