"""The studies of the paper's figures and tables: what the documentation says of them is what they find."""

import importlib
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "explanation" / "paper.md").read_text(encoding="utf-8")
SCRIPTS = [*sorted(path.stem for path in (ROOT / "studies").glob("figure_[0-9]*.py")), "tables_2_to_7"]


def test_every_figure_and_table_has_its_script_and_its_line():
    numbers = {number for name in SCRIPTS for number in name.split("_")[1:] if number.isdigit()}
    assert {str(int(number)) for number in numbers} >= {"9", *map(str, range(10, 17))}
    for name in SCRIPTS:
        assert f"`python studies/{name}.py`" in PAGE


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tables_2_to_7"])
def test_the_page_says_what_is_found(name, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "studies"))
    monkeypatch.setattr(sys, "argv", [name, "-o", str(tmp_path)])
    importlib.import_module(name).main()
    (found,) = (json.loads(path.read_text()) for path in tmp_path.glob("*.json"))
    assert found["here"] in PAGE
    assert found["paper"] in PAGE
    assert (tmp_path / found["figure"]).stat().st_size > 10_000
    assert found["here"] in capsys.readouterr().out
