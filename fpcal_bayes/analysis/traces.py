"""What is made of recorded light: rows of whole traces, a path that checks a calibration, a sweep that was read."""

from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import counted, covariance_root, quantile_band
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.fringes.count import Reading
from fpcal_bayes.fringes.fit import fit_course
from fpcal_bayes.fringes.ingest import Ingested, IngestSettings, ingest, rows_along
from fpcal_bayes.fringes.path_check import PathCheck
from fpcal_bayes.fringes.profile import DEGREE, DisplacementProfile, estimated_profiles, lengths_at, prior_profiles
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.fringes.solve import bins
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cell.cell import Cell

#: Polynomials of an expected course.
_MOST = 12
#: What no noise estimate of a sweep goes below, in um.
_LEFT = 2e-5
#: Averages of a fringe.
_BINS = 32
#: Standard deviations by which a sum of squares may exceed its expectation.
_MISFIT = 6.0


def trace_rows(cell: Cell, index: TraceIndex, *, session: str | None = None) -> tuple[Sweeps, list[str]]:
    """All samples of a session's traces as rows that share errors (`common`), and sentences for the user.

    On a perfect mechanism each trace is fitted along the course that the ends and middles of all expect, and the prior
    of that course is taken off again: the rows hold what the signal says. With error motions the traces are read by
    their fringes, at their middle and their end: at more places the errors that grow on the way between the ends (lost
    motion, return) are not those that the mechanics know. A doubtful trace counts by the scans at its ends; without
    them, or where no course fits or the mirror sets out late, it is left out. Both are named; less than a fringe tells
    its course to a tenth of a um, and not normally.
    """
    of = np.isin(index.sweeps.session, index.sweeps.of_session(session).sessions) & (index.sweeps.kind == "sweep")
    index = index.take(np.flatnonzero(of))
    sweeps, errs = index.sweeps, cell.mechanics is not None
    found = ingest(index, cell, settings=IngestSettings(points=1))
    # Half a turn has more polynomials than the reader of one trace allows for: what it calls uneven may be the course.
    told = [
        each is not None and not each.late and (each.good or (each.uneven and not (errs or each.alternatives)))
        for each in found.readings
    ]
    scanned = _by_scans(found, sweeps)
    # What many polynomials leave of half a turn is below a picometre; how they may be off, few of them say.
    expected = estimated_profiles(identify(cell, join([found.sweeps, *scanned.values()])).estimate, sweeps, _MOST)
    priors = [np.pad(each.covariance, (0, _MOST - DEGREE)) for each in prior_profiles(cell, sweeps)]
    light = 1.0 / (4.0 * cell.interferometer.fibre_reflectivity * cell.interferometer.gain)
    along = {}
    for i, (reading, samples) in enumerate(zip(found.readings, found.samples, strict=True)):
        if reading is None or samples is None or not told[i]:
            continue
        if errs:
            places = np.array([0.0, 1.0])
            changes, covariance = reading.changes(places)
            common = covariance_root(covariance)
        elif (seen := _whole(reading, samples, expected[i].mean, priors[i], light)) is not None:
            places, changes, common = seen
        else:
            continue
        # Which of both courses it was only the reading may say; where it does not, all rows have one unknown sign.
        changes = np.copysign(1.0, changes[-1] * (reading.dl if reading.signed else 1.0)) * changes
        rows = rows_along(sweeps.take(np.array([i])), places).with_measurement(changes, _LEFT)
        wide = np.pad(common, ((0, 0), (0, DEGREE - common.shape[1])))
        along[i] = replace(rows, common=wide, signed=np.full(len(places), reading.signed))
    if not along:
        raise InputError(f"{sweeps.file}: no trace is the course of its joint: expected traces that are")
    rest = [i for i in range(len(sweeps)) if i not in along and i not in scanned]
    kinds = [
        ("known by their scans alone, doubtful or too short to follow", list(scanned)),
        ("left out, doubtful or of a mirror that is off its joint's course", rest),
    ]
    said = [
        f"{counted(len(rows), 'trace')} {what}: {', '.join(sweeps.label[rows][:12])}" for what, rows in kinds if rows
    ]
    return join([*along.values(), *scanned.values()], sweeps.file), said


def _by_scans(found: Ingested, sweeps: Sweeps) -> dict[int, Sweeps]:
    """Rows of sweeps whose traces are doubtful, though the mirror keeps to its joint, by the scans at either end."""
    rows = {}
    for i, (reading, *scans) in enumerate(zip(found.readings, found.scans_before, found.scans_after, strict=True)):
        first, last = (scan if scan is not None and scan.good else None for scan in scans)
        if reading is None or reading.late or reading.uneven or reading.strayed:
            continue
        if reading.doubt and first and last:
            one, change = sweeps.take(np.array([i])), np.array([last.length - first.length])
            one = one.with_measurement(change, float(np.hypot(first.sigma, last.sigma)))
            rows[i] = replace(one, signed=np.ones(1, dtype=bool), group=np.array([""]))
    return rows


def _whole(
    reading: Reading, samples: Samples, near: Floats, prior: Floats, mirror_light: float
) -> tuple[Floats, Floats, Floats] | None:
    """Places, changes there in um, a root of their covariance; fitted along `near` (_MOST,), um, covariance `prior`."""
    if reading.fit is None:
        return None
    # The reading may be the mirror image of the course.
    seen = reading.fit.profile[:DEGREE]
    seen = np.append(np.copysign(1.0, seen @ near[:DEGREE]) * seen, near[DEGREE:])
    fit = fit_course(
        samples.binned(bins(near[None, :DEGREE], reading.phase_per_um, _BINS)),
        DisplacementProfile(near, prior),
        seen,
        reading.phase_per_um,
        nuisance=reading.fit.nuisance,
        noise=reading.noise,
        mirror_light=mirror_light,
    )
    if fit.residual_squares > fit.noise**2 * (fit.freedom + _MISFIT * np.sqrt(2.0 * fit.freedom)):
        return None
    n = fit.modes.shape[1]
    # Closer at the ends, the last at the end of the sweep.
    places = -np.cos(np.pi * np.arange(1, n + 1) / n)
    return places, *fit.told(places)


@dataclass(frozen=True)
class CheckNumbers:
    """What is shown of a checked path beside its own numbers: lengths in nm."""

    predicted: tuple[float, float, float]  # of the peak to peak by the estimate: lower edge of its band, median, upper
    noisy: float  # upper edge of the same with the noise of the recording
    rival: float | None  # peak to peak of another error that fits as well
    height: float | None  # percent of the way to a fringe's extreme at the start, where that is too near
    within: float | None  # probability, by the measurement alone, that the peak to peak is within the tolerance

    @classmethod
    def of(cls, check: PathCheck, tolerance: float | None = None) -> "CheckNumbers":
        """Numbers of a check, with a tolerance in um."""
        measured, (low, high) = check.measured, quantile_band(check.predicted, 0.95).tolist()
        sizes = np.ptp(measured.error[measured.places] + measured.draws, axis=1)
        return cls(
            predicted=(1e3 * low, 1e3 * float(np.median(check.predicted)), 1e3 * high),
            noisy=1e3 * float(np.quantile(check.expected, 0.975)),
            rival=None if measured.rival is None else 1e3 * float(np.ptp(measured.rival)),
            height=50.0 * (1.0 + np.sqrt(1.0 - measured.start_sine**2)) if measured.starts_flat else None,
            within=None if tolerance is None else float((sizes <= tolerance).mean()),
        )


#: Points of a fitted curve.
_CURVE = 4000


@dataclass(frozen=True)
class FittedSweep:
    """The curve that was fitted to the trace of a sweep."""

    s: Floats  # (n,), from -1 at the start of the sweep to 1 at its end
    signal: Floats  # (n,), V
    lengths: Floats  # (n,), L less L at the start, um
    tops: Ints  # places on the curve at which a fringe was found
    residual: Floats  # (n_samples,), V
    noise: float  # V

    @classmethod
    def of(cls, reading: Reading, samples: Samples) -> "FittedSweep | None":
        """The fitted curve of a reading and its trace; None where the trace was refused."""
        fit, phase_per_um = reading.fit, reading.phase_per_um
        if fit is None:
            return None
        s = np.linspace(-1.0, 1.0, _CURVE)
        order = np.argsort(samples.s, kind="stable")
        there, places = (np.clip(at, reading.set_out, reading.stop) for at in (s, samples.s))
        lengths = lengths_at(reading.profile if len(reading.profile) else fit.profile, there)
        return cls(
            s=s,
            signal=fit.signal(there, np.interp(s, samples.s[order], samples.time[order]), phase_per_um),
            lengths=lengths - lengths[0],
            tops=np.flatnonzero(np.diff(np.floor(fit.phase(there, phase_per_um) / (2.0 * np.pi))) != 0),
            residual=samples.signal - fit.signal(places, samples.time, phase_per_um),
            noise=fit.noise,
        )
