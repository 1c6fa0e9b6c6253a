"""gsplat's formulas, operation by operation in IEEE float32, lie inside the float32 bounds."""

import numpy as np
import pytest

from ns_abstract.arithmetic.rounding import FLOAT32
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import Perturbation

f = np.float32
ONE, TWO, HALF = f(1), f(2), f(0.5)
SIDE, FOCAL = 32, 100.0
CAMERA = PinholeCamera(np.concatenate([np.eye(3), np.zeros((3, 1))], 1), FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE)


def product(a, b):
    """[i, j] sums from left to right, as the compiled loops of glm."""

    def entry(i, j):
        return a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]

    return np.array([[entry(i, j) for j in range(b.shape[1])] for i in range(len(a))], f)


def pixel(mean, log_scales, quat, logit, color, compensated, column, row):
    """One pixel of one Gaussian on black: utils.cuh and rasterize_to_pixels_fwd.cu in float32."""
    inverse = ONE / np.sqrt(quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3] + quat[0] * quat[0])
    w, x, y, z = (q * inverse for q in quat)
    turn = np.array(
        [
            [ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)],
            [TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)],
            [TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)],
        ],
        f,
    )
    axes = turn * np.exp(log_scales)
    flip = np.diag([1, -1, -1]).astype(f)
    covariance = product(product(flip, product(axes, axes.T)), flip.T)
    x, y, z = flip @ mean
    focal, rz = f(FOCAL), ONE / z
    tx, ty = z * (x * rz), z * (y * rz)
    jacobian = np.array([[focal * rz, 0, -focal * tx * (rz * rz)], [0, focal * rz, -focal * ty * (rz * rz)]], f)
    s = product(product(jacobian, covariance), jacobian.T)
    mean_x, mean_y = focal * x * rz + f(SIDE / 2), focal * y * rz + f(SIDE / 2)
    det_before = s[0, 0] * s[1, 1] - s[0, 1] * s[1, 0]
    a, c = s[0, 0] + f(0.3), s[1, 1] + f(0.3)
    det = a * c - s[0, 1] * s[1, 0]
    opacity = ONE / (ONE + np.exp(-logit))
    if compensated:
        opacity = opacity * np.sqrt(max(f(0), det_before / det))
    inverse = ONE / det
    dx, dy = mean_x - f(column + 0.5), mean_y - f(row + 0.5)
    sigma = HALF * (c * inverse * dx * dx + a * inverse * dy * dy) + -s[0, 1] * inverse * dx * dy
    alpha = min(f(0.999), opacity * np.exp(-sigma))
    if sigma < 0 or alpha < ONE / f(255):
        return 0.0
    return float(color / (ONE + np.exp(-f(8))) * alpha)


#: Powers of ten of the standard deviations in pixels, least and most by axis, and how wide most bounds may be.
SHAPES = {
    "needles": (((0, 2), (-2.2, -1), (-2.2, -1)), 1e-2),
    "long needles": (((1.8, 2.2), (-2.2, -1), (-2.2, -1)), 0.1),
    "huge": (((2.8, 3.5), (1.3, 1.7), (1.3, 1.7)), 1e-2),
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("compensated", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_single_gaussian(compensated, shape):
    random = np.random.default_rng(3)
    poses = PoseBox.around(CAMERA, Perturbation())
    checked = 0
    for _ in range(150):
        z = random.uniform(1, 4)
        powers, wide = SHAPES[shape]
        log_scales = np.log([z / FOCAL * 10 ** random.uniform(*p) for p in powers]).astype(f)
        quat = random.normal(size=4).astype(f)
        mean = np.array([0.5 * z / FOCAL, -0.5 * z / FOCAL, -z]).astype(f)
        scene = SplatScene(
            means=mean[None],
            log_scales=log_scales[None],
            quats=quat[None],
            opacity_logits=np.array([1.0], f),
            sh=np.full((1, 1, 3), 8.0, f),
            color_model="sigmoid",
            rasterize_mode="antialiased" if compensated else "classic",
        )
        bounds = SplatBounds(activate(scene, GSPLAT_1_4_0), GSPLAT_1_4_0, FLOAT32)
        cell = bounds.cell(CAMERA, poses.enclosure(poses.box, 1), wanted=np.array([3]))
        for column, row in ((16, 16), (18, 17)):
            value = pixel(mean, log_scales, quat, f(1), ONE, compensated, column, row)
            low, high = cell.lower[0, row - 16, column - 16, 0], cell.upper[0, row - 16, column - 16, 0]
            assert low <= value <= high
            checked += high - low < wide
    # bounds that say nothing would pass
    assert checked > 50
