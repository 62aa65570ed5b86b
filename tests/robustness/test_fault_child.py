"""What the program of faults takes for whole, begun or damaged."""

import numpy as np
from fault_child import is_part
from toy_study import ToyStudy

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.study.runner import run_alone
from fpcal_bayes.study.store import StudyStore, packed


def test_a_store_that_was_cut_short_is_part_of_the_whole_one(tmp_path):
    study = ToyStudy(cell=load_cell(mechanics="none"))
    whole, begun = tmp_path / "whole.h5", tmp_path / "begun.h5"
    run_alone(study, StudyStore(whole, study), 3)
    store = StudyStore(begun, study)
    with store.appending(3) as appender:
        appender.put(1, packed(study, study.replicate(1)))
    assert is_part(begun, whole.read_bytes())
    assert is_part(whole, whole.read_bytes())
    assert not is_part(whole, begun.read_bytes())
    np.testing.assert_array_equal(store.done(), [False, True, False])
    wrong = bytearray(begun.read_bytes())
    wrong[-3] ^= 1
    begun.write_bytes(bytes(wrong))
    assert not is_part(begun, whole.read_bytes())
    begun.write_bytes(whole.read_bytes()[:-1])
    assert not is_part(begun, whole.read_bytes())
