"""Discrete mistakes of a file: axes that count the other way, columns swapped, units, signs; each is one refit.

On a poor fit the one that mends it is named. On a good fit the negated axes are tried: a solution that fits as well
with an axis the other way round is another machine, which the same commands drive elsewhere. Reflecting the world in a
plane that holds the beam changes no cavity length, whatever is swept: sets of axes that such a reflection turns round
are the same machine seen in a mirror, and are left out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from fpcal_bayes.core.linalg import chi2_tail, listed
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.minimise import Solution, minimise, stepped
from fpcal_bayes.infer.fit.problem import Problem
from fpcal_bayes.infer.fit.signs import signed_as
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.axes import home, joint_axes
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.chain import optical_axis
from fpcal_bayes.model.trust import POOR_FIT_BELOW, Reason

#: A second minimum within this of the lowest sum of squares has at least a hundredth of its posterior density.
RIVAL_EXCESS = 9.2
#: Steps of the first look at a mistake, and how far above a fit that it is worth a second one its sum may still stand.
_FEW_STEPS, _WORTH = 60, 100.0
_LOOKED_AT, _SIGN_ROUNDS = 10, 2
#: Rows that tell whether an axis may count the other way, where there are many.
_ASKED_FIRST = 1000
#: Steps from a good fit to that of the same rows with axes the other way round: where there is one it is near.
_NEAR_STEPS = 20
#: A mistake that leaves less than this share of a poor sum of squares is named, even where the rest is not good.
_MENDS = 0.05
#: Factors that mend numbers in another unit than um and deg.
_LENGTHS = {1e3: "in mm", 1e-3: "in nm"}
_ANGLES = {
    float(np.degrees(1.0)): "in rad",
    float(np.radians(1.0)): "as degrees that were taken for rad and turned into degrees once more",
    1e3: "in thousands of deg",
    1e-3: "in mdeg",
}
#: With more joints that move, sets of more than two axes are too many to try.
_MOST_IN_SETS = 7
#: Sines of angles within which an axis counts as along, or across, a mirror plane's normal.
_ALONG = 0.2
#: Two worlds are one where no sweep tells them apart by this many standard deviations and this change in um.
_APART_SD, _APART = 5.0, 0.001


@dataclass(frozen=True)
class Mistake:
    """A mistake that a file may hold, with its rows as they are without it."""

    name: str  # a sentence without a dot
    sweeps: Sweeps
    joints: tuple[int, ...] = ()  # those that it speaks of


@dataclass(frozen=True)
class Mended:
    """How the rows fit once a mistake is mended."""

    name: str
    joints: int  # how many it speaks of; the fewer, the likelier
    sum_of_squares: float
    p_value: float


def mend(problem: Problem, solution: Solution, worst: Floats) -> list[Mended]:
    """Mistakes that explain a poor fit, the best first; sizes of residuals `worst` (n_rows,) order what is tried."""
    known = problem.sweeps.signed | problem.sweeps.absolute
    if known.sum() < min(problem.n_free, len(known)):
        return []
    sweeps, cell = problem.sweeps.take(known), problem.model.cell
    moved = sweeps.q_start != sweeps.q_end
    blame = np.abs(worst[known]) @ moved / np.maximum(moved.sum(axis=0), 1)
    before = _seen(problem, sweeps, solution.unknowns).sum_of_squares
    told = sorted(mistakes(cell, sweeps), key=lambda one: -max((blame[j] for j in one.joints), default=0.0))
    tried = [(_seen(problem, one.sweeps).sum_of_squares, one) for one in told]
    found = []
    for total, one in sorted(tried, key=lambda entry: entry[0])[:_LOOKED_AT]:
        if total < _MENDS * before + _WORTH * len(sweeps):
            other = _problem(problem, one.sweeps)
            best = minimise(other, np.zeros(other.n_unknowns)).sum_of_squares
            found.append(Mended(one.name, len(one.joints), best, chi2_tail(best, len(sweeps))))
    # Rows that are squeezed together fit anything: what fits far too well comes last.
    found.sort(key=lambda one: (one.p_value > 1.0 - 1e-9, one.sum_of_squares))
    good = [one for one in found if one.p_value >= POOR_FIT_BELOW or one.sum_of_squares < _MENDS * before]
    near = good[0].sum_of_squares * 1.2 + 10.0 if good else 0.0
    return sorted((one for one in good if one.sum_of_squares < near), key=lambda one: one.joints)


def mistakes(cell: Cell, sweeps: Sweeps) -> Iterator[Mistake]:
    """What may be wrong with all rows at once; poses outside the cell's limits are no candidates."""
    names, n = [f"q{j + 1}" for j in range(len(cell.joints))], len(cell.joints)
    moved = (sweeps.q_start != sweeps.q_end).any(axis=0)

    def within(sweeps: Sweeps) -> bool:
        q, slack = np.vstack([sweeps.q_start, sweeps.q_end]), 1e-9
        return bool(((q >= cell.low - slack) & (q <= cell.high + slack) & (np.abs(q) < 1e7)).all())

    def posed(matrix: Floats) -> Sweeps:
        return replace(sweeps, q_start=sweeps.q_start @ matrix, q_end=sweeps.q_end @ matrix)

    sides = side_sets(cell)
    for axes in axis_sets(cell, moved):
        verb = "counts" if len(axes) == 1 else "count"
        name = f"{listed([names[j] for j in axes])} {verb} the other way"
        name += ", that is, the fibre stands on the other side" * (frozenset(axes) in sides)
        yield Mistake(name, posed(np.diag([-1.0 if j in axes else 1.0 for j in range(n)])), axes)
    found = []
    for i, j in combinations(range(n), 2):
        swap = np.eye(n)
        swap[[i, j], [i, j]] = 0.0
        # Files hold um and deg: a column of the other kind is read in the other unit.
        swap[i, j], swap[j, i] = cell.joint_scales[[j, i]] / cell.joint_scales[[i, j]]
        found.append(Mistake(f"the columns of {names[i]} and {names[j]} are swapped", posed(swap), (i, j)))
    groups: list[tuple[int, ...]] = [(j,) for j in range(n)]
    groups += [tuple(np.flatnonzero(kind).tolist()) for kind in (~cell.revolute, cell.revolute) if kind.sum() > 1]
    for joints in groups:
        for factor, size in (_ANGLES if cell.revolute[joints[0]] else _LENGTHS).items():
            what = f"{listed([names[j] for j in joints])} stand{'s' * (len(joints) == 1)} {size}"
            found.append(Mistake(what, posed(np.diag([factor if j in joints else 1.0 for j in range(n)])), joints))
    yield from (one for one in found if within(one.sweeps))
    lengths = {-1.0: "dl_um has the other sign, or starts and ends are exchanged", 1e3: "dl_um stands in mm",
               1e-3: "dl_um stands in nm", 2.0: "dl_um is half of dL", 0.5: "dl_um is twice dL"}  # fmt: skip
    for factor, name in lengths.items():
        yield Mistake(name, replace(sweeps, dl=factor * sweeps.dl))
        if factor in _LENGTHS:
            both = name.replace("stands", "and sigma_um stand")
            yield Mistake(both, replace(sweeps, dl=factor * sweeps.dl, sigma=factor * sweeps.sigma))
    for way, word in ((1, "after"), (-1, "before")):
        yield Mistake(f"each dl_um stands in the row {word} its own", replace(sweeps, dl=np.roll(sweeps.dl, -way)))


def axis_sets(cell: Cell, moved: Floats) -> list[tuple[int, ...]]:
    """Sets of axes to negate, the smallest first, one of each that mirrors of the world turn into each other."""
    joints = np.flatnonzero(moved).tolist()
    most = len(joints) if len(joints) <= _MOST_IN_SETS else 2
    mirrors = mirror_sets(cell)
    seen: set[frozenset[int]] = set(map(frozenset, [(), *mirrors]))
    found = []
    for count in range(1, most + 1):
        for axes in combinations(joints, count):
            # What a joint that stands still would do is not seen either.
            alike = [frozenset(axes)] + [frozenset(axes) ^ frozenset(one) for one in mirrors]
            if not seen.intersection(alike):
                found.append(axes)
            seen.update(alike)
    return found


def mirror_sets(cell: Cell) -> list[tuple[int, ...]]:
    """Sets of axes that a reflection of the world in a plane with the beam turns round; no sweep tells them."""
    vector = cell.parameters.nominal
    directions, _ = joint_axes(cell, vector, home(cell))
    light = np.asarray(optical_axis(cell, vector), dtype=float)
    across = directions - np.outer(directions @ light, light)
    found: set[frozenset[int]] = set()
    for normal in across[np.linalg.norm(across, axis=1) > 1.0 - _ALONG]:
        along = np.abs(directions @ (normal / np.linalg.norm(normal)))
        if ((along < _ALONG) | (along > 1.0 - _ALONG)).all():
            # A direction along the normal is reflected; a turn about it is not, all other turns are.
            found.add(frozenset(np.flatnonzero((along > 0.5) != cell.revolute).tolist()))
    found |= {one ^ other for one in found for other in found}
    return sorted(tuple(sorted(one)) for one in found if one)


def side_sets(cell: Cell) -> set[frozenset[int]]:
    """Sets of axes that are negated where the fibre, or its mirror image, stands on the other side of the mirror."""
    vector = cell.parameters.nominal
    directions, _ = joint_axes(cell, vector, home(cell))
    along = np.abs(directions @ np.asarray(optical_axis(cell, vector), dtype=float)) > 0.5
    # A reflection in a plane across the beam.
    flipped = frozenset(np.flatnonzero(along != cell.revolute).tolist())
    return {flipped, *(flipped.symmetric_difference(one) for one in mirror_sets(cell))}


def second_solution(names: Sequence[str], solution: Solution, others: Sequence[Solution]) -> list[Reason]:
    """The second of the minima found, where it counts for the posterior; `names` are those of the unknowns."""
    if not others or others[0].sum_of_squares - solution.sum_of_squares >= RIVAL_EXCESS:
        return []
    rival = others[0]
    apart = np.argsort(-np.abs(rival.unknowns - solution.unknowns)[: len(names)])[:3]
    named = ", ".join(names[i] for i in sorted(apart))
    text = (
        f"a second solution fits nearly as well (sum of squares {rival.sum_of_squares:.1f} against "
        f"{solution.sum_of_squares:.1f}); it differs most in {named}, whose sd covers both; "
        "midpoints tell the two apart"
    )
    return [Reason("second-solution", text)]


def axis_rivals(problem: Problem, solution: Solution) -> list[Reason]:
    """Sets of axes that fit a good fit as well the other way round, with the sweep that tells; none that do nothing."""
    n = len(problem.target)
    if n > _ASKED_FIRST:
        # Some of many rows are asked first, and all only if these leave it open.
        few = problem.take(np.arange(n) % -(-n // _ASKED_FIRST) == 0)
        if not _axis_rivals(few, minimise(few, solution.unknowns)):
            return []
    return _axis_rivals(problem, solution)


def _axis_rivals(problem: Problem, solution: Solution) -> list[Reason]:
    sweeps, cell = problem.sweeps, problem.model.cell
    known = sweeps.signed | sweeps.absolute
    if not solution.converged:
        return []
    told = []
    for axes in axis_sets(cell, (sweeps.q_start != sweeps.q_end).any(axis=0)):
        way = np.ones(len(cell.joints))
        way[list(axes)] = -1.0
        # The whitening stays: that of another machine hardly differs where it fits as well.
        rows = problem.model.turned(problem.rows, way)
        other = replace(problem, rows=rows)
        near = _quick(other, solution.unknowns, _NEAR_STEPS)
        for _ in range(0 if known.all() else _SIGN_ROUNDS):
            # Rows without sign take that which this machine gives them.
            other = other.with_target(signed_as(problem, problem.model.predict(problem.values(near.unknowns), rows)))
            near = _quick(other, near.unknowns, _NEAR_STEPS)
        if near.sum_of_squares > solution.sum_of_squares + _WORTH * len(sweeps):
            continue
        rival = minimise(other, near.unknowns)
        if rival.converged and rival.sum_of_squares < solution.sum_of_squares + RIVAL_EXCESS:
            told.append((axes, rival, _telling(problem, solution, rival, way)))
    named = [(axes, rival, sweep) for axes, rival, sweep in told if sweep]
    if not named:
        return []
    mirrors = [frozenset(), *map(frozenset, mirror_sets(cell))]
    alike = sorted({tuple(sorted(frozenset(axes) ^ m)) for axes, _, _ in named for m in mirrors}, key=len)
    few = [listed([f"q{j + 1}" for j in axes]) for axes in alike if len(axes) <= len(alike[0]) + 1]
    _, rival, sweep = named[0]
    text = (
        f"with {', or '.join(few)} counted the other way the rows fit as well (sum of squares "
        f"{rival.sum_of_squares:.1f} against {solution.sum_of_squares:.1f}), and tasks would be driven elsewhere; "
        f"a sweep that tells: {sweep}"
    )
    return [Reason("second-solution", text)]


def _telling(problem: Problem, solution: Solution, rival: Solution, way: Floats) -> str:
    """The simplest sweep that the two worlds predict differently, or nothing."""
    model, sweeps = problem.model, problem.sweeps
    cell, n = model.cell, len(model.cell.joints)
    reach = np.abs(np.vstack([sweeps.q_start, sweeps.q_end])).max(axis=0)
    low, high = np.maximum(-reach, cell.low), np.minimum(reach, cell.high)
    base = home(cell)
    starts, ends = [], []
    for beside in [None, *range(n)]:
        for side in (low, high)[: 1 if beside is None else 2]:
            pose = base.copy()
            if beside is not None:
                pose[beside] = side[beside]
            for joint in range(n):
                for there in (low[joint], high[joint]):
                    end = pose.copy()
                    end[joint] = there
                    if joint != beside and there != pose[joint]:
                        starts.append(pose)
                        ends.append(end)
    if not starts:
        return ""
    q_start, q_end = np.array(starts), np.array(ends)
    ours, jacobian = model.predict_with_jacobian(problem.values(solution.unknowns), model.rows(q_start, q_end))
    theirs = model.predict(problem.values(rival.unknowns), model.rows(q_start * way, q_end * way))
    covariance = problem.covariance(solution.unknowns)[: problem.n_free, : problem.n_free]
    variance = np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian) + float(np.median(sweeps.sigma)) ** 2
    apart = np.abs(ours - theirs)
    clear = (apart > _APART) & (apart > _APART_SD * np.sqrt(variance))
    if not clear.any():
        return ""
    # Sweeps from home come first; among equals the clearest.
    best = int(np.argmax(np.where(clear, apart / np.sqrt(variance) / (1e6 * (q_start != base).sum(axis=1) + 1.0), 0)))
    shown_start, shown_end = (q[best] / cell.joint_scales for q in (q_start, q_end))
    joint = int(np.argmax(q_start[best] != q_end[best]))
    beside = [j for j in range(n) if shown_start[j] != base[j] and j != joint]
    at = "".join(f" at q{j + 1} = {shown_start[j]:g} {cell.joints[j].unit}" for j in beside)
    move = f"q{joint + 1} from {shown_start[joint]:g} to {shown_end[joint]:g} {cell.joints[joint].unit}{at}"
    return f"{move}, where dL is {ours[best]:.4g} um, or {theirs[best]:.4g} um the other way"


def _problem(problem: Problem, sweeps: Sweeps) -> Problem:
    return Problem.of(problem.model, sweeps, problem.considered, prior=problem.prior)


def _seen(problem: Problem, sweeps: Sweeps, start: Floats | None = None) -> Solution:
    return _quick(_problem(problem, sweeps), start)


def _quick(problem: Problem, start: Floats | None = None, steps: int = _FEW_STEPS) -> Solution:
    first = np.zeros(problem.n_unknowns) if start is None else start
    return Solution(*stepped(problem, first, steps, xtol=1e-8, gtol=1e-8), converged=False)
