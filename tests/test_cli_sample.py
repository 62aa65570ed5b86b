import json
from pathlib import Path

import arviz as az
import pytest
from test_cli import error_lines, refused

from fpcal_bayes.cli import sample as sample_module
from fpcal_bayes.cli.main import main
from fpcal_bayes.infer.fit import minimise as least_squares

CASE_A = Path(__file__).parent / "data" / "case_a.csv"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    """Every test starts in its own empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return tmp_path


def run(*arguments: object, code: int = 0) -> None:
    assert main(["sample", str(CASE_A), *map(str, arguments)]) == code


def draws_of(name: str) -> dict[str, bytes]:
    with az.from_netcdf(name) as tree:
        groups = ((group, tree[group].data_vars) for group in ("posterior", "sample_stats"))
        return {f"{group}/{key}": value.values.tobytes() for group, every in groups for key, value in every.items()}


@pytest.fixture
def limited(monkeypatch) -> None:
    """A sampler that may take few steps only, and does not converge."""
    unlimited = sample_module.sample

    def limited(*arguments, **options):
        return unlimited(*arguments, **options, max_steps=20)

    monkeypatch.setattr(sample_module, "sample", limited)


class TestOutput:
    def test_files_and_table(self, capsys, here):
        run("-o", "p.nc", "--draws", 300, "--json", "p.json")
        out, err = capsys.readouterr()
        assert {path.name for path in here.iterdir()} == {"p.nc", "p.json"}
        written = json.loads(Path("p.json").read_text())
        assert (written["schema"], written["command"]) == ("fpcal/1", "sample")
        assert written["data"]["file"] == "case_a.csv"
        for name, entry in written["parameters"].items():
            assert name in out
            assert entry["ess_bulk"] >= 300
            assert entry["ess_tail"] >= 300
        assert "sampler: " in out
        assert all(line.startswith("fpcal: warning: ") for line in error_lines(err))
        with az.from_netcdf("p.nc") as tree:
            assert tree["posterior"]["z_et"].values.mean() == pytest.approx(written["parameters"]["z_et"]["mean"])
            assert tree.attrs["data_sha256"] == written["data"]["sha256"]

    @pytest.mark.usefixtures("limited")
    def test_seed_and_quiet(self, capsys):
        for name, seed in (("a", 3), ("b", 3), ("c", 4)):
            run("-o", f"{name}.nc", "--draws", 50, "--seed", seed, "--quiet", code=1)
        assert capsys.readouterr().out == ""
        assert draws_of("a.nc") == draws_of("b.nc")
        assert draws_of("a.nc") != draws_of("c.nc")


class TestNotConverged:
    @pytest.mark.usefixtures("limited")
    def test_says_so(self, capsys):
        run("-o", "p.nc", "--draws", 100_000, "--json", "p.json", code=1)
        lines = error_lines(capsys.readouterr().err)
        assert any("not converged: " in line and "expected 100000" in line for line in lines)
        sampler = json.loads(Path("p.json").read_text())["sampler"]
        assert sampler["converged"] is False
        assert sampler["failures"]
        with az.from_netcdf("p.nc") as tree:
            assert tree.attrs["converged"] == 0

    def test_without_a_maximum_nothing_is_sampled(self, capsys, monkeypatch, here):
        monkeypatch.setattr(least_squares, "_MAX_EVALUATIONS", 1)
        monkeypatch.setattr(least_squares, "_POLISH_STEPS", 0)
        run("-o", "p.nc", "--draws", 50, code=1)
        assert "its maximum was not found" in capsys.readouterr().err
        assert not list(here.iterdir())


class TestRefused:
    def test_usage(self, capsys):
        assert "required: -o" in refused(capsys, "sample", CASE_A)
        assert "whole number above zero" in refused(capsys, "sample", CASE_A, "-o", "p.nc", "--draws", "0")
        assert "found '1e4'" in refused(capsys, "sample", CASE_A, "-o", "p.nc", "--draws", "1e4")
        assert "whole number from 0" in refused(capsys, "sample", CASE_A, "-o", "p.nc", "--seed", "-1")
        assert "cauchy" in refused(capsys, "sample", CASE_A, "-o", "p.nc", "--likelihood", "cauchy")
        assert "ends in .nc" in refused(capsys, "sample", CASE_A, "-o", "p.h5")

    def test_input(self, capsys):
        assert "missing.csv" in refused(capsys, "sample", "missing.csv", "-o", "p.nc")
        assert "no session 'other'" in refused(capsys, "sample", CASE_A, "-o", "p.nc", "--session", "other")
        text = CASE_A.read_text()
        Path("bad.csv").write_text(text.replace("0.005", "nothing", 1))
        line = refused(capsys, "sample", "bad.csv", "-o", "p.nc")
        assert "row 2" in line
        assert "sigma_um" in line

    def test_outputs_that_cannot_be(self, capsys):
        assert "missing" in refused(capsys, "sample", CASE_A, "-o", "missing/p.nc")
        Path("p.nc").write_text("")
        assert "expected two names" in refused(capsys, "sample", CASE_A, "-o", "p.nc", "--json", "p.nc")

    @pytest.mark.usefixtures("limited")
    def test_blocks_of_another_run(self, capsys, monkeypatch):
        """Resuming with another seed is refused; the blocks of the first run stay for it."""
        monkeypatch.setattr("fpcal_bayes.cli.sample.write_netcdf", _interrupt)
        run("-o", "p.nc", "--draws", 50, "--quiet", code=130)
        capsys.readouterr()
        blocks = list(Path("p.nc.blocks").iterdir())
        assert blocks
        arguments = ["sample", str(CASE_A), "-o", "p.nc", "--draws", "50", "--seed", "1", "--resume"]
        assert main(arguments) == 2
        *_, line = error_lines(capsys.readouterr().err)
        assert line.startswith("fpcal: error: p.nc.blocks: holds draws of other data")
        assert list(Path("p.nc.blocks").iterdir()) == blocks


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
