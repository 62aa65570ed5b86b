"""The text of an observability analysis."""

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from fpcal_bayes.infer.observability.observe import Observability, observe
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.report import observe as words
from fpcal_bayes.report.observe import print_observability

CELL = load_cell(mechanics="none")


@pytest.fixture(scope="module")
def plan() -> Observability:
    return observe(CELL, paper_protocol(CELL))


@pytest.fixture(scope="module")
def found() -> Observability:
    protocol, model = paper_protocol(CELL), CavityModel.of(CELL)
    exact = model.predict(paper_truth(CELL).at(0.0), model.rows(protocol.q_start, protocol.q_end))
    noise = 0.005 * np.random.default_rng(0).standard_normal(69)
    return observe(CELL, protocol.with_measurement(exact + noise, 0.005))


def text_of(result: Observability, title: str = "file.csv", **console: object) -> str:
    out = StringIO()
    print_observability(result, title, Console(file=out, width=120, highlight=False, **console))
    return out.getvalue()


def test_a_plan_in_words(plan):
    text = text_of(plan, "plan.csv, session a")
    assert text.startswith("plan.csv, session a\n16 of 21 combinations are seen; a clear gap of 10^12")
    assert f"condition number of the seen ones {plan.indices.condition:.3g}" in text
    assert "expected sd" in text
    assert "value" not in text.split("Directions")[0].split("contraction")[0]
    assert "An offset of the last joint (theta_6) turns the direction of the mirror's tilt" in text
    assert "theta_3 and theta_4 turn about one axis; only their sum shows" in text
    assert "Remedy: the absolute cavity length of one pose (a wavelength scan) shows it." in text
    for base in plan.base:
        assert f"- {base}\n" in text


def test_a_measurement_in_words(found):
    text = text_of(found)
    row = next(line for line in text.splitlines() if line.strip().startswith("theta_wf "))
    i = CELL.free.position("theta_wf")
    value, sd = np.degrees(found.values[i]), np.degrees(np.sqrt(found.covariance[i, i]) * CELL.free.prior_sd[i])
    assert row.split()[:5] == ["theta_wf", "deg", "identified", f"{value:.4f}", f"{sd:.4f}"]
    rows = [line.split() for line in text.splitlines() if line.split()[:2] == ["y_wf", "um"]]
    assert rows[-1][2:] == ["unbounded", "200", "unbounded", "200"]


def test_redundant_sweeps_are_named_up_to_ten(plan):
    redundant = plan.information.redundant
    assert len(redundant) > 10
    text = text_of(plan)
    assert f"{', '.join(redundant[:10])} and {len(redundant) - 10} more." in text
    assert f"{len(redundant)} sweeps could be left out, each alone" in text


def test_every_table_has_every_row(plan):
    assert [row[0].text for row in words.parameter_table(plan).rows] == list(CELL.free.names)
    assert [row[0].text for row in words.block_table(plan).rows] == [block.name for block in plan.blocks]
    assert all(len(row) == len(words.bounds_table(plan).columns) for row in words.bounds_table(plan).rows)
    bits = [float(row[1].text) for row in words.sweep_table(plan).rows]
    assert bits == sorted(bits, reverse=True)
    assert bits[0] == pytest.approx(plan.information.bits.max(), abs=0.005)


def test_markup_of_users_is_text(plan):
    odd = "[red]x[/red] [/] <script>"
    information = replace(plan.information, labels=tuple(f"{odd}{i}" for i in range(69)))
    text = text_of(replace(plan, information=information, candidates=((odd, 1.0),)), f"{odd}.csv")
    assert text.startswith(f"{odd}.csv\n")
    assert f"{odd} (+1.00 bits)" in text
    best = int(plan.information.bits.argmax())
    assert f"{odd}{best}" in text


def test_a_quiet_console_prints_nothing(plan):
    assert text_of(plan, quiet=True) == ""


def test_all_seen_and_no_clear_gap_are_said(plan):
    full = replace(plan.spectrum, rank=21, gap=np.inf)
    assert words.headline(replace(plan, spectrum=full))[0].startswith("All 21 combinations are seen;")
    vague = replace(plan.spectrum, gap=12.0)
    assert "NO clear gap of 10^1" in words.headline(replace(plan, spectrum=vague))[0]
    assert "The rank differs between the draws: 15 to 16." in words.headline(replace(plan, ranks=(15, 16)))[2]


def test_percentages():
    assert [words.percent(x) for x in (0.5, 0.9996, -1e-17, 0.9994)] == ["50.0 %", "> 99.9 %", "0.0 %", "99.9 %"]
