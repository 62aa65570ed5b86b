"""A server under load: many reads while a campaign is tracked, rubbish on its connections, the page as it is.

    python tests/robustness/serve_load.py [--reads 10000]

A child process appends sessions to the campaign and tracks them with `fpcal track --estimate`, one after the other. No
read may be half an estimate, or older than a second. With schemathesis installed, its fuzzer must find no 5xx.
"""

import argparse
import http.client
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from serve_fixtures import ask, serving  # noqa: E402

from fpcal_bayes.cli.main import main as fpcal  # noqa: E402
from fpcal_bayes.core.files import content_sha256  # noqa: E402
from fpcal_bayes.io.cell import load_cell  # noqa: E402
from fpcal_bayes.io.sweeps import write_sweeps  # noqa: E402
from fpcal_bayes.measure.protocol import paper_protocol  # noqa: E402
from fpcal_bayes.measure.truth import paper_truth  # noqa: E402
from fpcal_bayes.simulator.sweeps import simulate  # noqa: E402

#: Seconds that an answer may be behind the file.
LATE_S = 1.0


def session(cell, path: Path, name: str, time_h: float, rows) -> None:
    """Write a measured session."""
    plan = paper_protocol(cell, session=name).take(np.asarray(rows))
    plan = replace(plan, time_h=np.full(len(plan), time_h))
    write_sweeps(path, simulate(cell, paper_truth(cell), plan, sigma_nm=5.0, seed=int(time_h)), cell)


def track(folder: Path) -> None:
    """Append sessions and track, until the parent ends this process."""
    os.chdir(folder)
    cell = load_cell(mechanics="none")
    for hour in range(1, 10_000):
        session(cell, Path("more.csv"), f"s{hour}", float(hour), range(45, 51))
        for line in ("append c.h5 more.csv", "track c.h5 --estimate now.json"):
            if fpcal([*line.split(), "--mechanics", "none", "--quiet"]):
                raise SystemExit(f"fpcal {line} failed")


def reads(url: str, estimate: Path, n: int) -> tuple[int, list[str]]:
    """How many estimates were seen, and what was wrong with a read."""
    connection, wrong, whole = http.client.HTTPConnection(url.removeprefix("http://")), [], {}
    for _ in range(n):
        asked, before = time.time(), estimate.stat()
        connection.request("GET", "/estimate")
        answer = connection.getresponse()
        text = answer.read()
        if answer.status != 200:
            wrong.append(f"status {answer.status}: {text[:100]!r}")
            continue
        if text not in whole:
            said = json.loads(text)
            stated = said.pop("content_sha256")
            if content_sha256(said) != stated:
                wrong.append("half an estimate")
            whole[text] = said["data"]["session"], said["time_h"]
        if before.st_mtime < asked - LATE_S:
            file = json.loads(estimate.read_text())
            if estimate.stat() == before and (file["data"]["session"], file["time_h"]) != whole[text]:
                wrong.append(f"{asked - before.st_mtime:.2f} s old: {whole[text]}")
    connection.close()
    return len(whole), wrong


def fuzz(url: str) -> int:
    """The status of schemathesis; what it says is shown."""
    line = [sys.executable, "-m", "schemathesis.cli", "run", f"{url}/openapi.json", "--checks", "not_a_server_error"]
    return subprocess.run([*line, "--max-examples", "20", "--exclude-path", "/report"], check=False).returncode


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reads", type=int, default=10_000)
    parser.add_argument("--track", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.track is not None:
        track(options.track)
        return 0
    cell, failed = load_cell(mechanics="none"), False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        campaign, estimate = folder / "c.h5", folder / "now.json"
        session(cell, campaign, "full-0", 0.0, range(69))
        if fpcal(["track", str(campaign), "--estimate", str(estimate), "--mechanics", "none", "--quiet"]):
            return 1
        with serving(cell, campaign, estimate) as url:
            child = subprocess.Popen([sys.executable, __file__, "--track", name])
            try:
                seen, wrong = reads(url, estimate, options.reads)
            finally:
                failed = child.poll() is not None
                child.terminate()
                child.wait()
            print(f"{options.reads} reads of {seen} estimates: {len(wrong)} wrong {wrong[:3]}")
            status, _, page = ask(url, "GET", "/report")
            shown = status == 200 and page.rstrip().endswith("</html>") and "<svg" in page
            print(f"report: status {status}, {len(page)} characters")
            if importlib.util.find_spec("schemathesis"):
                failed |= fuzz(url) != 0
    return int(failed or bool(wrong) or seen < 2 or not shown)


if __name__ == "__main__":
    sys.exit(main())
