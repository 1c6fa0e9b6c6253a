"""Values that are not finite, and files of other kinds: bounded, left out and counted, or refused by name."""

from __future__ import annotations

import dataclasses
import gzip
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import blob_scene, command_options
from scene_files import (
    INF,
    MIP,
    NAN,
    checkpoint_of,
    differ,
    path_of,
    picture,
    ply,
    refused,
    shows,
    thin_scene,
    two_steps,
)

import ns_abstract as nsa
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.methods.load import load_any
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_ply, write_splatfacto_run

# Values that are not finite


def spoiled(values: dict[str, list[tuple[Any, float]]], mode: str = "classic") -> SplatScene:
    """A scene with some values replaced: by array, places and what stands there."""
    scene = dataclasses.replace(blob_scene(30, degree=1), rasterize_mode=mode)  # type: ignore[arg-type]
    arrays = {name: getattr(scene, name).copy() for name in values}
    for name, changes in values.items():
        for place, value in changes:
            arrays[name][place] = value
    return dataclasses.replace(scene, **arrays)


FLAT = {"log_scales": [((slice(0, 10), 0), -INF), ((slice(10, 14), slice(0, 2)), -INF), (14, -INF)]}
SURE = {"opacity_logits": [(slice(0, 4), INF), (slice(4, 9), -INF)]}


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("values", [FLAT, SURE, {**FLAT, **SURE}], ids=["flat", "sure", "both"])
def test_flat_gaussians_and_opacities_of_0_and_1_are_bounded(tmp_path: Path, values: Any, mode: str) -> None:
    scene = spoiled(values, mode)
    assert differ(scene, dataclasses.replace(blob_scene(30, degree=1), rasterize_mode=mode))  # type: ignore[arg-type]
    config = write_splatfacto_run(scene, tmp_path, timestamp="t", experiment_name="e")
    loaded = load_scene(config)
    assert (loaded.count, loaded.dropped) == (30, {})
    shows(config, dataclasses.replace(scene, background=loaded.background))
    write_ply(loaded, tmp_path / "a.ply")
    assert np.array_equal(load_scene(tmp_path / "a.ply").opacity_logits, scene.opacity_logits)


NEVER = {
    "mean NaN": {"means": [((3, 1), NAN)]},
    "mean inf": {"means": [((3, 1), INF)]},
    "mean -inf": {"means": [(slice(3, 6), -INF)]},
    "scale NaN": {"log_scales": [((3, 0), NAN)]},
    "quaternion NaN": {"quats": [((3, 0), NAN), ((4, 1), NAN), ((5, 2), NAN), ((6, 3), NAN)]},
    "quaternion inf": {"quats": [((3, 0), INF), ((4, 1), -INF), ((5, 2), INF), ((6, 3), INF)]},
    "all NaN": {name: [(3, NAN)] for name in ("means", "log_scales", "quats", "opacity_logits", "sh")},
}


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("case", NEVER)
def test_gaussians_that_gsplat_never_draws_are_left_out_and_counted(tmp_path: Path, case: str, mode: str) -> None:
    scene = spoiled(NEVER[case], mode)
    bad = ~np.isfinite(scene.means).all(1) | np.isnan(scene.log_scales).any(1) | ~np.isfinite(scene.quats).all(1)
    config = write_splatfacto_run(scene, tmp_path, timestamp="t", experiment_name="e")
    loaded = load_scene(config)
    assert list(loaded.dropped.values()) == [int(bad.sum())] and loaded.count == 30 - int(bad.sum())
    assert loaded.stored is not None and loaded.stored.tolist() == np.flatnonzero(~bad).tolist()
    # gsplat's kernels draw the whole scene
    with_all = picture(scene)
    assert np.isfinite(with_all).all()
    shows(config, scene)
    assert any("stored Gaussians left out" in line for line in nsa.load_scene(config).method().plan)


DRAWN = {
    "opacity NaN": {"opacity_logits": [(3, NAN)]},
    "scale inf": {"log_scales": [((3, 0), INF)]},
    "colour NaN": {"sh": [((3, 0, 1), NAN)]},
    "colour inf": {"sh": [((3, 1, 1), INF)]},
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("case", DRAWN)
def test_gaussians_that_would_be_drawn_are_left_out_where_that_is_asked_for(tmp_path: Path, case: str) -> None:
    from ns_abstract.cli.export import Ply, export

    scene = spoiled({**DRAWN[case], "means": [(7, NAN)]})
    config = write_splatfacto_run(scene, tmp_path, timestamp="t", experiment_name="e")
    refused(config, "first is row 3", "1 rows", "--drop-nan-gaussians")
    drop = Overrides(drop_nan_gaussians=True)
    loaded = load_scene(config, drop)
    assert list(loaded.dropped.values()) == [1, 1]
    assert loaded.stored is not None and set(range(30)) - set(loaded.stored.tolist()) == {3, 7}
    kept = np.delete(np.arange(30), [3, 7])
    rest = {name: getattr(scene, name)[kept] for name in ("means", "log_scales", "quats", "opacity_logits", "sh")}
    shows(config, dataclasses.replace(scene, **rest), drop_nan_gaussians=True)
    assert (
        export(command_options(Ply, load_config=config, output_filename=tmp_path / "a.ply", drop_nan_gaussians=True))
        == 0
    )
    assert load_scene(tmp_path / "a.ply").count == 28


def test_a_nan_opacity_is_drawn_opaque_by_the_formulas() -> None:
    """Why such Gaussians are not left out unasked: fminf(0.999, NaN) is 0.999."""
    scene = spoiled({"opacity_logits": [(slice(0, 30), NAN)]})
    assert differ(scene, spoiled({"opacity_logits": [(slice(0, 30), -INF)]}))


def test_a_ply_with_nan_in_text(tmp_path: Path) -> None:
    scene = spoiled({"means": [((3, 1), NAN)], "opacity_logits": [(5, INF)], "log_scales": [((6, 1), -INF)]})
    loaded = load_scene(ply(tmp_path / "a.ply", scene, text=True))
    assert loaded.count == 29 and list(loaded.dropped.values()) == [1]
    assert loaded.opacity_logits[4] == INF and loaded.log_scales[5, 1] == -INF


def test_far_coordinates_get_a_note(tmp_path: Path) -> None:
    scene = blob_scene(30)
    assert not any("float32 resolves" in note for note in load_scene(ply(tmp_path / "a.ply", scene)).notes)
    far = dataclasses.replace(scene, means=scene.means + np.array([5e5, 4e6, 0], np.float32))
    assert any("float32 resolves 0.25" in note for note in load_scene(ply(tmp_path / "b.ply", far)).notes)
    near = dataclasses.replace(scene, means=scene.means + np.float32(100.0))
    assert not any("float32 resolves" in note for note in load_scene(ply(tmp_path / "c.ply", near)).notes)


# Files of other kinds


def archive(path: Path, *names: str) -> None:
    with zipfile.ZipFile(path, "w") as file:
        for name in names:
            file.writestr(name, b"{}")


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12345\n"
PAGE = b"\n<!DOCTYPE html>\n<html><body>Sign in</body></html>"
SPZ = struct.pack("<IIIBBBB", 0x5053474E, 2, 1, 0, 12, 0, 0)
KINDS: dict[str, tuple[Callable[[Path], Any], tuple[str, ...]]] = {
    "a.sog": (lambda p: archive(p, "meta.json", "means_l.webp"), ("means.files: missing",)),
    "sog.zip": (lambda p: archive(p, "x/meta.json"), ("means.files: missing",)),
    "run.zip": (lambda p: archive(p, "run/config.yml"), ("a zip archive", "unpack it")),
    "a.ksplat": (lambda p: p.write_bytes(b"\0\1" + bytes(range(256)) * 20), (".ksplat", "splat-transform")),
    "a.splat": (lambda p: p.write_bytes(bytes(range(255)) * 20), (".splat", "multiple of 32")),
    "a.spz": (lambda p: p.write_bytes(gzip.compress(SPZ)), ("cut off", "convert it to .ply")),
    "spz.ply": (lambda p: p.write_bytes(gzip.compress(SPZ)), ("SPZ", "splat-transform")),
    "spz4": (lambda p: p.write_bytes(SPZ), ("cut off",)),
    "a.ply.gz": (lambda p: p.write_bytes(gzip.compress(b"ply\n" * 99)), ("gzip", "gunzip a.ply.gz")),
    "a.glb": (lambda p: p.write_bytes(b"glTF\2\0\0\0" + bytes(99)), (".glb", "export the scene again")),
    "lfs.ply": (lambda p: p.write_bytes(LFS), ("Git LFS pointer", "git lfs pull")),
    "config.yml": (lambda p: p.write_bytes(LFS), ("Git LFS pointer", "git lfs pull")),
    "page.ply": (lambda p: p.write_bytes(PAGE), ("web page", "download")),
    "page.yml": (lambda p: p.write_bytes(b"\xef\xbb\xbf" + PAGE), ("web page", "download")),
    "sog.yml": (lambda p: archive(p, "meta.json"), ("SOG", "splat-transform")),
    "a.usdz": (lambda p: archive(p, "scene.usdc"), ("USD", "export the scene as .ply")),
    "meta.json": (lambda p: p.write_text("{}"), ("means.files: missing",)),
    "lod-meta.json": (lambda p: p.write_text("{}"), ("SOG", "splat-transform lod-meta.json out.ply")),
}


@pytest.mark.parametrize("name", KINDS)
def test_other_kinds_are_refused_by_name(tmp_path: Path, name: str) -> None:
    write, mentions = KINDS[name]
    write(tmp_path / name)
    message = refused(tmp_path / name, *mentions)
    assert "UTF-8" not in message and "header" not in message


@pytest.mark.parametrize("kind", ["run", "ply"])
def test_units_of_a_data_set_need_the_run_to_state_them(tmp_path: Path, kind: str) -> None:
    """Nerfstudio writes dataparser_transforms.json with every run; an export has none."""
    file = two_steps(tmp_path) if kind == "run" else ply(tmp_path / "a.ply", thin_scene(), MIP)
    camera = nsa.load_camera_path(path_of(tmp_path)).cameras[0]
    poses = nsa.PoseSet(camera, translation={"x": 0.01}, units="dataset")
    clear = {"type": "clear", "distance": 0.5, "units": "dataset"}
    if kind == "run":
        poses.of(nsa.load_scene(file))
        (file.parent / "dataparser_transforms.json").unlink()
    scene = nsa.load_scene(file)
    with pytest.raises(nsa.InputError, match=r"units: found dataset.*dataparser_transforms\.json"):
        poses.of(scene)
    with pytest.raises(nsa.InputError, match=r"units: found dataset.*dataparser_transforms\.json"):
        nsa.certify(scene, nsa.PoseSet(camera), None, clear, time_budget=1.0)
    assert nsa.PoseSet(camera, translation={"x": 0.01}).of(scene).box.upper == (0.01,)


def test_units_of_a_data_set_hold_the_scale_of_its_matrix() -> None:
    """Nerfstudio multiplies the matrix by what was applied to the poses before, which may scale."""
    rng, shift = np.random.default_rng(0), np.ones((3, 1))
    for size in (1e-3, 0.5, 1.0, 40.0):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0].astype(np.float32).astype(np.float64)
        frame = DataparserTransform(np.hstack([size * rotation, shift]), 0.25)
        a, b = (np.vstack([np.hstack([np.eye(3), p[:, None]]), [0, 0, 0, 1]]) for p in rng.normal(size=(2, 3)))
        moved = np.linalg.norm(frame.pose(a)[:, 3] - frame.pose(b)[:, 3])
        assert frame.stated_scale == pytest.approx(moved / np.linalg.norm(a[:3, 3] - b[:3, 3]), rel=1e-6)
        assert size != 1.0 or frame.stated_scale == 0.25
    for other in (np.diag([1.0, 1.0, 1.01]), 1e200 * np.eye(3), np.eye(3) + np.eye(3, k=1)):
        assert DataparserTransform(np.hstack([other, shift]), 0.25).stated_scale is None


@pytest.mark.parametrize("name", ["a.splat", "a.spz", "a.sog", "a.glb", "a.bin", "ckpt_6_rank0.pt"])
def test_a_file_that_may_not_be_read_is_no_other_kind(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_bytes(b"abc")
    opened = Path.open

    def refuse(path: Path, *arguments: Any, **more: Any) -> Any:
        if path.name == name:
            raise PermissionError(13, "Permission denied")
        return opened(path, *arguments, **more)

    monkeypatch.setattr(Path, "open", refuse)
    refused(tmp_path / name, "cannot be read: Permission denied; check the permissions")


@pytest.mark.slow
@pytest.mark.parametrize(("content", "name"), [(LFS, "Git LFS pointer"), (PAGE, "web page")])
def test_a_checkpoint_that_was_not_fetched(tmp_path: Path, content: bytes, name: str) -> None:
    run = two_steps(tmp_path)
    checkpoint_of(run).write_bytes(content)
    refused(run, name, "step-000029999.ckpt")


def test_a_ply_of_any_ending_is_read(tmp_path: Path) -> None:
    ply(tmp_path / "a.ply", thin_scene(), MIP).rename(tmp_path / "point_cloud.bin")
    assert load_any(tmp_path / "point_cloud.bin").rasterize_mode == "antialiased"
