"""The whitened least-squares problem that the identification, the posterior and the reports share.

Unknowns are standard normal scores of the prior (for a normal prior: deviations from its mean in units of its standard
deviation), so that every prior row is a unit row. Parameters that are held but uncertain (consider parameters, Schmidt
1966) enter as further unknowns in which the data are linear: their uncertainty reaches the free parameters, their
values stay.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from fpcal_bayes.core.linalg import covariance_root, posterior_triangle, symmetric
from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.noise import Whitening
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.infer.mechanics.rows import row_whitening
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel, Rows
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.trust import HELD_EXACT, Reason

#: Held values move rows off their tangents by so many standard deviations at most, root mean square.
_MOST_BEND = 3.0


@dataclass(frozen=True)
class Considered:
    """Held parameters whose covariance counts."""

    parameters: ParameterSet  # which ones; their values stand in the model's held vector
    factor: Floats  # square root of their covariance, shape (n_considered, n_considered), in um and rad

    @classmethod
    def of(cls, parameters: ParameterSet, covariance: Floats) -> "Considered":
        """From a covariance (n, n) in um and rad, which may be singular."""
        return cls(parameters, covariance_root(covariance, parameters.prior_sd, eigh=linalg.eigh))


def hold_rest(
    cell: Cell, chosen: ParameterSet, start: Estimate | None, hold: str
) -> tuple[CavityModel, Considered | None]:
    """The model with what `start` knows beside `chosen` held there and considered; what only priors tell stays free."""
    known = start.parameters.names if start is not None else ()
    vector = cell.parameters.nominal.copy()
    considered = None
    shared = [p.name for p in cell.parameters if p.name in known and p.name not in chosen]
    if start is not None and shared:
        held = ParameterSet(cell.parameters[name] for name in shared)
        vector[held.slots], covariance = start.block(shared)
        considered = Considered.of(held, covariance) if hold == "consider" else None
    loose = cell.free.names if hold == "consider" else ()
    free = ParameterSet(p for p in cell.parameters if p.name in chosen or (p.name in loose and p.name not in known))
    return CavityModel.of(cell, free, vector), considered


def held_reasons(problem: "Problem", unknowns: Floats, *, exact: bool) -> list[Reason]:
    """What is to be said of parameters that are held."""
    bend = problem.bend(unknowns)
    if bend > _MOST_BEND:
        text = (
            f"the held values are too uncertain to be held: rows bend by {bend:.0f} standard deviations over what the "
            "data move them; free them too (--free all), with --prior START if nothing has changed since"
        )
        return [Reason("held-uncertain", text)]
    if exact and len(problem.model.free) < len(problem.model.cell.free):
        return [Reason("held-exact", HELD_EXACT)]
    return []


@dataclass(frozen=True, repr=False)
class Problem(Brief):
    """Whitened residuals and Jacobian of data and prior rows."""

    model: CavityModel  # model of the free parameters
    sweeps: Sweeps  # the rows that are used, with measurements
    rows: Rows  # the same, laid out for the kernels
    target: Floats  # measured changes with the sign decided for each row, shape (n_rows,)
    whitening: Whitening
    prior: Prior
    considered: Considered | None = None  # held but uncertain parameters, or None
    sensitivity: Floats | None = None  # of rows to the considered unknowns, (n_rows, n_considered), in um
    log_scales: Floats | None = None  # log factors on the stated sizes of the mechanics, (n_scales,)

    @classmethod
    def of(
        cls,
        model: CavityModel,
        sweeps: Sweeps,
        considered: Considered | None = None,
        target: Floats | None = None,
        prior: Prior | None = None,
        *,
        linearised: bool = True,
    ) -> "Problem":
        """The problem of `sweeps`, linearised at nominal; else rows stand by themselves, with their sigma alone."""
        rows = sweeps.laid_out(model)
        problem = cls(
            model=model.facing(model.free.nominal, rows),
            sweeps=sweeps,
            rows=rows,
            target=sweeps.dl if target is None else target,
            whitening=Whitening(1.0 / sweeps.sigma),
            prior=Prior.of(model.free) if prior is None else prior,
            considered=considered,
        )
        return problem.relinearised(np.zeros(len(model.free))) if linearised else problem

    @property
    def n_free(self) -> int:
        """Number of free parameters."""
        return len(self.prior.mean)

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns: free parameters and considered ones."""
        return self.n_free + (0 if self.considered is None else len(self.considered.parameters))

    @property
    def depends_on_point(self) -> bool:
        """Whether the whitening or the considered rows change with the point of linearisation."""
        cell = self.model.cell
        return self.considered is not None or cell.mechanics is not None or bool(cell.repeatability.any())

    def values(self, unknowns: Floats) -> Floats:
        """Free parameters in um and rad of scaled unknowns (..., n_unknowns)."""
        return self.prior.values(unknowns[..., : self.n_free])

    def unknowns(self, values: Floats) -> Floats:
        """Scaled unknowns (n_unknowns,) of free parameters `values` (n,); the considered ones at zero."""
        result = np.zeros(self.n_unknowns)
        result[: self.n_free] = self.prior.scores(values)
        return result

    def relinearised(self, unknowns: Floats) -> "Problem":
        """The same problem with the measurement covariance and the considered rows taken at `unknowns`."""
        values = self.values(unknowns)
        whitening = row_whitening(self.model, self.sweeps, values, self.log_scales)
        sensitivity = None
        if self.considered is not None:
            held, vector = self.considered.parameters, self.model.vector(values)
            around = CavityModel.of(self.model.cell, held, vector)
            _, jacobian = around.predict_with_jacobian(vector[held.slots], self.rows)
            sensitivity = jacobian @ self.considered.factor
        return replace(self, whitening=whitening, sensitivity=sensitivity)

    def bend(self, unknowns: Floats) -> float:
        """By how many standard deviations a row's line in the considered parameters misses its curve at `unknowns`."""
        if self.considered is None or self.sensitivity is None:
            return 0.0
        held, vector = self.considered.parameters, self.model.vector(self.values(unknowns))
        around, middle = CavityModel.of(self.model.cell, held, vector), vector[held.slots]
        at = around.predict(middle, self.rows) + self.sensitivity @ unknowns[self.n_free :]
        ends = around.predict(middle + self.considered.factor @ unknowns[self.n_free :], self.rows)
        return float(np.sqrt(np.mean(self.whitening.apply(ends - at) ** 2)))

    def with_target(self, target: Floats) -> "Problem":
        """The same with other measured values (n_rows,)."""
        return replace(self, target=target)

    def take(self, chosen: NDArray[np.bool_]) -> "Problem":
        """The problem of some of the rows, under the same prior."""
        part = Problem.of(self.model, self.sweeps.take(chosen), self.considered, self.target[chosen], self.prior)
        return replace(part, log_scales=self.log_scales)

    def data_residuals(self, unknowns: Floats) -> Floats:
        """Whitened prediction minus measurement, shape (n_rows,), or (n_points, n_rows) at many points."""
        change = self.model.predict(self.values(unknowns), self.rows) - self.target
        if self.sensitivity is not None:
            change = change + unknowns[..., self.n_free :] @ self.sensitivity.T
        return self.whitening.apply(change[..., None])[..., 0]

    def data_jacobian(self, unknowns: Floats) -> Floats:
        """Derivatives of `data_residuals` by the unknowns, shape (n_rows, n_unknowns)."""
        return np.asarray(self.data_batch(unknowns[None])[1][0])

    def prior_scaled_jacobian(self, unknowns: Floats) -> Floats:
        """Derivatives of the whitened rows by the free parameters in prior standard deviations, shape (n_rows, n)."""
        if self.prior.factor is None and not self.prior.others:
            return self.data_jacobian(unknowns)[:, : self.n_free]
        _, jacobian = self.model.predict_with_jacobian(self.values(unknowns), self.rows)
        return self.whitening.apply(jacobian * self.prior.sd)

    def data_batch(self, points: Floats) -> tuple[Floats, Floats]:
        """Whitened residuals (n_points, n_rows) and derivatives (n_points, n_rows, n_unknowns) at many points."""
        change, scaled = self.unwhitened_batch(points)
        if self.whitening.only_scales:
            scaled *= self.whitening.scale[:, None]
            return change * self.whitening.scale, scaled
        return self.whitening.apply(change[:, :, None])[:, :, 0], self.whitening.apply(scaled)

    def unwhitened_batch(self, points: Floats) -> tuple[Floats, Floats]:
        """Predicted minus measured rows (n_points, n_rows) and their derivatives by the unknowns, in um."""
        predicted, jacobian = self.model.predict_with_jacobian(self.values(points), self.rows)
        scaled = self.prior.by_scores(jacobian, points[:, : self.n_free])
        change = predicted - self.target
        if self.sensitivity is not None:
            change = change + points[:, self.n_free :] @ self.sensitivity.T
            held = np.broadcast_to(self.sensitivity, (len(points), *self.sensitivity.shape))
            scaled = np.concatenate([scaled, held], axis=2)
        return change, scaled

    def gradients(self, points: Floats) -> Floats:
        """Gradients J'r of half the sum of squares at many points (n_points, n_unknowns); same shape."""
        result = np.empty_like(points)
        block = max(1, 8_000_000 // (len(self.target) * self.n_unknowns))
        for first in range(0, len(points), block):
            part = points[first : first + block]
            weighed, scaled = self._weighed_batch(part)
            result[first : first + block] = (weighed[:, None, :] @ scaled)[:, 0, :] + part
        return result

    def _weighed_batch(self, points: Floats) -> tuple[Floats, Floats]:
        """Rows and derivatives whose products are those of the whitened ones."""
        change, scaled = self.unwhitened_batch(points)
        return self.whitening.weigh_each(change), scaled

    def residuals(self, unknowns: Floats) -> Floats:
        """Whitened data rows, then prior rows, shape (n_rows + n_unknowns,)."""
        return np.concatenate([self.data_residuals(unknowns), unknowns])

    def jacobian(self, unknowns: Floats) -> Floats:
        """Derivatives of `residuals`, shape (n_rows + n_unknowns, n_unknowns)."""
        return np.vstack([self.data_jacobian(unknowns), np.eye(self.n_unknowns)])

    def covariance(self, unknowns: Floats) -> Floats:
        """Laplace covariance of free and considered parameters in um and rad, with Schmidt's cross block."""
        jacobian = self.data_jacobian(unknowns)
        inverse = linalg.solve_triangular(posterior_triangle(jacobian), np.eye(self.n_unknowns))
        scaled = inverse @ inverse.T
        transform = np.zeros((self.n_unknowns, self.n_unknowns))
        n = self.n_free
        transform[:n, :n] = self.prior.secants(unknowns[:n], np.sqrt(np.diag(scaled)[:n]))
        if self.considered is None:
            return symmetric(transform @ scaled @ transform.T)
        # x = K (y - f(x, c0)): the free error is -K e - K J_c dc, so its covariance with dc is -K J_c P_c.
        cross = -(scaled[:n] @ jacobian.T) @ jacobian[:, n:]
        transform[n:, n:] = self.considered.factor
        scaled[:n, n:], scaled[n:, :n], scaled[n:, n:] = cross, cross.T, np.eye(self.n_unknowns - n)
        return symmetric(transform @ scaled @ transform.T)
