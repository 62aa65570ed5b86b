"""How visibility can fade along a sweep, before its trace is looked at.

A mirror that tilts or moves away sends less light back into the fibre (see `mirror_coupling`). The cell's priors and
optics give the logarithm of the fringe amplitude along each sweep: for a tilt its bow is nearly certain and its slope
is not, for a translation there is next to nothing. A short sweep needs that to tell an envelope from a fringe.
"""

import numpy as np

from fpcal_bayes.fringes.fit import CALM, Nuisance
from fpcal_bayes.fringes.profile import centre_and_spread, coefficients_of, nodes
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.chain import fibre_in_world, optical_axis
from fpcal_bayes.model.interferometer import mirror_amplitude

_DRAWS, _SEED, _NODES = 120, 20240502, 9
#: Legendre polynomials of the logarithm, from the first on; what the optics' own uncertainty adds to each.
_FLOORS = (0.03, 0.02, 0.005, 0.003)
_OPTICS_SHARE = 0.3


def fading_priors(cell: Cell, sweeps: Sweeps) -> list[Nuisance]:
    """What a signal may do beside its fringes along each sweep, if the mirror fades as the cell's optics say."""
    model = CavityModel.of(cell)
    sds = np.array([p.prior_sd for p in model.free])
    draws = model.free.nominal + sds * np.random.default_rng(_SEED).standard_normal((_DRAWS, len(sds)))
    q, fit = nodes(sweeps, len(_FLOORS), _NODES)
    normals, origins = model.mirrors(draws, q)
    vectors = [model.vector(values) for values in draws]
    fibres = np.array([fibre_in_world(vector)[:3, 3] for vector in vectors])
    axes = np.array([optical_axis(cell, vector) for vector in vectors])
    distance = np.abs(np.einsum("vqi,vqi->vq", normals, origins - fibres[:, None]))
    tilt = np.arccos(np.clip(np.abs(np.einsum("vqi,vi->vq", normals, axes)), 0.0, 1.0))
    seen = np.log(np.maximum(mirror_amplitude(cell.interferometer, distance, tilt), 1e-12))
    centre, spread = centre_and_spread(coefficients_of(seen, fit))
    wide = np.hypot(spread, _OPTICS_SHARE * np.abs(centre)) + np.array(_FLOORS)
    return [
        Nuisance(CALM.offset, CALM.gain, tuple(sd.tolist()), tuple(mean.tolist()))
        for mean, sd in zip(centre, wide, strict=True)
    ]
