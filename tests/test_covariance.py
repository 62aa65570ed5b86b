from dataclasses import replace

import numpy as np
import pytest
from path_length import path_length

from fpcal_bayes.infer.fit.noise import whitening_of
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sharing import Sharing
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell

CELL = load_cell(mechanics="none")


def shaky(cell: Cell, revolute: float = 2e-6, prismatic: float = 0.004) -> Cell:
    """The cell with joints that repeat to `revolute` rad and `prismatic` um, a different one for each joint."""
    joints = [
        replace(joint, repeatability=(revolute if joint.kind == "revolute" else prismatic) * (1 + 0.3 * i))
        for i, joint in enumerate(cell.joints)
    ]
    return replace(cell, joints=tuple(joints))


def some_sweeps() -> Sweeps:
    """Sweeps alone, two groups (one of three rows), absolute lengths, and a group of a single row; mixed up."""
    sigma = np.array([0.004, 0.005, 0.007])
    with_mid = paper_protocol(CELL, midpoints=True).take(np.r_[0:4, 100, 101, 102])
    three = paper_protocol(CELL).take(np.array([5, 5, 5]))
    three = replace(three, group=np.array(["three"] * 3), q_end=three.q_end * np.array([[1.0], [0.9], [0.8]]))
    absolute = replace(paper_protocol(CELL).take(np.array([3, 50])), kind=np.array(["absolute"] * 2))
    sweeps = join([with_mid, three, absolute])
    per_group = {name: sigma[i % 3] for i, name in enumerate(sorted(set(sweeps.group.tolist())))}
    sweeps = sweeps.with_measurement(
        np.zeros(len(sweeps)),
        np.array([per_group[g] if g else sigma[i % 3] for i, g in enumerate(sweeps.group.tolist())]),
    )
    return sweeps.take(np.random.default_rng(1).permutation(len(sweeps)))


def dense_covariance(cell: Cell, sweeps: Sweeps, values: np.ndarray) -> np.ndarray:
    """Covariance A A' of rows made from independent errors: two readings a row and the joints at both ends.

    Rows of a group share the reading and the joints at their start. Derivatives by the joints are central differences
    of the 4x4 model.
    """
    vector = CavityModel.of(cell).vector(values)
    n, joints = sweeps.q_start.shape

    def slopes(q: np.ndarray) -> np.ndarray:
        widths = np.where(cell.revolute, 1e-4, 0.1)
        ahead = [path_length(cell, vector, q + w * unit) for w, unit in zip(widths, np.eye(joints), strict=True)]
        behind = [path_length(cell, vector, q - w * unit) for w, unit in zip(widths, np.eye(joints), strict=True)]
        return (np.array(ahead) - np.array(behind)) / (2 * widths)

    columns: dict[object, np.ndarray] = {}

    def add(source: object, row: int, amount: float) -> None:
        columns.setdefault(source, np.zeros(n))[row] += amount

    for i in range(n):
        group = (str(sweeps.session[i]), str(sweeps.group[i])) if sweeps.group[i] else i
        absolute = sweeps.kind[i] == "absolute"
        add(("end reading", i), i, sweeps.sigma[i] / (1 if absolute else np.sqrt(2)))
        for j, slope in enumerate(slopes(sweeps.q_end[i])):
            add(("end joint", i, j), i, slope * cell.repeatability[j])
        if not absolute:
            add(("start reading", group), i, -sweeps.sigma[i] / np.sqrt(2))
            for j, slope in enumerate(slopes(sweeps.q_start[i])):
                add(("start joint", group, j), i, -slope * cell.repeatability[j])
    errors = np.array(list(columns.values()))
    return errors.T @ errors


@pytest.fixture(scope="module")
def values() -> np.ndarray:
    return CELL.free.nominal + 0.7 * CELL.free.prior_sd * np.random.default_rng(4).standard_normal(len(CELL.free))


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
@pytest.mark.parametrize("repeats", [False, True])
@pytest.mark.parametrize("grouped", [False, True])
def test_whitening_undoes_the_dense_covariance(values, opd, repeats, grouped):
    cell = (shaky(CELL) if repeats else CELL).with_opd(opd)
    sweeps = some_sweeps()
    if not grouped:
        sweeps = replace(sweeps, group=np.full(len(sweeps), ""))
    whitening = whitening_of(CavityModel.of(cell), sweeps, values)
    covariance = dense_covariance(cell, sweeps, values)
    if repeats:
        # The joints matter here, and unequally.
        shares = np.diag(covariance) / sweeps.sigma**2
        assert shares.max() > 1.5
        assert np.ptp(shares) > 0.5
    white = whitening.apply(np.eye(len(sweeps)))
    np.testing.assert_allclose(white.T @ white @ covariance, np.eye(len(sweeps)), atol=2e-7)
    np.testing.assert_allclose(whitening.scale, 1 / np.sqrt(np.diag(covariance)), rtol=1e-7)
    assert (whitening.mix is not None) == grouped


def test_equal_readings_of_a_group_have_correlation_one_half(values):
    sweeps = some_sweeps()
    white = whitening_of(CavityModel.of(CELL), sweeps, values).apply(np.eye(len(sweeps)))
    covariance = np.linalg.inv(white.T @ white)
    correlation = covariance * np.outer(1 / sweeps.sigma, 1 / sweeps.sigma)
    same = (sweeps.group[:, None] == sweeps.group[None]) & (sweeps.group != "")[:, None]
    expected = np.where(same, 0.5, 0.0)
    np.fill_diagonal(expected, 1.0)
    np.testing.assert_allclose(correlation, expected, atol=1e-12)
    assert same.sum() > len(sweeps)


def test_a_vector_and_a_column_are_whitened_alike(values):
    sweeps = some_sweeps()
    rows = np.random.default_rng(0).standard_normal((len(sweeps), 3))
    for group in (sweeps.group, np.full(len(sweeps), "")):
        whitening = whitening_of(CavityModel.of(CELL), replace(sweeps, group=group), values)
        for i in range(3):
            np.testing.assert_allclose(whitening.apply(rows[:, i]), whitening.apply(rows)[:, i], rtol=1e-13)


def test_groups_of_other_sessions_and_single_rows_are_no_blocks():
    plan = paper_protocol(CELL).take(np.arange(6))
    plan = replace(
        plan, group=np.array(["a", "", "a", "a", "b", "a"]), session=np.array(["1", "1", "1", "2", "2", "2"])
    )
    assert [block.tolist() for block in Sharing.of(plan).read_alike] == [[0, 2], [3, 5]]


@pytest.mark.parametrize("repeats", [False, True])
def test_weighing_is_the_inverse_of_the_dense_covariance(values, repeats):
    cell = shaky(CELL) if repeats else CELL
    sweeps = some_sweeps()
    whitening = whitening_of(CavityModel.of(cell), sweeps, values)
    weighed = np.array([whitening.weigh(row) for row in dense_covariance(cell, sweeps, values)])
    np.testing.assert_allclose(weighed, np.eye(len(sweeps)), atol=2e-7)


def test_the_matrix_of_the_whitening_is_its_effect_on_each_row(values):
    sweeps = some_sweeps()
    whitening = whitening_of(CavityModel.of(shaky(CELL)), sweeps, values)
    assert whitening.mix is not None
    np.testing.assert_allclose(whitening.mix.toarray(), whitening.apply(np.eye(len(sweeps))), rtol=1e-12)


def test_a_row_is_whitened_given_only_those_before_it(values):
    sweeps = some_sweeps()
    white = whitening_of(CavityModel.of(shaky(CELL)), sweeps, values).apply(np.eye(len(sweeps)))
    np.testing.assert_array_equal(np.triu(white, 1), 0.0)
    assert np.count_nonzero(white) > len(sweeps)
