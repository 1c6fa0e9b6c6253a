"""Planted faults in what makes every process one that was checked."""

from planted.fault import Fault

PROCESSES = (
    Fault(
        "processes: a worker's result does not carry what its self-check found",
        "api/job.py",
        "Job.bound_part",
        "replace(refinement.run_part(), problems=platform_problems())",
        "refinement.run_part()",
        "test_processes.py::test_a_faulty_worker_takes_the_guarantee_away",
        compiled=True,
    ),
    Fault(
        "processes: a report keeps its guarantee whatever a worker's self-check found",
        "report/record.py",
        "Report.add",
        "self._without_guarantee(result.problems)",
        "pass",
        "test_processes.py::test_a_report_with_a_faulty_worker_is_sampled",
        compiled=True,
    ),
    Fault(
        "processes: a loop is opened on a worker without the self-check",
        "api/loop_job.py",
        "LoopJob.__init__",
        "require_sound_platform()",
        "pass",
        "test_processes.py::test_a_faulty_worker_reaches_nothing",
        compiled=True,
    ),
    Fault(
        "NeRF: frequencies are of torch's default type",
        "methods/nerf/scene.py",
        "Encoding.frequencies",
        "torch.linspace(self.least, self.most, self.count, dtype=torch.float32)",
        "torch.linspace(self.least, self.most, self.count)",
        "test_processes.py::test_bounds_do_not_depend_on_torchs_default_type",
        compiled=True,
    ),
    Fault(
        "processes: a kernel is compiled although another process of the session compiles it",
        "arithmetic/kernel_cache.py",
        "KernelStore.claim",
        "found is not None or not self.shared or kernel in self._claims",
        "True",
        "test_kernel_cache.py::test_processes_of_one_session_compile_no_kernel_twice",
        compiled=True,
    ),
    Fault(
        "processes: a stage whose kernels are missing counts as compiled",
        "api/compiling.py",
        "missing",
        "found.append(stage)",
        "pass",
        "test_compiling.py::test_stages_are_missing_whose_kernels_are_not_kept",
        compiled=True,
    ),
    Fault(
        "processes: the demo's damaged weights are used",
        "demo/scenes.py",
        "_stored.read",
        "stored != kind or found != wanted or len(found) != len(shape)",
        "False",
        "test_demo_nerf.py::test_damaged_weights_are_refused",
        compiled=True,
    ),
)
