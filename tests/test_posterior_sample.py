import json
import shutil

import numpy as np
import pytest
from conftest import DATA
from numpy.testing import assert_allclose

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.posterior import sample as sample_module
from fpcal_bayes.infer.posterior.checkpoint import BlockStore
from fpcal_bayes.infer.posterior.draws import Posterior
from fpcal_bayes.infer.posterior.sample import BLOCK_STEPS, identity, sample
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.measure.protocol import single_sweep
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.model.cell.cell import Cell

DRAWS = 300


@pytest.fixture(scope="module")
def found(femto) -> Identification:
    return identify(femto, read_sweeps(DATA / "case_a.csv", femto))


@pytest.fixture(scope="module")
def run(found, tmp_path_factory) -> tuple[Posterior, BlockStore, list[tuple[float, float]]]:
    """A run, the store it filled, and what it told of its progress: effective draws, and the share that is done."""
    store, told = BlockStore(tmp_path_factory.mktemp("run") / "blocks", identity(found.problem, 4)), []
    result = sample(found, draws=DRAWS, seed=4, store=store, progress=lambda *look: told.append(look))
    return result, store, told


@pytest.fixture(scope="module")
def posterior(run) -> Posterior:
    return run[0]


@pytest.fixture(scope="module")
def long(found) -> Posterior:
    return sample(found, draws=10_000, seed=1)


@pytest.fixture(scope="module")
def reference(found) -> dict[str, np.ndarray]:
    content = json.loads((DATA / "case_a.posterior.json").read_text())
    names = found.free.names
    keys = ("mean", "sd", "quantiles_5_25_50_75_95")
    return {key: np.array([content[key][name] for name in names]) for key in keys}


@pytest.fixture(scope="module")
def draws(long) -> np.ndarray:
    return long.identification.free.to_shown(long.values().reshape(-1, 21))


@pytest.mark.slow
class TestCaseA:
    """Against draws by a program that shares no code with this one."""

    def test_converged(self, long):
        assert long.converged
        assert long.diagnostics.effective >= 10_000

    def test_means(self, draws, reference):
        assert (np.abs(draws.mean(axis=0) - reference["mean"]) < 0.06 * reference["sd"]).all()

    def test_sds(self, draws, reference):
        assert_allclose(draws.std(axis=0), reference["sd"], rtol=0.05)

    def test_quantiles(self, draws, reference):
        quantiles = np.quantile(draws, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0).T
        difference = np.abs(quantiles - reference["quantiles_5_25_50_75_95"]) / reference["sd"][:, None]
        assert difference.max() < 0.12


class TestRun:
    def test_converged(self, posterior):
        assert posterior.converged
        assert posterior.failures == ()
        assert posterior.diagnostics.effective >= DRAWS

    def test_shapes(self, posterior):
        n_ensembles, n_steps, n_walkers, n = posterior.points.shape
        assert (n_ensembles, n_walkers, n) == (4, 32, 21)
        assert posterior.log_density.shape == (4, n_steps, 32)
        values = posterior.values()
        assert values.shape == (128, n_steps, 21)
        # A chain is one walker: its values are that walker's points.
        problem = posterior.identification.problem
        assert_allclose(values[33], problem.values(posterior.points[1, :, 1]), rtol=0, atol=0)

    def test_density_belongs_to_the_points(self, posterior):
        problem = posterior.identification.problem
        for point, density in zip(posterior.points[2, 7, :5], posterior.log_density[2, 7, :5], strict=True):
            residuals = problem.residuals(point)
            assert density == pytest.approx(-0.5 * residuals @ residuals, abs=1e-5)

    def test_same_seed_same_draws(self, found, posterior):
        again = sample(found, draws=DRAWS, seed=4)
        assert (again.points == posterior.points).all()
        assert again.evaluations == posterior.evaluations

    def test_other_seed_other_draws(self, found, posterior):
        other = sample(found, draws=DRAWS, seed=5, max_steps=60)
        assert not np.isin(other.points[:, -1, :, 0], posterior.points[..., 0]).any()

    def test_ensembles_differ(self, posterior):
        assert len(np.unique(posterior.points[:, 0, :, 0])) == 128

    def test_progress(self, run):
        result, _, told = run
        assert all(0.0 <= share <= 1.0 for _, share in told)
        assert told[-1] == (result.diagnostics.effective, 1.0)

    def test_a_limit_ends_it_with_what_failed(self, found):
        result = sample(found, draws=10**6, seed=4, max_steps=70)
        assert not result.converged
        assert result.points.shape[1] <= 70
        assert any("effective draws of the worst parameter, expected 1000000" in text for text in result.failures)


class TestStore:
    def test_going_on_from_any_block_gives_the_same(self, found, run, tmp_path):
        first, whole, _ = run
        blocks = whole.read()
        for n_kept in (1, len(blocks) - 2, len(blocks)):
            part = BlockStore(tmp_path / f"part{n_kept}", identity(found.problem, 4))
            for number, block in enumerate(blocks[:n_kept]):
                part.append(number, block)
            result = sample(found, draws=DRAWS, seed=4, store=part)
            assert (result.points == first.points).all()
            assert (result.log_density == first.log_density).all()
            assert result.outside == first.outside
            assert len(part.read()) == len(blocks)

    def test_more_draws_later_go_on(self, found, run, tmp_path):
        few, whole, _ = run
        store = BlockStore(shutil.copytree(whole.folder, tmp_path / "run"), identity(found.problem, 4))
        began = len(store.read())
        more = sample(found, draws=8000, seed=4, store=store)
        assert more.points.shape[1] > few.points.shape[1]
        assert (more.points[:, : few.points.shape[1]] == few.points).all()
        assert len(store.read()) > began
        assert len(store.read()) * BLOCK_STEPS == more.points.shape[1] + BLOCK_STEPS
        # And fewer again: what is there beyond is not looked at.
        assert (sample(found, draws=DRAWS, seed=4, store=store).points == few.points).all()

    def test_identity(self, found, femto):
        own = identity(found.problem, 4)
        assert own == identity(identify(femto, read_sweeps(DATA / "case_a.csv", femto)).problem, 4)
        sweeps = found.problem.sweeps
        others = [
            identity(found.problem, 5),
            identity(found.problem, 4, "slip"),
            identity(found.problem.with_target(found.problem.target + 1e-9), 4),
            identity(identify(femto, sweeps.take(np.arange(68))).problem, 4),
            identity(identify(load_cell(opd="perpendicular", mechanics="none"), sweeps).problem, 4),
            identity(identify(femto, sweeps, free="extrinsic", hold="exact").problem, 4),
        ]
        assert len({own, *others}) == 1 + len(others)
        # What is held by its prior alone is unknown: the same posterior.
        assert own == identity(identify(femto, sweeps, free="extrinsic").problem, 4)

    def test_blocks_of_other_data_are_refused(self, found, tmp_path):
        store = BlockStore(tmp_path / "run", identity(found.problem, 4))
        sample(found, draws=1, seed=4, store=store, max_steps=60)
        with pytest.raises(InputError, match="other data"):
            sample(found, draws=1, seed=4, store=BlockStore(store.folder, identity(found.problem, 6)), max_steps=60)


class TestHeldParameters:
    def test_uncertain_held_parameters_are_unknowns(self, femto, found):
        result = sample(identify(femto, found.problem.sweeps, free="extrinsic"), draws=200)
        assert result.points.shape[-1] == 21
        assert result.values().shape[-1] == 8
        assert len(result.diagnostics.rhat) == 8
        assert result.converged


class TestUnsigned:
    """Rows of which only the size is known."""

    @staticmethod
    def one_parameter(femto: Cell, sizes: list[float], sigma: float, signed: list[bool]) -> Identification:
        """A cell with theta_et alone free, which a translation along X sees; dl is about 300 um times its change."""
        plan = join([single_sweep(femto, 3, -150e0, 150e0), single_sweep(femto, 3, -100e0, 100e0)])
        sweeps = plan.with_measurement(np.array(sizes), sigma)
        sweeps.signed[:] = signed
        return identify(femto, sweeps, free=["theta_et"], hold="exact")

    @staticmethod
    def by_quadrature(found: Identification) -> tuple[np.ndarray, np.ndarray]:
        """Scaled unknowns and their weights, by the density of a folded normal."""
        problem = found.problem
        unknowns = np.linspace(-6.0, 6.0, 20_001)[:, None]
        predicted = problem.model.predict(problem.values(unknowns), problem.rows)
        sweeps = problem.sweeps

        def normal(target: np.ndarray) -> np.ndarray:
            return np.exp(-0.5 * ((predicted - target) / sweeps.sigma) ** 2)

        rows = np.where(sweeps.signed, normal(sweeps.dl), normal(sweeps.dl) + normal(-sweeps.dl))
        weights = rows.prod(axis=1) * np.exp(-0.5 * unknowns[:, 0] ** 2)
        return unknowns[:, 0], weights / weights.sum()

    def check(self, found: Identification) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        result = sample(found, draws=6000, seed=2)
        assert result.converged
        draws = result.points.reshape(-1)
        unknowns, weights = self.by_quadrature(found)
        mean = weights @ unknowns
        sd = np.sqrt(weights @ (unknowns - mean) ** 2)
        error = 1.0 / np.sqrt(result.diagnostics.effective)
        assert abs(draws.mean() - mean) < 4 * sd * error
        assert draws.std() == pytest.approx(sd, rel=0.05)
        return draws, unknowns, weights

    @pytest.mark.parametrize("sizes", [[0.1, 0.2], [0.3, 0.6], [0.6, 0.9]])
    def test_near_zero_both_signs_mix(self, femto, sizes):
        found = self.one_parameter(femto, sizes, 0.4, [False, False])
        draws, unknowns, weights = self.check(found)
        right = weights[unknowns > 0].sum()
        assert 0.4 < right < 0.6
        assert (draws > 0).mean() == pytest.approx(right, abs=0.03)

    def test_one_signed_row_decides(self, femto):
        # The signed row says which side; the other one has the smaller noise.
        plan = self.one_parameter(femto, [-2.0, 1.5], 0.6, [True, False])
        draws, unknowns, weights = self.check(plan)
        assert (draws > 0).mean() == pytest.approx(weights[unknowns > 0].sum(), abs=0.02)

    def test_clear_signs_change_nothing(self, femto):
        """Known and unknown signs give the same posterior where the data leave no doubt."""
        with_sign = self.one_parameter(femto, [-3.0, -2.0], 0.1, [True, True])
        without = self.one_parameter(femto, [-3.0, 2.0], 0.1, [True, False])
        one, other = (sample(found, draws=2000, seed=2) for found in (with_sign, without))
        assert_allclose(other.points, one.points, rtol=0, atol=1e-9)

    def test_signs_left_open_are_called_doubtful(self, femto):
        """Far from zero, with no row that is signed, the mirror image counts as much."""
        found = self.one_parameter(femto, [3.0, 2.0], 0.05, [False, False])
        assert [probability for _, probability in found.doubtful_signs] == pytest.approx([0.5, 0.5], abs=0.01)

    def test_signs_left_open_are_sampled(self, femto):
        found = self.one_parameter(femto, [3.0, 2.0], 0.05, [False, False])
        draws, unknowns, weights = self.check(found)
        assert (draws > 0).mean() == pytest.approx(weights[unknowns > 0].sum(), abs=0.03)


def test_settings_that_the_store_depends_on(found, monkeypatch):
    before = identity(found.problem, 4)
    monkeypatch.setattr(sample_module, "N_WALKERS", 64)
    assert identity(found.problem, 4) != before
