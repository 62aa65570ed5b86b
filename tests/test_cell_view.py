"""A cell is seen for what it is, made from words, and refused where its geometry cannot be right."""

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from path_length import path_length

from fpcal_bayes.analysis.cell_view import view_cell
from fpcal_bayes.cli.cell import joints_at
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.new_cell import new_cell_text, read_dh_table
from fpcal_bayes.model import chain
from fpcal_bayes.model.axes import direction_words
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.layout import AxisWord, layout_of_axes, layout_of_links, read_axes, read_side
from fpcal_bayes.report.cell import cell_words

DATA = Path(__file__).parent / "data"
FEMTO, LAB7 = data_file("femto-st.toml").read_text(), (DATA / "lab7.toml").read_text()
FIVE = (DATA / "five_axes.toml").read_text()
SIDES = ("+x", "-x", "+y", "-y", "+z", "-z")


def changed(text: str, *changes: tuple[str, str]) -> str:
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return text


def random_words(random: np.random.Generator) -> str:
    """Up to three translations and three turns, each once, in any order, counted either way."""
    words = [*"xyz", "rx", "ry", "rz"]
    random.shuffle(words)
    chosen = words[: int(random.integers(2, 7))]
    return " ".join(f"{random.choice(['', '-'])}{word}" for word in chosen)


def made(words: str, side: str, folder: Path, gap: float = 300.0) -> Cell:
    layout = layout_of_axes(read_axes(words), read_side(side), gap)
    path = folder / "new.toml"
    path.write_text(new_cell_text(layout, "new", wavelength_nm=1550.0, gap_sd_um=5.0))
    return load_cell(path, mechanics="none")


def moved(cell: Cell, joint: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """What the tool does when one joint moves: shift, and turn as a vector, by plain 4x4 products."""
    q = np.zeros(len(cell.joints))
    before = chain.tool_pose(cell, cell.parameters.nominal, q)
    q[joint] = step
    after = chain.tool_pose(cell, cell.parameters.nominal, q)
    turn = after[:3, :3] @ before[:3, :3].T
    about = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2.0
    return after[:3, 3] - before[:3, 3], about


@pytest.mark.parametrize("seed", range(200))
def test_a_cell_made_from_words_does_what_the_words_say(seed, tmp_path):
    random = np.random.default_rng(seed)
    words, side = random_words(random), str(random.choice(SIDES))
    cell = made(words, side, tmp_path)
    away = read_side(side)
    for joint, axis in enumerate(read_axes(words)):
        shift, turn = moved(cell, joint, 0.01)
        expected = np.array(axis.direction)
        assert cell.joints[joint].kind == axis.kind
        if axis.kind == "prismatic":
            assert_allclose(shift, 0.01 * expected, atol=1e-12)
            assert_allclose(turn, 0.0, atol=1e-12)
        else:
            assert_allclose(turn, np.sin(0.01) * expected, atol=1e-12)
            # The axes meet at the mirror, so that a turn leaves it where it is.
            assert_allclose(shift, 0.0, atol=1e-9)
    mirror = chain.mirror_pose(cell, cell.parameters.nominal, np.zeros(len(cell.joints)))
    fibre = chain.fibre_in_world(cell.parameters.nominal)
    assert_allclose(mirror[:3, 2], away, atol=1e-9)
    assert_allclose(chain.optical_axis(cell, cell.parameters.nominal), -away, atol=1e-9)
    assert_allclose(fibre[:3, 3], 300.0 * away, atol=1e-9)
    assert_allclose(mirror[:3, 0], fibre[:3, 0], atol=1e-9)
    length = path_length(cell, cell.parameters.nominal, np.zeros(len(cell.joints)))
    assert length == pytest.approx(300.0)
    # What is free moves the length or a direction: the two tilts of light and mirror each have a parameter.
    assert {"theta_et", "theta_wf", "z_et"} <= set(cell.free.names)
    assert ("beta_1" in cell.free.names) == (side[1] == "x") != ("beta_wf" in cell.free.names)


def test_the_papers_words_give_the_papers_angles(femto, tmp_path):
    cell = made("z y x rx rz ry", "+y", tmp_path, 920.0)
    assert cell.free.names == femto.free.names
    for q in ([0] * 6, [10, 20, 30, 0.05, -0.03, 1.0], [-50, 5, 70, -0.02, 0.08, -0.5]):
        expected = chain.mirror_pose(femto, femto.parameters.nominal, np.array(q, dtype=float))
        assert_allclose(chain.mirror_pose(cell, cell.parameters.nominal, np.array(q, dtype=float)), expected, atol=1e-9)


@pytest.mark.parametrize("side", SIDES)
def test_light_and_mirror_can_tilt_both_ways_on_every_side(side, tmp_path):
    """The four tilts of light and mirror against the robot, seen by their effect on the mirror plane and the light."""
    cell = made("x y z rx rz ry", side, tmp_path)
    vector, q = cell.parameters.nominal, np.zeros(6)
    columns = []
    for parameter in cell.free:
        steps = []
        for sign in (-1.0, 1.0):
            moved = vector.copy()
            moved[parameter.slot] += sign * 1e-6
            # Seen from the robot's base, so that a turn of the robot counts as one of the light.
            base = chain.link_transform(moved[:8], 0.0, True)[:3, :3]
            steps.append(base.T @ chain.optical_axis(cell, moved))
        columns.append((steps[1] - steps[0]) / 2e-6)
    assert np.linalg.matrix_rank(np.array(columns), tol=1e-3) == 2
    normals = []
    for parameter in cell.free:
        moved = vector.copy()
        moved[parameter.slot] += 1e-6
        normals.append((chain.mirror_pose(cell, moved, q) - chain.mirror_pose(cell, vector, q))[:3, 2] * 1e6)
    assert np.linalg.matrix_rank(np.array(normals), tol=1e-3) == 2


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("x y q", "axis 'q'"),
        ("x 5", "axis '5'"),
        ("--x", "axis '--x'"),
        ("", "0 axes"),
        ("x " * 13, "13 axes"),
        ("-r-x", "axis '-r-x'"),
    ],
)
def test_words_that_are_none(words, expected):
    with pytest.raises(InputError, match=expected):
        read_axes(words)


def test_words_are_read():
    assert read_axes("X, -y rz r-x -RY +z") == (
        AxisWord("prismatic", (1, 0, 0)),
        AxisWord("prismatic", (0, -1, 0)),
        AxisWord("revolute", (0, 0, 1)),
        AxisWord("revolute", (-1, 0, 0)),
        AxisWord("revolute", (0, -1, 0)),
        AxisWord("prismatic", (0, 0, 1)),
    )
    for word in ("q", "rx", "x y", ""):
        with pytest.raises(InputError, match="side"):
            read_side(word)
    assert_allclose(read_side("minus-y"), [0, -1, 0])


def test_a_table_of_modified_dh_parameters(femto, tmp_path):
    rows = ["kind,alpha_deg,a_um,theta_deg,d_um"]
    for i, joint in enumerate(femto.joints, 1):
        alpha, a, theta, d = (
            femto.parameters[f"{stem}_{i}"].shown(femto.parameters[f"{stem}_{i}"].nominal)
            for stem in ("alpha", "d", "theta", "r")
        )
        rows.append(f"{joint.kind},{alpha},{a},{theta},{d}")
    table, out = tmp_path / "dh.csv", tmp_path / "dh.toml"
    table.write_text("\n".join(rows) + "\n")
    assert main(["cell", "--from-dh", str(table), "-o", str(out), "--quiet"]) == 0
    cell = load_cell(out, mechanics="none")
    q = np.array([10, 20, 30, 0.05, -0.03, 1.0])
    expected = chain.mirror_pose(femto, femto.parameters.nominal, q)
    assert_allclose(chain.mirror_pose(cell, cell.parameters.nominal, q), expected, atol=1e-9)
    assert_allclose(chain.fibre_in_world(cell.parameters.nominal)[:3, 3], [0, 920, 0], atol=1e-9)


def test_a_skew_dh_table_still_faces_the_fibre(tmp_path):
    kinds = ("prismatic", "revolute", "revolute")
    links = np.array([[0, 10, 5, 20, 30], [3, -80, 100, 40, -20], [0, 70, 0, -15, 50]], dtype=float)
    layout = layout_of_links(kinds, links, read_side("+z"), 100.0)
    path = tmp_path / "skew.toml"
    path.write_text(new_cell_text(layout, "skew", wavelength_nm=1550.0))
    cell = load_cell(path, mechanics="none")
    seen = view_cell(cell).sight
    assert seen.length == pytest.approx(100.0, abs=1e-6)
    assert seen.tilt == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("alpha,a\n1,2\n", "row 1: expected the header kind,alpha_deg"),
        ("kind,alpha_deg,a_um,theta_deg,d_um\nhelical,0,0,0,0\n", "row 2, column kind: expected prismatic or revolute"),
        ("kind,alpha_deg,a_um,theta_deg,d_um\nr,0,x,0,0\n", "row 2, column a_um: expected a finite number"),
        ("kind,alpha_deg,a_um,theta_deg,d_um\nr,0,0\n", "row 2: expected 5 fields"),
        ("kind,alpha_deg,a_um,theta_deg,d_um\n", "expected a row for each joint"),
    ],
)
def test_tables_that_are_none(text, expected, tmp_path):
    path = tmp_path / "dh.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=expected):
        read_dh_table(path)


#: What cannot be right, and how the refusal begins and what it says to do.
REFUSED = [
    (changed(FEMTO, ("nominal_um = 920.0", "nominal_um = -920.0")), "key extrinsic.y_wf", "y_wf nominal_um = 920"),
    (changed(FEMTO, ("nominal_um = 920.0", "nominal_um = -920.0")), "key extrinsic.y_wf", "theta_wf nominal_deg = 180"),
    (changed(FEMTO, ("nominal_um = 920.0", "nominal_um = 0.0")), "key extrinsic.y_wf", "0 um behind"),
    (
        changed(FEMTO, ("beta_et = { nominal_deg = 0.0", "beta_et = { nominal_deg = 180.0")),
        "key extrinsic.beta_et: the mirror turns its back",
        "beta_et nominal_deg = 0",
    ),
    (
        changed(FEMTO, ("theta_wf = { nominal_deg = 0.0", "theta_wf = { nominal_deg = 180.0")),
        "key extrinsic.theta_wf: the mirror stands 920 um behind",
        "theta_wf nominal_deg = 0",
    ),
    (
        changed(FIVE, ("beta_et = { nominal_deg = -90.0", "beta_et = { nominal_deg = 0.0")),
        "key extrinsic.beta_et: the mirror stands 90 deg off the light",
        "beta_et nominal_deg = -90",
    ),
    (changed(FEMTO, ("wavelength_nm = 1560.0", "wavelength_nm = 1.56")), "key optics.wavelength_nm", "= 1560"),
    (changed(FEMTO, ("wavelength_nm = 1560.0", "wavelength_nm = 0.85")), "key optics.wavelength_nm", "= 850"),
    (
        changed(LAB7, ("[[joint]]                         # rotary about Yw\nkind = \"revolute\"\n",
                       "[[joint]]\nkind = \"revolute\"\nlimits_deg = [-45.0, 45.0]\n"),
                ("theta = { nominal_deg = 0.0, prior_sd_deg = 0.5 }\n\n[extrinsic]",
                 "theta = { nominal_deg = 90.0, prior_sd_deg = 0.5 }\n\n[extrinsic]")),
        "key joint 6.theta: tasks start with the mirror's x axis",
        "theta nominal_deg = 0",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("text", "key", "mend"), REFUSED)
def test_geometry_that_cannot_be_right(text, key, mend, tmp_path, capsys):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_cell(path, mechanics="none")
    assert str(caught.value).startswith(f"{path}: {key}")
    assert mend in str(caught.value)
    # It is shown all the same.
    assert main(["cell", str(path)]) == 2
    printed = capsys.readouterr()
    assert "q1" in printed.out
    assert mend in printed.err


@pytest.mark.parametrize(
    "text",
    [
        # The right ways to have the fibre on the other side, and what is unusual but can be.
        changed(
            FEMTO,
            ("nominal_um = 920.0", "nominal_um = -920.0"),
            ("theta_wf = { nominal_deg = 0.0", "theta_wf = { nominal_deg = 180.0"),
            ("beta_et = { nominal_deg = 0.0", "beta_et = { nominal_deg = 180.0"),
        ),
        changed(FEMTO, ('"minus-y"', '"z"')),
        # q6 turns without end, and so to any x axis.
        "theta = { nominal_deg = 90.0".join(FEMTO.rsplit("theta = { nominal_deg = 0.0", 1)),
        LAB7,
        FIVE,
    ],
)  # fmt: skip
def test_geometry_that_can_be(text, tmp_path):
    path = tmp_path / "good.toml"
    path.write_text(text)
    load_cell(path, mechanics="none")


def test_the_mend_of_a_refusal_mends(tmp_path):
    """Turn mirror and light by quarters in every way: what is refused says what makes it right."""
    path = tmp_path / "turned.toml"
    for beta, theta, side in itertools.product((0, 90, 180), (0, 180), (920, -920)):
        text = changed(
            FEMTO,
            ("beta_et = { nominal_deg = 0.0", f"beta_et = {{ nominal_deg = {beta}"),
            ("theta_wf = { nominal_deg = 0.0", f"theta_wf = {{ nominal_deg = {theta}"),
            ("nominal_um = 920.0", f"nominal_um = {side}"),
        )
        for _ in range(3):
            path.write_text(text)
            try:
                load_cell(path, mechanics="none")
                break
            except InputError as error:
                text = mended(text, str(error).split("otherwise")[0].split(", or light")[0].split("; or an axis")[0])
        load_cell(path, mechanics="none")


def mended(text: str, message: str) -> str:
    found = re.findall(r"(\w+) (nominal_\w+) = (-?[\d.]+)", message)
    assert found, message
    for name, key, value in found:
        text, count = re.subn(rf"(?m)^({name} = {{ {key} = )-?[\d.]+", rf"\g<1>{value}", text)
        assert count == 1
    return text


def test_what_is_seen_of_the_papers_cell(femto):
    view = view_cell(femto)
    assert [axis.words for axis in view.axes] == [
        "moves along +z", "moves along +y", "moves along +x", "turns about +x", "turns about +z", "turns about +y",
    ]  # fmt: skip
    assert view.sight.length == pytest.approx(920.0)
    assert view.reach.circle == pytest.approx(150.0, abs=0.1)
    assert (view.reach.tilt_x, view.reach.tilt_z) == pytest.approx((np.radians(5.0),) * 2, abs=1e-4)
    assert (view.refused, view.odd) == ("", ())


def test_a_cell_away_from_zero(femto):
    at = joints_at(femto, "q2=-20, q5=3")
    view = view_cell(femto, at)
    assert view.axes[5].words == "turns about +y, 3 deg off it towards -x"
    assert view.sight.tilt == pytest.approx(np.radians(3.0))
    assert any("3 deg off the light" in text for text in view.odd)
    assert any("q2 = -20 um, q5 = 3 deg" in line for line in cell_words(view))
    assert_allclose(joints_at(femto, "1,2,3,0,0,90"), [1, 2, 3, 0, 0, np.pi / 2])
    for text in ("1,2", "q9=1", "q1=x", "q1=1,5", "nan,0,0,0,0,0"):
        with pytest.raises(InputError, match="--at"):
            joints_at(femto, text)


def test_wrong_axes_are_seen(tmp_path):
    """The angles that a user of lab7 came to by hand: three quarter turns the other way."""
    second, third = "alpha = {{ nominal_deg = {}", "\ntheta = {{ nominal_deg = {}"
    joints = LAB7.split("[[joint]]")
    joints[2] = changed(joints[2], (third.format("90.0"), third.format("0.0")))
    joints[3] = changed(joints[3], (second.format("-90.0"), second.format("90.0")))
    joints[3] = changed(joints[3], (third.format("90.0"), third.format("-90.0")))
    joints[4] = changed(joints[4], (second.format("-90.0"), second.format("90.0")))
    joints[5] = changed(joints[5], (second.format("90.0"), second.format("-90.0")))
    joints[5] = changed(joints[5], (third.format("90.0"), third.format("-90.0")))
    text = "[[joint]]".join(joints)
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    view = view_cell(load_cell(path, check=False, mechanics="none"))
    assert "q1 and q3 both move along x" in view.odd
    assert "turns its back to the light" in view.refused


def test_directions_in_words():
    assert direction_words(np.array([0.0, 0.0, -1.0])) == "-z"
    assert direction_words(np.array([0.0, np.cos(0.1), -np.sin(0.1)])) == "+y, 5.73 deg off it towards -z"


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_the_command_writes_picture_and_json(suffix, tmp_path, capsys):
    figure, out = tmp_path / f"cell.{suffix}", tmp_path / "cell.json"
    assert main(["cell", str(DATA / "lab7.toml"), "--figure", str(figure), "--json", str(out)]) == 0
    content = json.loads(out.read_text())
    assert content["axes"][1]["words"] == "moves along +y"
    assert content["faces_the_light"] is True
    assert content["length_um"] == pytest.approx(60.0)
    assert figure.stat().st_size > 5_000
    if suffix == "svg":
        assert "<svg" in figure.read_text()[:1000]
    assert "[envelope]: nothing keeps the mirror off the fibre" in capsys.readouterr().out


def test_a_copy_of_a_cell_to_be_edited(tmp_path, capsys):
    out = tmp_path / "wider.toml"
    assert main(["cell", "femto-st", "-o", str(out)]) == 0
    assert "the mirror faces the light" in capsys.readouterr().out
    assert load_cell(out).sha256 == load_cell("femto-st").sha256
    assert main(["cell", "femto-st", "-o", str(out)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["cell", "femto-st", "--new", "x y", "-o", str(tmp_path / "b.toml")]) == 2
    assert "expected one of --new AXES, --from-dh TABLE and a CELL to copy" in capsys.readouterr().err
    assert main(["cell", "missing.toml", "-o", str(tmp_path / "b.toml")]) == 2
    assert not (tmp_path / "b.toml").exists()


def test_the_command_makes_a_cell(tmp_path, capsys):
    out = tmp_path / "lab8.toml"
    arguments = ["cell", "--new", "-x y z rx rz -ry", "--side", "minus-y", "--gap-um", "60", "-o", str(out)]
    assert main(arguments) == 0
    assert "q6 turns about -y, about the beam" in capsys.readouterr().out
    cell = load_cell(out, mechanics="none")
    assert cell.name == "lab8"
    # What exists is never overwritten: it may be filled in by now.
    assert main(arguments) == 2
    assert main(["cell", "--new", "x y", "--from-dh", "t.csv", "-o", str(tmp_path / "b.toml")]) == 2
    assert main(["cell", "-o", str(tmp_path / "b.toml")]) == 2
    assert main(["cell", "--new", "x y"]) == 2
    assert main(["cell", "--new", "x y", "-o", str(tmp_path / "b.toml"), "--name", 'a"b']) == 2
    assert not (tmp_path / "b.toml").exists()
