"""What other programs do, against the size of its input; each is held to our result before it is timed."""

import warnings
from collections.abc import Iterator

import numpy as np
from measuring import Point, timed
from numpy.testing import assert_allclose
from scaling_inputs import measured, random_poses

from fpcal_bayes.infer import Problem, minimise
from fpcal_bayes.measure import paper_truth
from fpcal_bayes.model import CavityModel, Cell, InverseModel, chain
from fpcal_bayes.tracking import DriftModel, LinearMeasurement, State, predict, update

#: Rows that one step of the linear filter takes in.
ROWS_OF_STEP = 6


def by_poses(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """Pinocchio's kinematics, and our cavity lengths with their Jacobian, of one parameter vector."""
    from pinocchio_cell import PinocchioCell

    model = CavityModel.of(cell)
    values = paper_truth(cell).values[0]
    vector = model.vector(values)
    rival = PinocchioCell(cell, vector)
    for q in random_poses(cell, 5):
        assert_allclose(rival.mirror_pose(q), chain.mirror_pose(cell, vector, q), rtol=0, atol=1e-9)
    for n in sizes:
        q = random_poses(cell, n)
        rows, poses = model.pose_rows(q), list(q)
        yield timed("lengths", n, lambda r=rows: model.predict(values, r), "poses")
        yield timed("forward kinematics, Pinocchio", n, lambda p=poses: rival.run(p), "poses", peer=True)
        yield timed(
            "lengths and Jacobian by 21 parameters", n, lambda r=rows: model.predict_with_jacobian(values, r), "poses"
        )
        yield timed("Jacobian by 6 joints, Pinocchio", n, lambda p=poses: rival.run_jacobians(p), "poses", peer=True)


def by_inverse_poses(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """Damped Newton steps on Pinocchio's Jacobian."""
    import pinocchio
    from pinocchio_cell import PinocchioCell

    vector = CavityModel.of(cell).vector(paper_truth(cell).values[0])
    rival = PinocchioCell(cell, vector)
    for n in sizes:
        q = random_poses(cell, n)
        poses = InverseModel(cell).tool_poses(vector, q)
        targets = [pinocchio.SE3(pose[:3, :3], pose[:3, 3]) for pose in poses]
        assert_allclose([rival.joints_at(target) for target in targets[:10]], q[:10], rtol=0, atol=1e-7)
        yield timed(
            "inverse model, Pinocchio and Newton", n, lambda t=targets: [rival.joints_at(to) for to in t], "poses",
            peer=True,
        )  # fmt: skip


def by_figaroh_poses(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """figaroh's Jacobian of the mirror's pose by the 36 errors of its joint placements, by central differences."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from figaroh.calibration import calibration_tools
    from pinocchio_cell import PinocchioCell

    vector = CavityModel.of(cell).vector(paper_truth(cell).values[0])
    rival = PinocchioCell(cell, vector)
    names = list(rival.model.names)[1:]
    settings = {
        "calib_model": "full_params",
        "param_name": list(calibration_tools.get_fullparam_offset(names)),
        "start_frame": "universe",
        "end_frame": "mirror",
        "actJoint_idx": list(range(1, len(names) + 1)),
        "NbMarkers": 1,
        "measurability": [True] * 6,
        "calibration_index": 6,
    }
    none = np.zeros(len(settings["param_name"]))
    for n in sizes:
        q = random_poses(cell, n)

        def jacobian(q: np.ndarray = q) -> np.ndarray:
            found: np.ndarray = calibration_tools.measurement_jacobian(rival.model, rival.data, none, q, settings)
            return found

        found = calibration_tools.calc_updated_fkm(rival.model, rival.data, none, q[:5], settings | {"NbSample": 5})
        origins = [chain.mirror_pose(cell, vector, pose)[:3, 3] for pose in q[:5]]
        assert_allclose(found.reshape(6, 5)[:3].T, origins, rtol=0, atol=1e-9)
        yield timed("Jacobian by 36 placements, figaroh", n, jacobian, "poses", peer=True)


def by_rows(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """lmfit on our residuals, with its own finite differences."""
    import lmfit

    for n in sizes:
        problem = Problem.of(CavityModel.of(cell), measured(cell, n))
        names = problem.model.free.names
        start = lmfit.Parameters()
        for name in names:
            start.add(name, value=0.0)

        def residuals(parameters: "lmfit.Parameters", p: Problem = problem) -> np.ndarray:
            return p.residuals(np.array([parameters[name].value for name in p.model.free.names]))

        ours = minimise(problem, np.zeros(len(names))).sum_of_squares
        assert lmfit.minimize(residuals, start, method="leastsq").chisqr < 1.01 * ours
        yield timed(
            "Levenberg-Marquardt, lmfit",
            n,
            lambda r=residuals, s=start: lmfit.minimize(r, s, method="leastsq"),
            peer=True,
        )


def by_steps(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """The likelihood of linear rows under the cell's drift: our filter, and statsmodels."""
    from statsmodels.tsa.statespace.mlemodel import MLEModel

    drift = DriftModel.of(cell)
    n, start = drift.n_states, State(0.0, np.zeros(drift.n_states), np.eye(drift.n_states), 20.0)
    random = np.random.default_rng(6)
    design = random.standard_normal((ROWS_OF_STEP, n))
    step = drift.transition(1.0, 0.0)
    for size in sizes:
        data = 3.0 * random.standard_normal((size, ROWS_OF_STEP))

        def ours(data: np.ndarray = data) -> float:
            state, total = start, 0.0
            for hour, z in enumerate(data, 1):
                taken = update(predict(drift, state, float(hour)), LinearMeasurement(z, design))
                state, total = taken.state, total + taken.innovation.log_likelihood
            return total

        def theirs(data: np.ndarray = data) -> float:
            model = MLEModel(data, k_states=n, k_posdef=n)
            model["design"], model["obs_cov"], model["selection"] = design, np.eye(ROWS_OF_STEP), np.eye(n)
            model["transition"], model["state_cov"], model["state_intercept"] = step.matrix, step.noise, step.shift
            mean = step.matrix @ start.mean + step.shift
            model.initialize_known(mean, step.matrix @ start.covariance @ step.matrix.T + step.noise)
            return float(model.ssm.loglike())

        assert_allclose(theirs(), ours(), rtol=1e-6)
        yield timed("filter, 6 linear rows a step", size, ours, "steps")
        yield timed("filter, 6 linear rows a step, statsmodels", size, theirs, "steps", peer=True)
