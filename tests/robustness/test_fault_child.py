"""What the program of faults takes for whole, begun or damaged."""

from fault_child import is_part
from toy_study import ToyStudy

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.study.run import run_study


def test_a_store_that_was_cut_short_is_part_of_the_whole_one(tmp_path):
    study = ToyStudy(cell=load_cell(mechanics="none"))
    whole, begun = tmp_path / "whole.jsonl", tmp_path / "begun.jsonl"
    run_study(study, whole, 3, workers=0)
    head, _, second, _ = whole.read_bytes().splitlines(keepends=True)
    begun.write_bytes(head + second + b'{"rep')
    assert is_part(begun, whole.read_bytes())
    assert is_part(whole, whole.read_bytes())
    assert not is_part(whole, begun.read_bytes())
    wrong = bytearray(begun.read_bytes())
    wrong[-12] ^= 1
    begun.write_bytes(bytes(wrong))
    assert not is_part(begun, whole.read_bytes())
