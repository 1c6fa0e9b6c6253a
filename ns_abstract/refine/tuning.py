"""Preferences of refinement: they affect how soon bounds are tight, never whether they are sound."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """How a refinement divides its time and memory. "Excess" is MPG beyond the witness MPG.

    Attributes:
        first_motion: Largest image motion (pixels) of a median Gaussian across one initial cell of one parameter.
        first_motions: The same along each of several parameters.
        aim_share: The initial partition of one parameter aims at this fraction of the allowed excess.
        coarser_share: Where this small a fraction of the tried cells seems enough, a coarser partition is tried.
        aim_ratio: Least target ratio that the initial partition aims at.
        helpful_share: Halving an initial cell of one parameter helps if it leaves at most this fraction of the excess.
        clipped_share: From this fraction of the largest possible excess on, [0, 1] may clip it, so it does not fall.
        aim_multiple: The initial partition of several parameters aims at this multiple of the allowed excess.
        helpful_halving: Halving an initial cell of several parameters helps if it leaves at most this fraction.
        patience: Number of halvings that together may help as little as one, where two axes matter as much.
        patient_multiple: They may do so only above this multiple of the aim.
        sampled_tiles: From this many tiles on, the initial cells of one parameter are chosen by a sample of tiles.
        tiles_a_sample: One of this many tiles is sampled.
        initial_time_share: Fraction of the time budget that the initial partition may take.
        most_cell_pictures: A cell is expected to take at most the time of this many renders.
        cover_groups: Groups of tiles that are bounded one after another where time may end before all are.
        cover_seconds: They get at least this many seconds, or as many more than the rest of the work.
        most_initial_cells: Largest number of cells of the initial partition.
        round_share: Fraction of the whole excess that one round of splitting handles.
        looks: How often the goal is checked in a round.
        wide_split_excess: From this excess over the allowed one on, cells are cut into the most parts at once.
        closed_share: Fraction of the allowed excess that a leaf may leave open at a pixel for good.
        narrowest: Cells narrower than this fraction of the set are not split: rounding dominates there.
        least_seconds: Least time that a cell is assumed to need.
        most_corners: Largest number of rendered corners of the set.
        early_corners: About this many of them are rendered before the initial partition.
        scene_samples: Other scenes of the set that are rendered at the middle.
        scene_samples_by_pose: The same at every other rendered pose.
        first_points: Points of the trace for the first initial cells, one each.
        initial_points: Points of the trace for the whole initial partition.
        views: Poses rendered across the range of one parameter where linear sets are kept.
        axis_views: The same along each axis of several.
    """

    first_motion: float = 0.5
    first_motions: float = 0.6
    aim_share: float = 0.6
    coarser_share: float = 0.75
    aim_ratio: float = 1.05
    helpful_share: float = 0.5
    clipped_share: float = 0.25
    aim_multiple: float = 3.0
    helpful_halving: float = 0.8
    patience: int = 2
    patient_multiple: float = 1.6
    sampled_tiles: int = 4096
    tiles_a_sample: int = 8
    initial_time_share: float = 0.7
    most_cell_pictures: float = 100.0
    cover_groups: int = 32
    cover_seconds: float = 2.0
    most_initial_cells: int = 4096
    round_share: float = 0.8
    looks: int = 16
    wide_split_excess: float = 4.0
    closed_share: float = 0.25
    narrowest: float = 2.0**-40
    least_seconds: float = 1e-4
    most_corners: int = 64
    early_corners: int = 4
    scene_samples: int = 48
    scene_samples_by_pose: int = 2
    first_points: int = 8
    initial_points: int = 32
    views: int = 9
    axis_views: int = 4


TUNING = Tuning()
