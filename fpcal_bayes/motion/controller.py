"""The controller of the paper's Fig 7: from operational poses to joint values, with what has been identified."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import require_task_within_envelope, safe_ranges
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.inverse import InverseModel, JointSolutions, check_poses
from fpcal_bayes.model.margin import estimate_draws, prior_draws
from fpcal_bayes.motion.compensation import compensated, compensated_joints
from fpcal_bayes.motion.placement import Placement, turns
from fpcal_bayes.motion.tasks import Task, follow_offsets
from fpcal_bayes.motion.validity import StaleEstimateWarning, read_now, stale_text

#: Most points of an interpolated path: a longer one is a mistake in the step.
_MOST_POINTS = 1_000_000


class Controller:
    """Joint values for mirror poses, from an estimate that may change while the controller runs.

    A pose fX is that of the mirror frame placed at the reflection point tPr, commanded in the fibre frame; the robot
    goes to q = IGM(wTf fX (eTt tTPr)^-1). The controller remembers where it stands; moves start from there.

    Parameters
    ----------
    estimate
        An estimate of a cell with six joints or fewer; from a file, a posterior or the tracker.
    q
        Where the joints stand, shape (n_joints,), in um and rad; by default at zero.
    now_h
        Tells the time in hours since the campaign began; by default this machine's clock does, where the estimate
        carries a clock time.
    compensate
        Make up for the error motions that the estimate knows, by the direction from which each joint comes; the pose
        that the controller stands at is then the commanded one.
    accept_untrusted
        Drive with an estimate that is not to be used; without it such an estimate is refused.

    Warns
    -----
    StaleEstimateWarning
        Once an estimate, when joint values are asked for after the time until which it is valid.

    Raises
    ------
    InputError
        If the cell has more than six joints, `q` lies outside its limits, or the estimate is not to be used.
    """

    def __init__(
        self,
        estimate: Estimate,
        q: Floats | None = None,
        *,
        now_h: Callable[[], float] | None = None,
        accept_untrusted: bool = False,
        compensate: bool = True,
    ) -> None:
        if not isinstance(estimate, Estimate):
            raise InputError(f"Controller: estimate is of type {type(estimate).__name__}, expected Estimate")
        self._now_h, self._told, self._accept_untrusted = now_h, False, accept_untrusted
        self._compensate = compensate
        self._inverse = InverseModel(estimate.cell)
        self._load(estimate)
        self._q = checked_joints(estimate.cell, np.zeros(len(estimate.cell.joints)) if q is None else q)
        # Where the geometry alone would have the joints for the pose that was commanded.
        self._plain = self._q

    def __repr__(self) -> str:
        return f"Controller({self.estimate!r})"

    @property
    def estimate(self) -> Estimate:
        """The estimate in use."""
        return self._estimate

    @property
    def q(self) -> Floats:
        """Where the joints stand, shape (n_joints,), in um and rad."""
        return self._q.copy()

    @property
    def pose(self) -> Floats:
        """Pose fX where the joints stand, as the estimate sees it, shape (4, 4)."""
        return self._placement.mirror_poses(self._inverse.tool_poses(self._vector, self._plain[None])[0])

    @property
    def aligned(self) -> Floats:
        """The aligned pose fX from which tasks start, shape (4, 4)."""
        return self._placement.aligned.copy()

    def update(self, estimate: Estimate) -> None:
        """Take a newer estimate of the same cell; the joints stay where they are, their pose is seen anew.

        Raises
        ------
        InputError
            If it is an estimate of another cell, or not to be used.
        """
        if estimate.cell.sha256 != self._estimate.cell.sha256:
            raise InputError(
                f"the estimate is of another cell ({estimate.cell.name!r}, opd {estimate.cell.opd!r}), expected "
                f"{self._estimate.cell.name!r}, opd {self._estimate.cell.opd!r}"
            )
        self._load(estimate)

    def joints(self, poses: Floats, *, follow: bool = True) -> JointSolutions:
        """Joint values of poses, without going there.

        Parameters
        ----------
        poses
            fX, shape (4, 4) or (n_poses, 4, 4); one after the other is looked for near the one before it, the first
            near where the joints stand.
        follow
            If false, all are looked for near where the joints stand.

        Raises
        ------
        InputError
            If a pose is not finite or its rotation is not orthonormal.
        """
        self._warn_if_stale()
        check_poses(poses)
        tools = self._placement.tool_poses(np.asarray(poses, dtype=float))
        return self._compensated(self._inverse.solve(self._vector, tools, near=self._q, follow=follow))

    def move_to(self, pose: Floats) -> Floats:
        """Go to a pose fX (4, 4).

        Returns
        -------
        ndarray
            Joint vector, shape (n_joints,), in um and rad.

        Raises
        ------
        InputError
            If it is no pose, the joints cannot take it, or the way there may leave the cell's envelope; the controller
            stays where it is then.
        """
        self._warn_if_stale()
        check_poses(pose)
        tools = self._placement.tool_poses(np.asarray(pose, dtype=float))
        plain = self._inverse.solve(self._vector, tools, near=self._q)
        found = self._compensated(plain)
        if not found.ok:
            raise InputError(f"the pose cannot be taken: {found.texts()}")
        self.require_within(found.q[None])
        self._q, self._plain = found.q, plain.q
        return self.q

    def move(
        self, translation_um: Sequence[float] = (0.0, 0.0, 0.0), rotation_deg: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Floats:
        """Go to a pose relative to the present one: shift, and turn about the reflection point, in the fibre frame.

        Parameters
        ----------
        translation_um
            Along Xf, Yf, Zf; in the mirror plane of the aligned pose that is Xf and Zf.
        rotation_deg
            About the fibre frame's X, then Y, then Z axis through the reflection point.

        Returns
        -------
        ndarray
            Joint vector, shape (n_joints,), in um and rad.

        Raises
        ------
        InputError
            As `move_to`.
        """
        pose = self.pose
        pose[:3, :3] = turns(np.radians(_triple(rotation_deg, "rotation_deg"))[None])[0] @ pose[:3, :3]
        pose[:3, 3] += _triple(translation_um, "translation_um")
        return self.move_to(pose)

    def path(self, pose: Floats, *, step_um: float = 1.0, step_deg: float = 0.1) -> JointSolutions:
        """A straight path from where the joints stand to `pose`, in steps that no joint exceeds, without going there.

        The mirror point moves on a straight line while the mirror turns about one axis; where the joints run fastest
        decides the number of points.

        Parameters
        ----------
        pose
            fX at the end, shape (4, 4).
        step_um, step_deg
            Longest step of a prismatic and of a revolute joint from point to point.

        Returns
        -------
        JointSolutions
            One a point, the first where the joints stand.

        Raises
        ------
        InputError
            If `pose` is no pose, a step is not above zero or asks for more than a million points, or the path may leave
            the cell's envelope.
        """
        if not (step_um > 0 and step_deg > 0):
            raise InputError(f"steps {step_um:g} um, {step_deg:g} deg: expected numbers above zero")
        steps = np.where(self._inverse.cell.revolute, np.radians(step_deg), step_um)
        self.joints(pose)
        points = 2
        while points <= _MOST_POINTS:
            found = self.joints(interpolate(self.pose, pose, points))
            known = found.q[np.isfinite(found.q).all(axis=1)]
            ratio = float((np.abs(np.diff(known, axis=0)) / steps).max(initial=0.0))
            if ratio <= 1.0:
                self.require_within(found.q[found.ok])
                return found
            points = max(points + 1, int(np.ceil((points - 1) * ratio)) + 1)
        raise InputError(
            f"steps {step_um:g} um, {step_deg:g} deg: expected such that a path has a million points or less"
        )

    def follow(self, name: str, offsets: Floats) -> Task:
        """Moves away from the aligned pose as a task, without going there (see `follow_offsets`)."""
        self._warn_if_stale()
        task = follow_offsets(self._estimate.cell, self._vector, name, offsets)
        return compensated(self._estimate, task) if self._compensate else task

    def _compensated(self, found: JointSolutions) -> JointSolutions:
        """Solutions with the known error motions made up for, where that gains; others as they are."""
        if not self._compensate or self._estimate.mechanics is None or not found.ok.all():
            return found
        better, _ = compensated_joints(self._estimate, self._aligned_q, found.q.reshape(-1, found.q.shape[-1]), self._q)
        return replace(found, q=better.reshape(found.q.shape))

    def _warn_if_stale(self) -> None:
        if self._told:
            return
        text = stale_text(self.estimate, read_now(None, self.estimate) if self._now_h is None else self._now_h())
        if text is not None:
            self._told = True
            warnings.warn(text, StaleEstimateWarning, stacklevel=3)

    def _load(self, estimate: Estimate) -> None:
        if not (estimate.trust.usable or self._accept_untrusted):
            raise InputError(f"the estimate is not to be driven with: {estimate.trust.against}")
        self._told = False
        self._estimate, self._vector = estimate, estimate.vector()
        self._placement = Placement.of(estimate.cell, self._vector)
        aligned = self._inverse.solve(self._vector, self._placement.tool_poses(self._placement.aligned))
        self._aligned_q = aligned.q if aligned.ok else np.zeros(len(estimate.cell.joints))
        self._known: tuple[CavityModel, Floats, Floats, Floats] | None = None

    def require_within(self, q: Floats, start: Floats | None = None) -> None:
        """Refuse a path (n_points, n_joints) that may leave the envelope, from `start` or where the joints stand."""
        cell = self._estimate.cell
        if cell.envelope is None:
            return
        if self._known is None:
            model, draws = estimate_draws(self._estimate) if self._estimate.trust.usable else prior_draws(cell)
            low, high = (np.where(np.isfinite(end), end, np.sign(end) * np.pi) for end in (cell.low, cell.high))
            self._known = model, draws, *safe_ranges(model, draws, low, high)
        model, draws, low, high = self._known
        start = self._q if start is None else start
        ends = np.vstack([start, q])
        # Inside these ranges no way is too near, so that only longer looks take their time.
        if not ((ends >= low) & (ends <= high)).all():
            require_task_within_envelope(model, draws, q, name="move", start=start)


def checked_joints(cell: Cell, values: ArrayLike) -> Floats:
    """A copy of a joint vector (n_joints,), in um and rad; `InputError` if it is none or outside its limits."""
    q = np.array(values, dtype=float)
    if q.shape != (len(cell.joints),) or not np.isfinite(q).all():
        raise InputError(f"joint vector of shape {q.shape}, expected {len(cell.joints)} finite numbers")
    slack = 1e-9 * (1.0 + np.abs(q))
    outside = (q < cell.low - slack) | (q > cell.high + slack)
    if outside.any():
        number = int(np.argmax(outside))
        raise InputError(f"q{number + 1} = {q[number] / cell.joint_scales[number]:g} is outside its limits")
    return q


def _triple(values: Sequence[float], name: str) -> Floats:
    found = np.asarray(values, dtype=float)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise InputError(f"{name}: expected three finite numbers")
    return found


def interpolate(start: Floats, end: Floats, n_points: int) -> Floats:
    """Poses from `start` to `end` (4, 4): positions on a line, turns about one axis; shape (n_points, 4, 4)."""
    share = np.linspace(0.0, 1.0, n_points)
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    poses = np.zeros((n_points, 4, 4))
    poses[:, :3, :3] = Rotation.from_rotvec(share[:, None] * turn).as_matrix() @ start[:3, :3]
    poses[:, :3, 3] = start[:3, 3] + share[:, None] * (end[:3, 3] - start[:3, 3])
    poses[:, 3, 3] = 1.0
    return poses
