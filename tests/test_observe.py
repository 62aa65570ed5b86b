"""What `observe` finds on the paper's sweeps, on plans and measurements, on too little data, and how fast."""

import json
import subprocess
import sys
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.spectrum import spectrum_of
from fpcal_bayes.infer.observability.observe import observe, whitened_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.report.observe import observe_html, print_observability

CELLS = {opd: load_cell(opd=opd, mechanics="none") for opd in ("axis", "perpendicular")}
CELL = CELLS["axis"]


def measured(cell: Cell, plan: Sweeps, seed: int = 0) -> Sweeps:
    model = CavityModel.of(cell)
    exact = model.predict(paper_truth(cell).at(0.0), model.rows(plan.q_start, plan.q_end, plan.absolute))
    return plan.with_measurement(exact + 0.005 * np.random.default_rng(seed).standard_normal(len(plan)), 0.005)


def with_absolute(plan: Sweeps, sigma: float) -> Sweeps:
    row = replace(plan.take(np.array([0])), kind=np.array(["absolute"]), group=np.array([""]))
    return join([plan, replace(row, sigma=np.full(1, sigma))])


@pytest.mark.parametrize(
    ("opd", "midpoints", "rank"),
    [("axis", False, 16), ("axis", True, 17), ("perpendicular", False, 14), ("perpendicular", True, 15)],
)
def test_ranks_at_fifty_truths(opd, midpoints, rank):
    cell = CELLS[opd]
    model, random = CavityModel.of(cell), np.random.default_rng(7)
    plan = paper_protocol(cell, midpoints=midpoints)
    for number in range(50):
        values = cell.free.nominal + cell.free.prior_sd * random.standard_normal(len(cell.free))
        sigma = (0.0001, 0.005, 0.1)[number % 3]
        sweeps = plan.with_measurement(np.zeros(len(plan)), sigma).take(random.permutation(len(plan)))
        for used, expected in ((sweeps, rank), (with_absolute(sweeps, sigma), rank + 1)):
            spectrum = spectrum_of(whitened_jacobian(model, used, values))
            assert spectrum.rank == expected
            assert spectrum.gap > 1e6


def test_rank_does_not_depend_on_units_of_length():
    # The same cell told in mm: every length and its prior a thousandth of what they were.
    model, values = CavityModel.of(CELL), paper_truth(CELL).at(0.0)
    plan = paper_protocol(CELL)
    rows = model.rows(plan.q_start, plan.q_end)
    _, jacobian = model.predict_with_jacobian(values, rows)
    length = np.array([p.unit == "um" for p in CELL.free])
    in_mm = jacobian * np.where(length, 1.0, 1e-3)
    prior_mm = CELL.free.prior_sd * np.where(length, 1e-3, 1.0)
    one, other = spectrum_of(jacobian * CELL.free.prior_sd / 0.005), spectrum_of(in_mm * prior_mm / 5e-6)
    assert one.rank == other.rank == 16
    np.testing.assert_allclose(one.singular_values[:16], other.singular_values[:16], rtol=1e-8)


def test_theta_wf_is_exactly_invisible_with_the_third_column():
    cell = replace(CELL, optical_axis="z")
    model, plan = CavityModel.of(cell), paper_protocol(cell)
    _, jacobian = model.predict_with_jacobian(paper_truth(cell).at(0.0), model.rows(plan.q_start, plan.q_end))
    assert (jacobian[:, cell.free.position("theta_wf")] == 0.0).all()
    result = observe(cell, plan)
    assert ("theta_wf",) in [gauge.parameters for gauge in result.gauges]
    assert result.status[cell.free.position("theta_wf")] == "gauge"


def test_exactly_at_nominal_the_rank_is_fifteen():
    sweeps = paper_protocol(CELL).with_measurement(np.zeros(69), 0.005)
    assert spectrum_of(whitened_jacobian(CavityModel.of(CELL), sweeps, CELL.free.nominal)).rank == 15
    # A plan is therefore linearised away from nominal.
    assert set(observe(CELL, paper_protocol(CELL)).ranks) == {16}


def test_plan_and_measurement():
    plan = observe(CELL, paper_protocol(CELL))
    found = observe(CELL, measured(CELL, paper_protocol(CELL)))
    assert plan.identification is None
    assert len(plan.ranks) == 16
    assert found.identification is not None
    assert found.identification.converged
    assert found.ranks == (16,)
    np.testing.assert_array_equal(
        found.values, found.identification.problem.values(found.identification.solution.unknowns)
    )
    assert plan.content()["observability"]["linearised_at"] == "prior draws"
    assert found.content()["fit"]["converged"]
    # Statuses agree with those of the identification.
    assert found.status == found.identification.estimate.status


def test_status_rules():
    result = observe(CELL, measured(CELL, paper_protocol(CELL)))
    for i, status in enumerate(result.status):
        left = result.covariance[i, i]
        assert status == ("gauge" if result.spectrum.null_share[i] > 0.1 else "weak" if left > 0.5 else "identified")
    assert {"gauge", "identified"} == set(result.status)
    np.testing.assert_allclose(result.contraction, 1.0 - np.diag(result.covariance))


def test_strongest_correlations():
    result = observe(CELL, measured(CELL, paper_protocol(CELL)))
    (first, value), *_ = result.strongest_correlations("alpha_2")
    assert first == "beta_wf"
    sd = np.sqrt(np.diag(result.covariance))
    i, j = CELL.free.positions(["alpha_2", "beta_wf"])
    assert value == pytest.approx(result.covariance[i, j] / sd[i] / sd[j])
    assert value > 0.99


def test_blocks():
    result = observe(CELL, paper_protocol(CELL))
    blocks = {block.name: (block.n_rows, block.spectrum.rank) for block in result.blocks}
    assert blocks["all"] == (69, 16)
    assert blocks["all, midpoints"] == (138, 17)
    assert blocks["all, absolute length"] == (70, 17)
    assert blocks["all, midpoints, absolute length"] == (139, 18)
    assert blocks["rotations"][0] == 45
    assert blocks["translations"][0] == 24


def test_noise_and_order_of_a_plan_change_no_rank():
    plan = paper_protocol(CELL)
    shuffled = plan.take(np.random.default_rng(0).permutation(69))
    reference = observe(CELL, plan)
    for sigma in (0.0001, 0.1):
        again = observe(CELL, shuffled, sigma=sigma)
        assert again.ranks == reference.ranks
        assert [g.parameters for g in again.gauges] == [g.parameters for g in reference.gauges]


def _alike() -> Sweeps:
    plan = paper_protocol(CELL)
    return Sweeps.of_um_rad(plan.q_start[[0] * 30], plan.q_end[[0] * 30], label=[f"again {i}" for i in range(30)])


@pytest.mark.parametrize("few", ["five", "one", "alike"])
@pytest.mark.parametrize("with_data", [False, True])
def test_too_little_data_is_a_report(few, with_data):
    plan = {
        "five": paper_protocol(CELL).take(np.arange(5)),
        "one": paper_protocol(CELL).take(np.array([0])),
        "alike": _alike(),
    }[few]
    result = observe(CELL, measured(CELL, plan) if with_data else plan)
    assert result.spectrum.rank == {"five": 5, "one": 1, "alike": 1}[few]
    assert len(result.gauges) == 21 - result.spectrum.rank
    assert len(result.base) == result.spectrum.rank
    text = StringIO()
    print_observability(result, few, Console(file=text, width=120))
    assert f"{result.spectrum.rank} of 21 combinations are seen" in text.getvalue()
    assert few in observe_html(result, few)
    json.dumps(result.content(), allow_nan=False)


def test_data_of_zero_change_are_a_report():
    # Nothing moved the light: the fit turns fibre and mirror so that it cannot.
    result = observe(CELL, paper_protocol(CELL).with_measurement(np.zeros(69), 0.005))
    assert len(result.gauges) == 21 - result.spectrum.rank


def test_candidates_are_ranked():
    plan = paper_protocol(CELL)
    result = observe(CELL, plan.take(np.arange(45)))
    bits = [bits for _, bits in result.candidates]
    assert len(bits) == 46
    assert bits == sorted(bits, reverse=True)
    assert bits[0] > 1.0


def test_default_candidates_are_midpoints_and_one_absolute_length():
    labels = {label for label, _ in observe(CELL, paper_protocol(CELL)).candidates}
    assert labels == {"absolute length"} | {f"{label}-mid" for label in paper_protocol(CELL).label}


def test_bad_arguments_are_refused():
    plan = paper_protocol(CELL)
    with pytest.raises(InputError, match="every row is of kind path"):
        observe(CELL, replace(plan, kind=np.full(69, "path")))


_WHOLE_TRACES = """
import resource
import numpy as np
from fpcal_bayes.infer.observability.observe import observe
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.io.cell import load_cell

cell, points = load_cell(mechanics="none"), 400
plan = paper_protocol(cell)
observe(cell, plan)
share = np.arange(1, points + 1)[None, :, None] / points
ends = (plan.q_start[:, None] + share * (plan.q_end - plan.q_start)[:, None]).reshape(-1, 6)
names = np.repeat(plan.label, points)
sweeps = Sweeps.of_um_rad(np.repeat(plan.q_start, points, axis=0), ends, label=names, group=names)
if {measured}:
    model, random = CavityModel.of(cell), np.random.default_rng(0)
    exact = model.predict(paper_truth(cell).at(0.0), model.rows(sweeps.q_start, sweeps.q_end))
    noise = random.standard_normal(len(sweeps)) + np.repeat(random.standard_normal(69), points)
    sweeps = sweeps.with_measurement(exact + 0.005 / np.sqrt(2) * noise, 0.005)
result = observe(cell, sweeps)
print(result.spectrum.rank, len(result.information.labels),
      resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
"""


@pytest.mark.slow
@pytest.mark.parametrize("measured", [False, True])
def test_whole_traces_fit_into_a_gibibyte(measured):
    program = _WHOLE_TRACES.replace("{measured}", str(measured))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    rank, n_sweeps, gibibytes = (float(word) for word in done.stdout.split())
    assert (rank, n_sweeps) == (17, 69)
    assert gibibytes < 1.0
