"""Replicates of a study: which are run, on workers that may die, and what stands in the file."""

import json

import numpy as np
import pytest
from toy_study import ToyStudy

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import exclusive
from fpcal_bayes.study.run import MOST, run_study


@pytest.fixture
def study(femto) -> ToyStudy:
    return ToyStudy(cell=femto, seed=4)


@pytest.fixture
def whole(study, tmp_path):
    """A store of twenty replicates."""
    run_study(study, tmp_path / "whole.jsonl", 20, workers=0)
    return tmp_path / "whole.jsonl"


def test_what_it_gives_is_what_the_replicates_are(study, whole):
    results, came = run_study(study, whole, 5, workers=0)
    assert came == 0
    assert results["number"].tolist() == list(range(5))
    expected = np.array([study.replicate(number)["normal"] for number in range(5)])
    np.testing.assert_array_equal(results["normal"], expected)
    assert np.isnan(expected).any()


def test_other_programs_can_read_it(study, whole):
    head, *rows = [json.loads(line) for line in whole.read_text().splitlines()]
    assert (head["schema"], head["study"], head["settings"]["seed"]) == ("fpcal-study/2", "toy", 4)
    assert [row["replicate"] for row in rows] == list(range(20))
    assert rows[5]["values"]["normal"].count(None) == 1
    assert "NaN" not in whole.read_text()


def test_order_and_interruptions_leave_the_same_bytes(study, whole, tmp_path):
    before, parts = whole.read_bytes(), tmp_path / "parts.jsonl"
    head, *lines = before.splitlines(keepends=True)
    for seed in range(3):
        kept = np.random.default_rng(seed).permutation(20)[: 7 * seed]
        parts.write_bytes(head + b"".join(lines[number] for number in kept))
        assert run_study(study, parts, 20, workers=0)[1] == 20 - len(kept)
        assert parts.read_bytes() == before


def test_more_replicates_leave_the_same_bytes(study, whole, tmp_path):
    seen: list[int] = []
    for replicates, came in ((6, 6), (20, 14)):
        found = run_study(study, tmp_path / "grown.jsonl", replicates, workers=0, progress=seen.append)
        assert found[1] == came
    assert seen == list(range(1, 21))
    assert (tmp_path / "grown.jsonl").read_bytes() == whole.read_bytes()


def test_a_file_cut_anywhere_is_refused_or_made_whole(study, whole):
    before = whole.read_bytes()
    head = before.index(b"\n") + 1
    for keep in [*range(1, head, 97), *range(head, len(before), 211)]:
        whole.write_bytes(before[:keep])
        if keep < head:
            with pytest.raises(InputError, match=r"whole\.jsonl: row 1: expected what fpcal study writes"):
                run_study(study, whole, 20, workers=0)
            assert whole.read_bytes() == before[:keep]
        else:
            # The last line counts if all of it is there.
            assert run_study(study, whole, 20, workers=0)[1] == 20 - before[head:keep].count(b"\n")
            assert whole.read_bytes() == before


@pytest.mark.parametrize(
    "line",
    [
        "{}",
        "[]",
        '{"replicate": "3"}',
        '{"replicate": 1, "values": {"normal": [1, 2]}}',
        "x",
        "[" * 100_000,
        "\N{SNOWMAN}",
    ],
)
def test_a_line_that_is_no_replicate_is_refused(study, whole, line):
    whole.write_text(whole.read_text() + line + "\n", encoding="utf-8")
    before = whole.read_bytes()
    with pytest.raises(InputError, match="row 22: expected a replicate"):
        run_study(study, whole, 20, workers=0)
    assert whole.read_bytes() == before


def test_other_settings_are_refused_unless_anew(whole, femto):
    other = ToyStudy(cell=femto, seed=5)
    with pytest.raises(InputError, match=r"settings .*seed.* 4.*expected.* 5.*--anew") as refused:
        run_study(other, whole, 20, workers=0)
    assert str(whole) in str(refused.value)
    assert run_study(other, whole, 2, workers=0, anew=True)[1] == 2


def test_a_second_writer_is_told(study, whole):
    with exclusive(whole), pytest.raises(InputError, match="another fpcal is writing this file"):
        run_study(study, whole, 20, workers=0)


def test_absurd_numbers_are_refused(study, tmp_path):
    with pytest.raises(InputError, match="expected at most"):
        run_study(study, tmp_path / "a.jsonl", MOST + 1, workers=0)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
class TestWorkers:
    def test_they_give_what_one_process_gives(self, study, whole, tmp_path):
        assert run_study(study, tmp_path / "two.jsonl", 20, workers=2)[1] == 20
        assert (tmp_path / "two.jsonl").read_bytes() == whole.read_bytes()

    def test_a_failing_replicate_ends_the_study_and_the_others_stay(self, femto, tmp_path):
        store = tmp_path / "store.jsonl"
        with pytest.raises(InputError, match=r"replicate 7: ZeroDivisionError: one over nothing"):
            run_study(ToyStudy(cell=femto, failing=7), store, 8, workers=1)
        assert run_study(ToyStudy(cell=femto), store, 8, workers=0)[1] == 1

    def test_a_worker_that_dies_is_one_line_and_the_others_stay(self, femto, tmp_path):
        store = tmp_path / "store.jsonl"
        with pytest.raises(InputError, match="a worker died; it may need more memory"):
            run_study(ToyStudy(cell=femto, deadly=7), store, 8, workers=1)
        assert 1 <= run_study(ToyStudy(cell=femto), store, 8, workers=0)[1] <= 8
