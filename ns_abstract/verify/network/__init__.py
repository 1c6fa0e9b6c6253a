"""Neural networks behind the image: loaded from files, evaluated, and bounded over sets of images."""

from ns_abstract.verify.network.bounds import bound_outputs
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.image_sets import ImageSets, OutputBounds
from ns_abstract.verify.network.load import load_network
from ns_abstract.verify.network.shared_coefficients import SharedCoefficients, reusable_anywhere

__all__ = [
    "ImageSets",
    "Network",
    "NetworkArithmetic",
    "OutputBounds",
    "SharedCoefficients",
    "bound_outputs",
    "load_network",
    "reusable_anywhere",
]
