"""Data files from a checkout and from an installed wheel."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import fpcal_bayes
from fpcal_bayes.core.resources import built_in_cells, data_file
from fpcal_bayes.io.cell import load_cell

REPOSITORY = Path(__file__).parent.parent


def test_every_built_in_cell_is_there_and_loads() -> None:
    assert built_in_cells()
    for name in built_in_cells():
        assert data_file(f"{name}.toml").is_file()
        assert load_cell(name, mechanics="none").name == name


def test_every_cell_of_the_data_folder_is_known() -> None:
    texts = {path: path.read_text() for path in (REPOSITORY / "data").glob("*.toml")}
    cells = {path.stem for path, text in texts.items() if 'schema = "fpcal-cell/' in text}
    assert cells == set(built_in_cells())


@pytest.mark.slow
def test_installed_wheel_brings_the_built_in_cell(tmp_path: Path) -> None:
    """The wheel is unpacked far from the checkout, and a fresh process imports it from there."""
    built = subprocess.run(
        [sys.executable, "-c", f"from hatchling.build import build_wheel; print(build_wheel({str(tmp_path)!r}))"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    wheel = tmp_path / built.stdout.split()[-1]
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(site)
    assert f"fpcal_bayes-{fpcal_bayes.__version__}.dist-info/METADATA" in names
    # Nothing but the package: no tests, no stray top-level folder.
    assert {name.partition("/")[0] for name in names} == {
        "fpcal_bayes",
        f"fpcal_bayes-{fpcal_bayes.__version__}.dist-info",
    }
    program = (
        f"import sys; sys.path.insert(0, {str(site)!r})\n"
        "import fpcal_bayes\n"
        "from fpcal_bayes.io.cell import load_cell\n"
        "from fpcal_bayes.core.resources import data_file\n"
        "print(fpcal_bayes.__file__, data_file('femto-st.toml'), load_cell().sha256, sep='\\n')\n"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert Path(loaded[0]).parent == site / "fpcal_bayes"
    assert Path(loaded[1]).parent == site / "fpcal_bayes" / "data"
    assert loaded[2] == load_cell(mechanics="none").sha256
