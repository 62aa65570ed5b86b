"""Sweeps in CSV files: what is read, what is refused and how it is said."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.sweeps import read_csv, read_sweeps, write_csv, write_sweeps
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cell.cell import make_parameters

CELL = load_cell(mechanics="none")
CASE_A = Path(__file__).parent / "data" / "case_a.csv"
HEADER = (
    "session,time_h,label,q1_start_um,q2_start_um,q3_start_um,q4_start_deg,q5_start_deg,q6_start_deg,"
    "q1_end_um,q2_end_um,q3_end_um,q4_end_deg,q5_end_deg,q6_end_deg,dl_um,sigma_um,signed"
)
ROW = "s,1.5,a,0,0,0,-3,0,0,0,0,0,3,0,0,11.5,0.005,1"
QS = HEADER.split(",")[3:15]


def write(folder: Path, text: str | bytes, name: str = "sweeps.csv") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def with_field(column: str, value: str) -> str:
    """A file of two good rows and one, in line 4, in which one field is replaced."""
    fields = ROW.split(",")
    fields[HEADER.split(",").index(column)] = value
    return "\n".join([HEADER, ROW, ROW, ",".join(fields)]) + "\n"


def with_option(column: str, value: str) -> str:
    return f"{HEADER},{column}\n{ROW},\n{ROW},{value}\n"


def refusal(path: Path, *, plan: bool = False) -> str:
    with pytest.raises(InputError) as caught:
        read_csv(path, CELL, plan=plan)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert len(message.splitlines()) == 1
    return message.removeprefix(str(path) + ": ")


def test_reads_internal_units(tmp_path):
    sweeps = read_csv(write(tmp_path, f"{HEADER}\n{ROW}\n"), CELL)
    assert sweeps.session.tolist() == ["s"]
    assert sweeps.label.tolist() == ["a"]
    np.testing.assert_allclose(sweeps.q_start, [[0, 0, 0, -np.pi / 60, 0, 0]], rtol=1e-15)
    np.testing.assert_allclose(sweeps.q_end, [[0, 0, 0, np.pi / 60, 0, 0]], rtol=1e-15)
    assert (sweeps.time_h[0], sweeps.dl[0], sweeps.sigma[0], sweeps.signed[0]) == (1.5, 11.5, 0.005, True)
    assert sweeps.kind.tolist() == ["sweep"]
    assert sweeps.rows.tolist() == [2]


def test_optional_columns_in_any_order(tmp_path):
    text = f"{HEADER},temperature_c,kind,utc,group,trace\n{ROW},21.5,path,2024-05-01T08:30:00Z,g,t.csv\n{ROW},,,,,\n"
    sweeps = read_csv(write(tmp_path, text), CELL)
    assert sweeps.kind.tolist() == ["path", "sweep"]
    assert sweeps.utc.tolist() == ["2024-05-01T08:30:00Z", ""]
    assert sweeps.group.tolist() == ["g", ""]
    assert sweeps.trace.tolist() == ["t.csv", ""]
    assert sweeps.temperature_c[0] == 21.5
    assert np.isnan(sweeps.temperature_c[1])


@pytest.mark.parametrize(
    "text",
    [
        f"\ufeff{HEADER}\n{ROW}\n",
        f"{HEADER}\r\n{ROW}\r\n",
        f"{HEADER}\n\n{ROW}\n\n  \n\n",
        f"{HEADER}\n{ROW}",
        f"{HEADER}\n" + ",".join(f'"{field}"' for field in ROW.split(",")) + "\n",
    ],
    ids=["byte order mark", "CRLF", "blank lines", "no last line end", "quoted"],
)
def test_accepts_other_writers(tmp_path, text):
    assert read_csv(write(tmp_path, text), CELL).dl.tolist() == [11.5]


def test_the_header_follows_the_cells_joints(tmp_path):
    links = make_parameters({"alpha_1": (-np.pi / 2, 0.0, False), "y_wf": (920.0, 200.0, False)}, 2)
    cell = replace(CELL, name="two", joints=(CELL.joints[5], CELL.joints[0]), parameters=links, envelope=None)
    header = "session,time_h,label,q1_start_deg,q2_start_um,q1_end_deg,q2_end_um,dl_um,sigma_um,signed"
    text = f"{header}\ns,0,a,90,5,0,7,1,1,1\n"
    path = write(tmp_path, text)
    sweeps = read_csv(path, cell)
    np.testing.assert_allclose(sweeps.q_start, [[np.pi / 2, 5.0]])
    write_csv(path, sweeps, cell)
    assert path.read_text() == text
    assert "column q1_start_deg does not fit: cell 'femto-st' has 6 joints" in refusal(path)


def test_rows_are_lines_of_the_file(tmp_path):
    assert read_csv(write(tmp_path, f"\n{HEADER}\n\n{ROW}\n\n{ROW}\n"), CELL).rows.tolist() == [4, 6]


@pytest.mark.parametrize(
    ("column", "value"),
    [(name, value) for name in ("time_h", "q1_start_um", "q6_end_deg", "dl_um", "sigma_um", "signed")
     for value in ("abc", "", "nan", "inf", "-Infinity", "1_0", "\uff11", " 1", "0x1", "1e", "1,5", "1e999", "--1")],
)  # fmt: skip
def test_refuses_what_is_not_a_number(tmp_path, column, value):
    message = refusal(write(tmp_path, with_field(column, f'"{value}"')))
    assert message.startswith(f"row 4, column {column}: expected a")
    assert "number" in message


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("sigma_um", "0", "above zero"),
        ("sigma_um", "-0.005", "above zero"),
        ("signed", "2", "expected 1 (sign known) or 0"),
        ("signed", "-1", "expected 1 (sign known) or 0"),
        ("q4_end_deg", "5.1", "-5 to 5 deg"),
        ("q1_start_um", "-150.001", "-150 to 150 um"),
        ("session", "", "the name of a session"),
        ("label", "x" * 1001, "at most 1000 characters"),
        ("label", "a\tb", "control characters"),
        ("session", "a\x1b[2Jb", "control characters"),
        ("label", '"a\nb"', "control characters"),
    ],
)
def test_refuses_a_value_that_cannot_be(tmp_path, column, value, expected):
    message = refusal(write(tmp_path, with_field(column, value)))
    # A quoted line end makes the field end one line later.
    assert message.startswith(f"row {5 if chr(10) in value else 4}, column {column}: ")
    assert expected in message
    assert "\x1b" not in message


def test_refuses_a_sweep_that_goes_nowhere_unless_it_is_a_path(tmp_path):
    still = with_field("q4_end_deg", "-3")
    assert refusal(write(tmp_path, still)).startswith("row 4, column q1_end_um: start and end are the same")
    path = f"{HEADER},kind\n" + still.splitlines()[3] + ",path\n"
    assert len(read_csv(write(tmp_path, path), CELL)) == 1


def test_refuses_a_negative_size(tmp_path):
    unsigned = ROW.replace(",11.5,0.005,1", ",-11.5,0.005,0")
    assert refusal(write(tmp_path, f"{HEADER}\n{unsigned}\n")).startswith("row 2, column dl_um: expected a size, zero")
    assert read_csv(write(tmp_path, f"{HEADER}\n{unsigned.replace('-11', '11')}\n"), CELL).signed.tolist() == [False]


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("utc", "yesterday", "ISO 8601"),
        ("utc", "2024-05-01", "ISO 8601"),
        ("utc", "2024-13-01T08:30:00Z", "ISO 8601"),
        ("kind", "sweeps", "sweep, absolute, path"),
        ("temperature_c", "warm", "expected a number"),
        ("temperature_c", "nan", "expected a number"),
        ("trace", "t" * 1001, "at most 1000"),
    ],
)
def test_refuses_optional_values(tmp_path, column, value, expected):
    message = refusal(write(tmp_path, with_option(column, value)))
    assert message.startswith(f"row 3, column {column}: ")
    assert expected in message


@pytest.mark.parametrize("value", ["2024-05-01T08:30", "2024-05-01 08:30:00.25", "20240501T083000+0200"])
def test_accepts_forms_of_iso_8601(tmp_path, value):
    assert read_csv(write(tmp_path, with_option("utc", value)), CELL).utc.tolist() == ["", value]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (HEADER, "no rows, expected at least one sweep"),
        ("\n \n", "the file holds no text"),
        (f"{HEADER},group,group\n{ROW},,\n", "row 1: the column 'group' stands twice"),
        (f"{HEADER},label\n{ROW},b\n", "row 1: the column 'label' stands twice"),
        (f"{HEADER},grp\n{ROW},\n", "row 1: unknown column 'grp', expected session,time_h"),
        (f"# made by hand\n{HEADER}\n{ROW}\n", "row 1: unknown column '# made by hand'"),
        (f"{HEADER}\n# a comment\n{ROW}\n", "row 2: expected 18 fields, found 1"),
        (f"{HEADER}\n{ROW},\n", "row 2: expected 18 fields, found 19"),
        (f"{HEADER}\n{ROW}\n{ROW[:-2]}\n", "row 3: expected 18 fields, found 17"),
        (f"{ROW}\n{ROW}\n", "row 1: unknown column 's'"),
        (HEADER.replace(",dl_um", "") + "\n", "row 1: the column dl_um is missing"),
        (HEADER.replace(",q6_end_deg", "") + "\n", "cell 'femto-st' has 6 joints"),
        (HEADER.replace(",dl_um", ",q7_end_deg,dl_um") + "\n", "column q7_end_deg does not fit: cell 'femto-st' has 6"),
        (HEADER.replace("q6_end_deg", "q6_end_um") + "\n", "column q6_end_um does not fit: cell 'femto-st' has 6"),
        (HEADER.replace("time_h,label", "label,time_h") + "\n", "row 1: expected the column time_h, found label"),
        (f"{HEADER}\n{ROW}\n".replace(",", ";"), "row 1: expected fields separated by commas"),
        (f'{HEADER}\n{ROW}\n"s,{ROW}\n', "row 3: not a line of CSV"),
        (f'{HEADER}\n"s"x,{ROW}\n', "row 2: not a line of CSV"),
        (f"{HEADER}\n{'x' * 200_000},{ROW}\n", "row 2: not a line of CSV"),
    ],
)
def test_refuses_another_layout(tmp_path, text, expected):
    assert expected in refusal(write(tmp_path, text))


@pytest.mark.parametrize("plan", [False, True])
def test_refuses_a_beam_that_the_cell_does_not_have(tmp_path, plan):
    path = write(tmp_path, with_option("beam", "left"))
    expected = "row 3, column beam: cell 'femto-st' names no beam, see [[beam]] of the cell"
    assert refusal(path, plan=plan) == expected


@pytest.mark.parametrize("column", ["readings", "expires_h", "expires_utc", "ticket"])
def test_refuses_columns_of_plans(tmp_path, column):
    beside = refusal(write(tmp_path, with_option(column, "1")))
    assert beside == f"row 1: the column {column} belongs to a plan, expected no column dl_um beside it"
    value = "2026-11-28T08:00:00Z" if column == "expires_utc" else "1"
    path = write(tmp_path, ",".join([*QS, column]) + "\n" + ",".join([*ROW.split(",")[3:15], value]) + "\n")
    assert len(read_csv(path, CELL, plan=True)) == 1
    assert f"the column {column} belongs to a plan, expected measured sweeps" in refusal(path)


def test_refuses_what_is_no_text_file(tmp_path):
    assert "no such file" in refusal(tmp_path / "absent.csv")
    assert "is a folder" in refusal(tmp_path)
    assert "the file is empty" in refusal(write(tmp_path, ""))
    assert "row 2: expected UTF-8 text" in refusal(write(tmp_path, f"{HEADER}\n\u00e9".encode("latin-1")))


def test_a_plan_needs_the_joints_only(tmp_path):
    values = ROW.split(",")[3:15]
    path = write(tmp_path, ",".join(["group", *reversed(QS)]) + "\n" + ",".join(["g", *reversed(values)]) + "\n")
    plan = read_csv(path, CELL, plan=True)
    assert plan.label.tolist() == ["row 2"]
    assert plan.group.tolist() == ["g"]
    assert not plan.measured
    assert plan.signed.all()
    np.testing.assert_allclose(np.degrees(plan.q_end[0, 3]), 3.0)
    assert "column session is missing" in refusal(path)
    assert "column q2_end_um is missing" in refusal(write(tmp_path, ",".join(QS).replace(",q2_end_um", "")), plan=True)


def test_a_measurement_in_a_plan_is_read():
    plan, measured = read_csv(CASE_A, CELL, plan=True), read_csv(CASE_A, CELL)
    assert plan.measured
    np.testing.assert_array_equal(plan.dl, measured.dl)


def test_writes_what_it_read(tmp_path):
    sweeps = read_csv(CASE_A, CELL)
    path = tmp_path / "out.csv"
    write_csv(path, sweeps, CELL)
    lines = path.read_text().splitlines()
    assert lines[0] == HEADER
    assert lines[1] == "full-T0,0,node0-rx,0,0,0,-3,0,0,0,0,0,3,0,0,11.0657781,0.005,1"
    write_csv(tmp_path / "again.csv", read_csv(path, CELL), CELL)
    assert (tmp_path / "again.csv").read_bytes() == path.read_bytes()


def test_a_plan_is_written_without_measurement(tmp_path):
    path = tmp_path / "plan.csv"
    write_csv(path, Sweeps.of_um_rad(np.zeros((1, 6)), np.full((1, 6), 0.01), label="one"), CELL)
    assert path.read_text().splitlines()[0] == ",".join(["session", "time_h", "label", *QS])
    assert read_csv(path, CELL, plan=True).label.tolist() == ["one"]


def test_refuses_to_write_what_could_not_be_read(tmp_path):
    sweeps = read_csv(CASE_A, CELL)
    dl = sweeps.dl.copy()
    dl[3] = np.nan
    path = tmp_path / "out.csv"
    for bad, expected in [
        (sweeps.with_measurement(dl, sweeps.sigma), "row 5, column dl_um: expected a number in every row or in none"),
        (sweeps.with_measurement(sweeps.dl, 0.0), "row 2, column sigma_um: expected a standard deviation above zero"),
        (sweeps.take(np.array([], dtype=int)), "no rows"),
    ]:
        with pytest.raises(InputError) as caught:
            write_csv(path, bad, CELL)
        assert expected in str(caught.value)
        assert not path.exists()


def test_a_hundred_thousand_rows_take_seconds(tmp_path):
    path = tmp_path / "many.csv"
    write_csv(path, join([read_csv(CASE_A, CELL)] * 1450), CELL)
    start = time.perf_counter()
    sweeps = read_csv(path, CELL)
    # About 1.5 s on two cores of 2024; a reader that converts field by field in Python takes longer than this.
    assert time.perf_counter() - start < 8.0
    assert len(sweeps) == 100_050


TEXT = st.text(st.characters(exclude_categories=["Cc", "Cs", "Zl", "Zp"]), max_size=12)
MOST = np.degrees(1.0)


@st.composite
def sweep_sets(draw):
    n = draw(st.integers(1, 5))
    low, high = np.maximum(CELL.low, -10.0), np.minimum(CELL.high, 10.0)

    def column(elements):
        return draw(st.lists(elements, min_size=n, max_size=n))

    def poses():
        return low + (high - low) * draw(hnp.arrays(float, (n, 6), elements=st.floats(0.0, 1.0, width=32)))

    kind = column(st.sampled_from(["absolute", "path"]))
    measured = draw(st.booleans())
    signed = np.array(column(st.booleans()))
    dl = np.array(column(st.floats(-1e3, 1e3)))
    return Sweeps.of_um_rad(
        poses(),
        poses(),
        session=column(TEXT.filter(bool)),
        label=column(TEXT),
        time_h=np.array(column(st.floats(-1e5, 1e5))),
        dl=np.where(signed, dl, abs(dl)) if measured else np.nan,
        sigma=np.array(column(st.floats(1e-6, 1e3))) if measured else np.nan,
        signed=signed,
        kind=kind,
        trace=column(TEXT),
        utc=column(st.datetimes().map(lambda moment: moment.isoformat()) | st.just("")),
        temperature_c=np.array(column(st.floats(-50, 100) | st.just(np.nan))),
    )


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(sweeps=sweep_sets())
def test_both_formats_keep_everything(tmp_path, sweeps):
    read = sweeps
    for name, digits in (("a.h5", 1e-14), ("b.csv", 1e-12), ("c.hdf5", 1e-12)):
        # Each file is written from what the one before it gave.
        write_sweeps(tmp_path / name, read, CELL)
        read = read_sweeps(tmp_path / name, CELL, plan=True)
        for column in ("session", "label", "kind", "trace", "utc", "group", "signed"):
            np.testing.assert_array_equal(getattr(read, column), getattr(sweeps, column), err_msg=column)
        for column in ("time_h", "q_start", "q_end", "dl", "sigma", "temperature_c"):
            np.testing.assert_allclose(getattr(read, column), getattr(sweeps, column), rtol=digits, err_msg=column)
        assert read.measured == sweeps.measured
