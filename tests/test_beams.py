"""Several beams: lengths and derivatives, what they make observable, what their rows share, files, refusals."""

import cmath
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.design.machine import prior_machine
from fpcal_bayes.infer.design.rows import SweepRows, plan_rows
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.fit.noise import whitening_of
from fpcal_bayes.infer.fit.spectrum import spectrum_of
from fpcal_bayes.infer.mechanics.rows import RowNoise
from fpcal_bayes.infer.observability.observe import observe, whitened_jacobian
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_csv, write_csv
from fpcal_bayes.measure.protocol import paper_protocol, read_often, seen_by_all
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth, default_truth
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.error_motions import JointMechanics
from fpcal_bayes.model.mechanics import Terms, design
from fpcal_bayes.model.mechanics.response import directions, responses
from fpcal_bayes.motion.tasks import task_path
from fpcal_bayes.simulator.sweeps import machine_of, simulate_um

CUBES = """
[[beam]]
name = "main"
[[beam]]
name = "cube"
target = "corner-cube"
wavelength_nm = 633.0
[beam.extrinsic]
x_et = { nominal_um = 3000.0, prior_sd_um = 20.0 }
y_et = { nominal_um = 100.0, prior_sd_um = 20.0 }
z_et = { nominal_um = -500.0, prior_sd_um = 20.0 }
y_wf = { nominal_um = 50000.0, prior_sd_um = 200.0 }
beta_wf = { nominal_deg = 0.0, prior_sd_deg = 1.0 }
theta_wf = { nominal_deg = 0.0, prior_sd_deg = 1.0 }
[[beam]]
name = "tracker"
shares = "cube"
opd = "distance"
[beam.extrinsic]
x_wf = { nominal_um = 200000.0, prior_sd_um = 200.0 }
y_wf = { nominal_um = 50000.0, prior_sd_um = 200.0 }
z_wf = { nominal_um = 5000.0, prior_sd_um = 200.0 }
[[beam]]
name = "across"
shares = "main"
opd = "perpendicular"
optical_axis = "minus-y"
[beam.extrinsic]
x_wf = { nominal_um = 1500.0, prior_sd_um = 200.0 }
"""


def _text(beams: str, name: str = "beams") -> str:
    """The built-in cell, without its envelope, with other beams."""
    text = Path(__file__).parents[1].joinpath("data", "femto-st.toml").read_text()
    text = text[: text.index("# No part of the cell's hash. The paper scans")]
    return text.replace('name = "femto-st"', f'name = "{name}"', 1) + beams


@pytest.fixture(scope="module")
def three() -> Cell:
    return load_cell("three-beams", mechanics="none")


@pytest.fixture
def cubes(tmp_path: Path) -> Cell:
    (tmp_path / "cubes.toml").write_text(_text(CUBES))
    return load_cell(tmp_path / "cubes.toml", mechanics="none")


def _length(cell: Cell, vector: np.ndarray, q: np.ndarray) -> complex:
    """Length of a cell of one beam by the readable transforms, also of complex vectors."""
    target = chain.mirror_pose(cell, vector, q)
    fibre, axis = chain.fibre_in_world(vector)[:3, 3], chain.optical_axis(cell, vector)
    away = target[:3, 3] - fibre
    if cell.target == "corner-cube":
        return axis @ away if cell.opd == "axis" else cmath.sqrt(away @ away)
    height = target[:3, 2] @ away
    return height / (target[:3, 2] @ axis) if cell.opd == "axis" else height * np.sign(height.real)


def _drawn(cell: Cell, rng: np.random.Generator, n: int) -> tuple[CavityModel, np.ndarray, np.ndarray]:
    """A model of every parameter that means something, values and poses."""
    gone = {f"runout_{part}_{i}" for part in ("cos", "sin") for i, r in enumerate(cell.revolute, 1) if not r}
    free = type(cell.parameters)(p for p in cell.parameters if p.name not in gone)
    sd = np.where(free.prior_sd > 0, free.prior_sd, 1e-3)
    values = free.nominal + sd * rng.standard_normal(len(free))
    low, high = np.maximum(cell.low, -1.5), np.minimum(cell.high, 1.5)
    low, high = np.where(cell.revolute, low, -140.0), np.where(cell.revolute, high, 140.0)
    return CavityModel.of(cell, free), values, rng.uniform(low, high, (n, len(low)))


@pytest.mark.parametrize("which", ["three", "cubes"])
def test_lengths_and_derivatives_of_every_beam(which: str, request: pytest.FixtureRequest) -> None:
    cell, rng = request.getfixturevalue(which), np.random.default_rng(5)
    model, values, q = _drawn(cell, rng, 24)
    beam = np.arange(24) % len(cell.beams)
    rows = model.pose_rows(q, beam)
    lengths, jacobian = model.predict_with_jacobian(values, rows)
    assert model.predict(np.tile(values, (70, 1)), rows)[69] == pytest.approx(lengths, rel=1e-12)
    moves = model.joint_jacobian(values, q, beam)
    for i in range(24):
        view, index = cell.views[beam[i]]
        vector = model.vector(values)[index]
        assert lengths[i] == pytest.approx(_length(view, vector, q[i]).real, rel=1e-12)
        expected = np.zeros(len(cell.parameters))
        for k, slot in enumerate(index):
            shifted = vector.astype(complex)
            shifted[k] += 1e-30j
            expected[slot] = _length(view, shifted, q[i]).imag / 1e-30
        expected = expected[model.free.slots]
        assert np.abs(jacobian[i] - expected).max() < 1e-8 * np.abs(expected).max()
        for joint, step in enumerate(np.where(cell.revolute, 1e-6, 1e-3)):
            ends = [_length(view, vector, q[i] + side * step * np.eye(6)[joint]).real for side in (1, -1)]
            assert moves[i, joint] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-4)


def test_rows_of_several_beams_are_those_of_each(three: Cell) -> None:
    model = CavityModel.of(three)
    plan = paper_protocol(three)
    whole = model.predict(three.free.nominal, plan.laid_out(model))
    for number, name in enumerate(three.beams):
        mine = plan.beam == name
        view, own = model.views[number]
        alone = view.predict(three.free.nominal[own], view.rows(plan.q_start[mine], plan.q_end[mine]))
        assert (whole[mine] == alone).all()
    assert load_cell().views[0].cell is load_cell() or len(load_cell().views) == 1


def _rank(cell: Cell, plan: Sweeps, model: CavityModel, values: np.ndarray) -> int:
    measured = plan.with_measurement(np.zeros(len(plan)), 0.005)
    return spectrum_of(whitened_jacobian(model, measured, values)).rank


def test_three_parallel_beams_see_all_but_six_directions(three: Cell) -> None:
    rng, model = np.random.default_rng(1), CavityModel.of(three)
    values = three.free.nominal + three.free.prior_sd * rng.standard_normal(len(three.free))
    # Each fibre along the light; the world's shift by d_4; one turn counted twice; q6 with the mirror's tilt.
    assert _rank(three, paper_protocol(three, midpoints=True), model, values) == 27 - 6
    plan = paper_protocol(three, midpoints=True)
    _, jacobian = model.predict_with_jacobian(values, plan.laid_out(model))
    scale = np.abs(jacobian).max(axis=0)
    light = chain.optical_axis(three, model.vector(values))
    for beam in ("", "@left", "@up"):
        at = [three.free.position(f"{axis}_wf{beam}") for axis in "xyz"]
        assert np.abs(jacobian[:, at] @ light).max() < 1e-9 * scale[at].max()
    # Moving the mirror by the world's part of d_4 is moving all fibres the other way.
    moved = chain.tool_pose(three, model.vector(values), np.zeros(6))[:3, 3]
    with_d = values.copy()
    with_d[three.free.position("d_4")] += 1.0
    moved = chain.tool_pose(three, model.vector(with_d), np.zeros(6))[:3, 3] - moved
    at = [three.free.position(f"{axis}_wf{beam}") for beam in ("", "@left", "@up") for axis in "xyz"]
    together = jacobian[:, three.free.position("d_4")] + jacobian[:, at] @ np.tile(moved, 3)
    assert np.abs(together).max() < 1e-9 * scale[at].max()


def test_absolute_lengths_of_three_beams_tell_three_gauges(three: Cell) -> None:
    rng, model = np.random.default_rng(2), CavityModel.of(three)
    values = three.free.nominal + three.free.prior_sd * rng.standard_normal(len(three.free))
    plan = paper_protocol(three, midpoints=True)
    scan = seen_by_all(Sweeps.of_um_rad(np.zeros((1, 6)), np.zeros((1, 6)), kind="absolute", label="scan"), three)
    both = [
        np.vstack([whitened_jacobian(model, each.with_measurement(np.zeros(len(each)), 0.2), values)])
        for each in (plan, scan)
    ]
    assert spectrum_of(np.vstack(both)).rank == 21 + 3


def test_fixed_beams_on_a_point_see_it_along_the_light_alone(cubes: Cell) -> None:
    model, values, q = _drawn(cubes, np.random.default_rng(3), 12)
    number = cubes.beams.index("cube")
    _, jacobian = model.predict_with_jacobian(values, model.pose_rows(q, np.full(12, number)))
    light = chain.optical_axis(cubes.views[number].cell, model.vector(values)[cubes.views[number].slots])
    at = [model.free.position(f"{axis}_wf@cube") for axis in "xyz"]
    assert jacobian[:, at] == pytest.approx(np.tile(-light, (12, 1)), abs=1e-12)
    # A change of length sees the origin of a beam that follows, not that of a fixed one.
    changes = jacobian - jacobian.mean(axis=0)
    assert np.abs(changes[:, at]).max() < 1e-12
    follows = model.pose_rows(q, np.full(12, cubes.beams.index("tracker")))
    _, jacobian = model.predict_with_jacobian(values, follows)
    at = [model.free.position(f"{axis}_wf@tracker") for axis in "xyz"]
    assert np.ptp(jacobian[:, at], axis=0).max() > 1e-5


def test_gauges_name_the_beam(three: Cell) -> None:
    plan = paper_protocol(three, midpoints=True)
    found = observe(three, plan)
    texts = [gauge.explanation for gauge in found.gauges]
    for beam in three.beams:
        assert any(f"changes every length of beam {beam} by the same amount" in text for text in texts)
    assert found.spectrum.rank == 21


def _expected_covariance(sweeps: Sweeps, cell: Cell, model: CavityModel, values: np.ndarray) -> np.ndarray:
    """Of rows in which readings and the poses that joints reach are independent, written out."""
    n = len(sweeps)
    beam = cell.beam_numbers(sweeps.beam)
    start = model.joint_jacobian(values, sweeps.q_start, beam) * cell.repeatability
    end = model.joint_jacobian(values, sweeps.q_end, beam) * cell.repeatability
    result = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            whole = str(sweeps.label[i]).split("-mid")[0] == str(sweeps.label[k]).split("-mid")[0]
            if whole:
                result[i, k] += start[i] @ start[k]
                result[i, k] += 0.5 * sweeps.sigma[i] * sweeps.sigma[k] * (beam[i] == beam[k])
            if sweeps.label[i] == sweeps.label[k]:
                result[i, k] += end[i] @ end[k]
        result[i, i] += 0.5 * sweeps.sigma[i] ** 2
    return result


def test_rows_of_one_shot_share_what_the_joints_miss(three: Cell) -> None:
    joints = tuple(replace(j, repeatability=5e-6 if j.kind == "revolute" else 0.02) for j in three.joints)
    cell, rng = replace(three, joints=joints), np.random.default_rng(4)
    plan = paper_protocol(cell, midpoints=True)
    plan = plan.take(np.isin(plan.label, ["node0-rx-mid", "node0-rx", "node3-ry-mid", "node3-ry"]))
    plan = plan.take(rng.permutation(len(plan))).with_measurement(np.zeros(12), 0.005)
    model = CavityModel.of(cell)
    expected = _expected_covariance(plan, cell, model, cell.free.nominal)
    white = whitening_of(model, plan, cell.free.nominal).apply(np.eye(12))
    assert white @ expected @ white.T == pytest.approx(np.eye(12), abs=1e-9)
    many = plan.take(np.tile(np.arange(12), 300))
    many = replace(many, session=np.repeat(np.arange(300), 12).astype(np.str_))
    drawn = simulate_um(cell, default_truth(cell, 0), many, sigma=0.005, seed=3).dl.reshape(300, 12)
    found = np.cov(drawn.T)
    spread = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / spread).max() < 0.25


def test_a_machine_moves_all_beams_alike() -> None:
    """Covariance of what the machine of the simulator adds, and that of the fit, by return errors alone."""
    cell = load_cell("three-beams")
    assert cell.mechanics is not None
    joints = tuple(JointMechanics(return_sd=size) for size in (2.0,) * 3 + (1.0,) * 3)
    cell = replace(cell, mechanics=replace(cell.mechanics, joints=joints, drift_nm_per_min=0.0, correlated_nm=0.0))
    plan = paper_protocol(cell, midpoints=True)
    plan = plan.take(np.isin(plan.label, ["node0-rx-mid", "node0-rx", "orient0-0-0-ty"])).with_measurement(
        np.zeros(9), 1e-4
    )
    assert cell.mechanics is not None
    drive = drive_of_sweeps(plan, 1.0)
    assert drive.sweep.tolist() == [0] * 6 + [1] * 3
    assert drive.beam.tolist() == list(cell.beams) * 3
    assert (drive.end_reach[:3] == drive.end_reach[0]).all()
    assert (drive.end_min[3:6] == drive.end_min[3]).all()
    vector = cell.parameters.nominal
    made = design(Terms.of(cell, cell.mechanics), vector, drive, plan.sigma)
    returns = RowNoise.of(plan, made).dense()[1] + made.matrix @ made.matrix.T
    machine = machine_of(cell, Truth(cell.free, np.zeros(1), cell.free.nominal[None]), 3)
    machine.return_sd[:] = Terms.of(cell, cell.mechanics).return_sd
    drawn = np.cov(np.array([machine.sweep(drive, 1e-9) for _ in range(150)]).T)
    spread = np.sqrt(np.outer(np.diag(returns), np.diag(returns)))
    assert np.abs((drawn - returns) / spread).max() < 0.4


@pytest.mark.parametrize("which", ["three", "cubes"])
def test_responses_to_small_motions_are_those_of_the_chain(which: str, request: pytest.FixtureRequest) -> None:
    cell, rng = request.getfixturevalue(which), np.random.default_rng(6)
    model, values, q = _drawn(cell, rng, 8)
    beam = np.arange(8) % len(cell.beams)
    found = responses(cell, model.vector(values), directions(cell, np.zeros((6, 3))), q, beam)
    assert found.length == pytest.approx(model.predict(values, model.pose_rows(q, beam)), rel=1e-12)
    gain = 1.0 + model.vector(values)[5:48:8]
    expected = model.joint_jacobian(values, q, beam) / gain
    runs = np.abs(model.vector(values)[6:48:8]).max() + np.abs(model.vector(values)[7:48:8]).max()
    assert np.abs(found.drive - expected).max() < 1e-9 + 2.0 * runs


def test_planned_rows_are_those_of_the_plan(three: Cell) -> None:
    joints = tuple(replace(j, repeatability=5e-6 if j.kind == "revolute" else 0.02) for j in three.joints)
    for cell in (three, replace(three, joints=joints)):
        model = CavityModel.of(cell)
        plan = paper_protocol(load_cell(mechanics="none")).take(np.arange(5))
        values = cell.free.nominal[None] + 0.1 * cell.free.prior_sd
        made = SweepRows(model, values, values[0], np.diag(cell.free.prior_sd), 2, 0.005)
        rows = seen_by_all(read_often(plan, 2), cell).with_measurement(np.zeros(30), 0.005)
        expected = (plan_rows(model, values, rows) * cell.free.prior_sd)[0].reshape(5, 6, -1)
        found = made.of(plan)[0]
        for one, other in zip(found, expected, strict=True):
            assert one.T @ one == pytest.approx(other.T @ other, rel=1e-7, abs=1e-6 * np.abs(other.T @ other).max())


def test_planned_rows_differ_with_the_ends_of_sweeps(three: Cell) -> None:
    stated = load_cell("three-beams")
    assert stated.mechanics is not None
    model, plan = CavityModel.of(stated), paper_protocol(load_cell(mechanics="none")).take(np.array([0, 50]))
    terms = Terms.of(stated, stated.mechanics, stated.free.names)
    poses = np.stack([plan.q_start, 0.5 * (plan.q_start + plan.q_end), plan.q_end], axis=1)
    tasks = np.zeros(
        (
            1,
            len(
                design(
                    terms,
                    stated.parameters.nominal,
                    drive_of_sweeps(plan.with_measurement(np.zeros(2), 1.0), 1.0),
                    np.ones(2),
                ).names
            ),
        )
    )
    count = design(terms, stated.parameters.nominal, drive_of_sweeps(plan, 1.0), np.ones(2)).motion_count
    machine = prior_machine(terms, stated.parameters.nominal, poses, tasks[:, :count], len(stated.free))
    root = np.pad(np.diag(stated.free.prior_sd), ((0, 0), (0, machine.basis.shape[1] - len(stated.free))))
    made = SweepRows(
        model, stated.free.nominal[None] + 0.1 * stated.free.prior_sd, stated.free.nominal, root, 2, 0.005, machine
    )
    by_rows, steps = (
        np.random.default_rng(7).standard_normal(made.of(plan).shape),
        1e-6 * np.where(stated.revolute, 1.0, 300.0),
    )
    weight = made._whitening(made._poses(plan)).transpose(0, 2, 1) @ by_rows
    slope = made.slope(plan, by_rows, steps)

    def value(moved: Sweeps) -> float:
        # The noise stays where it was.
        white = np.linalg.inv(made._whitening(made._poses(moved))) @ made.of(moved)
        return float((weight * white).sum())

    for end, joint in ((0, 0), (0, 3), (1, 3), (1, 5)):
        ends = np.stack([plan.q_start, plan.q_end])
        sides = []
        for side in (1.0, -1.0):
            shifted = ends.copy()
            shifted[end, 0, joint] += side * 100.0 * steps[joint]
            sides.append(value(replace(plan, q_start=shifted[0], q_end=shifted[1])))
        assert slope[end, 0, joint] == pytest.approx((sides[0] - sides[1]) / (200.0 * steps[joint]), rel=2e-3)


def test_an_identification_finds_the_truth(three: Cell) -> None:
    truth = default_truth(three, 3)
    found = identify(three, simulate_um(three, truth, paper_protocol(three, midpoints=True), sigma=0.005, seed=8))
    at = truth.parameters.positions(found.estimate.parameters.names)
    deviation = found.estimate.values - truth.at(0.0)[at]
    assert found.converged
    assert found.fit.p_value > 1e-3
    factor = np.linalg.cholesky(found.estimate.covariance)
    assert np.sum(np.linalg.solve(factor, deviation) ** 2) < 60.0


def test_files_keep_the_beams(tmp_path: Path, three: Cell) -> None:
    plan = paper_protocol(three).take(np.arange(6)).with_measurement(np.arange(6.0), 0.005)
    write_csv(tmp_path / "s.csv", plan, three)
    back = read_csv(tmp_path / "s.csv", three)
    assert back.beam.tolist() == ["main", "left", "up"] * 2
    assert back.shot.tolist() == plan.shot.tolist()
    # In a plan, a row that names no beam is read by all.
    text = (tmp_path / "s.csv").read_text().splitlines()
    short = [",".join(line.split(",")[:-5]) for line in (text[0], text[1])]
    (tmp_path / "p.csv").write_text(
        "\n".join(f"{line},{more}" for line, more in zip(short, ("readings", "2"), strict=True)) + "\n"
    )
    planned = read_csv(tmp_path / "p.csv", three, plan=True)
    assert planned.beam.tolist() == ["main", "left", "up"] * 2
    assert planned.shot.tolist() == [f"node0-rx{suffix}" for suffix in ("-mid", "") for _ in range(3)]


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("beam", "", "row 3, column beam: which beam read the row: expected one of main, left, up"),
        ("beam", "down", "row 3, column beam: expected one of main, left, up, see [[beam]] of the cell"),
        ("beam", "main", "row 3, column shot: shot 'node0-rx': the beam 'main' stands in it twice"),
        ("q4_end_deg", "2", "row 3, column shot: shot 'node0-rx': expected the poses and time_h of its row 2"),
    ],
)
def test_rows_of_beams_that_cannot_be(tmp_path: Path, three: Cell, column: str, value: str, message: str) -> None:
    plan = paper_protocol(three).take(np.arange(3)).with_measurement(np.arange(3.0), 0.005)
    write_csv(tmp_path / "s.csv", plan, three)
    lines = (tmp_path / "s.csv").read_text().splitlines()
    fields = lines[2].split(",")
    fields[lines[0].split(",").index(column)] = value
    (tmp_path / "s.csv").write_text("\n".join([*lines[:2], ",".join(fields), *lines[3:]]) + "\n")
    with pytest.raises(InputError, match="^" + ".*") as found:
        read_csv(tmp_path / "s.csv", three)
    assert message in str(found.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'shares = "cube"',
            'shares = "left"',
            "key beam 3.shares: expected a beam that stands before it, one of main, cube",
        ),
        ('name = "cube"', 'name = "main"', "key beam 2.name: expected another name for each beam"),
        ('name = "cube"', 'name = "c@be"', "key beam 2.name: expected another name for each beam"),
        ('opd = "distance"', 'opd = "perpendicular"', "key beam 3.opd: expected one of axis, distance"),
        ("x_et = {", "beta_et = {", "key beam 2.extrinsic.beta_et: unknown key"),
        ('target = "corner-cube"', 'target = "ball"', "key beam 2.target: expected one of plane-mirror, corner-cube"),
        ("wavelength_nm = 633.0", "waves = 1", "key beam 2.waves: unknown key"),
        (
            "\n[[beam]]",
            "\n[envelope]\nleast_gap_um = 1.0\n[[beam]]",
            "key envelope: it keeps one plane mirror off one fibre",
        ),
        (
            'name = "main"',
            'name = "main"\nextrinsic = { y_wf = { nominal_um = 9.0 } }',
            "key beam 1.extrinsic: expected no",
        ),
    ],
)
def test_beams_that_cannot_be(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "c.toml").write_text(_text(CUBES.replace(old, new, 1)))
    with pytest.raises(InputError) as found:
        load_cell(tmp_path / "c.toml")
    assert message in str(found.value)


def test_commands_that_know_one_beam_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text("")
    write_csv(tmp_path / "x.csv", paper_protocol(load_cell("three-beams")).take(np.arange(3)), load_cell("three-beams"))
    for words in (
        "simulate --cell three-beams --traces -o z.csv",
        "trace x.csv --cell three-beams",
        "measure x.csv --cell three-beams --rig rig.toml -o m.h5",
    ):
        assert main(words.split()) == 2
        assert "has 3 beams: " in capsys.readouterr().err


def test_one_beam_has_its_hash_and_no_names() -> None:
    assert load_cell().sha256 == "9ef957ab3e19a2274c93e5dc74c7a785bf393946d661f5a2885b7060c2ec5fce"
    assert load_cell("three-beams").sha256 != load_cell().sha256
    assert "x_wf@left" in load_cell("three-beams").free.names


SOCKETS = """
[[beam]]
name = "a-x"
target = "corner-cube"
[beam.extrinsic]
x_et = { prior_sd_um = 500.0 }
y_et = { prior_sd_um = 500.0 }
z_et = { nominal_um = 50000.0, prior_sd_um = 500.0 }
theta_wf = { nominal_deg = 90.0 }
x_wf = { prior_sd_um = 2000.0 }
y_wf = { nominal_um = 50000.0, prior_sd_um = 2000.0 }
z_wf = { prior_sd_um = 2000.0 }
[[beam]]
name = "a-y"
shares = "a-x"
extrinsic = { theta_wf = { nominal_deg = 0.0 } }
[[beam]]
name = "a-z"
shares = "a-x"
extrinsic = { theta_wf = { nominal_deg = 0.0 }, beta_wf = { nominal_deg = 90.0 } }
[[beam]]
name = "b-x"
shares = "a-x"
[beam.extrinsic]
x_wf = { nominal_um = 100.0, prior_sd_um = 2000.0 }
y_wf = { nominal_um = 50000.0, prior_sd_um = 2000.0 }
z_wf = { nominal_um = 80.0, prior_sd_um = 2000.0 }
[[beam]]
name = "b-y"
shares = "b-x"
extrinsic = { theta_wf = { nominal_deg = 0.0 } }
[[beam]]
name = "b-z"
shares = "b-x"
extrinsic = { theta_wf = { nominal_deg = 0.0 }, beta_wf = { nominal_deg = 90.0 } }
[[beam]]
name = "a-b"
shares = "a-x"
opd = "distance"
"""


def test_a_ball_in_two_sockets_at_a_known_distance(tmp_path: Path) -> None:
    """Poses by the readable chain that put the ball where the sockets are; the fit knows neither."""
    text = _text("")
    (tmp_path / "sockets.toml").write_text(text[: text.index("[extrinsic]")] + SOCKETS)
    cell, rng = load_cell(tmp_path / "sockets.toml", mechanics="none"), np.random.default_rng(3)
    joints = tuple(replace(j, low=-1e4, high=1e4) if j.kind == "prismatic" else j for j in cell.joints)
    cell = replace(cell, joints=joints)
    model = CavityModel.of(cell)
    truth = cell.free.nominal + 0.3 * cell.free.prior_sd * rng.standard_normal(len(cell.free))
    vector = model.vector(truth)
    sockets = {name: vector[cell.views[cell.beams.index(f"{name}-x")].slots][-3:] for name in "ab"}

    def ball(q: np.ndarray) -> np.ndarray:
        return chain.mirror_pose(cell, vector, q)[:3, 3]

    poses, beams, shots, dl = [], [], [], []
    for name, socket in sockets.items():
        for number in range(14):
            q = np.concatenate([np.zeros(3), rng.uniform(-0.08, 0.08, 2), rng.uniform(-3.0, 3.0, 1)])
            moves = np.column_stack([ball(q + np.eye(6)[j]) - ball(q) for j in range(3)])
            q[:3] = np.linalg.solve(moves, socket - ball(q))
            read = [f"{name}-{axis}" for axis in "xyz"] + ["a-b"] * (name == "b")
            poses += [q] * len(read)
            beams += read
            shots += [f"{name}{number}"] * len(read)
            dl += [0.0] * 3 + [float(np.linalg.norm(sockets["b"] - sockets["a"]))] * (name == "b")
    q, true = np.array(poses), np.array(dl)
    sweeps = Sweeps.of_um_rad(q, q, kind="absolute", beam=beams, shot=shots, label=shots)
    assert model.predict(truth, sweeps.laid_out(model)) == pytest.approx(true, abs=1e-6)
    sweeps = sweeps.with_measurement(true + 0.05 * rng.standard_normal(len(true)), 0.05)
    check_sweeps(sweeps, cell)
    found = identify(cell, sweeps)
    assert found.converged
    assert found.fit.p_value > 1e-3
    # Unseen: the world's shift by d_4, one turn counted twice, q6 with the ball about the tool's axis.
    assert found.spectrum.rank == len(cell.free) - 3
    deviation = found.estimate.values - truth
    assert deviation @ np.linalg.solve(found.estimate.covariance, deviation) < 48.0
    with pytest.raises(InputError, match="tasks hold a mirror before the first beam"):
        task_path(cell, vector, "circle")
