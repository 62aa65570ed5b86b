"""How the fringe amplitude changes along sweeps that tilt the mirror, fitted beside the phase that the reader found."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.fringes.fading import fading_priors
from fpcal_bayes.fringes.fit import CALM, Nuisance, fit_course
from fpcal_bayes.fringes.ingest import Ingested
from fpcal_bayes.fringes.profile import prior_profiles
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell

#: Sweeps that tilt the mirror by less than this, in rad, tell next to nothing; fewest of them.
_LEAST_TILT, _FEWEST = np.radians(1.0), 4
#: The weaker direction of all tilts relative to the stronger, below which one of two angles stays unseen.
_LEAST_ACROSS = 0.1
#: What a fit presumes of slope and bow: next to nothing.
_WIDE = (3.0, 2.0)
#: Averages a fringe, and the fewest of a sweep.
_BINS, _FEWEST_BINS = 128, 320


@dataclass(frozen=True)
class Amplitudes:
    """How the fringe amplitude changes along sweeps that tilt the mirror."""

    sweeps: Sweeps  # the sweeps, n of them
    #: shape, covariance: Slope and bow, the coefficients of the first and second Legendre polynomial of the logarithm
    #: of the amplitude over the place on the sweep, and their covariance from the traces' noise; shapes (n, 2) and (n,
    #: 2, 2).
    shape: Floats
    covariance: Floats

    def __len__(self) -> int:
        return len(self.shape)


def tilting(cell: Cell, sweeps: Sweeps) -> Ints:
    """Rows whose sweep turns the mirror's normal by a degree or more, by the nominal geometry."""
    turns = np.linalg.norm(_turns(cell, sweeps), axis=1)
    return np.flatnonzero((sweeps.kind == "sweep") & (turns >= _LEAST_TILT))


def _turns(cell: Cell, sweeps: Sweeps) -> Floats:
    """Change of the mirror's normal from start to end, shape (n, 3)."""
    model = CavityModel.of(cell)
    first, last = (model.mirrors(model.free.nominal, q)[0] for q in (sweeps.q_start, sweeps.q_end))
    return last - first


def fringe_amplitudes(cell: Cell, sweeps: Sweeps, found: Ingested) -> Amplitudes:
    """Slope and bow of the logarithm of the fringe amplitude along sweeps of the first session that tilt the mirror.

    sweeps: of the index that was read.
    found: what `ingest` made of it: phases, which the amplitudes are fitted beside; doubtful sweeps take no part.
    """
    readings = found.readings
    rows = [i for i in tilting(cell, sweeps).tolist() if (reading := readings[i]) is not None and reading.good]
    rows = [i for i in rows if sweeps.session[i] == sweeps.sessions[0]]
    chosen = sweeps.take(np.array(rows, dtype=np.int64))
    if len(rows) < _FEWEST:
        raise InputError(
            f"{sweeps.file}: {len(rows)} sweeps that tilt the mirror can be used, expected {_FEWEST} or more for the "
            "fibre's direction"
        )
    sizes = linalg.svdvals(_turns(cell, chosen))
    if sizes[1] < _LEAST_ACROSS * sizes[0]:
        raise InputError(
            f"{sweeps.file}: all sweeps tilt the mirror about one axis, expected tilts about two for the fibre's "
            "direction"
        )
    profiles, fading = prior_profiles(cell, chosen), fading_priors(cell, chosen)
    light = 1.0 / (4.0 * cell.interferometer.fibre_reflectivity * cell.interferometer.gain)
    shape, covariance = np.empty((len(rows), 2)), np.empty((len(rows), 2, 2))
    for k, i in enumerate(rows):
        reading, samples = readings[i], found.samples[i]
        if reading is None or samples is None or reading.fit is None:
            raise ValueError(f"row {i} was not read")
        allowed = Nuisance(CALM.offset, (), (*_WIDE, *fading[k].fade[2:]), fading[k].fade_mean)
        fit = fit_course(
            samples.binned(max(_FEWEST_BINS, int(_BINS * reading.fringes))),
            profiles[k],
            reading.fit.profile,
            reading.phase_per_um,
            nuisance=allowed,
            noise=reading.noise,
            mirror_light=light,
        )
        at = slice(sum(allowed.counts[:2]), sum(allowed.counts[:2]) + 2)
        shape[k], covariance[k] = fit.unknowns[at], fit.unknowns_covariance[at, at]
    return Amplitudes(chosen, shape, covariance)
