"""``ns-abstract-viewer``: nerfstudio's viewer with abstract images, also without CUDA."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from ns_abstract.cli.common import DONE, command, run
from ns_abstract.cli.sets import Overrides, SceneOverrides
from ns_abstract.io.errors import InputError


@dataclass
class Viewer:
    """nerfstudio's viewer."""

    relative_log_filename: str = "viewer_log_filename.txt"
    """Filename to use for the log file."""
    websocket_port: int | None = None
    """The websocket port to connect to. If None, find an available port."""
    websocket_port_default: int = 7007
    """The default websocket port to connect to if websocket_port is not specified."""
    websocket_host: str = "127.0.0.1"
    """The address that the viewer listens on: this machine only. 0.0.0.0: everyone who reaches this machine."""
    max_num_display_images: int = 512
    """Maximum number of training images to display in the viewer. If -1, display all."""
    quit_on_train_completion: bool = False
    """Whether to kill the training job when it has completed."""
    image_format: Literal["jpeg", "png"] = "jpeg"
    """Image format viewer should use; jpeg is lossy compression, while png is lossless."""
    jpeg_quality: int = 75
    """Quality tradeoff to use for jpeg compression."""
    make_share_url: bool = False
    """Print a shareable URL."""
    camera_frustum_scale: float = 0.1
    """Scale for the camera frustums in the viewer."""
    default_composite_depth: bool = True
    """The default value for compositing depth."""


@dataclass
class ViewRun:
    """View a trained run with lower and upper bounds of what its camera could show.

    nerfstudio's viewer with the output types abstract_lower, abstract_upper, abstract_gap and
    abstract_witness and a panel for the set of poses (Control tab, Custom Elements). Refuses a config.yml
    that names other Python objects than nerfstudio's runs do, as nerfstudio's reader could run code.
    """

    load_config: Path
    """config.yml of a Splatfacto or vanilla-nerf run, or a scene file (.ply, .sog, .spz, .splat, .glb, .pt)."""
    viewer: Viewer = field(default_factory=Viewer)
    """Viewer configuration"""
    vis: Literal["viewer", "viewer_legacy"] = "viewer"
    """Type of viewer"""
    depth: bool = False
    """Splats: bound the expected depth, too: output types abstract_depth_lower and abstract_depth_upper."""
    gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Splats: whose rules are drawn and bounded. Default: the installed version's."""
    overrides: SceneOverrides = field(default_factory=Overrides)


def view(options: ViewRun) -> int:
    """Run the command until it is interrupted; returns the exit code.

    Raises:
        InputError: nerfstudio is missing, or the run cannot be opened.
    """
    from ns_abstract.nerfstudio.torchvision_operators import declare_missing

    declare_missing()
    warnings.filterwarnings("ignore", category=FutureWarning)
    try:
        from ns_abstract.nerfstudio.viewing import view as serve

        abstract = {"depth": options.depth, "gsplat_version": options.gsplat_version}
        serve(options.load_config, options.vis, vars(options.viewer), abstract, options.overrides)
    except ModuleNotFoundError as error:
        raise InputError(
            f"the package {error.name} is missing", field="nerfstudio", fix="pip install 'ns-abstract[nerfstudio]'"
        ) from None
    except KeyboardInterrupt:
        # the way to end a viewer
        pass
    return DONE


def main() -> None:
    run(view, command("ns-abstract-viewer", tyro.conf.FlagConversionOff[ViewRun]))


if __name__ == "__main__":
    main()
