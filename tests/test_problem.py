from dataclasses import replace

import numpy as np
import pytest
from path_length import path_length

from fpcal_bayes.infer.fit.minimise import gauss_newton
from fpcal_bayes.infer.fit.noise import whitening_of
from fpcal_bayes.infer.fit.problem import Considered, Problem
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
SHAKY = replace(
    CELL, joints=tuple(replace(j, repeatability=1e-6 if j.kind == "revolute" else 1e-3) for j in CELL.joints)
)
CASES = [
    (cell.with_opd(opd), mid) for cell in (CELL, SHAKY) for opd in ("axis", "perpendicular") for mid in (False, True)
]


def measured(cell: Cell, midpoints: bool, rows: slice | None = None) -> Sweeps:
    plan = paper_protocol(cell, midpoints=midpoints)
    plan = plan if rows is None else plan.take(np.arange(len(plan))[rows])
    absolute = replace(paper_protocol(cell).take(np.array([7])), kind=np.array(["absolute"]))
    return simulate_um(cell, paper_truth(cell), join([plan, absolute]), sigma=0.005, seed=3)


def somewhere(problem: Problem, seed: int = 0, size: float = 0.5) -> np.ndarray:
    return size * np.random.default_rng(seed).standard_normal(problem.n_unknowns)


def considering(cell: Cell, sweeps: Sweeps, free: str = "extrinsic", seed: int = 8) -> Problem:
    """A problem whose held parameters have a full, random covariance and are not nominal."""
    chosen = cell.select(free)
    held = type(chosen)(p for p in cell.free if p.name not in chosen)
    random = np.random.default_rng(seed)
    mix = random.standard_normal((len(held), len(held))) / 20
    vector = cell.parameters.nominal.copy()
    vector[held.slots] += 0.1 * held.prior_sd * random.standard_normal(len(held))
    covariance = mix @ mix.T * np.outer(held.prior_sd, held.prior_sd)
    return Problem.of(CavityModel.of(cell, chosen, vector), sweeps, Considered.of(held, covariance))


@pytest.mark.parametrize(("cell", "midpoints"), CASES)
def test_residuals_are_whitened_prediction_minus_measurement_then_the_prior(cell, midpoints):
    sweeps = measured(cell, midpoints, slice(0, 12))
    problem = Problem.of(CavityModel.of(cell), sweeps)
    unknowns = somewhere(problem)
    values = cell.free.nominal + cell.free.prior_sd * unknowns
    vector = CavityModel.of(cell).vector(values)

    def length(q: np.ndarray) -> float:
        return float(path_length(cell, vector, q))

    predicted = np.array([length(end) - length(start) for start, end in zip(sweeps.q_start, sweeps.q_end, strict=True)])
    predicted[-1] = length(sweeps.q_end[-1])
    # The measurement covariance is that of the nominal cell until the problem is relinearised.
    whitening = whitening_of(CavityModel.of(cell), sweeps, cell.free.nominal)
    expected = np.concatenate([whitening.apply(predicted - sweeps.dl), unknowns])
    np.testing.assert_allclose(problem.residuals(unknowns), expected, atol=1e-6)
    assert problem.depends_on_point == bool(cell.repeatability.any())


@pytest.mark.parametrize(("cell", "midpoints"), CASES)
def test_jacobian_against_central_differences(cell, midpoints):
    problem = Problem.of(CavityModel.of(cell), measured(cell, midpoints))
    unknowns = somewhere(problem)
    jacobian = problem.jacobian(unknowns)
    width = 1e-3
    for i, shift in enumerate(width * np.eye(problem.n_unknowns)):
        ahead, behind, ahead2, behind2 = (problem.residuals(unknowns + f * shift) for f in (1, -1, 2, -2))
        numeric = (8 * (ahead - behind) - (ahead2 - behind2)) / (12 * width)
        assert np.linalg.norm(numeric - jacobian[:, i]) < 1e-7 * np.linalg.norm(jacobian[:, i])


@pytest.mark.parametrize("considered", [False, True])
@pytest.mark.parametrize("midpoints", [False, True])
def test_gradients_are_jacobian_times_residuals(midpoints, considered):
    sweeps = measured(CELL, midpoints)
    problem = considering(CELL, sweeps) if considered else Problem.of(CavityModel.of(CELL), sweeps)
    points = np.random.default_rng(1).standard_normal((5, problem.n_unknowns))
    expected = [problem.jacobian(point).T @ problem.residuals(point) for point in points]
    np.testing.assert_allclose(problem.gradients(points), expected, rtol=1e-10)


def test_gradients_of_many_points_go_through_in_blocks():
    problem = Problem.of(CavityModel.of(CELL), measured(CELL, False))
    points = np.random.default_rng(1).standard_normal((1600, problem.n_unknowns))
    # One block holds fewer points than these.
    assert len(points) * len(problem.target) * problem.n_unknowns > 2_000_000
    together = problem.gradients(points)
    for i in (0, 688, 689, 690, 691, 1599):
        np.testing.assert_allclose(together[i], problem.gradients(points[i : i + 1])[0], rtol=1e-12)


@pytest.mark.parametrize("cell", [CELL, SHAKY])
def test_take_keeps_rows_targets_prior_and_considered_parameters(cell):
    sweeps = measured(cell, False)
    problem = considering(cell, sweeps).with_target(np.arange(70.0))
    chosen = np.arange(70) % 3 == 0
    part = problem.take(chosen)
    np.testing.assert_array_equal(part.target, np.arange(0.0, 70.0, 3))
    assert part.sweeps.label.tolist() == sweeps.label[chosen].tolist()
    unknowns = somewhere(problem)
    np.testing.assert_allclose(part.data_residuals(unknowns), problem.data_residuals(unknowns)[chosen], rtol=1e-12)
    np.testing.assert_allclose(part.data_jacobian(unknowns), problem.data_jacobian(unknowns)[chosen], rtol=1e-12)
    np.testing.assert_array_equal(part.residuals(unknowns)[-problem.n_unknowns :], unknowns)


def test_take_of_part_of_a_group_keeps_the_correlation_of_what_is_left():
    sweeps = measured(CELL, True, slice(0, 6))
    problem = Problem.of(CavityModel.of(CELL), sweeps)
    alone = problem.take(np.array([True, False, True, True, False, True, False]))
    assert alone.whitening.mix is not None
    white = alone.whitening.apply(np.eye(4))
    correlation = np.linalg.inv(white.T @ white) / 0.005**2
    np.testing.assert_allclose(correlation, np.eye(4) + 0.5 * np.eye(4)[[0, 2, 1, 3]] * [[0], [1], [1], [0]], atol=1e-9)


def test_scaled_unknowns_and_values_are_inverse():
    problem = considering(CELL, measured(CELL, False))
    values = problem.values(somewhere(problem))
    again = problem.unknowns(values)
    np.testing.assert_allclose(problem.values(again), values, rtol=1e-12)
    assert (again[problem.n_free :] == 0).all()


@pytest.mark.parametrize(("cell", "midpoints"), CASES)
def test_covariance_is_the_inverse_of_information_and_prior(cell, midpoints):
    problem = Problem.of(CavityModel.of(cell), measured(cell, midpoints))
    unknowns = somewhere(problem)
    sd = cell.free.prior_sd
    information = problem.data_jacobian(unknowns) / sd
    information = information.T @ information + np.diag(sd**-2)
    product = problem.covariance(unknowns) @ information * np.outer(1 / sd, sd)
    np.testing.assert_allclose(product, np.eye(len(sd)), atol=1e-6)


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_a_direction_that_no_row_sees_keeps_its_prior_variance(opd):
    cell = CELL.with_opd(opd)
    sweeps = simulate_um(cell, paper_truth(cell), paper_protocol(cell), sigma=0.005, seed=3)
    problem = Problem.of(CavityModel.of(cell), sweeps)
    truth = paper_truth(cell).at(0.0)
    sd, free = cell.free.prior_sd, cell.free
    scaled = problem.covariance(problem.unknowns(truth)) / np.outer(sd, sd)
    unseen = np.zeros((len(free), 3))
    if opd == "axis":
        # The fibre slides along its own axis.
        fibre = free.positions(["x_wf", "y_wf", "z_wf"])
        unseen[fibre, 0] = chain.optical_axis(cell, CavityModel.of(cell).vector(truth)) / sd[fibre]
    else:
        unseen[free.positions(["beta_wf", "theta_wf", "z_et"]), [0, 1, 2]] = 1.0
    np.testing.assert_allclose(scaled @ unseen, unseen, atol=1e-9 * np.abs(unseen).max())
    share = np.diag(scaled)
    assert ((share > 0) & (share < 1 + 1e-9)).all()
    assert share.min() < 1e-3


class TestConsidered:
    """Held parameters whose covariance counts, against the Kalman and Schmidt formulas with dense matrices."""

    @pytest.fixture(params=[CELL, SHAKY, CELL.with_opd("perpendicular")], ids=["axis", "shaky", "perpendicular"])
    def problem(self, request):
        problem = considering(request.param, measured(request.param, True))
        return problem.relinearised(somewhere(problem, 4, 0.3))

    @staticmethod
    def dense(problem, unknowns):
        """R, Jx, Jc, Px, Pc in um and rad at `unknowns`, and the innovation of the linearised problem."""
        cell, free, considered = problem.model.cell, problem.model.free, problem.considered
        values = problem.values(unknowns)
        white = problem.whitening.apply(np.eye(len(problem.target)))
        noise = np.linalg.inv(white.T @ white)
        _, by_free = problem.model.predict_with_jacobian(values, problem.rows)
        vector = problem.model.vector(values)
        held = CavityModel.of(cell, considered.parameters, vector)
        predicted, by_held = held.predict_with_jacobian(vector[considered.parameters.slots], problem.rows)
        innovation = problem.target - predicted - by_free @ (free.nominal - values)
        return noise, by_free, by_held, np.diag(free.prior_sd**2), considered.factor @ considered.factor.T, innovation

    def test_estimate_is_that_of_inflated_noise(self, problem):
        # Both sides are linear here: one Gauss-Newton step from the point of linearisation is the whole estimate.
        unknowns = somewhere(problem, 4, 0.3)
        unknowns[problem.n_free :] = 0
        noise, by_free, by_held, prior, held, innovation = self.dense(problem, unknowns)
        inflated = noise + by_held @ held @ by_held.T
        gain = prior @ by_free.T @ np.linalg.inv(by_free @ prior @ by_free.T + inflated)
        expected = problem.model.free.nominal + gain @ innovation
        step, _ = gauss_newton(problem, unknowns, problem.residuals(unknowns))
        sd = problem.model.free.prior_sd
        np.testing.assert_allclose((problem.values(unknowns + step) - expected) / sd, 0, atol=2e-6)
        # The held parameters do move this estimate.
        exact = prior @ by_free.T @ np.linalg.inv(by_free @ prior @ by_free.T + noise) @ innovation
        assert np.abs((exact + problem.model.free.nominal - expected) / sd).max() > 0.01

    def test_covariance_is_schmidts(self, problem):
        unknowns = somewhere(problem, 4, 0.3)
        noise, by_free, by_held, prior, held, _ = self.dense(problem, unknowns)
        inflated = noise + by_held @ held @ by_held.T
        gain = prior @ by_free.T @ np.linalg.inv(by_free @ prior @ by_free.T + inflated)
        n = problem.n_free
        found = problem.covariance(unknowns)
        sd = np.concatenate([problem.model.free.prior_sd, problem.considered.parameters.prior_sd])
        found = found / np.outer(sd, sd)
        expected = np.zeros_like(found)
        reduced = np.eye(n) - gain @ by_free
        # Joseph's form, which rounding does not spoil.
        expected[:n, :n] = reduced @ prior @ reduced.T + gain @ inflated @ gain.T
        expected[:n, n:] = -gain @ by_held @ held
        expected[n:, :n] = expected[:n, n:].T
        expected[n:, n:] = held
        np.testing.assert_allclose(found, expected / np.outer(sd, sd), atol=1e-7)
        np.testing.assert_allclose(found, found.T, atol=1e-14)
        assert np.linalg.eigvalsh(found).min() > -1e-12

    def test_a_held_covariance_may_be_singular_or_zero(self):
        sweeps = measured(CELL, False)
        chosen = CELL.select("extrinsic")
        held = CELL.select("intrinsic")
        direction = np.linspace(-0.01, 0.01, len(held)) * held.prior_sd
        line = Problem.of(CavityModel.of(CELL, chosen), sweeps, Considered.of(held, np.outer(direction, direction)))
        np.testing.assert_allclose(
            line.considered.factor @ line.considered.factor.T / np.outer(held.prior_sd, held.prior_sd),
            np.outer(direction, direction) / np.outer(held.prior_sd, held.prior_sd),
            atol=1e-16,
        )
        none = Problem.of(CavityModel.of(CELL, chosen), sweeps, Considered.of(held, np.zeros((len(held), len(held)))))
        exact = Problem.of(CavityModel.of(CELL, chosen), sweeps)
        at = np.zeros(none.n_unknowns)
        n = exact.n_free
        np.testing.assert_allclose(none.covariance(at)[:n, :n], exact.covariance(at[:n]), rtol=1e-9)
        assert (none.covariance(at)[n:] == 0).all()
        # More uncertainty in what is held never makes what is free more certain.
        assert (np.diag(line.covariance(at))[:n] >= np.diag(exact.covariance(at[:n])) * (1 - 1e-12)).all()
