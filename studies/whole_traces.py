"""What do whole traces tell beyond end points and midpoints, and how few sweeps do they need?

The paper's 69 sweeps and 12 planned ones, truths drawn from the prior. End points and midpoints are readings of length,
with 5 nm each or with what a single sample of the simulated photodiode knows at half fringe height; whole traces are
its 2,000 samples of each sweep, with the scans that tell signs. Printed for each: standard deviations, and the mean
square of the standardised errors, which is one where they hold, with its standard error by the spread over truths: the
errors of one calibration go together, so that its 21 squares are worth about eight.

    python studies/whole_traces.py [--replicates 10] [--only "69, whole traces"] [--log FILE]
    python studies/whole_traces.py --fast --replicates 2000
    python studies/whole_traces.py --mechanics [--fast [--drawn]] --only "69, whole traces" --replicates 200

`--fast` reads the same light of the 69 sweeps in an eighth of the time: no scans, no search and no counts of fringes;
each trace is fitted from its true course on, with the nuisances and the noise of the product, and the parameters from
their true values on. It agrees with the whole way to a few hundredths of a standard deviation. With
`--mechanics` traces are read at their middle and end, the way of each mirror searched for, which takes 15 s a truth;
`--fast` then takes such readings as they are, with the noise that they state. The machines have the sizes that the cell
states; with `--drawn` sizes and noise are drawn as the fit expects them, a factor of three about what is stated.
"""

import argparse
import contextlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from numpy.polynomial import legendre

from fpcal_bayes import InputError, plan
from fpcal_bayes.analysis import trace_rows
from fpcal_bayes.fringes import (
    CALM,
    DisplacementProfile,
    Nuisance,
    fading_priors,
    fit_course,
    lay_out,
    prior_profiles,
    rows_along,
)
from fpcal_bayes.infer import (
    LOG_SD,
    LOG_SD_NOISE,
    PATH_POINTS,
    Problem,
    curve_sd,
    identify,
    linear_task_sd,
    minimise,
    predict_from_covariance,
    task_jacobian,
)
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import Sweeps, TraceIndex, Truth, join, paper_protocol, paper_truth
from fpcal_bayes.model import TERMS, CavityModel, Cell, Estimate, Mechanics, fringe, group_of
from fpcal_bayes.motion import task_path
from fpcal_bayes.simulator import Machine, RecorderSettings, record_sweeps, simulate_um

TASKS = ("circle", "line-x", "line-z", "tilt-x", "tilt-z", "spin")
#: Polynomials of a course, averages of a fringe and the fewest of a sweep, sd in um of a row's own, fewest fringes of a
#: trace, standard deviations by which its sum of squares may exceed its expectation, and log odds against a mirror that
#: does not fade where the optics say that it does: those of the product.
MOST, BINS, FEWEST_BINS, OWN, FEWEST_FRINGES, MISFIT, UNLIKELY, FADES = 12, 32, 160, 2e-5, 0.9, 6.0, 5.0, 0.1

#: Standard deviation in um of a reading of a trace where the cell states error motions: the median of simulated ones.
READ = 0.0022


@dataclass(frozen=True)
class FromTruth:
    """Whole traces of a protocol on a perfect mechanism, read from the truth on."""

    cell: Cell
    protocol: Sweeps

    @cached_property
    def model(self) -> CavityModel:
        return CavityModel.of(self.cell)

    @cached_property
    def before(self) -> list[tuple[np.ndarray, Nuisance]]:
        """Covariance of the course and what the light may do, of each sweep, before its trace is looked at."""
        profiles = prior_profiles(self.cell, self.protocol)
        covariances = [np.pad(each.covariance, (0, MOST - len(each.mean))) for each in profiles]
        return list(zip(covariances, fading_priors(self.cell, self.protocol), strict=True))

    def courses(self, values: np.ndarray) -> np.ndarray:
        """True courses of all sweeps, (n_sweeps, MOST) coefficients in um."""
        s, _ = legendre.leggauss(MOST + 4)
        middle, half = ((self.protocol.q_end + sign * self.protocol.q_start) / 2.0 for sign in (1.0, -1.0))
        q = middle[:, None] + s[None, :, None] * half[:, None]
        lengths = self.model.predict(values, self.model.pose_rows(q.reshape(-1, q.shape[2])))
        fitted = np.linalg.lstsq(legendre.legvander(s, MOST), lengths.reshape(len(q), -1).T, rcond=None)[0]
        return np.asarray(fitted[1:].T)

    def rows(self, index: TraceIndex, values: np.ndarray) -> Sweeps:
        """What the traces say, as rows that share errors."""
        optics, along = self.cell.interferometer, []
        per_um, light = 4.0 * np.pi / optics.wavelength, 1.0 / (4.0 * optics.fibre_reflectivity * optics.gain)
        for i, course in enumerate(self.courses(values)):
            swept = legendre.legval(np.linspace(-1.0, 1.0, 129), [0.0, *course])
            passed = np.abs(np.diff(swept)) * per_um / (2.0 * np.pi)
            if passed.sum() < FEWEST_FRINGES:
                continue
            one = self.protocol.take(np.array([i]))
            joint = int(np.argmax(one.q_start[0] != one.q_end[0]))
            ends = float(one.q_start[0, joint]), float(one.q_end[0, joint])
            samples = lay_out(index.traces[i], *ends, unit="", scale=1.0, place=str(one.label[0]))
            samples = samples.binned(max(FEWEST_BINS, int(np.ceil(128.0 * BINS * passed.max()))))
            covariance, fading = self.before[i]
            profile = DisplacementProfile(course, covariance)
            fits = [
                fit_course(samples, profile, course, per_um, nuisance=each, noise=optics.noise, mirror_light=light)
                for each in (fading, CALM)
            ]
            doubt = UNLIKELY if np.abs(fading.fade_mean).max() > FADES else 0.0
            fit = fits[0] if fits[0].evidence >= fits[1].evidence - doubt else fits[1]
            if fit.residual_squares > fit.noise**2 * (fit.freedom + MISFIT * np.sqrt(2.0 * fit.freedom)):
                continue
            n = fit.modes.shape[1]
            places = -np.cos(np.pi * np.arange(1, n + 1) / n)
            changes, common = fit.told(places)
            told = rows_along(one, places).with_measurement(changes, OWN)
            along.append(replace(told, common=common, signed=np.ones(n, dtype=bool)))
        return join(along)

    def estimate(self, truth: Truth, seed: int, settings: RecorderSettings | None = None) -> Estimate:
        """The estimate by light recorded with a seed."""
        index = record_sweeps(self.cell, truth, self.protocol, settings, seed=seed, scans=False)
        problem = Problem.of(self.model, self.rows(index, truth.values[0]))
        found = minimise(problem, problem.unknowns(truth.values[0])).unknowns
        values, covariance = problem.values(found), problem.covariance(found)
        bend = curve_sd(problem, found, covariance)
        return Estimate(self.cell, self.cell.free, values, covariance, ("identified",) * len(values), curve=bend)


def task_errors(estimate: Estimate, truth: Truth) -> list[tuple[float, float]]:
    """Of each task standard deviation at its worst point in nm, and the error there in units of it."""
    model, found = CavityModel.of(estimate.cell, estimate.parameters), []
    for name in TASKS:
        task = task_path(estimate.cell, estimate.vector(), name).driven()
        sds = linear_task_sd(task_jacobian(model, estimate.values, task), estimate.covariance)
        poses = model.pose_rows(np.vstack([task.start[None], task.q]))
        lengths = [model.predict(values, poses) for values in (estimate.values, truth.values[0])]
        errors = (lengths[1] - lengths[1][0]) - (lengths[0] - lengths[0][0])
        worst = int(np.argmax(sds))
        found.append((1e3 * float(sds[worst]), float(errors[1:][worst] / sds[worst])))
    return found


def drawn(cell: Cell, seed: int) -> tuple[Cell, float]:
    """A cell whose machine is as large as the prior of the fit's scales has it, and the factor on its noise."""
    rng, stated = np.random.default_rng([seed, 17]), cell.mechanics
    assert stated is not None
    kinds = (("linearity",), TERMS["straightness"] + TERMS["runout"], TERMS["tilts"])
    shared = {name: rng.standard_normal() for name in ("reversal", "return_sd", "encoder", "drift")}
    groups = {group_of(cell, i): rng.standard_normal(len(kinds)) for i in range(len(cell.joints))}
    joints = []
    for i, joint in enumerate(stated.joints):
        scores = {name: z for z, names in zip(groups[group_of(cell, i)], kinds, strict=True) for name in names}
        sizes = {name: getattr(joint, name) for name in scores | shared if name != "drift"}
        made = {n: size * np.exp(LOG_SD * (scores | shared)[n]) for n, size in sizes.items() if size is not None}
        joints.append(replace(joint, **made))
    drift = stated.drift_nm_per_min * np.exp(LOG_SD * shared["drift"])
    machine = replace(stated, joints=tuple(joints), drift_nm_per_min=float(drift))
    return replace(cell, mechanics=machine), float(np.exp(LOG_SD_NOISE * rng.standard_normal()))


def machine_errors(estimate: Estimate, truth: Truth, seed: int, sizes: Mechanics) -> list[tuple[float, float]]:
    """The same on the machine that a recording with this seed is of, against draws of what the estimate expects."""
    cell, found = estimate.cell, []
    vector = cell.parameters.nominal.copy()
    vector[truth.parameters.slots] = truth.values[0]
    machine = Machine.draw(cell, sizes, vector, np.random.default_rng([seed, 5]))
    model = CavityModel.of(cell, estimate.parameters)
    for name in TASKS:
        task = task_path(cell, estimate.vector(), name, n_points=PATH_POINTS).driven()
        rows = model.rows(np.repeat(task.start[None], len(task), axis=0), task.q)
        error = machine.path(task.start, task.q, 0.0) - model.predict(estimate.values, rows)
        ahead = predict_from_covariance(estimate, task, draws=1000, seed=seed).errors
        mean, sd = ahead.mean(axis=0), ahead.std(axis=0)
        worst = int(np.argmax(sd))
        found.append((1e3 * float(sd[worst]), float((error - mean)[worst] / sd[worst])))
    return found


def shown(squares: np.ndarray) -> str:
    """Mean of squares (n_truths, n) with its standard error by the spread over truths, and the extremes of columns."""
    each, error = squares.mean(axis=0), squares.std(axis=0, ddof=1) / np.sqrt(len(squares))
    pooled = squares.mean(axis=1)
    least, most = int(np.argmin(each)), int(np.argmax(each))
    return (
        f"{pooled.mean():.3f} +- {pooled.std(ddof=1) / np.sqrt(len(squares)):.3f}, each {each[least]:.2f} +- "
        f"{error[least]:.2f} to {each[most]:.2f} +- {error[most]:.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replicates", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fast", action="store_true", help="read the 69 whole traces from their truth on")
    parser.add_argument("--mechanics", action="store_true", help="machines with the error motions that the cell states")
    parser.add_argument("--drawn", action="store_true", help="sizes and noise of the machines drawn about the stated")
    parser.add_argument("--only", metavar="CASE", default="", help="cases whose name ends so")
    parser.add_argument("--log", type=Path, help="file that gets a line of JSON for each truth")
    options = parser.parse_args()

    cell = load_cell(mechanics="stated" if options.mechanics else "none")
    paper, ends, middle = paper_truth(cell), paper_protocol(cell), paper_protocol(cell, midpoints=True)
    sds = np.array([p.prior_sd for p in paper.parameters])
    optics = cell.interferometer
    # One sample at half height, at either end.
    single = np.sqrt(2.0) * optics.noise * optics.wavelength / (4 * np.pi * optics.gain)
    single = float(single / fringe(optics, 920.0, 0.0)[1])

    def from_rows(protocol: Sweeps, sigma: float) -> Callable[[Truth, int], Estimate]:
        return lambda truth, seed: identify(cell, simulate_um(cell, truth, protocol, sigma=sigma, seed=seed)).estimate

    def read(truth: Truth, seed: int) -> Estimate:
        machine, noise = drawn(cell, seed) if options.drawn else (cell, 1.0)
        rows = simulate_um(machine, truth, middle, sigma=READ * noise, seed=seed)
        return identify(cell, rows.with_measurement(rows.dl, np.full(len(rows), READ))).estimate

    def from_traces(protocol: Callable[[], Sweeps]) -> Callable[[Truth, int], Estimate]:
        def made(truth: Truth, seed: int) -> Estimate:
            index = record_sweeps(cell, truth, protocol(), seed=seed)
            return identify(cell, trace_rows(cell, index)[0]).estimate

        return made

    cases = {
        "69, end points, 5 nm": from_rows(ends, 0.005),
        "69, midpoints, 5 nm": from_rows(middle, 0.005),
        f"69, midpoints, one sample ({1e3 * single:.1f} nm)": from_rows(middle, single),
        "69, whole traces": from_traces(lambda: ends),
        "12 planned, whole traces": from_traces(cache(lambda: plan(cell, 12, readings=0))),
    }
    if options.fast and options.mechanics:
        cases = {"69, middles and ends as traces tell them": read}
    elif options.fast:
        cases = {"69, whole traces, from the truth": FromTruth(cell, ends).estimate}
    for name, make in cases.items():
        if not name.endswith(options.only):
            continue
        began, squares, zets, tasks = time.process_time(), [], [], []
        for seed in range(options.seed, options.seed + options.replicates):
            values = cell.free.nominal + sds * np.random.default_rng(seed).standard_normal(len(sds))
            truth = replace(paper, times_h=np.zeros(1), values=values[None])
            estimate = make(truth, seed)
            scores, along = (estimate.values - values) / estimate.sd, None
            # A truth of which some task leaves the joints' limits counts for its parameters only.
            with contextlib.suppress(InputError):
                if options.mechanics:
                    sizes = (drawn(cell, seed)[0] if options.drawn else cell).mechanics
                    assert sizes is not None
                    along = machine_errors(estimate, truth, seed, sizes)
                else:
                    along = task_errors(estimate, truth)
            if options.log:
                said = [reason.kind for reason in estimate.trust.reasons]
                line = {"case": name, "seed": seed, "scores": scores.tolist(), "tasks": along, "trust": said}
                with options.log.open("a", encoding="utf-8") as log:
                    log.write(json.dumps(line) + "\n")
            if estimate.trust.usable:
                squares.append(scores**2)
                zets.append(estimate.sd[cell.free.position("z_et")])
                tasks += [] if along is None else [along]
        by_task = np.array(tasks)
        print(f"{name}: {len(squares)} of {options.replicates} usable, {time.process_time() - began:.0f} s")
        print(f"  z_et {np.median(zets):.3f} um; squares of parameters {shown(np.array(squares))}")
        print(f"  squares of {len(tasks)} truths' tasks {shown(by_task[:, :, 1] ** 2)}")
        for k, task in enumerate(TASKS):
            square = by_task[:, k, 1] ** 2
            error = square.std(ddof=1) / np.sqrt(len(square))
            print(
                f"  {task:8}{np.median(by_task[:, k, 0]):8.3f} nm, square {square.mean():.2f} +- {error:.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
