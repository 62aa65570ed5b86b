import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import write_json
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.truth import paper_truth
from fpcal_bayes.model.estimate import SCHEMA, Estimate
from fpcal_bayes.simulator.sweeps import simulate_um

CELL = load_cell(mechanics="none")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("estimate")


def make(**options: Any) -> dict[str, Any]:
    plan = paper_protocol(CELL, time_h=24.0)
    result = identify(CELL, simulate_um(CELL, paper_truth(CELL), plan, sigma=0.005, seed=1), **options)
    return {"schema": SCHEMA, "command": "identify", **result.content()}


@pytest.fixture(scope="module")
def content() -> dict[str, Any]:
    return make()


@pytest.fixture(scope="module")
def held() -> dict[str, Any]:
    return make(free="extrinsic", hold="exact")


def read(folder: Path, content: Any, text: bool = False) -> Estimate:
    path = folder / "estimate.json"
    path.write_text(content if text else json.dumps(content))
    return read_estimate(path, CELL)


def test_round_trip(folder, content):
    plan = paper_protocol(CELL, time_h=24.0)
    made = identify(CELL, simulate_um(CELL, paper_truth(CELL), plan, sigma=0.005, seed=1)).estimate
    write_json(folder / "estimate.json", content)
    again = read_estimate(folder / "estimate.json", CELL)
    assert again.parameters.names == made.parameters.names
    np.testing.assert_allclose(again.values, made.values, rtol=1e-14)
    np.testing.assert_allclose(again.covariance, made.covariance, rtol=1e-9, atol=1e-16)
    assert again.status == made.status
    assert again.time_h == 24.0
    assert again.valid_until_h is None
    # Once read, what is written stays the same to the last digit but one.
    for key, value in again.content()["parameters"].items():
        assert value["value"] == pytest.approx(content["parameters"][key]["value"], rel=1e-14)
        assert value["sd"] == pytest.approx(content["parameters"][key]["sd"], rel=1e-12)


def test_round_trip_of_exact_parameters_and_times(folder, held):
    held = {**held, "valid_until_h": 30, "data": {"file": "a.csv", "sha256": "0"}}
    again = read(folder, held)
    assert again.valid_until_h == 30.0
    assert again.data == {"file": "a.csv", "sha256": "0"}
    assert held["covariance"]["names"] == list(CELL.select("extrinsic").names)
    intrinsic = CELL.select("intrinsic").names
    assert (again.block(intrinsic)[1] == 0).all()
    assert (np.diag(again.block(CELL.select("extrinsic").names)[1]) > 0).all()
    assert {again.status[again.parameters.position(name)] for name in intrinsic} == {"fixed"}
    assert again.content()["covariance"]["names"] == held["covariance"]["names"]


def test_units_are_those_a_person_reads(content):
    made = content["parameters"]
    assert made["alpha_2"]["unit"] == "deg"
    assert made["alpha_2"]["value"] == pytest.approx(-90, abs=3)
    assert made["alpha_2"]["prior_sd"] == pytest.approx(1.0)
    assert made["x_wf"]["unit"] == "um"
    names, matrix = content["covariance"]["names"], np.array(content["covariance"]["matrix"])
    assert names == list(CELL.free.names)
    np.testing.assert_allclose(np.sqrt(np.diag(matrix)), [made[name]["sd"] for name in names], rtol=1e-12)
    np.testing.assert_array_equal(matrix, matrix.T)


def test_vector_holds_values_and_nominals(folder, content):
    estimate = read(folder, content)
    vector = estimate.vector()
    np.testing.assert_array_equal(vector[estimate.parameters.slots], estimate.values)
    others = np.setdiff1d(np.arange(len(vector)), estimate.parameters.slots)
    np.testing.assert_array_equal(vector[others], CELL.parameters.nominal[others])
    values, covariance = estimate.block(["z_et", "alpha_2"])
    assert values.tolist() == [estimate.values[estimate.parameters.position(n)] for n in ("z_et", "alpha_2")]
    assert covariance[0, 1] == covariance[1, 0] == estimate.covariance[0, estimate.parameters.position("z_et")]


def change(*path: Any, to: Any) -> Any:
    """A change of one value; `to` may be a function of the old one."""

    def apply(content: dict[str, Any]) -> None:
        at: Any = content
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = to(at[path[-1]]) if callable(to) else to

    return apply


def remove(*path: Any) -> Any:
    def apply(content: dict[str, Any]) -> None:
        at: Any = content
        for key in path[:-1]:
            at = at[key]
        del at[path[-1]]

    return apply


def not_semidefinite(matrix: list[list[float]]) -> list[list[float]]:
    matrix = copy.deepcopy(matrix)
    matrix[0][1] = matrix[1][0] = 2 * (matrix[0][0] * matrix[1][1]) ** 0.5
    return matrix


BAD = {
    "schema": (change("schema", to="fpcal/2"), "key schema: expected 'fpcal/1', found 'fpcal/2'"),
    "no schema": (remove("schema"), "key schema: expected 'fpcal/1', found None"),
    "no cell": (remove("cell"), "key cell: expected the name and sha256"),
    "cell without hash": (remove("cell", "sha256"), "key cell: expected the name and sha256"),
    "cell is text": (change("cell", to="femto-st"), "key cell: expected the name and sha256"),
    "another cell": (change("cell", "sha256", to="0" * 64), "key cell: the estimate is of another cell"),
    "not converged": (change("fit", "converged", to=False), "key fit.converged: the fit did not converge"),
    "no parameters": (change("parameters", to={}), "key parameters: expected a table of parameters"),
    "parameters is a list": (change("parameters", to=[1]), "key parameters: expected a table of parameters"),
    "unknown parameter": (
        change("parameters", to=lambda p: p | {"alpha_9": p["alpha_2"]}),
        "key parameters.alpha_9: cell 'femto-st' has no such free parameter",
    ),
    "parameter without prior": (
        change("parameters", to=lambda p: p | {"gain_1": p["alpha_2"] | {"unit": "ppm"}}),
        "key parameters.gain_1: cell 'femto-st' has no such free parameter",
    ),
    "parameter is a number": (change("parameters", "z_et", to=3.0), "key parameters.z_et.unit: expected 'um'"),
    "unit": (change("parameters", "z_et", "unit", to="nm"), "key parameters.z_et.unit: expected 'um'"),
    "no unit": (remove("parameters", "alpha_2", "unit"), "key parameters.alpha_2.unit: expected 'deg'"),
    "status": (
        change("parameters", "z_et", "status", to="known"),
        "key parameters.z_et.status: expected one of identified, weak, gauge, fixed",
    ),
    "status is a list": (change("parameters", "z_et", "status", to=[]), "key parameters.z_et.status: expected one of"),
    "value is text": (
        change("parameters", "z_et", "value", to="1"),
        "key parameters.z_et.value: expected a finite number",
    ),
    "value is true": (
        change("parameters", "z_et", "value", to=True),
        "key parameters.z_et.value: expected a finite number",
    ),
    "value is missing": (remove("parameters", "z_et", "value"), "key parameters.z_et.value: expected a finite number"),
    "value is NaN": (
        change("parameters", "z_et", "value", to=np.nan),
        "parameters.z_et.value: expected a finite number",
    ),
    "value is infinite": (change("parameters", "z_et", "value", to=-np.inf), "z_et.value: expected a finite number"),
    "value is a huge integer": (
        change("parameters", "z_et", "value", to=10**400),
        "z_et.value: expected a finite number",
    ),
    "time": (change("time_h", to="noon"), "key time_h: expected a finite number, found 'noon'"),
    "end of validity": (change("valid_until_h", to=[1]), "key valid_until_h: expected a finite number"),
    "no covariance": (remove("covariance"), "key covariance: expected names and matrix"),
    "no covariance names": (remove("covariance", "names"), "key covariance: expected names and matrix"),
    "repeated name": (
        change("covariance", "names", 1, to="alpha_2"),
        "key covariance.names: expected names of the parameters",
    ),
    "unknown name": (
        change("covariance", "names", 1, to="alpha_9"),
        "key covariance.names: expected names of the parameters",
    ),
    "name is a list": (
        change("covariance", "names", 1, to=["x"]),
        "key covariance.names: expected names of the parameters",
    ),
    "no matrix": (remove("covariance", "matrix"), "key covariance.matrix: expected 21 rows of 21 numbers"),
    "missing row": (remove("covariance", "matrix", 3), "key covariance.matrix: expected 21 rows of 21 numbers"),
    "short row": (remove("covariance", "matrix", 3, 0), "key covariance.matrix: expected 21 rows of 21 numbers"),
    "text in the matrix": (
        change("covariance", "matrix", 3, 0, to="a"),
        "covariance.matrix: expected 21 rows of 21 numbers",
    ),
    "table in the matrix": (
        change("covariance", "matrix", 3, 0, to={}),
        "covariance.matrix: expected 21 rows of 21 numbers",
    ),
    "huge integer in the matrix": (
        change("covariance", "matrix", 3, 3, to=10**400),
        "matrix: expected 21 rows of 21 numbers",
    ),
    "NaN in the matrix": (
        change("covariance", "matrix", 3, 3, to=np.nan),
        "matrix: expected a symmetric matrix of finite",
    ),
    "null in the matrix": (
        change("covariance", "matrix", 3, 3, to=None),
        "matrix: expected a symmetric matrix of finite",
    ),
    "huge variance": (change("covariance", "matrix", 3, 3, to=1e300), "matrix: expected a symmetric matrix of finite"),
    "not symmetric": (
        change("covariance", "matrix", 0, 1, to=lambda x: x + 0.1),
        "matrix: expected a symmetric matrix",
    ),
    "not semidefinite": (
        change("covariance", "matrix", to=not_semidefinite),
        "matrix: expected a positive semidefinite",
    ),
    "negative variance": (
        change("covariance", "matrix", 2, 2, to=lambda x: -x),
        "matrix: expected a positive semidefinite",
    ),
    "no variance": (change("covariance", "matrix", 2, 2, to=0.0), "matrix: expected a positive semidefinite"),
    "tiny variance": (change("covariance", "matrix", 2, 2, to=1e-300), "matrix: expected a positive semidefinite"),
    "identified without covariance": (
        change("covariance", to=lambda c: {"names": c["names"][1:], "matrix": [row[1:] for row in c["matrix"][1:]]}),
        "key covariance.names: expected every parameter that is not fixed, alpha_2 is missing",
    ),
}


@pytest.mark.parametrize(("apply", "message"), BAD.values(), ids=BAD.keys())
def test_a_bad_file_is_refused_in_one_line(folder, content, apply, message):
    changed = copy.deepcopy(content)
    apply(changed)
    with pytest.raises(InputError) as caught:
        read(folder, changed)
    text = str(caught.value)
    assert text.startswith(f"{folder / 'estimate.json'}: ")
    assert message in text
    assert len(text.splitlines()) == 1


BAD_TEXTS = {
    "truncated": (lambda text: text[: len(text) // 2], "not a JSON file"),
    "not JSON": (lambda _: "session,time_h\n1,2\n", "not a JSON file"),
    "a list": (lambda _: "[1, 2]", "key schema: expected 'fpcal/1', found 'list'"),
    "a number": (lambda _: "3", "key schema: expected 'fpcal/1', found 'int'"),
    "deeply nested": (lambda _: "[" * 200_000, "not a JSON file"),
    "a number of many digits": (
        lambda text: text.replace('"time_h": 24.0', f'"time_h": {"9" * 5000}'),
        "not a JSON file",
    ),
    "empty": (lambda _: "", "the file is empty"),
}


@pytest.mark.parametrize(("make_text", "message"), BAD_TEXTS.values(), ids=BAD_TEXTS.keys())
def test_a_file_that_is_no_estimate_is_refused_in_one_line(folder, content, make_text, message):
    with pytest.raises(InputError) as caught:
        read(folder, make_text(json.dumps(content)), text=True)
    assert message in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_other_path_model_is_another_cell(folder, content):
    path = folder / "axis.json"
    write_json(path, content)
    with pytest.raises(
        InputError, match=r"another cell \('femto-st', opd 'axis'.*expected 'femto-st', opd 'perpendicular'"
    ):
        read_estimate(path, CELL.with_opd("perpendicular"))


def test_missing_files_folders_and_binary_files_are_refused(folder):
    (folder / "binary.json").write_bytes(b"\x80\x81")
    for name, message in (("none.json", "no such file"), (".", "is a folder"), ("binary.json", "expected UTF-8 text")):
        with pytest.raises(InputError, match=message):
            read_estimate(folder / name, CELL)


#: What a mutation puts in place of a value.
VALUES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=True)
    | st.text(max_size=5)
    | st.sampled_from([10**400, -(10**400), 1e308, 5e-324, 1e160, "deg", "um", "fixed", "gauge", "alpha_2", "\ud800"])
    | st.lists(st.floats() | st.text(max_size=2), max_size=3)
    | st.dictionaries(
        st.sampled_from(["names", "matrix", "value", "unit"]), st.lists(st.none(), max_size=2), max_size=2
    )
)


@st.composite
def mutations(draw: st.DrawFn) -> list[tuple[list[int], str, Any]]:
    """Steps into the tree (taken modulo the number of children), what to do there, and with which value."""
    one = st.tuples(
        st.lists(st.integers(0, 500), min_size=1, max_size=5), st.sampled_from(["set", "delete", "double"]), VALUES
    )
    return draw(st.lists(one, min_size=1, max_size=3))


def mutate(tree: Any, steps: list[int], action: str, value: Any) -> None:
    for position, step in enumerate(steps):
        if not isinstance(tree, (dict, list)) or not tree:
            return
        key = list(tree)[step % len(tree)] if isinstance(tree, dict) else step % len(tree)
        if position == len(steps) - 1 or not isinstance(tree[key], (dict, list)):
            if action == "set":
                tree[key] = value
            elif action == "delete":
                del tree[key]
            elif isinstance(tree, list):
                tree.insert(key, tree[key])
            else:
                tree[f"{key}_"] = tree[key]
            return
        tree = tree[key]


def attempt(path: Path, content: bytes) -> Estimate | None:
    """What is read of a file, or None if it is refused as it should be."""
    path.write_bytes(content)
    try:
        return read_estimate(path, CELL)
    except InputError as error:
        message = str(error)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return None


@settings(max_examples=200, deadline=None)
@given(changes=mutations(), exact=st.booleans())
def test_whatever_stands_in_the_file_only_input_errors_leave(folder, content, held, changes, exact):
    changed = copy.deepcopy(held if exact else content)
    for steps, action, value in changes:
        mutate(changed, steps, action, value)
    estimate = attempt(folder / "mutated.json", json.dumps(changed).encode())
    if estimate is None:
        return
    # What is accepted can be used and written.
    assert np.isfinite(estimate.values).all()
    assert np.isfinite(estimate.sd).all()
    json.dumps(estimate.content()["covariance"], allow_nan=False)


@settings(max_examples=200, deadline=None)
@given(share=st.floats(0, 1), piece=st.binary(min_size=1, max_size=4))
def test_damaged_bytes(folder, content, share, piece):
    data = json.dumps(content).encode()
    at = int(share * len(data))
    attempt(folder / "bytes.json", data[:at] + piece + data[at + len(piece) :])


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c["parameters"]["z_wf"].update(sd=2 * c["parameters"]["z_wf"]["sd"]), "parameters.z_wf.sd: "),
        (lambda c: c["covariance"]["names"].reverse(), "contradict each other"),
        (lambda c: c["parameters"]["z_wf"].update(mean=c["parameters"]["z_wf"]["value"] + 5.0), "parameters.z_wf.mean"),
        (
            lambda c: c["parameters"]["z_wf"].update(value=1e150),
            "parameters.z_wf.value: expected a number from -1e[+]07",
        ),
        (lambda c: c.update(time_h=1.7e9), "key time_h: expected a number from -1e[+]06"),
    ],
)
def test_what_is_said_twice_must_agree(folder, content, edit, message):
    changed = copy.deepcopy(content)
    edit(changed)
    with pytest.raises(InputError, match=message):
        read(folder, changed)


def test_a_file_without_its_hash_is_said(folder, content):
    assert [reason.kind for reason in read(folder, content).trust.reasons] == ["second-solution", "unrecorded"]
    write_json(folder / "estimate.json", content)
    assert [reason.kind for reason in read_estimate(folder / "estimate.json", CELL).trust.reasons] == [
        "second-solution"
    ]
