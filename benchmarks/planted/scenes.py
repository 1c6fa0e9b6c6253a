"""Faults in reading scene files: another picture than the one that the files say."""

from planted.fault import Fault

_RUNS, _HEADER, _READ = "methods/runs.py", "methods/splat/ply_header.py", "methods/splat/load.py"
_LOAD, _ROWS = "methods/splat/load.py", "methods/splat/drawable.py"
_FILES = "test_scene_files.py::"

SCENES = (
    Fault(
        "scenes: units of a data set that the scene does not state are normalised ones",
        "perturbation/specification.py", "unit_length",
        "dataset_scale is None", "(dataset_scale := dataset_scale or 1.0) is None",
        "test_perturbation.py::test_dataset_units_that_no_scene_states_are_refused",
    ),
    Fault(
        "scenes: units leave out the scale of the data set's matrix",
        "geometry/transform.py", "DataparserTransform.stated_scale", "self.scale * length", "self.scale",
        _FILES.replace("files", "values") + "test_units_of_a_data_set_hold_the_scale_of_its_matrix",
    ),
    Fault(
        "scenes: arguments of an object of config.yml are left out",
        "methods/runs.py", "as_mapping", "not any(part for key, part in inner.items() if key != \"state\")", "True",
        "test_load.py::test_bad_config[a model with arguments]",
    ),
    Fault(
        "scenes: a run without its transform states units",
        "methods/runs.py", "read_dataparser_transform", "DataparserTransform(stated=False)", "DataparserTransform()",
        _FILES.replace("files", "values") + "test_units_of_a_data_set_need_the_run_to_state_them[run]",
    ),
    Fault(
        "scenes: reports name files of a property as they are later",
        "api/frame_pictures.py", "PropertySource._digest", "self.digests.get(digests.key(file))", "None",
        "test_fingerprints.py::test_reports_name_the_files_of_a_property_that_were_read[index.txt]",
    ),
    Fault(
        "scenes: a checkpoint sets the attributes of its tensors",
        "methods/checkpoint_pickle.py", "_Stack.state",
        "isinstance(target, (dict, Placeholder))", "vars(target).update(_) is None",
        "test_load.py::test_hostile_index[attributes of a tensor]",
    ),
    Fault(
        "scenes: the configuration's step is not read",
        _RUNS, "find_checkpoint", "load_step(run) if step is None else step", "step",
        _FILES + "test_a_nerf_is_of_the_step_of_the_configuration",
    ),
    Fault(
        "scenes: a step's longer name comes before the one that Nerfstudio reads",
        _RUNS, "find_checkpoint", "(name != f'step-{taken:09d}.ckpt', -len(name), name)", "(-len(name), name)",
        _FILES + "test_the_name_that_nerfstudio_writes_comes_first",
    ),
    Fault(
        "scenes: the first comment about the mode wins",
        _HEADER, "_comments", "options.get(value)", "(mode or options.get(value))",
        _FILES + "test_comments_say_the_mode[False-the last one is default]",
    ),
    Fault(
        "scenes: comments in capitals are not read",
        _HEADER, "_comments", "re.IGNORECASE", "re.ASCII",
        _FILES + "test_comments_say_the_mode[False-capitals]",
    ),
    Fault(
        "scenes: the 3-D filter leaves opacities as they are",
        _READ, "filtered", "weight / (1.0 + np.exp(-opacity_logits.astype(np.float64)))",
        "1.0 / (1.0 + np.exp(-opacity_logits.astype(np.float64)))",
        _FILES + "test_the_filter_of_mip_splatting_is_applied",
    ),
    Fault(
        "scenes: another model's class is taken for Splatfacto",
        _LOAD, "_check_model", "not assumed and name and name not in _CLASSES", "False",
        _FILES + "test_another_class_is_refused_unless_it_is_declared[changes0-sea.WaterModel]",
    ),
    Fault(
        "scenes: modules that draw more are left out in silence",
        _LOAD, "_check_model", "not assumed and unknown", "False",
        _FILES + "test_unknown_modules_are_refused_unless_they_are_declared[medium_mlp.bias]",
    ),
    Fault(
        "scenes: a bound of the Gaussians alone is said to be of the picture",
        _LOAD, "_check_model", "bool(unknown) or bool(name and name not in _CLASSES)", "False",
        _FILES + "test_unknown_modules_are_refused_unless_they_are_declared[exposure]",
    ),
    Fault(
        "scenes: tensors that a NeRF does not have are left out in silence",
        "methods/nerf/model_state.py", "ModelState.refuse_unread",
        "key not in self.read and not key.startswith(tuple(_IDLE))", "False",
        _FILES + "test_a_nerf_of_another_class_or_with_more_is_refused[changes1-edits1-medium.weight]",
    ),
    Fault(
        "scenes: Gaussians of a NaN opacity are left out unasked",
        _ROWS, "drawable", "~_all(~np.isnan(rows.log_scales))",
        "(~_all(~np.isnan(rows.log_scales)) | np.isnan(rows.opacity_logits))",
        "test_scene_values.py::test_gaussians_that_would_be_drawn_are_left_out_where_that_is_asked_for[opacity NaN]",
    ),
    Fault(
        "scenes: workers read the scene without what was given",
        "api/scenes.py", "SceneSource.absolute",
        "replace(self, file=self.file.absolute(), options=replace(self.options, occupancy_grid=grid))",
        "SceneSource(self.file.absolute(), replace(self.options, occupancy_grid=grid))",
        _FILES + "test_workers_and_continued_results_see_what_was_given",
    ),
)  # fmt: skip
