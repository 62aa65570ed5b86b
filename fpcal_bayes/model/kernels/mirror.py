"""Compiled kernel: mirror normal and origin for many parameter vectors and poses, without the rest of wTt."""

import math

import numpy as np

from fpcal_bayes.core.typing import Bools, Floats, Ints
from fpcal_bayes.model.kernels.compile import compiled
from fpcal_bayes.model.kernels.lengths import (
    ALPHA,
    BETA,
    BETA_ET,
    GAIN,
    RUNOUT_COS,
    RUNOUT_SIN,
    STRIDE,
    THETA,
    THETA_ET,
    Z_ET,
    D,
    R,
    fill_block,
    start_block,
)


@compiled
def batch_mirrors(base: Floats, slots: Ints, values: Floats, revolute: Bools, q: Floats) -> tuple[Floats, Floats]:
    """Mirror normals and origins, columns three and four of wTt (paper equation (19)), (n_vectors, n_poses, 3) each."""
    n_links, n_poses = revolute.size, q.shape[0]
    first = STRIDE * n_links
    normals, origins = np.empty((values.shape[0], n_poses, 3)), np.empty((values.shape[0], n_poses, 3))
    block, block_cosine, block_sine = start_block(base, n_links, 1, 1)
    joint_cos, joint_sin = np.cos(q), np.sin(q)
    for k in range(values.shape[0]):
        fill_block(slots, values[k : k + 1], n_links, block, block_cosine, block_sine)
        vector, cosine, sine = block[:, 0], block_cosine[:, 0], block_sine[:, 0]
        for m in range(n_poses):
            nx = sine[first + THETA_ET]
            ny = -cosine[first + THETA_ET] * sine[first + BETA_ET]
            nz = cosine[first + THETA_ET] * cosine[first + BETA_ET]
            ox, oy, oz = 0.0, 0.0, vector[first + Z_ET]
            for link in range(n_links - 1, -1, -1):
                at = STRIDE * link
                c, s = cosine[at + THETA], sine[at + THETA]
                oz += vector[at + R]
                if revolute[link]:
                    turned_cos, turned_sin = joint_cos[m, link], joint_sin[m, link]
                    if vector[at + GAIN] != 0.0:
                        turned = q[m, link] * (1.0 + vector[at + GAIN])
                        turned_cos, turned_sin = math.cos(turned), math.sin(turned)
                    oz += vector[at + RUNOUT_COS] * turned_cos + vector[at + RUNOUT_SIN] * turned_sin
                    c, s = c * turned_cos - s * turned_sin, s * turned_cos + c * turned_sin
                else:
                    oz += q[m, link] * (1.0 + vector[at + GAIN])
                nx, ny = c * nx - s * ny, s * nx + c * ny
                ox, oy = c * ox - s * oy + vector[at + D], s * ox + c * oy
                c, s = cosine[at + ALPHA], sine[at + ALPHA]
                ny, nz = c * ny - s * nz, s * ny + c * nz
                oy, oz = c * oy - s * oz, s * oy + c * oz
                c, s = cosine[at + BETA], sine[at + BETA]
                nx, nz = c * nx + s * nz, c * nz - s * nx
                ox, oz = c * ox + s * oz, c * oz - s * ox
            normals[k, m, 0], normals[k, m, 1], normals[k, m, 2] = nx, ny, nz
            origins[k, m, 0], origins[k, m, 1], origins[k, m, 2] = ox, oy, oz
    return normals, origins
