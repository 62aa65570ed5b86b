"""Doubtful sweeps in HDF5: round trip, and damage."""

from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.campaign import get_doubtful, put_doubtful
from fpcal_bayes.io.hdf5 import reading, writing
from fpcal_bayes.measure.campaign import DoubtfulRecord

RECORD = DoubtfulRecord(
    session=np.array(["a", "a", "b"]),
    label=np.array(["one", "two", "drei \u00fc"]),
    reason=np.array(["sparse", "another count", ""]),
    recording=np.array([0, 3, 4]),
    dl=np.array([np.nan, 1.5, -2.0]),
    sigma=np.array([np.nan, 1e-3, 2e-3]),
    signed=np.array([False, False, True]),
    alternatives=((), (2.28, 0.72), (-1.22,)),
)


def test_a_record_reads_back(tmp_path: Path) -> None:
    with writing(tmp_path / "r.h5") as root:
        put_doubtful(root.create_group("doubtful"), RECORD)
    with reading(tmp_path / "r.h5") as reader:
        back = get_doubtful(reader, reader.group(reader.root, "doubtful"))
    for name in ("session", "label", "reason", "recording", "dl", "sigma", "signed"):
        np.testing.assert_array_equal(getattr(back, name), getattr(RECORD, name))
    assert back.alternatives == RECORD.alternatives
    assert len(back) == 3


@pytest.mark.parametrize(("name", "values"), [("alternatives_end", [2, 0, 3]), ("alternatives_end", [0, 2, 9])])
def test_damage_is_noticed(tmp_path: Path, name: str, values: list[int]) -> None:
    with writing(tmp_path / "r.h5") as root:
        group = root.create_group("doubtful")
        put_doubtful(group, RECORD)
        group[name][...] = values
    with reading(tmp_path / "r.h5") as reader, pytest.raises(InputError, match="expected whole numbers that rise to 3"):
        get_doubtful(reader, reader.group(reader.root, "doubtful"))
