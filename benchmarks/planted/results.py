"""Faults in what stored results say of themselves, and in what of them is believed."""

from planted.fault import Fault

_VERSION = "io/version.py"

RESULTS = (
    Fault(
        "the fingerprint does not name the version",
        "api/job.py",
        "Job._fingerprint",
        '{**computed_by(), **self.method.fingerprint, **more, "poses": sets.hexdigest()}',
        '{**self.method.fingerprint, **more, "poses": sets.hexdigest()}',
        "test_stale.py::test_fingerprint_of_images_and_numbers_of_rules",
    ),
    Fault(
        "the rules of images are not compared",
        _VERSION,
        "",
        '("ns_abstract", "render_rules", "rules")',
        '("ns_abstract", "rules")',
        "test_stale.py::test_results_are_not_exported[npz-other rules for images]",
    ),
    Fault(
        "a fingerprint without a version passes",
        _VERSION,
        "stale",
        "stored.get(key) == current[key]",
        "stored.get(key, current[key]) == current[key]",
        "test_stale.py::test_results_are_not_exported[png-before versions were written]",
    ),
    Fault(
        "a search of other rules goes on",
        "verify/store.py",
        "Store._check",
        "stale(stored, asked)",
        "None",
        "test_stale.py::test_search_is_not_resumed[other rules of the search]",
    ),
    Fault(
        "a worker of another version opens the files",
        "execution/opening.py",
        "opened.make",
        "asked != VERSION",
        "False",
        "test_stale.py::test_worker_of_another_version_is_refused",
    ),
    Fault(
        "a search's rules stay those of wrong results",
        "api/certification.py",
        "",
        "_RULES = 5",
        "_RULES = 4",
        "test_stale.py::test_fingerprint_of_images_and_numbers_of_rules",
    ),
    Fault(
        "what nobody said is told as an option",
        "api/assumptions.py",
        "choice",
        "default if given is None else flag",
        "flag",
        "test_assumptions.py::test_defaults_and_options_of_a_run",
    ),
    Fault(
        "a network's picture size is told as the camera path's",
        "api/certification.py",
        "Certification.assumptions",
        "drawn.get(entry.name, entry.origin)",
        "entry.origin",
        "test_assumptions.py::test_certificate",
    ),
    Fault(
        "the page shows what files say as markup",
        "report/html.py",
        "_templates",
        """Environment(
            loader=FileSystemLoader(_FOLDER / "templates"),
            autoescape=True,
            trim_blocks=True,
            lstrip_blocks=True,
            undefined=StrictUndefined,
        )""",
        """Environment(
            loader=FileSystemLoader(_FOLDER / "templates"),
            trim_blocks=True,
            lstrip_blocks=True,
            undefined=StrictUndefined,
        )""",
        "test_assumptions.py::test_page_escapes",
    ),
)
