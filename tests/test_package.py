"""The names of the package: complete, lazy, and enough for the whole workflow of the documentation."""

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import fpcal_bayes
from fpcal_bayes.core.notebook import html_table

NOTEBOOK = Path(__file__).parent.parent / "docs" / "how-to" / "notebook.md"


ROOMS = [f"fpcal_bayes.{path.parent.name}" for path in Path(fpcal_bayes.__file__).parent.glob("*/__init__.py")]


def test_every_name_can_be_had_after_every_module_is_loaded():
    """No module hides a name: `fp.track` is a function whatever was imported before."""
    for module in pkgutil.walk_packages(fpcal_bayes.__path__, "fpcal_bayes."):
        if module.name != "fpcal_bayes.__main__":
            importlib.import_module(module.name)
    for place in ("fpcal_bayes", *ROOMS):
        room = importlib.import_module(place)
        for name in getattr(room, "__all__", []):
            assert not inspect.ismodule(getattr(room, name)), f"{place}.{name}"
    assert dir(fpcal_bayes) == sorted(fpcal_bayes.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        fpcal_bayes.nothing  # noqa: B018


def test_nothing_is_loaded_before_it_is_used():
    script = "import sys, fpcal_bayes; print(sorted({'numpy', 'numba', 'matplotlib', 'rich'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_the_workflow_of_the_documentation(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", NOTEBOOK.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(code.splitlines()) < 25
    # Sampling and drawing the page are tested by themselves.
    written = []
    monkeypatch.setattr(fpcal_bayes, "sample", lambda found, **_: found, raising=False)
    monkeypatch.setattr(fpcal_bayes, "write_campaign_report", lambda *args, **_: written.append(args), raising=False)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(code, names)
    assert repr(names["found"]).startswith("Identification(converged, 69 rows, rank 16 of 21")
    assert repr(names["track"]).startswith("Track(1 session of 'femto-st'")
    assert repr(names["error"]).startswith("TaskPrediction(circle, ")
    for shown in ("sweeps", "found", "track"):
        html = names[shown]._repr_html_()
        assert html.count("<table>") == html.count("</table>") == 1
    assert "<td>beta_et</td>" in names["found"]._repr_html_()
    assert written[0][0] == "campaign.h5"


def test_tables_escape_their_texts():
    assert html_table("<b>", ["&"], [["<script>"]]) == (
        "<table><caption>&lt;b&gt;</caption><thead><tr><th>&amp;</th></tr></thead>"
        "<tbody><tr><td>&lt;script&gt;</td></tr></tbody></table>"
    )
