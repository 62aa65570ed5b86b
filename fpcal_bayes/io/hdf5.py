"""Datasets and attributes of an HDF5 file, read with a message for everything that can be wrong and written plainly.

Text is stored with a fixed length, numbers and text with checksums, metadata in the checksummed format of HDF5 1.10:
a damaged byte is noticed. Text of variable length lies in an unchecked heap, in which a damaged length sends the
HDF5 library into an endless loop; files of other programs may use it all the same.
"""

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.files import require_quiet, require_readable

SIGNATURE = b"\x89HDF\r\n\x1a\n"

#: All that is read from one file; a damaged or hostile file may promise any size without holding it.
MAX_BYTES = 1 << 30

#: What h5py raises on damaged files.
_FAILURES = (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError, MemoryError)


def is_hdf5(path: Path) -> bool:
    """Whether a readable file begins like an HDF5 file."""
    with path.open("rb") as file:
        return file.read(len(SIGNATURE)) == SIGNATURE


class Reader:
    """Reads from one open file; every refusal is an `InputError` that names the file and the place in it."""

    def __init__(self, path: Path, root: Any) -> None:
        self.path, self.root, self._bytes_left = path, root, MAX_BYTES

    def has(self, group: Any, name: str) -> bool:
        """Whether `group` holds something called `name`."""
        return group.get(name, getlink=True) is not None

    def group(self, parent: Any, name: str) -> Any:
        """The group `name` of a group."""
        return self._child(parent, name, h5py.Group, "group")

    def numbers(self, parent: Any, name: str, ndim: int | None = 1) -> NDArray[np.float64]:
        """The numbers of a dataset with `ndim` axes, or any number of them, as float64."""
        dataset = self.dataset(parent, name, ndim)
        if dataset.dtype.kind not in "fiub":
            raise self._error(dataset.name, f"expected numbers, found {dataset.dtype}")
        return np.asarray(dataset[()], dtype=np.float64)

    def texts(self, parent: Any, name: str) -> NDArray[np.str_]:
        """The texts of a dataset with one axis."""
        dataset = self.dataset(parent, name, 1)
        if h5py.check_string_dtype(dataset.dtype) is None:
            raise self._error(dataset.name, f"expected text, found {dataset.dtype}")
        texts = dataset.asstr()[()].tolist()
        # An array of text has the width of its longest: it must fit too.
        self._spend(dataset.name, 4 * max(map(len, texts), default=0) * len(texts))
        return np.array(texts, dtype=np.str_)

    def text_attribute(self, holder: Any, name: str) -> str:
        """The text of an attribute."""
        value = self._attribute(holder, name)
        if isinstance(value, bytes):
            value = value.decode()
        if not isinstance(value, str):
            raise self._error(f"{holder.name}, attribute {name}", f"expected text, found {value!r:.40}")
        return value

    def integer_attribute(self, holder: Any, name: str) -> int:
        """The whole number of an attribute."""
        value = self._attribute(holder, name)
        if not isinstance(value, np.integer):
            raise self._error(f"{holder.name}, attribute {name}", f"expected a whole number, found {value!r:.40}")
        return int(value)

    def _attribute(self, holder: Any, name: str) -> Any:
        if name not in holder.attrs:
            raise self._error(f"{holder.name}, attribute {name}", "missing")
        size = math.prod(holder.attrs.get_id(name).shape)
        if size != 1:
            raise self._error(f"{holder.name}, attribute {name}", f"expected a single value, found {size}")
        value = holder.attrs[name]
        # Some programs store a single value as an array of one.
        return value.reshape(-1)[0] if isinstance(value, np.ndarray) else value

    def dataset(self, parent: Any, name: str, ndim: int | None) -> Any:
        """The dataset `name` of a group, which lies in this file and fits in memory."""
        dataset = self._child(parent, name, h5py.Dataset, "dataset")
        if dataset.external or dataset.is_virtual:
            raise self._error(dataset.name, "the data lie in another file, which is not opened")
        if dataset.shape is None or ndim not in (None, len(dataset.shape)):
            raise self._error(dataset.name, f"expected {ndim} axes, found shape {dataset.shape}")
        self._spend(dataset.name, int(dataset.size) * dataset.dtype.itemsize)
        return dataset

    def _child(self, parent: Any, name: str, kind: type, what: str) -> Any:
        place = f"{parent.name.rstrip('/')}/{name}"
        link = parent.get(name, getlink=True)
        if link is None:
            raise self._error(place, f"the {what} is missing")
        if not isinstance(link, h5py.HardLink):
            raise self._error(place, f"expected a {what}, found a link, which is not followed")
        child = parent[name]
        if not isinstance(child, kind):
            raise self._error(place, f"expected a {what}")
        return child

    def _spend(self, place: str, size: int) -> None:
        self._bytes_left -= size
        if self._bytes_left < 0:
            raise self._error(place, f"the file holds more than {MAX_BYTES >> 20} MiB")

    def _error(self, place: str, expected: str) -> InputError:
        return located(self.path, f"{place}: {expected}")


@contextlib.contextmanager
def reading(path: Path, kind: str = "an HDF5 file") -> Iterator[Reader]:
    """Open an HDF5 file to read; whatever the library raises becomes one `InputError`."""
    try:
        require_readable(path)
        if not is_hdf5(path):
            raise InputError(f"{path}: not {kind}")
        # Files are replaced whole, so a lock would only hinder readers on shared drives.
        with h5py.File(path, "r", locking=False) as file:
            yield Reader(path, file)
    except _FAILURES as error:
        if path.is_file():
            require_quiet(path)
        if isinstance(error, InputError):
            raise
        if "already open for" in str(error):
            raise InputError(f"{path}: another program has this file open to write: close it there") from error
        raise InputError(f"{path}: truncated or damaged HDF5 file ({str(error)[:200]})") from error


@contextlib.contextmanager
def writing(path: Path) -> Iterator[Any]:
    """Write an HDF5 file, equal content as equal bytes; made in memory, since closing on a full disk fails uncaught."""
    try:
        with h5py.File(path, "w", libver=("v110", "v110"), driver="core", backing_store=False) as file:
            yield file
            file.flush()
            image = file.id.get_file_image()
    except RuntimeError as error:
        raise OSError(str(error)) from error
    path.write_bytes(image)


def put_array(group: Any, name: str, values: Any, unit: str = "") -> None:
    """Store numbers or texts, with their unit as an attribute."""
    array = np.asarray(values)
    if array.dtype.kind in "UO":
        array = _fixed(array)
    # One chunk: its place stands in the checksummed header, not in a tree of its own.
    layout = {"chunks": array.shape, "fletcher32": True} if array.size else {}
    dataset = group.create_dataset(name, data=array, dtype=array.dtype, track_times=False, **layout)
    if unit:
        put_text(dataset, "unit", unit)


def put_text(holder: Any, name: str, text: str) -> None:
    """Store a text as an attribute."""
    holder.attrs.create(name, _fixed(np.asarray(text)))


def _fixed(texts: NDArray[Any]) -> NDArray[Any]:
    encoded = np.strings.encode(texts.astype(np.str_), "utf-8")
    return encoded.astype(h5py.string_dtype("utf-8", max(1, encoded.dtype.itemsize)))
