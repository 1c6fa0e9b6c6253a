"""The gallery's page is what its script writes, and its pictures are small."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from benchmark_scripts import script
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "gallery.md"
if not PAGE.exists():
    pytest.skip("the documentation is not beside the tests", allow_module_level=True)


@pytest.fixture(scope="module")
def gallery() -> ModuleType:
    return script("gallery")


def test_the_page_shows_the_commands_that_are_run(gallery: ModuleType) -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert text == gallery.page()
    blocks = re.findall(r"```sh\n(.*?)\n```", text, re.S)
    shown = {re.sub(r" \\\n\s*", " ", block) for block in blocks}
    assert shown == {gallery.DEMO, *(entry.command for entry in gallery.ENTRIES)}
    for entry in gallery.ENTRIES:
        assert f"--output-dir {entry.output} " in entry.command


def test_pictures_are_there_and_small(gallery: ModuleType) -> None:
    names = {f"{entry.name}.png" for entry in gallery.ENTRIES}
    files = sorted(gallery.IMAGES.glob("*.png"))
    assert {file.name for file in files} == names
    assert all(file.stat().st_size <= 80_000 for file in files)
    assert sum(file.stat().st_size for file in files) <= 600_000
    for file in files:
        picture = np.asarray(Image.open(file).convert("RGB"))
        assert picture.shape[1] >= 500 and picture.std() > 10.0, file.name


def test_a_large_picture_becomes_small(gallery: ModuleType) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (40, 2000, 3), dtype=np.uint8)
    data = gallery.small(Image.fromarray(noise))
    assert len(data) <= 80_000


def test_every_command_can_be_parsed(gallery: ModuleType) -> None:
    """Options exist, files are those that the demo or the entry writes."""
    import shlex

    import tyro

    from ns_abstract.cli.certify import Certify
    from ns_abstract.cli.reach import Reach
    from ns_abstract.cli.render import Render

    classes = {"ns-abstract-render": Render, "ns-abstract-certify": Certify, "ns-abstract-reach": Reach}
    for entry in gallery.ENTRIES:
        script, *options = shlex.split(entry.command)
        given = tyro.cli(classes[script], args=options)
        for value in vars(given).values():
            if isinstance(value, Path) and value != given.output_dir:
                assert value.parts[0] == "demo" or value.name in entry.files
