"""Figures of plans show the numbers they are given."""

from pathlib import Path

import numpy as np
import pytest


def test_accuracy_against_the_number_of_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "studies"))
    from planning import draw_accuracy

    found = {"greedy": {8: {"circle": 0.004, "spin": 0.1}, 4: {"circle": 0.01, "spin": 0.3}}}
    figure = draw_accuracy(found, {"paper": {"circle": 0.001, "spin": 0.015}})
    assert [axis.get_title() for axis in figure.axes] == ["circle", "spin"]
    level, line = figure.axes[0].lines
    np.testing.assert_allclose(line.get_xydata(), [[4, 10.0], [8, 4.0]])
    np.testing.assert_allclose(level.get_ydata(), 1.0)
    assert figure.axes[0].get_yscale() == "log"
