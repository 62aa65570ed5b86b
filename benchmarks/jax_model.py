"""The model once more, in JAX, from the equations: for samplers that need gradients and checks that share no code."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from fpcal_bayes.infer import Identification
from fpcal_bayes.model import EXTRINSICS

jax.config.update("jax_enable_x64", True)


def changes_in_jax(found: Identification) -> Callable[[jax.Array], jax.Array]:
    """Changes of cavity length in um of each sweep, by the unknowns in prior standard deviations from their means."""
    problem, cell = found.problem, found.problem.model.cell
    sweeps, free = problem.sweeps, problem.model.free
    held = jnp.asarray(problem.model.held)
    revolute, perpendicular = cell.revolute, cell.opd == "perpendicular"
    at = {name: int(cell.parameters[name].slot) for name in EXTRINSICS}
    q = jnp.asarray(np.concatenate([sweeps.q_start, sweeps.q_end]))
    mean, sd = jnp.asarray(problem.prior.mean), jnp.asarray(problem.prior.sd)

    def rot_x(a: jax.Array) -> jax.Array:
        c, s = jnp.cos(a), jnp.sin(a)
        return jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])

    def rot_y(a: jax.Array) -> jax.Array:
        c, s = jnp.cos(a), jnp.sin(a)
        return jnp.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    def rot_z(a: jax.Array) -> jax.Array:
        c, s = jnp.cos(a), jnp.sin(a)
        return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def length(vector: jax.Array, pose: jax.Array) -> jax.Array:
        rotation, origin = jnp.eye(3), jnp.zeros(3)
        for i, turns in enumerate(revolute):
            beta, alpha, d, theta, r = vector[8 * i : 8 * i + 5]
            fixed = rotation @ rot_y(beta) @ rot_x(alpha)
            rotation = fixed @ rot_z(theta + pose[i] if turns else theta)
            origin = (
                origin
                + fixed @ jnp.array([d, 0.0, 0.0])
                + rotation @ jnp.array([0.0, 0.0, 1.0]) * (r if turns else r + pose[i])
            )
        z = jnp.array([0.0, 0.0, 1.0])
        origin = origin + rotation @ z * vector[at["z_et"]]
        normal = rotation @ rot_x(vector[at["beta_et"]]) @ rot_y(vector[at["theta_et"]]) @ z
        fibre = jnp.array([vector[at[name]] for name in ("x_wf", "y_wf", "z_wf")])
        distance = normal @ (origin - fibre)
        if perpendicular:
            return jnp.abs(distance)
        axis = -(rot_x(vector[at["beta_wf"]]) @ rot_z(vector[at["theta_wf"]]))[:, 1]
        return distance / (normal @ axis)

    def changes(unknowns: jax.Array) -> jax.Array:
        vector = held.at[jnp.asarray(free.slots)].set(mean + sd * unknowns)
        starts, ends = jnp.split(jax.vmap(length, (None, 0))(vector, q), 2)
        return ends - starts

    return changes
