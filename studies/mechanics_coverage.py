"""Do the bands hold on a machine? Simulated machines of another family than the fit's, fitted, and driven along tasks.

python studies/mechanics_coverage.py [--mixture realistic ...] [--protocol mid ...] [--truths 40]

For each mixture and protocol: share of true peak-to-peak errors inside their 95 % band (and at or below its upper end),
share of path points inside, predicted median over the true one, and how many fits are called "not to be trusted".
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from fpcal_bayes import InputError
from fpcal_bayes.infer import (
    FREEDOMS,
    LOG_SD,
    LOG_SD_NOISE,
    PATH_POINTS,
    MechanicsFit,
    Problem,
    RowNoise,
    covariance_of,
    doubts_of,
    fit_mechanics,
    knowledge_of_fit,
    predict_from_covariance,
)
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps, drive_of_sweeps, join, protocol_by_name
from fpcal_bayes.model import CavityModel, Cell, Estimate, JointMechanics, Mechanics, Terms, chain, design
from fpcal_bayes.motion import TASKS, Task, task_path
from fpcal_bayes.simulator import Machine, MachineSettings

_SIGMA = 0.005

_STAGE = JointMechanics(
    straightness_nm=30, pitch_urad=2, yaw_urad=2, roll_urad=2, linearity=45, reversal=10, return_sd=2, encoder=2
)
_GONIOMETER = JointMechanics(
    radial_runout_nm=100, axial_runout_nm=100, wobble_urad=15, linearity=26, reversal=1, return_sd=1, encoder=0.5
)
_ROTARY = JointMechanics(
    radial_runout_nm=100, axial_runout_nm=100, wobble_urad=8, linearity=8, reversal=1, return_sd=1, encoder=0.5
)


def _mechanics(stage: JointMechanics, goniometer: JointMechanics, rotary: JointMechanics, drift: float) -> Mechanics:
    return Mechanics((stage, stage, stage, goniometer, goniometer, rotary), drift_nm_per_min=drift)


REALISTIC = _mechanics(_STAGE, _GONIOMETER, _ROTARY, 3.0)
_NOTHING = JointMechanics()
_ZERO = _mechanics(_NOTHING, _NOTHING, _NOTHING, 0.0)
_NOISE = MachineSettings(student=3.0, slow_nm=4.0, mirror_radius_m=50.0, scale_ppm=5.0)


def _single(drift: float = 0.0, **joints: dict[str, float]) -> Mechanics:
    kinds = ("stage", "goniometer", "rotary")
    parts = [JointMechanics(**joints.get(kind, {})) for kind in kinds]  # type: ignore[arg-type]
    return _mechanics(parts[0], parts[1], parts[2], drift)


#: What a machine is (sizes and noise), and by how much the sheet of the fit differs from it.
MIXTURES: dict[str, tuple[Mechanics, MachineSettings, float]] = {
    "gentle": (REALISTIC.scaled(1 / 3), replace(_NOISE, slow_nm=1.3), 1.0),
    "realistic": (REALISTIC, _NOISE, 1.0),
    "built-in": (load_cell().mechanics or _ZERO, _NOISE, 1.0),
    "rough": (REALISTIC.scaled(3.0), replace(_NOISE, slow_nm=8.0), 1.0),
    "sheet-3-small": (REALISTIC, _NOISE, 1 / 3),
    "sheet-3-large": (REALISTIC, _NOISE, 3.0),
    "ideal": (_ZERO, MachineSettings(), 0.0),
    "straightness": (_single(stage={"straightness_nm": 20}), MachineSettings(), 0.0),
    "pitch-yaw": (_single(stage={"pitch_urad": 5, "yaw_urad": 5, "lever_mm": (0, 0, 80)}), MachineSettings(), 0.0),
    "wobble": (_single(goniometer={"wobble_urad": 50}, rotary={"wobble_urad": 20}), MachineSettings(), 0.0),
    "eccentricity": (_single(goniometer={"radial_runout_nm": 100}), MachineSettings(), 0.0),
    "runout": (_single(rotary={"radial_runout_nm": 100, "axial_runout_nm": 100}), MachineSettings(), 0.0),
    "encoder": (
        _single(stage={"encoder": 10}, goniometer={"encoder": 3}, rotary={"encoder": 3}),
        MachineSettings(),
        0.0,
    ),
    "reversal": (
        _single(stage={"reversal": 10}, goniometer={"reversal": 1}, rotary={"reversal": 1}),
        MachineSettings(),
        0.0,
    ),
    "return": (
        _single(stage={"return_sd": 2}, goniometer={"return_sd": 1}, rotary={"return_sd": 1}),
        MachineSettings(),
        0.0,
    ),
    "drift": (_single(drift=20.0), MachineSettings(), 0.0),
    "slow": (_ZERO, MachineSettings(slow_nm=4.0, student=3.0), 0.0),
}
#: Mixtures without a sheet of their own are fitted with the realistic one (with 80 mm levers where they matter).
_LEVER = (0.0, 0.0, 80.0)


def sheet_of(name: str) -> Mechanics:
    machine, _, factor = MIXTURES[name]
    if factor:
        return machine.scaled(factor)
    if name == "pitch-yaw":
        joints = [replace(j, lever_mm=_LEVER) if i < 3 else j for i, j in enumerate(REALISTIC.joints)]
        return replace(REALISTIC, joints=tuple(joints))
    return REALISTIC


def protocol(cell: Cell, name: str) -> Sweeps:
    if name == "ends":
        return protocol_by_name("paper", cell)
    if name == "mid":
        return protocol_by_name("paper-mid", cell)
    whole = protocol_by_name("paper", cell)
    parts = []
    for i in range(len(whole)):
        one = whole.take(np.array([i] * 4))
        share = np.arange(1, 5)[:, None] / 4
        ends = one.q_start + share * (one.q_end - one.q_start)
        parts.append(
            replace(one, q_end=ends, group=one.label, label=np.array([f"{one.label[0]}-{k}" for k in range(4)]))
        )
    return join(parts)


def reachable(cell: Cell, rng: np.random.Generator) -> np.ndarray:
    """A geometry from the prior with which every task can be driven."""
    while True:
        vector = cell.parameters.nominal.copy()
        vector[cell.free.slots] += rng.standard_normal(len(cell.free)) * cell.free.prior_sd
        try:
            task_path(cell, vector, "spin", n_points=3)
        except InputError:
            continue
        return vector


def one_truth(cell: Cell, name: str, plan: Sweeps, seed: int) -> dict[str, object]:
    machine_sizes, settings, _ = MIXTURES[name]
    sheet = sheet_of(name)
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    free, model = cell.free, CavityModel.of(cell)
    vector = reachable(cell, rng)
    machine = Machine.draw(cell, machine_sizes, vector, rng, settings)
    drive = drive_of_sweeps(plan, sheet.minutes_per_sweep)
    measured = plan.with_measurement(machine.sweep(drive, _SIGMA), _SIGMA)
    began = time.process_time()
    fit = fit_mechanics(Problem.of(model, measured), sheet, seed=seed)
    _ = fit.draws
    seconds = time.process_time() - began
    mean, covariance = fit.moments()
    truth = fit.problem.unknowns(vector[free.slots])
    result: dict[str, object] = {
        "seconds": seconds,
        "effective": fit.scales.effective,
        "converged": fit.solution.converged,
        "z": ((truth - mean) / np.sqrt(np.diag(covariance))).tolist(),
        "scales": dict(zip(fit.scales.names, fit.scales.quantiles()[1].tolist(), strict=True)),
        "doubts": [doubt.kind for doubt in doubts_of(fit)],
    }
    for task_name in TASKS:
        try:
            task = task_path(cell, model.vector(fit.values), task_name, n_points=PATH_POINTS).driven()
        except InputError:
            # The truth can be aligned, the estimate of it by a little not.
            continue
        when = float(rng.choice([0.0, 1.0])) * float(drive.end_min.max())
        rows = model.rows(np.repeat(task.start[None], len(task), axis=0), task.q)
        error = machine.path(task.start, task.q, when) - model.predict(fit.values, rows)
        estimate = handed_on(fit, cell)
        drawn = predict_from_covariance(estimate, replace(task, cell=estimate.cell), seed=seed)
        low, high = drawn.peak_to_peak_band()
        edges = drawn.band()
        width = np.ptp(error)
        result[task_name] = {
            "true": 1e3 * width,
            "low": 1e3 * low,
            "high": 1e3 * high,
            "median": 1e3 * float(np.median(drawn.peak_to_peak)),
            "points": float(((error >= edges[0]) & (error <= edges[1])).mean()),
            "freedoms": freedoms(estimate, machine, task, when, seed),
        }
    return result


def true_poses(machine: Machine, start: np.ndarray, q: np.ndarray, minutes: float) -> np.ndarray:
    """Poses fX of the mirror frame along a path that is driven point by point, shape (1 + n_points, 4, 4)."""
    joints = np.vstack([start, q])
    side = machine.rng.choice([-1.0, 1.0], len(start))
    tools = np.tile(np.eye(4), (len(joints), 1, 1))
    tools[:, :3, :3], at = machine.tools(joints, machine.reach(joints, side))
    tools[:, :3, 3] = at - machine.drift * minutes
    back = np.linalg.inv(chain.fibre_in_world(machine.vector))
    return back @ tools @ chain.mirror_in_tool(machine.cell, machine.vector)


def handed_on(fit: MechanicsFit, cell: Cell) -> Estimate:
    """What an estimate file would say of a fit."""
    free = cell.free
    return Estimate(
        replace(cell, mechanics=fit.terms.sizes), free, fit.values, covariance_of(fit), ("identified",) * len(free),
        mechanics=knowledge_of_fit(fit, free, free.names),
    )  # fmt: skip


def freedoms(estimate: Estimate, machine: Machine, task: Task, when: float, seed: int) -> dict[str, tuple[float, ...]]:
    """True peak to peak of each degree of freedom but the beam's, and its band, by 4 x 4 products, in um and rad."""
    cell = machine.cell
    vector, joints = estimate.vector(), np.vstack([task.start, task.q])
    expected = [np.linalg.inv(chain.fibre_in_world(vector)) @ chain.mirror_pose(cell, vector, q) for q in joints]
    moves, turned = [], []
    for owner, poses in ((vector, np.array(expected)), (machine.vector, true_poses(machine, task.start, task.q, when))):
        _, point = chain.reflection_point(cell, owner, np.zeros(len(task.start)))
        places = poses[:, :3, :3] @ point + poses[:, :3, 3]
        moves.append((places - places[0])[1:, [0, 2]])
        turned.append(poses[1:, :3, :3] @ poses[0, :3, :3].T)
    if np.abs(moves[0]).max() > 1.0:
        # One turn about the beam brings all moves nearest to those expected (Kabsch).
        left, _, right = np.linalg.svd(moves[1].T @ moves[0])
        moves[1] = moves[1] @ left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
    off = np.hstack([moves[1] - moves[0], Rotation.from_matrix(turned[1] @ turned[0].swapaxes(1, 2)).as_rotvec()])
    drawn = predict_from_covariance(estimate, replace(task, cell=estimate.cell), draws=2000, seed=seed).pose
    return {
        name: (float(np.ptp(off[:, k])), *np.quantile(np.ptp(drawn.of(name), axis=1), [0.025, 0.975]).tolist())
        for k, name in enumerate(FREEDOMS)
    }


def summary(results: list[dict[str, object]]) -> str:
    lines, inside, below, points, ratio = [], [], [], [], []
    for name in TASKS:
        part: list[dict[str, float]] = [r[name] for r in results if name in r]  # type: ignore[misc]
        true = np.array([p["true"] for p in part])
        low, high = np.array([p["low"] for p in part]), np.array([p["high"] for p in part])
        median = np.array([p["median"] for p in part])
        inside.append(((true >= low) & (true <= high)).mean())
        below.append((true <= high).mean())
        points.append(np.mean([p["points"] for p in part]))
        ratio.append(np.median(median) / np.median(true))
        lines.append(
            f"{name} {100 * inside[-1]:.0f}/{100 * below[-1]:.0f}/{100 * points[-1]:.0f} {ratio[-1]:.2f} "
            f"({np.median(true):.0f} nm)"
        )
    for name in TASKS:
        for freedom in FREEDOMS:
            true, low, high = np.array([r[name]["freedoms"][freedom] for r in results if name in r]).T  # type: ignore[index]
            scale = 1e3 if freedom in "xz" else np.degrees(1.0)
            held, under = 100 * ((true >= low) & (true <= high)).mean(), 100 * (true <= high).mean()
            lines.append(
                f"{name} {freedom} {held:.0f}/{under:.0f} "
                f"({scale * np.median(true):.2g} in {scale * np.median(low):.2g} .. {scale * np.median(high):.2g})"
            )
    z = np.array([r["z"] for r in results])
    pooled = np.sqrt(np.mean(z**2))
    doubtful = np.mean([bool(r["doubts"]) for r in results])
    seconds = np.median([r["seconds"] for r in results])  # type: ignore[type-var]
    return (
        f"inside {100 * np.mean(inside):.0f} (least {100 * min(inside):.0f}), below upper {100 * np.mean(below):.0f}, "
        f"points {100 * np.mean(points):.0f} (least {100 * min(points):.0f}), "
        f"ratio {min(ratio):.2f}..{max(ratio):.2f}, "
        f"rms z {pooled:.2f}, doubtful {100 * doubtful:.0f} %, {seconds:.2f} s; " + "; ".join(lines)
    )


def own_prior(cell: Cell, plan: Sweeps, seed: int) -> np.ndarray:
    """Scores of a truth from the fit's own prior, weights and scales included, under its fit: z and rank, (2, n)."""
    rng, free, model, sheet = np.random.default_rng([seed, 77]), cell.free, CavityModel.of(cell), REALISTIC
    scores = rng.standard_normal(len(free))
    values = free.nominal + scores * free.prior_sd
    terms, drive = Terms.of(cell, sheet, free.names), drive_of_sweeps(plan, sheet.minutes_per_sweep)
    made = design(terms, model.vector(values), drive, np.full(len(plan), _SIGMA))
    log = rng.standard_normal(len(terms.scales)) * LOG_SD
    log[-1] *= LOG_SD_NOISE / LOG_SD
    factors = np.exp(log)
    measured = plan.with_measurement(np.zeros(len(plan)), _SIGMA)
    error = RowNoise.of(measured, made).draw(factors[-1:], factors[-2:-1], rng)[0]
    shown = made.matrix @ (factors[made.scale] * rng.standard_normal(made.matrix.shape[1]))
    dl = model.predict(values, model.rows(plan.q_start, plan.q_end, plan.absolute)) + shown + error
    fit = fit_mechanics(Problem.of(model, plan.with_measurement(dl, _SIGMA)), sheet, seed=seed)
    mean, covariance = fit.moments()
    rank = (fit.draws.scores < scores).mean(axis=0)
    return np.array([(scores - mean) / np.sqrt(np.diag(covariance)), rank])


def judge_own_prior(cell: Cell, plan: Sweeps, truths: int) -> str:
    found = np.array([own_prior(cell, plan, seed) for seed in range(truths)])
    rms = np.sqrt((found[:, 0] ** 2).mean(axis=0))
    p_values = [stats.kstest(column, "uniform").pvalue for column in found[:, 1].T]
    worst = int(np.argmin(p_values))
    return (
        f"own prior, {truths} draws: rms z {rms.min():.2f} ({cell.free.names[rms.argmin()]}) to {rms.max():.2f} "
        f"({cell.free.names[rms.argmax()]}); ranks: least p {min(p_values):.2g} ({cell.free.names[worst]})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mixture", nargs="*", default=["gentle", "realistic", "rough"], choices=sorted(MIXTURES))
    parser.add_argument("--protocol", nargs="*", default=["ends", "mid", "four"], choices=("ends", "mid", "four"))
    parser.add_argument("--truths", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed of the first truth")
    parser.add_argument("--own-prior", action="store_true", help="truths from the fit's own prior instead")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    cell, everything = load_cell(mechanics="none"), {}
    if options.own_prior:
        for name in options.protocol:
            print(name, judge_own_prior(cell, protocol(cell, name), options.truths), flush=True)
        return
    for mixture in options.mixture:
        for name in options.protocol:
            plan = protocol(cell, name)
            seeds = range(options.first, options.first + options.truths)
            results = [one_truth(cell, mixture, plan, seed) for seed in seeds]
            everything[f"{mixture} {name}"] = results
            print(f"{mixture} {name}: {summary(results)}", flush=True)
            if options.json:
                options.json.write_text(json.dumps(everything))


if __name__ == "__main__":
    main()
