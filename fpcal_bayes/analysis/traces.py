"""What is made of recorded light: a fit to whole traces, a path that checks a calibration, a sweep that was read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.fringes.count import Reading
from fpcal_bayes.fringes.ingest import IngestSettings, ingest
from fpcal_bayes.fringes.path_check import PathCheck, starts_flat
from fpcal_bayes.fringes.profile import lengths_at
from fpcal_bayes.fringes.samples import Samples
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.traces.fit import TraceFit, fit_traces
from fpcal_bayes.measure.recordings import TraceIndex
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate


def identify_traces(
    cell: Cell,
    index: TraceIndex,
    *,
    session: str | None = None,
    free: str | Sequence[str] = "all",
    prior: Estimate | None = None,
) -> TraceFit:
    """The parameters by every sample of a session's traces, from what their ends and middles identify.

    Traces that are doubtful, or whose mirror does not follow its joint, are left out and named. `InputError` if the
    cell states error motions, of which the fit knows nothing.
    """
    if cell.mechanics is not None:
        raise InputError(
            f"cell {cell.name!r} states error motions, of which the fit of whole traces knows nothing: expected "
            "--mechanics none, or rows instead of traces"
        )
    of = index.sweeps.of_session(session).sessions[0]
    index = index.take(np.flatnonzero((index.sweeps.session == of) & (index.sweeps.kind == "sweep")))
    found = ingest(index, cell, settings=IngestSettings(points=1))
    # A trace of less than a fringe has no dL of its own, but its samples tell as much as others.
    told = [r is not None and (r.good or r.fringes < 1.0) and not (r.uneven or r.late) for r in found.readings]
    follows = np.array(told)
    if not follows.any():
        raise InputError(f"{index.sweeps.file}: in no sweep the mirror follows its joint: expected traces that do")
    start = identify(cell, found.sweeps, free=free, prior=prior).estimate
    fit = fit_traces(cell, index.take(np.flatnonzero(follows)), start, free=free, prior=prior)
    if follows.all():
        return fit
    names = ", ".join(index.sweeps.label[~follows][:5])
    said = f"{int((~follows).sum())} traces are left out, doubtful or of a mirror off its joint's course ({names})"
    return replace(fit, warnings=(*fit.warnings, said))


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
        measured, (low, high) = check.measured, check.predicted_band()
        sizes = np.ptp(measured.error[measured.places] + measured.draws, axis=1)
        return cls(
            predicted=(1e3 * low, 1e3 * float(np.median(check.predicted)), 1e3 * high),
            noisy=1e3 * float(np.quantile(check.expected, 0.975)),
            rival=None if measured.rival is None else 1e3 * float(np.ptp(measured.rival)),
            height=50.0 * (1.0 + np.sqrt(1.0 - measured.start_sine**2)) if starts_flat(measured) else None,
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
        time = np.interp(s, samples.s[order], samples.time[order])
        there, places = np.maximum(s, reading.set_out), np.maximum(samples.s, reading.set_out)
        lengths = lengths_at(reading.profile if len(reading.profile) else fit.profile, there)
        turned = fit.phase(there, phase_per_um) / (2.0 * np.pi)
        return cls(
            s=s,
            signal=fit.signal(there, time, phase_per_um),
            lengths=lengths - lengths[0],
            tops=np.flatnonzero(np.diff(np.floor(turned)) != 0),
            residual=samples.signal - fit.signal(places, samples.time, phase_per_um),
            noise=fit.noise,
        )
