"""Cells made from words: do they run the whole way, and does what may happen to them stay in their envelope?

python tests/robustness/cells.py whole [CELLS]       simulate, identify, plan, task-error on random cells
python tests/robustness/cells.py envelope [DRAWS]    whole paths of plans and tasks on four cells, by fresh draws
"""

import contextlib
import io
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from fpcal_bayes.cli.main import main as fpcal
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.design.commission import commission_plan
from fpcal_bayes.infer.design.plan import Planner, PlanSettings
from fpcal_bayes.infer.design.problem import DEFAULT_TASKS, Ground, estimate_ground, prior_ground
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.measure.protocol import add_midpoints
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model import chain
from fpcal_bayes.model.axes import home
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.tables import Envelope
from fpcal_bayes.model.envelope import require_task_within_envelope
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.joint_path import JointPath, sweep_path, task_path
from fpcal_bayes.model.margin import estimate_draws, normal_draws, prior_draws
from fpcal_bayes.motion.tasks import find_task, possible_tasks
from fpcal_bayes.simulator.sweeps import simulate

DATA = Path(__file__).parents[1] / "data"
SIDES = ("+x", "-x", "+y", "-y", "+z", "-z")


def random_words(rng: np.random.Generator) -> str:
    """Two to six of three translations and three turns, each once, in any order, counted either way."""
    words = [*"xyz", "rx", "ry", "rz"]
    rng.shuffle(words)
    return " ".join(f"{rng.choice(['', '-'])}{word}" for word in words[: int(rng.integers(2, 7))])


def run(*words: object) -> tuple[int, str]:
    """Exit status and what a command says on standard error."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            status = fpcal([str(word) for word in words])
        except SystemExit as end:
            status = int(end.code or 0)
    return status, said.getvalue().strip()


def truth_text(cell: Cell, rng: np.random.Generator) -> str:
    """True parameters drawn from the prior, as a TOML file; the gap is the one that the envelope states."""
    values = measured_gap(
        cell, cell.free.nominal + cell.free.prior_sd * np.clip(rng.standard_normal(len(cell.free)), -2, 2)
    )
    shown = cell.free.to_shown(values)
    return "[parameters]\n" + "".join(f"{p.name} = {v:.9f}\n" for p, v in zip(cell.free, shown.tolist(), strict=True))


def measured_gap(cell: Cell, values: np.ndarray) -> np.ndarray:
    """Parameters whose length at joint zero is the gap of the envelope: the fibre is shifted along its light."""
    model = CavityModel.of(cell.with_opd("axis"))
    light = np.asarray(chain.optical_axis(cell, model.vector(values)), dtype=float)
    length = float(model.predict(values, model.pose_rows(home(cell)[None]))[0])
    moved = values.copy()
    for name, part in zip(("x_wf", "y_wf", "z_wf"), light, strict=True):
        if name in cell.free:
            moved[cell.free.position(name)] += part * (length - cell.envelope.gap)
    return moved


def whole(seed: int, folder: Path) -> str:
    """One random cell through all commands; what goes wrong, or nothing."""
    rng = np.random.default_rng(seed)
    words, side = random_words(rng), str(rng.choice(SIDES))
    cell_file, truth, rows = folder / "c.toml", folder / "t.toml", folder / "r.csv"
    cell_file.unlink(missing_ok=True)
    common = ("--cell", cell_file, "--mechanics", "none")
    small = ("--n", 12, "--candidates", 150, "--draws", 8)
    away = side.replace("-", "minus-")
    steps: list[tuple[object, ...]] = [
        ("cell", "--new", words, "--side", away, "--gap-um", 300, "--gap-sd-um", 5, "-o", cell_file),
        ("plan", *common, "--commission", "-o", folder / "p.csv"),
        ("plan", *common, *small, "-o", folder / "q.csv", "--rows", rows),
        ("simulate", *common, "--protocol", rows, "--truth", truth, "-o", folder / "m.csv"),
        ("identify", folder / "m.csv", *common, "--json", folder / "e.json"),
        ("task-error", folder / "e.json", *common, "--json", folder / "x.json"),
    ]
    for number, step in enumerate(steps):
        status, said = run(*step)
        if number == 0 and status == 0:
            truth.write_text(truth_text(load_cell(cell_file, mechanics="none"), rng))
        if status != 0:
            last = said.splitlines()[-1][:250] if said else ""
            return f"seed {seed} {words!r} {side}: {step[0]} ends with {status}: {last}"
    return ""


def clearances(
    model: CavityModel, draws: np.ndarray, light: np.ndarray, fibre: np.ndarray, q: np.ndarray, envelope: Envelope
) -> tuple[np.ndarray, np.ndarray]:
    """Clearance and tilt of each draw and pose, from poses and discs; `light` and `fibre` are (n_draws, 1, 3)."""
    normal, origin = model.mirrors(draws, q)
    facing = -(normal * light).sum(-1)
    tilt = np.arccos(np.clip(facing, -1.0, 1.0))
    plane = -(normal * (origin - fibre)).sum(-1) - envelope.fibre_radius * np.sin(tilt)
    face = (light * (origin - fibre)).sum(-1) - envelope.mirror_radius * np.sin(tilt)
    return np.maximum(plane, face), tilt


def leaving(model: CavityModel, draws: np.ndarray, path: JointPath, rng: np.random.Generator) -> float:
    """Share of the draws that leave the envelope anywhere on a path."""
    cell = model.cell
    envelope = cell.envelope
    axis = replace(model, cell=cell.with_opd("axis"))
    length = axis.predict(draws, axis.pose_rows(home(cell)[None]))[:, 0]
    shift = envelope.gap + envelope.gap_sd * rng.standard_normal(len(draws)) - length
    vectors = [model.vector(values) for values in draws]
    light = np.array([chain.optical_axis(cell, vector) for vector in vectors])[:, None]
    # The gap is the measured one, whatever the draw says of the length at joint zero.
    fibre = np.array([chain.fibre_in_world(vector)[:3, 3] for vector in vectors])[:, None]
    fibre = fibre - shift[:, None, None] * light
    out = np.zeros(len(draws), dtype=bool)
    poses = np.unique(path.q, axis=0)
    for part in np.array_split(poses, max(1, len(poses) * len(draws) // 2_000_000)):
        clear, tilt = clearances(model, draws, light, fibre, part, envelope)
        out |= (clear < envelope.least_gap).any(axis=1) | (tilt > envelope.max_tilt).any(axis=1)
    return float(out.mean())


def bounded_cells(folder: Path) -> list[Cell]:
    """A 60 um cavity, one of 300 um from words, one of five axes, and the built-in one."""
    bounds = Envelope(15.0, 62.5, 2500.0, np.radians(20.0), 1000.0, gap=60.0, gap_sd=1.0)
    cells = [replace(load_cell(DATA / "lab7.toml", mechanics="none"), envelope=bounds)]
    for name, words, side in (("six", "x -y z ry -rx rz", "minus-z"), ("five", "x y z -rx rz", "+y")):
        run("cell", "--new", words, "--side", side, "--gap-um", 300, "--gap-sd-um", 3, "-o", folder / f"{name}.toml")
        cells.append(load_cell(folder / f"{name}.toml", mechanics="none"))
    return [*cells, load_cell(mechanics="none")]


def light_plan(ground: Ground, n: int) -> Sweeps:
    """A plan of `n` sweeps, searched with little effort: where it goes matters, not how good it is."""
    planner = Planner(ground, PlanSettings(n_candidates=200, starts=1, iterations=10, several=True))
    return planner.in_order(planner.best(n).sweeps)


def estimate_of(cell: Cell, rng: np.random.Generator, folder: Path) -> Estimate:
    """What a calibration leaves of a cell that is drawn from its prior."""
    free = cell.free
    values = measured_gap(cell, free.nominal + free.prior_sd * np.clip(rng.standard_normal(len(free)), -1.5, 1.5))
    sweeps = add_midpoints(
        join(
            [
                commission_plan(cell),
                light_plan(prior_ground(cell, tasks=possible_tasks(cell, DEFAULT_TASKS), draws=4), 12),
            ],
            "calibration",
        )
    )
    return identify(cell, simulate(cell, Truth(free, np.zeros(1), values[None]), sweeps, sigma_nm=5.0, seed=1)).estimate


def envelope(n_draws: int) -> int:
    """The largest share of draws that leave the envelope over plans and tasks of four cells."""
    worst = 0.0
    with tempfile.TemporaryDirectory() as text:
        for cell in bounded_cells(Path(text)):
            rng = np.random.default_rng(5)
            made = light_plan(prior_ground(cell, tasks=possible_tasks(cell, DEFAULT_TASKS), draws=4), 12)
            model, _ = prior_draws(cell, 2)
            draws = normal_draws(cell.free.nominal, np.diag(cell.free.prior_sd**2), n_draws, seed=11)
            shares = {"plan before": leaving(model, draws, sweep_path(cell, made.q_start, made.q_end), rng)}
            estimate = estimate_of(cell, rng, Path(text))
            known, few = estimate_draws(estimate)
            draws = normal_draws(estimate.values, estimate.covariance, n_draws, seed=12)
            made = light_plan(estimate_ground(estimate, tasks=possible_tasks(cell, DEFAULT_TASKS)), 8)
            shares["plan after"] = leaving(known, draws, sweep_path(cell, made.q_start, made.q_end), rng)
            for name in possible_tasks(cell):
                task = find_task(cell, estimate.vector(), name, n_points=31)
                q = task.q[task.ok]
                try:
                    require_task_within_envelope(known, few, q, name=name)
                except InputError as error:
                    print(f"{cell.name}: refused: {error}")
                    continue
                if len(q):
                    shares[name] = leaving(known, draws, task_path(cell, q), rng)
            print(f"{cell.name}: " + ", ".join(f"{name} {share:.1e}" for name, share in shares.items()), flush=True)
            worst = max(worst, *shares.values())
    print(f"largest share of {n_draws} draws outside: {worst:.1e}")
    return int(worst > 1e-4)


def main(arguments: list[str]) -> int:
    """Run what is asked for."""
    count = int(arguments[1]) if len(arguments) > 1 else 0
    if arguments[:1] == ["envelope"]:
        return envelope(count or 10_000)
    with tempfile.TemporaryDirectory() as folder:
        wrong = [said for seed in range(count or 200) if (said := whole(seed, Path(folder)))]
    print("\n".join(wrong))
    print(f"{len(wrong)} of {count or 200} random cells end otherwise than they should")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
