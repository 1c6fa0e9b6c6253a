"""Help texts of the commands: options in groups with type and default once, examples, wrapped to the terminal."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import shutil
import textwrap
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from ns_abstract.cli.examples import EXAMPLES
from ns_abstract.io.version import VERSION

#: Options by group, in the order in which they are shown; what is not here is "results and effort".
_GROUPS = {
    "scene": (
        "load_config", "other", "renderer", "gsplat_version", "arithmetic", "rasterize_mode", "background", "load_step",
        "assume_splatfacto", "drop_nan_gaussians",
    ),
    "set of poses": (
        "camera_path_filename", "perturbation_filename", "translation", "rotation", "units", "angle_units", "frames",
        "downscale_factor",
    ),
    "results and effort": (),
    "NeRF": ("sampling", "num_samples", "near_plane", "occupancy_grid", "device"),
    "cluster": ("engine", "scheduler_address", "workers", "tls_ca_file", "tls_cert", "tls_key"),
}  # fmt: skip
_GROUP_OF = {name: group for group, names in _GROUPS.items() for name in names}
_REST = "results and effort"
_TYPES: dict[Any, str] = {float: "NUMBER", int: "INTEGER", Path: "PATH", str: "TEXT"}
_MOST_COLUMNS = 100


def _sources(kind: type) -> dict[str, str]:
    """Return the text below each field of a dataclass, and of its bases."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, below in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
                if isinstance(below.value, ast.Constant) and isinstance(below.value.value, str):
                    texts[field.target.id] = " ".join(below.value.value.split())
    return texts


def _plain(hint: Any) -> Any:
    """Return a type without annotations and None."""
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    if get_origin(hint) in (Union, types.UnionType):
        rest = [part for part in get_args(hint) if part is not type(None)]
        hint = _plain(rest[0]) if len(rest) == 1 else hint
    return hint


def _value(hint: Any, flags: bool = True) -> str:
    """Return the placeholder of an option's value, from its type ``hint``; "" for a bool if ``flags`` take no value."""
    hint = _plain(hint)
    parts = get_args(hint)
    if get_origin(hint) is Literal:
        return "{" + ",".join(map(str, parts)) + "}"
    if get_origin(hint) is tuple:
        inner = _value(parts[0])
        return f"{inner} ..." if len(parts) == 2 and parts[1] is Ellipsis else " ".join([inner] * len(parts))
    if hint is bool:
        return "" if flags else "{True,False}"
    return _TYPES.get(hint, "VALUE")


def _default(field: dataclasses.Field[Any], given: Any, text: str) -> str:
    """Return the default of an option as text, unless the option's own text has it."""
    value = field.default if given is None else getattr(given, field.name)
    if given is None and field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    if value is dataclasses.MISSING or value is tyro.MISSING:
        return "Required."
    if value is None or value is False or value == () or "efault" in text:
        return ""
    words = (
        " ".join(map(str, value)) if isinstance(value, tuple) else f"{value:g}" if isinstance(value, float) else value
    )
    return f"Default: {'yes' if value is True else words}."


@dataclasses.dataclass(frozen=True)
class _Option:
    name: str
    value: str
    text: str
    group: str
    required: bool
    positional: bool


def _options(kind: type, given: Any = None, flags: bool = True) -> Iterator[_Option]:
    """Return the options of a command's dataclass, those of its parts included."""
    texts, hints = _sources(kind), get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint = _plain(hints[field.name])
        if dataclasses.is_dataclass(hint):
            prefix = "" if "name=''" in str(hints[field.name]).replace('"', "'") else f"{field.name}."
            inner = getattr(given, field.name) if given is not None else None
            if inner is None and field.default_factory is not dataclasses.MISSING:
                inner = field.default_factory()
            for option in _options(hint, inner, flags):  # pyright: ignore[reportArgumentType]
                yield dataclasses.replace(option, name=prefix + option.name) if prefix else option
            continue
        text = texts.get(field.name, "")
        default = _default(field, given, text)
        positional = tyro.conf.Positional in getattr(hints[field.name], "__metadata__", ()) or "Positional" in str(
            hints[field.name]
        )
        yield _Option(
            field.name,
            _value(hints[field.name], flags),
            f"{text} {default}".strip(),
            _GROUP_OF.get(field.name, _REST),
            default == "Required.",
            positional,
        )


def _flag(option: _Option) -> str:
    name = option.name.upper() if option.positional else "--" + option.name.replace("_", "-")
    return name if option.positional else f"{name} {option.value}".strip()


def _wrapped(text: str, width: int, indent: str = "") -> str:
    return "\n".join(
        textwrap.fill(part, width, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
        for part in text.split("\n")
    )


def _paragraphs(kind: type, width: int) -> str:
    parts = re.split(r"\n\s*\n", inspect.cleandoc(kind.__doc__ or ""))
    return "\n\n".join(_wrapped(" ".join(part.split()), width) for part in parts)


def _examples(program: str, width: int) -> str:
    examples = EXAMPLES.get(program, ())
    lines = []
    for text, command in examples:
        lines += [_wrapped(text, width, "  # "), _command(f"{program} {command}", width)]
    return "\n".join(["", "examples:", *lines]) if lines else ""


def _command(text: str, width: int) -> str:
    """Return the lines of a command that can be pasted."""
    lines = textwrap.wrap(text, width - 8, break_long_words=False, break_on_hyphens=False)
    return " \\\n".join(f"  {line}" if k == 0 else f"      {line}" for k, line in enumerate(lines))


def columns() -> int:
    return min(_MOST_COLUMNS, shutil.get_terminal_size().columns)


def command_help(program: str, kind: type, given: Any = None) -> str:
    """Return the help on a command whose options are a dataclass; ``given`` has other defaults."""
    flags = "FlagConversionOff" not in str(kind)
    kind, width = _plain(kind), columns()
    options = list(_options(kind, given, flags))
    usage = [f"usage: {program}", *(_flag(o) for o in options if o.required), "[options]"]
    lines = [_paragraphs(kind, width), "", _wrapped(" ".join(usage), width)]
    lines += [examples] if (examples := _examples(program, width)) else []
    for group in _GROUPS:
        members = [option for option in options if option.group == group]
        # what is required comes first
        members.sort(key=lambda option: not option.required)
        if members:
            lines += ["", f"{group}:" if any(o.group != group for o in options) else "options:"]
        for option in members:
            lines += [f"  {_flag(option)}", _wrapped(option.text, width, "      ")]
    lines += ["", "  --version, -h, --help"]
    return "\n".join(lines)


def parts_help(program: str, parts: Mapping[str, Any], about: str) -> str:
    """Return the help on a command with sub-commands: what each does."""
    width, wide = columns(), max(map(len, parts))
    lines = [_wrapped(about, width), "", f"usage: {program} NAME [options]", _examples(program, width), "", "names:"]
    for name, part in parts.items():
        kind = part if isinstance(part, type) else type(part)
        summary = inspect.cleandoc(kind.__doc__ or "").split("\n\n")[0]
        indent = " " * (wide + 4)
        text = _wrapped(" ".join(summary.split()), width, indent)
        lines.append(f"  {name:{wide}}  {text[len(indent) :]}")
    return "\n".join([*lines, "", _wrapped(f"{program} NAME --help lists the options of one.", width)])


def help_page(program: str, kind: Any, words: list[str], parts: Mapping[str, Any], about: str) -> str | None:
    """Return the text that ``words`` of a command line request, its version or help, or None."""
    if "--version" in words:
        return f"{program} {VERSION}"
    if not {"-h", "--help"} & set(words):
        return None
    if not parts:
        return command_help(program, kind)
    part = parts.get(words[0])
    if part is None:
        return parts_help(program, parts, about)
    defaults = None if isinstance(part, type) else part
    return command_help(f"{program} {words[0]}", part if defaults is None else type(part), defaults)
