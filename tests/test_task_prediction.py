"""Predicted task errors: draws, bands, probabilities; posterior files; both propagations agree where they should."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose
from task_fixtures import paper_estimate

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.draws import independent_draws
from fpcal_bayes.infer.posterior.netcdf import read_posterior, read_posterior_summary
from fpcal_bayes.infer.tasks.error import linear_task_sd, peak_to_peak, task_errors, task_jacobian
from fpcal_bayes.infer.tasks.prediction import predict_from_covariance, predict_from_draws
from fpcal_bayes.infer.tasks.source import Knowledge, read_knowledge
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.motion.tasks import TASKS, task_path
from fpcal_bayes.simulator.sweeps import simulate_um


def write_posterior(path: Path, cell: Cell, values: np.ndarray, **attributes: object) -> None:
    """A file such as ``fpcal sample`` writes, of draws (n, n_free) in um and rad."""
    with h5py.File(path, "w") as file:
        file.attrs.update({"cell_sha256": cell.sha256, "cell_name": cell.name, "opd": cell.opd, "converged": 1})
        file.attrs.update(attributes)
        group = file.create_group("posterior")
        for parameter, column in zip(cell.free, cell.free.to_shown(values).T, strict=True):
            group[parameter.name] = column.reshape(2, -1)
            group[parameter.name].attrs["units"] = parameter.unit


def test_bands_follow_from_the_covariance(femto: Cell) -> None:
    estimate = paper_estimate(femto)
    task = task_path(femto, estimate.vector(), "circle", n_points=13)
    prediction = predict_from_covariance(estimate, task, draws=20_000, seed=1)
    jacobian = task_jacobian(CavityModel.of(femto), estimate.values, task)
    sd = linear_task_sd(jacobian, estimate.covariance)
    assert_allclose(prediction.sd, sd, rtol=1e-12)
    assert_allclose(prediction.errors.std(axis=0), sd, rtol=0.03)
    assert_allclose(prediction.band()[1] - prediction.band()[0], 2 * 1.96 * sd, rtol=0.05)
    low, high = prediction.peak_to_peak_band()
    assert prediction.exceeds(low) == pytest.approx(0.975, abs=0.001)
    assert prediction.exceeds(high) == pytest.approx(0.025, abs=0.001)
    assert prediction.exceeds(1e3) == 0.0
    again = predict_from_covariance(estimate, task, draws=20_000, seed=1)
    assert_allclose(again.errors, prediction.errors, rtol=0, atol=0)


def test_small_draws_give_the_linear_prediction(femto: Cell) -> None:
    """Where the posterior is narrow its curvature does not matter."""
    estimate = paper_estimate(femto)
    narrow = replace(estimate, covariance=1e-8 * estimate.covariance)
    task = task_path(femto, estimate.vector(), "tilt-x", n_points=7)
    model, random = CavityModel.of(femto), np.random.default_rng(0)
    draws = random.multivariate_normal(estimate.values, narrow.covariance, size=5000, method="eigh")
    nonlinear = predict_from_draws(model, draws, estimate.values, task)
    linear = predict_from_covariance(narrow, task, draws=5000)
    assert not nonlinear.linear
    assert linear.linear
    assert_allclose(nonlinear.sd, linear.sd, rtol=0.05, atol=1e-12)
    assert_allclose(nonlinear.peak_to_peak_band(), linear.peak_to_peak_band(), rtol=0.1)


@pytest.mark.slow
@pytest.mark.usefixtures("minima_only")
def test_true_peak_to_peak_lies_in_its_band(femto: Cell) -> None:
    """40 calibrations of cells drawn from the prior: 200 bands of 95 %, of which 8 in 10 must hold at the very least.

    `fpcal study coverage --replicates 1000` does it a thousand times.
    """
    model, plan, random = CavityModel.of(femto), paper_protocol(femto), np.random.default_rng(0)
    inside = []
    for _ in range(40):
        values = femto.free.nominal + femto.free.prior_sd * random.standard_normal(len(femto.free))
        truth = Truth(femto.free, np.zeros(1), values[None])
        sweeps = simulate_um(femto, truth, plan, sigma=0.005, seed=int(random.integers(2**31)))
        found = identify(femto, sweeps)
        held, draws = found.estimate.values, independent_draws(found)
        for name in TASKS[:-1]:
            task = task_path(femto, found.estimate.vector(), name, n_points=13)
            low, high = np.quantile(peak_to_peak(task_errors(model, draws, held, task)), [0.025, 0.975])
            inside.append(low <= peak_to_peak(task_errors(model, values, held, task))[0] <= high)
    # Tasks of one calibration are correlated: the standard deviation of the share is up to 3.5 %.
    assert 0.85 <= np.mean(inside) <= 1.0


def test_posterior_files_are_read(femto: Cell, tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    values = femto.free.nominal + 1e-3 * femto.free.prior_sd * random.standard_normal((40, len(femto.free)))
    file = tmp_path / "posterior.nc"
    write_posterior(file, femto, values)
    draws = read_posterior(file, femto)
    assert draws.parameters.names == femto.free.names
    assert_allclose(draws.values, values, rtol=1e-12)
    assert len(draws.thinned(11).values) == 10
    knowledge = read_knowledge(file, femto)
    estimate, task = knowledge.plan("circle", n_points=5)
    assert any(np.allclose(estimate.values, draw, rtol=0, atol=1e-12) for draw in values)
    prediction = knowledge.predict(estimate, task)
    assert prediction.errors.shape == (40, 5)
    assert not prediction.linear
    model = CavityModel.of(femto)
    assert_allclose(prediction.errors, task_errors(model, values, estimate.values, task), rtol=0, atol=1e-9)
    # The draw that is held lies in the middle of the others.
    assert (np.abs(prediction.errors.mean(axis=0)) < prediction.errors.std(axis=0)).all()


def test_held_estimate_beside_draws(femto: Cell, tmp_path: Path) -> None:
    estimate = paper_estimate(femto)
    random = np.random.default_rng(4)
    values = estimate.values + 1e-4 * femto.free.prior_sd * random.standard_normal((40, len(femto.free)))
    file = tmp_path / "posterior.nc"
    write_posterior(file, femto, values)
    knowledge = Knowledge(femto, estimate, read_posterior(file, femto))
    held, task = knowledge.plan("line-z", n_points=5)
    assert held is estimate
    assert knowledge.predict(held, task).errors.shape == (40, 5)


def test_a_posterior_file_opens_no_other_and_promises_no_more_than_it_holds(femto: Cell, tmp_path: Path) -> None:
    values = np.tile(femto.free.nominal, (4, 1))
    file, other = tmp_path / "posterior.nc", tmp_path / "other.nc"
    write_posterior(other, femto, values)

    def changed(change: Callable[[h5py.File], object], message: str) -> None:
        write_posterior(file, femto, values)
        with h5py.File(file, "r+") as handle:
            change(handle)
        for read in (read_posterior, read_posterior_summary):
            with pytest.raises(InputError, match=message):
                read(file, femto)

    def put(handle: h5py.File, name: str, value: object) -> None:
        del handle[name]
        handle[name] = value

    far = h5py.ExternalLink("other.nc", "/posterior")
    changed(lambda handle: put(handle, "posterior", far), "found a link, which is not followed")
    far = h5py.ExternalLink("other.nc", "/posterior/alpha_2")
    changed(lambda handle: put(handle, "posterior/alpha_2", far), "found a link, which is not followed")
    for name in ("cell_sha256", "converged", "content_sha256"):
        value = ["x", "y"] if name.endswith("256") else [1, 1]
        changed(lambda handle, n=name, v=value: handle.attrs.create(n, v), f"attribute {name}: expected a single value")
    changed(lambda handle: handle["posterior/alpha_2"].attrs.create("units", ["deg"] * 3), "expected a single value")

    def huge(handle: h5py.File) -> None:
        del handle["posterior/alpha_2"]
        data = handle["posterior"].create_dataset("alpha_2", (1 << 20, 1 << 20), "f8", chunks=(1, 1024))
        data.attrs["units"] = "deg"

    changed(huge, "alpha_2: the file holds more than 1024 MiB")


def test_bad_posterior_files_are_refused(femto: Cell, tmp_path: Path) -> None:
    values = np.tile(femto.free.nominal, (4, 1))
    file = tmp_path / "posterior.nc"
    write_posterior(file, femto.with_opd("perpendicular"), values)
    with pytest.raises(InputError, match="the draws are of another cell \\('femto-st', opd 'perpendicular'\\)"):
        read_posterior(file, femto)
    write_posterior(file, femto, values, converged=0)
    with pytest.raises(InputError, match="the sampling did not converge"):
        read_posterior(file, femto)
    values[1, 2] = np.nan
    write_posterior(file, femto, values)
    with pytest.raises(InputError, match="posterior/alpha_3: expected finite numbers"):
        read_posterior(file, femto)
    with h5py.File(file, "r+") as handle:
        handle["posterior/alpha_2"].attrs["units"] = "rad"
    with pytest.raises(InputError, match="posterior/alpha_2: expected the units 'deg', found 'rad'"):
        read_posterior(file, femto)
    with h5py.File(file, "r+") as handle:
        del handle["posterior"]
    with pytest.raises(InputError, match="/posterior: the group is missing"):
        read_posterior(file, femto)
    with h5py.File(file, "w") as handle:
        handle["posterior"] = 1.0
    with pytest.raises(InputError, match="attribute cell_sha256: missing"):
        read_posterior(file, femto)
    file.write_text("draws")
    with pytest.raises(InputError, match="not a netCDF file of draws"):
        read_posterior(file, femto)
    with pytest.raises(InputError, match="no such file"):
        read_posterior(tmp_path / "none.nc", femto)


def test_estimate_of_another_cell_is_refused(femto: Cell) -> None:
    estimate = paper_estimate(femto)
    task = task_path(femto.with_opd("perpendicular"), estimate.vector(), "circle", n_points=5)
    with pytest.raises(InputError, match="expected the same cell"):
        predict_from_covariance(estimate, task)
