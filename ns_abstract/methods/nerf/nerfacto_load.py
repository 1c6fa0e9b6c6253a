"""Loads a nerfacto from an ``ns-train nerfacto`` run folder, if it was trained with torch's implementation.

It imports nothing from Nerfstudio and runs no code in the files. Sizes that both config.yml and the checkpoint state
have to agree; the grids' resolutions, the samples and the factor of densities are in config.yml alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import is_number, show
from ns_abstract.io.memory import check_memory
from ns_abstract.methods import config_keys, runs
from ns_abstract.methods.checkpoint import StoredTensor
from ns_abstract.methods.nerf import model_state
from ns_abstract.methods.nerf.hash_field import (
    LAYERS_LIMIT,
    DenseNet,
    HashEncoding,
    NerfactoField,
    NerfactoScene,
    ProposalField,
)
from ns_abstract.methods.nerf.model_state import ModelState
from ns_abstract.methods.overrides import Overrides

_FIX = "give a run of nerfacto or abstract-nerfacto that was trained with --pipeline.model.implementation torch"
_PAIR = "give the checkpoint that belongs to config.yml"
_STOCK = "nerfstudio.models.nerfacto.NerfactoModel"
_MODEL = "pipeline.model."
#: nerfstudio/fields/nerfacto_field.py: modules of ``predict_normals``.
_NORMALS = ("field.mlp_pred_normals.", "field.field_head_pred_normals.")
#: nerfstudio/fields/nerfacto_field.py: harmonics of directions, and geometric features.
HARMONICS, FEATURES = 16, 15
_LEVELS_LIMIT, _TABLE_LIMIT, _FEATURES_LIMIT, _RESOLUTION_LIMIT = 64, 30, 64, 2**22
_SAMPLES_LIMIT, _ROUNDS_LIMIT, _WIDTH_LIMIT, _FAR_LIMIT = 4096, 8, 4096, 1e6
#: Bytes by value of a table: as it is stored, and as it is used.
_BYTES = 12
#: nerfstudio/fields/density_fields.py: defaults of a proposal field, and values that each may have.
_PROPOSAL = {
    "num_layers": (2, 1, LAYERS_LIMIT),
    "hidden_dim": (64, 1, _WIDTH_LIMIT),
    "num_levels": (8, 1, _LEVELS_LIMIT),
    "max_res": (1024, 1, _RESOLUTION_LIMIT),
    "base_res": (16, 1, _RESOLUTION_LIMIT),
    "log2_hashmap_size": (18, 1, _TABLE_LIMIT),
    "features_per_level": (2, 1, _FEATURES_LIMIT),
}
#: nerfstudio/models/nerfacto.py: ``proposal_net_args_list``.
_PROPOSALS = tuple(
    {"hidden_dim": 16, "log2_hashmap_size": 17, "num_levels": 5, "max_res": most, "use_linear": False}
    for most in (128, 256)
)
#: float32 units in the last place within which another machine may round a resolution to another integer.
_CLOSE_ULPS = 4.0


@dataclass(frozen=True)
class _Grid:
    """The sizes of a hash grid in config.yml."""

    levels: int
    coarsest: int
    finest: int
    log2_size: int
    features: int

    @property
    def rows(self) -> int:
        return self.levels << self.log2_size


def holds_nerfacto(run: runs.RunConfig) -> bool:
    """Return whether config.yml names nerfacto: by its method or by its model class."""
    return run.method_name in ("nerfacto", "abstract-nerfacto") or runs.target_class(run) == _STOCK


def load_nerfacto(run: runs.RunConfig, overrides: Overrides | None = None) -> NerfactoScene:
    """Return the fields and the other inputs of Nerfstudio's evaluation."""
    overrides = overrides or Overrides()
    model_state.check_model(run, overrides, (_STOCK,), "nerfacto", _FIX)
    unused = config_keys.check_keys(run, config_keys.NERFACTO)
    run.choice("implementation", "tcnn", ("tcnn", "torch"))
    record, background = model_state.background(run, overrides, model_state.LAST_SAMPLE)
    if isinstance(background, str):
        # letter by letter: Nerfstudio stops at "Last_Sample"
        run.choice("background_color", model_state.LAST_SAMPLE, (model_state.LAST_SAMPLE,))
    grid, proposals, samples = _grid(run), _proposal_arguments(run), _samples(run)
    transform, notes = runs.read_dataparser_transform(run)
    checkpoint = runs.find_checkpoint(run, overrides.load_step)
    state = ModelState(runs.read_model_state(checkpoint), checkpoint, _FIX)
    _refuse_other_implementation(run, state)
    grids = [grid, *(_proposal_grid(one) for one in proposals)]
    check_memory(sum(_BYTES * one.rows * one.features for one in grids), checkpoint, "the hash tables")
    factor = _positive(run, "average_init_density", 1.0, math.inf)
    encoding = _encoding(state, "field", "mlp_base.model.0.hash_table", grid)
    width = encoding.size
    density = _net(state, "field.mlp_base.model.1", (width, run.integer("hidden_dim", 64, 1), 1 + FEATURES))
    field = NerfactoField(
        encoding=encoding,
        density_net=density,
        color_net=_color_net(run, state),
        average_init_density=factor,
        proposals=_proposals(run, state, proposals, factor),
        samples=samples,
        # nerfstudio/model_components/scene_colliders.py: reset_near_plane, outside training
        near=0.0,
        far=_positive(run, "far_plane", 1000.0, _FAR_LIMIT),
        spacing=cast(
            "Literal['piecewise', 'uniform']",
            run.choice("proposal_initial_sampler", "piecewise", ("piecewise", "uniform")),
        ),
        background=cast("Literal['last_sample']", background)
        if isinstance(background, str)
        else background.astype(np.float64),
    )
    for key in state:
        # the box that a field without contraction ends at, and what draws normals beside the picture
        if key.rpartition(".")[2] == "aabb" or key.startswith(_NORMALS):
            state.read.add(key)
    state.refuse_unread("nerfacto")
    others = model_state.records(run, state, overrides, _STOCK, transform, bool(notes))
    return NerfactoScene(
        field=field,
        dataparser=transform,
        name=run.experiment_name,
        source=str(checkpoint),
        notes=(*notes, *unused, *_close_resolutions(grids)),
        assumptions=(record, *others, _resolution_record(field)),
    )


def resolutions(levels: int, coarsest: int, finest: int) -> NDArray[np.int64]:
    """Return [levels] resolutions of a hash grid from ``coarsest`` to ``finest``, as torch rounds them in float32.

    A checkpoint does not hold them (nerfstudio/field_components/encodings.py, ``HashEncoding.__init__``).
    """
    import torch

    powers = torch.pow(torch.tensor(_growth(levels, coarsest, finest)).float(), torch.arange(levels).float())
    return torch.floor(coarsest * powers).to(torch.int64).numpy()


def _growth(levels: int, coarsest: int, finest: int) -> float:
    return float(np.exp((np.log(finest) - np.log(coarsest)) / (levels - 1))) if levels > 1 else 1.0


def _resolution_record(field: NerfactoField) -> Assumption:
    """Return the record of the resolutions of all grids."""
    encodings = field.encoding, *(one.encoding for one in field.proposals)
    sizes = "; ".join(" ".join(map(str, one.resolutions.tolist())) for one in encodings)
    return Assumption("resolutions", sizes, "config.yml, as torch rounds them in float32: field, then proposals")


def _close_resolutions(grids: list[_Grid]) -> tuple[str, ...]:
    """Return a note on resolutions that another machine's float32 power might round to another integer."""
    close = []
    for one in dict.fromkeys((grid.levels, grid.coarsest, grid.finest) for grid in grids):
        for level, size in enumerate(resolutions(*one)):
            exact = one[1] * _growth(*one) ** level
            near = abs(exact - round(exact)) <= _CLOSE_ULPS * float(np.spacing(np.float32(exact)))
            if near and level > 0:
                close.append(str(size))
    if not close:
        return ()
    return (
        f"resolutions of grids that lie within {_CLOSE_ULPS:g} float32 roundings of an integer, as torch rounds them "
        f"here: {', '.join(dict.fromkeys(close))}",
    )


def _refuse_other_implementation(run: runs.RunConfig, state: ModelState) -> None:
    """Refuse checkpoints of tiny-cuda-nn, and those that hold no nerfacto at all.

    config.yml does not decide: without tiny-cuda-nn installed, "tcnn" trains torch's implementation.
    """
    if any(key.endswith(".params") for key in state):
        raise InputError(
            "holds grids and networks of tiny-cuda-nn, which computes in half precision and by other rules than torch",
            file=state.checkpoint,
            field="pipeline.model.implementation",
            fix="train with --pipeline.model.implementation torch",
        )
    if not any(key.startswith("field.mlp_base.") for key in state):
        raise state.refused(f"no nerfacto in this checkpoint (method {show(run.method_name)})", "field.mlp_base")


def _positive(run: runs.RunConfig, name: str, default: float, most: float) -> float:
    value: Any = run.model.get(name, default)
    if not is_number(value) or not 0.0 < value < most:
        raise run.refused(name, value, "a number above 0" + (f" and below {most:g}" if math.isfinite(most) else ""))
    return float(value)


def _grid(run: runs.RunConfig) -> _Grid:
    return _Grid(
        run.integer("num_levels", 16, 1, _LEVELS_LIMIT),
        run.integer("base_res", 16, 1, _RESOLUTION_LIMIT),
        run.integer("max_res", 2048, 1, _RESOLUTION_LIMIT),
        run.integer("log2_hashmap_size", 19, 1, _TABLE_LIMIT),
        run.integer("features_per_level", 2, 1, _FEATURES_LIMIT),
    )


def _proposal_grid(arguments: Mapping[str, int]) -> _Grid:
    names = ("num_levels", "base_res", "max_res", "log2_hashmap_size", "features_per_level")
    return _Grid(*(arguments[name] for name in names))


def _samples(run: runs.RunConfig) -> tuple[int, ...]:
    """Return the numbers of samples of every round, and of the picture."""
    rounds = run.integer("num_proposal_iterations", 2, 1, _ROUNDS_LIMIT)
    value: Any = run.model.get("num_proposal_samples_per_ray", (256, 96))
    fits = isinstance(value, (list, tuple)) and all(type(one) is int and 1 <= one <= _SAMPLES_LIMIT for one in value)
    if not fits or len(value) < rounds:
        wanted = f"{rounds} numbers from 1 to {_SAMPLES_LIMIT}, one for every proposal iteration"
        raise run.refused("num_proposal_samples_per_ray", value, wanted)
    return (*value[:rounds], run.integer("num_nerf_samples_per_ray", 48, 1, _SAMPLES_LIMIT))


def _proposal_arguments(run: runs.RunConfig) -> list[dict[str, int]]:
    """Return the arguments of every proposal field (nerfstudio/models/nerfacto.py:182-205)."""
    name = _MODEL + "proposal_net_args_list"
    value: Any = run.model.get("proposal_net_args_list", _PROPOSALS)
    entries = [runs.as_mapping(one) for one in value] if isinstance(value, (list, tuple)) else []
    same = run.flag("use_same_proposal_network", False)
    if not entries or None in entries or (same and len(entries) != 1):
        raise run.refused("proposal_net_args_list", value, "one mapping" if same else "a list of mappings")
    arguments = []
    for entry in entries:
        assert entry is not None
        if entry.get("use_linear", False) is not False:
            fix = "give a run whose proposal fields have a hidden layer"
            raise InputError(
                "proposal fields without a network are not supported",
                file=run.file,
                field=f"{name}.use_linear",
                fix=fix,
            )
        unknown = sorted(set(entry) - set(_PROPOSAL) - {"use_linear"}, key=str)
        if unknown:
            raise InputError(f"unknown key {show(unknown[0])}", file=run.file, field=name, fix=_FIX)
        # numbers are checked as those of the model itself
        section = replace(run, model=entry)
        arguments.append({key: _argument(section, name, key) for key in _PROPOSAL})
    if same:
        return arguments
    rounds = run.integer("num_proposal_iterations", 2, 1, _ROUNDS_LIMIT)
    return [arguments[min(i, len(arguments) - 1)] for i in range(rounds)]


def _argument(section: runs.RunConfig, name: str, key: str) -> int:
    try:
        return section.integer(key, *_PROPOSAL[key])
    except InputError as error:
        raise InputError(error.problem, file=section.file, field=f"{name}.{key}", fix=error.fix) from None


def _proposals(
    run: runs.RunConfig, state: ModelState, arguments: list[dict[str, int]], factor: float
) -> tuple[ProposalField, ...]:
    """Return the proposal field of every round of sampling; ``arguments``: each field's options."""
    fields = []
    for i, one in enumerate(arguments):
        name, grid = f"proposal_networks.{i}", _proposal_grid(one)
        encoding = _encoding(state, name, "mlp_base.0.hash_table", grid)
        _refuse_second_table(state, f"{name}.encoding.hash_table", encoding)
        widths = (encoding.size, *(one["hidden_dim"],) * (one["num_layers"] - 1), 1)
        fields.append(ProposalField(encoding, _net(state, f"{name}.mlp_base.1", widths), factor))
    if len(fields) == 1:
        fields *= run.integer("num_proposal_iterations", 2, 1, _ROUNDS_LIMIT)
    return tuple(fields)


def _encoding(state: ModelState, owner: str, key: str, grid: _Grid) -> HashEncoding:
    """Return the hash grid ``owner.key``, whose sizes are those of config.yml."""
    for buffer, said in (("num_levels", grid.levels), ("max_res", grid.finest), ("log2_hashmap_size", grid.log2_size)):
        name = f"{owner}.{buffer}"
        if name in state and (stored := _whole(state[name])) != said:
            raise state.refused(f"found {stored}, config.yml says {said}", name, _PAIR)
    key = f"{owner}.{key}"
    # before the table is read, which may be large
    shape, wanted = getattr(state.get(key), "shape", None), (grid.rows, grid.features)
    if shape is not None and tuple(shape) != wanted:
        raise state.refused(f"a table of {list(shape)}, config.yml says {list(wanted)}", key, _PAIR)
    values = state.float32(key).astype(np.float64)
    sizes = resolutions(grid.levels, grid.coarsest, grid.finest)
    if sizes.min() < 1:
        raise state.refused(f"resolution {sizes.min()}", key, "give a run with a larger base_res")
    return HashEncoding(values.reshape(grid.levels, -1, grid.features), sizes)


def _whole(value: Any) -> Any:
    """Return the number in a tensor of one integer; any other value as it is."""
    if isinstance(value, StoredTensor) and value.kind == "int64" and value.storage is not None and value.shape == ():
        return int(value.storage[value.offset])
    return show(value) if not isinstance(value, np.ndarray) else value.item()


def _refuse_second_table(state: ModelState, key: str, encoding: HashEncoding) -> None:
    """Refuse a table under its second name (nerfstudio/fields/density_fields.py:84) if it has other values."""
    if key not in state:
        return
    if not np.array_equal(state.float32(key).ravel(), encoding.table.ravel()):
        raise state.refused("differs from mlp_base.0.hash_table, which is the same table", key, _PAIR)


def _net(state: ModelState, key: str, widths: tuple[int, ...]) -> DenseNet:
    """Return the network ``key`` with layers of the widths in config.yml."""
    weights, biases = [], []
    for i, shape in enumerate(zip(widths[1:], widths[:-1], strict=True)):
        weight, bias = state.linear(f"{key}.layers.{i}")
        if weight.shape != shape:
            problem = f"found {list(weight.shape)}, config.yml says {list(shape)}"
            raise state.refused(problem, f"{key}.layers.{i}.weight", _PAIR)
        weights.append(weight.astype(np.float64))
        biases.append(bias.astype(np.float64))
    return DenseNet(tuple(weights), tuple(biases))


def _color_net(run: runs.RunConfig, state: ModelState) -> DenseNet:
    """Return the network of colours, with the appearance embedding in its first bias."""
    use, average = (run.flag(f"use_{kind}appearance_embedding", True) for kind in ("", "average_"))
    length = run.integer("appearance_embed_dim", 32, 0, _WIDTH_LIMIT) if use else 0
    width = run.integer("hidden_dim_color", 64, 1, _WIDTH_LIMIT)
    inputs = HARMONICS + FEATURES
    net = _net(state, "field.mlp_head", (inputs + length, width, width, 3))
    if not length:
        return net
    key = "field.embedding_appearance.embedding.weight"
    embeddings = state.float32(key)
    if embeddings.ndim != 2 or embeddings.shape[1] != length or not embeddings.shape[0]:
        raise state.refused(f"found {list(embeddings.shape)}, config.yml says rows of {length}", key, _PAIR)
    first, bias = net.weights[0], net.biases[0]
    if average:
        bias = with_mean(bias, first[:, inputs:], embeddings)
    weights = np.ascontiguousarray(first[:, :inputs]), *net.weights[1:]
    return DenseNet(weights, (bias, *net.biases[1:]))


def with_mean(bias: NDArray[np.float64], weight: NDArray[np.float64], rows: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return ``bias + weight @ rows.mean(axis=0)`` [out], the exact values rounded once.

    Args:
        bias, weight: [out] and [out, n], values of float32.
        rows: [images, n] float32.
    """
    # every float32 is a whole multiple of 2^-149
    sums = [sum(int(math.ldexp(value, 149)) for value in column) for column in rows.T.astype(float).tolist()]
    mean = [Fraction(total, len(rows) << 149) for total in sums]
    exact = [
        Fraction(start) + sum((Fraction(w) * m for w, m in zip(row, mean, strict=True)), Fraction(0))
        for start, row in zip(bias.tolist(), weight.tolist(), strict=True)
    ]
    return np.array([float(value) for value in exact])
