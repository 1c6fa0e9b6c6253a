"""``ns-abstract-demo``: runs of Splatfacto, vanilla-nerf and nerfacto, with sets of poses and a network in a loop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ns_abstract.cli.common import DONE, command, run
from ns_abstract.io.errors import InputError, visible


@dataclass
class Demo:
    """Write scenes as real run folders, with camera paths, sets of poses and a network in a loop.

    An airfield as a Splatfacto run; a gate as another one, with a network that steers towards it (LOOP.json); and a
    buoy as a vanilla-nerf run of full size and as a small nerfacto run. Needs no network connection and takes about ten
    seconds.
    """

    output_dir: Path
    """Folder for the runs; made if missing."""
    splats_only: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave out the NeRFs."""


def demo(options: Demo) -> int:
    from ns_abstract.demo import writing
    from ns_abstract.report.progress import plain_console

    folder = options.output_dir
    writing.refuse_others(folder)
    console = plain_console()
    try:
        with console.status("modelling the airfield, rendering its data set"):
            config, files = writing.write_demo(folder)
        with console.status("modelling the gate, fitting the network of its loop"):
            course, loop = writing.write_loop_demo(folder / "gate")
        fields = {}
        if not options.splats_only:
            with console.status("writing the NeRFs"):
                fields = {"NeRF": writing.write_nerf_demo(folder), "nerfacto": writing.write_nerfacto_demo(folder)}
    except OSError as error:
        raise InputError(
            f"cannot be written ({error.strerror})", file=folder, field="--output-dir", fix="choose another folder"
        ) from None
    lines = [f"run          {config}"]
    for name, title in (("path", "camera path"), ("orbit", "orbit"), ("spec", "perturbation")):
        lines.append(f"{title:12s} {files[name]}")
    lines.append(
        "\nnext:\n"
        f"  ns-abstract-render --load-config {config} --camera-path-filename {files['path']} \\\n"
        f"    --perturbation-filename {files['spec']} --output-dir {folder / 'abstract'}"
    )
    lines.append(
        f"\nloop         {loop}\n"
        f"  ns-abstract-reach --load-config {course} --loop {loop} \\\n"
        f"    --output-dir {folder / 'loop'} --time-budget 600"
    )
    for name, (config, path) in fields.items():
        lines.append(
            f"\n{name + ' run':12s} {config}\n"
            f"  ns-abstract-render --load-config {config} --camera-path-filename {path} \\\n"
            f"    --output-dir {folder / f'abstract-{name.lower()}'}"
        )
    print("\n".join(visible(line) for line in "\n".join(lines).split("\n")))
    return DONE


def main() -> None:
    run(demo, command("ns-abstract-demo", Demo))


if __name__ == "__main__":
    main()
