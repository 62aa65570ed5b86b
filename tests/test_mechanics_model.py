"""Error motions: their sizes, their weights, and what they do to the cavity length."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.mechanics.rows import RowNoise
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.cell_tables import read_mechanics
from fpcal_bayes.io.validate import Tables
from fpcal_bayes.measure.protocol import protocol_by_name
from fpcal_bayes.measure.sharing import Sharing, drive_of_sweeps
from fpcal_bayes.model import chain
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.mechanics import JointMechanics, Mechanics, Terms, design, drive_of, path_design
from fpcal_bayes.model.mechanics.errors import known_task_errors, known_task_sd
from fpcal_bayes.model.mechanics.knowledge import MechanicsKnowledge
from fpcal_bayes.model.mechanics.response import directions, pose_responses, responses
from fpcal_bayes.model.mechanics.terms import WEIGHT_SD, harmonics, polynomials
from fpcal_bayes.simulator.machine import Machine, MachineSettings

STAGE = JointMechanics(straightness_nm=30, pitch_urad=2, yaw_urad=2, roll_urad=2, linearity=45, reversal=10)
TURN = JointMechanics(radial_runout_nm=100, axial_runout_nm=100, wobble_urad=15, linearity=26, reversal=1)
SIZES = Mechanics((STAGE, STAGE, STAGE, TURN, TURN, TURN), drift_nm_per_min=3.0)


def _vector(cell, rng):
    vector = cell.parameters.nominal.copy()
    vector[cell.free.slots] += rng.standard_normal(len(cell.free)) * cell.free.prior_sd
    return vector


def _poses(rng, n=12):
    return rng.uniform(-1, 1, (n, 6)) * np.array([150, 150, 150, 0.08, 0.08, 1.5])


@pytest.mark.parametrize("opd", ["axis", "perpendicular"])
def test_responses_are_exact_to_first_order(opd):
    # The machine moves the whole chain, in plain NumPy, by finite motions.
    cell, rng = load_cell(opd=opd, mechanics="none"), np.random.default_rng(1)
    levers = tuple((3.0 + i, -4.0, 5.0) for i in range(6))
    sizes = Mechanics(tuple(JointMechanics(lever_mm=lever) for lever in levers))
    vector, q = _vector(cell, rng), _poses(rng)
    machine, zero, still = Machine.draw(cell, sizes, vector, rng), np.zeros((12, 6)), np.zeros(12)
    model = CavityModel.of(cell)
    ideal = model.predict(vector[cell.free.slots], model.pose_rows(q))
    np.testing.assert_allclose(machine.lengths(q, zero, still), ideal, atol=1e-11)
    found = responses(cell, vector, directions(cell, np.array(levers)), q)
    for joint in range(6):
        for direction in range(6):
            size = 1e-4 if direction < 3 else 1e-7
            moved = []
            for sign in (1.0, -1.0):
                machine.motions[joint][direction] = lambda x, shift=sign * size: np.full_like(x, shift)
                moved.append(machine.lengths(q, zero, still))
            machine.motions[joint][direction] = np.zeros_like
            slope = (moved[0] - moved[1]) / (2 * size)
            scale = np.abs(slope).max()
            np.testing.assert_allclose(found.motion[:, joint, direction], slope, atol=2e-6 * scale)


def test_responses_of_the_pose_are_exact_to_first_order():
    # As above; poses and the mirror point by 4 x 4 products.
    cell, rng = load_cell(mechanics="none"), np.random.default_rng(1)
    levers = tuple((3.0 + i, -4.0, 5.0) for i in range(6))
    sizes = Mechanics(tuple(JointMechanics(lever_mm=lever) for lever in levers))
    vector, q = _vector(cell, rng), _poses(rng)
    machine = Machine.draw(cell, sizes, vector, rng)
    _, point = chain.reflection_point(cell, vector, np.zeros(6))

    def poses(at: np.ndarray, minutes: float = 0.0) -> np.ndarray:
        tools = np.tile(np.eye(4), (len(at), 1, 1))
        tools[:, :3, :3], origin = machine.tools(at, machine.periodic(at))
        tools[:, :3, 3] = origin - machine.drift * minutes
        return np.linalg.inv(chain.fibre_in_world(vector)) @ tools @ chain.mirror_in_tool(cell, vector)

    def slope(ahead: np.ndarray, behind: np.ndarray, size: float) -> np.ndarray:
        places = [(poses[:, :3, :3] @ point + poses[:, :3, 3])[:, [0, 2]] for poses in (ahead, behind)]
        turned = Rotation.from_matrix(ahead[:, :3, :3] @ behind[:, :3, :3].swapaxes(1, 2)).as_rotvec()
        return np.hstack([places[0] - places[1], turned]) / (2 * size)

    found = pose_responses(cell, vector, directions(cell, np.array(levers)), q)
    for joint in range(6):
        for direction in range(6):
            size, moved = 1e-2 if direction < 3 else 1e-6, []
            for sign in (1.0, -1.0):
                machine.motions[joint][direction] = lambda x, shift=sign * size: np.full_like(x, shift)
                moved.append(poses(q))
            machine.motions[joint][direction] = np.zeros_like
            expected = slope(moved[0], moved[1], size)
            responses_ = np.stack([at.motion[:, joint, direction] for at in found], axis=-1)
            np.testing.assert_allclose(responses_, expected, atol=1e-5 * np.abs(expected).max())
    machine.drift[:] = [0.0, 0.0, 1.0]
    expected = slope(poses(q, 1e-2), poses(q, -1e-2), 1e-2)
    np.testing.assert_allclose(np.stack([at.fibre[:, 2] for at in found], axis=-1), expected, atol=1e-7)
    # A joint's own travel, as reversal and return errors move it.
    for joint in range(6):
        step = np.zeros(6)
        step[joint] = 1e-6 if cell.revolute[joint] else 1e-2
        expected = slope(poses(q + step), poses(q - step), step[joint])
        drive = np.stack([at.drive[:, joint] for at in found], axis=-1)
        np.testing.assert_allclose(drive, expected, atol=1e-5 * np.abs(expected).max())


def test_a_lever_turns_a_tilt_into_a_displacement():
    cell = load_cell(mechanics="none")
    vector, q = cell.parameters.nominal, np.zeros((1, 6))
    levers = np.zeros((6, 3))
    near = responses(cell, vector, directions(cell, levers), q)
    levers[0] = [80.0, 0.0, 0.0]
    far = responses(cell, vector, directions(cell, levers), q)
    # q1 moves along Zw: a roll about Z moves a mirror 80 mm along X by 80 mm per rad along Y, the beam.
    assert abs(far.motion[0, 0, 3] - near.motion[0, 0, 3]) == pytest.approx(80e3, rel=1e-6)
    assert far.motion[0, 0, 5] == pytest.approx(near.motion[0, 0, 5], abs=1e-6)


def test_sheet_words_by_draws():
    rng, n = np.random.default_rng(0), 20_000
    x = np.linspace(-1.0, 1.0, 201)
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    bases = {
        "legendre": polynomials(x, -1.0, 1.0)[:, :5],
        "legendre-bent": polynomials(x, -1.0, 1.0)[:, 1:5],
        "tilt": polynomials(x, -1.0, 1.0),
        "fourier": harmonics(angle),
        "fourier-beyond-first": harmonics(angle)[:, 2:],
    }
    for shape, basis in bases.items():
        sd = 7.0 * np.array(WEIGHT_SD[shape])
        sd = np.repeat(sd, 2) if shape.startswith("fourier") else sd
        drawn = (rng.standard_normal((n, basis.shape[1])) * sd[-basis.shape[1] :]) @ basis.T
        assert np.median(np.ptp(drawn, axis=1)) == pytest.approx(7.0, rel=0.03), shape
    assert set(bases) == set(WEIGHT_SD)


def test_weights_are_as_large_as_those_of_tilts_of_one_peak_to_valley():
    rng, x = np.random.default_rng(1), np.linspace(-1.0, 1.0, 201)
    basis = polynomials(x, -1.0, 1.0)
    falling = rng.standard_normal((4000, 8)) / np.arange(1, 9)
    falling /= np.ptp(falling @ basis.T, axis=1)[:, None]
    stage = JointMechanics(pitch_urad=1e6)
    cell, settings = load_cell(), MachineSettings(spread=1.0)
    machines = [Machine.draw(cell, Mechanics((stage,) * 6), np.zeros(56), rng, settings) for _ in range(250)]
    waves = np.array([motions[5](150.0 * x) for machine in machines for motions in machine.motions[:3]])
    seen = np.linalg.lstsq(np.column_stack([np.ones(len(x)), basis]), waves.T, rcond=None)[0][1:].T
    expected = np.sqrt(((falling**2).mean(axis=0) + (seen**2).mean(axis=0)) / 2.0)
    np.testing.assert_allclose(np.array(WEIGHT_SD["tilt"]) / expected, 1.0, atol=0.08)


def test_functions_follow_the_tilts_of_machines_of_another_family():
    """At the levers of the built-in cell, what they cannot follow stays far below what is asked of a circle."""
    cell, left = load_cell(), []
    assert cell.mechanics is not None
    q = np.linspace(cell.low[0], cell.high[0], 301)
    basis = np.column_stack([np.ones(len(q)), polynomials(q, cell.low[0], cell.high[0])])
    for seed in range(10):
        machine = Machine.draw(cell, cell.mechanics, cell.parameters.nominal, np.random.default_rng(seed))
        tilts = np.array([tilt(q) for stage in machine.motions[:3] for tilt in stage[3:]]).T
        rest = tilts - basis @ np.linalg.lstsq(basis, tilts, rcond=None)[0]
        left.append(np.ptp(rest, axis=0) * 1e3 * np.abs(machine.lever[0]).max())
    assert np.sqrt(np.mean(np.square(left))) < 6.0


def test_tables_of_a_cell():
    axis = load_cell(mechanics="none").joints[0]

    def read(own: dict[str, object], whole: dict[str, object]) -> Mechanics:
        return read_mechanics(Tables("x.toml"), {"joint": [{"mechanics": own}], "mechanics": whole}, [axis])

    cell = read({"straightness_nm": 30.0, "return_nm": 2, "lever_mm": [0, 0, 80]}, {"drift_nm_per_min": 3.0})
    joint = cell.joints[0]
    assert (joint.straightness_nm, joint.return_sd, joint.lever_mm) == (30.0, 2.0, (0.0, 0.0, 80.0))
    assert cell.any
    assert cell.drift_nm_per_min == 3.0
    for table, word in (
        ({"wobble_urad": 3.0}, "unknown key"),
        ({"reversal_urad": 3.0}, "unknown key"),
        ({"straightness_nm": -1.0}, "from 0"),
        ({"straightness_nm": "30"}, "finite number"),
        ({"lever_mm": [1, 2]}, "three numbers"),
    ):
        with pytest.raises(InputError, match=rf"x\.toml: key joint 1\.mechanics.*{word}"):
            read(table, {})


def _drive(cell, name="paper-mid"):
    plan = protocol_by_name(name, cell)
    sweep = np.cumsum(np.r_[True, plan.group[1:] != plan.group[:-1]]) - 1
    return plan, drive_of(
        plan.q_start, plan.q_end, absolute=plan.absolute, sweep=sweep, time_h=plan.time_h, minutes_per_sweep=1.0
    )


def test_duplicates_stand_aside():
    cell = load_cell(mechanics="none")
    plain = Terms.of(cell, SIZES)
    freed = Terms.of(cell, SIZES, ("gain_4", "runout_cos_6"))
    plan, drive = _drive(cell)
    vector, sigma = cell.parameters.nominal, np.full(len(plan), 0.005)
    assert (
        design(plain, vector, drive, sigma).matrix.shape[1] == design(freed, vector, drive, sigma).matrix.shape[1] + 3
    )


def test_an_eccentricity_is_geometry():
    # The part of the fundamental radial motion that runs with the turn carries the mirror as an offset does, which a
    # plane mirror does not show; what is left is the change of the angle to the optical axis.
    cell, rng = load_cell(mechanics="none"), np.random.default_rng(3)
    vector, q = _vector(cell, rng), np.zeros((9, 6))
    q[:, 5] = np.linspace(-1.5, 1.5, 9)
    at = responses(cell, vector, directions(cell, np.zeros((6, 3))), q)
    up, across = at.motion[:, 5, 1], at.motion[:, 5, 2]
    c, s = np.cos(q[:, 5]), np.sin(q[:, 5])
    for column in (c * up + s * across, c * across - s * up):
        assert np.ptp(column) < 1e-4
    against = c * up - s * across
    assert np.ptp(against) > 1e-3


def test_directions_of_approach_follow_the_rows():
    q_start = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 0.0], [1.0, 0.0]])
    q_end = np.array([[2.0, 0.0], [1.0, 0.0], [0.0, 0.0], [1.0, 5.0]])
    drive = drive_of(
        q_start,
        q_end,
        absolute=np.zeros(4, dtype=bool),
        sweep=np.array([0, 1, 1, 2]),
        time_h=np.zeros(4),
        minutes_per_sweep=2.0,
    )
    np.testing.assert_array_equal(drive.start_side, [[0, 0], [1, 0], [1, 0], [1, 0]])
    np.testing.assert_array_equal(drive.end_side, [[1, 0], [-1, 0], [-1, 0], [1, 1]])
    np.testing.assert_array_equal(drive.start_min, [0, 2, 2, 4])


@pytest.mark.parametrize("several", [1, 3])
def test_noise_of_values_that_are_read_back_is_no_motion(several):
    """Sweeps as a person drives them, and as encoders tell of them, from the same sides and to the same positions."""
    cell, rng = load_cell(), np.random.default_rng(8)
    plan, still = protocol_by_name("paper-mid", cell), Terms.of(cell, cell.mechanics).still
    resolution = np.array([joint.resolution for joint in cell.joints])
    as_driven = drive_of_sweeps(plan, 1.0, still)
    for part in fields(as_driven):
        np.testing.assert_array_equal(getattr(as_driven, part.name), getattr(drive_of_sweeps(plan, 1.0), part.name))
    places, first = np.unique(plan.group, return_inverse=True)
    starts = plan.q_start + (several * resolution * rng.standard_normal((len(places), 6)))[first]
    ends = plan.q_end + several * resolution * rng.standard_normal(plan.q_end.shape)
    read_back = replace(plan, q_start=starts, q_end=ends)
    told = drive_of_sweeps(read_back, 1.0, still)
    for name in ("start_side", "end_side", "start_reach", "end_reach", "moved"):
        np.testing.assert_array_equal(getattr(told, name), getattr(as_driven, name))
    assert (drive_of_sweeps(read_back, 1.0).start_side != as_driven.start_side).any()


def test_a_joint_that_creeps_has_moved_in_the_end():
    q = np.zeros((6, 2))
    q[1:, 0] = np.arange(5) * 0.4
    drive = drive_of(
        q[:-1], q[1:], absolute=np.zeros(5, bool), sweep=np.arange(5), time_h=np.zeros(5), minutes_per_sweep=1.0,
        still=np.ones(2),
    )  # fmt: skip
    np.testing.assert_array_equal(drive.end_side[:, 0], [0, 0, 0, 1, 1])
    np.testing.assert_array_equal(drive.end_reach[:, 0], [0, 0, 0, 1, 1])


def test_a_stated_approach_holds_until_the_joint_moves():
    start, end = np.array([[0.0, 0.0], [2.0, 0.0], [5.0, 0.0]]), np.array([[2.0, 0.0], [2.0, 3.0], [4.0, 3.0]])
    stated = np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    drive = drive_of(
        start, end, absolute=np.zeros(3, bool), sweep=np.arange(3), time_h=np.zeros(3), minutes_per_sweep=1.0,
        approach=stated,
    )  # fmt: skip
    np.testing.assert_array_equal(drive.end_side[:, 0], [-1, -1, -1])
    np.testing.assert_array_equal(drive.start_side[:, 0], [0, -1, 1])


def test_the_design_is_what_a_machine_of_these_weights_shows():
    # Rows of a machine whose functions are the basis itself, moved through the whole chain.
    cell, rng = load_cell(mechanics="none"), np.random.default_rng(5)
    vector = _vector(cell, rng)
    terms = Terms.of(cell, replace(SIZES, drift_nm_per_min=0.0))
    plan, drive = _drive(cell)
    made = design(terms, vector, drive, np.full(len(plan), 0.005))
    machine = Machine.draw(cell, Mechanics((JointMechanics(),) * 6), vector, rng)
    still = np.zeros(len(plan))

    def rows():
        zero = np.zeros_like(drive.q_end)
        return machine.lengths(drive.q_end, zero, still) - machine.lengths(drive.q_start, zero, still)

    ideal, first = rows(), 0
    for motion in terms.motions:
        there = motion.sd > 0
        weights = rng.standard_normal(there.sum())
        i, size = motion.joint, 0.01
        low, high = cell.low[i], cell.high[i]

        def function(q, low=low, high=high, there=there, w=size * weights * motion.sd[there]):
            basis = harmonics(q) if not np.isfinite(high - low) else polynomials(q, low, high)
            return basis[:, : len(there)][:, there] @ w

        machine.motions[i][motion.direction] = function
        shown = (rows() - ideal) / size
        machine.motions[i][motion.direction] = np.zeros_like
        stated = made.matrix[:, first : first + there.sum()] @ weights
        first += int(there.sum())
        # Rounding of lengths near a millimetre stands against the smallest motions.
        np.testing.assert_allclose(stated, shown, atol=1e-4 * np.abs(shown).max() + 1e-10)


def test_path_and_rows_hold_the_same_weights():
    cell, rng = load_cell(mechanics="none"), np.random.default_rng(7)
    terms, vector, q = Terms.of(cell, SIZES), _vector(cell, rng), _poses(rng, 6)
    path = path_design(terms, vector, q[0], q[1:])
    drive = drive_of(
        np.repeat(q[:1], 5, axis=0),
        q[1:],
        absolute=np.zeros(5, dtype=bool),
        sweep=np.zeros(5, dtype=np.int64),
        time_h=np.zeros(5),
        minutes_per_sweep=1.0,
    )
    made = design(terms, vector, drive, np.full(5, 0.005))
    np.testing.assert_allclose(path.motions, made.matrix[:, : made.motion_count], atol=1e-15)


@pytest.mark.parametrize("cause", ["geometry", "approach", "encoder", "return", "drift", "added", "all"])
def test_the_closed_form_is_the_spread_of_draws(cause):
    """Each cause that is summed without draws, alone and with the others, on a path that comes back."""
    cell, rng = load_cell(mechanics="none"), np.random.default_rng(8)
    sizes = {"return": {"return_sd": 20.0}, "encoder": {"encoder": 30.0}, "approach": {"reversal": 40.0}}
    stated = {key: size for name, each in sizes.items() if cause in (name, "all") for key, size in each.items()}
    joint = JointMechanics(straightness_nm=1e-3, **stated)
    drift = 5.0 if cause in ("drift", "all") else 0.0
    terms = Terms.of(cell, Mechanics((joint,) * 6, drift_nm_per_min=drift))
    q = _poses(rng, 6)
    q[2, :3], q[4] = q[1, :3], 0.0
    start, vector = np.zeros(6), cell.parameters.nominal
    shared = [
        f"{name} [{i}]" for i, name in enumerate(["weight"] * path_design(terms, vector, start, q).motions.shape[1])
    ]
    drifts = [f"drift along {axis} [{i}]" for i in range(2 if drift else 0) for axis in "xyz"]
    names, scales = (*cell.free.names, *shared, *drifts), terms.scales
    spread = np.concatenate([1e-4 * cell.free.prior_sd, np.full(len(names) - len(cell.free), 0.5)])
    if cause not in ("geometry", "all"):
        spread[: len(cell.free)] = 0.0
    n = 4000
    knowledge = MechanicsKnowledge(
        terms.sizes, (), names, 0.5 * spread, spread[:, None] * rng.standard_normal((len(names), 5)),
        rng.standard_normal((n, 5)), scales, 0.3 * rng.standard_normal((n, len(scales))), 60.0,
    )  # fmt: skip
    covariance = np.diag(spread[: len(cell.free)] ** 2)
    estimate = Estimate(cell, cell.free, cell.free.nominal, covariance, ("identified",) * len(cell.free))
    estimate = replace(estimate, mechanics=knowledge)
    added = 0.02 * np.arange(6.0) if cause in ("added", "all") else None
    drawn = known_task_errors(estimate, start, q, added=added, draws=n)[0].total
    found = known_task_sd(estimate, start, q, added)
    assert found.max() > 1e-3
    # A standard deviation of 4,000 draws is off by 1.1 percent, more where the scales' tails count.
    np.testing.assert_allclose(found, np.sqrt((drawn**2).mean(axis=0)), rtol=0.07, atol=1e-9)


def test_a_slow_reading_error_is_stated_for_the_cell():
    cell = load_cell(mechanics="none")
    stated = Mechanics((JointMechanics(),) * 6, correlated_nm=4.0)
    plan, drive = _drive(cell)
    made = design(Terms.of(cell, stated), cell.parameters.nominal, drive, np.full(len(plan), 0.005))
    slow = made.matrix[:, [name == "slow reading error" for name in made.names]]
    assert np.sqrt((slow**2).sum(axis=1).mean()) == pytest.approx(4e-3, rel=0.05)


def _chained(cell):
    """Sweeps of q2 that begin where the last has ended, with midpoints, one that stands; then an absolute length."""
    stops = np.zeros((8, 6))
    stops[:, 1] = [-20, 20, 5, 5, -20, 20, -20, 0]
    stops[:, 5] = [0, 0, 0, 1, 1, 1, 1, 1]
    start, stop = np.repeat(stops[:-1], 2, axis=0), np.repeat(stops[1:], 2, axis=0)
    end = start + np.tile([0.5, 1.0], 7)[:, None] * (stop - start)
    start, end = np.vstack([start, stops[-1:]]), np.vstack([end, stops[-1:]])
    absolute = np.arange(len(end)) == len(end) - 1
    sweep = np.r_[np.repeat(np.arange(7), 2), 7]
    drive = drive_of(start, end, absolute=absolute, sweep=sweep, time_h=np.zeros(len(end)), minutes_per_sweep=1.0)
    return drive, [np.flatnonzero(sweep == k) for k in range(7)]


def _covariance(made, blocks):
    """Of the rows, by the shared weights and by what is new in each sweep, at noise-free readings."""
    columns = made.matrix[:, [name.startswith(("return of", "position of")) for name in made.names]]
    rows = np.arange(len(made.matrix))
    first = rows.copy()
    for block in blocks:
        first[block] = block[0]
    silent = np.zeros(len(rows)), np.zeros((len(rows), 0)), np.zeros(len(rows), dtype=bool)
    noise = RowNoise(*silent, Sharing(first, first, rows), made)
    return columns @ columns.T + noise.dense()[1]


def test_return_errors_stay_while_a_joint_stands_still():
    cell, rng = load_cell(mechanics="none"), np.random.default_rng(11)
    sizes = Mechanics((JointMechanics(return_sd=20.0),) * 3 + (JointMechanics(return_sd=200.0),) * 3)
    drive, blocks = _chained(cell)
    vector = cell.parameters.nominal
    made = design(Terms.of(cell, sizes), vector, drive, np.full(len(drive), 0.005))
    machine = Machine.draw(cell, sizes, vector, rng, MachineSettings(spread=1.0))
    told = directions(cell, np.zeros((6, 3)))
    at_end, at_start = (responses(cell, vector, told, q).drive for q in (drive.q_end, drive.q_start))
    drawn = []
    for _ in range(3000):
        begun, ended = machine.reached(drive)
        drawn.append((at_end * ended).sum(axis=1) - ~drive.absolute * (at_start * begun).sum(axis=1))
    expected, spread = _covariance(made, blocks), np.cov(np.array(drawn).T)
    assert sum(name == "return of q2" for name in made.names) >= 5
    assert np.abs(spread - expected).max() < 0.08 * expected.max()


def test_encoders_of_unknown_period_err_alike_at_the_same_position():
    cell, rng = load_cell(mechanics="none"), np.random.default_rng(12)
    sizes = Mechanics((JointMechanics(encoder=20.0),) * 3 + (JointMechanics(),) * 3)
    drive, blocks = _chained(cell)
    vector = cell.parameters.nominal
    made = design(Terms.of(cell, sizes), vector, drive, np.full(len(drive), 0.005))
    told = directions(cell, np.zeros((6, 3)))
    at_end, at_start = (responses(cell, vector, told, q).drive[:, 1] for q in (drive.q_end, drive.q_start))
    period, phase = rng.uniform(0.2, 1.1, (20_000, 1)), rng.uniform(0, 2 * np.pi, (20_000, 1))

    def error(q):
        return 0.02 * np.sin(2 * np.pi * q[:, 1] / period + phase)

    drawn = at_end * error(drive.q_end) - ~drive.absolute * at_start * error(drive.q_start)
    expected = _covariance(made, blocks)
    assert np.abs(np.cov(drawn.T) - expected).max() < 0.08 * expected.max()


def test_a_machine_adds_to_one_pose_what_it_adds_to_rows():
    cell, rng = load_cell(mechanics="none"), np.random.default_rng(13)
    machine = Machine.draw(cell, SIZES, _vector(cell, rng), rng)
    poses, side = _poses(rng), np.array([1.0, -1.0, 1.0, 0.0, 1.0, -1.0])
    told = np.where(side == 0, machine.side, side)
    lengths = machine.lengths(poses, machine.half_reversal * told + machine.periodic(poses), np.zeros(len(poses)))
    model = CavityModel.of(cell)
    ideal = model.predict(machine.vector[cell.free.slots], model.pose_rows(poses))
    added = [machine.length_change(pose, side, 100.0) for pose in poses]
    np.testing.assert_allclose(added, lengths - ideal, atol=1e-9)
    assert np.abs(added).max() > 0.02
