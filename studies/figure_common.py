"""What the studies of the paper's figures share: the true robot, its calibration, irradiance, and where plots go."""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fpcal_bayes.infer import identify
from fpcal_bayes.io import load_cell
from fpcal_bayes.measure import paper_protocol, paper_truth
from fpcal_bayes.model import CavityModel, Cell, Estimate
from fpcal_bayes.motion import Task
from fpcal_bayes.simulator import simulate_um

SIGMA = 0.005
#: Visibility of the fringes: bare fibre and mirror, coupling as in the paper's Fig 1.
VISIBILITY = 0.8


@dataclass(frozen=True)
class Rig:
    """A robot whose true parameters are Tables II and III."""

    cell: Cell
    model: CavityModel
    truth: np.ndarray

    @classmethod
    def of(cls, opd: str) -> "Rig":
        cell = load_cell(opd=opd, mechanics="none")
        return cls(cell, CavityModel.of(cell), paper_truth(cell).values[0])

    def calibrated(self, free: str = "all", hold: str = "consider", seed: int = 0) -> Estimate:
        """The estimate from the paper's 69 sweeps at 5 nm noise; what is not free is held at nominal."""
        sweeps = simulate_um(self.cell, paper_truth(self.cell), paper_protocol(self.cell), sigma=SIGMA, seed=seed)
        return identify(self.cell, sweeps, free=free, hold=hold).estimate

    def lengths(self, q: np.ndarray) -> np.ndarray:
        """True cavity lengths in um at joint vectors `q` (n, 6)."""
        return self.model.predict(self.truth, self.model.pose_rows(q))

    def irradiance(self, q: np.ndarray) -> np.ndarray:
        """Two-beam irradiance of the true cavity, 1 at a peak."""
        phase = 4.0 * np.pi * self.lengths(q) / self.cell.wavelength
        return (1.0 + VISIBILITY * np.cos(phase)) / (1.0 + VISIBILITY)

    def change_nm(self, task: Task) -> float:
        """True peak to peak of the cavity length along the points that can be driven to, in nm."""
        return float(1e3 * np.ptp(self.lengths(task.q[task.ok])))

    def fringes(self, change_nm: float) -> float:
        """Fringes of half a wavelength that a change of cavity length makes."""
        return change_nm / (500.0 * self.cell.wavelength)


def arguments(summary: str | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=summary)
    parser.add_argument("--opd", choices=("axis", "perpendicular"), default="axis")
    parser.add_argument(
        "-o", dest="output", type=Path, default=Path(__file__).parent / "output", help="folder of the figure"
    )
    return parser.parse_args()


def save(figure: Figure, options: argparse.Namespace, name: str, paper: str, here: str) -> None:
    """Write the figure with what the paper reports beside what is found, and print both."""
    figure.supxlabel(f"Paper: {paper}\nHere: {here}", fontsize=8, ha="left", x=0.01, wrap=True)
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / f"{name}-{options.opd}.png"
    figure.savefig(path, dpi=130)
    found = {"name": name, "opd": options.opd, "paper": paper, "here": here, "figure": path.name}
    path.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")
    print(f"{name} ({options.opd})\n  paper: {paper}\n  here:  {here}\n  {path}")
