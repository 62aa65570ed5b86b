import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.model.priors import LogNormal, TruncatedNormal, Uniform

HALF_NORMAL = TruncatedNormal(2.0, 3.0, 2.0, np.inf)
CASES = [
    (TruncatedNormal(1.0, 2.0, -0.5, 2.0), stats.truncnorm(-0.75, 0.5, 1.0, 2.0)),
    (TruncatedNormal(1.0, 2.0, -np.inf, 5.0), stats.truncnorm(-np.inf, 2.0, 1.0, 2.0)),
    (TruncatedNormal(-1.0, 0.1, -np.inf, np.inf), stats.norm(-1.0, 0.1)),
    (HALF_NORMAL, stats.halfnorm(2.0, 3.0)),
    (Uniform(-3.0, 8.0), stats.uniform(-3.0, 11.0)),
    (LogNormal(4.0, 1.5), stats.lognorm(np.log(1.5), scale=4.0)),
]
NAMES = ["truncated", "cut above", "not cut", "half-normal", "uniform", "log-normal"]
EVERY = pytest.mark.parametrize(("marginal", "known"), CASES, ids=NAMES)


@EVERY
def test_normal_scores_have_the_distribution_that_scipy_has(marginal, known):
    scores = np.linspace(-7.0, 7.0, 141)
    values = marginal.value(scores)
    lower = scores <= 0
    np.testing.assert_allclose(known.cdf(values)[lower], stats.norm.cdf(scores)[lower], rtol=1e-8, atol=1e-14)
    np.testing.assert_allclose(known.sf(values)[~lower], stats.norm.sf(scores)[~lower], rtol=1e-8, atol=1e-14)
    assert marginal.sd == pytest.approx(known.std(), rel=1e-9)


@EVERY
@given(score=st.floats(-5.0, 5.0))
def test_score_and_slope(marginal, known, score):
    at = np.array([score])
    value = marginal.value(at)
    assert marginal.score(value)[0] == pytest.approx(score, abs=1e-6)
    # The densities of value and score differ by the slope.
    assert marginal.slope(at)[0] == pytest.approx(stats.norm.pdf(score) / known.pdf(value[0]), rel=1e-6)


@pytest.mark.parametrize("marginal", [CASES[0][0], HALF_NORMAL, CASES[4][0]])
def test_far_scores_stay_inside(marginal):
    values = marginal.value(np.array([-40.0, -9.0, 9.0, 40.0]))
    assert (np.diff(values) >= 0).all()
    low, high = (marginal.low, marginal.high)
    assert values[0] >= low
    assert values[-1] <= high


@pytest.mark.parametrize(
    ("marginal", "value"), [(CASES[0][0], 2.5), (HALF_NORMAL, 1.0), (CASES[4][0], 8.0), (CASES[5][0], -1.0)]
)
def test_values_outside_are_refused(marginal, value):
    with pytest.raises(InputError, match="outside its prior's limits"):
        marginal.score(np.array([value]))


@pytest.mark.parametrize(
    "make",
    [
        lambda: TruncatedNormal(3.0, 1.0, -1.0, 2.0),
        lambda: TruncatedNormal(0.0, 0.0, -1.0, 2.0),
        lambda: Uniform(1.0, 1.0),
        lambda: Uniform(0.0, np.inf),
        lambda: LogNormal(0.0, 2.0),
        lambda: LogNormal(1.0, 1.0),
    ],
)
def test_impossible_priors_are_refused(make):
    with pytest.raises(InputError, match="expected"):
        make()
