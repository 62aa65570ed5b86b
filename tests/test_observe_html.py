"""The page of an observability analysis: self-contained, escaped, the same every time, light."""

import re
from dataclasses import replace

import numpy as np
import pytest
from page_reader import Reader

from fpcal_bayes.infer.observability.information import Information
from fpcal_bayes.infer.observability.observe import Observability, observe
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.report.observe import observe_html
from fpcal_bayes.report.pages import drawable, packaged

CELL = load_cell(mechanics="none")
ODD = '<script>alert("&")</script> $x_{$ [red] --> \u4e2d'


@pytest.fixture(scope="module")
def found() -> Observability:
    protocol, model = paper_protocol(CELL), CavityModel.of(CELL)
    exact = model.predict(paper_truth(CELL).at(0.0), model.rows(protocol.q_start, protocol.q_end))
    noise = 0.005 * np.random.default_rng(0).standard_normal(69)
    return observe(CELL, protocol.with_measurement(exact + noise, 0.005))


@pytest.fixture(scope="module")
def page(found: Observability) -> str:
    return observe_html(found, "file.csv")


def test_nothing_is_fetched(page):
    reader = Reader(page)
    assert reader.open == []
    names = [tag for tag, _ in reader.tags]
    assert not {"script", "link", "iframe", "img", "image", "object", "embed", "base"} & set(names)
    for _, attributes in reader.tags:
        for name, value in attributes.items():
            assert not name.startswith("on")
            if name in ("src", "href", "xlink:href", "action", "data"):
                assert value.startswith("#")
    assert "@import" not in page
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", page))


def test_four_figures_with_labels(page):
    reader = Reader(page)
    assert [tag for tag, _ in reader.tags].count("svg") == 4
    named = [a["aria-label"] for _, a in reader.tags if a.get("role") == "img"]
    assert len(named) == len(set(named)) == 4
    assert ("meta", {"charset": "utf-8"}) in reader.tags
    assert "16 of 21 combinations are seen" in reader.text
    for name in CELL.free.names:
        assert name in reader.text


def test_everything_users_give_is_escaped(found):
    odd = replace(
        found,
        cell=replace(CELL, name=ODD),
        information=replace(found.information, labels=tuple(f"{ODD}{i}" for i in range(69))),
        candidates=((ODD, 1.0),),
        warnings=(ODD,),
    )
    page = observe_html(odd, f"{ODD}.csv, session {ODD}")
    reader = Reader(page)
    assert reader.open == []
    assert "script" not in [tag for tag, _ in reader.tags]
    assert "<script" not in page
    for text in (f"{ODD}.csv, session {ODD}", f"cell {ODD}", f"{ODD} (+1.00 bits)", f"Warning: {ODD}"):
        assert text in reader.text.replace("\xa0", " ")


def test_the_same_analysis_gives_the_same_bytes(found, page):
    assert observe_html(found, "file.csv") == page
    assert len(page.encode()) < 1_000_000


def test_many_sweeps_stay_light(found):
    n = 27_600
    many = Information(
        labels=tuple(f"row {i}" for i in range(n)),
        leverage=np.full(n, 21 / n),
        bits=np.random.default_rng(0).random(n),
        cumulative_rows=np.arange(0, n + 1, n // 200),
        cumulative_bits=np.linspace(0.0, 150.0, 201),
    )
    page = observe_html(replace(found, information=many), "x")
    assert len(page) < 2_000_000
    assert page.count("<svg") == 4


def test_labels_that_no_font_draws_are_replaced():
    assert drawable("a\u4e2d\nb") == "a??b"
    assert drawable("x" * 30) == "x" * 21 + "..."


def test_the_template_is_part_of_the_package():
    assert "<html" in packaged("templates", "observe.html")
