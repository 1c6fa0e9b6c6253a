"""Assumptions: choices that shape the picture, with their origin."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Assumption:
    """One choice that the bounds rest on: its name, its value, and its origin."""

    name: str
    value: str
    origin: str
