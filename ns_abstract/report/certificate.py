"""Content of ``report.json`` of ``ns-abstract-certify``."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ns_abstract.io.atomic import write_text
from ns_abstract.io.folder import unwritable
from ns_abstract.report.run import CommandRun, plain

#: What the key ``scene_margin`` of report.json tells.
SCENE_MARGIN = (
    "by what varies, of every Gaussian by itself, (brightness, white_balance, gamma) of the camera "
    "or (registration, turn) of the scene as a whole: radius of the largest "
    "variation for which every certified cell is certified again; not_certified: the smallest radius that was "
    "tried in vain, and why; falsified: the smallest for which a scene, stored under counterexamples/, breaks "
    "what is certified; reached: radius at which the part of the certified volume holds that was looked at before "
    "the time ended"
)

METRICS = {
    "certified": "part of the parameter volume where the property is proved for every image",
    "falsified": "part in cells with a pose, stored and rendered again, whose image breaks the property",
    "unknown": "the rest: neither proved nor broken on the finest cells, or not examined before the end",
    "not_examined": "part of unknown whose cells were still to be examined",
    "sampled_right": "part of evenly spread poses at whose images the property holds; says nothing about others",
    "margin": "how far the property is from failing, in the unit of what is measured (a network's output, blending "
    "weight, distance, colour); proved from below in certified cells",
    "scene_margin": SCENE_MARGIN,
    "cameras": "where the camera of a cell's middle pose stands and where it looks, a unit vector, in the normalised "
    "frame, for the cells that are the largest parts of their sets; left_out: number of the others",
    "cells_seal": "rows of cells that have a verdict, and the sum of their SHA-256: --resume refuses other rows",
    "PCP-S": "parts of the fixed partition where the property holds at every sample, or is proved",
    "undecided": "parts of the fixed partition with a sample that neither holds nor breaks the property: its margin is "
    "no finite number; not in PCP-S",
    "PCP-V": "parts of the fixed partition that are certified as a whole",
}


def coverage(frames: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return mean fractions of the frames' sets: certified, falsified, unknown (unexamined too), not_examined."""
    names = ("certified", "falsified", "unknown", "not_examined")
    return {name: sum(entry["coverage"][name] for entry in frames) / max(1, len(frames)) for name in names}


def verdict(frames: Sequence[Mapping[str, Any]]) -> str:
    """Return the verdict on all sets together: falsified if any pose is, certified if all cells are, else unknown."""
    if any(entry["cells"]["falsified"] for entry in frames):
        return "falsified"
    # the parts are quotients of whole numbers: nothing open is exactly 0
    done = frames and all(e["coverage"]["unknown"] == 0.0 and e["cells"]["certified"] for e in frames)
    return "certified" if done else "unknown"


def search_figures(store: Any) -> dict[str, Any]:
    """Return report.json's figures of a search: progress over time, totals, reasons for unknown, the cells' seal."""
    return {
        "trace": store.points,
        "seconds": store.seconds,
        "effort": store.effort,
        "unknown_because": store.reasons,
        "cells_seal": {"rows": store.seal.rows, "sum": store.seal.text},
    }


def certificate_document(
    run: CommandRun,
    claim: Mapping[str, Any],
    frames: Sequence[Mapping[str, Any]],
    figures: Mapping[str, Any],
    *,
    state: str,
    scene_margin: Mapping[str, Any],
    cameras: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of report.json.

    Args:
        run: The command's run.
        claim: The property and the network: keys of report.json.
        frames: By frame, a mapping of index, parameters, coverage, cells, sampled, partition, least_margin,
            counterexamples.
        figures: See `search_figures`.
        state: "running", "done", "budget" or "interrupted".
        scene_margin: Largest variations of the scene for which certified cells stay certified.
        cameras: Positions of the cells' cameras.
    """
    covered = coverage(frames)
    poses = sum(entry["sampled"]["poses"] for entry in frames)
    right = sum(entry["sampled"]["right"] for entry in frames)
    parts = [entry["partition"] for entry in frames if entry["partition"] is not None]
    total = sum(part["partitions"] for part in parts)
    return plain(
        run.head()
        | {
            "verdict": verdict(frames),
            **claim,
            "coverage": covered,
            "sampled": {"poses": poses, "right": right, "sampled_right": right / poses if poses else None},
            "certified_of_sampled_right": covered["certified"] * poses / right if right else None,
            "partitions": {
                "partitions": total,
                "PCP-S": sum(part["right"] for part in parts) / total,
                "PCP-V": sum(part["certified"] for part in parts) / total,
                "undecided": sum(part["undecided"] for part in parts) / total,
            }
            if total
            else None,
            "frames": frames,
            **figures,
            "scene_margin": scene_margin,
            "cameras": cameras,
            "limits": run.limits,
        }
        | run.tail(state, METRICS)
    )


class LastReport:
    """Keeps the latest report of a search, so that a command that is killed can mark it as interrupted."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        #: the command that a resumed search goes on with
        self.first_command: list[str] | None = None
        self._document: dict[str, Any] = {}
        self._page: Callable[[], str] = lambda: ""

    def write(self, document: dict[str, Any], page: Callable[[], str]) -> None:
        """Write report.json and report.html.

        ``document``: content of report.json; its keys ``state`` and ``first_command`` are set here. Raises InputError
        where the folder cannot be written.
        """
        if self.first_command:
            document["first_command"] = self.first_command
        self._document, self._page = document, page
        write_certificate(self._folder, document, page())

    def interrupted(self) -> None:
        """Write the latest report again with the state "interrupted"; nothing else is computed.

        Raises:
            InputError: The folder cannot be written.
        """
        if self._document:
            self._document["state"] = "interrupted"
            self.write(self._document, self._page)


def write_certificate(folder: Path, document: Mapping[str, Any], page: str) -> None:
    """Write report.json and report.html. Raises InputError where the folder cannot be written."""
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    try:
        write_text(folder / "report.json", f"{text}\n")
        write_text(folder / "report.html", page)
    except OSError as error:
        raise unwritable(folder, error) from None
