"""The reader of cells: every kind of bad file gives one line that names file and key, and never another exception."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.cell import load_cell

TEXT = data_file("femto-st.toml").read_text()

MINIMAL = """
schema = "fpcal-cell/1"
name = "minimal"
[optics]
wavelength_nm = 1550
[[joint]]
kind = "revolute"
[extrinsic]
beta_et = { nominal_deg = -90 }
y_wf = { nominal_um = 900, prior_sd_um = 10 }
"""


def refusal(content: str | bytes, folder: Path) -> str:
    """The message with which a file of this content is refused."""
    path = folder / "cell.toml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError) as caught:
        load_cell(path, mechanics="none")
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message.removeprefix(f"{path}: ")


def test_minimal_cell(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(MINIMAL)
    cell = load_cell(path, mechanics="none")
    assert cell.free.names == ("y_wf",)
    assert (cell.opd, cell.optical_axis, cell.wavelength) == ("axis", "minus-y", pytest.approx(1.55))
    assert (cell.low[0], cell.high[0], cell.joints[0].controller) == (-np.inf, np.inf, None)
    # A string is as good as a path.
    assert load_cell(str(path)).sha256 == cell.sha256


def test_values_are_read_in_their_units(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    text = MINIMAL.replace(
        'kind = "revolute"\n',
        'kind = "revolute"\nlimits_deg = [-90, 180]\nrepeatability_deg = 0.5\n'
        "alpha = { nominal_deg = 9, prior_sd_deg = 2 }\ngain = { nominal_ppm = 5, prior_sd_ppm = 300 }\n"
        "runout_cos = { nominal_um = 0.1, prior_sd_um = 0.2, optional = false }\n"
        'controller = { name = "m", channel = "2", sign = -1, zero = 3, unit = "mdeg" }\n',
    )
    path.write_text(text)
    cell = load_cell(path, mechanics="none")
    assert cell.low[0] == pytest.approx(-np.pi / 2)
    assert cell.high[0] == pytest.approx(np.pi)
    assert cell.repeatability[0] == pytest.approx(np.radians(0.5))
    alpha, gain = cell.parameters["alpha_1"], cell.parameters["gain_1"]
    assert (alpha.nominal, alpha.prior_sd) == pytest.approx((np.radians(9), np.radians(2)))
    assert (gain.nominal, gain.prior_sd, gain.optional) == (pytest.approx(5e-6), pytest.approx(3e-4), True)
    assert not cell.parameters["runout_cos_1"].optional
    assert cell.free.names == ("alpha_1", "runout_cos_1", "y_wf")
    controller = cell.joints[0].controller
    assert controller is not None
    assert (controller.name, controller.channel, controller.sign, controller.zero) == ("m", "2", -1, 3.0)
    assert controller.reading_of(np.radians([1.0])) == pytest.approx([-997.0])


# What is replaced in the built-in cell, by what, and how the refusal goes on behind the file's name.
BAD = [
    # unknown keys at each level
    ('name = "femto-st"', 'name = "x"\ncolour = "red"', "key colour: unknown key"),
    ("[optics]", "[optics]\nlens = 1", "key optics.lens: unknown key"),
    ('kind = "prismatic"', 'kind = "prismatic"\nspeed = 1', "key joint 1.speed: unknown key"),
    ('channel = "2", sign = 1, zero = 150.0', 'channel = "2", baud = 9600', "key joint 2.controller.baud: unknown key"),
    ("alpha = { nominal_deg = -90.0", "alpha = { sd = 1, nominal_deg = -90.0", "key joint 2.alpha.sd: unknown key"),
    ("[extrinsic]", "[extrinsic]\nalpha_wf = { nominal_deg = 0.0 }", "key extrinsic.alpha_wf: unknown key"),
    ("z_et = { nominal_um", "z_et = { mean_um", "key extrinsic.z_et.mean_um: unknown key"),
    ("[optics]", "[lab]\n[optics]", "key lab: unknown key"),
    # impossible units
    ("d = { nominal_um = 0.0", "d = { nominal_deg = 0.0", "key joint 4.d.nominal_deg: unknown key"),
    ("beta = { nominal_deg", "beta = { nominal_um", "key joint 4.beta.nominal_um: unknown key"),
    ("gain = { prior_sd_ppm", "gain = { prior_sd_um", "key joint 4.gain.prior_sd_um: unknown key"),
    ("limits_um = [", "limits_deg = [", "key joint 1.limits_deg: unknown key"),
    ("limits_deg = [", "limits_um = [", "key joint 4.limits_um: unknown key"),
    ("repeatability_deg", "repeatability_um", "key joint 4.repeatability_um: unknown key"),
    ('unit = "um"', 'unit = "furlong"', "key joint 1.controller.unit: expected one of pm, nm, um, mm, m"),
    ('unit = "um"', 'unit = "deg"', "key joint 1.controller.unit: expected one of pm, nm, um, mm, m, found 'deg'"),
    ('unit = "deg"', 'unit = "mm"', "key joint 4.controller.unit: expected one of udeg"),
    # wrong types
    ("wavelength_nm = 1560.0", 'wavelength_nm = "1560"', "key optics.wavelength_nm: expected a finite number"),
    (
        "wavelength_nm = 1560.0",
        "wavelength_nm = true",
        "key optics.wavelength_nm: expected a finite number, found True",
    ),
    ("wavelength_nm = 1560.0", "", "key optics.wavelength_nm: expected a finite number, found None"),
    ('opd = "axis"', "opd = 1", "key optics.opd: expected one of axis, perpendicular, found 1"),
    ('opd = "axis"', 'opd = "Axis"', "key optics.opd: expected one of axis, perpendicular, found 'Axis'"),
    ('optical_axis = "minus-y"', 'optical_axis = "y"', "key optics.optical_axis: expected one of minus-y, z"),
    ('name = "femto-st"', "name = 3", "key name: expected a line of text"),
    ('name = "femto-st"', 'name = ""', "key name: expected a line of text"),
    ('name = "femto-st"', 'name = "a\\nb"', "key name: expected a line of text"),
    ('name = "femto-st"', f'name = "{"x" * 1001}"', "key name: expected a line of text"),
    ('name = "femto-st"', "", "key name: expected a line of text"),
    ('kind = "prismatic"', 'kind = "spherical"', "key joint 1.kind: expected one of prismatic, revolute"),
    ('kind = "prismatic"', "kind = []", "key joint 1.kind: expected one of prismatic, revolute, found []"),
    ('kind = "prismatic"', "", "key joint 1.kind: expected one of prismatic, revolute, found None"),
    ("sign = 1", "sign = 2", "key joint 1.controller.sign: expected 1 or -1, found 2"),
    ("sign = 1", "sign = true", "key joint 1.controller.sign: expected 1 or -1, found True"),
    ('channel = "1"', "channel = 1", "key joint 1.controller.channel: expected a line of text"),
    ("zero = 150.0", "zero = [150.0]", "key joint 1.controller.zero: expected a finite number"),
    ("300.0, optional = true", "300.0, optional = 1", "key joint 4.gain.optional: expected true or false, found 1"),
    ("beta = { nominal_deg = 0.0, prior_sd_deg = 1.0 }", "beta = 0.0", "key joint 4.beta: expected a table"),
    ("z_et = { nominal_um = 0.0, prior_sd_um = 20.0 }", "z_et = [0, 20]", "key extrinsic.z_et: expected a table"),
    (
        'controller = { name = "E-712", channel = "1",',
        "controller = [] # {",
        "key joint 1.controller: expected a table",
    ),
    # numbers that are none, or out of range
    ("wavelength_nm = 1560.0", "wavelength_nm = nan", "key optics.wavelength_nm: expected a finite number, found nan"),
    ("wavelength_nm = 1560.0", "wavelength_nm = inf", "key optics.wavelength_nm: expected a finite number, found inf"),
    ("wavelength_nm = 1560.0", "wavelength_nm = 1e999", "key optics.wavelength_nm: expected a finite number"),
    ("wavelength_nm = 1560.0", "wavelength_nm = -1560.0", "key optics.wavelength_nm: expected a number from 0.001"),
    ("wavelength_nm = 1560.0", f"wavelength_nm = {'9' * 400}", "key optics.wavelength_nm: expected a finite number"),
    ("wavelength_nm = 1560.0", f"wavelength_nm = {'9' * 5000}", "not a TOML file"),
    (
        "wavelength_nm = 1560.0",
        f"wavelength_nm = 0x{'f' * 5000}",
        "key optics.wavelength_nm: expected a finite number, found a number out of range",
    ),
    ("nominal_deg = -90.0", "nominal_deg = nan", "key joint 2.alpha.nominal_deg: expected a finite number, found nan"),
    ("nominal_um = 920.0", "nominal_um = -inf", "key extrinsic.y_wf.nominal_um: expected a finite number, found -inf"),
    ("prior_sd_deg = 1.0", "prior_sd_deg = -1.0", "key joint 2.alpha.prior_sd_deg: expected a number from 0 to 10000"),
    ("prior_sd_um = 20.0", "prior_sd_um = nan", "key joint 4.d.prior_sd_um: expected a finite number, found nan"),
    ("repeatability_um = 0.0", "repeatability_um = -1", "key joint 1.repeatability_um: expected a number from 0"),
    ("resolution_um = 0.0005", "resolution_um = -1", "key joint 1.resolution_um: expected a number from 0"),
    ("resolution_um = 0.0005", "resolution_deg = 1.0", "key joint 1.resolution_deg: unknown key"),
    # limits
    ("limits_um = [-150.0, 150.0]", "limits_um = [150.0, -150.0]", "key joint 1.limits_um: expected low < high"),
    ("limits_um = [-150.0, 150.0]", "limits_um = [1, 1]", "key joint 1.limits_um: expected low < high, found [1, 1]"),
    ("limits_um = [-150.0, 150.0]", "limits_um = [1]", "key joint 1.limits_um: expected two numbers"),
    ("limits_um = [-150.0, 150.0]", "limits_um = 150.0", "key joint 1.limits_um: expected two numbers"),
    ("limits_um = [-150.0, 150.0]", "limits_um = [-inf, 0]", "key joint 1.limits_um: expected two numbers"),
    ("limits_um = [-150.0, 150.0]", 'limits_um = ["a", 0]', "key joint 1.limits_um: expected two numbers"),
    # what a prismatic joint cannot have
    (
        'kind = "prismatic"',
        'kind = "prismatic"\nrunout_cos = { prior_sd_um = 0.2 }',
        "key joint 1.runout_cos: a prismatic joint has no runout",
    ),
    # the file as a whole
    ('schema = "fpcal-cell/1"', 'schema = "fpcal-cell/2"', "key schema: expected 'fpcal-cell/1', found 'fpcal-cell/2'"),
    ('schema = "fpcal-cell/1"', "", "key schema: expected 'fpcal-cell/1', found None"),
    ("prior_sd_", "optional = true, prior_sd_", "not a TOML file"),
    ("[optics]", "[optics", "not a TOML file"),
    ('name = "femto-st"', 'name = "a"\nname = "b"', "not a TOML file"),
]


@pytest.mark.parametrize(("old", "new", "expected"), BAD, ids=[f"{i}-{b[2][:60]}" for i, b in enumerate(BAD)])
def test_refusal_names_the_key(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert old in TEXT
    count = -1 if old == "prior_sd_" else 1
    assert refusal(TEXT.replace(old, new, count), tmp_path).startswith(expected)


@pytest.mark.parametrize(
    ("drop", "expected"),
    [
        ("[optics]\nwavelength_nm = 1550\n", "key optics: expected a table"),
        ('[[joint]]\nkind = "revolute"\n', "key joint: expected one [[joint]] table for each joint"),
        (
            "[extrinsic]\nbeta_et = { nominal_deg = -90 }\ny_wf = { nominal_um = 900, prior_sd_um = 10 }\n",
            "key extrinsic: expected a table",
        ),
        (", prior_sd_um = 10", "key joint: no parameter has a prior_sd: there is nothing to identify"),
    ],
)
def test_missing_part(tmp_path: Path, drop: str, expected: str) -> None:
    assert drop in MINIMAL
    assert refusal(MINIMAL.replace(drop, ""), tmp_path).startswith(expected)


@pytest.mark.parametrize(
    ("joint", "expected"),
    [
        ("joint = []", "key joint: expected one [[joint]]"),
        ("joint = 6", "key joint: expected one [[joint]]"),
        ("joint = [1]", "key joint 1: expected a table"),
        ("[joint]", "key joint: expected one [[joint]]"),
    ],
)
def test_joints_of_the_wrong_type(tmp_path: Path, joint: str, expected: str) -> None:
    without = MINIMAL.replace('[[joint]]\nkind = "revolute"\n', "")
    text = f"{without}\n{joint}\n" if joint.startswith("[") else without.replace("[optics]", f"{joint}\n[optics]")
    assert refusal(text, tmp_path).startswith(expected)


def test_only_optional_priors_leave_nothing_to_identify(tmp_path: Path) -> None:
    text = MINIMAL.replace("prior_sd_um = 10", "prior_sd_um = 10, optional = true")
    assert refusal(text, tmp_path).startswith("key joint: no parameter has a prior_sd")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "the file is empty"),
        (b"\xff\xfe", "row 1: expected UTF-8 text"),
        (b"# only a comment\n", "key schema: expected"),
        (b"hello", "not a TOML file"),
        (b"\x00", "not a TOML file"),
        (b"a = " + b"[" * 100_000, "not a"),
        (b"a = 1979-13-45", "not a TOML file"),
    ],
)
def test_not_a_cell(tmp_path: Path, content: bytes, expected: str) -> None:
    assert refusal(content, tmp_path).startswith(expected)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (lambda folder: folder / "missing.toml", "no such file"),
        (lambda folder: folder, "is a folder"),
        (lambda folder: folder / "a\x00b", "no such file"),
        (lambda folder: folder / ("x" * 5000), "cannot be read"),
        (lambda _: "femto", "no such file"),
        (lambda _: "", "is a folder"),
    ],
)
def test_no_such_cell(tmp_path: Path, source: Callable[[Path], str | Path], expected: str) -> None:
    with pytest.raises(InputError, match=f"{expected}.*; built-in cells: femto-st, three-beams$"):
        load_cell(source(tmp_path))


@pytest.fixture(scope="session")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "cell.toml"


def accepted_or_refused(path: Path, content: bytes) -> None:
    """Load the cell; a refusal is one line that names the file."""
    path.write_bytes(content)
    message = ""
    try:
        cell = load_cell(path, mechanics="none")
    except InputError as error:
        message = str(error)
    if message:
        assert message.startswith(f"{path}: ")
        assert len(message.splitlines()) == 1
        return
    assert len(cell.free) > 0
    assert np.isfinite(cell.parameters.nominal).all()
    assert len(cell.sha256) == 64


@given(st.text() | st.text(alphabet='[]{}=".,#\n\t 0123456789eE+-_xnaif'))
def test_any_text(fuzzed: Path, text: str) -> None:
    accepted_or_refused(fuzzed, text.encode())


@given(st.binary())
def test_any_bytes(fuzzed: Path, content: bytes) -> None:
    accepted_or_refused(fuzzed, content)


_VALUES = st.sampled_from(
    [
        *("nan", "-inf", "1e999", "0", "-1", "1.0", "0x" + "f" * 5000, "9" * 5000, "true", "1979-05-27", "07:32:00"),
        *('""', '"x"', '"deg"', '"axis"', '"\\u0000"', '"""a\nb"""', "[]", "[1, 2]", "{}", "{ a = 1 }"),
    ]
)


@settings(max_examples=120)
@given(st.data())
def test_mutated_cell(fuzzed: Path, data: st.DataObject) -> None:
    """Values are swapped, lines dropped, doubled or moved, and pieces of text put in anywhere."""
    lines = TEXT.splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(lines) - 1))
        match data.draw(st.sampled_from(["value", "drop", "double", "move", "insert", "cut"])):
            case "value":
                head, equals, tail = lines[at].rpartition("=")
                closing = " }" if "}" in tail else ""
                lines[at] = f"{head}{equals} {data.draw(_VALUES)}{closing}"
            case "drop":
                lines[at] = ""
            case "double":
                lines.insert(at, lines[at])
            case "move":
                lines.insert(data.draw(st.integers(0, len(lines) - 1)), lines.pop(at))
            case "insert":
                place = data.draw(st.integers(0, len(lines[at])))
                lines[at] = lines[at][:place] + data.draw(st.text(max_size=8)) + lines[at][place:]
            case "cut":
                lines[at] = lines[at][: data.draw(st.integers(0, len(lines[at])))]
    accepted_or_refused(fuzzed, "\n".join(lines).encode())


def tables() -> st.SearchStrategy[str]:
    """Well-formed TOML of the right keys with any values."""
    keys = ["schema", "name", "optics", "joint", "extrinsic", "kind", "alpha", "controller", "y_wf", "wavelength_nm"]
    scalars = st.sampled_from(["1", "-2.5", "nan", "true", '"fpcal-cell/1"', '"revolute"', '"x"', "1979-05-27"])
    values = st.recursive(
        scalars,
        lambda inner: (
            st.lists(inner, max_size=3).map(lambda items: f"[{', '.join(items)}]")
            | st.dictionaries(st.sampled_from(keys), inner, max_size=3).map(
                lambda table: f"{{ {', '.join(f'{k} = {v}' for k, v in table.items())} }}"
            )
        ),
        max_leaves=12,
    )
    return st.dictionaries(st.sampled_from(keys), values, max_size=6).map(
        lambda table: "\n".join(f"{k} = {v}" for k, v in ({"schema": '"fpcal-cell/1"', "name": '"x"'} | table).items())
    )


@given(tables())
def test_well_formed_toml_of_any_shape(fuzzed: Path, text: str) -> None:
    accepted_or_refused(fuzzed, text.encode())


class TestPriors:
    @staticmethod
    def cell(tmp_path, table: str):
        path = tmp_path / "cell.toml"
        path.write_text(
            data_file("femto-st.toml")
            .read_text()
            .replace("z_et = { nominal_um = 0.0, prior_sd_um = 20.0 }", f"z_et = {{ {table} }}")
        )
        return load_cell(path, mechanics="none")

    @pytest.mark.parametrize(
        ("table", "kind", "nominal", "sd"),
        [
            ('prior = "normal", nominal_um = 1.0, prior_sd_um = 5.0', None, 1.0, 5.0),
            ('prior = "uniform", low_um = -3.0, high_um = 9.0', "uniform", 3.0, 12 / 12**0.5),
            ('prior = "truncated-normal", prior_sd_um = 2.0, low_um = -100.0', "truncated-normal", 0.0, 2.0),
            (
                'prior = "half-normal", nominal_um = 1.0, prior_sd_um = 2.0',
                "truncated-normal",
                1.0,
                2 * (1 - 2 / np.pi) ** 0.5,
            ),
            ('prior = "log-normal", nominal_um = 5.0, prior_factor = 1.001', "log-normal", 5.0, 5 * np.log(1.001)),
        ],
    )
    def test_kinds(self, tmp_path, table, kind, nominal, sd):
        p = self.cell(tmp_path, table).parameters["z_et"]
        assert (None if p.prior is None else p.prior.kind) == kind
        assert (p.nominal, p.prior_sd) == pytest.approx((nominal, sd), rel=1e-5)

    def test_the_hash_knows_the_kind(self, tmp_path):
        hashes = {
            self.cell(tmp_path, table).sha256
            for table in (
                "nominal_um = 0.0, prior_sd_um = 20.0",
                'prior = "truncated-normal", prior_sd_um = 20.0, low_um = -1000.0',
                'prior = "truncated-normal", prior_sd_um = 20.0, low_um = -2000.0',
            )
        }
        assert len(hashes) == 3
        assert load_cell(mechanics="none").sha256 in hashes

    @pytest.mark.parametrize(
        ("table", "message"),
        [
            ('prior = "cauchy", prior_sd_um = 1.0', "extrinsic.z_et.prior: expected one of normal, truncated-normal"),
            ('prior = "uniform", low_um = -3.0', "extrinsic.z_et.high_um: expected a finite number"),
            ('prior = "uniform", low_um = 3.0, high_um = 1.0', "extrinsic.z_et: a uniform prior: expected low < high"),
            ('prior = "uniform", low_um = 0.0, high_um = 1.0, nominal_um = 2.0', "expected low < nominal < high"),
            ('prior = "uniform", low_um = 0.0, high_um = 1.0, prior_sd_um = 2.0', "prior_sd_um: unknown key"),
            ('prior = "log-normal", nominal_um = -1.0, prior_factor = 2.0', "expected a nominal value above zero"),
            ('prior = "half-normal", prior_sd_um = 0.0', "expected a spread above zero"),
            ('prior = "truncated-normal", prior_sd_um = 1.0, low_um = 2.0', "expected a spread above zero and low <="),
            ("prior_sd_um = 20.0, low_um = -1.0", "extrinsic.z_et.low_um: unknown key"),
        ],
    )
    def test_refused(self, tmp_path, table, message):
        with pytest.raises(InputError, match=re.escape(message)):
            self.cell(tmp_path, table)
