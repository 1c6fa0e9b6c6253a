"""Where a camera went that took a sequence of photos: what is left of one photo's set, grown, is the next one's set."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.api.files import PathJob
from ns_abstract.api.job import check_frames
from ns_abstract.api.location import LocateSettings, Location, open_location
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.io.folder import claim
from ns_abstract.io.jsonio import load_json, show
from ns_abstract.io.photos import photo_size, read_mask, read_photo, sequence_photos
from ns_abstract.io.stamps import file_stamp
from ns_abstract.perturbation.specification import ROTATIONS, TRANSLATIONS, load_perturbation
from ns_abstract.report.run import plain

Range = tuple[float, float]
_REPORT = "report.json"
#: Of how one photo's sets follow from another's: results of different rules are not continued.
_RULES = 3


def load_motion(file: Path, sets: Mapping[int, PoseBox], dataset_scale: float | None) -> dict[str, Range]:
    """Return the ranges, by parameter, of the change from one photo to the next.

    Raises:
        InputError: The file states what is no motion, or one that a set has no parameter for.
    """
    motion = load_perturbation(file, dataset_scale=dataset_scale)
    others = {
        "sweep": motion.sweep != "keyframes", "orbit": motion.orbit is not None, "scene": bool(motion.scene),
        "hue": motion.hue is not None, "saturation": motion.saturation is not None,
    }  # fmt: skip
    for name, present in others.items():
        if present:
            raise InputError("is no motion", file=file, field=name, fix="state translation and rotation alone")
    ranges = {name: ends for name, ends in {**motion.translation, **motion.rotation}.items() if ends != (0.0, 0.0)}
    if _along_path(sets) and len({poses.perturbation.frame for poses in sets.values()}) > 1:
        fix = "give all entries of the path the same frame"
        raise InputError("sets of camera and world axes follow each other", field="perturbation.frame", fix=fix)
    for poses in sets.values():
        if set(ranges) & set(TRANSLATIONS) and poses.perturbation.frame != motion.frame:
            fix = f'write "frame": "{poses.perturbation.frame}", as the set has'
            raise InputError(f"found {motion.frame}", file=file, field="frame", fix=fix)
        if missing := [name for name in ranges if name not in poses.box.names]:
            fix = "give the first photo's set a range of it, or remove it here"
            raise InputError("does not vary in the set", file=file, field=missing[0], fix=fix)
    return ranges


def grown(poses: PoseBox, hull: Mapping[str, Range], motion: Mapping[str, Range]) -> PoseBox:
    """Return all poses that a motion takes poses of ``hull`` to (U7).

    Args:
        motion: Ends of the changes; none where a translation or a rotation is not named. Other parameters, which no
            motion names, keep the whole range of ``poses``.
    """
    box = poses.box
    for axis, name in enumerate(box.names):
        if name in (*TRANSLATIONS, *ROTATIONS):
            low, high = motion.get(name, (0.0, 0.0))
            ends = np.nextafter(hull[name][0] + low, -np.inf), np.nextafter(hull[name][1] + high, np.inf)
            box = box.replace(axis, float(ends[0]), float(ends[1]))
    return poses.within(box)


def _along_path(sets: Mapping[int, PoseBox]) -> bool:
    """Whether any set has the parameter `segment`: sets are then segments of one path, and a camera may change sets."""
    return any("segment" in poses.box.names for poses in sets.values())


def following(
    sets: Mapping[int, PoseBox], frames: Sequence[Mapping[str, Any]], motion: Mapping[str, Range]
) -> dict[int, PoseBox]:
    """Return, by number, the sets that the next photo may come from: none where no pose is left (U7).

    Args:
        sets: Those that photos may come from, as they are given.
        frames: What reports of one photo say of each: ``index``, ``parameters`` and ``hull``.
        motion: As for `grown`.
    """
    hulls: dict[int, dict[str, Range]] = {}
    for frame in frames:
        if frame["hull"] is not None:
            names = [entry["name"] for entry in frame["parameters"]]
            ends = zip(frame["hull"]["lower"], frame["hull"]["upper"], strict=True)
            # what is fixed in one set may vary in the next
            still = {name: (value, value) for name, value in sets[frame["index"]].fixed.items()}
            hulls[frame["index"]] = still | dict(zip(names, ends, strict=True))
    if hulls and _along_path(sets):
        apart = [[hull[name] for hull in hulls.values()] for name in (*TRANSLATIONS, *ROTATIONS)]
        ends = [(min(low for low, _ in ranges), max(high for _, high in ranges)) for ranges in apart]
        joined: dict[str, Range] = dict(zip((*TRANSLATIONS, *ROTATIONS), ends, strict=True))
        hulls = dict.fromkeys(sets, joined)
    return {number: grown(sets[number], hull, motion) for number, hull in hulls.items()}


def _check_sizes(images: Sequence[Path]) -> None:
    """Refuse, before hours go into those before it, a photo that cannot be used."""
    field = "--image-sequence"
    height, width = photo_size(images[0], field)
    for image in images[1:]:
        if (size := photo_size(image, field)) != (height, width):
            problem = f"has {size[1]} x {size[0]} pixels, {show(images[0].name)} {width} x {height}"
            raise InputError(problem, file=image, field=field, fix=f"resize it to {width} x {height}")


def _seal(entry: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the stored bounds of a photo; a report that was edited is not continued."""
    sealed = {name: value for name, value in entry.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(plain(sealed), sort_keys=True).encode()).hexdigest()


@dataclass
class PhotoSequence:
    """A sequence of photos that is followed, and its report.

    Args:
        settings: What is located; the photo is the first one.
        motion: File of the motion between two of them.
        folder: For the results: a folder by photo, and report.json.
        frames: Numbers of the sets that the first photo may come from.
        resume: Whether to go on with what ``folder`` holds.

    Raises:
        InputError: A file or a field cannot be used, or the folder holds another sequence.
    """

    settings: LocateSettings
    images: list[Path]
    motion: Path
    folder: Path
    frames: tuple[int, ...] | None = None
    resume: bool = False

    def __post_init__(self) -> None:
        self.first = open_location(self.settings)
        job = self.first.job
        assert isinstance(job, PathJob)
        self.job = job
        _check_sizes(self.images)
        self.sets = {k: job.pose_sets[k] for k in check_frames(self.frames, job.frame_count)}
        # the sets that later photos may come from: a camera on a swept path goes on to its other segments
        self.reached = dict(enumerate(job.pose_sets)) if _along_path(self.sets) else self.sets
        self.ranges = load_motion(self.motion, self.reached, job.method.dataset_scale)
        text = json.dumps([_RULES, self.first.fingerprint, self.ranges, sorted(self.sets)], sort_keys=True)
        self.fingerprint = hashlib.sha256(text.encode()).hexdigest()
        self.entries: list[dict[str, Any]] = self._stored() if self.resume else []

    def _stored(self) -> list[dict[str, Any]]:
        """Return entries of the photos that an earlier command has finished, if its inputs were the same."""
        file = self.folder / _REPORT
        if not file.is_file():
            return []
        document = load_json(file, "report of a sequence")
        if not isinstance(document, dict) or document.get("fingerprint") != self.fingerprint:
            raise InputError(
                "is of other inputs", file=file, field="--resume", fix="give the same ones, or another --output-dir"
            )
        stored = document.get("images")
        if not isinstance(stored, list) or not all(isinstance(e, dict) and e.get("sha256") == _seal(e) for e in stored):
            fix = "run without --resume to search again"
            raise InputError("its images were changed since it was written", file=file, field="--resume", fix=fix)
        entries = [entry for entry in stored if entry["state"] != "interrupted"]
        for entry, image in itertools.zip_longest(entries, self.images[: len(entries)]):
            if image is None or entry["image"] != file_stamp(image):
                problem = f"{entry['image']['name']} {'is missing' if image is None else 'was another photo then'}"
                raise InputError(problem, file=image or file, field="--resume", fix="give the same photos")
        return entries

    def follow(self, search: Callable[[Location, tuple[int, ...], Path], dict[str, Any]]) -> dict[str, Any]:
        """Locate one photo after the other until one is excluded everywhere; returns the content of report.json.

        Args:
            search: Locates a photo in sets of some numbers, into a folder; returns its report.

        Raises:
            InputError: Another command works in the folder, it holds files of others, or a photo cannot be read.
        """
        with claim(self.folder):
            if not self.entries:
                # it would speak of photos whose folders are written anew
                (self.folder / _REPORT).unlink(missing_ok=True)
            return self._followed(search)

    def _followed(self, search: Callable[[Location, tuple[int, ...], Path], dict[str, Any]]) -> dict[str, Any]:
        for k in range(len(self.entries), len(self.images)):
            alive = self._sets(k)
            if not alive:
                break
            folder = f"{k:05d}_{self.images[k].stem}"
            stamp, location = file_stamp(self.images[k]), self._location(k, alive)
            if file_stamp(self.images[k]) != stamp:
                fix = "give a copy that nothing writes to"
                raise InputError("was replaced meanwhile", file=self.images[k], fix=fix)
            document = search(location, tuple(alive), self.folder / folder)
            reported = ("answer", "possible_volume", "hull", "best", "seconds", "state", "frames")
            self.entries.append({"image": stamp, "folder": folder, **{name: document[name] for name in reported}})
            if document["state"] == "interrupted":
                break
            self._write("running")
        return self._write("interrupted" if self.entries[-1]["state"] == "interrupted" else "done")

    def _sets(self, k: int) -> dict[int, PoseBox]:
        """Return the pose sets, by number, searched for photo ``k``: those given, or what photo k - 1 leaves."""
        if k == 0:
            return self.sets
        return following(self.reached, self.entries[k - 1]["frames"], self.ranges)

    def _location(self, k: int, alive: Mapping[int, PoseBox]) -> Location:
        image, first = self.images[k], self.first
        levels = read_photo(image)
        mask = None if self.settings.mask is None else read_mask(self.settings.mask, levels.shape[:2])
        # sets keep their numbers, of the path's entries
        poses = tuple(alive.get(number, poses) for number, poses in enumerate(self.job.pose_sets))
        job = PathJob(self.job.settings, self.job.scene, self.job.path, poses)
        return Location(job, levels, mask, first.options, image, first.calibration)

    def _write(self, state: str) -> dict[str, Any]:
        """Bring report.json up to date; ``state``: "running", "done" or "interrupted"."""
        entries = self.entries
        left = len(self.images) - len(entries)
        document = plain(
            {
                "version": 1,
                "kind": "sequence",
                "answer": "none" if any(entry["answer"] == "none" for entry in entries) else entries[-1]["answer"],
                "motion": self.ranges,
                "images": [entry | {"sha256": _seal(entry)} for entry in entries],
                "not_examined": left,
                "state": state,
                "fingerprint": self.fingerprint,
            }
        )
        write_json(self.folder / _REPORT, document)
        return document


def open_sequence(
    settings: LocateSettings, images: Path, motion: Path, folder: Path, frames: tuple[int, ...] | None, resume: bool
) -> PhotoSequence:
    """Open the photos of a folder, in the order of their names; arguments and errors as for `PhotoSequence`."""
    photos = sequence_photos(images)
    return PhotoSequence(replace(settings, image=photos[0]), photos, motion, folder, frames, resume)
