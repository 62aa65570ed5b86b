"""Programs that ask `fpcal serve`: Octave, Python by its standard library, and the bytes that LabVIEW sends."""

import importlib.util
import re
import shutil
import socket
import subprocess
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rig_fixtures import live, write_ticket
from serve_fixtures import CLIENTS, ask, serving, write_estimate
from task_fixtures import paper_estimate

from fpcal_bayes.analysis import watch
from fpcal_bayes.cli.main import main
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_sweeps, write_csv
from fpcal_bayes.io.tickets import read_ticket
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.trust import Reason
from fpcal_bayes.simulator.sweeps import simulate

CELL = load_cell(mechanics="none")
OCTAVE = shutil.which("octave-cli")
MATLAB = CLIENTS.parent / "matlab"
PAGE = Path(__file__).parent.parent / "docs" / "how-to" / "serve.md"


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    plan = paper_protocol(CELL, session="full-0")
    write_csv(folder / "campaign.csv", simulate(CELL, paper_truth(CELL), plan, sigma_nm=5.0, seed=1), CELL)
    write_csv(folder / "more.csv", replace(plan.take(np.arange(2)), session=np.array(["s1", "s1"])), CELL)
    write_estimate(folder / "now.json", replace(paper_estimate(CELL), valid_until_h=24.0))
    with serving(CELL, folder / "campaign.csv", folder / "now.json") as found:
        yield found


@pytest.fixture
def client(url):
    spec = importlib.util.spec_from_file_location("fpcal_client", CLIENTS / "fpcal_client.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = module.Client(url)
    found.error = module.FpcalError
    yield found
    found.close()


def test_python_asks(client, url):
    first = client.estimate()
    assert client.estimate() is first
    assert client.estimate(flat=True)["schema"] == "fpcal-flat/1"
    assert client.joints([[10, 0, 0, 0, 0, 0]])["status"] == ["ok"]
    assert len(client.joints(task="circle", points=5)["q"]) == 5
    assert client.health()["status"] == "ok"
    with pytest.raises(client.error, match="unknown task") as caught:
        client.joints(task="square")
    assert (caught.value.kind, caught.value.despite) == ("request", "")
    with pytest.raises(client.error, match="row 1"):
        client.sweeps("nothing\n")
    assert ask(url, "GET", "/clients/fpcal_client.py")[2] == (CLIENTS / "fpcal_client.py").read_text()
    assert "function answer = fpcal_client" in ask(url, "GET", "/clients/fpcal_client.m")[2]


def test_the_bytes_of_the_labview_page_are_answered(url):
    """Each request of the page, byte by byte; its answer begins and ends as the page shows."""
    text = PAGE.read_text(encoding="utf-8")
    requests = re.findall(r"```http\n(\w+ /.*?)```\n+```http\n(.*?)```", text, flags=re.DOTALL)
    assert len(requests) >= 3
    host, port = url.removeprefix("http://").split(":")
    for sent, shown in requests:
        head, _, body = sent.replace("127.0.0.1:8765", f"{host}:{port}").partition("\n\n")
        body = body.rstrip("\n")
        stated = re.search(r"Content-Length: (\d+)", head)
        assert int(stated[1] if stated else 0) == len(body)
        with socket.create_connection((host, int(port)), timeout=30) as connection:
            connection.sendall(f"{head}\n\n{body}".replace("\n", "\r\n").encode("ascii"))
            answer = b""
            while part := connection.recv(1 << 16):
                answer += part
        status, _, rest = answer.decode("ascii").partition("\r\n")
        lines = shown.strip().splitlines()
        assert status == lines[0]
        for piece in lines[-1].split("..."):
            assert piece.strip() in rest, piece


def octave(folder, script, **more):
    return subprocess.Popen(
        [str(OCTAVE), "--no-init-file", "--eval", f"addpath('{MATLAB}'); {script}"],
        cwd=folder, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **more
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(OCTAVE is None, reason="octave-cli is not installed (apt-get install octave)")
def test_octave_asks_and_is_refused(url, tmp_path):
    poses = [[10, 5, 20, 0.5, 20, 0.5], [0, 0, 1000, 0, 0, 0], [0, 0, 0, 0, 0, 0]]
    wanted = ask(url, "POST", "/joints", {"poses": poses})[2]
    script = (
        f"url = '{url}'; now = fpcal_client(url, 'estimate'); way = fpcal_client(url, 'joints', "
        "[10 5 20 0.5 20 0.5; 0 0 1000 0 0 0; 0 0 0 0 0 0]); one = fpcal_client(url, 'joints', [0 0 0 0 0 0], "
        "[1 1 1 0 0 0]); own = fpcal_ik(now, [10; 5; 20; 0.5; 20; 0.5]);"
        "fprintf('%.15g ', way.q', way.predicted_sd_nm, one.q, own);"
        "disp(way.status{2}); told = fpcal_client(url, 'health'); disp(told.status);"
        "try, fpcal_client(url, 'joints', struct('task', 'square')); catch e, disp(e.identifier); disp(e.message); end;"
        "try, fpcal_client(url, 'sweeps', 'x'); catch e, disp(e.message); end;"
    )
    ran = octave(tmp_path, script)
    out, errors = ran.communicate(timeout=120)
    assert ran.returncode == 0, errors
    lines = out.splitlines()
    numbers, status = lines[0].rsplit("out of reach", 1)[0].split("saturated")[0], wanted["status"][1]
    found = np.array([float(x) for x in numbers.split()])
    assert_allclose(found[:18].reshape(3, 6)[[0, 2]], [wanted["q"][0], wanted["q"][2]], rtol=1e-13)
    assert np.isnan(found[6:12]).all()
    assert_allclose(found[[18, 20]], [wanted["predicted_sd_nm"][i] for i in (0, 2)], rtol=1e-13, atol=1e-15)
    assert_allclose(found[21:27], wanted["q"][2], rtol=1e-9, atol=1e-12)
    assert_allclose(found[27:], wanted["q"][0], rtol=0, atol=1e-9)
    assert lines[0].endswith(status)
    assert lines[1:3] == ["ok", "fpcal:request"]
    assert "unknown task 'square'" in lines[3]
    assert "sweeps: row 1" in lines[4]


DRIVE = """
way = fpcal_client('{url}', 'joints', struct('task', 'circle', 'points', {points}));
assert(all(strcmp(way.status, 'ok')));
stage = popen("bash -c 'exec cat > /dev/tcp/{pi}'", 'w'); turn = popen("bash -c 'exec cat > /dev/tcp/{smaract}'", 'w');
fprintf(turn, ':CHAN%d:MMOD 0\\n', 1:3);
for i = 0:rows(way.q)
  q = way.q(max(i, 1), :);
  if i == 0, aligned = fpcal_client('{url}', 'joints', zeros(1, 6)); q = aligned.q; end
  fprintf(stage, 'MOV 1 %.6f 2 %.6f 3 %.6f\\n', q(1:3) + 150); fflush(stage);
  fprintf(turn, ':MOVE%d %d\\n', [1:3; round(q(4:6) * 1e9)]); fflush(turn);
  disp(i); fflush(stdout); input('', 's');
end
"""


@pytest.mark.slow
@pytest.mark.skipif(OCTAVE is None, reason="octave-cli is not installed (apt-get install octave)")
def test_octave_drives_a_circle_on_the_emulated_cell_while_it_is_kept(tmp_path, monkeypatch):
    pytest.importorskip("pipython")
    monkeypatch.chdir(tmp_path)
    points, done = 9, threading.Event()
    with live(CELL, tmp_path, speedup=100.0) as cell:
        cell.measure(write_ticket(tmp_path / "day0.csv", CELL, session="full-T0"), tmp_path / "campaign.h5")

        def sleep(seconds):
            if done.wait(min(seconds, 0.2)):
                raise SystemExit

        monkeypatch.setattr(watch, "time", SimpleNamespace(sleep=sleep, monotonic=time.monotonic))
        line = "keep campaign.h5 --ticket ticket.csv --estimate now.json --rig live.toml --tolerance-nm 400 --quiet"
        keeper = threading.Thread(target=lambda: main([*line.split(), "--every-min", "6000"]))
        keeper.start()
        try:
            end = time.monotonic() + 60.0
            while not Path("now.json").exists() and time.monotonic() < end:
                done.wait(0.1)
            with serving(CELL, "campaign.h5", "now.json", now=cell.rig.clock.now) as url:
                assert ask(url, "GET", "/estimate")[2]["trust"]["usable"]
                ends = {name: end.address for name, end in cell.emulated.server.endpoints.items()}
                to = {k: str(ends[n]).replace(":", "/") for k, n in (("pi", "E-712"), ("smaract", "MCS-3D"))}
                driving = octave(tmp_path, DRIVE.format(url=url, points=points, **to))
                lengths = []
                for _ in range(points + 1):
                    assert driving.stdout.readline(), driving.stderr.read()
                    done.wait(0.1)
                    lengths.append(cell.emulated.lab.length())
                    driving.stdin.write("\n")
                    driving.stdin.flush()
                driving.communicate(timeout=60)
                assert driving.returncode == 0
                told = ask(url, "GET", "/decision")[2]["decision"]
        finally:
            done.set()
            keeper.join(60.0)
        assert told["action"] == "hold"
        assert read_ticket("ticket.csv", CELL).plan is None
        assert read_sweeps("campaign.h5", CELL).sessions == ("full-T0",)
        assert {joint for joint, _, _ in cell.emulated.lab.commanded} == set(range(6))
        # The estimate expects a circle that leaves the length as it is; a nominal one misses micrometres.
        assert np.ptp(lengths) < 0.1


def test_an_estimate_that_is_not_to_be_used_is_refused_to_every_client(tmp_path, url):
    doubtful = replace(paper_estimate(CELL), trust=paper_estimate(CELL).trust.because(Reason("poor-fit", "no fit")))
    write_estimate(tmp_path / "bad.json", doubtful)
    spec = importlib.util.spec_from_file_location("fpcal_client", CLIENTS / "fpcal_client.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with serving(CELL, tmp_path / "none.csv", tmp_path / "bad.json") as bad:
        client = module.Client(bad)
        with pytest.raises(module.FpcalError, match="not to be driven with: no fit") as caught:
            client.joints(task="circle", points=3)
        assert caught.value.kind == "refused"
        assert client.joints(task="circle", points=3, despite=caught.value.despite)["status"] == ["ok"] * 3
        client.close()
