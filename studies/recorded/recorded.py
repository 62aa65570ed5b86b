"""Arms that others recorded: held-out errors of the calibrated ball with and without mechanics, and how bands hold.

    python studies/recorded/recorded.py FOLDER [--json FILE]

FOLDER holds ROBOT/POSITION/hole_0.csv, hole_1.csv (or is one robot's folder): joint angles of a Franka Panda in rad, a
row for each posture with its ball in one of two sockets 50 mm apart; their plate stands elsewhere at each position.

Each position is held out in turn and looked at once, at the end. The others alone tell the sizes of priors and errors
(marginal likelihood), by which factor predictions of positions left out among them missed, which widens the bands, and
which mechanics the model has (score of such predictions). An error is the distance of a posture's predicted ball from
the mean of its socket.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from arm import MECHANICS, Arm, Floats, Postures, find_robots, read_robot
from evidence import PAIR, PAIR_SD, Fit
from scipy import stats

from fpcal_bayes import InputError

#: What the arm may do beside its geometry: nothing, or gains of the joints with any mechanics.
_ANY = ["+".join(("gains", *some)) for n in range(len(MECHANICS) + 1) for some in combinations(MECHANICS, n)]
CHOICES = ("geometry", *_ANY)
LEVEL = 0.95
_DRAWS = 4000
_FARTHEST = 3.0  # logarithm of the largest factor on a stated size that is believed


class Missed(NamedTuple):
    """Predictions of one position that a fit did not see."""

    error: Floats  # distance of each posture's ball from its socket's mean, in um, shape (n,)
    chi_square: Floats  # the same in units of the prediction, three degrees of freedom, shape (n,)
    volume: float  # mean logarithm of the determinant of the predicted covariances
    radius: Floats  # root mean square of the standard deviations of each posture, in um, shape (n,)
    pair: float  # distance of the first two sockets less the known one, in um; NaN of one socket
    pair_sd: float  # of what is predicted and of the distance as made


def judge(fit: Fit, held: Postures) -> Missed:
    """How a fit predicts held-out postures."""
    point, slope, noise = fit.predict(held)
    means, slopes = held.means(point), held.means(slope)
    off, change = point - means[held.socket], slope - slopes[held.socket]
    spread = noise + np.einsum("nij,jk,nlk->nil", change, fit.covariance, change, optimize=True)
    chi_square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
    volume = float(np.mean(np.linalg.slogdet(spread)[1]))
    radius = np.sqrt(np.trace(spread, axis1=1, axis2=2) / 3.0)
    pair = pair_sd = np.nan
    if len(held.places) > 1:
        along = (means[1] - means[0]) / np.linalg.norm(means[1] - means[0])
        row = along @ (slopes[1] - slopes[0])
        own = sum(along @ noise[held.socket == i].mean(axis=0) @ along / np.sum(held.socket == i) for i in (0, 1))
        pair = float(along @ (means[1] - means[0]) - PAIR)
        pair_sd = float(np.sqrt(row @ fit.covariance @ row + own + (PAIR_SD * np.exp(fit.factors[-3])) ** 2))
    return Missed(np.linalg.norm(off, axis=1), chi_square, volume, radius, pair, pair_sd)


class Held(NamedTuple):
    """One held-out position, lengths in mm; the fields of the table."""

    robot: str
    position: str
    postures: int
    error: float
    geometry: float  # error with geometry alone
    inside: float  # share of postures inside their band
    band: float  # median half width of a coordinate's band
    factor: float  # by which predictions missed the positions left out within training
    pair: float  # predicted distance of two sockets less the known one
    pair_band: float
    chosen: str
    scores: dict[str, float]  # of each choice within training, over that of geometry alone


def others(postures: Postures, position: str) -> Postures:
    """Those of all other positions."""
    return postures.at(*(one for one in postures.positions if one != position))


def hold_out(arm: Arm, robot: str, postures: Postures, position: str) -> Held:
    """Choose and fit on all other positions, then look at this one."""
    training, held = others(postures, position), postures.at(position)
    fits = {name: Fit(arm, training, name.split("+")) for name in CHOICES}
    if np.delete(fits["geometry"].factors, -3).max() > _FARTHEST:
        raise InputError(f"the chain of cell {arm.cell.name!r} does not explain its postures")
    inner = {name: _left_out(fit, training) for name, fit in fits.items()}
    (_, factor), chosen = max((found, name) for name, found in inner.items())
    found, plain = judge(fits[chosen], held), judge(fits["geometry"], held)
    # The factor is a mean over few sockets: its own spread makes the normal an F distribution.
    limit = factor * stats.f.ppf(LEVEL, 3, len(training.places))
    tail = np.sqrt(factor) * stats.t.ppf(0.5 + 0.5 * LEVEL, len(training.places))
    inside = float(np.mean(found.chi_square / 3.0 <= limit))
    lengths = (found.error.mean(), plain.error.mean(), tail * np.median(found.radius), found.pair, tail * found.pair_sd)
    error, bare, band, pair, pair_band = (1e-3 * float(length) for length in lengths)
    scores = {name: score - inner["geometry"][0] for name, (score, _) in inner.items()}
    return Held(robot, position, len(held.q), error, bare, inside, band, factor, pair, pair_band, chosen, scores)


def _left_out(fit: Fit, training: Postures) -> tuple[float, float]:
    """How a fit's mechanics and sizes predict each training position from the others: score and widening factor.

    The score is the mean logarithm of the normal density after widening; of one position alone it is the evidence.
    """
    if len(training.positions) < 2:
        return fit.log_evidence, 1.0
    every = ((others(training, one), training.at(one)) for one in training.positions)
    missed = [judge(Fit(fit.arm, rest, fit.kinds, fit.factors), held) for rest, held in every]
    ratio, volume = np.mean([(m.chi_square.mean() / 3.0, m.volume) for m in missed], axis=0).tolist()
    factor = max(1.0, ratio)
    return -0.5 * volume - 1.5 * (np.log(factor) + ratio / factor), factor


def pooled(rows: Sequence[Held], seed: int = 0) -> dict[str, list[float]]:
    """Means over postures with their 95 % interval when positions are drawn anew with replacement."""
    weight = np.array([row.postures for row in rows], dtype=float)
    drawn = np.random.default_rng(seed).integers(len(rows), size=(_DRAWS, len(rows)))
    told = {name: [getattr(row, name) for row in rows] for name in ("error", "geometry", "inside")}
    told |= {f"score {name}": [row.scores[name] for row in rows] for name in CHOICES[1:]}
    made = {}
    for name, values in told.items():
        anew = (weight * values)[drawn].sum(axis=1) / weight[drawn].sum(axis=1)
        made[name] = [float(np.average(values, weights=weight)), *np.quantile(anew, [0.025, 0.975]).tolist()]
    return made


def line(values: Sequence[object]) -> str:
    """A row of the table."""
    return " ".join(f"{value:11.3f}" if isinstance(value, float) else f"{value!s:>11}" for value in values)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the recorded postures")
    parser.add_argument("--json", type=Path, help="write every number of the table")
    options = parser.parse_args(argv)
    rows, refused = [], False
    if options.json and not options.json.parent.is_dir():
        print(f"recorded: error: {options.json}: expected a file in a folder that is there", file=sys.stderr)
        return 2
    try:
        arm, folders = Arm(), find_robots(options.folder)
    except InputError as error:
        print(f"recorded: error: {error}", file=sys.stderr)
        return 2
    print(line(Held._fields[:-1]), flush=True)
    for folder in folders:
        name = folder.resolve().name
        try:
            postures = read_robot(folder, len(arm.cell.joints))
            for position in postures.positions:
                rows.append(hold_out(arm, name, postures, position))
                print(line(rows[-1][:-1]), flush=True)
        except InputError as error:
            print(f"{name} refused: {error}", flush=True)
            refused = True
    groups = {name: [row for row in rows if row.robot == name] for name in dict.fromkeys(row.robot for row in rows)}
    summary = {name: pooled(own) for name, own in (groups | ({"all": rows} if rows else {})).items()}
    for name, means in summary.items():
        print("\n".join(line([name, *values, key]) for key, values in means.items()))
    if options.json:
        text = json.dumps({"positions": [r._asdict() for r in rows], "pooled": summary}, indent=1)
        options.json.write_text(text.replace("NaN", "null"))
    return 2 if refused else 0


if __name__ == "__main__":
    sys.exit(main())
