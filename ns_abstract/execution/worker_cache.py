"""The cache of a worker process: the scene or network that its tasks use."""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from ns_abstract.io.errors import InputError
from ns_abstract.io.version import VERSION, stale


class Fingerprinted(Protocol):
    """An object that is loaded from files and identified by a fingerprint."""

    @property
    def fingerprint(self) -> Mapping[str, Any]:
        """A mapping that differs wherever the content does."""
        ...


T = TypeVar("T")
F = TypeVar("F", bound=Fingerprinted)


def built(make: Callable[..., F], parts: Sequence[Callable[[], Any]], *arguments: Any, **options: Any) -> F:
    """Return ``make`` of what ``parts`` return and of the other arguments: how a recipe opens an object again."""
    return make(*(part() for part in parts), *arguments, **options)


class LatestValue(Generic[T]):
    """A cache of one value, kept until another key is requested."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: tuple[object, T] | None = None

    def get(self, key: object, make: Callable[[], T]) -> T:
        """Return the value of ``key``, made if it is not cached; the cached value is dropped first."""
        with self._lock:
            if self._held is None or self._held[0] != key:
                self._held = None
                self._held = key, make()
            return self._held[1]

    def clear(self) -> None:
        """Drop the cached value."""
        with self._lock:
            self._held = None


@dataclass(frozen=True)
class Recipe(Generic[F]):
    """A recipe, which can be pickled, to open the same object in another process; errors name ``file``."""

    open: Callable[[], F]
    fingerprint: Mapping[str, Any]
    file: Path

    @cached_property
    def key(self) -> bytes:
        """Bytes that are equal for equal recipes."""
        return hashlib.sha256(pickle.dumps((self.open, self.fingerprint))).digest()


_latest: LatestValue[Any] = LatestValue()


def load(recipe: Recipe[F]) -> F:
    """Return the object of the recipe, loaded once in this process.

    Raises:
        InputError: This process runs another version than the caller's, or reads other files under the same names.
    """

    def make() -> F:
        version = recipe.fingerprint.get("ns_abstract", VERSION)
        if version != VERSION:
            # before the files: another version may not even open them
            raise InputError(
                f"a worker runs ns-abstract {VERSION}, the command that asks it {version}",
                field="--engine",
                fix="install the same version on all machines",
            )
        content = recipe.open()
        if problem := stale(content.fingerprint, recipe.fingerprint):
            raise InputError(
                f"a worker's results would be {problem}",
                field="--engine",
                fix="install the same version on all machines",
            )
        if content.fingerprint != recipe.fingerprint:
            raise InputError(
                "the worker finds other content than this machine",
                file=recipe.file,
                fix="give the workers the same files under the same paths",
            )
        return content

    return _latest.get(recipe.key, make)


def clear_cache() -> None:
    """Drop the cached object of this process."""
    _latest.clear()
