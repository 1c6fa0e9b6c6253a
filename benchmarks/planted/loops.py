"""Faults in loops: dynamics, sets of states, controls, verdicts."""

from planted.fault import Fault

_DYNAMICS, _TUBES, _SEARCH, _LOOP = "reach/dynamics.py", "reach/tubes.py", "reach/search.py", "reach/loop.py"
_LEARNED = "reach/learned.py"
_FILE = "test_reach.py::test_a_step_of_a_file_is_enclosed"
_STEP = "test_reach.py::test_a_step_is_enclosed"
_SETS = "test_reach.py::test_affine_sets_hold_their_images"
_CLIP = "test_reach.py::test_a_clip_is_enclosed"
_RUNS = "test_reach.py::test_tubes_hold_every_run"
_VERDICTS = "test_reach.py::test_a_good_controller_is_certified_and_a_bad_one_falsified"
_VIEWS = "test_reach.py::test"
_MARGIN = "test_reach_cli.py::test_scene_margin"

LOOPS = (
    Fault(
        "loops: pictures of a step are those of its middle pose",
        "reach/pictures.py",
        "PropertyView.bound",
        "self.pictures.linear_sets(box)",
        "self.pictures.linear_sets(ParameterBox(box.names, box.units, tuple(box.middle), tuple(box.middle)))",
        f"{_VIEWS}_tubes_hold_margins_of_the_pictures_of_every_run",
    ),
    Fault(
        "loops: a margin that is no number takes no part",
        _SEARCH,
        "SimulatedRun.margin",
        "any(map(_is_nan, clearances))",
        "all(map(_is_nan, clearances))",
        f"{_VIEWS}_pictures_that_are_no_numbers_prove_nothing",
    ),
    Fault(
        "loops: a goal of the end counts at every step",
        _LOOP,
        "Goal.steps",
        'last if self.when == "end" else 0',
        "0",
        f"{_VIEWS}_properties_of_the_picture_are_certified_and_falsified",
    ),
    Fault(
        "loops: required properties are left out of proofs",
        _TUBES,
        "Tube.safe",
        "[*clearances, *self.views[:, : len(loop.required)].ravel()]",
        "clearances",
        f"{_VIEWS}_tubes_hold_margins_of_the_pictures_of_every_run",
    ),
    Fault(
        "scene margin: tubes of a tenth of the radius",
        "api/loop_job.py",
        "LoopJob._varied",
        "kind.variation(radius)",
        "kind.variation(0.1 * radius)",
        _MARGIN,
        compiled=True,
    ),
    Fault(
        "loops: a scene that stands elsewhere is not charged",
        _TUBES,
        "TubeBuilder.poses",
        "self.shift + rounding * size",
        "rounding * size",
        "test_reach.py::test_tubes_hold_runs_in_a_scene_that_stands_elsewhere",
    ),
    Fault(
        "loops: places of the scene that the view tells are not charged",
        _TUBES,
        "TubeBuilder._pose_box",
        "AffineSet(np.zeros(place.size), none, place, pose.first)",
        "AffineSet(np.zeros(place.size), none, 0.0 * place, pose.first)",
        "test_reach.py::test_tubes_hold_runs_in_a_scene_whose_place_the_view_tells",
    ),
    Fault(
        "scene margin: runs see the stored scene",
        _SEARCH,
        "simulate",
        "reacher.view.image(pose, *more)",
        "reacher.view.image(pose)",
        "test_reach.py::test_a_run_sees_the_scene_it_is_given",
    ),
    Fault(
        "loops: quadratic drag curves one way only",
        _DYNAMICS,
        "Forms.signed_square",
        "np.where(low > 0.0, 1.0, -1.0)",
        "np.where(low > 0.0, 1.0, 1.0)",
        _STEP,
    ),
    Fault(
        "loops: states that a file is given are not rounded to float32",
        _LEARNED,
        "LearnedDynamics.bound",
        "STORED_ROUNDING * size + STORED_FLUSH",
        "0.0 * size",
        f"{_FILE}[selection]",
    ),
    Fault(
        "loops: the remainder of states and controls does not pass a file",
        _LEARNED,
        "LearnedDynamics.bound",
        "(radius + room) * STORED_UP",
        "room",
        f"{_FILE}[tanh]",
    ),
    Fault(
        "loops: what lies between planes is one of them",
        _TUBES,
        "between",
        "half + wide",
        "wide",
        f"{_FILE}[relu]",
    ),
    Fault(
        "loops: the remainder of a file's step is left out",
        _TUBES,
        "TubeBuilder._driven",
        "AffineSet(lines.center, lines.slopes, lines.radius, both.first)",
        "AffineSet(lines.center, lines.slopes, 0.0 * lines.radius, both.first)",
        f"{_RUNS}[onnx]",
    ),
    Fault(
        "loops: a map forgets the remainder",
        _TUBES,
        "AffineSet.mapped",
        "self.radius + share * size",
        "share * size",
        _SETS,
    ),
    Fault(
        "loops: dropped symbols are lost",
        _TUBES,
        "AffineSet.promoted",
        "(radius + more) * (1.0 + 2.0 * gamma(len(gone) + 4))",
        "radius",
        _SETS,
    ),
    Fault(
        "loops: a clip is taken for a straight line",
        _TUBES,
        "clipped",
        "slope * raw.radius + half + CLIP_ROUNDING * size",
        "slope * raw.radius",
        _CLIP,
    ),
    Fault(
        "loops: disturbances are left out",
        _TUBES,
        "TubeBuilder._driven",
        "step.radius + wide + added",
        "step.radius + added",
        _RUNS,
    ),
    Fault(
        "loops: a film shows the first step's bounds throughout",
        "reach/film.py",
        "along",
        "reacher.poses(tube.state_sets[step])",
        "reacher.poses(tube.state_sets[0])",
        "test_reach_cli.py::test_a_film_encloses_what_runs_see",
        compiled=True,
    ),
    Fault(
        "loops: a run's margin has the wrong side",
        _LOOP,
        "HalfSpace.exact",
        "sum(terms, start=Fraction(0)) - Fraction(self.offset)",
        "Fraction(self.offset) - sum(terms, start=Fraction(0))",
        _VERDICTS,
    ),
)
