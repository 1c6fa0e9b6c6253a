"""Preferences of refinement. They decide how soon bounds are tight; bounds are sound whatever they are."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """How a refinement divides its time and memory.

    Attributes:
        first_motion: Largest image motion (pixels) of a median Gaussian across one initial cell of one parameter.
        first_motions: The same along each of several parameters.
        aim_share: The initial partition of one parameter aims at this part of the excess that the goal allows.
        coarser_share: Where so small a part of the cells that were tried seems enough, a coarser one is tried.
        aim_ratio: It aims at a goal of at least this ratio.
        helpful_share: Halving an initial cell of one parameter helps if it leaves at most this part of the excess.
        clipped_share: Part of the largest possible excess from which on [0, 1] may clip it, so that it does not fall.
        aim_multiple: The initial partition of several parameters aims at so many times the excess that the goal allows.
        helpful_halving: Halving an initial cell of several parameters helps if it leaves at most this part.
        patience: So many halvings together may help as little as one should, where two axes matter as much.
        patient_multiple: They may do so only from so many times the aim on.
        sampled_tiles: From so many tiles on, some of them tell how many initial cells of one parameter are tried first.
        tiles_a_sample: One of so many.
        initial_time_share: Part of the time budget that the initial partition may take.
        most_cell_pictures: A cell may take as long as rendering so many pictures.
        cover_groups: Groups of tiles that are bounded one after another where time may end before all of them are.
        cover_seconds: They get so many seconds at least, or so many more than the rest of the work.
        most_initial_cells: Most cells of the initial partition.
        round_share: Part of the whole excess that one round of splitting takes on.
        looks: Times in a round that the goal is checked.
        wide_split_excess: Excess over what the goal allows from which on cells are cut into the most parts at once.
        closed_share: Part of the allowed excess that a leaf may leave open at a pixel for good.
        narrowest: Cells narrower than this part of the set are not split: rounding rules there.
        least_seconds: Least time that a cell is taken to need.
        most_corners: Most corners of the set that are rendered.
        early_corners: About as many of them are rendered before the initial partition.
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
