"""The absolute cavity length from the irradiance against wavelength, at rest.

With k = n / lambda the phase 4 pi L k + const runs linearly in k, and its slope is L. The constant, which mirror and
fibre shift, is fitted along and not used: the length so found needs no knowledge of it, and is good to a few nanometres
from 1,520 to 1,600 nm, far below the lambda / 2 after which a single wavelength repeats itself.
"""

from dataclasses import dataclass

import numpy as np

from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.misfit import PhaseErrors
from fpcal_bayes.fringes.profile import DEGREE, DisplacementProfile
from fpcal_bayes.fringes.samples import Samples, fault
from fpcal_bayes.fringes.solve import FringeSolution, path_fringes, solve
from fpcal_bayes.measure.traces import WavelengthScan
from fpcal_bayes.model.air_index import air_index
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet

#: Fewest fringes of a scan, and fewest samples of a fringe.
FEWEST_FRINGES, SPARSE = 2.0, 3.0
#: Another length with more than this probability makes a scan doubtful.
_RISK = 1e-3
#: The cell's prior of the length is widened by this factor, and is at least this share of the length.
_WIDENED, _LEAST_SHARE = 2.0, 0.2
#: A length known less well, in um, and a mean square of errors that no explanation comes below, are refused.
_VAGUE, _UNEXPLAINED = 0.4, 30.0


@dataclass(frozen=True)
class ScanReading:
    """What a wavelength scan says."""

    length: float = np.nan  # of the cavity, in um; NaN where the scan was refused
    sigma: float = np.nan  # its standard deviation, in um
    fringes: float = np.nan  # within the scan
    refused: str = ""  # why it gives no number; empty where it does
    doubt: str = ""  # why the number is not to be relied on; empty where it is

    @property
    def good(self) -> bool:
        """Whether the number may be used."""
        return not self.refused and not self.doubt


def expected_lengths(cell: Cell, q: Floats) -> tuple[Floats, Floats]:
    """Cavity lengths at poses `q` (n, n_joints) and their standard deviations by the cell's priors, in um."""
    parameters = ParameterSet(p for p in cell.parameters if p.prior_sd > 0)
    model = CavityModel.of(cell, parameters)
    lengths, jacobian = model.predict_with_jacobian(parameters.nominal, model.pose_rows(q))
    return np.abs(lengths), np.asarray(np.linalg.norm(jacobian * np.array([p.prior_sd for p in parameters]), axis=1))


def read_wavelength_scan(
    scan: WavelengthScan,
    expected: float,
    expected_sd: float,
    *,
    air: tuple[float, float, float] = (np.nan, np.nan, np.nan),
    noise: float | None = None,
    full_scale: float | None = None,
) -> ScanReading:
    """The length near `expected` um, both widened; air: deg C, hPa, % (else index 1); noise: sd of a sample in V."""
    wave_number = air_index(scan.wavelength, *air) / scan.wavelength
    middle, half = wave_number[[0, -1]].mean(), abs(wave_number[-1] - wave_number[0]) / 2.0
    s = (wave_number - middle) / half
    samples = Samples(s, s, scan.irradiance, np.ones(len(scan)))
    if why := fault(samples, full_scale):
        return ScanReading(refused=why)
    sd = max(_WIDENED * expected_sd, _LEAST_SHARE * expected)
    mean, covariance = np.zeros(DEGREE), np.zeros((DEGREE, DEGREE))
    mean[0], covariance[0, 0] = expected * half, (sd * half) ** 2
    # A profile in units of L k: one cycle each half unit.
    solution = solve(samples, DisplacementProfile(mean, covariance), 4.0 * np.pi, noise)
    if solution is None:
        return ScanReading(refused="no fringes are seen")
    return _reading(solution, samples, float(middle), float(half))


def _reading(solution: FringeSolution, samples: Samples, middle: float, half: float) -> ScanReading:
    best = solution.best
    fringes = path_fringes(best.profile, 4.0 * np.pi)
    if best.amplitude < 3.0 * best.noise:
        return ScanReading(refused="no fringes are seen")
    if len(samples) < SPARSE * fringes:
        seen = f"{len(samples) / fringes:.2g} samples a fringe"
        return ScanReading(refused=f"sparse: {seen}, expected {SPARSE:g} or more")
    slope, sd = float(best.profile[0]), float(np.sqrt(best.covariance[0, 0]))
    errors = PhaseErrors.of(best, solution.samples, 4.0 * np.pi)
    bent, bent_sd, rest = errors.straightened(half / middle)
    slope, sd = slope + bent / (4.0 * np.pi), max(sd, bent_sd / (4.0 * np.pi))
    if sd > _VAGUE * half or rest > _UNEXPLAINED:
        off = float(np.sqrt(np.mean(errors.phase**2)))
        why = f"the phase leaves a line by {off:.2g} rad: the laser hops, its tuning ripples or L drifts"
        return ScanReading(fringes=fringes, refused=why)
    length, sd = abs(slope) / half, sd / half
    weights = np.exp(np.array([fit.evidence for fit in solution.fits]) - best.evidence)
    others = float(weights[1:].sum() / weights.sum())
    doubt = ""
    if fringes < FEWEST_FRINGES:
        doubt = f"{fringes:.1f} fringes, expected {FEWEST_FRINGES:g} or more"
    elif others > _RISK:
        doubt = f"another length is possible (probability {others:.2g})"
    return ScanReading(length, sd, fringes, doubt=doubt)
