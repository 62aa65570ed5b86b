"""The paper's Fig 16: the experimental protocol as a flow chart, with what each step does on the simulated cell.

python studies/figure_16.py [--opd perpendicular]
"""

import numpy as np
from figure_common import SIGMA, Rig, arguments, save
from matplotlib.figure import Figure

from fpcal_bayes.infer import identify, observe
from fpcal_bayes.measure import paper_protocol, paper_truth
from fpcal_bayes.motion import task_path
from fpcal_bayes.simulator import simulate_um


def main() -> None:
    options = arguments(__doc__)
    rig = Rig.of(options.opd)
    plan = paper_protocol(rig.cell)
    turns = (plan.q_start != plan.q_end)[:, 3:].any(axis=1)
    sweeps = simulate_um(rig.cell, paper_truth(rig.cell), plan, sigma=SIGMA, seed=0)
    seen, found = observe(rig.cell, sweeps), identify(rig.cell, sweeps)
    task = task_path(rig.cell, found.estimate.vector(), "circle", n_points=361)
    before = task_path(rig.cell, rig.cell.parameters.nominal, "circle", n_points=361)
    reversing = sum(
        np.ptp(np.sign(np.diff(rig.lengths(_path(sweep)))).astype(int)) > 0
        for sweep in zip(plan.q_start, plan.q_end, strict=True)
    )
    steps = [
        f"align: mirror faces the fibre, L about {rig.lengths(np.zeros((1, 6)))[0]:.0f} um",
        f"at 15 nodes turn q4, q5, q6: {int(turns.sum())} sweeps, {reversing} of all turn round on the way",
        f"at 8 orientations move q3, q2, q1: {int((~turns).sum())} sweeps",
        f"count fringes: dL of each sweep, {1e3 * SIGMA:g} nm noise here",
        f"identify {len(found.free)} parameters: {seen.spectrum.rank} combinations are seen, "
        f"sum of squares {found.solution.sum_of_squares:.0f}",
        f"check the circle: {rig.change_nm(before):.0f} nm before, {rig.change_nm(task):.1f} nm after",
    ]
    figure = Figure(figsize=(7.5, 6.5), layout="constrained")
    axis = figure.subplots()
    axis.set(xlim=(0, 1), ylim=(-len(steps), 0.2))
    axis.axis("off")
    box = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": "#0072B2"}
    for i, step in enumerate(steps):
        axis.text(0.5, -i - 0.4, step, ha="center", va="center", fontsize=9, bbox=box)
        if i:
            axis.annotate("", (0.5, -i - 0.18), (0.5, -i + 0.38), arrowprops={"arrowstyle": "->"})
    save(
        figure,
        options,
        "figure-16",
        "15 nodes with three rotations each, then 8 orientations with three translations each: 69 equations for 21 "
        "parameters.",
        f"{len(plan)} sweeps, of which {reversing} turn round on the way and would be counted wrong by whole fringes; "
        f"they determine {seen.spectrum.rank} of {len(found.free)} combinations of the parameters, all that the circle "
        f"needs: {rig.change_nm(before):.0f} nm before, {rig.change_nm(task):.1f} nm after.",
    )


def _path(ends: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return ends[0] + np.linspace(0.0, 1.0, 201)[:, None] * (ends[1] - ends[0])


if __name__ == "__main__":
    main()
