"""Replicates on disk: one HDF5 table with a row a replicate.

The table is laid out in full when the file is made: rows without a gap, at one place of the file, empty. A replicate is
put into its own row by a single write of plain bytes, and no byte outside the row changes. A kill at any moment
therefore leaves a valid HDF5 file; a row that was cut in the middle is known by its checksum and counts as empty. The
finished file depends neither on the order in which replicates came nor on how often the study was stopped: it is the
same byte for byte.
"""

import contextlib
import json
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, reason
from fpcal_bayes.core.files import content_sha256, exclusive, replacing
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.core.version import __version__
from fpcal_bayes.io.hdf5 import put_text, reading, writing
from fpcal_bayes.study.base import Study

SCHEMA = "fpcal-study"
SCHEMA_VERSION = 1
#: More than this much is refused: numbers of replicates are mistyped more often than meant.
MAX_BYTES = 1 << 32
_CHECKSUM = "checksum"


def row_type(study: Study) -> np.dtype[np.void]:
    """Layout of one replicate in the file: its checksum, then its numbers."""
    numbers = [(name, "<f8", shape) for name, shape in sorted(study.shapes().items())]
    return np.dtype([(_CHECKSUM, "<u4"), *numbers])


def packed(study: Study, values: dict[str, Floats]) -> bytes:
    """One replicate as the bytes of its row."""
    row = np.zeros(1, row_type(study))
    for name in study.shapes():
        # There are many NaN; the file knows one.
        row[name] = np.where(np.isnan(values[name]), np.nan, values[name])
    row[_CHECKSUM] = _checksums(row)
    return row.tobytes()


class StudyStore:
    """The replicates of one study in an HDF5 file.

    path: path of the file; made by `appending`.
    study: whose replicates the file holds.
    """

    def __init__(self, path: Path, study: Study) -> None:
        self.path, self.study = path, study
        self._type = row_type(study)
        self._offset = 0

    @contextlib.contextmanager
    def appending(self, replicates: int, *, anew: bool = False) -> Iterator["Appender"]:
        """Make the file, or room for `replicates` in it, and put replicates into it; nobody else does meanwhile.

        What the file holds stays, unless `anew`.
        """
        if replicates * self._type.itemsize > MAX_BYTES:
            raise InputError(
                f"{self.path}: {replicates} replicates need {replicates * self._type.itemsize >> 20} MiB, expected at "
                f"most {MAX_BYTES >> 20}"
            )
        if not self.path.exists():
            self._make(np.zeros(replicates, self._type))
        else:
            with exclusive(self.path):
                known = np.zeros(0, self._type) if anew else self._rows()
                if len(known) < replicates:
                    rows = np.zeros(replicates, self._type)
                    rows[: len(known)] = known
                    self._make(rows)
        with exclusive(self.path, in_place=True) as require_same:
            self._rows()
            appender = Appender(self.path, self._offset, self._type.itemsize)
            try:
                yield appender
            finally:
                appender.close()
            require_same()

    def done(self) -> NDArray[np.bool_]:
        """Which replicates are there, shape (n,)."""
        rows = self._rows()
        there: NDArray[np.bool_] = rows[_CHECKSUM] == _checksums(rows)
        return there

    def results(self, replicates: int) -> dict[str, Floats]:
        """The numbers of the first `replicates`, which must all be there, in the order of their numbers."""
        rows = self._rows()[:replicates]
        return {name: np.array(rows[name]) for name in self.study.shapes()}

    def _identity(self) -> dict[str, Any]:
        cell = self.study.cell
        return {
            "study": self.study.name,
            "cell_name": cell.name,
            "cell_sha256": cell.sha256,
            "settings": json.dumps(self.study.settings() | {"seed": self.study.seed}, sort_keys=True),
            "program_version": __version__,
        }

    def _make(self, rows: NDArray[np.void]) -> None:
        """Write the file with these rows, whole or not at all."""
        with replacing(self.path) as temporary, writing(temporary) as root:
            put_text(root, "schema", SCHEMA)
            root.attrs["schema_version"] = SCHEMA_VERSION
            for name, text in self._identity().items():
                put_text(root, name, text)
            put_text(root, "identity", content_sha256(self._identity()))
            creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            creation.set_layout(h5py.h5d.CONTIGUOUS)
            creation.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
            creation.set_obj_track_times(False)
            space = h5py.h5s.create_simple(rows.shape)
            kind = h5py.h5t.py_create(self._type, logical=False)
            dataset = h5py.Dataset(h5py.h5d.create(root.id, b"replicates", kind, space, creation))
            dataset[...] = rows

    def _rows(self) -> NDArray[np.void]:
        """All rows, empty ones too; where they lie in the file is noted."""
        with reading(self.path, most=MAX_BYTES) as reader:
            root = reader.root
            schema = reader.text_attribute(root, "schema")
            if schema != SCHEMA:
                raise InputError(f"{self.path}: expected an HDF5 file of schema {SCHEMA}, found {schema!r:.40}")
            version = reader.integer_attribute(root, "schema_version")
            if version != SCHEMA_VERSION:
                raise InputError(f"{self.path}: expected schema_version {SCHEMA_VERSION}, found {version}")
            if reader.text_attribute(root, "identity") != content_sha256(self._identity()):
                raise self._differs({name: reader.text_attribute(root, name) for name in self._identity()})
            dataset = reader.dataset(root, "replicates", 1)
            if dataset.dtype != self._type:
                raise InputError(f"{self.path}: /replicates: expected one row a replicate")
            offset = dataset.id.get_offset()
            if offset is None or offset + dataset.nbytes > self.path.stat().st_size:
                raise InputError(f"{self.path}: /replicates: expected whole rows, the file is truncated")
            self._offset = offset
            rows: NDArray[np.void] = dataset[()]
            return rows

    def _differs(self, found: dict[str, str]) -> InputError:
        own = self._identity()
        name = next((name for name in own if found[name] != own[name]), "identity")
        expected = f"expected {own.get(name, '')!r:.300}"
        return InputError(
            f"{self.path}: holds replicates of {name} {found.get(name, '')!r:.300}, {expected}; "
            "give another name with -o, or --anew to replace it"
        )


class Appender:
    """Puts replicates into their rows."""

    def __init__(self, path: Path, offset: int, size: int) -> None:
        self._path, self._offset, self._size = path, offset, size
        with self._writing():
            self._file = path.open("rb+", buffering=0)

    def put(self, number: int, row: bytes) -> None:
        """Write the bytes of replicate `number` (see `packed`)."""
        with self._writing():
            self._file.seek(self._offset + number * self._size)
            self._file.write(row)

    def close(self) -> None:
        """Wait until all rows are on the disk."""
        with self._writing(), self._file:
            os.fsync(self._file.fileno())

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written ({reason(error)})") from error


def _checksums(rows: NDArray[np.void]) -> NDArray[np.uint32]:
    """Checksum of each row without its own, shape (n,)."""
    width = rows.dtype[_CHECKSUM].itemsize
    return np.array([zlib.crc32(row.tobytes()[width:]) for row in rows], dtype=np.uint32)
