"""Help and complaints of the commands: every option once and in a group, examples that parse, our own words."""

from __future__ import annotations

import dataclasses
import importlib
import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import tyro
from test_architecture import project

from ns_abstract.cli import bench, export, help
from ns_abstract.cli.common import mistake
from ns_abstract.cli.examples import EXAMPLES
from ns_abstract.io.version import VERSION

SCRIPTS: dict[str, str] = project()["scripts"]
PARTS = {"ns-abstract-bench": bench._DEFAULTS, "ns-abstract-export": export._PARTS}
#: Every command line that has help of its own.
HELPS = [(name,) for name in SCRIPTS] + [(name, part) for name, parts in PARTS.items() for part in parts]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def run(program: str, *words: str) -> tuple[int, str, str]:
        module, _, name = SCRIPTS[program].partition(":")
        monkeypatch.setattr(sys, "argv", [program, *words])
        with pytest.raises(SystemExit) as leave:
            getattr(importlib.import_module(module), name)()
        found = capsys.readouterr()
        return int(leave.value.code or 0), found.out, found.err

    return run


def option_names(kind: Any) -> list[str]:
    """Fields of a command, as its dataclass has them."""
    names = []
    for field in dataclasses.fields(kind):
        hint = help._plain(get_type_hints(kind, include_extras=True)[field.name])
        if not dataclasses.is_dataclass(hint):
            names.append(field.name)
        elif field.name == "viewer":
            names += [f"viewer.{inner}" for inner in option_names(hint)]
        else:
            names += option_names(hint)
    return names


@pytest.mark.parametrize("words", HELPS, ids=" ".join)
def test_help_has_every_option_once(
    words: tuple[str, ...], call: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Any] = []
    monkeypatch.setattr(help, "command_help", lambda *given: read.append(given) or made(*given))
    made = COMMAND_HELP
    monkeypatch.setenv("COLUMNS", "80")
    code, text, said = call(*words, "--help")
    assert code == 0 and said == "" and max(map(len, text.splitlines())) <= 80
    assert "tyro" not in text and "{None}" not in text and "(default:" not in text
    if not read:
        assert all(re.search(rf"(?m)^  {part} +[A-Z]", text) for part in PARTS[words[0]])
        return
    kind = help._plain(read[0][1])
    shown = re.findall(r"(?m)^  --([a-z][\w.-]*|[\w.]+)\b|^  ([A-Z_]{4,})$", text)
    names = [(a or b).lower().replace("-", "_") for a, b in shown]
    assert sorted(n for n in names if n != "version") == sorted(option_names(kind))
    for line, below in zip(text.splitlines(), text.splitlines()[1:], strict=False):
        if re.match(r"  (--[a-z]|[A-Z_]{4,}$)", line) and "--version" not in line:
            assert re.match(r"      \S", below), line


COMMAND_HELP = help.command_help


@pytest.mark.parametrize("program", SCRIPTS)
def test_version(program: str, call: Callable[..., tuple[int, str, str]]) -> None:
    assert call(program, "--version") == (0, f"{program} {VERSION}\n", "")


@pytest.mark.parametrize("program", SCRIPTS)
def test_examples_parse(
    program: str, call: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    examples = EXAMPLES[program]
    assert len(examples) == 3
    _, text, _ = call(program, "--help")
    for about, example in examples:
        assert about in " ".join(text.split()).replace(" # ", " ") or about in text
        parsed: list[Any] = []
        module = importlib.import_module(SCRIPTS[program].partition(":")[0])

        def run(main: Any, options: Callable[[], Any], relief: str = "", parsed: list[Any] = parsed) -> None:
            parsed.append(options())
            raise SystemExit(0)

        monkeypatch.setattr(module, "run", run)
        code, _, said = call(program, *shlex.split(example))
        monkeypatch.undo()
        assert code == 0 and len(parsed) == 1, (example, said)


def test_groups(call: Callable[..., tuple[int, str, str]]) -> None:
    _, text, _ = call("ns-abstract-render", "--help")
    heads = re.findall(r"(?m)^([A-Za-z][\w ]+):$", text)
    assert heads == ["examples", "scene", "set of poses", "results and effort", "NeRF", "cluster"]
    groups = dict(zip(heads, re.split(r"(?m)^[A-Za-z][\w ]+:$", text)[1:], strict=True))
    assert "--load-config" in groups["scene"] and "--rotation" in groups["set of poses"]
    assert "--time-budget" in groups["results and effort"] and "--num-samples" in groups["NeRF"]
    assert "--scheduler-address" in groups["cluster"]
    assert "one number for all three axes of the camera, or three for x, y, z" in " ".join(text.split())


@dataclasses.dataclass
class Numbers:
    """Options of all kinds."""

    one: float = 1.0
    whole: int = 1
    maybe: float | None = None
    some: tuple[float, ...] | None = None
    frames: tuple[int, ...] = ()
    color: tuple[float, float, float] | None = None
    word: str = "a"
    path: Path = Path("a")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--one abc", "--one: found abc; give a number;"),
        ("--whole 1.5", "--whole: found 1.5; give a whole number;"),
        ("--maybe 1,5", "--maybe: found 1,5; give a number;"),
        ("--some 1 b 2", "--some: found b; give numbers;"),
        ("--frames 1 2.5", "--frames: found 2.5; give whole numbers;"),
        ("--color 1 2", "--color: found 1 2; give 3 numbers;"),
        ("--one", "--one: no value; give one;"),
        ("--oen 1", "--oen: unknown option; perhaps --one;"),
        ("stray", "stray: is no option's value;"),
    ],
)
def test_mistyped_values_are_answered_in_our_words(
    words: str, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from ns_abstract.cli.common import command, run

    monkeypatch.setattr(sys, "argv", ["numbers", *words.split()])
    with pytest.raises(SystemExit) as leave:
        run(lambda options: 0, command("numbers", Numbers))
    said = capsys.readouterr().err
    assert leave.value.code == 2 and said.count("\n") == 1
    assert said.startswith(f"error: {text}"), said
    assert not re.search(r"FLOAT|INT|\{None\}|instantiated|tyro|literal", said)


def test_complaints_of_other_kinds_pass() -> None:
    assert str(mistake("something else")) == "something else; --help lists the options"
    assert tyro.__version__
