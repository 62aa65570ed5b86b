"""The flat estimate: what MATLAB makes of it is what `Controller` does."""

import json
import shutil
import subprocess
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.io import loadmat
from task_fixtures import paper_estimate

from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.flat import write_flat
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model import chain
from fpcal_bayes.model.trust import Reason
from fpcal_bayes.motion.controller import Controller
from fpcal_bayes.motion.flat import flat_content
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking.tracker import track

OCTAVE = shutil.which("octave-cli")
CELL = load_cell(mechanics="none")


def fresh(**others):
    made = datetime.now(UTC).isoformat()
    return replace(paper_estimate(CELL), valid_until_h=1.0, data={"utc": made, "session": "s1"}, **others)


def test_flat_names_hold_the_calibrated_chain(tmp_path):
    estimate = fresh()
    content = flat_content(estimate)
    write_flat(tmp_path / "now.mat", content)
    write_flat(tmp_path / "now.json", content)
    said, mat = json.loads((tmp_path / "now.json").read_text()), loadmat(tmp_path / "now.mat")
    shown = estimate.shown()
    assert said["link_alpha_deg"][1] == pytest.approx(shown["alpha_2"]["value"], abs=1e-12)
    assert said["beta_et_deg"] == pytest.approx(shown["beta_et"]["value"], abs=1e-12)
    assert said["beta_et_sd_deg"] == pytest.approx(shown["beta_et"]["sd"])
    assert_allclose(mat["aligned_pose"], Controller(estimate).aligned)
    assert mat["link_d_um"].shape == (6, 1)
    assert (said["usable"], said["session"], said["n_joints"]) == (1, "s1", 6)
    assert said["valid_until_unix_s"] - time.time() == pytest.approx(3600.0, abs=60.0)
    assert (tmp_path / "fpcal_ik.m").exists()
    assert all(value is not None for value in content.values())
    assert flat_content(replace(estimate, data={}))["valid_until_unix_s"] is None


def per_offset(folder, suffix, offsets, work):
    """The numbers that Octave prints for each offset, a line each."""
    np.savetxt(folder / "offsets.txt", offsets, fmt="%.17g")
    read = "now = load('now.mat');" if suffix == ".mat" else "now = jsondecode(fileread('now.json'));"
    ran = octave(folder, f"{read} offsets = load('offsets.txt'); for i = 1:{len(offsets)}, {work} end")
    return np.array([[float(x) for x in line.split()] for line in ran.strip().splitlines()])


@pytest.mark.slow
@pytest.mark.skipif(OCTAVE is None, reason="octave-cli is not installed (apt-get install octave)")
@pytest.mark.parametrize(("opd", "suffix"), [("axis", ".mat"), ("perpendicular", ".json")])
def test_octave_drives_as_the_controller_does(tmp_path, opd, suffix):
    cell = load_cell(opd=opd, mechanics="none")
    estimate = replace(paper_estimate(cell), valid_until_h=1.0, data={"utc": datetime.now(UTC).isoformat()})
    write_flat(tmp_path / f"now{suffix}", flat_content(estimate))
    random = np.random.default_rng(1)
    offsets = random.uniform(-1, 1, (6, 6)) * np.array([80, 15, 80, 1.5, 40.0, 1.5])
    found = per_offset(
        tmp_path,
        suffix,
        offsets,
        "q = fpcal_ik(now, offsets(i, :)); "
        "[pose, gap] = fpcal_fk(now, q); fprintf('%.17g ', q, gap, pose); fprintf('\\n');",
    )
    controller, vector = Controller(estimate), estimate.vector()
    radians = np.hstack([offsets[:, :3], np.radians(offsets[:, 3:])])
    solved = controller.joints(controller._placement.moved(radians), follow=False)
    assert solved.ok.all()
    assert_allclose(found[:, :6], solved.q / cell.joint_scales, rtol=0, atol=1e-9)
    for q, gap in zip(solved.q, found[:, 6], strict=True):
        point, _ = chain.reflection_point(cell, vector, q)
        assert gap == pytest.approx(np.linalg.norm(point - chain.fibre_in_world(vector)[:3, 3]), abs=1e-9)


@pytest.mark.slow
@pytest.mark.skipif(OCTAVE is None, reason="octave-cli is not installed (apt-get install octave)")
@pytest.mark.parametrize(("opd", "suffix"), [("axis", ".json"), ("perpendicular", ".mat")])
def test_octave_makes_up_for_error_motions_as_the_controller_does(tmp_path, opd, suffix):
    stated = load_cell(opd=opd)
    joints = list(stated.mechanics.joints)
    joints[0] = replace(joints[0], encoder=20.0, encoder_period=25.0, reversal=40.0)
    cell = replace(stated, mechanics=replace(stated.mechanics, joints=tuple(joints)))
    measured = simulate_um(cell, paper_truth(cell), paper_protocol(cell), sigma=0.005, seed=2)
    found = track(cell, measured).estimate()
    # Ten times as large, so that most poses are worth it.
    known = replace(found.mechanics, mean=10.0 * found.mechanics.mean)
    made = {"utc": datetime.now(UTC).isoformat()}
    estimate = replace(found, valid_until_h=1.0, data=made, mechanics=known)
    write_flat(tmp_path / f"now{suffix}", flat_content(estimate))
    random = np.random.default_rng(3)
    offsets = random.uniform(-1, 1, (12, 6)) * np.array([50, 10, 50, 1.0, 20.0, 1.0])
    found = per_offset(
        tmp_path, suffix, offsets, "fprintf('%.17g ', fpcal_ik(now, offsets(i, :), [1 2 3 0.1 5 0.1])); fprintf('\\n');"
    )
    at = np.array([1, 2, 3, 0.1, 5, 0.1]) * cell.joint_scales
    controller, plain = Controller(estimate, at), Controller(estimate, at, compensate=False)
    poses = controller._placement.moved(np.hstack([offsets[:, :3], np.radians(offsets[:, 3:])]))
    wanted = np.array([controller.joints(pose).q for pose in poses]) / cell.joint_scales
    assert_allclose(found, wanted, rtol=0, atol=1e-9)
    moved = np.abs(wanted - [plain.joints(pose).q / cell.joint_scales for pose in poses]).max(axis=1)
    assert np.count_nonzero(moved > 1e-3) >= 6


@pytest.mark.slow
@pytest.mark.skipif(OCTAVE is None, reason="octave-cli is not installed (apt-get install octave)")
def test_octave_refuses_what_is_not_to_be_driven(tmp_path):
    doubtful = fresh(trust=paper_estimate(CELL).trust.because(Reason("poor-fit", "it does not fit")))
    cases = {
        "unusable": (doubtful, "[0 0 0 0 0 0]"),
        "expired": (replace(fresh(), valid_until_h=-1.0), "[0 0 0 0 0 0]"),
        "limits": (fresh(), "[0 500 0 0 0 0]"),
        "pose": (fresh(), "2 * eye(4)"),
    }
    script = ""
    for name, (estimate, pose) in cases.items():
        write_flat(tmp_path / f"{name}.mat", flat_content(estimate))
        script += f"try, fpcal_ik(load('{name}.mat'), {pose}); disp('drove'); catch e, disp(e.identifier); end;"
    assert octave(tmp_path, script).split() == [f"fpcal:{name}" for name in cases]


def octave(folder: Path, script: str) -> str:
    return subprocess.run(
        [str(OCTAVE), "--no-init-file", "--eval", script],
        cwd=folder, capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
