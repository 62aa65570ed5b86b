"""Results as a notebook shows them, by public names."""

import json
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from xarray import DataTree

import fpcal_bayes as fp
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.model.trust import Reason

FREE = ["z_et", "x_wf", "z_wf", "theta_wf", "beta_wf", "theta_6"]


@pytest.fixture(scope="module")
def results(femto):
    """One result of each kind, with its command."""
    plan = fp.paper_protocol(femto)
    sweeps = fp.simulate(femto, fp.paper_truth(femto), plan, sigma_nm=5, seed=0)
    found = fp.identify(femto, sweeps)
    circle = fp.find_task(femto, found.estimate.vector(), "circle").driven()
    return {
        "observe": fp.observe(femto, sweeps),
        "identify": found,
        "sample": fp.sample(fp.identify(femto, sweeps, free=FREE), draws=100, seed=0),
        "task-error": fp.predict_from_covariance(found.estimate, circle, draws=200),
        "track": fp.track(femto, sweeps),
    }


@pytest.mark.parametrize("kind", ["observe", "identify", "sample", "task-error", "track"])
def test_each_result_shows_itself(results, kind, tmp_path):
    result = results[kind]
    assert len(repr(result)) < 200
    assert repr(result) not in ("", object.__repr__(result))
    text, html, frame, figure = result.summary(), result._repr_html_(), result.to_dataframe(), result.plot()
    assert isinstance(figure, Figure)
    figure.savefig(tmp_path / "figure.png")
    assert html.count("<tr>") >= 2
    assert html.count("<table>") == html.count("</table>") == 1
    first = str(frame.index[0])
    assert first in text or kind == "task-error"
    result.write(tmp_path / "result.json")
    written = json.loads((tmp_path / "result.json").read_text())
    assert (written["schema"], written["command"]) == ("fpcal/1", kind)
    assert written["trust"]["usable"] is True
    with pytest.raises(InputError, match=r"expected a file name that ends in \.json"):
        result.write(tmp_path / "result.txt")


def test_what_results_hold_is_shown_in_short(results):
    left, seen, long = list(results.values()), set(), []
    while left:
        one = left.pop()
        if not is_dataclass(one) or id(one) in seen:
            continue
        seen.add(id(one))
        if len(repr(one)) > 2000:
            long.append(type(one).__name__)
        values = [getattr(one, each.name) for each in fields(one)]
        left += [*values, *(value[0] for value in values if isinstance(value, tuple | list) and value)]
    assert len(seen) > 30
    assert long == []


def test_numbers_of_the_frame_are_those_of_the_estimate(results, femto, tmp_path):
    found = results["identify"]
    frame = found.to_dataframe()
    one = found.estimate["beta_et"]
    assert (
        frame.loc["beta_et", "value"]
        == one["value"]
        == pytest.approx(np.rad2deg(found.estimate.block(["beta_et"])[0][0]))
    )
    assert frame.loc["beta_et", "sd"] == one["sd"]
    assert (one["unit"], one["status"]) == ("deg", "identified")
    found.write(tmp_path / "estimate.json")
    again = read_estimate(str(tmp_path / "estimate.json"), femto)
    np.testing.assert_allclose(again.values, found.estimate.values, rtol=1e-12, atol=1e-15)
    with pytest.raises(InputError, match="alpha_99"):
        found.estimate["alpha_99"]


def test_a_posterior_is_what_arviz_knows(results, tmp_path):
    tree = results["sample"].to_arviz()
    assert isinstance(tree, DataTree)
    assert {"posterior", "prior", "log_likelihood", "posterior_predictive"} <= set(tree.children)
    results["sample"].write(tmp_path / "posterior.nc")
    assert Path(tmp_path / "posterior.nc").stat().st_size > 10_000


def test_what_is_not_to_be_used_says_so(results):
    estimate = results["identify"].estimate
    doubted = replace(estimate, trust=estimate.trust.because(Reason("not-converged", "no minimum was found")))
    assert "not to be used: no minimum was found" in doubted.summary()
