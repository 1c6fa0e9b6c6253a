"""``ns-abstract-demo``: a small airfield as a Splatfacto run, with camera paths and a set of poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ns_abstract.cli.common import DONE, run
from ns_abstract.errors import InputError


@dataclass
class Demo:
    """Write a procedural scene as a real Splatfacto run folder, camera paths and a perturbation.

    No network, no training, a few seconds.
    """

    output_dir: Path
    """Folder for the run; made if missing."""


def demo(options: Demo) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: The folder cannot be written.
    """
    from rich.console import Console

    from ns_abstract.demo.writing import write_demo

    folder = options.output_dir
    console = Console(stderr=True, highlight=False)
    try:
        with console.status("modelling the airfield, rendering its data set"):
            config, files = write_demo(folder)
    except OSError as error:
        raise InputError(
            f"cannot be written ({error.strerror})", file=folder, field="--output-dir", fix="choose another folder"
        ) from None
    print(f"run          {config}")
    for name, title in (("path", "camera path"), ("orbit", "orbit"), ("spec", "perturbation")):
        print(f"{title:12s} {files[name]}")
    print(
        "\nnext:\n"
        f"  ns-abstract-render --load-config {config} --camera-path-filename {files['path']} \\\n"
        f"    --perturbation-filename {files['spec']} --output-dir {folder / 'abstract'}"
    )
    return DONE


def main() -> None:
    """Entry point of the console script."""
    run(demo, lambda: tyro.cli(Demo, prog="ns-abstract-demo"))


if __name__ == "__main__":
    main()
