import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import special, stats
from test_cli import error_lines, refused

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit import minimise as least_squares
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior import compare as compare_module
from fpcal_bayes.infer.posterior import draws as draws_module
from fpcal_bayes.infer.posterior import leave_out
from fpcal_bayes.infer.posterior.compare import Comparison, Difference, ModelResult, ModelSpec, compare, parse_models
from fpcal_bayes.infer.posterior.draws import charted_draws, make_target
from fpcal_bayes.infer.posterior.leave_out import (
    LeaveOneOut,
    leave_one_out,
    left_out_each,
    rows_given_others,
    without_row,
)
from fpcal_bayes.infer.posterior.proposal import ProposalMixture
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.infer.posterior.target import PosteriorTarget
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.report.posterior import compare_table
from fpcal_bayes.simulator.sweeps import simulate_um

CASE_A = Path(__file__).parent / "data" / "case_a.csv"
BOTH = "opd=axis,opd=perpendicular"


@pytest.fixture(scope="module")
def case(femto):
    """Case A on the axis path, sampled."""
    found = identify(femto, read_sweeps(CASE_A, femto))
    return sample(found, draws=200, seed=2)


@pytest.fixture(scope="module")
def grouped(femto):
    """Sweeps with midpoints, whose rows share a reading, and their identification."""
    plan = paper_protocol(femto, midpoints=True).take(np.arange(138) < 60)
    truth = Truth(femto.free, np.zeros(1), femto.free.nominal[None] + 0.3 * femto.free.prior_sd)
    return identify(femto, simulate_um(femto, truth, plan, sigma=0.005, seed=3))


def linear_elpd(identification) -> np.ndarray:
    """Leave-one-out densities of independent rows where the model is linear: by residual and leverage alone."""
    problem, at = identification.problem, identification.solution.unknowns
    residuals, jacobian = problem.data_residuals(at), problem.data_jacobian(at)
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.eye(problem.n_unknowns))
    left = 1.0 - np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)
    return stats.norm.logpdf(residuals, scale=np.sqrt(left)) + np.log(left) + np.log(problem.whitening.scale)


class TestLeaveOneOut:
    def test_near_the_linear_formula(self, case):
        found = leave_one_out(case, "gaussian", most_refits=10)
        expected = linear_elpd(case.identification)
        assert found.elpd_rows == pytest.approx(expected, abs=0.35)
        assert found.elpd == pytest.approx(expected.sum(), abs=1.0)
        assert (found.elpd_rows <= found.bound_rows).all()
        assert 14.0 < found.p_loo < 20.0
        assert not found.open.any()

    def test_leaving_out_in_earnest_agrees_where_weights_are_good(self, case):
        """Two ways to the same number: importance weights, and the posterior without the row."""
        weighted = leave_one_out(case, "gaussian", most_refits=0)
        good = np.flatnonzero((weighted.pareto_k > 0.3) & (weighted.pareto_k < 0.5))[:10]
        whole = rows_given_others(case.target, case.points.reshape(-1, case.points.shape[-1])[::4])
        rng = np.random.default_rng(0)
        known = case.identification, case.target
        refitted = [leave_out._left_out(*known, "gaussian", row, whole[:, row], rng) for row in good.tolist()]
        assert len(refitted) == 10
        assert refitted == pytest.approx(weighted.elpd_rows[good].tolist(), abs=0.15)
        assert np.mean(refitted) == pytest.approx(weighted.elpd_rows[good].mean(), abs=0.05)

    def test_rows_that_cannot_be_left_out_have_a_bound(self, case, monkeypatch):
        monkeypatch.setattr(leave_out, "without_row", lambda *_: None)
        found = leave_one_out(case, "gaussian", most_refits=69)
        assert (found.open == found.bad).all()
        assert (found.elpd_rows[found.bad] == found.bound_rows[found.bad]).all()

    def test_grouped_rows_are_given_all_others(self, grouped):
        """Against the conditional of a dense normal distribution."""
        target = PosteriorTarget(grouped.problem)
        points = np.vstack([grouped.solution.unknowns, grouped.solution.unknowns + 0.001])
        found = rows_given_others(target, points)
        factor = np.linalg.inv(grouped.problem.whitening.mix.toarray())
        covariance = factor @ factor.T
        assert np.abs(covariance - np.diag(np.diag(covariance))).max() > 1e-6
        for k, point in enumerate(points):
            error = factor @ grouped.problem.data_residuals(point)
            for row in (0, 1, 31, 58):
                others = np.arange(len(error)) != row
                gain = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, row])
                sd = np.sqrt(covariance[row, row] - gain @ covariance[others, row])
                assert found[k, row] == pytest.approx(stats.norm.logpdf(error[row], gain @ error[others], sd), abs=1e-6)

    def test_many_points(self, case):
        points = case.points.reshape(-1, case.points.shape[-1])[:600]
        found = rows_given_others(case.target, points)
        assert found == pytest.approx(case.target.log_likelihoods(points))

    def test_without_row(self, grouped):
        """The data of the reduced problem are the others, whitened alike."""
        reduced = without_row(grouped, 4).problem
        assert len(reduced.target) == len(grouped.problem.target) - 1
        assert reduced.target.tolist() == np.delete(grouped.problem.target, 4).tolist()
        assert without_row(grouped, 4).converged


def test_weights_that_cannot_be_smoothed():
    """One draw outweighs all others: not to be trusted. All weigh the same: nothing to smooth."""
    row, same = np.random.default_rng(1).normal(-1e5, 1e4, 400), np.full(400, -np.log(400.0))
    row[205] = -1e7
    assert leave_out._smoothed(row, same, 1.0)[1] == np.inf
    assert leave_out._smoothed(np.full(400, -3.0), same, 1.0) == pytest.approx((-3.0, 0.0))


class TestChartedDraws:
    """Independent draws with weights, which take the place of a run where the charts tell enough."""

    def test_agree_with_the_sampler(self, case):
        found = case.identification
        known = charted_draws(found, "gaussian", 1000, np.random.default_rng(4))
        assert known.worth >= 1000
        by_weights = left_out_each(found, known, "gaussian", most_refits=10)
        sampled = leave_one_out(case, "gaussian", most_refits=10)
        assert by_weights.elpd_rows == pytest.approx(sampled.elpd_rows, abs=0.3)
        assert by_weights.elpd == pytest.approx(sampled.elpd, abs=0.5)

    def test_few_sweeps_by_the_ratio_of_evidences(self, femto, monkeypatch):
        """Twelve sweeps leave a long bent posterior: a row given the others is the ratio of two normalising constants.

        The elpd of a row whose weights fail is that of the posterior without it.
        """
        monkeypatch.setattr(leave_out, "_SURE_K", 0.7)
        few = read_sweeps(CASE_A, femto).take(np.arange(69) % 6 == 0)
        found = identify(femto, few)
        known = charted_draws(found, "gaussian", 300, np.random.default_rng(0))
        result = left_out_each(found, known, "gaussian", most_refits=12)
        assert result.refitted.any()
        assert not result.open.any()
        evidence = log_evidence(found)
        for row in (int(np.argmax(result.pareto_k)), int(np.argmin(result.pareto_k))):
            exact = evidence - log_evidence(without_row(found, row))
            assert result.elpd_rows[row] == pytest.approx(exact, abs=0.4)

    def test_none_where_the_charts_tell_too_little(self, case, monkeypatch):
        monkeypatch.setattr(draws_module, "_MOST_CHARTED", 1)
        assert charted_draws(case.identification, "gaussian", 100, np.random.default_rng(0)) is not None
        monkeypatch.setattr(draws_module, "MOST_K", -1.0)
        assert charted_draws(case.identification, "gaussian", 100, np.random.default_rng(0)) is None


def log_evidence(identification, proposals: int = 4000) -> float:
    """Log normalising constant of a posterior by plain importance sampling."""
    target, references = make_target(identification, "gaussian")
    rng = np.random.default_rng(9)
    solved = ProposalMixture(target, references).propose(
        rng.standard_normal((proposals, target.n_unknowns)), rng.random(proposals)
    )
    weights = solved.log_density[solved.inside] - solved.log_proposal[solved.inside]
    return float(special.logsumexp(weights) - np.log(proposals) + target.log_scale.sum())


@pytest.mark.parametrize("y", [0.5, 6.0, 9.0])
def test_bridge_of_normal_densities(y):
    """The density of a reading y of noise 1, x being N(0, 3): N(y; 0, sqrt(10)), also far out and by weighted draws."""
    rng = np.random.default_rng(5)
    found = []
    for _ in range(40):
        known = 0.9 * y + np.sqrt(0.9) * rng.standard_normal(4000)
        free = 4.0 * rng.standard_normal(512)
        weights = np.exp(0.5 * (free / 4.0) ** 2 - 0.5 * (free / 3.0) ** 2)
        weights /= weights.sum()
        by_row = stats.norm.logpdf(y, known), stats.norm.logpdf(y, free)
        found.append(leave_out._bridge(*by_row, weights, 1.0 / (weights**2).sum()))
    error = np.std(found) / np.sqrt(len(found))
    assert error < 0.04
    assert np.mean(found) == pytest.approx(stats.norm.logpdf(y, scale=np.sqrt(10.0)), abs=4.0 * error)


class TestModels:
    def test_parsed(self, femto):
        models = parse_models("opd=axis, opd=perpendicular+likelihood=slip,likelihood=slip", femto)
        assert [(m.name, m.opd, m.likelihood) for m in models] == [
            ("opd=axis", "axis", "gaussian"),
            ("opd=perpendicular+likelihood=slip", "perpendicular", "slip"),
            ("likelihood=slip", "axis", "slip"),
        ]
        assert models[1].words == "the perpendicular path with fringe slips"

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("opd=axis", "at least two"),
            ("opd=axis,likelihood=gaussian", "the same model"),
            ("opd=axis,opd=oblique", "axis or perpendicular"),
            ("opd=axis,noise=student", "found 'noise=student'"),
            ("opd=axis,", "found ''"),
        ],
    )
    def test_refused(self, femto, text, said):
        with pytest.raises(InputError, match=said):
            parse_models(text, femto)


def stand_in(opd: str, elpd: float, *, p_value: float = 0.5, k: float = 0.2, converged: bool = True) -> ModelResult:
    """A model of 20 rows that is told about, not sampled."""
    rows = np.full(20, elpd / 20) + 0.1 * np.random.default_rng(len(opd)).standard_normal(20)
    fit = SimpleNamespace(chi2_data=2700.0 if p_value < 1e-3 else 20.0, expected=18.0, p_value=p_value)
    sweeps = SimpleNamespace(signed=np.ones(20, bool), absolute=np.zeros(20, bool), group=np.full(20, ""))
    problem = SimpleNamespace(target=rows, sweeps=sweeps)
    solution = SimpleNamespace(sum_of_squares=fit.chi2_data)
    identification = SimpleNamespace(
        converged=converged, fit=fit, problem=problem, solution=solution, starts=10, machine=None
    )
    loo = LeaveOneOut(rows, rows + 0.1, np.full(20, k), 0.7, np.zeros(20, bool))
    return ModelResult(ModelSpec(f"opd={opd}", opd, "gaussian"), identification, loo if converged else None)


def compared(*models: ModelResult) -> Comparison:
    return Comparison(models, compare_module._differences(models))


class TestVerdict:
    def test_favoured(self):
        found = compared(stand_in("axis", -400.0), stand_in("perpendicular", 12.0))
        difference = found.differences[0]
        assert difference.clear
        assert (difference.better.opd, difference.worse.opd) == ("perpendicular", "axis")
        rows = [m.loo.elpd_rows for m in found.models]
        assert difference.elpd == pytest.approx((rows[1] - rows[0]).sum())
        assert difference.se == pytest.approx(np.sqrt(20) * (rows[1] - rows[0]).std())
        assert found.verdict.startswith("the data favour the perpendicular path by 41")

    def test_open(self):
        found = compared(stand_in("axis", 11.0), stand_in("perpendicular", 12.0))
        assert "cannot be told apart" in found.verdict
        assert not found.differences[0].clear

    def test_uncertain_difference_is_open(self):
        spec = ModelSpec("a", "axis", "gaussian")
        assert not Difference(spec, spec, 30.0, 20.0, False).clear
        assert Difference(spec, spec, 30.0, 10.0, False).clear

    def test_a_few_rows_that_reject_a_model_are_enough(self):
        spec = ModelSpec("a", "axis", "gaussian")
        assert Difference(spec, spec, 300.0, 200.0, False, rejected=True).clear
        assert compared(stand_in("axis", 0.0, p_value=1e-9), stand_in("perpendicular", 12.0)).differences[0].rejected

    def test_a_model_that_fits_comes_first(self):
        """A poor fit is no winner, whatever it predicts."""
        found = compared(stand_in("axis", 20.0, p_value=1e-9), stand_in("perpendicular", 12.0))
        assert found.differences[0].better.opd == "perpendicular"
        assert "rejected by its own fit" in found.verdict
        assert "chi-square 2,700 where 18 is expected" in found.verdict

    def test_bound(self):
        found = compared(stand_in("axis", -400.0, k=0.9), stand_in("perpendicular", 12.0))
        assert "by at least " in found.verdict
        assert "20 rows with a Pareto k too large" in found.warnings[-1]

    def test_none_sampled(self):
        found = compared(stand_in("axis", 0.0, converged=False), stand_in("perpendicular", 0.0, converged=False))
        assert not found.sound
        assert "no minimum was found from 10 starting points" in found.verdict
        assert "nothing can be compared" in found.verdict
        assert found.content()["difference"] is None

    def test_none_fits(self):
        found = compared(stand_in("axis", 20.0, p_value=1e-9), stand_in("perpendicular", 12.0, p_value=1e-9))
        assert found.sound
        assert "none of the models fits" in found.verdict


class TestData:
    """Both paths on data of either."""

    def test_perpendicular_data(self, femto, monkeypatch):
        """The axis path is rejected by its own fit."""
        monkeypatch.setattr(compare_module, "_POOR_REFITS", 0)
        cell = femto.with_opd("perpendicular")
        values = cell.free.nominal + 0.5 * cell.free.prior_sd
        truth = Truth(cell.free, np.zeros(1), values[None])
        sweeps = simulate_um(cell, truth, paper_protocol(cell), sigma=0.005, seed=1)
        found = compare(cell, sweeps, parse_models(BOTH, cell), draws=100)
        axis, perpendicular = found.models
        assert axis.poor
        assert axis.identification.fit.p_value < 1e-3
        assert perpendicular.fits
        assert "the axis path does not fit" in found.verdict
        assert found.sound
        assert found.differences[0].better.opd == "perpendicular"
        assert found.verdict.startswith("the data favour the perpendicular path by ")
        assert len(compare_table(found, "t").rows) == 2

    def test_grouped_rows_need_gaussian_noise(self, femto, grouped):
        models = parse_models("likelihood=slip,likelihood=gaussian", femto)
        with pytest.raises(InputError, match="rows that share a reading"):
            compare(femto, grouped.problem.sweeps, models)

    def test_sampling_that_fails_is_said(self, femto, monkeypatch, case):
        failed = replace(case, failures=("nested R-hat 1.2",))
        monkeypatch.setattr(compare_module, "charted_draws", lambda *_: None)
        monkeypatch.setattr(compare_module, "sample", lambda *_, **__: failed)
        found = compare(femto, read_sweeps(CASE_A, femto), parse_models(BOTH, femto))
        assert not found.sound
        assert "the axis path is not compared: its posterior could not be sampled (nested R-hat 1.2)" in found.verdict


class TestCommand:
    def test_axis_data(self, capsys, tmp_path, monkeypatch):
        monkeypatch.setattr(compare_module, "_POOR_REFITS", 0)
        out = tmp_path / "out.json"
        assert main(["compare", str(CASE_A), "--models", BOTH, "--draws", "100", "--json", str(out)]) == 0
        text, err = capsys.readouterr()
        written = json.loads(out.read_text())
        assert (written["schema"], written["command"]) == ("fpcal/1", "compare")
        axis, perpendicular = written["models"]
        assert axis["fits"]
        assert axis["elpd"] == pytest.approx(252.5, abs=1.5)
        assert axis["bad_k"] <= axis["refitted"] < 20
        assert not perpendicular["fits"]
        assert perpendicular["elpd"] < -500.0
        assert written["verdict"].startswith("the data favour the axis path")
        assert f"verdict: {written['verdict']}" in text
        assert all(line.startswith("fpcal: warning: ") for line in error_lines(err))

    def test_nothing_fits(self, capsys, monkeypatch):
        monkeypatch.setattr(least_squares, "_MAX_EVALUATIONS", 1)
        monkeypatch.setattr(least_squares, "_POLISH_STEPS", 0)
        assert main(["compare", str(CASE_A), "--models", BOTH, "--quiet"]) == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert "nothing can be compared" in err

    def test_refused(self, capsys, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert "--models" in refused(capsys, "compare", CASE_A)
        assert "at least two" in refused(capsys, "compare", CASE_A, "--models", "opd=axis")
        assert "no session 'x'" in refused(capsys, "compare", CASE_A, "--models", BOTH, "--session", "x")
        assert "missing.csv" in refused(capsys, "compare", "missing.csv", "--models", BOTH)
