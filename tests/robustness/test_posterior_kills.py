import subprocess
import sys
from pathlib import Path

import pytest
from posterior_kills import MOMENTS

HERE = Path(__file__).parent


@pytest.mark.slow
def test_kills_at_chosen_moments_change_nothing():
    """While a block is written, between two, and while the draws are written. The program also kills at random ones."""
    command = [sys.executable, str(HERE / "posterior_kills.py"), str(HERE.parent / "data" / "case_a.csv")]
    found = subprocess.run(
        [*command, "--kills", "0", "--draws", "400"], capture_output=True, text=True, check=False, timeout=900
    )
    assert found.returncode == 0, found.stdout + found.stderr
    assert found.stdout == f"{len(MOMENTS)} kills, draws identical byte for byte\n"
