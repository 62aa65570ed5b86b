"""A checked path as rows of a campaign."""

from pathlib import Path

import numpy as np

from fpcal_bayes.infer.path_check import PathError
from fpcal_bayes.measure.path_trace import PathTrace
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell import Cell
from fpcal_bayes.model.estimate import Estimate

#: Of a row, in um: what no noise estimate goes below.
_LEAST_SIGMA = 1e-4


def check_rows(
    cell: Cell,
    estimate: Estimate,
    trace: PathTrace,
    measured: PathError,
    *,
    session: str,
    time_h: float,
    points: int = 0,
) -> Sweeps:
    """The measured error of a path as sweeps.

    Parameters
    ----------
    estimate
        The one that the error was measured against.
    session, time_h
        Of all rows.
    points
        How many sweeps from the start of the path to points along it to add. They are one group: the reading at the
        start, and the signal's drift, which counts as part of it, are common to them.

    Returns
    -------
    Sweeps
        First a row of kind ``path``: peak to peak of the error, which has no sign. Then the sweeps, with the measured
        change of the cavity length itself.
    """
    q = trace.q[trace.path]
    name = Path(trace.file).name or "path"
    row = Sweeps.make(
        q[:1],
        q[-1:],
        session=session,
        label="check",
        time_h=time_h,
        dl=measured.peak_to_peak,
        sigma=max(measured.peak_to_peak_sd, _LEAST_SIGMA),
        signed=False,
        kind="path",
        trace=name,
        file=name,
    )
    if points == 0:
        return row
    model = CavityModel.of(cell, estimate.parameters, estimate.vector())
    # Without the start; the path's end too unless it is the start again.
    chosen = np.unique(np.linspace(0, len(measured.places) - 1, points + 2).round().astype(np.int64)[1:-1])
    ends = q[measured.places[chosen]]
    starts = np.repeat(q[:1], len(ends), axis=0)
    expected = model.predict(estimate.values, model.rows(starts, ends))
    sweeps = Sweeps.make(
        starts,
        ends,
        session=session,
        label=[f"check-{i}" for i in range(1, len(ends) + 1)],
        time_h=time_h,
        dl=expected + measured.error[measured.places[chosen]],
        sigma=max(float(measured.draws[:, chosen].std(axis=0).max()), _LEAST_SIGMA),
        group="check",
    )
    return join([row, sweeps], name)
