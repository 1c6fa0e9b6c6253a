"""Certificates as in-toto statements, which other tools sign and check."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ns_abstract.check.inputs import BadInput, read_scene
from ns_abstract.check.results import read_report, read_verdicts
from ns_abstract.io import digests
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import load_json
from ns_abstract.io.stamps import file_stamp
from ns_abstract.io.version import ADVISORY, computed_by, stale

STATEMENT, PREDICATE = "https://in-toto.io/Statement/v1", "urn:ns-abstract:certificate:1"
#: What of report.json is the statement's predicate.
_STATED = (
    "kind", "verdict", "property", "property_text", "loop", "coverage", "questions", "frames", "parameters",
    "guarantee", "guarantee_text", "network_guarantee", "picture", "limits", "renderer", "scene", "assumptions",
    "fingerprint", "cells_seal", "substitution", "packages", "state", "updated",
)  # fmt: skip


def statement(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the in-toto Statement (v1) of the certificate in ``folder``, and notes.

    Its subjects are the scene, the network and the property or loop, each with the SHA-256 that the certificate was
    made for. Files that lie where they did are named too, if they still are what was certified. Raises InputError where
    the folder holds no certificate, its cells are not those of its report, or an advisory speaks against the version
    that made it.
    """
    try:
        report = read_report(folder)
        if "cells_seal" not in report:
            fix = "give the output folder of ns-abstract-certify or ns-abstract-reach"
            raise BadInput("holds no certificate", folder, "--input-dir", fix)
        read_verdicts(folder, report)
    except BadInput as error:
        raise InputError(error.problem, file=error.file, field=error.field, fix=error.fix) from None
    if problem := stale(report["fingerprint"], computed_by()):
        raise InputError(problem, file=folder / "report.json", fix=f"make the certificate again; {ADVISORY}")
    prints, notes = report["fingerprint"], []
    scene = _subject("scene", prints["scene"], of="the arrays that the renderer draws (docs/certificates.md)")
    subjects = [scene, *_run_files(report, notes)]
    if report.get("model"):
        subjects.append(_subject(report["model"]["name"], report["model"]["sha256"], of="the network's file"))
    for name in ("model_data", "network_data", "dynamics_data"):
        for file, digest in prints.get(name, {}).items():
            subjects.append(_subject(file, digest, of="a file of constants beside the network"))
    if "dynamics" in prints:
        subjects.append(_subject("dynamics", prints["dynamics"], of="the file of the dynamics"))
    for name in ("property", "loop"):
        if name in prints:
            subjects.append(_subject(name, prints[name], of=f"the {name} as JSON with sorted keys"))
            subjects += _given_file(report, name)
    predicate = {name: report[name] for name in _STATED if name in report}
    predicate["report"] = {"sha256": file_stamp(folder / "report.json")["sha256"]}
    content = {"_type": STATEMENT, "subject": subjects, "predicateType": PREDICATE, "predicate": predicate}
    return content, notes


def _subject(name: str, digest: str, *, of: str) -> dict[str, Any]:
    return {"name": name, "digest": {"sha256": digest}, "annotations": {"digest_of": of}}


def _run_files(report: dict[str, Any], notes: list[str]) -> list[dict[str, Any]]:
    """Return the record of the scene's file, if it still holds the certified scene."""
    source, config = report["scene"].get("source"), report["settings"].get("load_config")
    if not isinstance(source, str) or not isinstance(config, str):
        return []
    try:
        stamp = file_stamp(Path(source))
        read_scene(Path(config), report)
        if file_stamp(Path(source)) != stamp:
            raise InputError("was replaced while it was read", file=source)
    except (BadInput, InputError, OSError) as error:
        why = getattr(error, "problem", None) or str(error)
        notes.append(f"the scene is named by its arrays alone: {source}: {why}")
        return []
    return [_subject(stamp["name"], stamp["sha256"], of="the scene's file")]


def _given_file(report: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return the record of the property's or the loop's file, if it still states what was certified."""
    file = report["settings"].get(name)
    try:
        read: dict[str, str] = {}
        with digests.recorded(read):
            if not isinstance(file, str) or load_json(Path(file)) != report.get(name):
                return []
    except (InputError, OSError):
        return []
    return [_subject(Path(file).name, read[digests.key(file)], of=f"the file of the {name}")]
