"""The study of recorded arms on one that is made here: another chain and another potential, a truth that is known."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import approx_fprime

STUDY = Path(__file__).parents[1] / "studies" / "recorded"
# The maker's table as the study does not read it: alpha in quarter turns, a and d in mm.
ALPHA, A, D = [0, -1, 1, 1, -1, 1, 1], [0, 0, 0, 82.5, -82.5, 0, 88], [333, 0, 316, 0, 384, 0, 107]
HOME = np.array([0.0, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8])
NOISE_MM = 0.1


@pytest.fixture
def study(monkeypatch):
    monkeypatch.syspath_prepend(str(STUDY))
    import recorded

    yield recorded
    for name in ("recorded", "evidence", "arm"):
        sys.modules.pop(name, None)


def frames(q, table):
    """Poses of the links, shape (7, n, 4, 4), at joint vectors (n, 7); alpha, a, theta, d in each row of the table."""
    pose, made = np.eye(4), []
    for (alpha, a, theta, d), angle in zip(table, q.T, strict=True):
        c, s, zero, one = np.cos(theta + angle), np.sin(theta + angle), 0 * angle, 0 * angle + 1
        ca, sa = np.cos(alpha), np.sin(alpha)
        rows = [[c, -s, zero, a * one], [s * ca, c * ca, -sa * one, -d * sa * one]]
        rows += [[s * sa, c * sa, ca * one, d * ca * one], [zero, zero, zero, one]]
        pose = pose @ np.moveaxis(np.array(rows), 2, 0)
        made.append(pose)
    return np.array(made)


def levers(poses, points):
    """How points (n, 3) beyond the last of some links move with each joint, shape (n, 3, n_links)."""
    return np.array([np.cross(pose[:, :3, 2], points - pose[:, :3, 3]) for pose in poses]).transpose(1, 2, 0)


def torques(q, masses):
    """Of the links' weight on the joints, in Nm; masses in kg with their centres in um."""
    poses, total = frames(q, nominal()), np.zeros_like(q)
    for link, (mass, centre) in enumerate(masses, 1):
        at = poses[link - 1] @ [*(1e-3 * np.array(centre)), 1.0]
        total[:, :link] -= 9.81e-3 * mass * levers(poses[:link], at[:, :3])[:, 2]
    return total


def nominal():
    return np.array([np.array(ALPHA) * np.pi / 2, A, np.zeros(7), D], dtype=float).T


def make(folder, masses, seed=1, postures=20):
    """Record a robot whose joints give way by 1.5 mrad under 10 Nm; a plate of two sockets at three positions."""
    rng = np.random.default_rng(seed)
    table = nominal() + rng.normal(size=(7, 4)) * [3e-3, 0.3, 3e-3, 0.3]
    for name, centre in (("left", [450, 300, 50]), ("high", [350, -250, 450]), ("front", [600, 0, 80])):
        (folder / name).mkdir(parents=True)
        for hole in (0, 1):
            place = np.add(centre, [0, 50 * hole, 0]) + NOISE_MM * rng.normal(size=(2 * postures, 3))
            q = HOME + rng.uniform(-0.9, 0.9, size=(2 * postures, 7))
            for _ in range(60):
                poses = frames(q, table)
                ball = poses[-1] @ [2.0, -3.0, 130.0, 1.0]
                step = np.linalg.pinv(levers(poses, ball[:, :3])) @ (place - ball[:, :3])[:, :, None]
                q = q + np.clip(step[:, :, 0], -0.2, 0.2)
            shown = q = q[np.abs(place - ball[:, :3]).max(axis=1) < 1e-6][:postures]
            assert len(q) == postures
            for _ in range(3):  # where the joints stand is what they show and their twist
                shown = q - 1.5e-4 * torques(shown, masses)
            np.savetxt(folder / name / f"hole_{hole}.csv", shown, delimiter=",")


def test_a_generated_robot_is_predicted_to_its_noise_and_its_bands_hold(study, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "CHOICES", ("geometry", "gains+compliance"))
    make(tmp_path / "made", sys.modules["arm"].MASSES)
    assert study.main([str(tmp_path), "--json", str(tmp_path / "out.json")]) == 0
    rows = json.loads((tmp_path / "out.json").read_text())["positions"]
    assert [row["position"] for row in rows] == ["front", "high", "left"]
    assert capsys.readouterr().out.splitlines()[1].split()[:3] == ["made", "front", "40"]
    floor = NOISE_MM * np.sqrt(8 / np.pi)  # mean length of a vector of three such errors
    errors = [row["error"] for row in rows]
    assert 0.85 * floor < np.mean(errors) < 1.3 * floor
    assert np.mean([row["geometry"] for row in rows]) > 1.5 * np.mean(errors)
    assert all(row["chosen"] == "gains+compliance" for row in rows)
    assert np.mean([row["inside"] for row in rows]) >= 0.9
    assert np.mean([row["band"] for row in rows]) < 4.5 * NOISE_MM
    assert all(abs(row["pair"]) < row["pair_band"] for row in rows)


def test_points_torques_and_the_gradient_of_the_evidence(study, tmp_path):
    arm = study.Arm()
    q = np.random.default_rng(2).uniform(-2.0, 2.0, size=(9, 7))
    poses = frames(q, nominal())
    points, _, moves = arm.points(arm.free.nominal, q)
    ball = (poses[-1] @ [0.0, 0.0, 100.0, 1.0])[:, :3]
    np.testing.assert_allclose(points, 1e3 * ball, atol=1e-6)
    np.testing.assert_allclose(moves, 1e3 * levers(poses, ball), atol=1e-6)
    masses = sys.modules["arm"].MASSES
    np.testing.assert_allclose(arm.torques(q), torques(q, masses), atol=1e-9)
    make(tmp_path / "made", masses, postures=6)
    postures = study.read_robot(tmp_path / "made", 7)
    kinds = ("gains", "compliance", "backlash", "harmonics")
    factors = np.linspace(-0.8, 0.6, 9)
    fit = study.Fit(arm, postures, kinds, factors)
    given = fit._linear(arm.deviations(postures.q, kinds)), np.append(fit.x, np.zeros(18))
    slope = approx_fprime(factors, lambda at: fit.evidence(at, *given)[0], 1e-6)
    np.testing.assert_allclose(fit.evidence(factors, *given)[1], slope, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,0,0,-1,0,1,0\n0,0,0,-1,0,1\n", "row 2: column 7: expected 7 angles in rad"),
        ("0,0,0,-1,0,1,0\n0,0,nan,-1,0,1,0\n", "row 2: column 3: expected 7 angles in rad"),
        ("0,0,0,-90,0,1,0\n" * 2, "row 1: column 4: expected 7 angles in rad of at most two turns each, found '-90'"),
        ("0,0,0,-1,0,1,0\n", "expected two postures or more, found 1"),
    ],
    ids=["short", "nan", "deg", "one"],
)
def test_a_robot_that_cannot_be_read_is_named_and_the_others_go_on(study, tmp_path, capsys, text, words):
    for position in "ab":
        (tmp_path / "bad" / position).mkdir(parents=True)
        (tmp_path / "bad" / position / "hole_0.csv").write_text(text)
    assert study.main([str(tmp_path)]) == 2
    assert words in capsys.readouterr().out
    assert study.main([str(tmp_path / "none")]) == 2
    assert "expected POSITION/hole_0.csv" in capsys.readouterr().err


def test_postures_of_another_chain_are_refused(study, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "CHOICES", ("geometry",))
    rng = np.random.default_rng(0)
    for place in ("a/hole_0", "a/hole_1", "b/hole_0"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        np.savetxt(tmp_path / f"{place}.csv", HOME + rng.uniform(-0.9, 0.9, size=(12, 7)), delimiter=",")
    assert study.main([str(tmp_path)]) == 2
    assert "refused: the chain of cell 'panda' does not explain its postures" in capsys.readouterr().out
