"""Where a choice that shapes the picture came from."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Assumption:
    """One choice that the bounds rest on: its name, its value, and its origin."""

    name: str
    value: str
    origin: str
