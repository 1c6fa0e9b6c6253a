"""How many planted faults of the splat bounds `ns-abstract-check` finds by itself, on results that it is handed.

Every fault is applied to a copy of the package, which compiles its kernels into a cache of its own and bounds two tiny
scenes. Where a bound differs from the healthy one by more than 1e-3 the healthy package's checker audits the result.

    python benchmarks/check_planted.py WORK [--faults 40] [--seed 0] [--claims 200] [--seconds 120] [--audit-only]
        [--interpreted] [--part 0 1]

keeps results in WORK, goes on from what lies there, and prints one line a fault.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from mutants import copy_package, mutate
from planted import FAULTS, Fault

ROOT = Path(__file__).resolve().parents[1]
#: Files of the splat bounds that read scenes, pictures or results and bound nothing.
_OTHER = ("load", "ply", "write", "scene", "render", "reference", "method", "descent")
_SPECS: dict[str, dict[str, Any]] = {
    "shift": {"version": 1, "translation": {"x": 0.02}},
    "turn": {"version": 1, "translation": {"z": [0.0, 0.01]}, "rotation": {"yaw": 0.01}},
}
_LEAST_CHANGE = 1e-3


def candidates() -> list[Fault]:
    """The planted faults that lie in what bounds splats."""
    folder = "methods/splat/"
    return [f for f in FAULTS if f.file.startswith(folder) and not f.file[len(folder) :].startswith(_OTHER)]


def inputs(folder: Path, tiny: bool) -> dict[str, Path]:
    """Writes the runs, the path and the sets; the path of each by its name. ``tiny``: for interpreted kernels."""
    sys.path.insert(0, str(ROOT / "tests"))
    from dataclasses import replace

    from conftest import blob_scene, path_json, ring, write_json, write_splatfacto_run

    found: dict[str, Path] = {}
    for name, mode in (("shift", "classic"), ("turn", "antialiased")):
        where = folder / name
        where.mkdir(parents=True, exist_ok=True)
        scene = blob_scene(14 if tiny else 40, degree=1 if tiny else 2)
        scene = replace(scene, rasterize_mode=mode, opacity_logits=2.0 * scene.opacity_logits)
        scene = replace(scene, log_scales=scene.log_scales + np.float32(0.8 * tiny))
        config = where / "blobs"
        found[name] = (
            next(config.rglob("config.yml"))
            if config.exists()
            else write_splatfacto_run(scene, where, timestamp="2026-01-01_120000", experiment_name="blobs")
        )
        found[f"{name} set"] = write_json(where / "spec.json", _SPECS[name])
    found["path"] = write_json(folder / "path.json", path_json(ring(1, 6 if tiny else 24)))
    return found


def blind(package: Path) -> None:
    """Lets the copy write bounds that its own renders leave, which it refuses otherwise: the checker is alone."""
    file = package / "ns_abstract" / "report" / "files.py"
    text = file.read_text()
    changes = {"if not excess <= 0.0:": "if np.isnan(excess):"}
    changes["if not ((images >= result.lower).all() and (images <= result.upper).all()):"] = (
        "if np.isnan(images).any():"
    )
    for old, new in changes.items():
        if text.count(old) != 1:
            raise ValueError(f"{old} stands {text.count(old)} times in {file}")
        text = text.replace(old, new)
    file.write_text(text)


def dependents(package: Path, file: str) -> set[str]:
    """The modules of the copy that import ``file``, directly or not, and itself; without ".py", relative to it."""
    imports: dict[str, set[str]] = {}
    root = package / "ns_abstract"
    names = {path.relative_to(root).with_suffix("").as_posix() for path in root.rglob("*.py")}
    for name in names:
        tree = ast.parse((root / f"{name}.py").read_text())
        nodes = [n for n in ast.walk(tree) if isinstance(n, (ast.Import, ast.ImportFrom))]
        found = {f"{n.module}.{a.name}" for n in nodes if isinstance(n, ast.ImportFrom) for a in n.names}
        found |= {n.module or "" for n in nodes if isinstance(n, ast.ImportFrom)}
        found |= {a.name for n in nodes if isinstance(n, ast.Import) for a in n.names}
        imports[name] = {f.removeprefix("ns_abstract.").replace(".", "/") for f in found}
    closed = {file.removesuffix(".py")}
    while more := {name for name, used in imports.items() if name not in closed and used & closed}:
        closed |= more
    return closed


def warm(package: Path, file: str, kept: Path, cache: Path) -> None:
    """Fills the copy's cache with the healthy kernels that nothing in ``file`` can have gone into."""
    if not kept.exists():
        return
    environment = {k: v for k, v in os.environ.items() if k != "NS_ABSTRACT_DEV_KEY"} | {"PYTHONPATH": str(package)}
    program = "from ns_abstract.arithmetic.kernel_cache import source_key; print(source_key())"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=environment, cwd=package, capture_output=True, text=True, check=True)
    (old,) = (path.parent for path in kept.glob("*/manifest.json"))
    new = cache / done.stdout.split()[-1]
    shutil.copytree(old, new, ignore=shutil.ignore_patterns("session-*"))
    manifest, gone = json.loads((new / "manifest.json").read_text()), dependents(package, file)
    left = {kernel: entry for kernel, entry in manifest.items() if str(Path(kernel).parent) not in gone}
    print(f"  {len(manifest) - len(left)} of {len(manifest)} kernels are compiled again", flush=True)
    (new / "manifest.json").write_text(json.dumps(left))


def render(package: Path, files: dict[str, Path], out: Path, cache: str, tiny: bool) -> bool:
    """Bounds both scenes with the package in ``package``; whether that ended well."""
    environment = {k: v for k, v in os.environ.items() if k != "NS_ABSTRACT_DEV_KEY"}
    environment |= {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1", "NS_ABSTRACT_CACHE_DIR": cache}
    environment |= {"NUMBA_DISABLE_JIT": "1"} if tiny else {}
    for name in _SPECS:
        if (out / name / "report.json").exists():
            continue
        command = [
            sys.executable, "-W", "ignore", "-m", "ns_abstract.cli.render", "--load-config", str(files[name]),
            "--camera-path-filename", str(files["path"]), "--perturbation-filename", str(files[f"{name} set"]),
            "--output-dir", str((out / name).absolute()), "--save-cells",
            "--time-budget", "60", "--target-ratio", "1.2",
        ]  # fmt: skip
        with (out / f"{name}.log").open("w") as log:
            # Python looks first where it is started
            done = subprocess.run(
                command, env=environment, cwd=package, stdout=log, stderr=log, timeout=1500, check=False
            )
        if done.returncode != 0:
            return False
    return True


def change(healthy: Path, faulty: Path) -> tuple[float, float]:
    """By how much bounds of pictures differ at most, and by how much they lie inside what was really rendered."""
    most = inside = 0.0
    for name in _SPECS:
        with np.load(healthy / name / "frame_00000.npz") as a, np.load(faulty / name / "frame_00000.npz") as b:
            for side, sign in (("lower", 1.0), ("upper", -1.0)):
                most = max(most, float(np.abs(a[side] - b[side]).max()))
                inside = max(inside, float((sign * (b[side] - a[f"witness_{side}"])).max()))
    return most, inside


def audit(folder: Path, claims: int, seconds: float) -> dict[str, Any]:
    """Numbers of claims by outcome, of both scenes."""
    sys.path.insert(0, str(ROOT))
    from ns_abstract.api.checking import check
    from ns_abstract.io.errors import InputError

    total = {"proved": 0, "refuted": 0, "unsettled": 0, "structure": 0}
    for name in _SPECS:
        try:
            found = check(folder / name, claims=claims, seconds=seconds)
        except InputError:
            # the copy bounded nothing
            continue
        for key in ("proved", "refuted", "unsettled"):
            total[key] += getattr(found, key)
        total["structure"] += len(found.structure)
    return total


def main() -> None:
    """Plant, render and audit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--faults", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--claims", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--audit-only", action="store_true", help="audit what has been rendered, and render nothing")
    parser.add_argument("--interpreted", action="store_true", help="interpret the kernels, on tiny scenes")
    parser.add_argument("--part", type=int, nargs=2, default=(0, 1), help="every n-th fault from the k-th on: k n")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    files = inputs(options.work / "inputs", options.interpreted)
    drawn: list[Fault | None] = [None, *random.Random(options.seed).sample(candidates(), options.faults)]
    changed = refuted = 0
    for number, fault in enumerate(drawn):
        if fault is not None and number % options.part[1] != options.part[0]:
            continue
        out = options.work / ("healthy" if fault is None else f"{number:02d}")
        out.mkdir(exist_ok=True)
        name = "no fault" if fault is None else fault.name
        if not all((out / s / "report.json").exists() for s in _SPECS):
            if options.audit_only or (out / "failed").exists():
                continue
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
                package = Path(temporary) / "package"
                package.mkdir()
                copy_package(package)
                blind(package)
                if fault is not None:
                    mutate(package, fault)
                cache, kept = Path(temporary) / "cache", options.work / "kernels"
                if fault is not None:
                    warm(package, fault.file, kept, cache)
                ended = render(package, files, out, str(cache), options.interpreted)
                if fault is None and not options.interpreted:
                    shutil.copytree(cache, kept)
                if not ended:
                    (out / "failed").touch()
                    print(f"{number:2d} {name}: the command failed", flush=True)
                    continue
        most, inside = change(options.work / "healthy", out)
        entry: dict[str, Any] = {"number": number, "fault": name, "change": most, "inside": inside}
        if fault is None or most > _LEAST_CHANGE:
            entry |= audit(out, options.claims, options.seconds)
            if fault is not None:
                changed += 1
                refuted += bool(entry["refuted"] or entry["structure"])
        print(json.dumps(entry), flush=True)
    print(f"{refuted} of {changed} faults that change a bound by more than {_LEAST_CHANGE:g} were refuted")


if __name__ == "__main__":
    main()
