import h5py
import numpy as np
import pytest
from toy_study import ToyStudy

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.study.runner import run_alone
from fpcal_bayes.study.store import StudyStore, packed


@pytest.fixture
def study(femto) -> ToyStudy:
    return ToyStudy(cell=femto, seed=4)


@pytest.fixture
def whole(study, tmp_path):
    """A store of twenty replicates."""
    store = StudyStore(tmp_path / "whole.h5", study)
    run_alone(study, store, 20)
    return store


def put(store: StudyStore, study: ToyStudy, numbers, replicates: int = 20) -> None:
    with store.appending(replicates) as appender:
        for number in numbers:
            appender.put(number, packed(study, study.replicate(number)))


def test_order_and_interruptions_leave_the_same_bytes(study, whole, tmp_path):
    store = StudyStore(tmp_path / "parts.h5", study)
    numbers = np.random.default_rng(0).permutation(20).tolist()
    put(store, study, numbers[:7])
    assert store.done().tolist() == [number in numbers[:7] for number in range(20)]
    put(store, study, numbers[7:])
    assert file_sha256(store.path) == file_sha256(whole.path)


def test_more_replicates_leave_the_same_bytes(study, whole, tmp_path):
    store = StudyStore(tmp_path / "grown.h5", study)
    run_alone(study, store, 6)
    run_alone(study, store, 20)
    assert file_sha256(store.path) == file_sha256(whole.path)


def test_other_programs_can_read_it(study, whole):
    with h5py.File(whole.path) as file:
        assert file["replicates"]["number"].tolist() == list(range(20))
    results = whole.results(5)
    assert results["normal"].shape == (5, 3)
    expected = np.array([study.replicate(number)["normal"] for number in range(5)])
    np.testing.assert_array_equal(results["normal"], expected)


@pytest.mark.parametrize("cut", [1, 13, 27])
def test_a_row_cut_in_the_middle_counts_as_empty(study, whole, cut):
    before = whole.path.read_bytes()
    row = packed(study, study.replicate(3))
    assert before.count(row) == 1
    at = before.index(row)
    whole.path.write_bytes(before[: at + cut] + bytes(len(row) - cut) + before[at + len(row) :])
    assert np.flatnonzero(~whole.done()).tolist() == [3]
    run_alone(study, whole, 20)
    assert whole.path.read_bytes() == before


def test_other_settings_are_refused_unless_anew(study, whole, femto):
    other = ToyStudy(cell=femto, seed=5)
    with pytest.raises(InputError, match=r"settings .*seed.* 4.*expected.* 5.*--anew") as refused:
        run_alone(other, StudyStore(whole.path, other), 20)
    assert str(whole.path) in str(refused.value)
    with StudyStore(whole.path, other).appending(20, anew=True):
        pass
    assert not StudyStore(whole.path, other).done().any()


def test_a_second_writer_is_told(study, whole):
    with (
        whole.appending(20),
        pytest.raises(InputError, match="another fpcal is writing this file"),
        whole.appending(20),
    ):
        pass


def test_replicates_of_another_file_are_not_opened(study, whole, tmp_path):
    other = tmp_path / "other.h5"
    other.write_bytes(whole.path.read_bytes())
    with h5py.File(whole.path, "r+") as file:
        del file["replicates"]
        file["replicates"] = h5py.ExternalLink("other.h5", "/replicates")
    before = whole.path.read_bytes()
    with pytest.raises(InputError, match="found a link, which is not followed"):
        run_alone(study, whole, 20)
    assert whole.path.read_bytes() == before


def test_truncated_and_foreign_files_are_refused(study, whole, tmp_path):
    content = whole.path.read_bytes()
    for keep in range(1, len(content), 211):
        whole.path.write_bytes(content[:keep])
        with pytest.raises(InputError) as refused:
            run_alone(study, whole, 20)
        assert str(refused.value).startswith(str(whole.path))
        assert whole.path.read_bytes() == content[:keep]
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["x"] = 1
    with pytest.raises(InputError, match="schema"):
        run_alone(study, StudyStore(foreign, study), 2)


def test_absurd_numbers_are_refused(study, tmp_path):
    with pytest.raises(InputError, match="MiB"):
        run_alone(study, StudyStore(tmp_path / "a.h5", study), 10**12)
    assert not list(tmp_path.iterdir())
