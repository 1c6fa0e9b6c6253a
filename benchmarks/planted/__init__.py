"""Planted faults, by the part of the package that they lie in."""

from planted.boxes import BOXES
from planted.certificates import CERTIFICATES
from planted.checks import CHECKS
from planted.depths import DEPTHS
from planted.differences import DIFFERENCES
from planted.fault import Fault, apply
from planted.fields import FIELDS
from planted.files import FILES
from planted.forms import FORMS
from planted.hash_bounds import HASH_BOUNDS
from planted.hash_fields import HASH_FIELDS
from planted.inputs import INPUTS
from planted.location import LOCATION
from planted.loops import LOOPS
from planted.maps import MAPS
from planted.network_rows import NETWORK_ROWS
from planted.networks import NETWORKS
from planted.pictures import PICTURES
from planted.polynomials import POLYNOMIALS
from planted.processes import PROCESSES
from planted.results import RESULTS
from planted.scenes import SCENES
from planted.splats import SPLATS
from planted.verdicts import VERDICTS

FAULTS = (
    *FORMS, *POLYNOMIALS, *FIELDS, *VERDICTS, *CERTIFICATES, *SPLATS, *DEPTHS, *LOOPS, *CHECKS,
    *INPUTS, *NETWORKS, *NETWORK_ROWS, *PROCESSES, *RESULTS, *SCENES, *MAPS, *DIFFERENCES,
    *PICTURES, *LOCATION, *FILES, *HASH_FIELDS, *HASH_BOUNDS, *BOXES,
)  # fmt: skip

__all__ = ["FAULTS", "Fault", "apply"]
