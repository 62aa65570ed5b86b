"""Pictures of doubtful sweeps show the trace, the fit, the turns and what is left."""

import numpy as np
from trace_fixtures import irradiance

from fpcal_bayes.fringes.profile import DisplacementProfile, legendre
from fpcal_bayes.fringes.reader import Recorded, read_traces
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.report.fringes import draw_sweep


def samples() -> Samples:
    random, s = np.random.default_rng(3), np.linspace(-1.0, 1.0, 800)
    phase = 4.0 * np.pi / 1.56 * (legendre(s)[:, 1:] @ np.array([1.0, -2.5, 0, 0, 0, 0]))
    return Samples(s, s, irradiance(random, phase, (s + 1) / 2), np.ones(800))


def test_a_sweep_that_was_read_has_three_panels() -> None:
    laid = samples()
    prior = DisplacementProfile(np.zeros(6), np.diag([25.0, 25.0, 0, 0, 0, 0]))
    reading = read_traces([Recorded("spin", laid, 0.0, 90.0, prior, 1.56)], noise=0.01)[0]
    figure = draw_sweep(reading, laid, 0.0, 90.0, "q6 [deg]", "a reason")
    trace, profile, left = figure.axes
    assert "spin: a reason" in figure.get_suptitle()
    tops = next(line for line in trace.lines if str(line.get_label()).endswith("fringes"))
    assert abs(len(tops.get_xdata()) - reading.fringes) < 2
    turn = next(line for line in trace.lines if len(line.get_xdata()) == 2)
    np.testing.assert_allclose(turn.get_xdata()[0], reading.reversals[0], atol=1e-9)
    np.testing.assert_allclose(abs(profile.lines[0].get_ydata()[-1]), abs(reading.dl), atol=1e-9)
    residual = np.asarray(left.lines[0].get_ydata())
    assert 0.008 < residual.std() < 0.012


def test_a_refused_trace_is_drawn_alone() -> None:
    laid = samples()
    flat = Samples(laid.s, laid.time, np.ones(800), laid.count)
    prior = DisplacementProfile(np.zeros(6), np.diag([25.0, 25.0, 0, 0, 0, 0]))
    reading = read_traces([Recorded("spin", flat, 0.0, 90.0, prior, 1.56)])[0]
    figure = draw_sweep(reading, flat, 0.0, 90.0, "q6 [deg]", reading.refused)
    assert len(figure.axes) == 1
    assert figure.axes[0].get_xlabel() == "q6 [deg]"
