"""The built-in cell once more, in plain NumPy: the paper's equations over many poses, and a fit with SciPy alone.

It shares with the package the names of the parameters and the numbers of the cell file, nothing else.
"""

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

Array = NDArray[Any]

#: Nominal values and prior standard deviations, in deg and um.
PRIOR = {
    "alpha_2": (-90.0, 1.0),
    "theta_2": (-90.0, 1.0),
    "alpha_3": (-90.0, 1.0),
    "theta_3": (-90.0, 1.0),
    "beta_4": (0.0, 1.0),
    "alpha_4": (0.0, 1.0),
    "d_4": (0.0, 20.0),
    "theta_4": (0.0, 1.0),
    "alpha_5": (-90.0, 1.0),
    "d_5": (0.0, 20.0),
    "theta_5": (-90.0, 1.0),
    "alpha_6": (-90.0, 1.0),
    "theta_6": (0.0, 1.0),
    "beta_et": (0.0, 1.0),
    "theta_et": (0.0, 1.0),
    "beta_wf": (0.0, 1.0),
    "theta_wf": (0.0, 1.0),
    "z_et": (0.0, 20.0),
    "x_wf": (0.0, 200.0),
    "y_wf": (920.0, 200.0),
    "z_wf": (0.0, 200.0),
}
NAMES = tuple(PRIOR)
NOMINAL, SD = np.array(list(PRIOR.values())).T


def _turn(axis: int, angle: Array) -> Array:
    """Rotations about X, Y or Z, shape (..., 4, 4)."""
    angle = np.asarray(angle)
    result = np.zeros((*angle.shape, 4, 4), dtype=angle.dtype)
    one, two = (axis + 1) % 3, (axis + 2) % 3
    result[..., one, one] = result[..., two, two] = np.cos(angle)
    result[..., two, one] = np.sin(angle)
    result[..., one, two] = -np.sin(angle)
    result[..., axis, axis] = result[..., 3, 3] = 1.0
    return result


def _shift(x: Any = 0.0, y: Any = 0.0, z: Any = 0.0) -> Array:
    x, y, z = np.broadcast_arrays(x, y, z)
    result = np.zeros((*x.shape, 4, 4), dtype=np.result_type(x, y, z, float))
    result[...] = np.eye(4)
    for axis, value in enumerate((x, y, z)):
        result[..., axis, 3] = value
    return result


def lengths(values: Array, q: Array, opd: str = "axis") -> Array:
    """Cavity lengths in um at joint vectors `q` (n, 6) in um and deg, for parameters `values` (21,) in deg and um."""
    p = dict(zip(NAMES, values, strict=True))
    q = np.asarray(q, dtype=float)
    pose = np.eye(4)
    for i in range(1, 7):
        moved = q[:, i - 1]
        theta, r = p.get(f"theta_{i}", 0.0), 0.0
        if i <= 3:
            r = r + moved
        else:
            theta = theta + moved
        frame = _turn(1, np.radians(1.0) * p.get(f"beta_{i}", 0.0)) @ _turn(
            0, np.radians(1.0) * p.get(f"alpha_{i}", 0.0)
        )
        frame = frame @ _shift(x=p.get(f"d_{i}", 0.0)) @ _turn(2, np.radians(1.0) * theta) @ _shift(z=r)
        pose = pose @ frame
    radian = np.radians(1.0)
    pose = pose @ _shift(z=p["z_et"]) @ _turn(0, radian * p["beta_et"]) @ _turn(1, radian * p["theta_et"])
    normal, origin = pose[:, :3, 2], pose[:, :3, 3]
    beta, theta = radian * p["beta_wf"], radian * p["theta_wf"]
    light = np.array([np.sin(theta), -np.cos(theta) * np.cos(beta), -np.cos(theta) * np.sin(beta)])
    distance = ((origin - np.array([p["x_wf"], p["y_wf"], p["z_wf"]])) * normal).sum(axis=1)
    return distance / (normal @ light) if opd == "axis" else distance * np.sign(distance.real)


def predictions(values: Array, start: Array, end: Array, opd: str = "axis") -> Array:
    """Changes of cavity length from `start` to `end`, each (n, 6) in um and deg."""
    first, last = np.split(lengths(values, np.concatenate([start, end]), opd), 2)
    return last - first


class Fit:
    """Whitened residuals of sweeps under the prior, their Jacobian by complex steps, and their minimum."""

    def __init__(self, start: Array, end: Array, dl: Array, sigma: Array, opd: str = "axis") -> None:
        self.start, self.end, self.dl, self.sigma, self.opd = start, end, dl, sigma, opd

    def residuals(self, scaled: Array) -> Array:
        """Data rows, then prior rows, at `scaled` (21,) in prior standard deviations from nominal."""
        predicted = predictions(NOMINAL + SD * scaled, self.start, self.end, self.opd)
        return np.concatenate([(predicted - self.dl) / self.sigma, scaled])

    def jacobian(self, scaled: Array) -> Array:
        """Derivatives of `residuals`, shape (n + 21, 21)."""
        shifted = scaled + 1e-30j * np.eye(len(NAMES))
        return np.array([self.residuals(point).imag for point in shifted]).T / 1e-30

    def total(self, scaled: Array) -> float:
        """Sum of squares."""
        residuals = self.residuals(scaled)
        return float(residuals @ residuals)

    def minimum(self, scaled: Array) -> Array:
        """The minimum that SciPy's trust-region method finds from `scaled`, to the last digits."""
        found = optimize.least_squares(
            self.residuals, scaled, self.jacobian, method="trf", ftol=1e-15, xtol=1e-15, gtol=1e-10, max_nfev=500
        )
        return np.asarray(found.x)


def read_rows(path: Path) -> tuple[Array, Array, Array, Array]:
    """Start and end poses (n, 6) in um and deg, dl and sigma (n,) of a sweep file."""
    with path.open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    units = ("um", "um", "um", "deg", "deg", "deg")
    ends = [
        np.array([[float(row[f"q{i}_{end}_{unit}"]) for i, unit in enumerate(units, 1)] for row in rows])
        for end in ("start", "end")
    ]
    dl, sigma = (np.array([float(row[name]) for row in rows]) for name in ("dl_um", "sigma_um"))
    return ends[0], ends[1], dl, sigma
