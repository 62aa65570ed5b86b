"""A calibration verified: whether it foresees fresh sweeps, and whether these would have shown an error."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import linalg

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import chi2_tail
from fpcal_bayes.core.typing import Bools, Floats
from fpcal_bayes.infer.design.candidates import tilts
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.tasks.prediction import predict_from_covariance
from fpcal_bayes.infer.tasks.source import path_points
from fpcal_bayes.infer.verification.expected import Expected
from fpcal_bayes.infer.verification.power import LEVEL, effects_of
from fpcal_bayes.io.estimate import read_result, require_unchanged
from fpcal_bayes.measure.sharing import sweep_numbers
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.trust import Reason
from fpcal_bayes.motion.compensation import compensated
from fpcal_bayes.motion.tasks import Task, find_task, possible_tasks

Outcome = Literal["PASS", "FAIL", "NOT EVALUATED"]

#: With less power than this a task is not evaluated, however well the sweeps are met.
LEAST_POWER = 0.5
_INSIDE = 1.959964
#: Joints that tasks drive by more than this share of their way beyond what was tried are named.
_BEYOND = 0.05
#: No session lasts longer, in h: rows that are held out may be its last.
_SESSION_H = 24.0


@dataclass(frozen=True)
class Verification:
    """What fresh sweeps say of a calibration."""

    n_rows: int
    score: float  # by how much the sum of squares of data and prior rises when the fresh rows join
    p_value: float  # probability of a larger score if the calibration is right
    coverage: float  # share of the fresh rows inside their 95 % bands
    kinds: dict[str, tuple[int, float]]  # by the joints that move: rows, and the probability of a larger score of these
    power: dict[str, dict[str, float]]  # by task and kind of error: probability of finding one that is worth it
    scope: tuple[str, ...]  # sentences: for what it holds

    @property
    def failed(self) -> bool:
        """Whether the fresh rows contradict the calibration."""
        return self.p_value < LEVEL

    def least_power(self, task: str) -> tuple[str, float]:
        """The kind of error that is found least likely, and how likely; of a task that no kind can bring out, 1."""
        return min(self.power[task].items(), key=lambda item: item[1], default=("any", 1.0))

    def outcome(self, task: str) -> Outcome:
        """What holds for a task."""
        if self.failed:
            return "FAIL"
        return "PASS" if self.least_power(task)[1] >= LEAST_POWER else "NOT EVALUATED"

    @property
    def verdict(self) -> Outcome:
        """What holds for all of the tasks."""
        found: set[Outcome] = {self.outcome(task) for task in self.power}
        return "FAIL" if self.failed else "PASS" if found == {"PASS"} else "NOT EVALUATED"

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What is to be held against the calibration."""
        if not self.failed:
            return ()
        worst = min(self.kinds, key=lambda kind: self.kinds[kind][1])
        text = (
            f"verification failed: sweeps that were not fitted are off by more than the calibration allows (p = "
            f"{self.p_value:.1g}), those of {worst} most; measure them again, then calibrate anew: fpcal doctor tries "
            "what may be wrong"
        )
        return (Reason("verification", text),)

    def content(self) -> dict[str, Any]:
        """The JSON content."""
        return {
            "verdict": self.verdict,
            "level": LEVEL,
            "n_rows": self.n_rows,
            "score": self.score,
            "p_value": self.p_value,
            "coverage_95": self.coverage,
            "kinds": {kind: {"n_rows": n, "p_value": p} for kind, (n, p) in self.kinds.items()},
            "tasks": {task: {"verdict": self.outcome(task), "power": self.power[task]} for task in self.power},
            "scope": list(self.scope),
        }


def read_verification(path: str | Path, calibration: Estimate) -> Verification:
    """The verification of a calibration in a result file; `InputError` if there is none, or of another session."""
    content = read_result(path, calibration.cell)
    require_unchanged(path, content)
    made = content.get("verification")
    if made is None:
        raise InputError(f"{path}: key verification: expected a result of fpcal verify, or fpcal identify --hold-out")
    session, at = content.get("data", {}).get("session"), content.get("time_h", np.nan)
    own = calibration.data.get("session")
    if session != own or not abs(at - calibration.time_h) <= _SESSION_H:
        raise InputError(
            f"{path}: verifies the calibration of session {session!r} at {at:g} h, expected that of {own!r} at "
            f"{calibration.time_h:g} h"
        )
    kinds = {kind: (each["n_rows"], each["p_value"]) for kind, each in made["kinds"].items()}
    power = {task: each["power"] for task, each in made["tasks"].items()}
    rows, coverage = made["n_rows"], made["coverage_95"]
    return Verification(rows, made["score"], made["p_value"], coverage, kinds, power, tuple(made["scope"]))


def verify(
    found: Identification,
    sweeps: Sweeps,
    fitted: Bools,
    *,
    drift: Floats | None = None,
    tasks: Sequence[str] | None = None,
    tolerance: float = 0.05,
    radius: float | None = None,
    seed: int = 0,
) -> Verification:
    """Hold a calibration against sweeps that it was not made from.

    Parameters
    ----------
    found
        The calibration.
    sweeps, fitted
        All rows, and which of them it was made from, shape (n,); the others verify it.
    drift
        Square root (n_free, n_drift), in um and rad, of the covariance by which the geometry drifted until these.
    tasks, tolerance, radius
        Whose error is worth finding: by default all that the cell can do, from 0.05 um peak to peak.

    Raises
    ------
    InputError
        If no row is left to verify with.
    """
    if fitted.all():
        raise InputError(f"{sweeps.file}: no row is left to verify with")
    expected = Expected.of(found, sweeps, fitted, drift)
    # What is not to be used promises nothing of a task; fresh rows may still contradict it.
    paths = worthwhile(found.estimate, tasks, tolerance, radius) if found.estimate.trust.usable else []
    effects = effects_of(expected, paths, seed=seed)
    score = expected.score()
    covariance, innovation, fresh = expected.covariance, expected.innovation, sweeps.take(~fitted)
    moving = np.array(["+".join(f"q{i + 1}" for i in np.flatnonzero(m)) for m in fresh.q_start != fresh.q_end])
    moving[fresh.absolute] = "absolute"
    kinds = {}
    for kind in dict.fromkeys(moving.tolist()):
        rows = np.flatnonzero(moving == kind)
        own = innovation[rows] @ linalg.solve(covariance[np.ix_(rows, rows)], innovation[rows], assume_a="pos")
        kinds[kind] = (len(rows), chi2_tail(float(own), len(rows)))
    coverage = float((np.abs(innovation) < _INSIDE * np.sqrt(np.diag(covariance))).mean())
    power, scope = {name: each.power(covariance) for name, each in effects.items()}, _scope(found, fresh, paths)
    return Verification(len(fresh), score, expected.p_value(score, seed=seed), coverage, kinds, power, scope)


def kept_rows(sweeps: Sweeps, share: float) -> Bools:
    """Rows that stay when a share of the sweeps verifies the calibration, (n,); `InputError` if none is left out."""
    # Whole sweeps are left out, spread over the session, of each set of moving joints; one at least of each stays.
    number = sweep_numbers(sweeps)
    first = np.unique(number, return_index=True)[1]
    moved = (sweeps.q_start != sweeps.q_end)[first]
    out: list[int] = []
    for kind in np.unique(moved, axis=0):
        own = np.flatnonzero((moved == kind).all(axis=1) & (sweeps.kind[first] == "sweep"))
        count = min(round(share * len(own)), len(own) - 1)
        out += own[np.linspace(0, len(own) - 1, count + 2)[1:-1].round().astype(np.int64)].tolist() if count > 0 else []
    if not out:
        raise InputError(f"{sweeps.file}: {share:g} of the sweeps of each joint is none, expected a larger share")
    return ~np.isin(number, out)


def worthwhile(
    estimate: Estimate, tasks: Sequence[str] | None, tolerance: float, radius: float | None
) -> list[tuple[Task, float, float]]:
    """Paths of tasks, by default of all that can be driven, each with its tolerance and the upper edge of its band."""
    cell, found = estimate.cell, []
    own = {task.name: task.tolerances for task in cell.tasks}
    for name in possible_tasks(cell) if tasks is None else tasks:
        task = find_task(cell, estimate.vector(), name, radius=radius, n_points=path_points(estimate))
        if tasks is not None or task.ok.any():
            task = compensated(estimate, task).driven()
            edge = predict_from_covariance(estimate, task, draws=2000).peak_to_peak_band()[1]
            found.append((task, own.get(name, {}).get("beam", tolerance), float(edge)))
    return found


def _scope(found: Identification, fresh: Sweeps, paths: Sequence[tuple[Task, float, float]]) -> tuple[str, ...]:
    """Sentences: up to which tilt it holds, and where tasks go that no sweep has tried."""
    cell: Cell = found.estimate.cell
    poses = np.vstack([fresh.q_start[~fresh.absolute], fresh.q_end])
    tilt = np.degrees(tilts(found.problem.model, found.problem.values(found.solution.unknowns), poses).max())
    said = [f"it holds for tilts of the mirror up to {tilt:.1f} deg"]
    for i, column in enumerate(cell.joint_columns):
        unit = column.rpartition("_")[2]
        low, high = poses[:, i].min(), poses[:, i].max()
        driven = np.concatenate([poses[:1, i], *(task.q[:, i] for task, *_ in paths)])
        beyond = _BEYOND * max(float(np.ptp(driven)), 1e-9)
        if driven.min() < low - beyond or driven.max() > high + beyond:
            ends = np.array([low, high, driven.min(), driven.max()]) / cell.joint_scales[i]
            said.append(
                f"q{i + 1} beyond {ends[0]:.4g} to {ends[1]:.4g} {unit} was not tried; tasks drive it from "
                f"{ends[2]:.4g} to {ends[3]:.4g} {unit}"
            )
    return tuple(said)
