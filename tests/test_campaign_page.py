"""The report of a campaign: what it says, that it needs nothing else, and that it works in a browser."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from browser import CHROMIUM, browser
from page_reader import Reader

from fpcal_bayes.analysis.campaign import gather
from fpcal_bayes.analysis.history import history, outlooks, residuals
from fpcal_bayes.cli.main import main
from fpcal_bayes.decision.forecast import Goal
from fpcal_bayes.infer.tasks.prediction import predict_from_covariance
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import write_csv
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import join
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.report import observe_figures
from fpcal_bayes.report.campaign import figures
from fpcal_bayes.report.campaign.charts import log_table, outlook_chart
from fpcal_bayes.report.campaign.page import campaign_html
from fpcal_bayes.report.campaign.words import standing, verdict
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
ODD = '<script>alert("&")</script> $x_{$ [red] \u4e2d'


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A calibration and two sessions of fourteen sweeps."""
    full = paper_protocol(CELL, session="day0", time_h=0.0)
    few = [full.take(np.arange(i, 69, 5)) for i in (1, 2)]
    later = [
        replace(part, session=np.full(len(part), name), time_h=np.full(len(part), time_h))
        for part, name, time_h in zip(few, ("day1", "day2"), (24.0, 48.0), strict=True)
    ]
    truth = paper_truth(CELL)
    sweeps = simulate_um(CELL, truth, join([full, *later]), sigma=0.005, seed=2)
    path = tmp_path_factory.mktemp("report") / "campaign.h5"
    write_campaign(path, Campaign.of(sweeps, CELL, command="made", seed=2, truth=truth.record()), CELL)
    return path


@pytest.fixture(scope="module")
def facts(file):
    return gather(file, CELL)


@pytest.fixture(scope="module")
def page(file):
    """The page that the command writes."""
    path = file.parent / "report.html"
    assert main(["report", str(file), "-o", str(path), "--quiet", "--json", str(path.with_suffix(".json"))]) == 0
    return path.read_text()


def test_the_verdict_is_that_of_decide(file, facts, tmp_path):
    assert main(["decide", str(file), "--json", str(tmp_path / "d.json"), "--quiet"]) == 0
    decided = json.loads((tmp_path / "d.json").read_text())["decision"]
    assert facts.decision.action == decided["action"]
    assert facts.decision.hold_hours == pytest.approx(decided["hold_hours"])
    said = verdict(facts)
    assert said.word == {"hold": "Hold", "extrinsic": "Re-identify", "full": "Recalibrate"}[decided["action"]]
    assert decided["sentence"][1:] in said.sentences[0]
    if decided["action"] == "hold":
        due = decided["hold_hours"] < facts.costs.horizon_h
        assert said.style == ("caution" if due else "good")
        assert said.title.startswith("Measure again by" if due else "Hold: nothing to measure within 24 h")
    else:
        assert said.title.startswith(f"{said.word} now: ")


def test_the_error_along_the_beam_is_one_number(facts, page):
    """In the headline, the table of tasks and that of the degrees of freedom."""
    (asked,) = (each for each in facts.tasks if each.asked)
    most = f"{asked.numbers.most:.1f}"
    assert f"at most {most} nm" in page
    table = page.partition("Peak to peak by degree of freedom")[2].partition("</table>")[0]
    along = re.findall(r"<tr>\s*<td[^>]*>([^<]*)</td>\s*<td[^>]*>([^<]*)</td>", table)
    told = [(each.name, f"{each.numbers.most:.1f}") for each in facts.tasks if each.numbers is not None]
    assert along == told
    assert most != f"{1e3 * asked.prediction.peak_to_peak_band()[1]:.1f}"


def test_task_errors_are_those_of_the_tracked_estimate(facts):
    task = facts.tasks[0].task.driven()
    again = predict_from_covariance(facts.track.estimate(), task, draws=20_000, seed=1)
    assert np.median(facts.tasks[0].prediction.peak_to_peak) == pytest.approx(np.median(again.peak_to_peak), rel=0.05)


def test_standing_follows_the_tolerance(file, facts):
    inside = facts.tasks[0].numbers.most <= 1e3 * facts.goal.tolerance_um
    assert standing(facts.tasks[0], facts) == (
        ("within tolerance", "good") if inside else ("probably within", "caution")
    )
    tight = gather(file, CELL, goal=Goal(0.1))
    assert standing(tight.tasks[0], tight) == ("out of tolerance", "bad")
    assert tight.decision.action == "hold"
    assert tight.decision.attainable_nm > 0.1
    assert verdict(tight).word == "Out of reach"
    assert "tolerance 0.1 nm cannot be met" in verdict(tight).sentences[0]


def test_the_error_grows_with_time_and_falls_at_a_session(facts):
    found = outlooks(facts)
    before, after = (found.median[np.flatnonzero(found.hours == 24.0)[i]] for i in (0, 1))
    assert found.median[0] < before
    assert after < before / 2


def test_the_track_holds_the_truth(facts):
    found = history(facts)
    known = np.isfinite(found.truth)
    inside = np.abs(found.mean - found.truth)[known] < 4 * found.sd[known]
    assert inside.mean() > 0.99
    assert (np.diff(found.hours) >= 0).all()


def test_residuals_are_of_unit_size(facts):
    parts = residuals(facts)
    assert [len(part.values) for part in parts] == [69, 14, 14]
    assert 0.5 < np.mean(np.concatenate([part.values for part in parts]) ** 2) < 1.3


def test_the_log_says_what_came_late(facts):
    words = [row[2].text for row in log_table(facts).rows]
    assert words[0].endswith("h late")
    assert words[-1] == "latest"


def test_the_page_needs_nothing_else(page):
    reader = Reader(page)
    assert reader.open == []
    assert not {"iframe", "img", "object", "embed", "base"} & {tag for tag, _ in reader.tags}
    for _, attributes in reader.tags:
        for name, value in attributes.items():
            assert not name.startswith("on")
            if name in ("src", "href", "xlink:href", "action", "data"):
                assert value.startswith(("#", "data:,"))
    assert "@import" not in page
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", page))
    assert len(page) < 5_000_000
    assert [tag for tag, _ in reader.tags].count("figure") == 7
    for text in ("Not sampled", "fpcal sample campaign.h5", "sha256", "Uncertainty budget of circle", "as-modelled"):
        assert text in reader.text


def test_json_says_what_the_page_says(file, page, facts):
    content = json.loads((file.parent / "report.json").read_text())
    assert (content["schema"], content["command"]) == ("fpcal/1", "report")
    assert content["report"]["verdict"] == verdict(facts).word
    assert all(sentence in Reader(page).text for sentence in content["report"]["sentences"])
    assert content["report"]["tasks"]["circle"] == standing(facts.tasks[0], facts)[0]


def test_the_table_and_the_headline_have_one_probability(facts):
    told = facts.tasks[0].numbers
    assert told.exceeds == facts.decision.now.exceeds(facts.goal.tolerance_um)
    assert told.median == pytest.approx(1e3 * facts.decision.now.median)
    assert (told.least, told.most) == pytest.approx([1e3 * edge for edge in facts.decision.now.band()])


def test_everything_users_give_is_escaped(file, tmp_path, monkeypatch):
    # Figures without a text of users stay undrawn here.
    for name in ("spectrum_figure", "contraction_figure", "correlation_figure"):
        monkeypatch.setattr(observe_figures, name, lambda _: "")
    for name in ("task_figure", "drift_figure", "outlook_figure"):
        monkeypatch.setattr(figures, name, lambda *_: "")
    campaign = read_campaign(file, CELL)
    n = len(campaign.sweeps)
    first = campaign.sweeps.session == "day0"
    odd = replace(
        campaign.sweeps,
        label=np.array([f"{ODD}{i}" for i in range(n)]),
        session=np.where(first, ODD, campaign.sweeps.session),
    )
    path = tmp_path / "a<b>&.csv"
    write_csv(path, odd, CELL)
    page = campaign_html(gather(path, CELL, command=ODD))
    reader = Reader(page)
    assert reader.open == []
    assert [tag for tag, _ in reader.tags].count("script") == 2
    assert "<script>alert" not in page
    assert "a<b>&.csv" in reader.text
    assert reader.text.count(ODD) >= 5


def test_the_same_campaign_gives_the_same_numbers(file, facts):
    again = gather(file, CELL)
    assert outlook_chart(again, outlooks(again)) == outlook_chart(facts, outlooks(facts))


def test_a_cell_without_drift_has_no_verdict(file, tmp_path):
    path = tmp_path / "c.csv"
    write_csv(path, read_campaign(file, CELL).sweeps, CELL)
    found = gather(path, replace(CELL, drift=()))
    assert found.track is None
    assert "states no drift" in found.track_reason
    assert verdict(found).word == "No verdict"
    assert history(found) is None
    assert outlooks(found) is None
    assert log_table(found) is None
    assert [len(part.values) for part in residuals(found)] == [69]


def test_a_fit_that_is_wrong_is_of_no_use(tmp_path):
    # Sweeps of the perpendicular path, taken for ones of the axis path.
    other = CELL.with_opd("perpendicular")
    sweeps = simulate_um(other, paper_truth(CELL), paper_protocol(CELL), sigma=0.005, seed=2)
    write_csv(tmp_path / "a.csv", sweeps, CELL)
    found = gather(tmp_path / "a.csv", CELL)
    assert verdict(found).word == "Do not use"
    assert {standing(outlook, found)[0] for outlook in found.tasks} == {"not known"}
    assert "fpcal doctor a.csv" in verdict(found).sentences[-1]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["none.h5", "-o", "r.html"], "none.h5: no such file"),
        (["campaign.h5", "-o", "none/r.html"], "does not exist"),
        (["campaign.h5", "-o", "campaign.h5"], "is an input of this command"),
        (["campaign.h5", "-o", "r.html", "--now", "3"], "lies in the future"),
        (
            ["campaign.h5", "-o", "r.html", "--posterior", "campaign.h5"],
            "campaign.h5: /posterior: the group is missing",
        ),
    ],
)
def test_refusals(file, monkeypatch, capsys, options, expected):
    monkeypatch.chdir(file.parent)
    before = sorted(path.name for path in file.parent.iterdir())
    assert main(["report", *options]) == 2
    err = capsys.readouterr().err
    assert expected in err
    assert err.count("\n") == 1
    assert sorted(path.name for path in file.parent.iterdir()) == before


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_in_a_browser(page, tmp_path):
    path = tmp_path / "r.html"
    path.write_text(page)
    with browser() as shown:
        for width in (1280, 400):
            shown.open(path, width)
            # Nothing is fetched but the page, nothing is logged, and the page is as wide as the window.
            assert shown.requests == [path.as_uri()]
            assert shown.messages == []
            assert shown.run("document.documentElement.scrollWidth <= window.innerWidth")
            edges = shown.run("[...document.querySelectorAll('figure svg')].map(s => s.getBoundingClientRect().right)")
            assert max(edges) <= width
        shown.open(path, 1280)
        sizes = shown.run(
            "[...document.querySelectorAll('figure:not(.drawn) svg:not(.legend)')].map(s => s.clientHeight)"
        )
        assert min(sizes) > 100
        column = "[...document.querySelectorAll('table')[0].rows].slice(1).map(r => Number(r.cells[3].dataset.sort))"
        shown.run("document.querySelectorAll('table')[0].rows[0].cells[3].click()")
        falling = shown.run(f"new Promise(done => setTimeout(() => done({column}), 60))")
        assert falling == sorted(falling, reverse=True)
        assert falling != sorted(falling)
        shown.run("document.querySelectorAll('table')[0].rows[0].cells[3].click()")
        assert shown.run(f"new Promise(done => setTimeout(() => done({column}), 60))") == falling[::-1]
        check_zoom(shown)
        assert shown.messages == []


def check_zoom(shown):
    """Dragging over a chart magnifies it, the button shows the whole range again, and values follow the mouse."""
    shown.run("document.querySelector('#chart-outlook').scrollIntoView()")
    ticks = "document.querySelector('#chart-outlook .u-legend .u-value').textContent"
    area = "document.querySelector('#chart-outlook .u-over').getBoundingClientRect()"
    left, top, width, height = shown.run(f"(r => [r.left, r.top, r.width, r.height])({area})")
    middle = top + height / 2

    def value_at(share: float) -> float:
        x = left + share * width
        shown.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=middle)
        return float(shown.run(f"new Promise(done => setTimeout(() => done({ticks}), 60))"))

    whole = value_at(0.9) - value_at(0.1)
    assert whole > 24
    shown.drag((left + 0.4 * width, middle), (left + 0.6 * width, middle))
    magnified = value_at(0.9) - value_at(0.1)
    assert magnified < 0.4 * whole
    shown.run("document.querySelector('#chart-outlook button').click()")
    assert value_at(0.9) - value_at(0.1) == pytest.approx(whole, rel=0.1)
