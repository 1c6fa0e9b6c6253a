"""Planted faults, by the part of the package that they lie in."""

from planted.certificates import CERTIFICATES
from planted.depths import DEPTHS
from planted.fault import Fault, apply
from planted.fields import FIELDS
from planted.polynomials import POLYNOMIALS

FAULTS = (*POLYNOMIALS, *FIELDS, *CERTIFICATES, *DEPTHS)

__all__ = ["FAULTS", "Fault", "apply"]
