from pathlib import Path

import numpy as np
import pytest

from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.io.sweeps import read_sweeps

CASE_A = Path(__file__).parent / "data" / "case_a.csv"


@pytest.fixture(scope="module")
def found(femto):
    """A small posterior of six parameters."""
    free = ["z_et", "x_wf", "z_wf", "theta_wf", "beta_wf", "theta_6"]
    return sample(identify(femto, read_sweeps(CASE_A, femto), free=free), draws=200)


def test_units_on_every_panel(found):
    axes = found.plot().axes
    assert len(axes) == 6
    assert {"z_et [um]", "x_wf [um]", "theta_wf [deg]"} <= {axis.get_xlabel() for axis in axes}


def test_posterior_line_is_the_posterior(found):
    """The median of the draws halves what is under the solid line of a panel, the prior's under the dashed."""
    axis = next(axis for axis in found.plot().axes if axis.get_xlabel() == "z_wf [um]")
    for line, group in zip(axis.lines, ("prior", "posterior"), strict=True):
        x, y = np.asarray(line.get_xdata()), np.cumsum(np.asarray(line.get_ydata()))
        draws = found.to_arviz()[group]["z_wf"].values
        assert x[np.searchsorted(y, 0.5 * y[-1])] == pytest.approx(np.median(draws), abs=0.25 * draws.std())
