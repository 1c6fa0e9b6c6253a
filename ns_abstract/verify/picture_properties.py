"""Properties of the picture itself, without a network: ``visible``, ``clear``, ``picture``, ``all`` and ``any``.

A property is a tree whose leaves state that a measure of the picture lies within limits; its margin is the least or the
greatest of theirs (docs/dev/design.md, Q4).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import OWN_MARGIN
from ns_abstract.arithmetic.rounding import SUB_BOX_OVERLAP
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.io.fields import fail, known
from ns_abstract.io.jsonio import MODERATE, file_beside, is_number, show, unusable
from ns_abstract.io.photos import read_grey_mask
from ns_abstract.perturbation.specification import unit_length
from ns_abstract.perturbation.variations import parse_selection
from ns_abstract.refine.protocol import COLORS, WeightPlane
from ns_abstract.verify.network import ImageSets, OutputBounds
from ns_abstract.verify.picture_measures import (
    CHANNELS,
    CellParts,
    Measure,
    Plane,
    PlaneSets,
    Region,
    SubBoxEnds,
    planes_of,
    shared_counts,
)
from ns_abstract.verify.pixel_parts import fewest_reaching
from ns_abstract.verify.preprocess import parse_preprocess
from ns_abstract.verify.properties import Claim, Property, Query
from ns_abstract.verify.property_reading import parse_partitions
from ns_abstract.verify.settled_pixels import LimitedMeasure

STATISTICS = ("mean", "least", "greatest")
#: The depth of a pixel on which nothing is drawn, and the greatest that is told apart, normalised units: beyond twice
#: any distance (`MODERATE`).
FARTHEST = 2.0**52
#: What reports say of distances.
_DISTANCES = "distances: depth of the centres of Gaussians along the optical axis; of a NeRF's samples along their rays"
#: Preferences: most parts of a cell, and most numbers (parts times pixels) at once.
_PARTS, _NUMBERS = 32, 1 << 21
#: Most leaves of a property, and how deep it may be.
_MOST_LEAVES, _DEEPEST = 64, 8


@dataclass(frozen=True)
class Leaf:
    """The statement that a measure lies above ``low`` and below ``high``.

    Attributes:
        sentence: In words, as the end of "on every image ...".
        plane, statistic, region, minus: See `Measure`.
        channels: Weights of the plane's channels.
        pixels: For the statistic "rank": takes the pixels-th largest pixel; a number, or a fraction of the region.
    """

    sentence: str
    plane: Plane
    statistic: str
    region: Region
    minus: Region | None = None
    channels: tuple[float, ...] = (1.0,)
    pixels: int | float = 1
    low: float = -math.inf
    high: float = math.inf
    cap: float = math.inf

    def measure(self, height: int, width: int) -> Measure:
        """Return the measure for pictures of this size; InputError if a region does not fit or has too few pixels."""
        places = np.flatnonzero(self.region.pixels(height, width))
        minus = None if self.minus is None else np.flatnonzero(self.minus.pixels(height, width))
        rank: int | None = 1
        if self.statistic == "mean":
            rank = None
        elif self.statistic == "rank":
            rank = self.pixels if isinstance(self.pixels, int) else fewest_reaching(self.pixels, places.size)
            if not 1 <= rank <= places.size:
                raise InputError(
                    f"found {self.pixels}, {self.region} has {places.size} pixels", field="pixels", fix="ask for fewer"
                )
        return Measure(self.plane, self.channels, rank, places, self.statistic == "least", minus, self.cap)


@dataclass(frozen=True)
class Combined:
    """The statement that all or any of some statements hold."""

    all: bool
    parts: tuple[Statement, ...]


Statement = Leaf | Combined


def leaves(statement: Statement) -> Iterator[Leaf]:
    """Yield the leaves of a statement, in order."""
    if isinstance(statement, Leaf):
        yield statement
    else:
        for part in statement.parts:
            yield from leaves(part)


def _sentence(statement: Statement, inner: bool = False) -> str:
    if isinstance(statement, Leaf):
        return statement.sentence
    text = (" and " if statement.all else " or ").join(_sentence(part, True) for part in statement.parts)
    return f"({text})" if inner else text


def _joined(statement: Statement, margins: Iterator[Any], least: Callable[..., Any], most: Callable[..., Any]) -> Any:
    """Return a statement's margin from its leaves' margins, in order: ``least`` of them for all, ``most`` for any."""
    if isinstance(statement, Leaf):
        return next(margins)
    parts = [_joined(part, margins, least, most) for part in statement.parts]
    joined = parts[0]
    for part in parts[1:]:
        joined = (least if statement.all else most)(joined, part)
    return joined


@dataclass(frozen=True, eq=False)
class PictureClaim(Claim):
    """A statement about measures as a claim; its "outputs" are the leaves' values, in order."""

    statement: Statement
    limits: tuple[tuple[float, float], ...]

    def margin(self, outputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        margins = []
        for k, (low, high) in enumerate(self.limits):
            value = outputs[:, k]
            # a limit that is not there takes no part, also in slopes
            sides = [value - low] * math.isfinite(low) + [high - value] * math.isfinite(high)
            margins.append(sides[0] if len(sides) == 1 else torch.minimum(*sides))
        return _joined(self.statement, iter(margins), torch.minimum, torch.maximum)

    def query(self, outputs: np.ndarray) -> Query:
        unit = np.eye(len(self.limits))
        return Query(np.concatenate([unit, -unit]), np.zeros(2 * len(unit)))

    def proved(self, query: Query, bounds: OutputBounds, boxes: Sequence[ParameterBox]) -> np.ndarray:
        margins = [
            np.min([rise - low] * math.isfinite(low) + [fall + high] * math.isfinite(high), axis=0)
            for (rise, fall), (low, high) in zip(self._ends(bounds, boxes), self.limits, strict=True)
        ]
        lower = [margin - self._rounding(margin) for margin in margins]
        return _joined(self.statement, iter(lower), np.minimum, np.maximum).min(axis=1)

    def refuted(self, query: Query, bounds: OutputBounds, boxes: Sequence[ParameterBox]) -> np.ndarray:
        """Return upper bounds [m] of the margin over the cells ``boxes`` (docs/dev/design.md, Q8)."""
        # the value is at most -fall, and its negative at most -rise
        margins = [
            np.min([-fall - low] * math.isfinite(low) + [high - rise] * math.isfinite(high), axis=0)
            for (rise, fall), (low, high) in zip(self._ends(bounds, boxes), self.limits, strict=True)
        ]
        upper = [margin + self._rounding(margin) for margin in margins]
        return _joined(self.statement, iter(upper), np.minimum, np.maximum).max(axis=1)

    def _ends(self, bounds: OutputBounds, boxes: Sequence[ParameterBox]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield by leaf lower bounds [m, parts] of its value and of the negative, over parts of the cells."""
        lower = bounds.lower.reshape(len(boxes), -1, 2, len(self.limits))
        for k in range(len(self.limits)):
            # what is not known is as bad as can be, whatever it is combined with
            rise, fall = (np.where(np.isnan(side), -np.inf, side) for side in (lower[..., 0, k], lower[..., 1, k]))
            yield rise, fall

    @staticmethod
    def _rounding(margin: np.ndarray) -> np.ndarray:
        """Return an upper bound of the rounding of a margin's own sums."""
        return OWN_MARGIN * (1.0 + np.abs(np.where(np.isfinite(margin), margin, 0.0)))


@dataclass(frozen=True)
class PictureProperty(Property):
    """A statement about the picture, its depths or its blending weights."""

    statement: Statement

    def sentence(self) -> str:
        return _sentence(self.statement)

    @property
    def notes(self) -> tuple[str, ...]:
        near = any(leaf.plane == "depth" or _nearer(leaf.plane) for leaf in leaves(self.statement))
        return (_DISTANCES,) * near

    @property
    def planes(self) -> tuple[Plane, ...]:
        """The planes that the measures need, each once."""
        return tuple(dict.fromkeys(leaf.plane for leaf in leaves(self.statement)))

    def bind(self, pose_set: PoseBox, nominal: Callable[[], np.ndarray]) -> PictureClaim:
        return PictureClaim(self.statement, tuple((leaf.low, leaf.high) for leaf in leaves(self.statement)))

    def model(self, height: int, width: int) -> MeasureModel:
        """Return the measures as a model, in place of a network; pictures of this size have colours first."""
        others = [plane for plane in self.planes if plane != "colors"]
        measures = self.measures(height, width)
        places = [0 if m.plane == "colors" else COLORS + others.index(m.plane) for m in measures]
        return MeasureModel(measures, places, COLORS + len(others))

    def limited(self, height: int, width: int) -> tuple[LimitedMeasure, ...]:
        """Return the measures for pictures of this size with their limits, by leaf; InputError as `measures`."""
        model = self.model(height, width)
        by_leaf = zip(model.measures, model.places, leaves(self.statement), strict=True)
        return tuple(
            LimitedMeasure(measure, place, tuple(end for end in (leaf.low, leaf.high) if math.isfinite(end)))
            for measure, place, leaf in by_leaf
        )

    def measures(self, height: int, width: int) -> tuple[Measure, ...]:
        """Return the measures for pictures of this size, by leaf; InputError if a region does not fit."""
        return tuple(leaf.measure(height, width) for leaf in leaves(self.statement))


def _nearer(plane: Plane) -> bool:
    return isinstance(plane, WeightPlane) and plane.nearer is not None


class MeasureModel:
    """Measures of pictures, by leaf, in the place of a network (`ns_abstract.verify.protocol.Model`).

    ``places``: by leaf, the first channel of its plane, of the ``channels`` of the pictures.
    """

    def __init__(self, measures: Sequence[Measure], places: Sequence[int], channels: int) -> None:
        self.measures, self.places, self.channels = tuple(measures), tuple(places), channels

    def outputs(self, images: np.ndarray) -> np.ndarray:
        """Return values [B, leaves] of pictures [B, H, W, C]."""
        with torch.no_grad():
            return self.differentiable(torch.from_numpy(np.asarray(images, np.float64))).numpy()

    def differentiable(self, images: torch.Tensor) -> torch.Tensor:
        """Return values [B, leaves] of pictures [B, H, W, C]."""
        pairs = zip(self.measures, self.places, strict=True)
        return torch.stack([measure.value(images, first) for measure, first in pairs], dim=1)

    def input_sets(self, linear: tuple[np.ndarray, ...], lower: np.ndarray, upper: np.ndarray) -> ImageSets:
        """Return the sets with each picture's numbers flattened."""
        m, d = len(lower), linear[0].shape[-1]
        slopes, rest = (linear[0], linear[2]), (linear[1], linear[3], lower, upper)
        a_lower, a_upper = (np.asarray(part).reshape(m, lower[0].size, d) for part in slopes)
        b_lower, b_upper, low, high = (np.asarray(part).reshape(m, -1) for part in rest)
        return ImageSets(a_lower, b_lower, a_upper, b_upper, low, high)

    def bound(self, images: ImageSets, query: Query) -> OutputBounds:
        """Return lower bounds of values and of their negatives over parts of cells, as rows [parts, 2, leaves]."""
        rows = [
            self._over(planes, CellParts.equal(self._counts(planes, _PARTS)))
            for planes in planes_of(images, self.channels)
        ]
        # as many rows for every cell: cells of fewer parts repeat them
        most = max(len(row) for row in rows)
        lower = np.stack([np.resize(row, (most, *row.shape[1:])).ravel() for row in rows])
        return OutputBounds(lower, np.zeros((*lower.shape, 1)), lower)

    def part_counts(self, images: ImageSets, most_parts: int) -> np.ndarray:
        """Return numbers [d] of parts of one cell, up to ``most_parts`` together, more where its pictures vary."""
        (planes,) = planes_of(images, self.channels)
        return self._counts(planes, most_parts)

    def bound_parts(self, images: ImageSets, counts: np.ndarray, ends: SubBoxEnds | None = None) -> OutputBounds:
        """Return `bound` of equal parts of one cell, ``counts`` [d] along its parameters, each as a cell (Q8).

        Parts extend by `SUB_BOX_OVERLAP` of the cell's half-widths beyond their ends, as those of ``ends`` do.
        """
        assert ends is None or np.array_equal(ends.counts, counts)
        (planes,) = planes_of(images, self.channels)
        rows = self._over(replace(planes, ends=ends), CellParts.equal(counts, SUB_BOX_OVERLAP))
        lower = rows.reshape(len(rows), -1)
        return OutputBounds(lower, np.zeros((*lower.shape, 1)), lower)

    def _counts(self, planes: PlaneSets, most_parts: int) -> np.ndarray:
        """Return numbers [d] of parts of a cell, at most ``most_parts`` together, fewer where there are many pixels."""
        read = np.unique(np.concatenate([m.pixels for m in self.measures]))
        effects = np.abs(planes.linear[0][read].astype(np.float64)).sum(axis=(0, 1))
        return shared_counts(effects, max(1, min(most_parts, _NUMBERS // read.size)))

    def _over(self, planes: PlaneSets, parts: CellParts) -> np.ndarray:
        """Return lower bounds [parts, 2, leaves] of values and of their negatives."""
        ends = [m.bounds(planes, first, parts) for m, first in zip(self.measures, self.places, strict=True)]
        low, high = (np.stack(side, axis=1) for side in zip(*ends, strict=True))
        return np.stack([low, -high], axis=1)

    def branch(self, images: ImageSets, query: Query, groups: Sequence[Sequence[int]], most_branches: int) -> float:
        """Return no bound: a measure has no activations to branch on."""
        return -math.inf


# ---------------------------------------------------------------- the file

#: Keys beside those of a statement, at the top of the file.
COMMON = ("preprocess", "partitions")
#: Keys of every leaf.
_PLACE = ("region", "mask")


class _PropertyObject(NamedTuple):
    """An object of the file, with its place for error messages, and the folder of the files that it names."""

    root: dict[str, Any]
    prefix: str
    folder: Path
    dataset_scale: float | None

    def number(self, key: str, low: float, high: float, otherwise: float | None = None) -> float:
        """Return the number under a key, in [low, high]; ``otherwise`` if it is absent."""
        value = self.root.get(key, otherwise)
        if value is None:
            raise fail(f"{self.prefix}{key}", "missing", f"write a number from {low:g} to {high:g}")
        if not (is_number(value) and low <= value <= high):
            raise unusable(value, field=f"{self.prefix}{key}", fix=f"write a number from {low:g} to {high:g}")
        return float(value)

    def choice(self, key: str, values: Sequence[str]) -> str:
        """Return the name under a key, one of ``values``; the first if it is absent."""
        value = self.root.get(key, values[0])
        if value not in values or not isinstance(value, str):
            raise unusable(value, field=f"{self.prefix}{key}", fix=f"write one of {', '.join(values)}")
        return value

    def region(self, key: str = "region") -> Region:
        """Return the box under a key, or the mask beside the key region; the whole picture if both are absent."""
        name = f"{self.prefix}{key}"
        box, mask = self.root.get(key), self.root.get("mask") if key == "region" else None
        if box is not None and mask is not None:
            raise fail(f"{self.prefix}mask", "given together with region", "write one of them")
        if mask is not None:
            if not isinstance(mask, str) or not mask:
                raise unusable(mask, field=f"{self.prefix}mask", fix="write the name of a .png, relative to this file")
            name = f"{self.prefix}mask"
            file = file_beside(self.folder, mask, name)
            return Region(mask=file, name=name, white=read_grey_mask(file))
        if box is None or box == "all":
            return Region(name=name)
        if not (isinstance(box, list) and len(box) == 4 and all(type(v) is int and 0 <= v < 1 << 20 for v in box)):
            raise unusable(box, field=name, fix='write pixels [x0, y0, x1, y1], whole numbers of at least 0, or "all"')
        x0, y0, x1, y1 = box
        if not (x0 < x1 and y0 < y1):
            raise unusable(box, field=name, fix="write [x0, y0, x1, y1] with x0 < x1 and y0 < y1")
        return Region(box=(x0, y0, x1, y1), name=name)


def _below(number: float) -> float:
    """Return the float before ``number``: everything above it is ``number`` or more."""
    return float(np.nextafter(number, -np.inf))


def _visible(source: _PropertyObject) -> Leaf:
    root, prefix = source.root, source.prefix
    if "select" not in root:
        raise fail(f"{prefix}select", "missing", 'write {"box": [[x0, y0, z0], [x1, y1, z1]]}')
    select = parse_selection(root["select"], f"{prefix}select", fail, source.folder)
    weight, region = source.number("weight", MODERATE[0], 1.0, 0.5), source.region()
    if "pixels" in root and "fraction" in root:
        raise fail(f"{prefix}fraction", "given together with pixels", "write one of them")
    pixels: int | float = 1
    if "fraction" in root:
        pixels = source.number("fraction", 0.0, 1.0)
        if pixels == 0.0:
            raise unusable(root["fraction"], field=f"{prefix}fraction", fix="write a number above 0")
        count = f"{pixels:.4g} of the pixels"
    else:
        pixels = root.get("pixels", 1)
        if type(pixels) is not int or not 1 <= pixels < 1 << 40:
            raise unusable(pixels, field=f"{prefix}pixels", fix="write a whole number of at least 1")
        count = f"{pixels} {'pixel' if pixels == 1 else 'pixels'}"
    sentence = f"at least {count} of {region} get a weight of at least {weight:g} from what is selected"
    return Leaf(sentence, WeightPlane(select), "rank", region, pixels=pixels, low=_below(weight))


def _clear(source: _PropertyObject) -> Leaf:
    root, prefix = source.root, source.prefix
    distance_given = source.number("distance", *MODERATE)
    units = source.choice("units", ("normalised", "dataset"))
    scale = unit_length(units, source.dataset_scale, lambda name, problem, fix: fail(f"{prefix}{name}", problem, fix))
    unit = "units of the data set" if scale != 1.0 else "normalised units"
    distance, region = distance_given * scale, source.region()
    if not MODERATE[0] <= distance <= MODERATE[1]:
        limits = f"{MODERATE[0]:g} to {MODERATE[1]:g}"
        raise fail(f"{prefix}distance", f"is {distance:g} normalised units", f"write one of {limits} normalised units")
    if source.choice("measure", ("weight", "expected")) == "expected":
        if "weight" in root:
            raise fail(f"{prefix}weight", "given with the expected depth", "remove it, or measure")
        sentence = f"the expected depth is above {distance_given:g} {unit} everywhere in {region}"
        # twice as far is as good as any
        return Leaf(sentence, "depth", "least", region, low=distance, cap=2.0 * distance)
    weight = source.number("weight", MODERATE[0], 1.0, 0.5)
    sentence = f"no ray of {region} has collected a weight of {weight:g} nearer than {distance_given:g} {unit}"
    return Leaf(sentence, WeightPlane(nearer=distance), "greatest", region, high=weight)


def _picture(source: _PropertyObject) -> Leaf:
    root, prefix = source.root, source.prefix
    statistic, channel = source.choice("statistic", STATISTICS), source.choice("channel", tuple(CHANNELS))
    region, minus = source.region(), source.region("minus") if "minus" in root else None
    if "min" not in root and "max" not in root:
        raise fail(f"{prefix}min", "missing", "write min, max or both")
    low = source.number("min", -1.0, 1.0) if "min" in root else -math.inf
    high = source.number("max", -1.0, 1.0) if "max" in root else math.inf
    if low > high:
        raise fail(f"{prefix}min", f"{low:g} is above max {high:g}", "write the smaller limit under min")
    what = f"the {statistic} {channel} of {region}"
    if minus is not None:
        what += f" less that of {minus}"
    limits = [f"at least {low:g}"] * math.isfinite(low) + [f"at most {high:g}"] * math.isfinite(high)
    return Leaf(
        f"{what} is {' and '.join(limits)}", "colors", statistic, region, minus, CHANNELS[channel],
        low=_below(low) if math.isfinite(low) else low, high=-_below(-high) if math.isfinite(high) else high,
    )  # fmt: skip


class _StatementType(NamedTuple):
    """The keys of a type of statement, and its parser."""

    keys: tuple[str, ...]
    parse: Callable[[_PropertyObject], Leaf]


PICTURE_TYPES = {
    "visible": _StatementType(("type", "select", "weight", "pixels", "fraction", *_PLACE), _visible),
    "clear": _StatementType(("type", "distance", "units", "weight", "measure", *_PLACE), _clear),
    "picture": _StatementType(("type", "statistic", "channel", "min", "max", "minus", *_PLACE), _picture),
}


def is_of_picture(root: Any) -> bool:
    """Return whether a parsed PROP.json states a property of the picture, which needs no network."""
    return isinstance(root, dict) and ("all" in root or "any" in root or root.get("type") in tuple(PICTURE_TYPES))


def parse_picture_property(root: dict[str, Any], folder: Path, dataset_scale: float | None = 1.0) -> PictureProperty:
    """Return the property of the picture that a parsed PROP.json states; files that it names lie in ``folder``.

    ``dataset_scale``: normalised units per unit of the data set; None: not known.
    """
    value = root.get("preprocess", {})
    if isinstance(value, dict):
        known(value, ("resize",), "preprocess.", fail)
    common: dict[str, Any] = {"preprocess": parse_preprocess(value), "partitions": parse_partitions(root)}
    statement = parse_statement(root, folder, dataset_scale, COMMON)
    if sum(1 for _ in leaves(statement)) > _MOST_LEAVES:
        raise fail("type", f"more than {_MOST_LEAVES} statements", "split the file")
    return PictureProperty(statement, **common)


def parse_statement(
    root: Any, folder: Path, dataset_scale: float | None, common: tuple[str, ...] = (), prefix: str = "", depth: int = 0
) -> Statement:
    """Return the statement of a JSON object at ``prefix``; ``common`` are keys that are allowed beside it."""
    if not isinstance(root, dict):
        raise unusable(root, field=prefix.rstrip(".") or "type", fix='write an object {"type": ...}')
    kinds = [name for name in ("all", "any") if name in root]
    if kinds:
        known(root, (*kinds[:1], *common), prefix, fail)
        parts, name = root[kinds[0]], f"{prefix}{kinds[0]}"
        if not isinstance(parts, list) or not parts or depth >= _DEEPEST:
            raise unusable(parts, field=name, fix=f"write a list of properties, nested at most {_DEEPEST} times")
        inner = [
            parse_statement(part, folder, dataset_scale, (), f"{name}[{k}].", depth + 1) for k, part in enumerate(parts)
        ]
        return Combined(kinds[0] == "all", tuple(inner))
    kind = root.get("type")
    if not isinstance(kind, str) or kind not in PICTURE_TYPES:
        raise fail(
            f"{prefix}type", "missing" if kind is None else f"found {show(kind)}",
            f"write one of {', '.join(PICTURE_TYPES)}",
        )  # fmt: skip
    known(root, (*PICTURE_TYPES[kind].keys, *common), prefix, fail)
    return PICTURE_TYPES[kind].parse(_PropertyObject(root, prefix, folder, dataset_scale))
