"""Each step of the program against the size of its input."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from measuring import Point, timed
from scaling_inputs import SIGMA, drawn_near, measured, random_poses, random_sweeps, sessions, wide_cell

from fpcal_bayes import ingest
from fpcal_bayes.infer import (
    Planner,
    PlanSettings,
    Problem,
    ProposalMixture,
    identify,
    make_target,
    minimise,
    observe,
    prior_ground,
)
from fpcal_bayes.io import write_csv
from fpcal_bayes.measure import paper_protocol, paper_truth
from fpcal_bayes.model import CavityModel, Cell, InverseModel
from fpcal_bayes.report import write_campaign_report
from fpcal_bayes.simulator import record_sweeps, simulate_um
from fpcal_bayes.tracking import track

#: Proposals of a step of the sampler.
PROPOSALS = 32
#: Sweeps of a plan, and draws of the prior for which it is made.
PLANNED, DRAWS = 5, 16


def by_rows(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """Model, fit and posterior against the number of rows."""
    random = np.random.default_rng(0)
    for n in sizes:
        sweeps = measured(cell, n)
        problem = Problem.of(CavityModel.of(cell), sweeps)
        model, values, start = problem.model, cell.free.nominal, np.zeros(problem.n_unknowns)
        rows = model.rows(sweeps.q_start, sweeps.q_end)
        found = identify(cell, sweeps)
        atlas = ProposalMixture(*make_target(found, "gaussian"))
        normal, choice = random.standard_normal((PROPOSALS, problem.n_unknowns)), random.random(PROPOSALS)
        yield timed("changes of length", n, lambda m=model, v=values, r=rows: m.predict(v, r))
        yield timed("Jacobian", n, lambda m=model, v=values, r=rows: m.predict_with_jacobian(v, r))
        yield timed("Levenberg-Marquardt", n, lambda p=problem, s=start: minimise(p, s))
        yield timed("identify", n, lambda s=sweeps: identify(cell, s))
        yield timed("observe", n, lambda s=sweeps: observe(cell, s))
        yield timed(f"sample, {PROPOSALS} proposals", n, lambda a=atlas, z=normal, u=choice: a.propose(z, u))


def by_session_rows(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """The filter: a calibration of 69 rows, then two sessions of many rows."""
    for n in sizes:
        large = sessions(cell, 3, n)
        yield timed("track, 2 sessions of so many", n, lambda s=large: track(cell, s))


def by_sessions(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """The filter: a calibration of 69 rows, then many sessions of six rows."""
    for n in sizes:
        many = sessions(cell, 1 + n, 6)
        yield timed("track, 6 rows a session", n, lambda s=many: track(cell, s), "sessions")


def by_poses(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """The inverse model against the number of poses."""
    vector = CavityModel.of(cell).vector(paper_truth(cell).values[0])
    inverse = InverseModel(cell)
    for n in sizes:
        poses = inverse.tool_poses(vector, random_poses(cell, n))
        yield timed("inverse model", n, lambda p=poses: inverse.solve(vector, p), "poses")


def by_traces(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """Reading of recorded traces against their number; the paper's sweeps again and again."""
    paper = paper_protocol(cell)
    for n in sizes:
        plan = paper.take(np.arange(n) % len(paper))
        index = record_sweeps(cell, paper_truth(cell), plan, seed=5, scans=False)
        yield timed("ingest", n, lambda i=index: ingest(i, cell), "traces")


def by_candidates(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """A plan from the prior against the number of sweeps to choose from."""
    ground = prior_ground(cell, draws=DRAWS, seed=1)
    reference = ground.expected_sd(paper_protocol(cell), readings=1)
    for n in sizes:
        settings = PlanSettings(n_candidates=n)
        yield timed(
            f"plan of {PLANNED}, {DRAWS} draws",
            n,
            lambda s=settings: Planner(ground, s, reference).best(PLANNED),
            "candidates",
        )


def by_report_rows(cell: Cell, sizes: list[int]) -> Iterator[Point]:
    """The report of one session against its rows."""
    with tempfile.TemporaryDirectory() as name:
        page = Path(name) / "report.html"
        for n in sizes:
            file = Path(name) / f"{n}.csv"
            write_csv(file, measured(cell, n), cell)
            yield timed("report", n, lambda f=file: write_campaign_report(f, cell, page))


def by_parameters(sizes: list[int]) -> Iterator[Point]:
    """Jacobian and one fit of 1,000 rows against the number of free parameters."""
    for n in sizes:
        cell = wide_cell(n)
        at = drawn_near(cell)
        sweeps = simulate_um(cell, at, random_sweeps(cell, 1000), sigma=SIGMA, seed=4)
        problem = Problem.of(CavityModel.of(cell), sweeps)
        model, truth, start = problem.model, at.values[0], np.zeros(problem.n_unknowns)
        rows = model.rows(sweeps.q_start, sweeps.q_end)
        of = "parameters"
        yield timed("Jacobian, 1,000 rows", n, lambda m=model, v=truth, r=rows: m.predict_with_jacobian(v, r), of)
        yield timed("Levenberg-Marquardt, 1,000 rows", n, lambda p=problem, s=start: minimise(p, s), of)
