"""Where the fibre points, from the fringes' amplitude: what a perpendicular path's dL cannot see.

The amplitude falls with the square of the angle between mirror normal and fibre axis (see `mirror_coupling`). Along a
sweep that tilts the mirror its logarithm has a slope, which tells that angle at the sweep's middle, and a bow, which
tells the mode's radius. Its mean is left free, sweep by sweep, and with it gain and reflectivity.

The gain may also drift while a sweep lasts, which nothing in one trace tells from a tilt; by how much, sweeps of the
same turn at different places show. A drift that is alike in all sweeps stays unseen.

The amplitude tells an angle between mirror and fibre, not the fibre's alone. So the datum is carried as the joint
distribution of all parameters: the cell's prior updated by slopes and bows made linear near the solution. What the
linear form misses over the states that are still possible is added to the noise (T. Lefebvre, H. Bruyninckx, J. De
Schutter, IEEE Transactions on Automatic Control 47, 1406 (2002)). An estimate serves only as the place where they are
made linear, and does not enter the datum: the datum may be used with the changes of length that the estimate came from.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import chi2_tail, covariance_root
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.amplitude import Amplitudes
from fpcal_bayes.fringes.fit import CALM
from fpcal_bayes.fringes.profile import legendre
from fpcal_bayes.measure.recordings import moving_joint
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.interferometer import mirror_coupling, mirror_views
from fpcal_bayes.model.parameters import ParameterSet

#: The parameters that turn the fibre.
DIRECTION = ("beta_wf", "theta_wf")
#: Drift of the gain that is believable, of slope and bow of the logarithm of the amplitude: a poor day's.
_DRIFT = 2.0 * np.array(CALM.gain[:2])
#: Share of the slope and bow that the coupling's expansion and the averages may miss, in logarithms.
_FLOOR = 5e-4
#: Repeats that make their scatter a measure of the drift.
_FEWEST_REPEATS = 6
#: Standard deviation of the logarithm of the mode's radius; of the fibre's angles where the mirror is held, in rad.
_RADIUS_SD, _FREE_SD = 0.3, 0.5
_NODES, _STEPS, _STEP, _CONVERGED = 7, 30, 1e-3, 1e-3
_DRAWS, _SEED = 200, 20240503
#: Probability below which amplitudes do not follow the model.
_IMPROBABLE = 1e-3


@dataclass(frozen=True)
class Alignment:
    """The fibre's direction by the fringe amplitude."""

    estimate: Estimate  # the datum: the cell's prior of all parameters, narrowed by the amplitudes
    #: direction, noise, covariance: `DIRECTION` with the mirror's geometry held at nominal or at an estimate, in rad,
    #: shape (2,); the covariance from noise and drift of the gain alone, and with the uncertainty of what is held; each
    #: (2, 2).
    direction: Floats
    noise: Floats
    covariance: Floats
    #: mode_field_radius, mode_field_radius_sd: Of the fibre mode, in um, from the bows.
    mode_field_radius: float
    mode_field_radius_sd: float
    drift: Floats  # standard deviations of slope and bow that the gain's drift adds, shape (2,)
    nonlinear: float  # the largest standard deviation of a slope or bow that making them linear adds
    #: chi_square, freedom: Of slopes and bows under prior and coupling model, and what is expected.
    chi_square: float
    freedom: int
    n_sweeps: int  # that took part

    @property
    def probability(self) -> float:
        """Probability of a larger chi-square, if the amplitudes follow the model."""
        return chi2_tail(self.chi_square, self.freedom)

    def content(self) -> dict[str, Any]:
        """The JSON content: the estimate, and under ``alignment`` the direction with the mirror held; deg and um."""
        deg = np.pi / 180.0
        alignment = {
            "names": list(DIRECTION),
            "value_deg": (self.direction / deg).tolist(),
            "noise_covariance_deg2": (self.noise / deg**2).tolist(),
            "covariance_deg2": (self.covariance / deg**2).tolist(),
            "mode_field_radius_um": {"value": self.mode_field_radius, "sd": self.mode_field_radius_sd},
            "gain_drift_sd": self.drift.tolist(),
            "nonlinear_sd": self.nonlinear,
            "chi_square": self.chi_square,
            "expected": self.freedom,
            "probability": self.probability,
            "n_sweeps": self.n_sweeps,
        }
        return {**self.estimate.content(), "alignment": alignment}


def align(cell: Cell, amplitudes: Amplitudes, estimate: Estimate | None = None) -> Alignment:
    """Find the fibre's direction.

    amplitudes: from `fringe_amplitudes`.
    estimate: near which the amplitudes are made linear, by default nominal: the better the mirror is known, the less is
    lost.
    """
    file = amplitudes.sweeps.file
    missing = [name for name in DIRECTION if name not in cell.free]
    if missing:
        raise InputError(f"cell {cell.name!r}: {missing[0]} is not free, so no amplitude can tell it")
    view = _View.of(cell, amplitudes.sweeps, estimate)
    mean, covariance = view.known(estimate)
    measured = amplitudes.shape.ravel()
    scatter = linalg.block_diag(*(each + _FLOOR**2 * np.eye(2) for each in amplitudes.covariance))
    presumed = scatter + np.diag(np.tile(_DRIFT**2, len(amplitudes)))
    first = _update(view.shape, view.steps, measured, presumed, mean, covariance)
    drift = _drift(cell, amplitudes, measured - first.predicted)
    noise = scatter + np.diag(np.tile(drift**2, len(amplitudes)))
    found = _update(view.shape, view.steps, measured, noise, mean, covariance, first.mean)
    freedom = len(measured)
    if not (found.converged and chi2_tail(found.chi_square, freedom) > _IMPROBABLE):
        raise InputError(
            f"{file}: the fringe amplitudes do not follow the coupling of mirror and fibre (chi-square "
            f"{found.chi_square:.0f}, expected {freedom}): they do not tell the fibre's direction"
        )
    excess = _nonlinear(view.shape, found)
    linear = _linear(found, measured, noise + excess, *view.known(None))
    held = _held(view, measured, noise, mean, covariance)
    radius = found.mean[-1]
    return Alignment(
        estimate=_estimate(cell, amplitudes, *linear),
        direction=held[0],
        noise=held[1],
        covariance=held[2],
        mode_field_radius=float(np.exp(radius) * cell.interferometer.mode_field_radius),
        mode_field_radius_sd=float(
            np.exp(radius) * cell.interferometer.mode_field_radius * np.sqrt(found.covariance[-1, -1])
        ),
        drift=drift,
        nonlinear=float(np.sqrt(np.diag(excess).max())),
        chi_square=found.chi_square,
        freedom=freedom,
        n_sweeps=len(amplitudes),
    )


@dataclass(frozen=True)
class _View:
    """Slopes and bows as a function of the state: the cell's free parameters, then the logarithm of the mode radius."""

    cell: Cell
    model: CavityModel
    poses: Floats  # at the nodes of all sweeps, shape (n_sweeps * nodes, n_joints)
    weights: Floats  # what makes slope and bow of values at the nodes, shape (2, nodes)

    @classmethod
    def of(cls, cell: Cell, sweeps: Sweeps, estimate: Estimate | None) -> "_View":
        s, _ = np.polynomial.legendre.leggauss(_NODES)
        middle, half = (sweeps.q_start + sweeps.q_end) / 2.0, (sweeps.q_end - sweeps.q_start) / 2.0
        poses = (middle[:, None] + s[None, :, None] * half[:, None]).reshape(-1, middle.shape[1])
        model = CavityModel.of(cell, held=None if estimate is None else estimate.vector())
        return cls(cell, model, poses, np.linalg.pinv(legendre(s, 4))[1:3])

    @property
    def free(self) -> ParameterSet:
        return self.model.free

    @property
    def steps(self) -> Floats:
        """Variance of a difference, one per entry of the state."""
        return _STEP * np.array([*(p.prior_sd for p in self.free), _RADIUS_SD])

    def shape(self, state: Floats) -> Floats:
        """Slopes and bows (2 n_sweeps,), sweep by sweep."""
        _, distance, tilt = mirror_views(self.model, state[:-1], self.poses)
        optics = self.cell.interferometer
        radius = optics.mode_field_radius * float(np.exp(state[-1]))
        taken = np.abs(mirror_coupling(distance, tilt, mode_field_radius=radius, wavelength=optics.wavelength))
        logarithm = np.log(np.maximum(taken, 1e-12))
        return np.asarray((logarithm.reshape(-1, _NODES) @ self.weights.T).ravel())

    def known(self, estimate: Estimate | None) -> tuple[Floats, Floats]:
        """Mean and covariance of the state by the cell's priors, or by an estimate where it holds a parameter."""
        mean = np.append(self.free.nominal, 0.0)
        covariance = np.diag(np.array([*(p.prior_sd for p in self.free), _RADIUS_SD]) ** 2)
        if estimate is not None:
            names = [name for name in self.free.names if name in estimate.parameters]
            at = self.free.positions(names)
            mean[at], covariance[np.ix_(at, at)] = estimate.block(names)
            # The mirror's geometry is the estimate's; the direction is what is looked for, and may have drifted since.
            turned = self.free.positions(DIRECTION)
            covariance[turned, turned] += np.array([self.free[name].prior_sd for name in DIRECTION]) ** 2
        return mean, covariance


@dataclass(frozen=True)
class _Update:
    """A state after an update: mean, covariance, prediction there with its derivatives, and how well it fits."""

    mean: Floats
    covariance: Floats
    predicted: Floats
    jacobian: Floats
    chi_square: float
    converged: bool


def _update(
    predict: Callable[[Floats], Floats],
    steps: Floats,
    measured: Floats,
    noise: Floats,
    mean: Floats,
    covariance: Floats,
    start: Floats | None = None,
) -> _Update:
    """Iterated Gaussian update (B. Bell, F. Cathey, IEEE Transactions on Automatic Control 38, 294 (1993))."""
    state, converged = mean if start is None else start, False
    moves = np.diag(steps)
    for _ in range(_STEPS):
        predicted = predict(state)
        jacobian = np.array([predict(state + move) - predicted for move in moves]).T / steps
        innovation = measured - predicted + jacobian @ (state - mean)
        across = covariance @ jacobian.T
        spread = linalg.cho_factor(jacobian @ across + noise)
        chi_square = float(innovation @ linalg.cho_solve(spread, innovation))
        after = covariance - across @ linalg.cho_solve(spread, across.T)
        if converged:
            break
        target = mean + across @ linalg.cho_solve(spread, innovation)
        change = jacobian @ (target - state)
        converged = bool(np.abs(change / np.sqrt(np.diag(noise))).max() < _CONVERGED)
        state = target
    return _Update(state, (after + after.T) / 2.0, predicted, jacobian, chi_square, converged)


def _drift(cell: Cell, amplitudes: Amplitudes, residuals: Floats) -> Floats:
    """Standard deviations (2,) of slope and bow beyond the noise, by the scatter of sweeps of the same turn.

    With few repeats the largest that is believable; it is never taken to be larger.
    """
    sweeps = amplitudes.sweeps
    turns = np.column_stack([sweeps.q_start, sweeps.q_end])[:, np.tile(cell.revolute, 2)]
    joints = [moving_joint(sweeps, i) for i in range(len(sweeps))]
    _, kind, count = np.unique(
        np.column_stack([joints, np.round(turns, 6)]), axis=0, return_inverse=True, return_counts=True
    )
    kind = kind.ravel()
    left = len(amplitudes) - len(count)
    if left < _FEWEST_REPEATS:
        return _DRIFT
    each = residuals.reshape(-1, 2)
    means = np.stack([np.bincount(kind, column) / count for column in each.T], axis=1)
    squares = ((each - means[kind]) ** 2).sum(axis=0) / left
    own = np.einsum("nii->ni", amplitudes.covariance).mean(axis=0)
    # A variance from a few repeats is itself uncertain: that of Student's t.
    return np.asarray(np.minimum(np.sqrt(np.maximum(squares * left / (left - 2) - own, 0.0)), _DRIFT))


def _nonlinear(predict: Callable[[Floats], Floats], found: _Update) -> Floats:
    """Mean squares of what the linear form misses over the states that are still possible, shape (m, m)."""
    sds = np.sqrt(np.maximum(np.diag(found.covariance), 1e-300))
    moves = np.random.default_rng(_SEED).standard_normal((_DRAWS, len(sds))) @ covariance_root(found.covariance, sds).T
    missed = np.array([predict(found.mean + move) - found.predicted - found.jacobian @ move for move in moves])
    return np.asarray(missed.T @ missed / _DRAWS)


def _linear(found: _Update, measured: Floats, noise: Floats, mean: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance of a state updated by the measurement in its linear form near `found`."""
    jacobian = found.jacobian
    across = covariance @ jacobian.T
    spread = linalg.cho_factor(jacobian @ across + noise)
    off = measured - found.predicted + jacobian @ (found.mean - mean)
    after = covariance - across @ linalg.cho_solve(spread, across.T)
    return mean + across @ linalg.cho_solve(spread, off), (after + after.T) / 2.0


def _held(
    view: _View, measured: Floats, noise: Floats, mean: Floats, covariance: Floats
) -> tuple[Floats, Floats, Floats]:
    """The direction with all else held: values (2,), covariance (2, 2) by noise, and with the rest considered."""
    free = np.zeros(len(mean))
    at = view.free.positions(DIRECTION)
    free[at], free[-1] = _FREE_SD, _RADIUS_SD
    found = _update(view.shape, view.steps, measured, noise, mean, np.diag(free**2))
    gain = found.covariance @ found.jacobian.T @ linalg.inv(noise)
    rest = found.jacobian * (free == 0.0)
    carried = gain @ rest @ covariance @ rest.T @ gain.T
    block = np.ix_(at, at)
    return found.mean[at], found.covariance[block], (found.covariance + carried)[block]


def _estimate(cell: Cell, amplitudes: Amplitudes, mean: Floats, covariance: Floats) -> Estimate:
    """The datum without the mode's radius, and without parameters whose priors are not normal: these keep theirs."""
    names = [p.name for p in cell.free if p.prior is None or p.name in DIRECTION]
    parameters = ParameterSet(p for p in cell.free if p.name in names)
    at = cell.free.positions(names)
    block = covariance[np.ix_(at, at)]
    shrunk = np.diag(block) < 0.5 * np.array([p.prior_sd for p in parameters]) ** 2
    return Estimate(
        cell=cell,
        parameters=parameters,
        values=mean[at],
        covariance=block,
        status=tuple("identified" if each else "weak" for each in shrunk.tolist()),
        time_h=float(np.median(amplitudes.sweeps.time_h)),
    )
