"""A few of the random faults of rig_faults.py, which alone drives hundreds of them."""

import pytest
import rig_faults

pytest.importorskip("pipython")


def test_faults_at_random_moments(tmp_path):
    account = rig_faults.run(tmp_path, 10, seed=3)
    assert account.wrong == []
    assert account.faults >= 10
    assert account.rows + account.doubtful == account.sessions * len(rig_faults.SWEEPS)
