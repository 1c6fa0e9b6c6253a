"""Errors that a user can fix; command lines print them as one line and exit with 2."""

from __future__ import annotations

from pathlib import Path


def visible(text: str) -> str:
    """Return ``text`` without characters that a terminal acts upon; Python's escapes stand in their place."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def first_line(error: BaseException) -> str:
    """Return an error's text as one short line, or its type where the text is empty."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else f"{text[:157]}..."


class InputError(ValueError):
    """A file, a field or an option is wrong.

    The message is one line: ``FILE: FIELD: what is wrong; how to mend it``.

    Args:
        problem: What is wrong, in words that name the value found.
        fix: What the user can do about it.
        file: The file the value came from, if any.
        field: Dotted path of the field inside the file, if any.
    """

    def __init__(
        self, problem: str, *, fix: str | None = None, file: str | Path | None = None, field: str | None = None
    ) -> None:
        self.problem = problem
        self.fix = fix
        self.file = None if file is None else str(file)
        self.field = field
        where = [part for part in (self.file, field) if part]
        text = ": ".join([*where, problem])
        if fix:
            text = f"{text}; {fix}"
        super().__init__(visible(" ".join(text.split())))

    def within(self, file: str | Path) -> InputError:
        """Return the same error with ``file`` filled in where it was unknown."""
        if self.file is not None:
            return self
        return InputError(self.problem, fix=self.fix, file=file, field=self.field)
