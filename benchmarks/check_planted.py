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
    # kernels that the fault does not touch are those of the package without it
    file = package / "ns_abstract" / "arithmetic" / "kernel_cache.py"
    text = file.read_text()
    head = "def source_key() -> str:\n"
    if text.count(head) != 1:
        raise ValueError(f"source_key is not defined once in {file}")
    file.write_text(text.replace(head, f'{head}    return "planted"\n'))


def _referenced(node: ast.AST, imported: dict[str, str], module: str) -> set[tuple[str, str]]:
    """What a definition refers to, as (module, name): all that it could mean."""
    found = set()
    for n in ast.walk(node):
        if isinstance(n, ast.Name):
            whole = imported.get(n.id, f"{module}.{n.id}")
            found.add(tuple(whole.rpartition(".")[::2]))
        elif isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name) and n.value.id in imported:
            found.add((imported[n.value.id], n.attr))
    return found


def touched(package: Path, file: str, before: str) -> set[tuple[str, str]]:
    """Definitions of the copy, as (module, name), that a change of ``file`` may have gone into.

    Args:
        package: The copy, with the change.
        file: Relative to the package.
        before: Its text without it.
    """
    root, uses = package / "ns_abstract", {}
    for path in root.rglob("*.py"):
        tree, module = (
            ast.parse(path.read_text()),
            path.relative_to(package).with_suffix("").as_posix().replace("/", "."),
        )
        imported = {}
        for n in ast.walk(tree):
            if isinstance(n, ast.ImportFrom):
                imported |= {a.asname or a.name: f"{n.module}.{a.name}" for a in n.names}
            elif isinstance(n, ast.Import):
                imported |= {a.asname or a.name: a.name for a in n.names}
        for node in tree.body:
            for name in _defined(node):
                uses[module, name] = uses.get((module, name), set()) | _referenced(node, imported, module)
    module = f"ns_abstract.{file.removesuffix('.py').replace('/', '.')}"
    old = {ast.dump(node) for node in ast.parse(before).body}
    new = [node for node in ast.parse((root / file).read_text()).body if ast.dump(node) not in old]
    closed = {(module, name) for node in new for name in _defined(node)}
    while more := {key for key, used in uses.items() if key not in closed and used & closed}:
        closed |= more
    return closed


def _defined(node: ast.AST) -> list[str]:
    """Names that a statement of a module defines; "" where it only acts."""
    if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [n.id for t in targets if t is not None for n in ast.walk(t) if isinstance(n, ast.Name)] or [""]


def warm(package: Path, fault: Fault, before: str, kept: Path, cache: Path) -> None:
    """Fills the copy's cache with the healthy kernels that the fault cannot have gone into."""
    if not kept.exists():
        return
    shutil.copytree(kept, cache, ignore=shutil.ignore_patterns("session-*"))
    (file,) = cache.glob("*/manifest.json")
    manifest, gone = json.loads(file.read_text()), touched(package, fault.file, before)

    def of(kernel: str) -> tuple[str, str]:
        place, _, name = kernel.rpartition("/")
        return f"ns_abstract.{place.replace('/', '.')}", name.split(".")[1].partition("-")[0]

    left = {kernel: entry for kernel, entry in manifest.items() if of(kernel) not in gone}
    print(f"  {len(manifest) - len(left)} of {len(manifest)} kernels are compiled again", flush=True)
    file.write_text(json.dumps(left))


def render(package: Path, files: dict[str, Path], out: Path, cache: str, tiny: bool) -> bool:
    """Bounds both scenes with the package in ``package``; whether that ended well."""
    environment = {k: v for k, v in os.environ.items() if k != "NS_ABSTRACT_DEV_KEY"}
    environment |= {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1", "NS_ABSTRACT_CACHE_DIR": cache}
    environment |= {"NUMBA_DISABLE_JIT": "1"} if tiny else {}
    calls = [
        [
            "--load-config", str(files[name]), "--camera-path-filename", str(files["path"]),
            "--perturbation-filename", str(files[f"{name} set"]), "--output-dir", str((out / name).absolute()),
            "--save-cells", "--time-budget", "60", "--target-ratio", "1.2",
        ]
        for name in _SPECS
        if not (out / name / "report.json").exists()
    ]  # fmt: skip
    program = f"""
import sys
from ns_abstract.cli.render import main
for options in {calls!r}:
    sys.argv = ["ns-abstract-render", *options]
    try:
        main()
    except SystemExit as ended:
        if ended.code not in (0, None):
            raise
"""
    with (out / "render.log").open("w") as log:
        # Python looks first where it is started
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", program], env=environment, cwd=package, stdout=log, stderr=log,
            timeout=3000, check=False,
        )  # fmt: skip
    return done.returncode == 0


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
                cache, kept = Path(temporary) / "cache", options.work / "kernels"
                if fault is not None:
                    warm(package, fault, mutate(package, fault), kept, cache)
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
