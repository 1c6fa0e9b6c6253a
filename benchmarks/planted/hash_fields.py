"""Faults in what is read and rendered of nerfacto."""

from planted.fault import Fault

_FEATURES, _WEIGHTS = "methods/nerf/hash_bounds/features.py", "methods/nerf/render.py"
_LOAD, _RENDER = (f"methods/nerf/nerfacto_{part}.py" for part in ("load", "render"))
_RESOLUTIONS = "test_nerfacto.py::test_resolutions_are_rounded_down_in_float32"
_HASH = "test_nerfacto.py::test_corners_have_the_rows_of_the_hash"
_EDGES = "test_nerfacto.py::test_edges_are_quantiles_of_padded_weights"
_HARMONICS = "test_nerfacto.py::test_harmonics_are_of_shifted_directions"
_PICTURE = "test_nerfacto.py::test_empty_rays_show_the_last_samples_colour"

HASH_FIELDS = (
    Fault(
        "nerfacto: resolutions are rounded to the nearest",
        _LOAD, "resolutions", "torch.floor(coarsest * powers)", "torch.round(coarsest * powers)", _RESOLUTIONS,
    ),
    Fault(
        "nerfacto: resolutions are computed in float64",
        _LOAD, "resolutions",
        "torch.pow(torch.tensor(_growth(levels, coarsest, finest)).float(), torch.arange(levels).float())",
        "torch.tensor([_growth(levels, coarsest, finest) ** k for k in range(levels)], dtype=torch.float64)",
        _RESOLUTIONS,
    ),
    Fault(
        "nerfacto: the hash has the primes of y and z exchanged",
        _FEATURES, "hash_row", "x ^ (y * PRIME_Y) ^ (z * PRIME_Z)", "x ^ (y * PRIME_Z) ^ (z * PRIME_Y)", _HASH,
    ),
    Fault(
        "nerfacto: weights are not padded before edges are placed",
        _RENDER, "next_places", "weights + HISTOGRAM_PADDING", "weights + 1e-9", _EDGES,
    ),
    Fault(
        "nerfacto: harmonics are of the direction itself",
        _RENDER, "harmonics", "(direction + 1.0) / 2.0", "direction", _HARMONICS,
    ),
    Fault(
        "nerfacto: edges lie at the quantiles j / n",
        _RENDER, "quantiles", "even(1.0 - 1.0 / edges, edges) + 1.0 / (2 * edges)", "even(1.0 - 1.0 / edges, edges)",
        _EDGES,
    ),
    Fault(
        "nerfacto: the last sample's colour is forgotten where it has no weight",
        _RENDER, "NerfactoRenderer.colors", "seen[:, -1] |= isinstance(f.background, str)", "pass", _PICTURE,
    ),
    Fault(
        "nerfacto: an interval of no length and infinite density has no number for a weight",
        _WEIGHTS, "interval_weights", "torch.nan_to_num((1.0 - torch.exp(-depth)) * torch.exp(-before))",
        "(1.0 - torch.exp(-depth)) * torch.exp(-before)",
        "test_nerfacto.py::test_weights_of_overflowing_densities_are_numbers",
    ),
    Fault(
        "nerfacto: the mean embedding is left out",
        _LOAD, "with_mean", "Fraction(total, len(rows) << 149)", "Fraction(0)",
        "test_nerfacto.py::test_the_mean_embedding_is_rounded_once",
    ),
    Fault(
        "nerfacto: a proposal's second table is not compared",
        _LOAD, "_refuse_second_table", "key not in state", "True",
        "test_nerfacto.py::test_damaged_checkpoints[<lambda>-differs]",
    ),
)  # fmt: skip
