import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent / "faults.py"


@pytest.mark.slow
def test_some_faults():
    """Faults of every kind: cut and changed inputs, kills, full disks and so on. The program injects thousands."""
    command = [sys.executable, str(PROGRAM), "--faults", "25", "--quick"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    assert "25 faults injected" in found.stdout
    assert "0 problems" in found.stdout
