"""The chain of a cell in Pinocchio: what the peers compute with."""

import numpy as np
import pinocchio

from fpcal_bayes.model import Cell, chain


class PinocchioCell:
    """Each link's fixed placement, then its joint about or along Z; lengths in um.

    Parameters
    ----------
    vector
        Parameters of the chain, as `CavityModel.vector` gives them.
    """

    def __init__(self, cell: Cell, vector: np.ndarray) -> None:
        self.model = pinocchio.Model()
        parent, end = 0, pinocchio.SE3.Identity()
        for i, joint in enumerate(cell.joints):
            # At q = 0 the joint's own motion is the identity, and it stands last: TransZ(r) commutes with RotZ(q).
            placement = pinocchio.SE3(chain.link_transform(vector[8 * i : 8 * i + 8], 0.0, joint.kind == "prismatic"))
            kind = pinocchio.JointModelPZ() if joint.kind == "prismatic" else pinocchio.JointModelRZ()
            parent = self.model.addJoint(parent, kind, end * placement, f"q{i + 1}")
        self.tool = parent
        self.mirror = self._frame("mirror", parent, chain.mirror_in_tool(cell, vector))
        self.fibre = self._frame("fibre", 0, chain.fibre_in_world(vector))
        self.data = self.model.createData()

    def _frame(self, name: str, parent: int, placement: np.ndarray) -> int:
        kind = pinocchio.FrameType.OP_FRAME
        frame: int = self.model.addFrame(pinocchio.Frame(name, parent, pinocchio.SE3(placement), kind))
        return frame

    def mirror_pose(self, q: np.ndarray) -> np.ndarray:
        """wTt, shape (4, 4)."""
        pinocchio.forwardKinematics(self.model, self.data, q)
        placement: np.ndarray = pinocchio.updateFramePlacement(self.model, self.data, self.mirror).homogeneous
        return placement

    def mirror_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Velocity of the mirror in the world by the joints, shape (6, n_joints)."""
        frame = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian: np.ndarray = pinocchio.computeFrameJacobian(self.model, self.data, q, self.mirror, frame)
        return jacobian

    def run(self, poses: list[np.ndarray]) -> None:
        """Forward kinematics of every pose, without reading the result out."""
        model, data = self.model, self.data
        for q in poses:
            pinocchio.forwardKinematics(model, data, q)

    def run_jacobians(self, poses: list[np.ndarray]) -> None:
        """Joint Jacobian of every pose, without reading the result out."""
        model, data = self.model, self.data
        for q in poses:
            pinocchio.computeJointJacobians(model, data, q)

    def joints_at(self, target: "pinocchio.SE3") -> np.ndarray:
        """Joint values at which the tool takes a pose, by damped Newton steps from zero, shape (n_joints,)."""
        q = np.zeros(self.model.nq)
        for _ in range(50):
            pinocchio.computeJointJacobians(self.model, self.data, q)
            error = pinocchio.log6(self.data.oMi[self.tool].actInv(target)).vector
            if np.abs(error[:3]).max() < 1e-9 and np.abs(error[3:]).max() < 1e-12:
                break
            jacobian = pinocchio.getJointJacobian(self.model, self.data, self.tool, pinocchio.ReferenceFrame.LOCAL)
            q = q + np.linalg.solve(jacobian.T @ jacobian + 1e-9 * np.eye(len(q)), jacobian.T @ error)
        return q
