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
        "api/reaching.py",
        "_open",
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
)
