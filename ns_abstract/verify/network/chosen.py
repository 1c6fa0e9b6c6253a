"""Choose which of a network's outputs is read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import show

#: Outputs that a message names.
_NAMED = 8


def chosen_output(
    path: Path, shapes: Mapping[str, Sequence[object]], asked: str | None, beside: Sequence[str] = ()
) -> str:
    """Return the name of the output to read: the requested one, or the only one.

    Outputs are never joined: a label would count through all of them.

    Args:
        path: The file, for errors.
        shapes: Shapes of the outputs by name, as the file says them.
        asked: A name, or None.
        beside: Outputs that are no scores, such as masks and indices; they are read only where they are asked for.

    Raises:
        InputError: There is no such output, or there are several and none is asked for.
    """
    if asked is not None:
        if asked not in shapes:
            raise InputError(f"has no output {show(asked)}", file=path, field="output", fix=f"write {_list(shapes)}")
        return asked
    scores = [name for name in shapes if name not in beside] or list(shapes)
    if len(scores) == 1:
        return scores[0]
    raise InputError(
        f"has {len(scores)} outputs: {_list({name: shapes[name] for name in scores})}",
        file=path,
        field="output",
        fix=f'write "output": {show(scores[0])} in the property, or export the network with one output',
    )


def _list(shapes: Mapping[str, Sequence[object]]) -> str:
    shown = [f"{show(name)} {list(shape)}".replace("'", "") for name, shape in list(shapes.items())[:_NAMED]]
    return ", ".join(shown) + (f" and {len(shapes) - _NAMED} more" if len(shapes) > _NAMED else "")
