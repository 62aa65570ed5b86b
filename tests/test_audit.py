"""The audit tells a weakness from a question that was not answered."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

STUDY = Path(__file__).parents[1] / "studies" / "audit.py"
CLEAN = {"name": "alpha", "version": "1.0", "vulns": []}
WEAK = {"name": "beta", "version": "2.0", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2.1"]}]}
UNKNOWN = {"name": "gamma", "skip_reason": "Dependency not found"}


@pytest.fixture
def audit(monkeypatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("audit", STUDY)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", ["audit"])
    return module


@pytest.mark.parametrize(
    ("packages", "status", "said"),
    [
        ([CLEAN, UNKNOWN], 0, "0 known weaknesses in 1 packages; not known there: gamma"),
        ([CLEAN, WEAK], 1, "beta 2.0: PYSEC-1, mended in 2.1"),
        ([UNKNOWN], 0, "skipped: the service that was asked knows none of 1 packages"),
        (None, 0, "skipped: pip-audit cannot ask: ConnectionError: no route"),
    ],
)
def test_verdict(audit, monkeypatch, capsys, packages, status, said):
    def answer(command, **_):
        if packages is not None:
            Path(command[command.index("-o") + 1]).write_text(json.dumps({"dependencies": packages}))
        return subprocess.CompletedProcess(command, 1, "", "Traceback\nConnectionError: no route\n")

    monkeypatch.setattr(audit.subprocess, "run", answer)
    assert audit.main() == status
    assert said in capsys.readouterr().out
