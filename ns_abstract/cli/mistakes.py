"""Complaints of the parser of options in this project's words."""

from __future__ import annotations

import re

from ns_abstract.io.errors import InputError


def _is(word: str, kind: type) -> bool:
    try:
        kind(word)
    except ValueError:
        return False
    return True


def _value(detail: str) -> tuple[str, str] | None:
    """What stands in place of numbers, and the fix, from tyro's text on a value that cannot be parsed."""
    quoted = re.search(r"(?:from|float:|base 10:|arguments:) (\[.*\]|'.*')", detail)
    words = re.findall(r"'([^']*)'", quoted[1]) if quoted else []
    expected = detail.split(" could be", maxsplit=1)[0]
    numbers = [word for word in words if not _is(word, float)]
    if not words or (quoted and "type" in detail and not re.search("FLOAT|INT", expected)):
        return None
    whole = "INT" in expected or "int()" in detail or (not numbers and "arguments:" in detail)
    bad = (numbers or [word for word in words if not _is(word, int)]) if whole else numbers
    kind = "whole number" if whole else "number"
    count = len(re.findall("FLOAT|INT", expected))
    if "[" in expected:
        fix = f"give {kind}s"
    else:
        fix = f"give {count} {kind}s" if count > 1 else f"give a {kind}"
    return f"found {' '.join(bad or words)}", fix


def mistake(text: str) -> InputError:
    """The error of a complaint, in this project's words where it is one of the usual ones."""
    field, problem, fix = None, text, None
    if (match := re.match(r"Error parsing (--[\w.-]+): (.*)", text)) and (value := _value(match[2])):
        field, (problem, fix) = match[1], value
    elif match := re.match(r"invalid choice '(.*)' for argument '(--[\w.-]+)'. Expected one of \((.*)\)", text):
        field, problem = match[2], f"found {match[1]}"
        fix = "use " + " or ".join(re.findall("'([^']*)'", match[3]))
    elif match := re.match(r"Missing value for argument '(--[\w.-]+)'", text):
        field, problem, fix = match[1], "no value", "give one"
    elif match := re.match(r"Unrecognized options: (.*?)(?:; perhaps (.*))?$", text):
        field = re.split(", |; ", match[1])[0]
        problem = "unknown option" if field.startswith("-") else "is no option's value"
        parts = re.search(r"Available subcommands: (.*)", text)
        fix = f"perhaps {match[2]}" if match[2] else f"use {parts[1]}" if parts else None
    elif match := re.match(r"Expected one of \{(.*)\}", text):
        problem, fix = "no sub-command", f"use {match[1]}"
    return InputError(problem, field=field, fix="; ".join(filter(None, (fix, "--help lists the options"))))
