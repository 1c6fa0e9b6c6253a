"""Arithmetic and rules of bounding."""

# before any kernel is defined
from ns_abstract.arithmetic import kernel_cache as kernel_cache
