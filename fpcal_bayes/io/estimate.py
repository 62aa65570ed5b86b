"""Estimates from the JSON that ``fpcal identify``, ``track`` and ``sample`` write."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError, largest, located
from fpcal_bayes.core.files import CONTENT_HASH, content_sha256, read_text
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.sweeps import unpacked
from fpcal_bayes.io.validate import Tables, shown
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import SCHEMA, STATUSES, Estimate
from fpcal_bayes.model.mechanics.knowledge import MechanicsKnowledge, knowledge_of
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.trust import MECHANICS_LEFT_OUT, UNRECORDED, Trust, trust_of

#: Variances below this are no uncertainties.
_SMALLEST = 1e-100


def read_result(path: str | Path, cell: Cell, text: str | None = None) -> dict[str, Any]:
    """The content of a result file of a cell, or of its `text`; `InputError` if it is none or of another cell."""
    text = read_text(Path(path)) if text is None else text
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON file: {error}") from error
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        found = content.get("schema") if isinstance(content, dict) else type(content).__name__
        raise InputError(f"{path}: key schema: expected {SCHEMA!r}, found {found!r}")
    stated = content.get("cell")
    if not isinstance(stated, dict) or not {"name", "sha256"} <= stated.keys():
        raise InputError(f"{path}: key cell: expected the name and sha256 of the cell the estimate belongs to")
    if stated["sha256"] != cell.sha256:
        opd = f", opd {stated['opd']!r}" if "opd" in stated else ""
        raise InputError(
            f"{path}: key cell: the estimate is of another cell ({stated['name']!r}{opd}, "
            f"{str(stated['sha256'])[:12]}), expected {cell.name!r}, opd {cell.opd!r}, {cell.sha256[:12]}"
        )
    return content


def require_unchanged(path: str | Path, content: dict[str, Any]) -> None:
    """Raise `InputError` if the content of a result file is not what its hash says."""
    rest = {key: value for key, value in content.items() if key != CONTENT_HASH}
    if content.get(CONTENT_HASH) != content_sha256(rest):
        raise located(path, f"key {CONTENT_HASH}: the content is not what the program wrote, expected it unchanged")


def read_estimate(path: str | Path, cell: Cell, text: str | None = None) -> Estimate:
    """Read an estimate file, as ``identify --json`` writes it, or its `text`."""
    content = read_result(path, cell, text)
    if isinstance(content.get("fit"), dict) and content["fit"].get("converged") is False:
        what = f"{path}: key fit.converged: the fit did not converge, expected an estimate that can be trusted"
        raise InputError(what)
    found = _Reader(str(path), cell).estimate(content)
    if CONTENT_HASH not in content:
        return replace(found, trust=found.trust.because(UNRECORDED))
    require_unchanged(path, content)
    return found


def read_estimate_rows(path: str | Path, cell: Cell) -> Sweeps | None:
    """The sweeps that an estimate file, which `read_estimate` has accepted, was made from; None if it holds none."""
    text = json.loads(read_text(Path(path))).get("rows")
    if text is None:
        return None
    if not isinstance(text, str):
        raise InputError(f"{path}: key rows: expected the text that fpcal writes there")
    return unpacked(text, path, cell)


class _Reader(Tables):
    def __init__(self, path: str, cell: Cell) -> None:
        super().__init__(path, shown)
        self.cell = cell

    def estimate(self, content: dict[str, Any]) -> Estimate:
        stated = self.table(content, "", "parameters", "expected a table of parameters")
        if not stated:
            raise self.error("parameters", "expected a table of parameters")
        for name in stated:
            if name not in self.cell.parameters or self.cell.parameters[name].prior_sd == 0:
                raise self.error(f"parameters.{name}", f"cell {self.cell.name!r} has no such free parameter")
        parameters = ParameterSet(p for p in self.cell.parameters if p.name in stated)
        values, status = [], []
        for p in parameters:
            entry = stated[p.name]
            if not isinstance(entry, dict) or entry.get("unit") != p.unit:
                raise self.error(f"parameters.{p.name}.unit", f"expected {p.unit!r}")
            if entry.get("status") not in STATUSES:
                raise self.error(f"parameters.{p.name}.status", f"expected one of {', '.join(STATUSES)}")
            most = largest(p.unit)
            values.append(self.number(entry, f"parameters.{p.name}", "value", low=-most, high=most) * p.scale)
            status.append(entry["status"])
        covariance = self.covariance(content.get("covariance"), parameters, status)
        curve = np.zeros(len(parameters))
        for i, (p, variance) in enumerate(zip(parameters, np.diag(covariance).tolist(), strict=True)):
            curve[i] = p.scale * self.number(stated[p.name], f"parameters.{p.name}", "curve_sd", low=0.0, default=0.0)
            self.agree(stated[p.name], p.name, math.hypot(variance**0.5, curve[i]) / p.scale)
        known = self.mechanics(content.get("mechanics"), parameters)
        return Estimate(
            cell=self.cell,
            parameters=parameters,
            values=np.array(values),
            covariance=covariance,
            curve=curve,
            status=tuple(status),
            time_h=self.number(content, "", "time_h", default=0.0),
            valid_until_h=None if content.get("valid_until_h") is None else self.number(content, "", "valid_until_h"),
            data=content["data"] if isinstance(content.get("data"), dict) else {},
            trust=self.trust(content.get("trust"), known is not None),
            mechanics=known,
        )

    def agree(self, entry: dict[str, Any], name: str, sd: float) -> None:
        """What a file says twice must be the same: sd and covariance, value and mean."""
        most = largest("um")
        for key, other, what in (("sd", sd, "covariance.matrix"), ("mean", entry["value"], "value")):
            if key in entry:
                stated = self.number(entry, f"parameters.{name}", key, low=-most, high=most)
                if abs(stated - other) > 1e-6 * max(abs(stated), abs(other), sd):
                    text = f"{stated:g} and {what} ({other:g}) contradict each other"
                    raise self.error(f"parameters.{name}.{key}", text)

    def mechanics(self, stated: Any, parameters: ParameterSet) -> MechanicsKnowledge | None:
        """What is known of the error motions; nothing is asked of it where the mechanism is taken as perfect."""
        sizes = self.cell.mechanics
        if sizes is None or not isinstance(stated, dict) or not stated.get("names"):
            return None
        if stated.get("sizes_sha256") != sizes.sha256:
            what = "the cell states other sizes of error motions now: identify it anew"
            raise self.error("mechanics.sizes_sha256", what)
        try:
            return knowledge_of(stated, sizes, parameters, self.cell)
        except (KeyError, TypeError, ValueError) as error:
            raise self.error("mechanics", f"expected what fpcal writes there ({error})") from error

    def trust(self, stated: Any, knows: bool) -> Trust:
        try:
            found = trust_of(stated)
        except ValueError as error:
            raise self.error("trust", str(error)) from error
        return found if knows or self.cell.mechanics is None else found.because(MECHANICS_LEFT_OUT)

    def covariance(self, stated: Any, parameters: ParameterSet, status: Sequence[str]) -> Floats:
        if not isinstance(stated, dict) or not isinstance(stated.get("names"), list):
            raise self.error("covariance", "expected names and matrix")
        names = stated["names"]
        if len(set(map(str, names))) != len(names) or not all(name in parameters.names for name in names):
            raise self.error("covariance.names", "expected names of the parameters above, each once")
        held = {name for name, state in zip(parameters.names, status, strict=True) if state == "fixed"}
        for name in parameters.names:
            if name not in names and name not in held:
                raise self.error("covariance.names", f"expected every parameter that is not fixed, {name} is missing")
        try:
            matrix = np.array(stated.get("matrix"), dtype=float).reshape(len(names), len(names))
        except (TypeError, ValueError, OverflowError) as error:
            raise self.error("covariance.matrix", f"expected {len(names)} rows of {len(names)} numbers") from error
        small = np.abs(matrix).max(initial=0.0) <= largest("um") ** 2
        if not small or not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12):
            raise self.error("covariance.matrix", "expected a symmetric matrix of finite numbers")
        matrix = (matrix + matrix.T) / 2
        variances = np.diag(matrix)
        good = bool((variances >= _SMALLEST).all())
        if good:
            correlation = matrix / np.sqrt(np.outer(variances, variances))
            # Eigenvalues are asked for only where every entry can be a correlation.
            good = bool(np.abs(correlation).max(initial=0.0) <= 1 + 1e-6)
            good = good and bool(np.linalg.eigvalsh(correlation)[:1].min(initial=0.0) >= -1e-6)
        if not good:
            raise self.error("covariance.matrix", "expected a positive semidefinite matrix")
        full, chosen = np.zeros((len(parameters), len(parameters))), parameters.positions(names)
        scales = parameters.scales[chosen]
        full[np.ix_(chosen, chosen)] = matrix * np.outer(scales, scales)
        return full
