"""Every key of config.yml, camera paths and perturbation files is used, irrelevant to the picture, or refused."""

from __future__ import annotations

import copy
import dataclasses
import importlib
import importlib.metadata
import json
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import blob_scene, ring
from nerfactos import tiny_nerfacto
from nerfs import tiny_scene
from nerfstudio_runs import needs_nerfstudio

import ns_abstract as nsa
from ns_abstract.api.files import Settings, open_job
from ns_abstract.geometry import path_keys
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.keyframe_cameras import path_json
from ns_abstract.io.errors import InputError
from ns_abstract.io.keys import Key, KeyTable
from ns_abstract.methods import config_keys
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.hash_field import NerfactoField
from ns_abstract.methods.nerf.write import write_nerf_run, write_nerfacto_run
from ns_abstract.methods.splat.write import write_splatfacto_run
from ns_abstract.nerfstudio.torchvision_operators import declare_missing
from ns_abstract.perturbation.specification import FILE_KEYS, load_perturbation, parse_perturbation
from ns_abstract.reach.loop import parse_loop
from ns_abstract.verify.property_reading import parse_property

TABLES = (*config_keys.TABLES, *path_keys.TABLES)
MODELS = {
    "splatfacto": config_keys.SPLATFACTO, "vanilla-nerf": config_keys.VANILLA_NERF, "nerfacto": config_keys.NERFACTO,
}  # fmt: skip


def named(table: KeyTable) -> dict[str, Key]:
    return {key.name: key for key in table.keys}


# ---------------------------------------------------------------- the tables and Nerfstudio


@pytest.fixture(scope="module")
def nerfstudio() -> SimpleNamespace:
    """Nerfstudio's modules; this package declares what a torchvision built for another torch lacks."""
    declare_missing()
    modules = {
        name: importlib.import_module(name)
        for name in (
            "ns_abstract.nerfstudio.methods", "nerfstudio.configs.method_configs", "nerfstudio.models.splatfacto",
            "nerfstudio.models.vanilla_nerf", "nerfstudio.models.nerfacto", "nerfstudio.cameras.cameras",
            "nerfstudio.cameras.rays",
            "nerfstudio.data.scene_box",
        )
    }  # fmt: skip
    found = SimpleNamespace(**{name.rpartition(".")[2]: module for name, module in modules.items()})
    found.configs = found.method_configs.method_configs
    return found


@pytest.fixture
def no_metric(monkeypatch: pytest.MonkeyPatch) -> None:
    """Models without the metric whose weights they would fetch from the network."""
    lpips = pytest.importorskip("torchmetrics.image.lpip")
    monkeypatch.setattr(lpips, "LearnedPerceptualImagePatchSimilarity", lambda **options: torch.nn.Identity())


def fields_of(config: Any, above: str = "") -> Iterator[str]:
    """Dotted names of all fields of a dataclass and of those in it."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        yield above + field.name
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from fields_of(value, f"{above}{field.name}.")
        elif isinstance(value, dict):
            yield from (f"{above}{field.name}.{key}" for key in value)


def missing(table: KeyTable, names: Iterator[str], prefix: str) -> list[str]:
    """Fields below ``prefix`` that no entry of the table covers; sections of listed keys are no fields."""
    found = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
    sections = {key.name[: at.start()] for key in table.keys for at in re.finditer(r"\.", key.name)}
    return [name for name in found if name not in sections and table.find(name) is None]


@pytest.mark.slow
@needs_nerfstudio
@pytest.mark.parametrize("method", MODELS)
def test_every_field_of_the_models_is_in_a_table(nerfstudio: SimpleNamespace, method: str) -> None:
    assert missing(MODELS[method], fields_of(nerfstudio.configs[method]), "pipeline.model.") == []


@pytest.mark.slow
@needs_nerfstudio
@pytest.mark.parametrize(
    ("method", "ours"),
    [("splatfacto", "abstract_splatfacto"), ("vanilla-nerf", "abstract_nerf"), ("nerfacto", "abstract_nerfacto")],
)
def test_every_field_of_our_models_is_in_a_table(nerfstudio: SimpleNamespace, method: str, ours: str) -> None:
    config = getattr(nerfstudio.methods, ours).config
    assert missing(MODELS[method], fields_of(config), "pipeline.model.") == []


@pytest.mark.slow
@needs_nerfstudio
@pytest.mark.parametrize("method", MODELS)
def test_every_field_of_a_run_is_in_a_table(nerfstudio: SimpleNamespace, method: str) -> None:
    assert missing(config_keys.RUN, fields_of(nerfstudio.configs[method]), "") == []


def test_a_field_that_is_in_no_table_is_noticed() -> None:
    assert missing(config_keys.SPLATFACTO, iter(["pipeline.model.exposure"]), "pipeline.model.") == ["exposure"]
    nested = iter(["collider_params.near_plane", "collider_params.slope", "collider_params"])
    assert missing(config_keys.VANILLA_NERF, nested, "") == ["collider_params.slope"]
    # what lies below a key without keys of its own is covered by it
    assert config_keys.RUN.find("machine.seed") == named(config_keys.RUN)["machine"]
    assert config_keys.RUN.find("pipeline.datamanager.shuffle") is None


@needs_nerfstudio
@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.title)
def test_lines_of_nerfstudio_are_those_that_show_it(table: KeyTable) -> None:
    if importlib.metadata.version("nerfstudio") != "1.1.5":
        pytest.skip("the lines are those of nerfstudio 1.1.5")
    folder = Path(str(importlib.metadata.distribution("nerfstudio").locate_file("nerfstudio")))
    wrong = []
    for key in table.keys:
        if key.where:
            file, number = key.where.split(":")
            line = (folder / file).read_text(encoding="utf-8").splitlines()[int(number) - 1]
            fragments = re.findall("`([^`]*)`", key.why) or [key.name.rpartition(".")[2]]
            wrong += [] if any(fragment in line for fragment in fragments) else [(key.name, key.where, line)]
    assert wrong == []


def other(name: str, value: Any) -> Any:
    """Another value of a key, as far from the old one as its type allows."""
    names = {
        "background_color": "black", "rasterize_mode": "antialiased", "sh_degree": 2,
        "proposal_initial_sampler": "uniform",
    }  # fmt: skip
    if name in names:
        return names[name]
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value * 2 + 1
    if isinstance(value, dict):
        return {key: other(key, part) for key, part in value.items()}
    if isinstance(value, tuple):
        return tuple(2 * part for part in value)
    return "a robot" if value is None else value


def pictures_that_differ(config: Any, names: list[str], picture: Any) -> set[str]:
    """The keys whose other values change what Nerfstudio shows."""
    before = picture(config)
    assert before is not None and all(np.array_equal(a, b) for a, b in zip(before, picture(config), strict=True))
    found = set()
    for name in names:
        outer, _, inner = name.partition(".")
        value = getattr(config, outer)
        new = {**value, inner: other(inner, value[inner])} if inner else other(name, value)
        if dataclasses.is_dataclass(value):
            new = type(value)(mode="SO3xR3")  # pyright: ignore[reportCallIssue]
        after = picture(dataclasses.replace(config, **{outer: new}))
        if after is None or any(not np.array_equal(a, b) for a, b in zip(before, after, strict=True)):
            found.add(name)
    return found


@pytest.mark.slow
@needs_nerfstudio
@pytest.mark.usefixtures("no_metric")
def test_nerfstudio_nerf_pictures_depend_on_what_is_used_or_refused(nerfstudio: SimpleNamespace) -> None:
    """Nerfstudio's own model in evaluation, one key changed at a time."""
    RayBundle, SceneBox = nerfstudio.rays.RayBundle, nerfstudio.scene_box.SceneBox
    config = dataclasses.replace(
        nerfstudio.configs["vanilla-nerf"].pipeline.model, num_coarse_samples=6, num_importance_samples=5
    )
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator), dim=-1)

    def picture(changed: Any) -> list[np.ndarray] | None:
        torch.manual_seed(1)
        try:
            # Nerfstudio takes the kind of distortion out of the configuration's own dictionary
            model = nerfstudio.vanilla_nerf.NeRFModel(
                copy.deepcopy(changed), scene_box=SceneBox(torch.ones(2, 3)), num_train_data=3
            ).eval()
            for field in (model.field_coarse, model.field_fine):
                # neither opaque nor empty, and colourful
                field.field_output_density.net.bias.data.fill_(0.3)
                field.field_heads[0].net.weight.data.mul_(9.0)
            bundle = RayBundle(
                torch.zeros(9, 3), directions, torch.ones(9, 1), times=torch.linspace(0, 1, 9)[:, None],
                camera_indices=torch.zeros(9, 1, dtype=torch.long),
            )[:, None]  # fmt: skip
            return [model.get_outputs_for_camera_ray_bundle(bundle)["rgb_fine"].numpy()]
        except (AssertionError, RuntimeError, AttributeError, TypeError):
            # there is no picture at all
            assert changed is not config
            return None

    listed = named(config_keys.VANILLA_NERF)
    names = [name for name in listed if hasattr(config, name.partition(".")[0])]
    names = [name for name in names if name not in ("_target", "collider_params", "temporal_distortion_params")]
    changing = pictures_that_differ(config, names, picture)
    assert changing == {name for name in names if listed[name].status != "irrelevant"}
    assert {"num_coarse_samples", "collider_params.far_plane", "enable_temporal_distortion"} <= changing


@pytest.mark.slow
@needs_nerfstudio
@pytest.mark.usefixtures("no_metric")
def test_nerfstudio_nerfacto_pictures_depend_on_what_is_used_or_refused(nerfstudio: SimpleNamespace) -> None:
    """Nerfstudio's own model in evaluation, one key changed at a time."""
    RayBundle, SceneBox = nerfstudio.rays.RayBundle, nerfstudio.scene_box.SceneBox
    config = dataclasses.replace(
        nerfstudio.configs["nerfacto"].pipeline.model, implementation="torch", log2_hashmap_size=8, num_levels=3,
        num_proposal_samples_per_ray=(6, 5), num_nerf_samples_per_ray=4,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator), dim=-1)

    def picture(changed: Any) -> list[np.ndarray] | None:
        torch.manual_seed(1)
        try:
            model = nerfstudio.nerfacto.NerfactoModel(
                changed, scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=3
            ).eval()
            for name, value in model.named_parameters():
                # neither opaque nor empty, colourful, and the same whatever other modules there are
                torch.manual_seed(zlib.crc32(name.encode()))
                value.data.uniform_(-1.0, 1.0).mul_(
                    3.0 if "hash_table" in name else 2.0 / (value.shape[-1] or 1) ** 0.5
                )
            bundle = RayBundle(
                torch.full((9, 3), 0.4), directions, torch.ones(9, 1), camera_indices=torch.zeros(9, 1).long()
            )[:, None]  # fmt: skip
            return [model.get_outputs_for_camera_ray_bundle(bundle)["rgb"].detach().numpy()]
        except (AssertionError, RuntimeError, TypeError, IndexError):
            # there is no picture at all
            assert changed is not config
            return None

    listed = named(config_keys.NERFACTO)
    # a text, and mappings in a list
    names = [name for name in listed if name not in ("_target", "implementation", "proposal_net_args_list")]
    changing = pictures_that_differ(config, names, picture)
    assert changing == {name for name in names if listed[name].status != "irrelevant"}


@pytest.mark.slow
@needs_nerfstudio
@pytest.mark.usefixtures("no_metric")
def test_nerfstudio_splat_pictures_depend_on_what_is_used(
    nerfstudio: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What Nerfstudio's own model hands to gsplat, and the colour behind it, one key changed at a time."""
    Cameras, SceneBox = nerfstudio.cameras.Cameras, nerfstudio.scene_box.SceneBox
    calls: list[dict[str, Any]] = []

    def rasterization(**given: Any) -> tuple[torch.Tensor, torch.Tensor, dict]:
        calls.append(given)
        size = given["height"], given["width"]
        return torch.full((1, *size, 4), 0.25), torch.full((1, *size, 1), 0.5), {}

    monkeypatch.setattr(nerfstudio.splatfacto, "rasterization", rasterization)
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self, *rest: self)
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(12, 3, generator=generator), 255 * torch.rand(12, 3, generator=generator)
    config = nerfstudio.configs["splatfacto"].pipeline.model
    camera = Cameras(torch.eye(4)[None, :3], 20.0, 20.0, 8.0, 8.0, 16, 16)

    def picture(changed: Any) -> list[np.ndarray] | None:
        torch.manual_seed(1)
        model = nerfstudio.splatfacto.SplatfactoModel(
            changed, scene_box=SceneBox(torch.ones(2, 3)), num_train_data=3, seed_points=points
        ).eval()
        state = {f"gauss_params.{name}": value.clone() for name, value in first.items()}
        try:
            model.load_state_dict(state, strict=False)
        except RuntimeError:
            return None
        shown = model.get_outputs_for_camera(camera)["rgb"].detach().numpy()
        given = calls[-1]
        arrays = [value.detach().numpy() for value in given.values() if isinstance(value, torch.Tensor)]
        # absgrad says what the backward pass keeps
        rest = [str(v) for k, v in given.items() if not isinstance(v, torch.Tensor) and k != "absgrad"]
        return [shown, *arrays, np.array(rest)]

    first: dict[str, torch.Tensor] = {}
    torch.manual_seed(0)
    model = nerfstudio.splatfacto.SplatfactoModel(
        config, scene_box=SceneBox(torch.ones(2, 3)), num_train_data=3, seed_points=points
    )
    first |= {name: value.detach() + 0.1 for name, value in model.gauss_params.items()}
    listed = named(config_keys.SPLATFACTO)
    names = [name for name in listed if hasattr(config, name) and name != "_target"]
    changing = pictures_that_differ(config, names, picture) | {"sh_degree_interval"}
    assert changing == {name for name in names if listed[name].status != "irrelevant"}
    # of an interval, only one so long that a band is left out at step 30000 can be seen
    long = dataclasses.replace(config, sh_degree_interval=20000)
    assert picture(long)[-1].tolist() != picture(config)[-1].tolist()  # pyright: ignore[reportOptionalSubscript]


# ---------------------------------------------------------------- config.yml


def write_config(folder: Path, method: str, edit: str = "", where: str = "model") -> Path:
    """A run with one more line in its configuration, under pipeline.model or at the top level."""
    if method == "splatfacto":
        config = write_splatfacto_run(blob_scene(5), folder, timestamp="t", experiment_name="e")
    elif method == "nerfacto":
        config = write_nerfacto_run(tiny_nerfacto(1), folder, timestamp="t", experiment_name="e")
    else:
        config = write_nerf_run(tiny_scene(1), folder, timestamp="t", experiment_name="e")
    lines = config.read_text().splitlines()
    key = edit.strip().partition(":")[0]
    if where == "model":
        start = next(i for i, line in enumerate(lines) if line.startswith("  model:")) + 1
        end = next(i for i in range(start, len(lines)) if not lines[i].startswith("    "))
        # what lies below the key that is replaced goes with it
        body, dropped = [], False
        for line in lines[start:end]:
            dropped = line.startswith(f"    {key}:") or (dropped and line.startswith(("     ", "    -")))
            body += [] if dropped else [line]
        lines[start:end] = [*body, *([f"    {edit}"] if edit else [])]
    elif edit:
        lines += edit.splitlines()
    config.write_text("\n".join(lines) + "\n")
    return config


def arrays_of(scene: Any) -> list[Any]:
    """What of a scene the picture depends on."""
    values = {k: v for k, v in vars(scene).items() if k not in ("source", "notes", "coarse", "fine", "field")}
    if isinstance(field := getattr(scene, "field", None), NerfactoField):
        values |= {f"array {k}": a for k, a in enumerate(field.arrays())}
        values |= {k: getattr(field, k) for k in ("samples", "far", "spacing", "background", "average_init_density")}
    for name in ("coarse", "fine"):
        if (field := getattr(scene, name, None)) is not None:
            values |= {f"{name}{k}": a for k, a in enumerate(field.arrays())} | {f"{name} encodings": field.position}
    return [(k, v.tolist() if isinstance(v, np.ndarray) else repr(v)) for k, v in sorted(values.items())]


VALUES = {
    "collider_params": "{near_plane: 1.0, far_plane: 4.0}", "loss_coefficients": "{rgb_loss_coarse: 9.0}",
    "camera_optimizer": "{mode: SO3xR3}", "grid_shape": "[1, 1, 1]", "abstract": "{seconds: 3.0}", "prompt": "a robot",
    "temporal_distortion_params": "{kind: DNERF}", "strategy": "mcmc",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("method", MODELS)
def test_irrelevant_keys_leave_the_scene_as_it_is(tmp_path: Path, method: str) -> None:
    scene = load_any(write_config(tmp_path / "before", method))
    before, notes = arrays_of(scene), scene.notes
    for key in MODELS[method].keys:
        if key.status == "irrelevant" and "." not in key.name:
            line = f"{key.name}: {VALUES.get(key.name, '7')}"
            scene = load_any(write_config(tmp_path / key.name, method, line))
            assert arrays_of(scene) == before, key.name
            assert scene.notes == notes, key.name


USED = {
    "splatfacto": ["sh_degree_interval: 40000", "rasterize_mode: antialiased", "background_color: white"],
    "vanilla-nerf": [
        "num_coarse_samples: 8", "num_importance_samples: 9", "background_color: black",
        "collider_params: {near_plane: 2.0, far_plane: 5.5}",
    ],
    "nerfacto": [
        "far_plane: 3.0", "background_color: white", "background_color: last_sample",
        "num_proposal_samples_per_ray: [9, 5]", "num_nerf_samples_per_ray: 7", "proposal_initial_sampler: uniform",
        "average_init_density: 2.0",
    ],
}  # fmt: skip


@pytest.mark.slow_cases
@pytest.mark.parametrize(("method", "line"), [(m, line) for m, lines in USED.items() for line in lines])
def test_used_keys_change_the_scene(tmp_path: Path, method: str, line: str) -> None:
    before = arrays_of(load_any(write_config(tmp_path / "before", method)))
    assert arrays_of(load_any(write_config(tmp_path / "after", method, line))) != before


REFUSED = [
    ("vanilla-nerf", "enable_temporal_distortion: true", "scenes that move"),
    ("vanilla-nerf", "use_integrated_encoding: true", "mip-NeRF"),
    ("vanilla-nerf", "enable_collider: false", "rays without ends"),
    ("vanilla-nerf", "background_color: last_sample", "not supported"),
    ("vanilla-nerf", "background_color: Last_Sample", "not supported"),
    ("vanilla-nerf", "num_importance_samples: 0", "num_importance_samples"),
    ("vanilla-nerf", "collider_params: {far_plane: 4.0, slope: 1.0}", "pipeline.model.collider_params.slope"),
    ("vanilla-nerf", "use_temporal_distortion: true", "pipeline.model.use_temporal_distortion"),
    ("nerfacto", "disable_scene_contraction: true", "ends at a box"),
    ("nerfacto", "background_color: Last_Sample", "background_color"),
    ("nerfacto", "implementation: cuda", "tcnn, torch"),
    ("nerfacto", "use_transient_embedding: true", "pipeline.model.use_transient_embedding"),
    ("nerfacto", "num_proposal_samples_per_ray: [9]", "write 2 numbers"),
    ("nerfacto", "num_proposal_samples_per_ray: [9, 0]", "write 2 numbers"),
    ("nerfacto", "average_init_density: 0", "above 0"),
    ("nerfacto", "far_plane: .inf", "above 0"),
    ("nerfacto", "use_appearance_embedding: 1", "true or false"),
    ("nerfacto", "proposal_net_args_list: [{use_linear: true}]", "without a network"),
    ("nerfacto", "proposal_net_args_list: [{num_levels: 0}]", "proposal_net_args_list.num_levels"),
    ("nerfacto", "proposal_net_args_list: [{levels: 3}]", "unknown key 'levels'"),
    ("nerfacto", "proposal_net_args_list: 3", "list of mappings"),
    ("splatfacto", "use_exposure: true", "pipeline.model.use_exposure"),
    ("splatfacto", "radius_clip: 3.0", "pipeline.model.radius_clip"),
    ("splatfacto", "7: 3.0", "pipeline.model.7"),
    ("splatfacto", "num_coarse_samples: 64", "pipeline.model.num_coarse_samples"),
]


@pytest.mark.slow_cases(every=6)
@pytest.mark.parametrize(("method", "line", "said"), REFUSED)
def test_keys_that_may_change_the_picture_are_refused(tmp_path: Path, method: str, line: str, said: str) -> None:
    config = write_config(tmp_path, method, line)
    with pytest.raises(InputError) as caught:
        load_any(config)
    assert said in str(caught.value) and caught.value.file == str(config) and caught.value.fix
    assert (caught.value.field or "").startswith("pipeline.model.")
    assert len(str(caught.value).splitlines()) == 1


def test_values_that_switch_a_refused_key_off_are_taken(tmp_path: Path) -> None:
    for line in ("enable_temporal_distortion: false", "use_integrated_encoding: false", "enable_collider: true"):
        assert load_any(write_config(tmp_path / line[:12], "vanilla-nerf", line)).notes == ()


@pytest.mark.slow_cases
@pytest.mark.parametrize("method", MODELS)
def test_unknown_keys_elsewhere_are_named_in_the_notes(tmp_path: Path, method: str) -> None:
    usual = load_any(write_config(tmp_path / "usual", method)).notes
    config = write_config(tmp_path, method, "camera_tweaks:\n  on: true", where="top")
    assert load_any(config).notes == ("unknown keys of config.yml, which are not used: camera_tweaks", *usual)
    text = config.read_text()
    assert "  datamanager:" in text
    start = text.index("  datamanager:")
    line = text.index("\n", start) + 1
    config.write_text(f"{text[:line]}    shuffle_rays: true\n{text[line:]}")
    assert load_any(config).notes[0].endswith("camera_tweaks, pipeline.datamanager.shuffle_rays")


# ---------------------------------------------------------------- camera paths

POSE = [0.0, 0.0, 1.0, 2.0, 1.0, 0.0, 0.0, -0.5, 0.0, 1.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0]
COLUMNS = np.array(POSE).reshape(4, 4).T.flatten().tolist()


def viewer_path(version: str) -> dict[str, Any]:
    """What a viewer writes for two frames, with every key that it has."""
    frames = [{"camera_to_world": POSE, "fov": 60.0, "aspect": 1.5, "render_time": 0.25 * k} for k in range(2)]
    common = {
        "camera_type": "perspective", "render_height": 20, "render_width": 30, "fps": 24, "seconds": 2,
        "is_cycle": False, "smoothness_value": 0.5, "camera_path": frames,
    }  # fmt: skip
    if version in ("0.x", "Blender"):
        properties = json.dumps([["FOV", 60], ["NAME", "Camera 0"], ["TIME", 0]])
        keyframe = {"matrix": json.dumps(COLUMNS), "fov": 60.0, "aspect": 1.5, "properties": properties}
        return {"keyframes": [keyframe, keyframe], **common, **({"crop": None} if version == "0.x" else {})}
    keyframe = {"matrix": POSE, "fov": 60.0, "aspect": 1.5}
    if version == "1.0":
        return {"keyframes": [keyframe, keyframe], **common}
    keyframe |= {"override_transition_enabled": False, "override_transition_sec": None}
    keyframe |= {"render_time": 0.5, "override_time_enabled": False}
    more = {"default_fov": 75.0, "default_time": 0.0, "default_transition_sec": 2.0}
    return {**more, "keyframes": [keyframe, keyframe], **common}


VERSIONS = ("0.x", "Blender", "1.0", "1.1.5")


def read(folder: Path, data: Any) -> nsa.CameraPath:
    file = folder / "path.json"
    file.write_text(json.dumps(data))
    return load_camera_path(file)


@pytest.mark.parametrize("version", VERSIONS)
def test_paths_of_every_viewer_are_read_without_notes(tmp_path: Path, version: str) -> None:
    path = read(tmp_path, viewer_path(version))
    assert len(path.cameras) == 2 and path.notes == ()
    assert path.cameras[0].camera_to_world.flatten().tolist() == POSE[:12]


@pytest.mark.parametrize("version", VERSIONS)
def test_one_keyframe_is_the_camera(tmp_path: Path, version: str) -> None:
    whole = viewer_path(version)
    # another field of view and pose than a default would give
    one = {**whole, "camera_path": [], "keyframes": [{**whole["keyframes"][0], "fov": 33.0}]}
    path = read(tmp_path, {**one, "perturbation": {"version": 1, "translation": {"x": 0.1}}})
    assert len(path.cameras) == 1 and path.following(0) is None
    assert path.cameras[0].camera_to_world.flatten().tolist() == POSE[:12]
    assert path.cameras[0].fx == pytest.approx(10 / np.tan(np.deg2rad(33.0) / 2), rel=1e-15)
    assert path.perturbations == ({"version": 1, "translation": {"x": 0.1}},)


def test_a_text_of_rows_is_told_from_one_of_columns(tmp_path: Path) -> None:
    """The place of the zeros says which it is; where the camera stands in the origin, it is three.js' columns."""
    whole = viewer_path("0.x")
    for matrix in (POSE, COLUMNS):
        keyframe = {**whole["keyframes"][0], "matrix": json.dumps(matrix)}
        path = read(tmp_path, {**whole, "camera_path": [], "keyframes": [keyframe]})
        assert path.cameras[0].camera_to_world.flatten().tolist() == POSE[:12]
    origin = np.array(POSE).reshape(4, 4)
    origin[:3, 3] = 0.0
    keyframe = {**whole["keyframes"][0], "matrix": json.dumps(origin.T.flatten().tolist())}
    path = read(tmp_path, {**whole, "camera_path": [], "keyframes": [keyframe]})
    assert np.array_equal(path.cameras[0].camera_to_world, origin[:3])


OTHERS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "two keyframes and no cameras": ({"camera_path": []}, ("camera_path", "2 keyframes", "duration")),
    "keyframes an object": ({"keyframes": {}}, ("keyframes", "list")),
    "keyframe a number": ({"keyframes": [1]}, ("keyframes[0]", "object")),
    "matrix no list": ({"camera_path": [], "keyframes": [{"matrix": "x", "fov": 60.0}]}, ("keyframes[0].matrix",)),
    "matrix of 12": ({"camera_path": [], "keyframes": [{"matrix": "[1, 2]", "fov": 60.0}]}, ("keyframes[0]", "16")),
    "fisheye": ({"camera_type": "fisheye"}, ("camera_type", "perspective", "viewer")),
    "equirectangular": ({"camera_type": "equirectangular"}, ("camera_type", "perspective")),
    "omnidirectional": ({"camera_type": "omnidirectional"}, ("camera_type", "perspective")),
    "vr180": ({"camera_type": "VR180"}, ("camera_type", "perspective")),
    "orthophoto": ({"camera_type": "orthophoto"}, ("camera_type", "perspective")),
    "type of an entry": (
        {"camera_path": [{"camera_to_world": POSE, "fov": 60.0, "camera_type": "fisheye"}]},
        ("camera_path[0].camera_type", "fisheye"),
    ),
    "crop": (
        {"crop": {"crop_center": [0, 0, 0], "crop_scale": [1, 1, 1], "crop_bg_color": {"r": 0, "g": 0, "b": 0}}},
        ("crop", "changes the picture", "viewer"),
    ),
}


@pytest.mark.parametrize("case", OTHERS)
def test_paths_that_show_something_else_are_refused(tmp_path: Path, case: str) -> None:
    change, said = OTHERS[case]
    with pytest.raises(InputError) as caught:
        read(tmp_path, viewer_path("1.1.5") | change)
    for fragment in said:
        assert fragment in str(caught.value)


FILES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "transforms.json": (
        {"camera_model": "OPENCV", "fl_x": 500.0, "w": 100, "h": 100, "frames": [{"transform_matrix": []}]},
        ("transforms.json", "config.yml of a run", "camera path"),
    ),
    "transforms_train.json": ({"camera_angle_x": 0.7, "frames": []}, ("transforms.json",)),
    "exported cameras": ([{"file_path": "a.png", "transform": []}], ("ns-export cameras",)),
    "dataparser_transforms.json": ({"transform": [[1, 0, 0, 0]], "scale": 1.0}, ("dataparser_transforms.json",)),
    "a perturbation": ({"version": 1, "translation": {"x": 0.1}}, ("--perturbation-filename",)),
    "a loop": ({"version": 1, "dynamics": {}}, ("--loop",)),
}


@pytest.mark.parametrize("case", FILES)
def test_other_files_are_refused_by_name(tmp_path: Path, case: str) -> None:
    content, said = FILES[case]
    with pytest.raises(InputError) as caught:
        read(tmp_path, content)
    for fragment in ("path.json", *said):
        assert fragment in str(caught.value)
    assert caught.value.fix


SCALED = {
    "whole": (2.0 * np.array(POSE), ("scaled matrix", "(0, 0, 0, 2)", "divide all 16 numbers by 2")),
    "halved": (0.5 * np.array(POSE), ("scaled matrix", "(0, 0, 0, 0.5)", "divide all 16 numbers by 0.5")),
    "the end alone": (np.array([*POSE[:15], 3.0]), ("scaled matrix", "(0, 0, 0, 3)", "write 1 at its end")),
    "the rotation alone": (
        np.array(POSE) * np.array([2.0, 2, 2, 1] * 3 + [1.0] * 4), ("orthonormal", "divide its nine numbers by 2"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SCALED)
def test_scaled_matrices_are_told_with_the_fix(tmp_path: Path, case: str) -> None:
    matrix, said = SCALED[case]
    data = viewer_path("1.1.5")
    data["camera_path"][1] = {**data["camera_path"][1], "camera_to_world": matrix.tolist()}
    with pytest.raises(InputError) as caught:
        read(tmp_path, data)
    for fragment in ("camera_path[1].camera_to_world", *said):
        assert fragment in str(caught.value)
    # what the fix says gives the pose
    for _, given in re.findall(r"(divide all 16 numbers by) ([\d.]+)", str(caught.value)):
        data["camera_path"][1]["camera_to_world"] = (matrix / float(given)).tolist()
        assert read(tmp_path, data).cameras[1].camera_to_world.flatten().tolist() == POSE[:12]


def test_keys_of_a_path_do_what_the_table_says(tmp_path: Path) -> None:
    """Other values of irrelevant keys change nothing that is read, and those of used keys do."""

    def told(data: Any) -> list[Any]:
        path = read(tmp_path, data)
        cameras = [(c.camera_to_world.tolist(), c.intrinsics) for c in path.cameras]
        return [cameras, path.perturbations, path.is_cycle, path.notes]

    new: dict[str, Any] = {
        "render_height": 21, "render_width": 31, "default_fov": 50.0, "fps": 12, "is_cycle": True,
        "perturbation": {"version": 1}, "camera_path": viewer_path("1.0")["camera_path"][:1],
    }  # fmt: skip
    whole = viewer_path("1.1.5")
    for entry in whole["camera_path"]:
        del entry["fov"]
    for table, spot in ((path_keys.PATH, None), (path_keys.ENTRY, "camera_path")):
        for key in table.keys:
            if key.status == "refused" or key.name == "keyframes":
                continue
            data = json.loads(json.dumps(whole))
            value = new.get(
                key.name, {"fov": 20.0, "camera_to_world": np.eye(4).flatten().tolist()}.get(key.name, 0.75)
            )
            (data if spot is None else data[spot][0])[key.name] = value
            assert (told(data) != told(whole)) == (key.status == "used"), key.name


def test_unknown_keys_of_a_path_are_named_in_the_report(tmp_path: Path) -> None:
    data = path_json(ring(2, 8), perturbation={"version": 1})
    data["exposure"] = 1.0
    for entry in data["camera_path"]:
        entry["appearance"] = 3
    (tmp_path / "path.json").write_text(json.dumps(data))
    config = write_config(tmp_path, "splatfacto")
    said = "unknown keys of path.json, which are not used: camera_path[].appearance, exposure"
    job = open_job(Settings(config, tmp_path / "path.json"))
    assert job.path.notes == (said,) and job.describe()["notes"] == [said]


# ---------------------------------------------------------------- files of this program

SET: dict[str, Any] = {
    "version": 1, "frame": "world", "units": "dataset", "angle_units": "degrees", "translation": {"x": 0.1},
    "rotation": {"yaw": 0.1}, "sweep": "segments", "hue": 0.1, "saturation": 0.1,
    "orbit": {"target": [0, 0, 0], "axis": [0, 0, 1], "azimuth": [0, 1]},
    "scene": [{"select": {"indices": [0]}, "mean": 0.1, "opacity": 0.1, "color": 0.1}],
}  # fmt: skip


def test_every_key_of_a_perturbation_file_is_used() -> None:
    assert SET.keys() == FILE_KEYS.keys()
    whole = parse_perturbation(SET, dataset_scale=2.0)
    for key in FILE_KEYS:
        if key != "version":
            assert parse_perturbation({k: v for k, v in SET.items() if k != key}, dataset_scale=2.0) != whole, key
    with pytest.raises(InputError, match="version"):
        parse_perturbation(SET | {"version": 2})


def inside(value: dict[str, Any], place: str, key: str) -> dict[str, Any]:
    """A copy with one more key at a dotted place."""
    copy = json.loads(json.dumps(value))
    inner: Any = copy
    for part in place.split(".") if place else []:
        inner = inner[int(part) if part.isdigit() else part]
    inner[key] = 1
    return copy


@pytest.mark.parametrize("place", ["", "translation", "rotation", "orbit", "scene.0", "scene.0.select"])
def test_unknown_keys_of_a_perturbation_file_are_errors(place: str) -> None:
    with pytest.raises(InputError, match="unknown key") as caught:
        parse_perturbation(inside(SET, place, "shake"))
    assert "shake" in (caught.value.field or "")


def test_schema_is_taken_at_the_top_alone() -> None:
    schema = {"$schema": "https://example.org/perturbation.json"}
    assert parse_perturbation(SET | schema) == parse_perturbation(SET)
    with pytest.raises(InputError, match="unknown key"):
        parse_perturbation(inside(SET, "translation", "$schema"))


def test_schema_of_properties_and_loops(tmp_path: Path) -> None:
    schema = {"$schema": "./schema.json"}
    prop = {"type": "classification", "label": 1}
    found = parse_property(prop | schema, tmp_path, (3, 8, 8), (3,))
    assert found.preprocess == parse_property(prop, tmp_path, (3, 8, 8), (3,)).preprocess
    with pytest.raises(InputError, match=r"lable.*unknown key"):
        parse_property(prop | {"lable": 1}, tmp_path, (3, 8, 8), (3,))
    with pytest.raises(InputError, match=r"preprocess\.scale.*unknown key"):
        parse_property(prop | {"preprocess": {"scale": 2}}, tmp_path, (3, 8, 8), (3,))
    # what is missing comes next
    with pytest.raises(InputError, match="state"):
        parse_loop(schema | {"version": 1}, tmp_path)
    with pytest.raises(InputError, match="unknown key"):
        parse_loop({"version": 1, "schema": 1}, tmp_path)


def test_sets_of_entries_are_not_lost_in_a_path_that_serves_as_perturbation_file(tmp_path: Path) -> None:
    data: dict[str, Any] = viewer_path("1.1.5") | {"perturbation": {"version": 1, "translation": {"x": 0.1}}}
    file = tmp_path / "path.json"
    file.write_text(json.dumps(data))
    assert load_perturbation(file).translation == {"x": (-0.1, 0.1)}
    data["camera_path"][1]["perturbation"] = {"version": 1, "translation": {"x": 0.9}}
    file.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"camera_path\[1\]\.perturbation"):
        load_perturbation(file)
