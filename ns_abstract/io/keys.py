"""Tables of the keys in other programs' files: used, irrelevant to the picture, or refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import show


class Key(NamedTuple):
    """One key of a file.

    Attributes:
        name: Dotted path in the file, or in the section that the table is of.
        status: "used", "irrelevant" (no value changes the evaluated picture) or "refused" (every value but
            ``accepts``).
        why: For what it is used, or why it is irrelevant or refused. Fragments between backquotes stand in the line of
            ``where``.
        where: File and line of Nerfstudio 1.1.5, such as "models/splatfacto.py:588"; "" where that has no such key.
        accepts: Values of a refused key that do not change the picture, and are not refused.
        refuses: Values of a used key that are not supported.
        fix: What a user can do about a refused value.
    """

    name: str
    status: Literal["used", "irrelevant", "refused"]
    why: str
    where: str = ""
    accepts: tuple[Any, ...] = ()
    refuses: tuple[Any, ...] = ()
    fix: str = "give a run that was trained without it"

    def refused(self, value: Any) -> bool:
        """Whether ``value`` of this key is refused."""
        return _among(value, self.refuses) or (self.status == "refused" and not _among(value, self.accepts))


def _plain(value: Any) -> Mapping[str, Any] | None:
    return value if isinstance(value, Mapping) else None


@dataclass(frozen=True)
class KeyTable:
    """The keys of a file or of a section of it. A key that is listed without keys below it covers all below it."""

    title: str
    keys: tuple[Key, ...]

    @cached_property
    def _known(self) -> dict[str, Key]:
        return {key.name: key for key in self.keys}

    @cached_property
    def _sections(self) -> set[str]:
        """Names that have listed keys below them."""
        parts = [key.name.split(".") for key in self.keys]
        return {".".join(names[:k]) for names in parts for k in range(1, len(names))}

    def find(self, name: str) -> Key | None:
        """Return the entry of the dotted ``name`` or of the nearest key above it; None if the table has none."""
        while name not in self._known:
            name, dot, _ = name.rpartition(".")
            if not dot or name in self._sections:
                return None
        return self._known[name]

    def unknown(
        self, section: Mapping[Any, Any], prefix: str = "", mapping: Callable[[Any], Mapping[Any, Any] | None] = _plain
    ) -> list[str]:
        """Return the dotted names of keys of ``section`` that are not in the table.

        ``mapping``: the mapping that a value holds, or None. Raises InputError where a key has a value that is refused.
        """

        def walk(inner: Mapping[Any, Any], above: str) -> Iterator[str]:
            for part, value in inner.items():
                name = above + (part if isinstance(part, str) else show(part))
                key = self._known.get(name)
                if key is not None and key.refused(value):
                    raise InputError(f"found {show(value)}: {key.why}", field=prefix + name, fix=key.fix)
                below = mapping(value) if name in self._sections else None
                if below is not None:
                    yield from walk(below, f"{name}.")
                elif key is None:
                    yield name

        return list(walk(section, ""))


def _among(value: Any, values: Sequence[Any]) -> bool:
    """Whether ``value`` is one of ``values``: same type and equal; texts are compared in lower case."""
    if isinstance(value, str):
        return value.lower() in values
    return any(type(value) is type(other) and value == other for other in values)


def sentence(names: Sequence[str], file: str) -> tuple[str, ...]:
    """Return a note that ``file`` holds unknown keys, which are not used; no note without such keys."""
    if not names:
        return ()
    sorted_names = sorted(dict.fromkeys(names))
    listing = ", ".join(sorted_names[:10]) + (f" and {len(sorted_names) - 10} more" if len(sorted_names) > 10 else "")
    return (f"unknown keys of {file}, which are not used: {listing}",)
