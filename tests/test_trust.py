"""The rule of trust: which reasons forbid the use of a result, and how a file repeats it."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fpcal_bayes.model.trust import KINDS, UNRECORDED, FitEvidence, Reason, Trust, judge_fit, trust_of

GOOD = FitEvidence(True, 1, 69, 50.0, 53.0, 0.6, 60.0, 0.7, 16, "a +1 sd", 50.0, 53.0, 0.6)
reasons = st.lists(st.builds(Reason, st.sampled_from(sorted(KINDS)), st.text(max_size=20)), max_size=4)


def test_a_good_fit_is_usable_without_a_word():
    assert judge_fit(GOOD) == Trust()
    assert judge_fit(GOOD).verdict == "usable"


@pytest.mark.parametrize(
    ("change", "kind", "verdict"),
    [
        ({"converged": False}, "not-converged", "unusable"),
        ({"chi2_data": 219.0, "p_value": 1e-20}, "poor-fit", "unusable"),
        ({"sum_of_squares": 190.0, "p_total": 1e-12}, "poor-fit", "unusable"),
        ({"chi2_noise": 0.2, "p_noise": 1.0}, "too-good-fit", "doubtful"),
        ({"rank": 0}, "nothing-determined", "doubtful"),
    ],
)
def test_what_is_held_against_a_fit(change, kind, verdict):
    found = judge_fit(replace(GOOD, **change))
    assert [reason.kind for reason in found.reasons] == [kind]
    assert found.verdict == verdict
    assert found.usable == (verdict != "unusable")
    assert bool(found.against) == (verdict == "unusable")


def test_a_second_solution_leaves_a_result_usable():
    found = judge_fit(GOOD, Reason("second-solution", "another one"))
    assert (found.usable, found.verdict) == (True, "doubtful")


@given(reasons)
def test_a_file_says_what_was_found(given_reasons):
    found = Trust().because(*given_reasons)
    assert trust_of(found.content()) == found
    assert found.because(*given_reasons) == found


def test_a_file_without_a_verdict_says_so():
    assert trust_of(None).reasons == (UNRECORDED,)


@pytest.mark.parametrize(
    "content",
    [
        "good",
        {"usable": True},
        {"usable": True, "verdict": "usable", "reasons": [{"kind": "poor-fit", "text": "bad"}]},
        {"usable": False, "verdict": "unusable", "reasons": []},
        {"usable": True, "verdict": "usable", "reasons": "none"},
        {"usable": True, "verdict": "doubtful", "reasons": [{"kind": "invented", "text": ""}]},
        {"usable": True, "verdict": "doubtful", "reasons": [{"kind": "signs"}]},
    ],
)
def test_a_contradiction_is_refused(content):
    with pytest.raises(ValueError, match=r"expected|reasons"):
        trust_of(content)
