"""What users call from outside refuses objects of another kind in one sentence."""

import inspect
import pickle

import numpy as np
import pytest

import fpcal_bayes as fp
from fpcal_bayes.core.errors import InputError

CELL = fp.load_cell(mechanics="none")
FUNCTIONS = sorted(name for name in fp.__all__ if inspect.isfunction(getattr(fp, name)))


def asked(name: str) -> dict[str, str]:
    """Arguments for which a function asks an object of the package."""
    parameters = inspect.signature(getattr(fp, name)).parameters
    found = {each: parameters[each].annotation for each in parameters}
    return {each: str(kind) for each, kind in found.items() if "<class 'fpcal_bayes." in str(kind)}


def test_there_are_functions_to_try():
    assert {"predict_from_covariance", "identify", "decide_track", "write_sweeps"} <= set(FUNCTIONS)
    assert asked("predict_from_covariance").keys() == {"estimate", "task"}


@pytest.mark.parametrize(
    "value", [np.zeros(3), None, "nothing.csv", float("nan"), [], {}], ids=lambda v: type(v).__name__
)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_another_object_is_refused_by_name(name, value):
    parameters = inspect.signature(getattr(fp, name)).parameters.values()
    needed = [each.name for each in parameters if each.default is each.empty]
    for wrong in asked(name):
        # What is not at fault is told apart by its order: the first argument that is of another kind is named.
        given = dict.fromkeys(needed, CELL) | {wrong: value}
        with pytest.raises(InputError, match=rf"{name}: \w+ is of type \w+, expected [A-Z]\w+$"):
            getattr(fp, name)(**given)


def test_the_name_and_the_kinds_are_said(femto):
    sweeps = fp.simulate(femto, fp.paper_truth(femto), fp.paper_protocol(femto), sigma_nm=5.0, seed=0)
    estimate = fp.identify(femto, sweeps).estimate
    with pytest.raises(InputError, match=r"^predict_from_covariance: task is of type ndarray, expected Task$"):
        fp.predict_from_covariance(estimate, np.zeros((3, 6)))
    with pytest.raises(InputError, match=r"^identify: prior is of type ndarray, expected Estimate$"):
        fp.identify(femto, fp.paper_protocol(femto), prior=np.zeros(21))
    with pytest.raises(TypeError, match="missing"):
        fp.identify(femto)
    with pytest.raises(InputError, match=r"^Controller: estimate is of type ndarray, expected Estimate$"):
        fp.Controller(np.zeros(21))


def test_what_is_a_number_is_told_by_its_kind():
    for n in (np.str_("5"), np.bool_(True), np.array(2.0), np.array([2]), np.float64(2.0), np.array("5"), np.float64):
        with pytest.raises(InputError, match=r"^plan: n is of type \w+, expected a whole number$"):
            fp.plan(CELL, n)
    for sigma in (np.str_("5"), np.bool_(True), True, np.array(5j), np.array([5.0]), np.datetime64(5, "s"), "5"):
        with pytest.raises(InputError, match=r"^plan: sigma_nm is of type \w+, expected a number$"):
            fp.plan(CELL, 1, sigma_nm=sigma)
    one = fp.plan(CELL, np.array(1), draws=np.uint8(2), sigma_nm=np.array(5))
    np.testing.assert_array_equal(one.q_end, fp.plan(CELL, 1, draws=2, sigma_nm=5.0).q_end)
    truth, sweeps = fp.paper_truth(CELL), fp.paper_protocol(CELL)
    for sigma in ("5", None, True, np.str_("5"), np.array(["5"]), ["5"], np.array([True]), {}):
        with pytest.raises(InputError, match=r"^simulate: sigma_nm is of type \w+, expected a number or an array$"):
            fp.simulate(CELL, truth, sweeps, sigma_nm=sigma, seed=0)
    same = [fp.simulate(CELL, truth, sweeps, sigma_nm=s, seed=0) for s in (5, np.full(len(sweeps), 5))]
    np.testing.assert_array_equal(same[0].dl, same[1].dl)


def test_functions_go_to_other_processes():
    for name in FUNCTIONS:
        assert pickle.loads(pickle.dumps(getattr(fp, name))) is getattr(fp, name)
