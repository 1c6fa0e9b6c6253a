"""Attacks on the abstract images that refinement ends with."""

from __future__ import annotations

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import pose_set, splat_of
from ns_abstract.bench.tightness import refine
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import compiled_renderer, reference_renderer


def attack(
    job: PathJob, name: str, frame: int, seconds: float, poses: int, reference_poses: int, seed: int,
    scale: float = 1.0, ratio: float = 1.0,
) -> dict[str, object]:  # fmt: skip
    """Refine one frame to ``ratio``, then attack it: random poses, corners, gradient ascent and jumps.

    Gradient ascent goes through the differentiable reference; what it finds is rendered by the compiled renderer.
    The poses that came closest, random ones and corners are then rendered by the reference as well.
    """
    poses_set, splat = pose_set(job, name, frame, scale), splat_of(job)
    result = refine(job, poses_set, frame, seconds, ratio)
    render, probe = compiled_renderer(splat.scene, poses_set, splat.rasteriser)
    other, other_probe, twin = reference_renderer(splat.scene, poses_set, splat.rasteriser)
    first = falsify(result.lower, result.upper, poses_set.box, render, twin, probe=probe, poses=poses, seed=seed)
    second = falsify(
        result.lower, result.upper, poses_set.box, other, twin, probe=other_probe, poses=reference_poses,
        seed=seed + 1, starts=first.closest, strategies=("given", "corners", "random"),
    )  # fmt: skip
    last = result.trace[-1]
    return {
        "scene": job.method.name,
        "size": f"{result.lower.shape[1]}x{result.lower.shape[0]}",
        "program": "{name} {version}".format_map(job.method.program),
        "set": name,
        "ratio": last.mpg / last.mpg_witness if last.mpg_witness else float("nan"),
        "poses": first.poses,
        "reference poses": second.poses,
        "ascent steps": first.steps + second.steps,
        "comparisons": first.comparisons + second.comparisons,
        "violations": first.violations + second.violations,
        "not finite": first.not_finite + second.not_finite,
        "worst": max(first.amount, second.amount),
    }
