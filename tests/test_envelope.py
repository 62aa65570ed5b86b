"""The envelope: what keeps the mirror off the fibre, with the uncertainty of what is known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model import chain, envelope
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.tables import Envelope
from fpcal_bayes.model.envelope import (
    behind_the_fibre,
    breaches,
    require_in_front,
    require_task_within_envelope,
    require_within_envelope,
    safe_ranges,
)
from fpcal_bayes.model.joint_path import JointPath, in_turn, sweep_path, task_path
from fpcal_bayes.model.margin import margin, prior_draws

FEMTO = data_file("femto-st.toml").read_text()


def with_envelope(cell: Cell, **changes: object) -> Cell:
    assert cell.envelope is not None
    return replace(cell, envelope=replace(cell.envelope, **changes))


def at(q: np.ndarray) -> JointPath:
    """Poses alone, without steps."""
    none = np.zeros((0, 2), dtype=np.int64)
    return JointPath(q, np.arange(len(q)), np.zeros(len(q), dtype=bool), none, np.zeros(0))


def within(model: CavityModel, draws: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether each sweep stays in the envelope, without the ways between them."""
    found = breaches(model, draws, sweep_path(model.cell, start, end, ways=False), rows=1)
    return ~np.isin(np.arange(len(start)), list(found))


def disc(centre: np.ndarray, normal: np.ndarray, radius: float) -> np.ndarray:
    """Points of a disc, many of them on its edge."""
    first, second = np.linalg.svd(normal[None])[2][1:]
    angle = np.linspace(0.0, 2.0 * np.pi, 181)[:, None]
    ring = np.cos(angle) * first + np.sin(angle) * second
    return np.vstack([centre + radius * share * ring for share in (0.0, 0.3, 0.7, 1.0)])


def test_the_paper_fits_the_built_in_envelope(femto):
    plan = paper_protocol(femto)
    model, draws = prior_draws(femto)
    require_within_envelope(model, draws, plan.q_start, plan.q_end, file="plan", rows=plan.rows)


@pytest.mark.parametrize("seed", range(6))
def test_boxes_around_many_poses_refuse_the_same(femto, seed, monkeypatch):
    """Against a look at every pose, with limits that cut through the path or lie just beyond it."""
    rng = np.random.default_rng(seed)
    turns, phase = rng.integers(1, 3, 6), rng.uniform(0, 6, 6)
    share, span = np.linspace(0, 2 * np.pi, 24)[:, None], np.where(np.isfinite(femto.high), femto.high, 2.0)
    q = rng.uniform(0.05, 0.6, 6) * span * np.cos(turns * share + phase)
    model, draws = prior_draws(femto, 60)
    draws = femto.free.nominal + rng.choice([0.005, 0.05]) * (draws - femto.free.nominal)
    path = task_path(femto, q)
    free = with_envelope(femto, max_tilt=1.5, mirror_radius=2e4, max_fringe_rate=1e12)
    found = margin(replace(model, cell=free), draws, path, rows=len(q))
    beyond = rng.uniform(0.9, 1.5, 3)
    narrow = with_envelope(
        free,
        max_tilt=found.most_tilt.max() * beyond[0],
        mirror_radius=found.most_aside.max() * beyond[1],
        least_gap=max(found.gap.min() - (found.gap - found.least_gap).max() * beyond[2], 0.1),
    )
    model = replace(model, cell=narrow)
    monkeypatch.setattr("fpcal_bayes.model.margin._WORTH", 1)
    boxes = margin(model, draws, path, rows=len(q), boxes=True)
    refused = breaches(model, draws, path)
    monkeypatch.setattr(envelope, "margin", lambda *given, boxes, **more: margin(*given, **more))
    assert refused == breaches(model, draws, path)
    assert np.isnan(boxes.gap).sum() > 0 or refused


def test_the_envelope_is_no_part_of_the_hash(femto):
    assert femto.sha256.startswith("9ef957ab3e19")
    assert with_envelope(femto, least_gap=1.0).sha256 == femto.sha256
    assert replace(femto, envelope=None).sha256 == femto.sha256


def test_the_clearance_is_below_the_distance_of_the_discs(femto):
    """Against points of both discs, and exact where the mirror is large: its plane and the fibre's edge."""
    truth = paper_truth(femto)
    model = CavityModel.of(femto, truth.parameters)
    values = truth.at(0.0)
    q = np.array([[0, -100, 0, 0.05, 0, 0], [150, 50, -150, -0.08, 0.06, 1], [0, 0, 0, 0, 0, 0]], dtype=float)
    found = margin(model, values, at(q), exact=True)
    vector = model.vector(values)
    fibre, light = chain.fibre_in_world(vector)[:3, 3], chain.optical_axis(femto, vector)
    envelope = femto.envelope
    edge = disc(fibre, light, envelope.fibre_radius)
    for i, pose in enumerate(q):
        mirror = chain.mirror_pose(femto, vector, pose)
        from_plane = (mirror[:3, 2] @ (edge - mirror[:3, 3]).T).min()
        points = disc(mirror[:3, 3], mirror[:3, 2], envelope.mirror_radius)
        apart = np.linalg.norm(points[:, None] - edge, axis=2).min()
        assert found.gap[i] == pytest.approx(from_plane, abs=0.1)
        assert found.gap[i] <= apart + 1e-6
    assert_allclose(found.gap_sd, 0.0, atol=1e-9)


def test_a_small_mirror_is_held_by_its_own_edge(femto):
    """Tilted beside a wide ferrule: the fibre's edge is behind the mirror's plane, but the mirror is not there."""
    cell = with_envelope(femto, fibre_radius=20_000.0, mirror_radius=100.0)
    model = CavityModel.of(cell)
    found = margin(model, cell.free.nominal, at(np.array([[0, 0, 0, 0.05, 0, 0]])), exact=True)
    assert found.gap[0] == pytest.approx(920.0 - 100.0 * np.sin(0.05))
    wide = with_envelope(femto, fibre_radius=20_000.0, mirror_radius=20_000.0)
    found = margin(CavityModel.of(wide), cell.free.nominal, at(np.array([[0, 0, 0, 0.05, 0, 0]])), exact=True)
    assert found.gap[0] == pytest.approx(920.0 - 20_000.0 * np.sin(0.05))


def test_the_stated_gap_holds_and_its_sd_counts(femto):
    cell = with_envelope(femto, gap=500.0, gap_sd=20.0)
    model, draws = prior_draws(cell)
    found = margin(model, draws, at(np.zeros((1, 6))))
    # The fibre's own position, 200 um uncertain, drops out: the gap was measured.
    assert found.gap[0] == pytest.approx(500.0 - 62.5 * np.sin(found.tilt[0]), abs=2.0)
    assert 20.0 <= found.gap_sd[0] < 21.0
    assert found.known


def test_a_move_towards_the_fibre_is_refused_where_it_stands(femto):
    cell = with_envelope(femto, gap=220.0, gap_sd=5.0)
    model, draws = prior_draws(cell)
    start = np.array([[0, -20, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0]], dtype=float)
    end = start + np.array([[0, 40, 0, 0, 0, 0], [0, 140, 0, 0, 0, 0], [0, 0, 0, 0.05, 0, 0]])
    assert within(model, draws, start, end).tolist() == [True, False, True]
    with pytest.raises(InputError, match=r"^plan\.csv: row 8: the mirror comes to .* um from the fibre at 4 sd"):
        require_within_envelope(model, draws, start, end, file="plan.csv", rows=[7, 8, 9])


def test_the_way_between_sweeps_counts(femto):
    """Each sweep is far off, but the way from one to the next leads past the fibre."""
    cell = with_envelope(femto, gap=220.0, gap_sd=2.0, mirror_radius=2500.0, least_gap=60.0)
    model, draws = prior_draws(replace(cell, envelope=cell.envelope))
    start = np.array([[0, 60, 0, 0, 0, 0], [0, -60, 0, 0.087, 0.087, 0]], dtype=float)
    end = start + np.array([[100, 0, 0, 0, 0, 0], [100, 0, 0, 0, 0, 0]])
    far = np.array([[0, -100, 0, 0, 0, 0]], dtype=float)
    plan = np.vstack([start[:1], far]), np.vstack([end[:1], far + np.array([[100, 0, 0, 0, 0, 0]])])
    assert within(model, draws, *plan).all()
    path = sweep_path(cell, start, end)
    assert path.between.any()
    corner = (path.q[:, 1] == 60.0) & (path.q[:, 3] > 0.08) & (path.q[:, 4] > 0.08)
    assert (path.between & corner).any()


def test_tilt_rate_and_aim(femto):
    model, draws = prior_draws(femto)
    one = np.zeros((1, 6))
    tilted = one.copy()
    tilted[0, 3] = 0.087
    cell = with_envelope(femto, max_tilt=0.05)
    found = breaches(replace(model, cell=cell), draws, sweep_path(cell, one, tilted))
    assert "max_tilt_deg" in found[0]
    # The fibre is known to be in front of the mirror's middle, so that only the move counts.
    draws[:, [femto.free.position(name) for name in ("x_wf", "z_wf")]] = 0.0
    cell = with_envelope(femto, mirror_radius=140.0)
    found = breaches(replace(model, cell=cell), draws, sweep_path(cell, one, one + np.array([[150, 0, 0, 0, 0, 0]])))
    assert "mirror_radius_um" in found[0]
    cell = with_envelope(femto, max_fringe_rate=10.0)
    found = breaches(replace(model, cell=cell), draws, sweep_path(cell, one, one + np.array([[0, 20, 0, 0, 0, 0]])))
    # 100 um a second are 128 half waves of 780 nm.
    assert 128.2 < float(found[0].split()[0]) < 132.0


def test_joints_that_may_not_move_together(femto):
    assert not in_turn(femto, np.array([True, True, False, False, False, False]))
    assert in_turn(femto, np.array([True, False, False, True, False, False]))
    alone = with_envelope(femto, together=())
    model, draws = prior_draws(alone)
    start, end = np.zeros((1, 6)), np.array([[10, 10, 0, 0, 0, 0]], dtype=float)
    with pytest.raises(InputError, match="row 1: moves q1, q2 at once"):
        require_within_envelope(model, draws, start, end, file="plan.csv")
    # A task's points may be reached in turn: every pose between two counts.
    path = task_path(alone, np.vstack([start, end]))
    assert {tuple(q[:2]) for q in path.q} == {(0.0, 0.0), (0.0, 10.0), (10.0, 0.0), (10.0, 10.0)}


def test_without_a_measured_gap_nothing_moves_along_the_beam(femto):
    cell = with_envelope(femto, gap=None, gap_sd=None)
    model, draws = prior_draws(cell)
    zero = np.zeros((1, 6))
    with pytest.raises(
        InputError, match="moves q2 along the beam by 20 um while the gap is not known: measure it by a"
    ):
        require_within_envelope(model, draws, zero, zero + np.array([[0, 20, 0, 0, 0, 0]]), file="plan.csv")
    require_within_envelope(model, draws, zero, zero + np.array([[100, 0, 0, 0, 0, 0]]), file="plan.csv")
    require_within_envelope(model, draws, zero, zero + np.array([[0, 0, 0, 0.05, 0, 0]]), file="plan.csv")
    with pytest.raises(InputError, match="task 'line', point 2: moves q2 along the beam"):
        require_task_within_envelope(
            model, draws, np.vstack([zero, zero + np.array([[0, 50, 0, 0, 0, 0]])]), name="line"
        )
    # A wavelength scan knows the gap: the estimate's own length holds.
    known = draws.copy()
    known[:, cell.free.position("y_wf")] = 920.0
    require_within_envelope(model, known, zero, zero + np.array([[0, 20, 0, 0, 0, 0]]), file="plan.csv")


def test_a_stated_gap_that_the_measurement_contradicts(femto):
    cell = with_envelope(femto, gap=300.0, gap_sd=2.0)
    model, draws = prior_draws(cell)
    draws[:, cell.free.position("y_wf")] = 920.0
    with pytest.raises(InputError, match=r"gap_um = 300 \(sd 2\) and the measured length .* disagree"):
        breaches(model, draws, at(np.zeros((1, 6))))


def test_rows_that_no_cell_gives(femto):
    model = CavityModel.of(femto)
    values = femto.free.nominal.copy()
    values[femto.free.position("y_wf")] = 10.0
    start = np.zeros((2, 6))
    end = np.array([[100, 0, 0, 0, 0, 0], [0, 20, 0, 0, 0, 0]], dtype=float)
    with pytest.raises(InputError, match=r"f\.csv: row 5: the mirror stands behind the fibre on this sweep \(L = -"):
        require_in_front(model, values, sweep_path(femto, start, end, ways=False), file="f.csv", rows=[4, 5])
    require_in_front(model, values, sweep_path(femto, start[:1], end[:1], ways=False), file="f.csv", rows=[4])


def test_a_cell_without_an_envelope_refuses_nothing(femto):
    cell = replace(femto, envelope=None)
    model, draws = prior_draws(cell)
    require_within_envelope(model, draws, np.zeros((1, 6)), np.full((1, 6), 100.0), file="plan.csv")
    with pytest.raises(InputError, match=r"expected an \[envelope\] table"):
        margin(model, draws, at(np.zeros((1, 6))))


def test_what_leaves_of_many_draws(femto):
    """4 sd: of 10,000 draws that the margin has not seen at most one leaves a path that just fits."""
    # Near the bound all draws are looked at.
    model, draws = prior_draws(with_envelope(femto, least_gap=730.0))
    fresh = prior_draws(femto, 10_000, seed=9)[1]
    path = at(np.array([[0, 100, 0, 0.05, 0.05, 0], [150, 100, 150, 0.05, -0.05, 0.5]]))
    least = margin(model, draws, path, rows=2).least_gap
    truth = np.random.default_rng(1).normal(femto.envelope.gap, femto.envelope.gap_sd, len(fresh))
    inside = 0
    for values, gap in zip(fresh[:10_000], truth, strict=True):
        vector = model.vector(values)
        fibre, light = chain.fibre_in_world(vector)[:3, 3], chain.optical_axis(femto, vector)
        home = chain.mirror_pose(femto, vector, np.zeros(6))
        length = home[:3, 2] @ (home[:3, 3] - fibre) / (home[:3, 2] @ light)
        fibre = fibre + light * (length - gap)
        normals, origins = model.mirrors(values, path.q)
        clear = ((fibre - origins) * normals).sum(axis=1) - 62.5 * np.linalg.norm(np.cross(normals, light), axis=1)
        inside += bool((clear >= least).all())
    assert inside >= 9_999


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("gap_sd_um = 5.0\n", "", "key envelope.gap_sd_um: expected gap_um and gap_sd_um together"),
        ("least_gap_um = 100.0", "least_gap_um = 1000.0", "key envelope.gap_um: the gap of 920 um is below"),
        ("least_gap_um = 100.0", "least_gap_um = 0", "key envelope.least_gap_um: expected a number"),
        ("mirror_radius_um = 2500.0", "", "key envelope.mirror_radius_um: expected a finite number, found None"),
        ("max_tilt_deg = 30.0", "max_tilt_deg = 85", "key envelope.max_tilt_deg: expected a number"),
        ("max_tilt_deg = 30.0", "max_tilt_rad = 0.3", "key envelope.max_tilt_rad: unknown key"),
        ('["q4", "q5", "q6"]', '["q4", "q7"]', "key envelope.together: expected groups of joints"),
        ('[["q1", "q2", "q3"], ["q4", "q5", "q6"]]', '["q1"]', "key envelope.together: expected groups of joints"),
        ("[envelope] ", "[[envelope]] ", "key envelope: expected a table"),
        ("speed_um_per_s = 100.0", "speed_um_per_s = 0", "key joint 1.speed_um_per_s: expected a number"),
        ("speed_um_per_s = 100.0", "speed_deg_per_s = 1", "key joint 1.speed_deg_per_s: unknown key"),
    ],
)
def test_a_table_that_is_none(old, new, expected, tmp_path):
    assert old in FEMTO
    path = tmp_path / "cell.toml"
    path.write_text(FEMTO.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_cell(path, mechanics="none")
    assert str(caught.value).startswith(f"{path}: {expected}")


def test_the_built_in_envelope_is_read(femto):
    envelope = femto.envelope
    assert isinstance(envelope, Envelope)
    assert (envelope.least_gap, envelope.gap, envelope.gap_sd) == (100.0, 920.0, 5.0)
    assert envelope.max_tilt == pytest.approx(np.radians(30.0))
    assert envelope.together == ((0, 1, 2), (3, 4, 5))
    assert [joint.speed for joint in femto.joints] == pytest.approx([100.0] * 3 + [np.radians(2.0)] * 3)


@pytest.mark.parametrize("gap_sd", [2.0, 20.0, None])
def test_every_pose_in_the_safe_ranges_stays_in_the_envelope(femto, gap_sd):
    """Random poses of the ranges, by fresh draws of the prior and the gap, against the discs' own distance."""
    cell = with_envelope(femto, gap=None if gap_sd is None else 260.0, gap_sd=gap_sd, max_tilt=0.3)
    model, draws = prior_draws(cell)
    low, high = np.where(np.isfinite(cell.low), cell.low, -1.5), np.where(np.isfinite(cell.high), cell.high, 1.5)
    least, most = safe_ranges(model, draws, low, high)
    assert ((low <= least) & (least <= 0) & (most >= 0) & (most <= high)).all()
    if gap_sd is None:
        assert (most - least)[1] == pytest.approx(2 * 9.2, rel=5e-3)
    rng = np.random.default_rng(1)
    q = rng.uniform(least, most, (60, 6))
    model, fresh = prior_draws(cell, 2000, seed=7)
    found = margin(model, fresh, at(q), rows=1)
    assert (found.most_tilt <= 0.3).all()
    assert not found.known or (found.least_gap >= 100.0).all()
    # What gives way is needed: all ranges as they are would leave the envelope.
    if gap_sd is not None:
        assert not (least == low).all() or not (most == high).all()


def test_one_pose_measured_twice_to_a_picometre_is_no_reason_to_fail(femto):
    """Two lengths of one pose, known far better than rounding leaves of their prior."""
    zero = np.zeros((2, 6))
    moved = zero + np.array([0.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    for wide in (zero, moved):
        behind, lengths = behind_the_fibre(femto, moved, (wide, np.full(2, 920.0), np.full(2, 1e-6)))
        assert not behind.any()
        assert np.isfinite(lengths).all()
