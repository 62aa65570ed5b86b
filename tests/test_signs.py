from dataclasses import replace

import numpy as np
import pytest

from fpcal_bayes.infer.fit import signs as signs_module
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.fit.signs import DOUBTFUL
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import mark_signs, paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
FREE = CELL.free
PLAN = paper_protocol(CELL)
MODEL = CavityModel.of(CELL)


def measured(number: int, plan: Sweeps = PLAN, cell: Cell = CELL) -> tuple[np.ndarray, Sweeps]:
    """A truth drawn from the prior, and its sweeps with all signs."""
    random = np.random.default_rng(100 + number)
    truth = FREE.nominal + FREE.prior_sd * random.standard_normal(len(FREE))
    model = CavityModel.of(cell)
    dl = model.predict(truth, model.rows(plan.q_start, plan.q_end)) + 0.005 * random.standard_normal(len(plan))
    return truth, plan.with_measurement(dl, 0.005)


def without_signs(sweeps: Sweeps, which: np.ndarray | None = None) -> Sweeps:
    which = np.ones(len(sweeps), dtype=bool) if which is None else which
    return replace(sweeps, signed=sweeps.signed & ~which, dl=np.where(which, np.abs(sweeps.dl), sweeps.dl))


def wrong_signs(result: Identification, sweeps: Sweeps) -> set[str]:
    return set(sweeps.label[result.signs.target != sweeps.dl].tolist())


def is_same_fit(result: Identification, signed: Identification) -> bool:
    """Whether two identifications end in the same point, to a hundredth of a standard deviation."""
    total, expected = result.solution.sum_of_squares, signed.solution.sum_of_squares
    apart = (result.estimate.values - signed.estimate.values) / signed.estimate.sd
    return abs(total - expected) < 1e-6 and bool(np.abs(apart).max() < 0.01)


@pytest.mark.slow
@pytest.mark.usefixtures("minima_only")
@pytest.mark.parametrize("cell", [CELL, CELL.with_opd("perpendicular")], ids=["axis", "perpendicular"])
def test_paper_signs_of_random_truths(cell):
    for number in range(20):
        _, sweeps = measured(number, cell=cell)
        unsigned = mark_signs(sweeps, "paper")
        assert (~unsigned.signed).sum() == 53
        result = identify(cell, unsigned)
        assert result.converged
        assert result.signs.complete
        wrong = wrong_signs(result, sweeps)
        assert wrong <= {label for label, _ in result.doubtful_signs}, number
        signed = identify(cell, sweeps)
        # The right assignment is one of those searched: the sum can only be lower.
        assert result.solution.sum_of_squares <= signed.solution.sum_of_squares + 1e-6
        if not wrong:
            assert is_same_fit(result, signed), number


@pytest.mark.slow
@pytest.mark.usefixtures("minima_only")
def test_no_sign_at_all():
    same = 0
    for number in range(6):
        _, sweeps = measured(number)
        result = identify(CELL, without_signs(sweeps))
        assert result.converged
        assert wrong_signs(result, sweeps) <= {label for label, _ in result.doubtful_signs}, number
        same += is_same_fit(result, identify(CELL, sweeps))
    assert same >= 4


def test_midpoints_and_absolute_lengths():
    plan = paper_protocol(CELL, midpoints=True)
    absolute = replace(PLAN.take(np.array([7])), kind=np.array(["absolute"]))
    sweeps = simulate_um(CELL, paper_truth(CELL), join([plan, absolute]), sigma=0.005, seed=4)
    unsigned = mark_signs(sweeps, "paper")
    assert unsigned.signed[-1]
    result = identify(CELL, unsigned)
    assert wrong_signs(result, sweeps) <= {label for label, _ in result.doubtful_signs}
    assert result.signs.doubt[-1] == 0
    assert result.signs.target[-1] == sweeps.dl[-1]
    # An absolute length has no sign to lose, whatever its row says.
    again = identify(CELL, replace(unsigned, signed=np.zeros(len(unsigned), dtype=bool)))
    assert again.signs.target[-1] == sweeps.dl[-1]
    assert again.signs.doubt[-1] == 0


class TestDoubt:
    @pytest.fixture(scope="class")
    @classmethod
    def sweeps(cls) -> Sweeps:
        """A sweep of an eighth of a micrometre, whose change is about as small as its noise, among the usual ones."""
        truth = paper_truth(CELL)
        tiny = PLAN.take(np.array([51]))
        tiny = replace(tiny, label=np.array(["tiny"]))
        change = 1.0
        scale = 1.0
        for _ in range(60):
            # Shorten the sweep until it changes the length by 1 nm.
            scale *= 0.5 if abs(change) > 0.001 else 1.0
            shorter = replace(tiny, q_end=tiny.q_start + scale * (tiny.q_end - tiny.q_start))
            change = float(MODEL.predict(truth.at(0.0), MODEL.rows(shorter.q_start, shorter.q_end))[0])
        return simulate_um(CELL, truth, join([PLAN, shorter]), sigma=0.005, seed=6)

    def test_a_row_near_zero_is_doubtful(self, sweeps):
        result = identify(CELL, mark_signs(sweeps, "paper"))
        assert [label for label, _ in result.doubtful_signs] == ["tiny"]
        assert DOUBTFUL < result.doubtful_signs[0][1] < 0.9
        (warning,) = (w for w in result.warnings if "sign" in w)
        assert warning.startswith("the sign of 1 sweep is doubtful (probability of the other): tiny (")

    def test_its_probability_is_that_of_the_two_fits(self, sweeps):
        unsigned = mark_signs(sweeps, "paper")
        result = identify(CELL, unsigned)
        flipped = np.where(unsigned.label == "tiny", -result.signs.target, result.signs.target)
        whole = replace(unsigned, signed=np.ones(len(unsigned), dtype=bool))
        sums = [identify(CELL, replace(whole, dl=dl)).solution.sum_of_squares for dl in (result.signs.target, flipped)]
        expected = 1 / (1 + np.exp((sums[1] - sums[0]) / 2))
        assert sums[0] <= sums[1]
        assert result.doubtful_signs[0][1] == pytest.approx(expected, rel=1e-3)

    def test_signed_rows_are_never_in_doubt(self, sweeps):
        assert identify(CELL, sweeps).signs is None
        result = identify(CELL, mark_signs(sweeps, "paper"))
        known = result.problem.sweeps.signed
        assert (result.signs.doubt[known] == 0).all()
        np.testing.assert_array_equal(result.signs.target[known], sweeps.dl[known])


def test_the_size_is_kept():
    _, sweeps = measured(3)
    result = identify(CELL, without_signs(sweeps, np.arange(69) % 2 == 0))
    np.testing.assert_array_equal(np.abs(result.signs.target), np.abs(sweeps.dl))


def test_held_parameters_are_considered_while_signs_are_decided():
    truth = paper_truth(CELL)
    start = identify(CELL, simulate_um(CELL, truth, PLAN, sigma=0.005, seed=1)).estimate
    sweeps = simulate_um(CELL, truth, PLAN, sigma=0.005, seed=2)
    result = identify(CELL, mark_signs(sweeps, "paper"), free="extrinsic", start=start)
    assert wrong_signs(result, sweeps) <= {label for label, _ in result.doubtful_signs}
    assert is_same_fit(result, identify(CELL, sweeps, free="extrinsic", start=start))


def test_a_single_unsigned_sweep():
    _, sweeps = measured(0)
    result = identify(CELL, without_signs(sweeps.take(np.array([2]))))
    # Nothing else says where the mirror is: either sign will do.
    assert result.converged
    assert result.doubtful_signs[0][1] == pytest.approx(0.5, abs=0.05)


def test_a_search_that_reaches_its_limit_still_gives_signs(monkeypatch):
    monkeypatch.setattr(signs_module, "_MAX_FITS", 1)
    _, sweeps = measured(1)
    result = identify(CELL, without_signs(sweeps))
    assert not result.signs.complete
    assert any("ended at its limit" in w for w in result.warnings)
    np.testing.assert_array_equal(np.abs(result.signs.target), np.abs(sweeps.dl))


def few_unsigned(seed: int) -> tuple[np.ndarray, Sweeps, Sweeps]:
    """A truth drawn from the prior, and 10 to 19 sweeps of it with 1 nm of noise, with and without signs."""
    random = np.random.default_rng(seed)
    truth = FREE.nominal + FREE.prior_sd * random.standard_normal(len(FREE))
    n = int(random.integers(10, 20))
    plan = PLAN.take(np.sort(random.choice(len(PLAN), n, replace=False)))
    sweeps = simulate_um(CELL, replace(paper_truth(CELL), times_h=np.zeros(1), values=truth[None]), plan, sigma=0.001,
        seed=seed)  # fmt: skip
    return truth, sweeps, without_signs(sweeps)


def test_a_sign_that_linear_prediction_excludes_is_tried():
    _, sweeps, unsigned = few_unsigned(66)
    found = identify(CELL, unsigned)
    assert found.solution.sum_of_squares < identify(CELL, sweeps).solution.sum_of_squares + 1e-6


@pytest.mark.parametrize("seed", [21, 33, 55])
def test_a_sign_in_doubt_widens_the_estimate(seed):
    truth, _, unsigned = few_unsigned(seed)
    found = identify(CELL, unsigned)
    assert found.doubtful_signs
    assert np.abs((found.estimate.values - truth) / found.estimate.sd).max() < 5.0
