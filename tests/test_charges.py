"""Every charge for rounding pays for what it names, depends on the arithmetic it is made from, and is needed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from benchmark_scripts import script

from ns_abstract.arithmetic.rounding import FLOAT32, REAL, Arithmetic, Charges, charges
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import Perturbation

ledger = script("ledger")

MEASURED = [name for name in Charges._fields if name not in ledger.UNMEASURED]
#: Values that matter where twice as much is too little to be seen.
CHANGED = {"flush": 1.0, "overflow": 1.0}
CAMERA = PinholeCamera(np.concatenate([np.eye(3), np.zeros((3, 1))], 1), 20.0, 20.0, 8.0, 8.0, 16, 16)


@pytest.mark.slow
@pytest.mark.parametrize("arithmetic", [FLOAT32, REAL], ids=["float32", "real"])
def test_every_charge_pays(arithmetic: Arithmetic) -> None:
    """No error seen is larger than the error charged, and every charge but those named is measured."""
    found = ledger.ratios(arithmetic, charges(arithmetic))
    assert sorted(found) == sorted(MEASURED)
    # errors may add up to the very charge, but for what is of second order
    assert {name: ratio for name, ratio in found.items() if not ratio <= 1.0 + 1e-5} == {}


@pytest.mark.slow_cases(every=20)
@pytest.mark.parametrize("name", MEASURED)
def test_every_charge_is_needed(name: str) -> None:
    """A charge that is left out is missed."""
    without = charges(FLOAT32)._replace(**{name: 0.0})
    assert ledger.ratios(FLOAT32, without, count=12, repeats=2)[name] > 1.0


def scene() -> SplatScene:
    random = np.random.default_rng(0)
    return SplatScene(
        means=np.column_stack([random.uniform(-0.5, 0.5, (6, 2)), random.uniform(-4.0, -2.0, 6)]).astype(np.float32),
        log_scales=np.log(random.uniform(0.05, 0.3, (6, 3))).astype(np.float32),
        quats=random.normal(size=(6, 4)).astype(np.float32),
        opacity_logits=random.uniform(-1.0, 3.0, 6).astype(np.float32),
        sh=random.uniform(-0.5, 0.5, (6, 1, 3)).astype(np.float32),
        rasterize_mode="antialiased",
    )


def bounds_of(arithmetic: Arithmetic) -> bytes:
    poses = PoseBox.around(CAMERA, Perturbation(translation={"x": (-0.01, 0.01)}))
    cell = SplatBounds(activate(scene(), GSPLAT_1_4_0), GSPLAT_1_4_0, arithmetic).cell(
        CAMERA, poses.enclosure(poses.box, 2)
    )
    return cell.lower.tobytes() + cell.upper.tobytes()


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(Arithmetic) if f.name != "name"])
def test_every_field_counts(name: str) -> None:
    """Each figure of an arithmetic has a part in the bounds."""
    other = dataclasses.replace(FLOAT32, **{name: CHANGED.get(name, 2.0 * getattr(FLOAT32, name))})
    assert bounds_of(other) != bounds_of(FLOAT32)
