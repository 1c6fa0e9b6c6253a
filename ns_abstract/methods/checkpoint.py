"""Read checkpoints that ``torch.save`` wrote, without torch and without running code in them.

The format is torch's (``torch/serialization.py``): an uncompressed zip archive with one pickle of the structure and
one member by storage. Of the pickle's instructions only those are followed that structures of tensors need, and of the
names in it only those of `_NAMES`, each of which stands for a function of this file.
"""

from __future__ import annotations

import math
import mmap
import struct
import zipfile
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.errors import InputError, first_line
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.kinds import refuse_other_kind
from ns_abstract.io.memory import check_memory
from ns_abstract.io.packed import open_zip
from ns_abstract.methods.checkpoint_pickle import RECOPY, Placeholder, read_structure

PICKLE_BYTES_LIMIT = 16 * 2**20
ARCHIVE_MEMBERS_LIMIT = 100_000
#: Dimensions of arrays of every version of numpy, and values that no file holds.
_MOST_DIMENSIONS, _LARGEST_TENSOR = 32, 2**58

#: By torch's name of a storage: numpy's type of its bytes, and torch's name of its values' type.
_STORAGES = {
    "FloatStorage": ("<f4", "float32"),
    "DoubleStorage": ("<f8", "float64"),
    "HalfStorage": ("<f2", "float16"),
    "BFloat16Storage": ("<u2", "bfloat16"),
    "LongStorage": ("<i8", "int64"),
    "IntStorage": ("<i4", "int32"),
    "ShortStorage": ("<i2", "int16"),
    "CharStorage": ("i1", "int8"),
    "ByteStorage": ("u1", "uint8"),
    "BoolStorage": ("u1", "bool"),
    "ComplexFloatStorage": ("<c8", "complex64"),
    "ComplexDoubleStorage": ("<c16", "complex128"),
    "QInt8Storage": ("i1", "quantized"),
    "QUInt8Storage": ("u1", "quantized"),
    "QInt32Storage": ("<i4", "quantized"),
}
_FLOATS = ("float16", "bfloat16", "float32", "float64")


@dataclass(frozen=True)
class StoredTensor:
    """A tensor as a checkpoint describes it; nothing of it is read or allocated.

    Attributes:
        kind: torch's name of its type ("float32"), or what it is where it is not dense ("sparse").
        strides: In elements.
        offset: Of its first element in ``storage``, in elements.
        storage: The values of the file that it is a view of; None where it is not dense.
    """

    kind: str
    shape: tuple[int, ...]
    strides: tuple[int, ...] = ()
    offset: int = 0
    storage: NDArray[Any] | None = None

    def float32(self, file: Path, field: str, finite: bool = True) -> NDArray[np.float32]:
        """Return the tensor's values, copied out of the file.

        ``finite``: whether values that are not finite are refused. Raises InputError: not a dense tensor of float16,
        bfloat16, float32 or float64, or a value is not finite in float32.
        """
        if self.kind not in _FLOATS or self.storage is None:
            fix = "save it as a dense float32 tensor"
            raise InputError(f"{self.kind} tensor", file=file, field=field, fix=fix)
        # Strides of 0 let a small file claim any size.
        if math.prod(self.shape) > self.storage.size:
            raise InputError("claims more values than the file holds", file=file, field=field, fix=RECOPY)
        strides = [stride * self.storage.itemsize for stride in self.strides]
        view = np.lib.stride_tricks.as_strided(self.storage[self.offset :], self.shape, strides, writeable=False)
        if self.kind == "bfloat16":
            array = (view.astype(np.uint32) << np.uint32(16)).view(np.float32)
        else:
            with np.errstate(over="ignore"):
                array = np.array(view, np.float32, order="C")
        if finite:
            require_finite(array, file, field)
        return array


def to_float32(value: Any, file: Path, field: str, finite: bool = True) -> NDArray[np.float32]:
    """Return float32 values of an entry ``field`` of a checkpoint; arrays of float32 are checked alone."""
    if isinstance(value, np.ndarray) and value.dtype == np.float32:
        if finite:
            require_finite(value, file, field)
        return value
    if not isinstance(value, StoredTensor):
        raise InputError(f"found {show(value)}, not a tensor", file=file, field=field, fix=RECOPY)
    return value.float32(file, field, finite)


def require_finite(array: NDArray[np.float32], file: Path, field: str) -> None:
    """Raise InputError that names the first row and the count of values that are NaN or infinite."""
    bad = ~np.isfinite(array)
    if bad.any():
        rows = np.flatnonzero(bad.reshape(array.shape[0], -1).any(axis=1)) if array.ndim else np.zeros(1, int)
        raise InputError(
            f"{int(bad.sum())} values are not finite in float32, the first in row {int(rows[0])}",
            file=file,
            field=field,
            fix="remove these rows or train again",
        )


def read_checkpoint(path: Path) -> Any:
    """Return the content of a checkpoint: mappings, lists and plain values with `StoredTensor` in them.

    Checksums of all members are compared first. What else torch and numpy put there (random states, devices) is None.
    Raises InputError where the file is damaged, or asks for other Python objects.
    """
    size = file_size(path, "checkpoint")
    refuse_other_kind(path)
    check_memory(size, path, "the checkpoint")
    try:
        with path.open("rb") as stream:
            if stream.read(4) != b"PK\x03\x04":
                raise InputError("not a PyTorch checkpoint", file=path, fix=RECOPY)
        with open_zip(path) as archive:
            index = _validated_pickle_member(archive, path, size)
            data = archive.read(index)
            storages = _Storages(path, archive, index.filename.removesuffix("data.pkl"))
            return read_structure(data, path, _NAMES, storages.storage)
    except (InputError, MemoryError):
        raise
    except OSError as error:
        problem = f"checkpoint cannot be read: {error.strerror or type(error).__name__}"
        raise InputError(problem, file=path, fix="check the permissions") from None
    except Exception as error:  # zipfile and pickle raise many types on damaged files
        raise InputError(f"damaged checkpoint: {first_line(error)}", file=path, fix=RECOPY) from None


def _validated_pickle_member(archive: zipfile.ZipFile, path: Path, size: int) -> zipfile.ZipInfo:
    """Return the member that holds the pickle of an archive that torch.save wrote."""
    members = archive.infolist()
    names = Counter(member.filename.casefold() for member in members)
    pickles = [m for m in members if m.filename.endswith("/data.pkl")]
    order = [m for m in members if m.filename.endswith("/byteorder")]
    problem = None
    if len(members) > ARCHIVE_MEMBERS_LIMIT:
        problem = f"{len(members)} members in the archive"
    elif any(member.compress_type != zipfile.ZIP_STORED for member in members):
        problem = "compressed members, which torch.save never writes"
    elif sum(member.file_size for member in members) > size:
        problem = "members larger than the file"
    elif names and names.most_common(1)[0][1] > 1:
        problem = f"member {show(names.most_common(1)[0][0])} stands twice"
    elif len(pickles) != 1 or any(m.filename.endswith("/constants.pkl") for m in members):
        problem = "not an archive of torch.save"
    elif pickles[0].file_size > PICKLE_BYTES_LIMIT:
        problem = f"its index has {pickles[0].file_size} bytes, more than {PICKLE_BYTES_LIMIT}"
    if problem is None:
        broken = archive.testzip()
        problem = None if broken is None else f"checksum of {show(broken)} does not match"
    if problem is None and any(archive.read(member) != b"little" for member in order):
        problem = "written on a machine of another byte order"
    if problem:
        raise InputError(f"damaged checkpoint: {problem}", file=path, fix=RECOPY)
    return pickles[0]


class _Storages:
    """The members of an archive that hold values."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, folder: str) -> None:
        self._path, self._archive, self._folder = path, archive, folder
        self._bytes: Any = None
        self._found: dict[tuple[str, str], NDArray[Any]] = {}

    def storage(self, pid: Any) -> _Storage:
        """Return the storage of a persistent_id of torch: ("storage", type, key, device, number of values)."""
        kind, storage, key, _device, count = pid
        if kind != "storage" or storage not in _STORAGES or not isinstance(count, int):
            raise ValueError("a storage of an unknown type")
        return _Storage(storage, self._values(storage, str(key), count))

    def _values(self, kind: str, key: str, count: int) -> NDArray[Any]:
        """Return ``count`` values of a storage, a read-only view of the mapped file."""
        if (kind, key) not in self._found:
            member = self._archive.getinfo(f"{self._folder}data/{key}")
            self._found[kind, key] = np.frombuffer(
                self._file(), _STORAGES[kind][0], member.file_size // np.dtype(_STORAGES[kind][0]).itemsize,
                self._start(member),
            )  # fmt: skip
        values = self._found[kind, key]
        if not 0 <= count <= values.size:
            raise ValueError(f"storage {key} holds {values.size} values of {count}")
        return values[:count]

    def _file(self) -> Any:
        if self._bytes is None:
            with self._path.open("rb") as stream:
                try:
                    self._bytes = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
                except OSError:
                    # Some network file systems cannot map files.
                    self._bytes = stream.read()
        return self._bytes

    def _start(self, member: zipfile.ZipInfo) -> int:
        """Return the offset of a member's bytes, behind its local header (APPNOTE.TXT, 4.3.7)."""
        at = member.header_offset
        name, extra = struct.unpack("<HH", self._file()[at + 26 : at + 30])
        return at + 30 + name + extra


@dataclass(frozen=True)
class _Storage:
    kind: str
    values: NDArray[Any]


def _mapping(*items: Any) -> dict[Any, Any]:
    """Return an empty dictionary in place of an ordered one, or of counts."""
    if len(items) > 1 or not all(isinstance(part, dict) for part in items):
        raise ValueError("a mapping of other objects")
    return dict(*items)


def _nothing(*_arguments: Any) -> Placeholder:
    return Placeholder()


def _sizes(numbers: Any) -> tuple[int, ...]:
    """Return a tensor's sizes or strides. ValueError: other objects, or more than numpy's arrays have."""
    if not isinstance(numbers, (list, tuple)) or len(numbers) > _MOST_DIMENSIONS:
        raise ValueError("a tensor of other or too many dimensions")
    if not all(type(n) is int and 0 <= n < 2**62 for n in numbers):
        raise ValueError("a tensor of negative size")
    return tuple(numbers)


def _tensor(
    storage: Any, offset: Any, shape: Any, strides: Any, _grad: Any = None, _hooks: Any = None, metadata: Any = None
) -> StoredTensor:
    """Return the tensor of a call of torch._utils._rebuild_tensor_v2."""
    shape, strides = _sizes(shape), _sizes(strides)
    (offset,) = _sizes((offset,))
    if not isinstance(storage, _Storage) or len(shape) != len(strides):
        raise ValueError("a tensor without its storage")
    # numpy refuses some shapes of no values
    if math.prod(max(n, 1) for n in shape) > _LARGEST_TENSOR:
        raise ValueError("a tensor of too many values")
    last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
    if 0 not in shape and last >= storage.values.size:
        raise ValueError("a tensor larger than its storage")
    kind = "negated" if metadata else _STORAGES[storage.kind][1]
    return StoredTensor(kind, shape, strides, offset, storage.values)


def _parameter(data: Any, *_rest: Any) -> Any:
    """Return the tensor of a call of torch._utils._rebuild_parameter."""
    return data


def _other(kind: str, place: int, *arguments: Any) -> StoredTensor:
    """Return a placeholder for a tensor that is not dense; its shape is argument ``place``."""
    shape: Any = arguments[1][2] if kind == "sparse" else arguments[place]
    return StoredTensor(kind, _sizes(shape))


_NUMBERS = ("Bool", "Float16", "Float32", "Float64", *(f"{sign}Int{n}" for sign in ("", "U") for n in (8, 16, 32, 64)))
_NAMES: dict[str, Any] = {
    "collections.OrderedDict": _mapping,
    "collections.Counter": _mapping,
    "torch.Size": _sizes,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": _parameter,
    "torch._utils._rebuild_parameter_with_state": _parameter,
    "torch._utils._rebuild_sparse_tensor": partial(_other, "sparse", 0),
    "torch._utils._rebuild_qtensor": partial(_other, "quantized", 2),
    "torch._utils._rebuild_meta_tensor_no_storage": partial(_other, "empty (meta)", 1),
    **{f"torch.{name}": name for name in _STORAGES},
    # Schedulers and optimizers hold numpy scalars and torch's types; none of their values is used.
    **dict.fromkeys(
        (
            "torch.device",
            "torch.serialization._get_layout",
            "torch.per_tensor_affine",
            "torch.per_channel_affine",
            *(f"torch.{kind}" for _, kind in _STORAGES.values() if kind != "quantized"),
            "_codecs.encode",
            "numpy.core.multiarray.scalar",
            "numpy._core.multiarray.scalar",
            "numpy.dtype",
            *(f"numpy.dtypes.{kind}DType" for kind in _NUMBERS),
        ),
        _nothing,
    ),
}
