"""The structure of a checkpoint from its pickle, built without Python's unpickler.

That one lets a file set attributes of what it built, compare keys of any depth and copy a list as often as it likes.
Here only those instructions are followed that structures of tensors need, keys are text and small whole numbers, and
the number of instructions and of copied values is limited.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import show

RECOPY = "copy the checkpoint again from the run"
#: A tensor takes about 40.
INSTRUCTIONS_LIMIT = 2**20
_MODULES = {"torch", "collections", "numpy", "_codecs"}
#: Keys that Python finds in constant time, whatever a file holds.
_KEY_LIMIT = 2**31

Function = Callable[..., Any]


class _Mark:
    """Where the arguments of a later instruction begin on the stack."""


class Placeholder:
    """An object of a checkpoint that is never used."""

    __slots__ = ()


def read_structure(data: bytes, path: Path, names: Mapping[str, Any], persistent: Callable[[Any], Any]) -> Any:
    """Return the structure that an untrusted pickle describes, without running anything of it.

    Args:
        data: The pickle.
        path: Its file, for messages.
        names: By module and name: functions that it may call, and values.
        persistent: Gives the object of a persistent identifier.

    Raises:
        InputError: It asks for other names.
        ValueError: It is damaged, or has other instructions or keys. ``persistent`` and functions may raise others.
    """
    _check_names(data, path, names)
    return _Stack(len(data), names, persistent).run(data)


def _check_names(data: bytes, path: Path, names: Mapping[str, Any]) -> None:
    """Refuse pickles that ask for other names or are too long; pickletools builds nothing, it only lists them."""
    wanted, unusual = set(), None
    for number, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        if opcode.name in ("GLOBAL", "INST", "STACK_GLOBAL"):
            wanted.add(str(argument or "unnamed").replace(" ", "."))
        if opcode.name not in _INSTRUCTIONS or (opcode.name.endswith("PUT") and int(argument or 0) > len(data)):
            unusual = unusual or f"unusual contents ({opcode.name})"
        if number >= INSTRUCTIONS_LIMIT:
            unusual = unusual or f"its index has more than {INSTRUCTIONS_LIMIT} instructions"
            break
    # names outside of torch and numpy first: they are what an attack needs
    for name in sorted(wanted, key=lambda n: (n.partition(".")[0] in _MODULES, n)):
        if name not in names:
            raise InputError(
                f"asks for the Python object {show(name)}; nothing was run",
                file=path,
                field="data.pkl",
                fix="use only checkpoints that ns-train wrote",
            )
    if unusual:
        raise ValueError(unusual)


class _Stack:
    """Follows the instructions of a pickle.

    ``most``: how many values its functions may copy together.
    """

    def __init__(self, most: int, names: Mapping[str, Any], persistent: Callable[[Any], Any]) -> None:
        self._most, self._names, self._persistent = most, names, persistent
        self._items: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self, data: bytes) -> Any:
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name == "STOP":
                break
            _INSTRUCTIONS[opcode.name](self, argument)
        return self._pop()

    def _pop(self) -> Any:
        if not self._items or isinstance(self._items[-1], _Mark):
            _damaged("the stack is empty")
        return self._items.pop()

    def _popped(self, count: int) -> tuple[Any, ...]:
        return tuple(self._pop() for _ in range(count))[::-1]

    def _since_mark(self) -> list[Any]:
        items = []
        while self._items:
            item = self._items.pop()
            if isinstance(item, _Mark):
                return items[::-1]
            items.append(item)
        return _damaged("a mark is missing")

    def _last(self, kind: type) -> Any:
        if not self._items or type(self._items[-1]) is not kind:
            _damaged(f"no {kind.__name__} to fill")
        return self._items[-1]

    def push(self, value: Any) -> None:
        self._items.append(value)

    def mark(self, _argument: Any) -> None:
        self._items.append(_Mark())

    def pop(self, _argument: Any) -> None:
        self._pop()

    def pop_mark(self, _argument: Any) -> None:
        self._since_mark()

    def tuple_of_mark(self, _argument: Any) -> None:
        self.push(tuple(self._since_mark()))

    def tuple_of(self, count: int) -> None:
        self.push(self._popped(count))

    def set_items(self, items: list[Any]) -> None:
        mapping = self._last(dict)
        if len(items) % 2:
            _damaged("a key without a value")
        for key, value in zip(items[::2], items[1::2], strict=True):
            mapping[_checked_key(key)] = value

    def append(self, items: list[Any]) -> None:
        self._last(list).extend(items)

    def add(self, _argument: Any) -> None:
        items = self._since_mark()
        self._last(set).update(map(_checked_key, items))

    def put(self, place: Any) -> None:
        if not self._items:
            _damaged("nothing to keep")
        self._memo[len(self._memo) if place is None else int(place)] = self._items[-1]

    def get(self, place: Any) -> None:
        if int(place) not in self._memo:
            _damaged("a reference to nothing")
        self.push(self._memo[int(place)])

    def name(self, argument: Any) -> None:
        self.push(self._names[str(argument).replace(" ", ".")])

    def call(self, _argument: Any) -> None:
        function, arguments = self._popped(2)
        if not callable(function) or not isinstance(arguments, tuple):
            _damaged("a call of no function")
        self._most -= sum(len(value) for value in arguments if isinstance(value, (dict, list, tuple, set)))
        if self._most < 0:
            _damaged("its functions copy more values than it holds")
        self.push(function(*arguments))

    def state(self, _argument: Any) -> None:
        """Attributes are left out: torch stores those of a module's state, which a file could hide methods by."""
        target, _ = self._popped(2)
        if not isinstance(target, (dict, Placeholder)):
            _damaged(f"attributes of {show(target)}")
        self.push(target)

    def persistent(self, _argument: Any) -> None:
        self.push(self._persistent(self._pop()))

    def nothing(self, _argument: Any) -> None:
        pass


def _damaged(problem: str) -> NoReturn:
    raise ValueError(problem)


def _checked_key(key: Any) -> Any:
    """Return ``key`` itself; ValueError where Python may compare it for long, or without end."""
    # other numbers can be chosen so that all are looked up at one place
    if type(key) is str or (isinstance(key, int) and -_KEY_LIMIT < key < _KEY_LIMIT):
        return key
    return _damaged(f"{show(key)} as a key")


#: What an instruction does; those that are not here are refused.
_INSTRUCTIONS: dict[str, Callable[[_Stack, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), _Stack.nothing),
    **dict.fromkeys(
        """BININT BININT1 BININT2 LONG1 BINFLOAT BINUNICODE SHORT_BINUNICODE BINSTRING SHORT_BINSTRING BINBYTES
        SHORT_BINBYTES""".split(),  # noqa: SIM905
        _Stack.push,
    ),
    "NONE": lambda stack, _: stack.push(None),
    "NEWTRUE": lambda stack, _: stack.push(True),
    "NEWFALSE": lambda stack, _: stack.push(False),
    "EMPTY_DICT": lambda stack, _: stack.push({}),
    "EMPTY_LIST": lambda stack, _: stack.push([]),
    "EMPTY_TUPLE": lambda stack, _: stack.push(()),
    "EMPTY_SET": lambda stack, _: stack.push(set()),
    "MARK": _Stack.mark,
    "POP": _Stack.pop,
    "POP_MARK": _Stack.pop_mark,
    "TUPLE": _Stack.tuple_of_mark,
    "TUPLE1": lambda stack, _: stack.tuple_of(1),
    "TUPLE2": lambda stack, _: stack.tuple_of(2),
    "TUPLE3": lambda stack, _: stack.tuple_of(3),
    "SETITEM": lambda stack, _: stack.set_items(list(stack._popped(2))),
    "SETITEMS": lambda stack, _: stack.set_items(stack._since_mark()),
    "APPEND": lambda stack, _: stack.append([stack._pop()]),
    "APPENDS": lambda stack, _: stack.append(stack._since_mark()),
    "ADDITEMS": _Stack.add,
    **dict.fromkeys(("BINPUT", "LONG_BINPUT", "MEMOIZE"), _Stack.put),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), _Stack.get),
    "GLOBAL": _Stack.name,
    "REDUCE": _Stack.call,
    "BUILD": _Stack.state,
    "BINPERSID": _Stack.persistent,
}
