import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from fpcal_bayes.cli.main import main, make_parser
from fpcal_bayes.core.files import file_sha256
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.core.version import __version__
from fpcal_bayes.infer.fit import minimise as least_squares
from fpcal_bayes.io.cell import load_cell

DATA = Path(__file__).parent / "data"
CASE_A = DATA / "case_a.csv"
COMMANDS = ["simulate", "identify", "week"]
NOTICE = "fpcal: compiling"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    """Every test starts in its own empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return tmp_path


def program(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own, its output piped."""
    paths = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **options.pop("env", {})}
    command = [sys.executable, "-m", "fpcal_bayes", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=300, check=False, stdin=subprocess.DEVNULL
    )


def error_lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if not line.startswith(NOTICE)]


def refused(capsys, *arguments: str) -> str:
    """The one line with which the program refuses `arguments`."""
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    assert main(list(map(str, arguments))) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = error_lines(err)
    assert line.startswith("fpcal: error: ")
    assert "Traceback" not in err
    # Nothing is made and nothing is changed.
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before
    return line


class TestUsage:
    def test_the_commands(self):
        (subparsers,) = (a for a in make_parser()._actions if a.choices and a.dest == "command")
        assert set(COMMANDS) <= set(subparsers.choices)

    @pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
    def test_help(self, capsys, command):
        with pytest.raises(SystemExit) as caught:
            main([*command, "--help"])
        assert caught.value.code == 0
        out, err = capsys.readouterr()
        assert err == ""
        assert out.startswith("usage: fpcal " + " ".join(command))
        if command:
            for option in ("--cell", "--opd", "--quiet"):
                assert option in out
        else:
            assert all(name in out for name in COMMANDS)
            assert "Exit status: 0 done; 1" in out

    def test_version(self, capsys):
        with pytest.raises(SystemExit) as caught:
            main(["--version"])
        assert caught.value.code == 0
        assert capsys.readouterr().out == f"fpcal {__version__}\n"

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ([], "the following arguments are required: COMMAND (see fpcal --help)"),
            (["frobnicate"], "invalid choice: 'frobnicate'"),
            (["identify"], "the following arguments are required: FILE (see fpcal identify --help)"),
            (["identify", CASE_A, "--frobnicate"], "unrecognized arguments: --frobnicate"),
            (["identify", CASE_A, "--fre", "all"], "unrecognized arguments: --fre all"),
            (["identify", CASE_A, "--opd", "sideways"], "argument --opd: invalid choice: 'sideways'"),
            (["identify", CASE_A, "--hold", "tight"], "argument --hold: invalid choice: 'tight'"),
            (["identify", CASE_A, CASE_A], "unrecognized arguments"),
            (["simulate"], "the following arguments are required: -o"),
            (
                ["simulate", "-o", "a.csv", "--seed", "-1"],
                "argument --seed: expected a whole number from 0, found '-1'",
            ),
            (
                ["simulate", "-o", "a.csv", "--seed", "1.5"],
                "argument --seed: expected a whole number from 0, found '1.5'",
            ),
            (
                ["simulate", "-o", "a.csv", "--sigma-nm", "0"],
                "argument --sigma-nm: expected a number above zero, found '0'",
            ),
            (["simulate", "-o", "a.csv", "--sigma-nm", "nan"], "--sigma-nm: expected a number above zero, found 'nan'"),
            (
                ["simulate", "-o", "a.csv", "--sigma-nm", "inf"],
                "--sigma-nm: expected a number above zero, 1e-9 to 1e9, found 'inf'",
            ),
            (["simulate", "-o", "a.csv", "--signs", "some"], "argument --signs: invalid choice: 'some'"),
            (["week", "--seed", "x"], "argument --seed: expected a whole number from 0, found 'x'"),
        ],
    )
    def test_bad_usage(self, capsys, arguments, message):
        assert message in refused(capsys, *arguments)


class TestSimulate:
    def test_csv(self, capsys):
        assert main(["simulate", "-o", "a.csv", "--seed", "3"]) == 0
        out, err = capsys.readouterr()
        assert error_lines(err) == []
        assert out == "69 rows simulated on cell 'femto-st', sd 5 nm -> a.csv\n"
        text = Path("a.csv").read_text()
        header = CASE_A.read_text().partition("\n")[0]
        assert text.startswith(header + "\n")
        assert len(text.splitlines()) == 70

    @pytest.mark.parametrize("name", ["a.csv", "a.h5"])
    def test_same_seed_same_bytes(self, name):
        contents = []
        for seed in ("1", "1", "2"):
            assert main(["simulate", "-o", name, "--seed", seed, "--quiet"]) == 0
            contents.append(Path(name).read_bytes())
        assert contents[0] == contents[1] != contents[2]

    def test_signs_protocol_sigma_and_opd(self, capsys):
        assert main(["simulate", "-o", "a.csv", "--signs", "paper", "--protocol", "paper-mid", "--sigma-nm", "2"]) == 0
        assert capsys.readouterr().out == (
            "138 rows simulated on cell 'femto-st', sd 2 nm, the direction of 106 unknown -> a.csv\n"
        )
        rows = [line.split(",") for line in Path("a.csv").read_text().splitlines()[1:]]
        assert {row[16] for row in rows} == {"0.002"}
        assert sum(row[17] == "0" for row in rows) == 106
        main(["simulate", "-o", "b.csv", "--quiet"])
        main(["simulate", "-o", "c.csv", "--quiet", "--opd", "perpendicular"])
        assert Path("b.csv").read_bytes() != Path("c.csv").read_bytes()

    def test_truth_and_a_plan_of_ones_own(self, capsys):
        Path("truth.toml").write_text("[parameters]\nalpha_2 = -91.0\n")
        assert main(["simulate", "-o", "a.csv", "--truth", "truth.toml", "--protocol", str(CASE_A), "--quiet"]) == 0
        own = Path("a.csv").read_text().splitlines()
        assert [line.split(",")[:15] for line in own[:3]] == [
            line.replace(".0,", ",").split(",")[:15] for line in CASE_A.read_text().splitlines()[:3]
        ]
        assert main(["simulate", "-o", "b.csv", "--protocol", str(CASE_A), "--quiet"]) == 0
        assert Path("a.csv").read_bytes() != Path("b.csv").read_bytes()

    def test_campaign_says_how_it_was_made(self):
        assert main(["simulate", "-o", "a.h5", "--seed", "4", "--quiet"]) == 0
        with h5py.File("a.h5") as file:
            assert file.attrs["command"].decode() == "fpcal simulate --protocol paper --sigma-nm 5 --seed 4"
            assert file.attrs["seed"] == 4
            assert file["sweeps"]["dl_um"].shape == (69,)

    def test_the_plan_is_not_overwritten(self, capsys):
        Path("plan.csv").write_bytes(CASE_A.read_bytes())
        message = refused(capsys, "simulate", "-o", "plan.csv", "--protocol", "plan.csv")
        assert "plan.csv: is an input of this command" in message

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["-o", "a.txt"], "a.txt: expected a file name that ends in .csv"),
            (["-o", "none/a.csv"], "none/a.csv: the folder none does not exist"),
            (["-o", "."], ".: is a folder, expected the name of a file to write"),
            (["-o", "a.csv", "--protocol", "none.csv"], "none.csv: no such file"),
            (["-o", "a.csv", "--truth", "none.toml"], "none.toml: no such file"),
            (["-o", "a.csv", "--cell", "none.toml"], "none.toml: no such file; built-in cells: femto-st"),
        ],
    )
    def test_bad_input(self, capsys, arguments, message):
        assert message in refused(capsys, "simulate", *arguments)


class TestIdentify:
    def run(self, *arguments: str, status: int = 0) -> dict[str, Any]:
        assert main(["identify", *map(str, arguments), "--json", "out.json"]) == status
        return json.loads(Path("out.json").read_text())

    def test_json_contract(self):
        content = self.run(CASE_A)
        assert list(content)[:2] == ["schema", "command"]
        assert set(content) == {
            "schema", "command", "parameters", "covariance", "cell", "data", "time_h", "valid_until_h", "fit",
            "residuals", "doubtful_signs", "rows", "warnings", "draws", "trust", "mechanics", "content_sha256",
        }  # fmt: skip
        assert content["schema"] == "fpcal/1"
        assert content["command"] == "identify"
        cell = load_cell(mechanics="none")
        assert list(content["parameters"]) == list(cell.free.names)
        for name, entry in content["parameters"].items():
            assert set(entry) == {"value", "sd", "unit", "prior_sd", "status"}
            assert entry["unit"] == cell.free[name].unit
            assert entry["status"] in ("identified", "weak", "gauge")
        names, matrix = content["covariance"]["names"], np.array(content["covariance"]["matrix"])
        assert names == list(cell.free.names)
        sds = [content["parameters"][name]["sd"] for name in names]
        np.testing.assert_allclose(np.sqrt(np.diag(matrix)), sds, rtol=1e-12)
        np.testing.assert_array_equal(matrix, matrix.T)
        fit = content["fit"]
        assert {"sum_of_squares", "chi2_data", "n_sweeps", "rank", "converged", "seconds"} <= set(fit)
        assert fit["n_sweeps"] == 69
        assert fit["rank"] == 16
        assert fit["converged"] is True
        assert fit["seconds"] > 0
        assert content["cell"] == {"name": "femto-st", "sha256": cell.sha256, "opd": "axis"}
        assert content["data"] == {"file": "case_a.csv", "sha256": file_sha256(CASE_A), "session": "full-T0"}
        assert content["time_h"] == 0.0
        assert content["valid_until_h"] is None
        assert content["doubtful_signs"] == []
        assert len(content["warnings"]) == 1

    def test_estimates_are_those_of_the_reference(self):
        expected = json.loads((DATA / "case_a.json").read_text())["map"]
        found = self.run(CASE_A)["parameters"]
        for name, sd in expected["laplace_sd"].items():
            assert found[name]["value"] == pytest.approx(expected["estimate"][name], abs=1e-3 * sd)
            assert found[name]["sd"] == pytest.approx(sd, rel=1e-3)

    def test_readable_summary_and_warnings(self, capsys):
        assert main(["identify", str(CASE_A)]) == 0
        out, err = capsys.readouterr()
        for name in load_cell(mechanics="none").free.names:
            assert re.search(rf"^ ?{name} ", out, re.MULTILINE), name
        assert "fit: converged, sum of squares 67.36 over 69 rows" in out
        assert "rank: 16 of 21" in out
        assert "along the others the estimate is the prior: theta_3, d_4" in out
        lines = error_lines(err)
        assert len(lines) == 1
        assert lines[0].startswith("fpcal: warning: with q6, or q3 and q5, or q1 and q4 counted the other way")
        assert "\x1b" not in out + err

    def test_quiet(self, capsys):
        assert main(["identify", str(CASE_A), "--quiet"]) == 0
        out, err = capsys.readouterr()
        assert out == ""
        assert all(line.startswith("fpcal: warning: ") for line in error_lines(err))

    def test_same_bytes_but_for_the_time(self):
        contents = [self.run(CASE_A) for _ in range(2)]
        seconds = [content["fit"].pop("seconds") for content in contents]
        assert all(s > 0 for s in seconds)
        # The hash of the content covers the time too.
        assert all(len(content.pop("content_sha256")) == 64 for content in contents)
        assert json.dumps(contents[0]) == json.dumps(contents[1])

    def test_input_is_not_modified(self):
        data = Path("a.csv")
        data.write_bytes(CASE_A.read_bytes())
        stamp = data.stat().st_mtime_ns
        self.run("a.csv")
        assert data.read_bytes() == CASE_A.read_bytes()
        assert data.stat().st_mtime_ns == stamp
        assert sorted(path.name for path in Path().iterdir()) == ["a.csv", "out.json"]

    def test_csv_and_campaign_give_the_same(self):
        for name in ("a.csv", "a.h5"):
            assert main(["simulate", "-o", name, "--seed", "5", "--quiet"]) == 0
        from_csv, from_h5 = self.run("a.csv"), self.run("a.h5")
        for name, entry in from_csv["parameters"].items():
            assert from_h5["parameters"][name]["value"] == pytest.approx(entry["value"], abs=1e-3 * entry["sd"])
        assert from_h5["data"]["file"] == "a.h5"

    def test_held_at_an_earlier_estimate(self):
        self.run(CASE_A)
        Path("out.json").rename("start.json")
        content = self.run(CASE_A, "--free", "extrinsic", "--start", "start.json")
        start = json.loads(Path("start.json").read_text())
        intrinsic = load_cell(mechanics="none").select("intrinsic").names
        assert {name for name, e in content["parameters"].items() if e["status"] == "fixed"} == set(intrinsic)
        for name in intrinsic:
            assert content["parameters"][name]["value"] == pytest.approx(start["parameters"][name]["value"], rel=1e-12)
            assert content["parameters"][name]["sd"] == pytest.approx(start["parameters"][name]["sd"], rel=1e-6)
        assert content["covariance"]["names"] == list(load_cell(mechanics="none").free.names)
        exact = self.run(CASE_A, "--free", "extrinsic", "--start", "start.json", "--hold", "exact")
        assert exact["covariance"]["names"] == list(load_cell(mechanics="none").select("extrinsic").names)
        assert exact["parameters"]["z_et"]["sd"] < content["parameters"]["z_et"]["sd"]
        assert exact["parameters"]["alpha_2"] == content["parameters"]["alpha_2"] | {"sd": 0.0}

    def test_free_takes_groups_and_names(self):
        content = self.run(CASE_A, "--free", "all,gain_4")
        assert content["parameters"]["gain_4"]["unit"] == "ppm"
        assert len(content["parameters"]) == 22
        assert self.run(CASE_A, "--free", "alpha_2,z_et", "--hold", "exact")["covariance"]["names"] == [
            "alpha_2",
            "z_et",
        ]

    def test_unknown_signs(self, capsys):
        assert main(["simulate", "-o", "a.csv", "--signs", "paper", "--quiet"]) == 0
        content = self.run("a.csv")
        assert content["fit"]["converged"] is True
        assert "signs: 53 decided with the fit" in capsys.readouterr().out

    def test_the_other_path_model_is_a_poor_fit_and_said(self, capsys):
        assert main(["simulate", "-o", "a.csv", "--opd", "perpendicular", "--quiet"]) == 0
        fitting = self.run("a.csv", "--opd", "perpendicular")
        assert fitting["cell"]["opd"] == "perpendicular"
        assert not any(w.startswith("poor fit") for w in fitting["warnings"])
        capsys.readouterr()
        content = self.run("a.csv")
        assert content["cell"]["opd"] == "axis"
        (poor,) = (w for w in content["warnings"] if w.startswith("poor fit"))
        assert f"fpcal: warning: {poor}" in capsys.readouterr().err.splitlines()

    def test_what_does_not_converge_is_said_and_exits_with_1(self, capsys, monkeypatch):
        monkeypatch.setattr(least_squares, "_MAX_EVALUATIONS", 2)
        monkeypatch.setattr(least_squares, "_POLISH_STEPS", 0)
        content = self.run(CASE_A, status=1)
        assert content["fit"]["converged"] is False
        out, err = capsys.readouterr()
        assert "fit: NOT CONVERGED" in out
        assert "fpcal: warning: the fit did not converge" in err
        monkeypatch.undo()
        # Nobody builds on such an estimate by accident.
        assert main(["identify", str(CASE_A), "--start", "out.json"]) == 2


def edit(line: int, column: str, value: str) -> Any:
    """Case A with one field changed; line 1 is the header."""

    def make() -> str:
        rows = [row.split(",") for row in CASE_A.read_text().splitlines()]
        rows[line - 1][rows[0].index(column)] = value
        return "\n".join(map(",".join, rows)) + "\n"

    return make


def without(column: str) -> Any:
    def make() -> str:
        rows = [row.split(",") for row in CASE_A.read_text().splitlines()]
        at = rows[0].index(column)
        return "\n".join(",".join(row[:at] + row[at + 1 :]) for row in rows) + "\n"

    return make


def still() -> str:
    rows = [row.split(",") for row in CASE_A.read_text().splitlines()]
    rows[4][9:15] = rows[4][3:9]
    return "\n".join(map(",".join, rows)) + "\n"


BAD_SWEEPS = {
    "empty": (lambda: "", "bad.csv: the file is empty"),
    "header alone": (
        lambda: CASE_A.read_text().splitlines()[0] + "\n",
        "bad.csv: no rows, expected at least one sweep",
    ),
    "wrong header": (edit(1, "q3_start_um", "q3"), "row 1: unknown column 'q3', expected session,time_h,label"),
    "duplicated header": (edit(1, "sigma_um", "dl_um"), "row 1: the column 'dl_um' stands twice"),
    "missing column": (without("sigma_um"), "row 1: the column sigma_um is missing"),
    "missing joint": (without("q6_end_deg"), "row 1: the column q6_end_deg is missing: cell 'femto-st' has 6 joints"),
    "seventh joint": (
        edit(1, "signed", "q7_end_deg"),
        "row 1: column q7_end_deg does not fit: cell 'femto-st' has 6 joints",
    ),
    "text in a number": (edit(5, "dl_um", "abc"), "row 5, column dl_um: expected a number, found 'abc'"),
    "NaN": (edit(6, "dl_um", "nan"), "row 6, column dl_um: expected a number, found 'nan'"),
    "inf": (edit(7, "q1_end_um", "inf"), "row 7, column q1_end_um: expected a number, found 'inf'"),
    "1e999": (edit(7, "q1_end_um", "1e999"), "row 7, column q1_end_um: expected a finite number"),
    "nothing": (edit(7, "time_h", ""), "row 7, column time_h: expected a number, found nothing"),
    "sigma 0": (edit(8, "sigma_um", "0"), "row 8, column sigma_um: expected a standard deviation above zero"),
    "sigma < 0": (edit(8, "sigma_um", "-0.005"), "row 8, column sigma_um: expected a standard deviation above zero"),
    "outside the limits": (edit(9, "q4_end_deg", "6"), "row 9, column q4_end_deg: 6 deg is outside the limits of cell"),
    "start = end": (still, "row 5, column q1_end_um: start and end are the same, expected a sweep that moves"),
    "signed 2": (edit(10, "signed", "2"), "row 10, column signed: expected 1 (sign known) or 0"),
    "long text": (edit(11, "label", "x" * 1001), "row 11, column label: expected at most 1000 characters"),
    "short row": (lambda: CASE_A.read_text() + "full-T0,0\n", "row 71: expected 18 fields, found 2"),
    "semicolons": (lambda: CASE_A.read_text().replace(",", ";"), "row 1: expected fields separated by commas"),
}


@pytest.mark.parametrize(("make", "message"), BAD_SWEEPS.values(), ids=BAD_SWEEPS.keys())
def test_bad_sweeps(capsys, make, message):
    Path("bad.csv").write_text(make())
    line = refused(capsys, "identify", "bad.csv", "--json", "out.json")
    assert line.startswith("fpcal: error: bad.csv: ")
    assert message in line


def test_missing_files_and_folders(capsys):
    assert "none.csv: no such file" in refused(capsys, "identify", "none.csv")
    assert ".: is a folder, expected a file" in refused(capsys, "identify", ".")
    assert "no session 'x': expected one of full-T0" in refused(capsys, "identify", CASE_A, "--session", "x")
    Path("binary.csv").write_bytes(b"a,b\n\xff\xfe\n")
    assert "binary.csv: row 2: expected UTF-8 text" in refused(capsys, "identify", "binary.csv")


@pytest.mark.parametrize(
    ("free", "message"),
    [
        ("alpha_9", "unknown parameter 'alpha_9': expected all, intrinsic, extrinsic, or some of alpha_2"),
        ("", "unknown parameter ''"),
        ("all,", "unknown parameter ''"),
        ("gain_1", "parameter 'gain_1' has no prior_sd in cell 'femto-st': it cannot be freed"),
    ],
)
def test_unknown_parameters(capsys, free, message):
    assert message in refused(capsys, "identify", CASE_A, "--free", free, "--json", "out.json")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "femto-st"', 'name = "femto-st"\nnmae = "x"', "key nmae: unknown key, expected one of"),
        ("wavelength_nm", "wavelength", "key optics.wavelength: unknown key"),
        ("repeatability_um = 0.0", "repeatability_mm = 0.0", "key joint 1.repeatability_mm: unknown key"),
        (
            'unit = "um"',
            'unit = "furlong"',
            "key joint 1.controller.unit: expected one of pm, nm, um, mm, m, found 'furlong'",
        ),
        (
            "nominal_deg = -90.0",
            'nominal_deg = "-90"',
            "key joint 2.alpha.nominal_deg: expected a finite number, found '-90'",
        ),
        ("[optics]", "[optics", "not a TOML file"),
    ],
)
def test_bad_cells(capsys, old, new, message):
    text = data_file("femto-st.toml").read_text()
    assert old in text
    Path("cell.toml").write_text(text.replace(old, new, 1))
    for command in (["identify", CASE_A, "--json", "out.json"], ["simulate", "-o", "a.csv"], ["week", "-o", "folder"]):
        line = refused(capsys, *command, "--cell", "cell.toml")
        assert line.startswith("fpcal: error: cell.toml: ")
        assert message in line
    assert not Path("folder").exists()


def test_cell_with_other_joints(capsys):
    three = Path(__file__).parent / "data" / "xy-theta.toml"
    line = refused(capsys, "identify", CASE_A, "--cell", three)
    assert "does not fit: cell 'xy-theta' has 5 joints" in line or "has 5 joints" in line
    assert "the paper's protocol is for a chain" in refused(capsys, "simulate", "-o", "a.csv", "--cell", three)


class TestCampaigns:
    @pytest.fixture
    def campaign(self, here) -> Path:
        assert main(["simulate", "-o", "a.h5", "--quiet"]) == 0
        return here / "a.h5"

    @pytest.mark.parametrize("share", [0.02, 0.5, 0.95])
    def test_truncated(self, capsys, campaign, share):
        capsys.readouterr()
        content = campaign.read_bytes()
        Path("bad.h5").write_bytes(content[: int(share * len(content))])
        assert refused(capsys, "identify", "bad.h5", "--json", "out.json").startswith("fpcal: error: bad.h5: ")

    def test_newer(self, capsys, campaign):
        capsys.readouterr()
        with h5py.File(campaign, "r+") as file:
            file.attrs["schema_version"] = 2
        line = refused(capsys, "identify", "a.h5", "--json", "out.json")
        assert "a.h5: written by a newer fpcal: schema 2, this program reads 1" in line

    def test_other_cell(self, capsys, campaign):
        capsys.readouterr()
        Path("cell.toml").write_text(data_file("femto-st.toml").read_text().replace("1560.0", "1550.0"))
        assert "a.h5: made with cell 'femto-st'" in refused(capsys, "identify", "a.h5", "--cell", "cell.toml")

    def test_csv_that_is_called_h5(self, capsys):
        Path("a.h5").write_bytes(CASE_A.read_bytes())
        assert refused(capsys, "identify", "a.h5").startswith("fpcal: error: a.h5: ")


class TestOutputs:
    def test_folder_missing(self, capsys):
        line = refused(capsys, "identify", CASE_A, "--json", "none/out.json")
        assert "none/out.json: the folder none does not exist" in line

    def test_folder_is_a_file(self, capsys):
        Path("file").write_text("x")
        assert "the folder file does not exist" in refused(capsys, "identify", CASE_A, "--json", "file/out.json")
        assert "file: expected a folder that can be made" in refused(capsys, "week", "-o", "file")
        assert "none/week: expected a folder that can be made" in refused(capsys, "week", "-o", "none/week")

    @pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder that not even root can write to")
    def test_folder_not_writable(self, capsys):
        line = refused(capsys, "identify", CASE_A, "--json", "/proc/self/out.json")
        assert "/proc/self/out.json: the folder /proc/self is not writable" in line

    @pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root writes to read-only folders")
    def test_folder_read_only(self, capsys, here):
        folder = here / "closed"
        folder.mkdir(mode=0o500)
        assert "is not writable" in refused(capsys, "identify", CASE_A, "--json", folder / "out.json")

    def test_output_is_an_input(self, capsys):
        Path("a.csv").write_bytes(CASE_A.read_bytes())
        Path("link.csv").symlink_to("a.csv")
        for name in ("a.csv", "./a.csv", "link.csv"):
            line = refused(capsys, "identify", "a.csv", "--json", name)
            assert "is an input of this command, expected another name for the output" in line
        assert main(["identify", "a.csv", "--json", "start.json", "--quiet"]) == 0
        capsys.readouterr()
        line = refused(capsys, "identify", "a.csv", "--start", "start.json", "--json", "start.json")
        assert "start.json: is an input of this command" in line


class TestStart:
    @pytest.fixture
    def start(self, capsys) -> dict[str, Any]:
        assert main(["identify", str(CASE_A), "--json", "start.json", "--quiet"]) == 0
        capsys.readouterr()
        return json.loads(Path("start.json").read_text())

    def test_of_another_cell(self, capsys, start):
        Path("cell.toml").write_text(data_file("femto-st.toml").read_text().replace('"femto-st"', '"twin"'))
        line = refused(capsys, "identify", CASE_A, "--start", "start.json", "--cell", "cell.toml", "--json", "out.json")
        assert "start.json: key cell: the estimate is of another cell ('femto-st', opd 'axis'" in line
        assert "expected 'twin'" in line

    def test_of_the_other_path(self, capsys, start):
        line = refused(capsys, "identify", CASE_A, "--start", "start.json", "--opd", "perpendicular")
        assert "start.json: key cell: the estimate is of another cell" in line

    def test_damaged(self, capsys, start):
        text = Path("start.json").read_text()
        Path("start.json").write_text(text[:1000])
        assert "start.json: not a JSON file" in refused(capsys, "identify", CASE_A, "--start", "start.json")
        start["parameters"]["z_et"]["unit"] = "nm"
        Path("start.json").write_text(json.dumps(start))
        line = refused(capsys, "identify", CASE_A, "--start", "start.json")
        assert "start.json: key parameters.z_et.unit: expected 'um'" in line

    def test_missing(self, capsys):
        assert "none.json: no such file" in refused(capsys, "identify", CASE_A, "--start", "none.json")


@pytest.mark.slow
class TestProcess:
    """What only a process of its own shows: streams, colours, exit status."""

    def test_identify(self):
        done = program("identify", str(CASE_A), "--json", "out.json", env={"TERM": "xterm-256color"})
        assert done.returncode == 0
        assert "\x1b" not in done.stdout + done.stderr
        assert "alpha_2" in done.stdout
        assert json.loads(Path("out.json").read_text())["schema"] == "fpcal/1"

    def test_bad_input(self):
        done = program("identify", "none.csv")
        assert done.returncode == 2
        assert done.stdout == ""
        assert done.stderr == "fpcal: error: none.csv: no such file\n"

    def test_bad_usage(self):
        done = program("identify", "a", "b", "--nothing")
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1

    def test_help_and_reader_that_leaves(self):
        assert program("--help").returncode == 0
        # The reader of the pipe is gone before anything is written.
        read, write = os.pipe()
        os.close(read)
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
        command = [sys.executable, "-m", "fpcal_bayes", "identify", str(CASE_A), "--json", "out.json"]
        done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, env=environment, check=False)
        os.close(write)
        assert done.returncode == 0
        assert "Traceback" not in done.stderr
        assert "Exception ignored" not in done.stderr
        # The work is done all the same.
        assert json.loads(Path("out.json").read_text())["fit"]["converged"] is True

    def test_plain_ascii_terminal(self):
        done = program("identify", str(CASE_A), env={"PYTHONIOENCODING": "ascii", "LC_ALL": "C"})
        assert done.returncode == 0
        assert "Traceback" not in done.stderr
