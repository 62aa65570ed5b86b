"""Draws that an estimate hands on: the posterior's, around all of its minima, and what a file of them may hold."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import DATA
from numpy.testing import assert_allclose, assert_array_equal

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.posterior.draws import draws_content, independent_draws
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.infer.tasks.source import read_estimate_draws, read_knowledge
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
FREE = CELL.free


@pytest.fixture(scope="module")
def found() -> Identification:
    return identify(CELL, read_sweeps(DATA / "case_a.csv", CELL))


@pytest.fixture
def file(found: Identification, tmp_path: Path) -> Path:
    path = tmp_path / "e.json"
    path.write_text(json.dumps({"schema": "fpcal/1", **found.content(), **draws_content(found, 40)}))
    return path


def test_agrees_with_another_program(found: Identification) -> None:
    """Means and standard deviations of NUTS draws made by a program that shares no code with this one."""
    reference = json.loads((DATA / "case_a.posterior.json").read_text())
    mean, sd = (np.array([reference[key][name] for name in FREE.names]) for key in ("mean", "sd"))
    draws = FREE.to_shown(independent_draws(found, 4000))
    assert draws.shape == (4000, 21)
    assert (np.abs(draws.mean(axis=0) - mean) < 0.1 * sd).all()
    assert_allclose(draws.std(axis=0), sd, rtol=0.1)


@pytest.mark.slow
def test_both_minima_have_their_share() -> None:
    """Truth 28 drawn from the prior has two minima of nearly the same depth; the sampler tells what each is worth."""
    random = np.random.default_rng(5)
    values = [FREE.nominal + FREE.prior_sd * random.standard_normal(21) for _ in range(29)][-1]
    truth = Truth(FREE, np.zeros(1), values[None])
    found = identify(CELL, simulate_um(CELL, truth, paper_protocol(CELL), sigma=0.005, seed=28))
    first, second = (found.problem.values(m.unknowns) for m in (found.solution, found.other_minima[0]))

    def share(draws: np.ndarray) -> float:
        apart = (second - first) / FREE.prior_sd**2
        return float(np.mean((draws - first) @ apart > (second - first) @ apart / 2))

    # 128 walkers over 20 steps: a share is known to 0.02.
    sampled = share(sample(found, draws=100, seed=1, max_steps=30).values().reshape(-1, 21))
    assert 0.2 < sampled < 0.8
    assert share(independent_draws(found, 2000)) == pytest.approx(sampled, abs=0.08)


def test_same_seed_same_draws(found: Identification) -> None:
    assert_array_equal(independent_draws(found, 50, seed=3), independent_draws(found, 50, seed=3))
    assert (independent_draws(found, 50, seed=3) != independent_draws(found, 50, seed=4)).any()


def test_a_file_gives_them_back(found: Identification, file: Path) -> None:
    draws = read_estimate_draws(file, CELL)
    assert draws is not None
    assert draws.parameters.names == FREE.names
    # Ten digits after the point, in um and deg.
    assert_allclose(FREE.to_shown(draws.values), FREE.to_shown(independent_draws(found, 40)), rtol=0, atol=1e-10)
    knowledge = read_knowledge(file, CELL)
    held, task = knowledge.plan("circle", n_points=5)
    assert_allclose(held.values, found.estimate.values, rtol=1e-12)
    prediction = knowledge.predict(held, task)
    assert (prediction.linear, prediction.errors.shape) == (False, (40, 5))


def test_held_parameters_leave_the_covariance_only(tmp_path: Path) -> None:
    sweeps = read_sweeps(DATA / "case_a.csv", CELL)
    found = identify(CELL, sweeps, free="extrinsic")
    assert draws_content(found) == {}
    path = tmp_path / "e.json"
    path.write_text(json.dumps({"schema": "fpcal/1", **found.content()}))
    assert read_estimate_draws(path, CELL) is None
    knowledge = read_knowledge(path, CELL)
    assert knowledge.predict(*knowledge.plan("circle", n_points=5), draws=10).linear


@pytest.mark.parametrize(
    ("names", "rows", "expected"),
    [
        (FREE.names[:-1], [[0.0] * 20], "key draws.names: expected the parameters above, in this order"),
        (FREE.names[::-1], [[0.0] * 21], "key draws.names"),
        (FREE.names, [], "key draws.rows: expected rows of 21 finite numbers, one or more"),
        (FREE.names, [[0.0] * 20], "key draws.rows"),
        (FREE.names, [[0.0] * 21, [0.0]], "key draws.rows"),
        (FREE.names, [[float("nan")] * 21], "key draws.rows"),
        (FREE.names, [["x"] * 21], "key draws.rows"),
        (FREE.names, {"a": 1}, "key draws.rows"),
    ],
)
def test_other_draws_are_refused(file: Path, names: tuple[str, ...], rows: Any, expected: str) -> None:
    content = json.loads(file.read_text())
    content["draws"] = {"names": list(names), "rows": rows}
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match=expected):
        read_estimate_draws(file, CELL)


def test_sds_cover_a_second_solution():
    """Truths from the prior at end points: errors of every parameter over its stated sd, the quartiles aside."""
    cell, off, first_order = load_cell(mechanics="none"), [], []
    for seed in (36, 45, 49):
        values = cell.free.nominal + cell.free.prior_sd * np.random.default_rng([seed, 5]).standard_normal(21)
        truth = Truth(cell.free, np.zeros(1), values[None])
        found = identify(cell, simulate_um(cell, truth, paper_protocol(cell), sigma=0.005, seed=2 * seed), seed=seed)
        stated = found.estimate
        laplace = found.problem.covariance(found.solution.unknowns)
        off.append(np.abs((values - stated.values) / stated.sd).max())
        first_order.append(np.abs((values - stated.values) / np.sqrt(np.diag(laplace))).max())
    assert max(off) < 4.0
    assert max(first_order) > 5.0
