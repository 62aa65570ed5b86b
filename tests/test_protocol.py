"""Protocols: the paper's sweeps, midpoints, known signs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_csv
from fpcal_bayes.measure.protocol import (
    add_midpoints,
    mark_signs,
    paper_protocol,
    protocol_by_name,
    read_often,
    single_sweep,
)
from fpcal_bayes.model.parameters import Parameter, ParameterSet

CELL = load_cell(mechanics="none")
CASE_A = Path(__file__).parent / "data" / "case_a.csv"


def test_the_papers_sweeps_are_those_of_the_reference_case():
    protocol, reference = paper_protocol(CELL), read_csv(CASE_A, CELL)
    assert protocol.label.tolist() == reference.label.tolist()
    assert protocol.session.tolist() == reference.session.tolist()
    np.testing.assert_array_equal(protocol.q_start, reference.q_start)
    np.testing.assert_array_equal(protocol.q_end, reference.q_end)
    assert not protocol.measured


def test_midpoints_share_the_start_of_their_sweep():
    plain, both = protocol_by_name("paper", CELL), protocol_by_name("paper-mid", CELL)
    middle, end = both.take(np.arange(0, 138, 2)), both.take(np.arange(1, 138, 2))
    assert end.label.tolist() == plain.label.tolist()
    assert middle.label.tolist() == [f"{label}-mid" for label in plain.label]
    assert middle.group.tolist() == end.group.tolist() == plain.label.tolist()
    np.testing.assert_array_equal(end.q_end, plain.q_end)
    np.testing.assert_array_equal(middle.q_start, plain.q_start)
    np.testing.assert_array_equal(end.q_start, plain.q_start)
    np.testing.assert_allclose(2.0 * middle.q_end, plain.q_start + plain.q_end, atol=1e-12)


def test_groups_and_absolute_lengths_get_no_midpoint():
    plan = paper_protocol(CELL).take(np.array([0, 0, 1, 2]))
    plan = replace(
        plan,
        label=np.array(["first", "second", "length", ""]),
        group=np.array(["pair", "pair", "", ""]),
        kind=np.array(["sweep", "sweep", "absolute", "sweep"]),
    )
    halved = add_midpoints(plan)
    assert halved.label.tolist() == ["first", "second", "length", "-mid", ""]
    assert halved.group.tolist() == ["pair", "pair", "", "row 4", "row 4"]
    assert halved.kind.tolist() == ["sweep", "sweep", "absolute", "sweep", "sweep"]
    assert halved.rows.tolist() == [2, 2, 3, 4, 4]
    np.testing.assert_array_equal(halved.q_end[[0, 1, 2, 4]], plan.q_end)
    np.testing.assert_allclose(halved.q_end[3], (plan.q_start[3] + plan.q_end[3]) / 2)
    # Once more: there is nothing left to halve.
    assert add_midpoints(halved).label.tolist() == halved.label.tolist()


def test_midpoints_keep_labels_longer_than_the_others():
    plan = replace(paper_protocol(CELL).take(np.array([0])), label=np.array(["a"]), group=np.array([""]))
    assert add_midpoints(plan).label.tolist() == ["a-mid", "a"]
    assert add_midpoints(plan).group.tolist() == ["a", "a"]


def test_another_chain_is_refused():
    swapped = replace(CELL, joints=CELL.joints[::-1])
    short = replace(CELL, joints=CELL.joints[:5])
    turned = replace(CELL, parameters=ParameterSet(_renominal(p, "alpha_3", 0.0) for p in CELL.parameters))
    for cell in (swapped, short, turned):
        with pytest.raises(InputError, match=r"the paper's protocol is for a chain .* give a sweep file instead"):
            paper_protocol(cell)


def test_a_cell_that_cannot_reach_is_refused():
    tight = replace(CELL.joints[3], low=-0.01, high=0.01)
    with pytest.raises(InputError, match="q4_start_deg: -3 deg is outside"):
        paper_protocol(replace(CELL, joints=(*CELL.joints[:3], tight, *CELL.joints[4:])))


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="unknown protocol 'papers': expected one of paper, paper-mid"):
        protocol_by_name("papers", CELL)
    with pytest.raises(InputError, match="unknown signs 'some'"):
        mark_signs(paper_protocol(CELL), "some")


def test_signs_of_the_paper():
    plan = mark_signs(paper_protocol(CELL), "paper")
    assert sorted(plan.label[plan.signed]) == sorted(x for x in plan.label if x.endswith(("-tx", "-tz")))
    assert plan.signed.sum() == 16
    both = mark_signs(paper_protocol(CELL, midpoints=True), "paper")
    np.testing.assert_array_equal(both.signed, np.repeat(plan.signed, 2))
    assert mark_signs(plan, "all").signed.all()


def test_a_lost_sign_stays_lost():
    measured = read_csv(CASE_A, CELL)
    unsigned = mark_signs(measured, "paper")
    assert (measured.dl < 0).any()
    np.testing.assert_array_equal(unsigned.dl, np.where(unsigned.signed, measured.dl, abs(measured.dl)))
    np.testing.assert_array_equal(mark_signs(unsigned, "all").signed, unsigned.signed)


def test_an_absolute_length_keeps_its_sign():
    plan = paper_protocol(CELL).take(np.array([0, 0]))
    plan = replace(plan, kind=np.array(["absolute", "sweep"]))
    assert mark_signs(plan, "paper").signed.tolist() == [True, False]


def test_single_sweep():
    sweep = single_sweep(CELL, 5, -0.01, 0.02, pose=np.array([1.0, 2.0, 3.0, 0.01, 0.0, 1.0]))
    assert sweep.q_start.tolist() == [[1.0, 2.0, 3.0, 0.01, -0.01, 1.0]]
    assert sweep.q_end.tolist() == [[1.0, 2.0, 3.0, 0.01, 0.02, 1.0]]
    for arguments in ((0, 0.0, 0.1), (7, 0.0, 0.1), (1, 0.0, 200.0), (1, 1.0, 1.0)):
        with pytest.raises(InputError):
            single_sweep(CELL, *arguments)


def _renominal(parameter: Parameter, name: str, nominal: float) -> Parameter:
    return replace(parameter, nominal=nominal) if parameter.name == name else parameter


@pytest.mark.parametrize("readings", [3, 5, 6, 7])
def test_joints_that_stand_still_do_so_at_every_reading(readings):
    """Rounding is no motion: a joint that moves beside others may be refused."""
    random = np.random.default_rng(readings)
    plan = paper_protocol(CELL)
    still = random.uniform(-100.0, 100.0, (len(plan), 6)) * CELL.joint_scales
    moved = plan.q_start != plan.q_end
    plan = replace(plan, q_start=np.where(moved, plan.q_start, still), q_end=np.where(moved, plan.q_end, still))
    rows = read_often(plan, readings)
    np.testing.assert_array_equal(rows.q_start != rows.q_end, np.repeat(moved, readings, axis=0))
    np.testing.assert_array_equal(rows.q_end[readings - 1 :: readings], plan.q_end)
