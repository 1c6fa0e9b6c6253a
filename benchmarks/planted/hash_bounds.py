"""Faults in the bounds of hash-grid fields."""

from planted.fault import Fault

_FOLDER, _STEPS = "methods/nerf/hash_bounds/", "test_hash_steps.py::"

HASH_BOUNDS = (
    Fault(
        "hash fields: a product forgets the radii", _FOLDER + "forms.py", "multiply",
        "max(rest, 0.0) + size_a * b[k] + size_b * a[k] + a[k] * b[k]", "max(rest, 0.0)",
        _STEPS + "test_products_and_quotients_of_forms_are_enclosed",
    ),
    Fault(
        "hash fields: kinks of the contraction have one slope", _FOLDER + "points.py", "_at_kinks",
        "0.5 * (jacobian[1, i, k] - jacobian[0, i, k]) * HASH_UP", "0.0",
        _STEPS + "test_kinks_of_the_contraction_are_enclosed",
    ),
    Fault(
        "hash fields: slopes of features beyond a face are left out", _FOLDER + "features.py", "level_features",
        "0.5 * (slopes[1, a] - slopes[0, a]) + TRILINEAR_ROUNDING * size", "TRILINEAR_ROUNDING * size",
        _STEPS + "test_features_are_enclosed_across_faces",
    ),
    Fault(
        "hash fields: a ReLU of unknown sign has no error", _FOLDER + "network.py", "relu",
        "rows[count, j] = error * HASH_UP", "rows[count, j] = 0.0", _STEPS + "test_networks_are_enclosed",
    ),
    Fault(
        "hash fields: the places of samples forget the rests of light", _FOLDER + "distribution.py", "_one_bin",
        "return (followed + rest) * HASH_UP + HASH_PLACE_ROUNDING * (1.0 + abs(scale) * reach)",
        "return 0.5 * followed",
        _STEPS + "test_light_and_places_of_samples_are_enclosed", True,
    ),
    Fault(
        "hash fields: colours forget the rests of depths", _FOLDER + "composition.py", "form_color",
        "rest += times(abs(gain), light.depth[i, n + 3]) + abs(weight) * colors[i, n + 3]", "pass",
        _STEPS + "test_colours_of_rays_are_enclosed", True,
    ),
    Fault(
        "hash fields: an exponential that overflows is followed", _FOLDER + "forms.py", "exp_band",
        "high < _MOST and low <= high", "low <= high", _STEPS + "test_bands_enclose_their_function",
    ),
    Fault(
        "hash fields: shifted colours keep the bounds of those that are not", _FOLDER + "composition.py",
        "shifted_interval_colors", "interval_colors(light, count, room[0], room[1], background, last, out)",
        "interval_colors(light, count, colors[0], colors[1], background, last, out)",
        _STEPS + "test_colours_of_rays_are_enclosed", True,
    ),
    Fault(
        "hash fields: networks end at the second layer", _FOLDER + "network.py", "remaining_layers",
        "weights.sizes.shape[0] - 1", "min(weights.sizes.shape[0] - 1, 2)", _STEPS + "test_networks_are_enclosed",
    ),
)  # fmt: skip
