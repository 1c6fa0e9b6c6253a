"""Neural networks behind the image: loaded from files, evaluated, and bounded over sets of images."""

from ns_abstract.verify.network.bounds import bound_outputs
from ns_abstract.verify.network.family import Family, lends_anywhere
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.load import load_network
from ns_abstract.verify.network.sets import ImageSets, OutputBounds, Substitution

__all__ = [
    "Family",
    "ImageSets",
    "Network",
    "NetworkArithmetic",
    "OutputBounds",
    "Substitution",
    "bound_outputs",
    "lends_anywhere",
    "load_network",
]
