"""Whatever a file holds, its reader gives sweeps or an `InputError` of one line, and nothing else."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.hdf5 import SIGNATURE
from fpcal_bayes.io.sweeps import read_csv, read_sweeps, write_csv
from fpcal_bayes.io.truth import read_truth
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")
EXAMPLES = settings(max_examples=150, deadline=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(scope="module")
def valid(folder) -> dict[str, bytes]:
    """A small valid file of each format, as bytes."""
    plan = paper_protocol(CELL, midpoints=True)
    plan = plan.take(plan.rows < 8)
    sweeps = simulate_um(CELL, paper_truth(CELL), plan, sigma=0.005, seed=1)
    write_csv(folder / "valid.csv", sweeps, CELL)
    campaign = Campaign.of(sweeps, CELL, seed=1, truth=paper_truth(CELL).record())
    write_campaign(folder / "valid.h5", campaign, CELL)
    return {name: (folder / f"valid.{name}").read_bytes() for name in ("csv", "h5")}


def attempt(read, path: Path, content: bytes) -> object:
    path.write_bytes(content)
    try:
        return read(path, CELL)
    except InputError as error:
        message = str(error)
    assert message.startswith(str(path))
    assert len(message.splitlines()) == 1
    return None


#: Pieces that have a meaning in one of the formats, beside plain bytes.
PIECES = st.binary(max_size=4) | st.sampled_from(
    [piece.encode() for piece in (",", '"', "\n", "\r", "\r\n", "\0", "\ufeff", "-", "e", "nan", "inf", "1e999", "1_0")]
    + [piece.encode() for piece in ("\uff11", "\u2028", "\x1b[0m", "sweep", "path", "absolute", "0" * 400, ";", "#")]
)


@st.composite
def edits(draw) -> list[tuple[float, int, bytes]]:
    """Where (as a share of the length), how many bytes go, and what comes in their place."""
    edit = st.tuples(st.floats(0, 1), st.sampled_from([0, 0, 1, 1, 2, 8, 40]), PIECES)
    return draw(st.lists(edit, min_size=1, max_size=4))


def edited(content: bytes, changes: list[tuple[float, int, bytes]]) -> bytes:
    for share, gone, piece in changes:
        place = int(share * len(content))
        content = content[:place] + piece + content[place + gone :]
    return content


def overwritten(content: bytes, places: list[tuple[float, int]]) -> bytes:
    changed = bytearray(content)
    for share, value in places:
        changed[min(int(share * len(changed)), len(changed) - 1)] = value
    return bytes(changed)


def test_the_valid_files_are_valid(valid, folder):
    for name, read in (("csv", read_csv), ("h5", read_campaign)):
        assert attempt(read, folder / f"whole.{name}", valid[name]) is not None


@EXAMPLES
@given(content=st.binary(max_size=300) | st.text(max_size=200).map(str.encode))
def test_any_bytes(folder, content):
    for name, read in (("a.csv", read_csv), ("a.h5", read_campaign), ("a", read_sweeps), ("a.toml", read_truth)):
        attempt(read, folder / name, content)
    attempt(read_campaign, folder / "b.h5", SIGNATURE + content)


@EXAMPLES
@given(changes=edits(), plan=st.booleans())
def test_edited_csv(valid, folder, changes, plan):
    content = edited(valid["csv"], changes)
    sweeps = attempt(lambda path, cell: read_csv(path, cell, plan=plan), folder / "edited.csv", content)
    if isinstance(sweeps, Sweeps):
        # What is read can be written and read again.
        write_csv(folder / "again.csv", sweeps, CELL)
        assert len(read_csv(folder / "again.csv", CELL, plan=True)) == len(sweeps)


@EXAMPLES
@given(places=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=8))
def test_overwritten_hdf5(valid, folder, places):
    attempt(read_campaign, folder / "overwritten.h5", overwritten(valid["h5"], places))


@EXAMPLES
@given(changes=edits(), keep=st.floats(0, 1))
def test_shifted_and_truncated_hdf5(valid, folder, changes, keep):
    content = edited(valid["h5"], changes)
    attempt(read_campaign, folder / "shifted.h5", content)
    attempt(read_campaign, folder / "truncated.h5", valid["h5"][: int(keep * len(valid["h5"]))])
