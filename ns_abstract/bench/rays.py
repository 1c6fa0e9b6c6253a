"""Measures cost and tightness of random rays of a NeRF, and attacks the bounds."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import pose_set
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.method import NerfMethod
from ns_abstract.refine.engine import Refinement
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import nerf_renderer


class RaySample(NerfFrame):
    """A sample of a frame's rays, as a picture of one row."""

    def __init__(self, method: NerfMethod, poses: PoseBox, count: int, seed: int) -> None:
        super().__init__(method.scene, method.sampling, poses, method.device)
        chosen = np.sort(np.random.default_rng(seed).permutation(self.tile_count)[:count])
        #: [n, 2] rows and columns.
        self.chosen = np.stack([chosen // self.across, chosen % self.across], axis=1)
        self.camera = replace(self.camera, width=len(chosen), height=1)
        self.across, self.down = len(chosen), 1

    def _pixels(self, tiles: np.ndarray) -> np.ndarray:
        return self.chosen[tiles]


def measure(job: PathJob, name: str, frame: int, scale: float, **options: Any) -> dict[str, object]:
    """Return a row: seconds by ray to a ratio, and attacks by random poses, corners and gradient ascent.

    Args:
        job, name, frame, scale: The scene, and the set of poses (`pose_set`).
        options: ``rays``, ``ratio``, ``seconds``, ``poses`` and ``seed``.

    Raises:
        InputError: The run is not a NeRF.
    """
    if not isinstance(job.method, NerfMethod):
        raise InputError("rays are those of a vanilla NeRF", field="--load-config", fix="give a run of vanilla-nerf")
    poses = pose_set(job, name, frame, scale)
    sample: Any = RaySample(job.method, poses, options["rays"], options["seed"])
    sample.warm_up()
    threads = torch.get_num_threads()
    # threads that wait for one another would count
    torch.set_num_threads(1)
    begun, start = time.perf_counter(), time.process_time()
    refinement = Refinement(sample, frame, job.goal(options["ratio"], options["seconds"]), seed=options["seed"])
    result = refinement.run()
    spent, passed = time.process_time() - start, time.perf_counter() - begun
    torch.set_num_threads(threads)
    _, probe, twin = nerf_renderer(job.method.scene, poses, job.method.sampling)
    chosen = torch.from_numpy(sample.chosen)
    attack = falsify(
        result.lower, result.upper, poses.box,
        lambda values: probe(values, sample.chosen)[None],
        lambda values, pixels: twin(values, chosen[pixels[:, 1]]),
        probe=lambda values, pixels: probe(values, sample.chosen[np.asarray(pixels)[:, 1]]),
        poses=options["poses"], seed=options["seed"],
    )  # fmt: skip
    last = result.trace[-1]
    return {
        "scene": job.method.name,
        "field": job.method.scene.fine.text,
        "device": job.method.device,
        "size": f"{poses.camera.width}x{poses.camera.height}",
        "set": name,
        "scale": scale,
        "rays": sample.tile_count,
        "CPU s / ray": spent / sample.tile_count,
        "s / ray": passed / sample.tile_count,
        "MPG": last.mpg,
        "witness MPG": last.mpg_witness,
        "ratio": last.mpg / last.mpg_witness if last.mpg_witness else float("nan"),
        "cells": result.cells,
        "poses": attack.poses,
        "ascent steps": attack.steps,
        "comparisons": attack.comparisons,
        "violations": attack.violations,
        "not finite": attack.not_finite,
    }
