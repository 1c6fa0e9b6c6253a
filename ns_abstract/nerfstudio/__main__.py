"""Runs one of nerfstudio's commands where torchvision's build does not fit PyTorch's.

python -m ns_abstract.nerfstudio ns-train abstract-nerf --data my_scene
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points

from ns_abstract.nerfstudio.torchvision_operators import declare_missing

# also in processes that a command spawns: they import this module
declare_missing()


def main() -> None:
    """Run the command that the first argument names with the others; exit code 2 if there is no such command."""
    commands = {point.name: point for point in entry_points(group="console_scripts") if point.name.startswith("ns-")}
    name = sys.argv[1] if len(sys.argv) > 1 else None
    if name not in commands:
        names = ", ".join(sorted(commands)) or "none: pip install 'ns-abstract[nerfstudio]'"
        print(f"error: {name or 'no command'}: give one of the installed commands ({names})", file=sys.stderr)
        raise SystemExit(2)
    sys.argv = sys.argv[1:]
    sys.exit(commands[name].load()())


if __name__ == "__main__":
    main()
