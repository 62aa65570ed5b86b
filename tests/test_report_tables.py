import io
import re
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_csv
from fpcal_bayes.measure.protocol import mark_signs
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.report.fit import fit_lines, parameter_table
from fpcal_bayes.report.pages import ENVIRONMENT
from fpcal_bayes.report.table import Table, TableCell, figure_of, number, plain_table
from fpcal_bayes.report.week import truth_table

CELL = load_cell(mechanics="none")


@pytest.fixture(scope="module")
def result() -> Identification:
    return identify(CELL, read_csv(Path(__file__).parent / "data" / "case_a.csv", CELL))


def printed(table: Table, **options: object) -> str:
    text = io.StringIO()
    Console(file=text, width=200, highlight=False, **options).print(table)  # type: ignore[arg-type]
    return text.getvalue()


def rows(text: str) -> dict[str, list[str]]:
    """Fields of each row by its first field."""
    return {line.split()[0]: line.split() for line in text.splitlines() if line.split()}


@pytest.mark.parametrize(
    ("value", "sd", "expected"),
    [
        (-90.14964, 0.136, "-90.15"),
        (0.252880, 0.00764, "0.2529"),
        (917.55, 199.97, "918"),
        (10.97, 6.4, "11.0"),
        (1.23456789, 1.0, "1.2"),
        (1.23456789, 0.99, "1.23"),
        (123456.7, 12000.0, "123457"),
        # At most six decimals.
        (1.23456789, 1e-9, "1.234568"),
        (0.5, 0.0123, "0.500"),
        # No minus before a zero.
        (-0.001, 1.0, "0.0"),
        (-0.4, 20.0, "0"),
        (0.0, 1.0, "0.0"),
        # Without an sd, six digits.
        (-90.14964512, 0.0, "-90.1496"),
        (1.5, float("nan"), "1.5"),
        (1.5, float("inf"), "1.5"),
    ],
)
def test_number(value, sd, expected):
    assert number(value, sd) == expected


def test_parameter_table(result):
    found = rows(printed(parameter_table(result.estimate, "a title")))
    assert found["a"] == ["a", "title"]
    shown = result.estimate.shown()
    for parameter, status in zip(CELL.free, result.estimate.status, strict=True):
        name, unit, value, sd, prior, told = found[parameter.name]
        assert unit == parameter.unit
        assert float(value) == pytest.approx(shown[name]["value"], abs=0.05 * shown[name]["sd"])
        assert float(sd) == pytest.approx(shown[name]["sd"], rel=0.05)
        assert float(prior) == pytest.approx(parameter.shown(parameter.prior_sd))
        assert told == status
    assert {"identified", "gauge"} == set(result.estimate.status)


def test_every_status_is_shown_and_exact_values_are_called_so(result):
    statuses = ("identified", "weak", "gauge", "fixed")
    estimate = replace(result.estimate, status=(statuses * 6)[:21])
    covariance = estimate.covariance.copy()
    covariance[3] = covariance[:, 3] = 0.0
    found = rows(printed(parameter_table(replace(estimate, covariance=covariance), "")))
    for i, name in enumerate(CELL.free.names):
        assert found[name][-1] == statuses[i % 4]
        assert (found[name][3] == "exact") == (i == 3)
    truth = paper_truth(CELL).at(0.0)
    exact = replace(estimate, covariance=covariance)
    row = rows(printed(truth_table(exact, truth[3:4], CELL.free.names[3:4], "")))[CELL.free.names[3]]
    assert row[4:] == ["exact", "fixed"]


def test_colours_only_on_a_terminal(result):
    table = parameter_table(result.estimate, "")
    assert "\x1b" not in printed(table)
    assert "\x1b[31mgauge" in printed(table, force_terminal=True, color_system="standard", no_color=False)


def test_truth_table(result):
    truth = paper_truth(CELL).at(0.0)
    names = ["z_et", "alpha_2"]
    chosen = truth[paper_truth(CELL).parameters.positions(names)]
    found = rows(printed(truth_table(result.estimate, chosen, names, "")))
    assert [name for name in found if name in CELL.free.names] == names
    assert found["z_et"][:3] == ["z_et", "um", "1.61"]
    assert found["alpha_2"][:3] == ["alpha_2", "deg", "-90.13"]
    entry = result.estimate.shown()["z_et"]
    assert float(found["z_et"][5]) == pytest.approx((entry["value"] - 1.61) / entry["sd"], abs=0.051)
    assert found["z_et"][5][0] in "+-"


@pytest.mark.parametrize("title", ["[red]a[/red]", "[/]", "week[1].csv", "back\\", "[link=x]"])
def test_markup_in_a_title_is_text(title):
    text = printed(plain_table(title, ["a" * 40, "b", "c"]), force_terminal=True, color_system="standard")
    assert title in re.sub(r"\x1b\[[0-9;]*m", "", text)


def test_columns():
    table = plain_table("a title that is wider than its table and stands in one line", ["aaa", "bbb", "ccc", "ddd"])
    table.add_row("1", "2", "3", "4")
    title, _, head, _, row, *_ = str(table).splitlines()
    assert title.rstrip() == table.title
    assert [row.index(n) for n in "12"] == [head.index(name) for name in ("aaa", "bbb")]
    assert [row.index(n) for n in "34"] == [head.index(name) + 2 for name in ("ccc", "ddd")]


def test_one_content_in_a_terminal_and_on_a_page():
    table = plain_table("a [title]", ["name", "size [nm]", "error [nm]", "status"], words=[0])
    table.add_row("<one>", figure_of(1234.5), "2", TableCell("good", style="good"))
    table.add_row("sum [nm]", "", "", "")
    lines = [line.split() for line in str(table).splitlines() if line.strip()]
    assert lines[:2] == [["a", "[title]"], ["name", "size", "nm", "error", "nm", "status"]]
    assert lines[3] == ["<one>", "1.23e+03", "2", "good"]
    assert lines[4] == ["sum", "[nm]"]
    page = ENVIRONMENT.get_template("macros.html").module.table(table)
    assert "<caption><span>a [title]</span></caption>" in page
    assert '<th scope="col" class="text">name</th><th scope="col">size [nm]</th>' in page
    assert '<td class="text">&lt;one&gt;</td><td class="" data-sort="1234.5">1.23e+03</td>' in page
    assert '<td class=" good">good</td>' in page


def test_fit_lines(result):
    lines = fit_lines(result)
    assert lines[0] == (
        "fit: converged, sum of squares 67.36 over 69 rows and the prior; "
        "chi-square of the data 62.8, expected 53.6 (p = 0.18)"
    )
    assert lines[1] == "rank: 16 of 21 combinations of the free parameters are seen by the data"
    assert lines[2].startswith("along the others the estimate is the prior: theta_3, d_4, ")
    assert lines[3].startswith("largest residuals: node5-rz +3.25 sd, ")
    assert lines[4:] == [f"time: {1e3 * result.seconds:.0f} ms"]
    assert fit_lines(result, timed=False) == lines[:4]


def test_fit_lines_of_unsigned_sweeps_and_of_a_failure(result):
    unsigned = identify(CELL, mark_signs(result.problem.sweeps, "paper"))
    assert fit_lines(unsigned)[4] == "signs: 53 decided with the fit, 0 of them doubtful"
    failed = replace(result, solution=replace(result.solution, converged=False))
    assert fit_lines(failed)[0].startswith("fit: NOT CONVERGED, ")
