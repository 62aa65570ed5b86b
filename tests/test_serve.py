"""`fpcal serve`: answers are those of the commands, refusals have one form, and nothing from outside breaks it."""

import contextlib
import json
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from serve_fixtures import ask, serving, write_estimate
from task_fixtures import paper_estimate

from fpcal_bayes.cli.main import main
from fpcal_bayes.cli.serve import guard, listening, state
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import content_sha256, file_sha256
from fpcal_bayes.infer.tasks.prediction import predict_from_covariance
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.joint_paths import read_joint_path
from fpcal_bayes.io.sweeps import read_sweeps, write_csv, write_sweeps
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.trust import Reason
from fpcal_bayes.motion.controller import Controller
from fpcal_bayes.motion.tasks import find_task
from fpcal_bayes.simulator.sweeps import simulate

CELL = load_cell(mechanics="none")


def estimate_of_now(**others):
    return replace(paper_estimate(CELL), valid_until_h=24.0, **others)


def session(name, time_h, seed, rows=slice(None)):
    plan = paper_protocol(CELL, session=name).take(np.arange(69)[rows])
    plan = replace(plan, time_h=np.full(len(plan), time_h))
    return simulate(CELL, paper_truth(CELL), plan, sigma_nm=5.0, seed=seed)


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    path = tmp_path_factory.mktemp("campaign") / "campaign.csv"
    write_csv(path, session("full-0", 0.0, 1), CELL)
    return path


@pytest.fixture(scope="module")
def folder(campaign):
    write_estimate(campaign.parent / "now.json", estimate_of_now())
    return campaign.parent


@pytest.fixture(scope="module")
def url(campaign, folder):
    with serving(CELL, campaign, folder / "now.json") as found:
        yield found


def test_the_estimate_is_the_file_with_the_verdict_of_now(url, folder, tmp_path):
    status, headers, said = ask(url, "GET", "/estimate")
    written = json.loads((folder / "now.json").read_text())
    assert (status, said["parameters"], said["valid_until_h"]) == (200, written["parameters"], 24.0)
    assert said["trust"] == {"usable": True, "verdict": "usable", "reasons": []}
    assert said["valid_until_utc"].endswith("Z")
    assert headers["ETag"] == f'"{said["content_sha256"]}"'
    assert ask(url, "GET", "/estimate", If_None_Match=headers["ETag"])[0] == 304
    assert ask(url, "GET", "/estimate", If_None_Match='"another"')[0] == 200
    # What was given is an estimate file.
    (tmp_path / "got.json").write_text(json.dumps(said))
    assert_allclose(read_estimate(tmp_path / "got.json", CELL).values, paper_estimate(CELL).values, rtol=1e-12)
    flat = ask(url, "GET", "/estimate?flat=true")[2]
    assert (flat["schema"], flat["usable"]) == ("fpcal-flat/1", 1)


def test_a_task_is_driven_as_control_drives_it(url, folder, tmp_path):
    line = f"control --estimate {folder / 'now.json'} --task circle --points 9 -o c.csv --json c.json --quiet"
    assert main(line.split()) == 0
    said = ask(url, "POST", "/joints", {"task": "circle", "points": 9})[2]
    told = json.loads((tmp_path / "c.json").read_text())["tasks"]["circle"]
    assert_allclose(np.array(said["q"]) * CELL.joint_scales, read_joint_path("c.csv", CELL), rtol=0, atol=1e-9)
    assert_allclose(said["predicted_sd_nm"], told["sd_nm"], rtol=1e-9)
    assert said["status"] == ["ok"] * 9


def test_poses_are_driven_as_the_controller_drives_them(url):
    controller = Controller(estimate_of_now(), now_h=lambda: 0.0)
    offsets = np.random.default_rng(1).uniform(-1, 1, (20, 6)) * [80, 15, 80, 1.5, 40.0, 1.5]
    poses = controller._placement.moved(np.hstack([offsets[:, :3], np.radians(offsets[:, 3:])]))
    wanted = controller.joints(poses).q
    for asked in (offsets.tolist(), poses.tolist()):
        said = ask(url, "POST", "/joints", {"poses": asked})[2]
        assert_allclose(np.array(said["q"]) * CELL.joint_scales, wanted, rtol=0, atol=1e-8)
    single = ask(url, "POST", "/joints", {"poses": offsets[:1].tolist(), "q_now": [1.0] * 3 + [0.1] * 3})[2]
    assert_allclose(np.array(single["q"][0]) * CELL.joint_scales, wanted[0], rtol=0, atol=1e-8)
    task = find_task(CELL, estimate_of_now().vector(), "circle", n_points=5)
    prediction = predict_from_covariance(estimate_of_now(), task)
    said = ask(url, "POST", "/joints", {"poses": np.hstack([task.offsets[:, :3], task.offsets[:, 3:]]).tolist()})[2]
    assert_allclose(said["predicted_sd_nm"], 1e3 * prediction.sd, rtol=1e-9)
    out = ask(url, "POST", "/joints", {"poses": [[0, 0, 400, 0, 0, 0], [0] * 6]})[2]
    assert (out["q"][0], out["predicted_sd_nm"][0], out["status"][1]) == (None, None, "ok")
    assert out["status"][0].startswith("saturated: q")
    assert "1 of 2 points cannot be driven to" in out["warnings"][0]


def test_motion_is_held_to_the_envelope(campaign, tmp_path):
    narrow = replace(CELL, envelope=replace(CELL.envelope, max_tilt=np.radians(2.0)))
    write_estimate(tmp_path / "now.json", replace(estimate_of_now(), cell=narrow))
    with serving(narrow, campaign, tmp_path / "now.json") as url:
        for poses in ([[0, 0, 0, 2.5, 0, 0]], [[0] * 6, [0, 0, 0, 2.5, 0, 0]]):
            status, _, said = ask(url, "POST", "/joints", {"poses": poses})
            assert status == 422
            assert "the mirror may tilt by" in said["error"]["message"]
        # Where the robot stands counts too: the way from there.
        far = {"poses": [[0] * 6], "q_now": [0, 0, 0, 4.0, 0, 0]}
        assert ask(url, "POST", "/joints", far)[0] == 422
        assert ask(url, "POST", "/joints", {"poses": [[0] * 6, [0, 0, 0, 1, 0, 0]]})[0] == 200
        assert ask(url, "POST", "/joints", {"poses": [[0, 0, 0, 1, 0, 0]]})[0] == 200


def test_the_mirror_is_kept_off_the_fibre(campaign, tmp_path):
    """The least gap, for one pose and for a path; the reference is the gap that the cell states at joint zero."""
    assert CELL.envelope is not None
    gap, sd = CELL.envelope.gap, CELL.envelope.gap_sd
    near = replace(CELL, envelope=replace(CELL.envelope, least_gap=gap - 4.0 * sd - 50.0))
    write_estimate(tmp_path / "now.json", replace(estimate_of_now(), cell=near))
    with serving(near, campaign, tmp_path / "now.json") as url:
        for way, refused in ((100.0, True), (25.0, False), (-100.0, False)):
            pose = [0, way, 0, 0, 0, 0]
            for poses in ([pose], [[0] * 6, pose]):
                status, _, said = ask(url, "POST", "/joints", {"poses": poses})
                assert (status == 422) is refused, said
                assert not refused or "um from the fibre at 4 sd" in said["error"]["message"]


REFUSED = {
    "unusable": (lambda e: replace(e, trust=e.trust.because(Reason("poor-fit", "it does not fit"))), "it does not fit"),
    "expired": (lambda e: replace(e, valid_until_h=-1.0), "which has passed"),
    "timeless": (lambda e: replace(e, data={"session": "s1"}), "carries no clock time"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_joints_are_refused_until_the_reason_is_repeated(campaign, tmp_path, name):
    change, why = REFUSED[name]
    write_estimate(tmp_path / "now.json", change(estimate_of_now()))
    with serving(CELL, campaign, tmp_path / "now.json") as url:
        asked = {"poses": [[10, 0, 0, 0, 0, 0]]}
        status, _, said = ask(url, "POST", "/joints", asked)
        error = said["error"]
        assert (status, error["kind"]) == (409, "refused")
        assert why in error["despite"]
        for other in ("", "yes", error["despite"][:-1]):
            assert ask(url, "POST", "/joints", asked | {"despite": other})[0] == 409
        status, _, said = ask(url, "POST", "/joints", asked | {"despite": error["despite"]})
        assert (status, said["status"], said["predicted_sd_nm"]) == (200, ["ok"], [None])
        estimate = ask(url, "GET", "/estimate")[2]
        assert (estimate["trust"]["usable"], estimate["valid_until_h"]) == (False, None)


def test_the_clock_of_keep_tells_when_rows_have_none(campaign, tmp_path):
    estimate = replace(estimate_of_now(), data={"session": "s1"})
    for began, usable in (("2001-01-01T00:00:00Z", False), (time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), True)):
        write_estimate(tmp_path / "now.json", estimate, campaign_began_utc=began)
        with serving(CELL, campaign, tmp_path / "now.json") as url:
            assert ask(url, "GET", "/estimate")[2]["trust"]["usable"] is usable


def test_decision_and_suggestion_are_those_of_the_command(url, campaign, tmp_path):
    before = file_sha256(campaign)
    assert main(f"decide {campaign} --tolerance-nm 50 --sigma-nm 5 --json d.json --quiet".split()) == 0
    told = json.loads((tmp_path / "d.json").read_text())["decision"]
    said = ask(url, "GET", "/decision")[2]["decision"]
    assert {k: v for k, v in said.items() if "hours" not in k} == {k: v for k, v in told.items() if "hours" not in k}
    found = ask(url, "GET", "/suggest?n=3")[2]["sweeps"]
    assert len(found) == 3
    moves = [[s[c.replace("_", "_end_")] - s[c.replace("_", "_start_")] for c in CELL.joint_columns] for s in found]
    assert (np.count_nonzero(moves, axis=1) >= 1).all()
    assert ask(url, "GET", "/suggest?n=2")[2]["sweeps"] == found[:2]
    assert file_sha256(campaign) == before


def test_sweeps_are_appended_as_append_does(tmp_path):
    write_sweeps(tmp_path / "c.h5", session("full-0", 0.0, 1), CELL)
    write_estimate(tmp_path / "now.json", estimate_of_now())
    write_csv(tmp_path / "more.csv", session("s1", 2.0, 2, slice(0, 6)), CELL)
    text = (tmp_path / "more.csv").read_text()
    with serving(CELL, tmp_path / "c.h5", tmp_path / "now.json", now=lambda: time.time()) as url:
        status, _, said = ask(url, "POST", "/sweeps", text, Content_Type="text/csv")
        assert (status, said) == (201, {"sessions": ["s1"], "n_rows": 6, "n_missing": 0})
        assert read_sweeps(tmp_path / "c.h5", CELL).sessions == ("full-0", "s1")
        after = file_sha256(tmp_path / "c.h5")
        bad = text.replace("s1,", "s2,").replace("0.005", "zero", 1)
        for wrong, why in ((text, "session 's1'"), (bad, "row 2, column sigma_um"), ("", "body"), ("x", "row 1")):
            status, _, said = ask(url, "POST", "/sweeps", wrong, Content_Type="text/csv")
            assert (status, said["error"]["kind"]) == (422, "request"), wrong
            assert why in said["error"]["message"]
        assert file_sha256(tmp_path / "c.h5") == after


def test_the_page_is_live(url, monkeypatch):
    """The page itself takes seconds: tests of `fpcal report` hold it, and robustness/serve_load.py asks for it."""
    asked = []
    monkeypatch.setattr(state, "gather", lambda file, cell, **how: asked.append((file.name, how["now"])))
    monkeypatch.setattr(state, "campaign_html", lambda _: f"<!DOCTYPE html>{len(asked)}")
    for _ in range(2):
        status, headers, page = ask(url, "GET", "/report")
        assert (status, headers["Refresh"], page) == (200, "60", "<!DOCTYPE html>1")
    assert asked == [("campaign.csv", "0.000000")]


WRONG = [
    ("GET", "/nothing", None, 404, "Not Found"),
    ("DELETE", "/joints", None, 405, "Method Not Allowed"),
    ("POST", "/joints", {}, 422, "expected poses or a task"),
    ("POST", "/joints", {"task": "circle", "poses": [[0] * 6]}, 422, "expected poses or a task"),
    ("POST", "/joints", {"task": "/etc/passwd.csv"}, 422, "unknown task"),
    ("POST", "/joints", {"task": "\ud800"}, 422, "body.task"),
    ("POST", "/joints", {"poses": []}, 422, "at least 1"),
    ("POST", "/joints", {"poses": [[0] * 5]}, 422, "poses.0"),
    ("POST", "/joints", {"poses": [[0] * 6, np.eye(4).tolist()]}, 422, "all of one form"),
    ("POST", "/joints", {"poses": [(2 * np.eye(4)).tolist()]}, 422, "orthonormal"),
    ("POST", "/joints", {"poses": [[float("nan")] + [0] * 5]}, 422, "poses.0"),
    ("POST", "/joints", {"poses": [["1"] + [0] * 5]}, 422, "poses.0"),
    ("POST", "/joints", {"poses": [[0] * 6] * 5001}, 422, "at most 5000"),
    ("POST", "/joints", {"poses": [[0] * 6], "q_now": [0]}, 422, "expected 6 finite numbers"),
    ("POST", "/joints", {"poses": [[0] * 6], "q_now": [200, 0, 0, 0, 0, 0]}, 422, "q1 = 200"),
    ("POST", "/joints", {"poses": [[0] * 6], "speed": 1}, 422, "speed"),
    ("POST", "/joints", "[" * 100000, 400, "parsing"),
    ("POST", "/joints", b"\xff\xfe", 422, "body"),
    ("GET", "/suggest?n=0", None, 422, "n"),
    ("GET", "/suggest?n=x", None, 422, "n"),
]


@pytest.mark.parametrize(("method", "path", "body", "code", "why"), WRONG)
def test_errors_have_one_form(url, method, path, body, code, why):
    more = {} if body is None or isinstance(body, dict) else {"Content_Type": "application/json"}
    status, _, said = ask(url, method, path, body, **more)
    assert status == code
    assert set(said) == {"error"}
    assert why in said["error"]["message"]
    assert "\n" not in said["error"]["message"]
    join = "&" if "?" in path else "?"
    status, _, again = ask(url, method, f"{path}{join}always_200=1", body, **more)
    assert (status, again) == (200, said)


def test_another_method_is_told_which_there_is(url):
    status, headers, _ = ask(url, "DELETE", "/joints")
    assert (status, headers["Allow"]) == (405, "POST")


def test_an_estimate_that_is_not_there_is_an_error_of_this_side(campaign, tmp_path):
    with serving(CELL, campaign, tmp_path / "none.json") as url:
        assert ask(url, "GET", "/health")[2]["status"] == "no estimate"
        for method, path, body in (("GET", "/estimate", None), ("POST", "/joints", {"task": "circle"})):
            status, _, said = ask(url, method, path, body)
            assert (status, said["error"]["kind"]) == (409, "state")
        (tmp_path / "none.json").write_text('{"schema": "fpcal/1"')
        assert ask(url, "GET", "/estimate")[0] == 409
        write_estimate(tmp_path / "none.json", estimate_of_now())
        assert ask(url, "GET", "/estimate")[0] == 200


def test_others_need_the_token(campaign, folder, tmp_path):
    with serving(CELL, campaign, folder / "now.json", token="0123456789abcdef") as url:
        for headers in ({}, {"Authorization": "Bearer 0123456789abcdeF"}, {"Authorization": "Basic eDp5"}):
            status, _, said = ask(url, "GET", "/health", **headers)
            assert (status, said["error"]["kind"]) == (401, "token")
        assert ask(url, "GET", "/health", Authorization="Bearer 0123456789abcdef", Host="cell.lab")[0] == 200
    with pytest.raises(InputError, match="expected --token FILE too"):
        listening("0.0.0.0", 0, None)
    (tmp_path / "short").write_text("secret\n")
    line = f"serve --campaign {campaign} --estimate {folder / 'now.json'} --token short --port 1"
    assert main(line.split()) == 2


def test_pages_in_a_browser_cannot_speak_for_its_user(url):
    assert ask(url, "GET", "/health", Host="localhost:1")[0] == 200
    for headers in ({"Host": "attacker.example"}, {"Origin": "http://attacker.example"}, {"Host": "[::"}):
        assert ask(url, "POST", "/joints", {"task": "circle"}, **headers)[0] == 403


def test_the_api_describes_itself(url):
    told = ask(url, "GET", "/openapi.json")[2]
    assert set(told["paths"]) > {"/estimate", "/joints", "/decision", "/suggest", "/sweeps", "/report", "/health"}
    assert {"ErrorAnswer", "Asked"} <= set(told["components"]["schemas"])


def test_an_estimate_that_is_replaced_is_never_half_or_old(campaign, tmp_path):
    """Each number of the estimate says when it was written."""
    path, done, wrote = tmp_path / "now.json", threading.Event(), []
    estimate = estimate_of_now()

    def write():
        while not done.is_set():
            values = estimate.values.copy()
            values[-1] = len(wrote)
            write_estimate(path, replace(estimate, values=values))
            wrote.append(time.monotonic())
            time.sleep(0.15)

    write_estimate(path, estimate)
    writer = threading.Thread(target=write)
    with serving(CELL, campaign, path) as url:
        writer.start()
        try:
            reads = 0
            while reads < 12 or len(wrote) < 4:
                reads += 1
                asked = time.monotonic()
                said = ask(url, "GET", "/estimate")[2]
                assert (
                    content_sha256({k: v for k, v in said.items() if k != "content_sha256"}) == said["content_sha256"]
                )
                number = round(said["parameters"]["z_wf"]["value"])
                later = wrote[number + 1 : number + 2]
                assert not later or later[0] > asked - 1.0
        finally:
            done.set()
            writer.join()


def resident_mb():
    with open("/proc/self/status") as file:
        return int(next(line for line in file if line.startswith("VmRSS")).split()[1]) / 1024.0


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
def test_a_hundred_connections_of_rubbish_end_in_bounded_memory(url, monkeypatch):
    monkeypatch.setattr(guard, "_SECONDS", 1.0)
    host, port = url.removeprefix("http://").split(":")
    sent = [
        b"",
        b"\x16\x03\x01\x02\x00\x01\x00",
        b"rubbish\r\n\r\n",
        b"GET /health HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ",
        b"GET /health HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * 40000,
        b"POST /joints HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000\r\n\r\n{",
        b"POST /joints HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n5\r\n{",
        b"POST /joints HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999\r\n\r\n" + b"[" * 3_000_000,
    ]
    open_ones, before = [], resident_mb()
    for data in sent * 13:
        connection = socket.create_connection((host, int(port)), timeout=20)
        open_ones.append(connection)
        try:
            connection.sendall(data)
        except OSError:
            assert len(data) > 1_000_000
        assert ask(url, "GET", "/health")[0] == 200
    assert resident_mb() - before < 100.0
    for data, connection in zip(sent * 13, open_ones, strict=True):
        answer = b""
        with connection, contextlib.suppress(ConnectionResetError):
            while part := connection.recv(1 << 16):
                answer += part
        if b"Content-Length: 1000\r\n" in data:
            assert answer.startswith(b"HTTP/1.1 408")
    assert ask(url, "POST", "/joints", {"task": "circle", "points": 3})[0] == 200
