"""Two kinds of errors compared, and the standard errors of that."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "studies"))
from planning import compare


def test_one_is_a_multiple_of_the_other() -> None:
    theirs = np.random.default_rng(0).lognormal(size=50)
    found = compare(3.0 * theirs, theirs)
    for name in ("ratio_of_rms", "mean_ratio", "ratio_of_medians"):
        assert found[name] == pytest.approx(3.0)
        assert found[f"{name}_se"] == pytest.approx(0.0, abs=1e-9)


def test_standard_errors_are_the_spread_over_sets_of_truths() -> None:
    random = np.random.default_rng(1)
    sets = [compare(*np.abs(random.normal(size=(2, 100)) + 3.0)) for _ in range(40)]
    for name in ("ratio_of_rms", "mean_ratio", "ratio_of_medians"):
        stated = np.mean([found[f"{name}_se"] for found in sets])
        # 40 sets tell a spread to 11 %.
        assert stated == pytest.approx(np.std([found[name] for found in sets]), rel=0.35)
