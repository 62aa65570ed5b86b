"""A machine with error motions: drawn from stated sizes, with functions of another family than those of the fit.

The fit expands error motions in Legendre polynomials and harmonics and takes them to first order. Here they are random
Fourier features with kinks, moved through the whole chain, so that no study flatters itself.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.error_motions import JointMechanics, Mechanics
from fpcal_bayes.model.mechanics.drive import Drive

Function = Callable[[Floats], Floats]

_STRIDE, _FEATURES, _GRID = 8, 12, 401


@dataclass(frozen=True)
class MachineSettings:
    """How a machine is drawn beside its sizes."""

    spread: float = 1.33  # a size is drawn within this factor of what is stated, either way
    student: float | None = None  # degrees of freedom of the noise, scaled to the stated sigma; None: normal noise
    slow_nm: float = 0.0  # standard deviation of a slow reading error
    slow_rows: float = 10.0  # its correlation length, in rows
    mirror_radius_m: float = np.inf  # of the mirror's curvature; infinite for a flat one
    scale_ppm: float = 0.0  # error of the wavelength


@dataclass
class Machine:
    """One machine: geometry, error motions and their random state."""

    cell: Cell  # the cell whose chain, path model and joint limits hold
    vector: Floats  # true model vector, shape (model size,), in um and rad
    # of each joint six functions of its value: displacements in um and tilts in rad, about own axis, upward, across
    motions: list[list[Function]]
    lever: Floats  # from the sheet's point to the mirror, in um, in world axes at joint zero, shape (n_joints, 3)
    # half_reversal, return_sd, encoder, period, phase: Of each joint, in um and rad, shape (n_joints,)
    half_reversal: Floats
    return_sd: Floats
    encoder: Floats
    period: Floats
    phase: Floats
    drift: Floats  # rate of the fibre in um per minute, shape (3,), or (n_beams, 3) where there are several
    settings: MachineSettings
    rng: np.random.Generator  # of the noise
    side: Floats = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def draw(
        cls,
        cell: Cell,
        sizes: Mechanics,
        vector: Floats,
        rng: np.random.Generator,
        settings: MachineSettings | None = None,
    ) -> "Machine":
        """Draw a machine of the stated sizes around the geometry `vector`."""
        settings = MachineSettings() if settings is None else settings
        n = len(cell.joints)
        motions = [_draw_joint(cell, i, joint, rng, settings.spread) for i, joint in enumerate(sizes.joints)]
        own = np.where(cell.revolute, 1e-6, 1e-3)

        def drawn(values: list[float]) -> Floats:
            return np.asarray(np.array(values) * own * np.exp(rng.uniform(-1, 1, n) * np.log(settings.spread)))

        periods = np.array([np.nan if j.encoder_period is None else j.encoder_period for j in sizes.joints])
        periods = periods * cell.joint_scales
        unknown = np.where(cell.revolute, np.radians(0.37), 3.1) * rng.uniform(0.5, 2.0, n)
        return cls(
            cell=cell,
            vector=vector,
            motions=motions,
            lever=np.array([j.lever_mm for j in sizes.joints]) * 1e3,
            half_reversal=0.5 * drawn([j.reversal for j in sizes.joints]),
            return_sd=drawn([j.return_sd for j in sizes.joints]),
            encoder=drawn([j.encoder for j in sizes.joints]),
            period=np.where(np.isfinite(periods), periods, unknown),
            phase=rng.uniform(0, 2 * np.pi, n),
            drift=rng.standard_normal((len(cell.beams), 3) if cell.further else 3) * sizes.drift_nm_per_min * 1e-3,
            settings=settings,
            rng=rng,
            side=np.asarray(rng.choice([-1.0, 1.0], n), dtype=np.float64),
        )

    def lengths(self, q: Floats, reached: Floats, minutes: Floats, beam: Ints | None = None) -> Floats:
        """Cavity lengths at commanded poses `q`, own-axis errors `reached`, times and beams, in um; shape (n,)."""
        if self.cell.further:
            lengths = np.empty(len(q))
            for number, (view, index) in enumerate(self.cell.views):
                seen = np.broadcast_to(0 if beam is None else beam, len(q)) == number
                alone = replace(self, cell=view, vector=self.vector[index], drift=self.drift[number])
                lengths[seen] = alone.lengths(q[seen], reached[seen], minutes[seen])
            return lengths
        fibre_at = self.vector[-3:] + self.drift * minutes[:, None]
        turn, at = self.tools(q, reached)
        beta_et, theta_et, beta_wf, theta_wf, z_et = self.vector[-8:-3]
        light, scale = _beam(self.cell, beta_wf, theta_wf), 1.0 + 1e-6 * self.settings.scale_ppm
        if self.cell.target == "corner-cube":
            point = at + turn @ np.array([beta_et, theta_et, z_et]) - fibre_at
            return np.asarray(scale * (np.linalg.norm(point, axis=1) if self.cell.opd == "distance" else point @ light))
        in_tool = np.array([np.sin(theta_et), -np.sin(beta_et) * np.cos(theta_et), np.cos(beta_et) * np.cos(theta_et)])
        normal, origin = turn @ in_tool, at + z_et * turn[:, :, 2]
        away = ((origin - fibre_at) * normal).sum(axis=1)
        length = away / (normal @ light if self.cell.opd == "axis" else np.ones(len(q)))
        along = light if self.cell.opd == "axis" else normal
        # Where the light meets the mirror, seen from its origin: the sag of a curved mirror there.
        spot = fibre_at + along * length[:, None] - origin
        spot = spot - normal * (spot * normal).sum(axis=1, keepdims=True)
        sag = (spot**2).sum(axis=1) / (2.0 * self.settings.mirror_radius_m * 1e6)
        return np.asarray((np.abs(length) - sag) * scale)

    def reach(self, poses: Floats, side: Floats) -> Floats:
        """Own-axis errors with which joints reach poses in their order, shape (n, n_joints); one at rest keeps its."""
        reached = np.empty_like(poses)
        error = self.return_sd * self.rng.standard_normal(poses.shape[1])
        last = poses[0]
        for k, pose in enumerate(poses):
            moved = pose != last
            side = np.where(moved, np.sign(pose - last), side)
            error = np.where(moved, self.return_sd * self.rng.standard_normal(len(pose)), error)
            reached[k] = self.half_reversal * side + error
            last = pose
        return reached + self.periodic(poses)

    def periodic(self, q: Floats) -> Floats:
        """The encoders' periodic errors at poses (n, n_joints), same shape."""
        return np.asarray(self.encoder * np.sin(2 * np.pi * q / self.period + self.phase))

    def reached(self, drive: Drive) -> tuple[Floats, Floats]:
        """Own-axis errors at the start and the end of rows, without the encoders' part, shape (n, n_joints) each."""
        q, _, starts, ends = _poses(drive)
        errors = self.reach(q, self.side) - self.periodic(q)
        return errors[starts], errors[ends]

    def sweep(self, drive: Drive, sigma: float | Floats) -> Floats:
        """Measured changes of cavity length of rows driven in file order, in um, shape (n,); `sigma` is of the rows."""
        q, minutes, starts, ends = _poses(drive)
        reached, beam, beams = self.reach(q, self.side), self.cell.beam_numbers(drive.beam), range(len(self.cell.beams))
        lengths = np.array([self.lengths(q, reached, minutes, np.full(len(q), number)) for number in beams])
        noise = np.array([self._noise(len(q)) for _ in beams])
        own = np.where(drive.absolute, np.sqrt(2.0), 1.0) * noise[beam, ends]
        dl: Floats = lengths[beam, ends] + own * sigma / np.sqrt(2.0)
        dl -= np.where(drive.absolute, 0.0, lengths[beam, starts] + noise[beam, starts] * sigma / np.sqrt(2.0))
        slow: Floats = np.array([self._slow(len(drive)) for _ in beams])
        return dl + slow[beam, np.arange(len(drive))]

    def path(self, start: Floats, q: Floats, minutes: float) -> Floats:
        """True L(q) - L(start) along a path that is driven point by point, in um, shape (n_points,)."""
        poses = np.vstack([start, q])
        side = np.asarray(self.rng.choice([-1.0, 1.0], len(start)), dtype=np.float64)
        lengths = self.lengths(poses, self.reach(poses, side), np.full(len(poses), minutes))
        return np.asarray(lengths[1:] - lengths[0])

    def tools(self, q: Floats, reached: Floats) -> tuple[Floats, Floats]:
        """Orientation (n, 3, 3) and origin (n, 3) of the tool as in `lengths`, each error motion applied as it is."""
        n, zero, (ex, ey, ez) = len(q), _nominal_bases(self.cell), np.eye(3)
        turn, at = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
        for i, joint in enumerate(self.cell.joints):
            beta, alpha, d, theta, r, gain, runout_cos, runout_sin = self.vector[_STRIDE * i : _STRIDE * (i + 1)]
            turn = turn @ (_turn(ey, np.array([beta])) @ _turn(ex, np.array([alpha])))[0]
            at = at + d * turn[:, :, 0]
            shifts, tilts = np.split(np.array([f(q[:, i]) for f in self.motions[i]]), 2)
            axes = zero[i].T @ _axes(zero[i])
            travel = q[:, i] * (1 + gain) + reached[:, i]
            angle, along = np.full(n, theta), np.full(n, r)
            if joint.kind == "prismatic":
                along = along + travel
            else:
                angle = angle + travel + tilts[0]
                along = along + runout_cos * np.cos(travel) + runout_sin * np.sin(travel)
                tilts = np.vstack([np.zeros((1, n)), tilts[1:]])
            tilt = _turn(axes[:, 0], tilts[0]) @ _turn(axes[:, 1], tilts[1]) @ _turn(axes[:, 2], tilts[2])
            # In the base frame: the carriage, tilted about the sheet's point, which is the lever behind the mirror.
            arm = zero[i].T @ self.lever[i]
            carried = along[:, None] * ez + (axes @ shifts).T + (tilt @ arm - arm)
            at = at + (turn @ carried[:, :, None])[:, :, 0]
            turn = turn @ tilt @ _turn(ez, angle)
        return turn, at

    def length_change(self, q: Floats, approach: Floats, time_h: float) -> float:
        """What error motions, reversal and encoders add to L at a pose (n_joints,), in um; `approach`: a sign each."""
        side, now = np.where(approach != 0, approach, self.side), np.zeros(1)
        still = replace(self, motions=[[np.zeros_like] * 6] * len(q))
        errors = self.half_reversal * side + self.periodic(q)
        added = self.lengths(q[None], errors[None], now) - still.lengths(q[None], np.zeros((1, len(q))), now)
        return float(added[0])

    def _noise(self, n: int) -> Floats:
        dof = self.settings.student
        if dof is None:
            return self.rng.standard_normal(n)
        return np.asarray(self.rng.standard_t(dof, n) * np.sqrt((dof - 2.0) / dof), dtype=np.float64)

    def _slow(self, n: int) -> Floats:
        size = 1e-3 * self.settings.slow_nm
        if size == 0.0:
            return np.zeros(n)
        rho = np.exp(-1.0 / self.settings.slow_rows)
        values = np.empty(n)
        values[0] = self.rng.standard_normal()
        for i in range(1, n):
            values[i] = rho * values[i - 1] + np.sqrt(1 - rho**2) * self.rng.standard_normal()
        return size * values


def _beam(cell: Cell, beta_wf: float, theta_wf: float) -> Floats:
    if cell.optical_axis == "z":
        return np.array([0.0, -np.sin(beta_wf), np.cos(beta_wf)])
    return np.array([np.sin(theta_wf), -np.cos(theta_wf) * np.cos(beta_wf), -np.cos(theta_wf) * np.sin(beta_wf)])


def _poses(drive: Drive) -> tuple[Floats, Floats, Ints, Ints]:
    """Poses of rows one after the other with their minutes, and the place of each row's start and end among them."""
    poses, minutes = list[Floats](), list[float]()
    starts, ends, sweep = list[int](), list[int](), -1
    for i in range(len(drive)):
        if drive.sweep[i] != sweep and not drive.absolute[i]:
            starts.append(len(poses))
            poses.append(drive.q_start[i])
            minutes.append(drive.start_min[i])
        else:
            starts.append(starts[-1] if starts else 0)
        sweep = int(drive.sweep[i])
        ends.append(len(poses))
        poses.append(drive.q_end[i])
        minutes.append(drive.end_min[i])
    return np.array(poses), np.array(minutes), np.array(starts), np.array(ends)


def _draw_joint(cell: Cell, i: int, sizes: JointMechanics, rng: np.random.Generator, spread: float) -> list[Function]:
    """Six functions of joint `i` of the stated peak to valley."""
    flat = sizes.straightness_nm if sizes.flatness_nm is None else sizes.flatness_nm
    if cell.joints[i].kind == "prismatic":
        sized = [
            (sizes.linearity, "full"),
            (np.hypot(flat, sizes.crosstalk_nm), "bent"),
            (np.hypot(sizes.straightness_nm, sizes.crosstalk_nm), "bent"),
            (sizes.roll_urad, "full"),
            (sizes.yaw_urad, "full"),
            (sizes.pitch_urad, "full"),
        ]
    else:
        radial = "radial" if not np.isfinite(cell.high[i] - cell.low[i]) else "full"
        sized = [
            (2 * sizes.axial_runout_nm, "full"),
            (2 * sizes.radial_runout_nm, radial),
            (2 * sizes.radial_runout_nm, radial),
            (sizes.linearity, "full"),
            (2 * sizes.wobble_urad, "full"),
            (2 * sizes.wobble_urad, "full"),
        ]
    made = []
    for (size, shape), unit in zip(sized, [1e-3] * 3 + [1e-6] * 3, strict=True):
        drawn = float(size * unit * np.exp(rng.uniform(-1, 1) * np.log(spread)))
        made.append(_draw_function(cell.low[i], cell.high[i], drawn, shape, rng))
    return made


def _draw_function(low: float, high: float, size: float, shape: str, rng: np.random.Generator) -> Function:
    """A smooth function with a kink, of peak to valley `size` over the travel (a turn where there is no limit)."""
    if size == 0.0:
        return np.zeros_like
    endless = not np.isfinite(high - low)
    if endless:
        low, high = 0.0, 2.0 * np.pi
    rate, phase = np.abs(rng.standard_normal(_FEATURES)) * 2.0, rng.uniform(0, 2 * np.pi, _FEATURES)
    weight = rng.standard_normal(_FEATURES)
    kink, kinked = rng.uniform(-0.6, 0.6), 1.2 * rng.standard_normal() * np.sqrt(_FEATURES / 2)
    slope = rng.standard_normal() * np.sqrt(_FEATURES) if shape == "full" and not endless else 0.0
    order = rng.integers(2 if shape == "radial" else 1, 5, _FEATURES)

    def raw(q: Floats) -> Floats:
        if endless:
            bump = np.abs(np.sin(q - np.pi * kink)) if shape == "radial" else np.abs(np.sin((q - np.pi * kink) / 2.0))
            return np.asarray(np.cos(order * q[:, None] + phase) @ (weight / order) + 0.2 * kinked * bump)
        x = (2.0 * q - low - high) / (high - low)
        return np.asarray(np.cos(rate * x[:, None] + phase) @ weight + 0.3 * kinked * np.abs(x - kink) + slope * x)

    grid = np.linspace(low, high, _GRID)
    values = raw(grid)
    line = np.polyfit(grid, values, 1) if shape == "bent" else np.zeros(2)
    factor = size / np.ptp(values - np.polyval(line, grid))
    middle = float(values.mean())

    def function(q: Floats) -> Floats:
        return np.asarray(factor * (raw(q) - (np.polyval(line, q) if shape == "bent" else middle)))

    return function


def _turn(axis: Floats, angle: Floats) -> Floats:
    """Rotations about one axis by many angles, shape (n, 3, 3)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    return np.asarray(np.eye(3) + s * cross + (1 - c) * (cross @ cross))


def _axes(base: Floats) -> Floats:
    """Own axis, upward, across in world axes, as data sheets tell error motions."""
    own = base[:, 2]
    up = np.eye(3)[1 if abs(own[2]) > 0.9 else 2]
    up = (up - own * (own @ up)) / np.linalg.norm(up - own * (own @ up))
    return np.column_stack([own, up, np.cross(own, up)])


def _nominal_bases(cell: Cell) -> list[Floats]:
    vector, made, turn, (ex, ey, ez) = cell.parameters.nominal, [], np.eye(3), np.eye(3)
    for i in range(len(cell.joints)):
        beta, alpha, _, theta, *_ = vector[_STRIDE * i : _STRIDE * (i + 1)]
        made.append(turn @ (_turn(ey, np.array([beta])) @ _turn(ex, np.array([alpha])))[0])
        turn = made[-1] @ _turn(ez, np.array([theta]))[0]
    return made
