import json

import arviz as az
import numpy as np
import pytest
from conftest import DATA
from numpy.testing import assert_allclose

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.draws import Posterior
from fpcal_bayes.infer.posterior.netcdf import content, data_tree, summarise, write_netcdf
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

GROUPS = {"posterior", "prior", "sample_stats", "log_likelihood", "posterior_predictive", "observed_data"}


@pytest.fixture(scope="module")
def posterior(femto) -> Posterior:
    return sample(identify(femto, read_sweeps(DATA / "case_a.csv", femto)), draws=500, seed=2)


@pytest.fixture(scope="module")
def in_groups(femto) -> Posterior:
    """A few draws with midpoints, whose rows share readings."""
    plan = paper_protocol(femto, midpoints=True)
    found = identify(femto, simulate_um(femto, paper_truth(femto), plan, sigma=0.005, seed=5))
    return sample(found, draws=100, seed=2, max_steps=60)


@pytest.fixture(scope="module")
def tree(posterior, tmp_path_factory):
    """Written and read again."""
    path = tmp_path_factory.mktemp("tree") / "posterior.nc"
    write_netcdf(data_tree(posterior, seed=2, command="fpcal sample"), path)
    with az.from_netcdf(path) as opened:
        return opened.load()


class TestTree:
    def test_groups(self, tree):
        assert set(tree.children) == GROUPS

    def test_draws_in_the_units_a_person_reads(self, tree, posterior):
        parameters = posterior.identification.free
        shown = parameters.to_shown(posterior.values())
        for i, p in enumerate(parameters):
            entry = tree["posterior"][p.name]
            assert entry.dims == ("chain", "draw")
            assert (entry.values == shown[:, :, i]).all()
            assert entry.attrs["units"] == p.unit
            assert entry.attrs["long_name"] == p.latex
            assert tree["prior"][p.name].attrs["units"] == p.unit

    def test_prior(self, tree, posterior):
        for p in posterior.identification.free:
            draws = tree["prior"][p.name].values
            sd = p.prior_sd / p.scale
            assert draws.mean() == pytest.approx(p.nominal / p.scale, abs=5 * sd / np.sqrt(draws.size))
            assert draws.std() == pytest.approx(sd, rel=5 / np.sqrt(2 * draws.size))

    def test_labels_and_data(self, tree, posterior):
        sweeps = posterior.identification.problem.sweeps
        for group in ("log_likelihood", "posterior_predictive", "observed_data"):
            assert tree[group]["sweep"].values.tolist() == sweeps.label.tolist()
        assert (tree["observed_data"]["dl_um"].values == sweeps.dl).all()
        assert tree["observed_data"]["dl_um"].attrs["units"] == "um"
        assert tree["posterior_predictive"]["dl_um"].attrs["units"] == "um"

    def test_attributes(self, tree, posterior):
        cell = posterior.identification.estimate.cell
        assert tree.attrs["cell_name"] == cell.name
        assert tree.attrs["cell_sha256"] == cell.sha256
        assert tree.attrs["opd"] == "axis"
        assert tree.attrs["seed"] == 2
        assert tree.attrs["converged"] == 1
        assert tree.attrs["n_ensembles"] == 4
        assert tree.attrs["command"] == "fpcal sample"

    def test_arviz_agrees_with_the_summary(self, tree, posterior):
        summary = summarise(posterior)
        found = az.ess(tree, method="bulk")
        for name, entry in summary.items():
            draws = tree["posterior"][name].values
            assert entry["mean"] == pytest.approx(draws.mean())
            assert entry["sd"] == pytest.approx(draws.std(ddof=1))
            assert entry["ess_bulk"] == pytest.approx(float(found[name]))


class TestRows:
    """What is said of each row, without and with rows that share a reading."""

    @pytest.fixture(params=["alone", "in groups"])
    def case(self, request, posterior, in_groups):
        chosen = posterior if request.param == "alone" else in_groups
        return chosen, data_tree(chosen, seed=3, command="")

    def test_likelihoods_sum_to_that_of_the_draw(self, case):
        posterior, tree = case
        problem = posterior.identification.problem
        n = posterior.points.shape[-1]
        total = tree["log_likelihood"]["dl_um"].values.sum(axis=-1)
        n_kept = total.shape[1]
        every = -(-posterior.points.shape[1] // n_kept)
        unknowns = posterior.points.transpose(0, 2, 1, 3).reshape(128, -1, n)[:, ::every]
        covariance = _covariance_of_rows(problem)
        log_volume = np.linalg.slogdet(2.0 * np.pi * covariance)[1]
        precision = np.linalg.inv(covariance)
        for chain, draw in ((0, 0), (70, 5), (127, n_kept - 1)):
            residual = problem.model.predict(problem.values(unknowns[chain, draw]), problem.rows) - problem.target
            expected = -0.5 * (residual @ precision @ residual + log_volume)
            assert total[chain, draw] == pytest.approx(expected, abs=1e-5)
        # And with the prior's share they are the density that was sampled.
        densities = posterior.log_density.transpose(0, 2, 1).reshape(128, -1)[:, ::every]
        squares = (unknowns**2).sum(axis=-1)
        assert_allclose(total - 0.5 * squares - densities, -0.5 * log_volume, rtol=0, atol=1e-5)

    def test_predictions_scatter_as_the_noise_says(self, case):
        posterior, tree = case
        problem = posterior.identification.problem
        predicted = tree["posterior_predictive"]["dl_um"].values
        every = -(-posterior.points.shape[1] // predicted.shape[1])
        unknowns = posterior.points.transpose(0, 2, 1, 3).reshape(128, -1, posterior.points.shape[-1])[:, ::every]
        mean = problem.model.predict(problem.values(unknowns.reshape(-1, unknowns.shape[-1])), problem.rows)
        noise = (predicted.reshape(mean.shape) - mean) / problem.sweeps.sigma
        correlation = _covariance_of_rows(problem) / np.outer(problem.sweeps.sigma, problem.sweeps.sigma)
        assert_allclose(noise.T @ noise / len(noise), correlation, rtol=0, atol=7 / np.sqrt(len(noise)))

    def test_long_runs_are_thinned(self, posterior, monkeypatch):
        monkeypatch.setattr("fpcal_bayes.infer.posterior.netcdf._KEPT_CELLS", 128 * 69 * 10)
        thin = data_tree(posterior, seed=3, command="")
        n_draws = thin["posterior"].sizes["draw"]
        assert n_draws == posterior.points.shape[1]
        assert n_draws // 20 < thin["log_likelihood"].sizes["draw"] <= 10


class TestContent:
    def test_contract(self, posterior):
        written = json.loads(json.dumps(content(posterior), allow_nan=False))
        keys = {"mean", "sd", "q05", "q25", "q50", "q75", "q95", "ess_bulk", "ess_tail", "rhat", "value", "unit"}
        for p in posterior.identification.free:
            entry = written["parameters"][p.name]
            assert keys <= set(entry)
            assert entry["value"] == entry["mean"]
            quantiles = [entry[key] for key in ("q05", "q25", "q50", "q75", "q95")]
            assert quantiles == sorted(quantiles)
        sampler = written["sampler"]
        assert {"draws", "evaluations", "seconds", "acceptance", "min_ess", "max_rhat"} <= set(sampler)
        assert sampler["draws"] == posterior.log_density.size
        assert sampler["evaluations"] == posterior.evaluations
        bulk = [entry["ess_bulk"] for entry in written["parameters"].values()]
        assert sampler["min_ess"] == min(bulk)
        assert sampler["max_rhat"] == max(entry["rhat"] for entry in written["parameters"].values())
        assert sampler["converged"] is True
        assert 0.3 < sampler["acceptance"] < 1.0
        assert written["fit"]["n_sweeps"] == 69

    def test_covariance(self, posterior):
        stated = content(posterior)["covariance"]
        parameters = posterior.identification.free
        assert stated["names"] == list(parameters.names)
        draws = parameters.to_shown(posterior.values().reshape(-1, 21))
        assert_allclose(stated["matrix"], np.cov(draws.T))

    def test_one_free_parameter(self, femto, posterior):
        sweeps = posterior.identification.problem.sweeps
        result = sample(identify(femto, sweeps, free=["z_et"], hold="exact"), draws=50, max_steps=60)
        assert np.shape(content(result)["covariance"]["matrix"]) == (1, 1)


def _covariance_of_rows(problem) -> np.ndarray:
    """Rows that share the reading at their start have correlation 1/2."""
    sweeps = problem.sweeps
    same = (sweeps.group[:, None] == sweeps.group) & (sweeps.group != "")
    correlation = np.where(same, 0.5, 0.0)
    np.fill_diagonal(correlation, 1.0)
    return correlation * np.outer(sweeps.sigma, sweeps.sigma)
