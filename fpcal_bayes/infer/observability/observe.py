"""Everything that a set of sweeps, measured or planned, can tell about a cell, in one report."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import finite
from fpcal_bayes.core.notebook import Brief, Result
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.infer.fit.identify import Identification, identify
from fpcal_bayes.infer.fit.prior import Prior
from fpcal_bayes.infer.fit.spectrum import WEAK_SHARE, Spectrum, Status, spectrum_of, statuses
from fpcal_bayes.infer.mechanics.judge import terms_content
from fpcal_bayes.infer.mechanics.rows import row_whitening
from fpcal_bayes.infer.observability.gauges import Gauge, find_gauges
from fpcal_bayes.infer.observability.information import Information, gain_of, information_of
from fpcal_bayes.infer.observability.measures import (
    BaseParameter,
    Bounds,
    Indices,
    base_parameters,
    bounds_of,
    indices_of,
)
from fpcal_bayes.measure.protocol import add_midpoints
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.trust import Trust

#: Standard deviation of an absolute length where a block supposes one: an eighth of a wavelength, in wavelengths.
_ABSOLUTE_SD = 0.125
_DRAWS = 16


@dataclass(frozen=True, repr=False)
class Block(Brief):
    """What a part of the sweeps, or the sweeps with an addition, tells."""

    name: str
    n_rows: int
    spectrum: Spectrum
    indices: Indices


@dataclass(frozen=True)
class Observability(Result):
    """Result of `observe`."""

    # cell, sweeps, parameters: what was analysed
    cell: Cell
    sweeps: Sweeps
    parameters: ParameterSet
    identification: Identification | None  # the fit at which the sweeps were linearised, or None for a plan
    # point of linearisation, shape (n,), in um and rad: the maximum of the posterior, or a draw of the prior
    values: Floats
    ranks: tuple[int, ...]  # rank at each point that was tried; one for measured sweeps
    # spectrum, indices: singular values of the whitened Jacobian in prior-scaled units, and the observability indices
    spectrum: Spectrum
    indices: Indices
    covariance: Floats  # expected or found posterior covariance in prior-scaled units, shape (n, n)
    status: tuple[Status, ...]  # one per parameter
    gauges: tuple[Gauge, ...]
    base: tuple[BaseParameter, ...]
    blocks: tuple[Block, ...]
    information: Information
    # cramer-Rao bounds by what is free: ``full``, ``extrinsic``, ``intrinsic``; with the parameters they are for
    bounds: dict[str, tuple[ParameterSet, Bounds]]
    candidates: tuple[tuple[str, float], ...]  # worth in bits of one more row: (label, bits), best first
    warnings: tuple[str, ...]  # sentences about what is not to be trusted

    def __repr__(self) -> str:
        n = len(self.parameters)
        return f"Observability({len(self.sweeps)} rows, rank {self.spectrum.rank} of {n}, {len(self.gauges)} gauges)"

    @cached_property
    def mechanics(self) -> dict[str, Any] | None:
        """What the rows say of the stated sizes of error motions, and which terms the residuals show."""
        machine = None if self.identification is None else self.identification.machine
        return None if machine is None else terms_content(machine)

    @cached_property
    def contraction(self) -> Floats:
        """Share of the prior variance that the data take away, from 0 to 1, shape (n,)."""
        return 1.0 - np.diag(self.covariance)

    @cached_property
    def correlation(self) -> Floats:
        """Posterior correlations, shape (n, n)."""
        sd = np.sqrt(np.diag(self.covariance))
        return np.asarray(self.covariance / np.outer(sd, sd))

    def strongest_correlations(self, name: str, n: int = 3) -> list[tuple[str, float]]:
        """The parameters most correlated with one, strongest first."""
        row = self.correlation[self.parameters.position(name)]
        order = [int(i) for i in np.argsort(-np.abs(row), kind="stable") if self.parameters.names[i] != name]
        return [(self.parameters.names[i], float(row[i])) for i in order[:n]]

    @property
    def trust(self) -> Trust:
        """What is held against the fit at which measured sweeps were linearised."""
        return Trust() if self.identification is None else self.identification.estimate.trust

    def content(self) -> dict[str, Any]:
        """What ``observe --json`` writes, without schema and command."""
        sd = self.parameters.to_shown(np.sqrt(np.diag(self.covariance)) * self.parameters.prior_sd)
        shown = self.parameters.to_shown(self.values)
        scale = self.parameters.to_shown(self.parameters.prior_sd)
        bounds = {
            free: {
                p.name: {"unbiased": finite(float(u) * s), "with_prior": float(w) * s}
                for p, u, w, s in zip(
                    chosen, b.unbiased, b.with_prior, chosen.to_shown(chosen.prior_sd).tolist(), strict=True
                )
            }
            for free, (chosen, b) in self.bounds.items()
        }
        fit = self.identification.content()["fit"] if self.identification is not None else None
        told = self.information
        return {
            **({} if self.mechanics is None else {"mechanics": self.mechanics}),
            "parameters": {
                p.name: {
                    "value": float(shown[i]),
                    "sd": float(sd[i]),
                    "unit": p.unit,
                    "prior_sd": float(scale[i]),
                    "status": self.status[i],
                    "contraction": float(self.contraction[i]),
                    "correlations": [{"name": n, "correlation": c} for n, c in self.strongest_correlations(p.name)],
                }
                for i, p in enumerate(self.parameters)
            },
            "covariance": {
                "names": list(self.parameters.names),
                "matrix": (self.covariance * np.outer(scale, scale)).tolist(),
            },
            "fit": fit or {"n_sweeps": len(self.sweeps), "rank": self.spectrum.rank},
            "cell": {"name": self.cell.name, "sha256": self.cell.sha256, "opd": self.cell.opd},
            "observability": {
                "rank": self.spectrum.rank,
                "n_parameters": len(self.parameters),
                "tolerance": self.spectrum.tolerance,
                "gap": finite(self.spectrum.gap),
                "ranks_tried": list(self.ranks),
                "linearised_at": "prior draws" if self.identification is None else "maximum of the posterior",
                "singular_values": self.spectrum.singular_values.tolist(),
                "indices": self.indices.content(),
                "condition": finite(self.indices.condition),
                "gauges": [asdict(gauge) for gauge in self.gauges],
                "base_parameters": [base.content() for base in self.base],
                "blocks": [
                    {"name": block.name, "n_rows": block.n_rows, "rank": block.spectrum.rank}
                    | {"condition": finite(block.indices.condition), "indices": block.indices.content()}
                    for block in self.blocks
                ],
                "bounds": bounds,
                "weak_share": WEAK_SHARE,
            },
            "information": {
                "sweeps": [
                    {"label": label, "leverage": float(leverage), "bits": float(bits)}
                    for label, leverage, bits in zip(told.labels, told.leverage, told.bits, strict=True)
                ],
                "redundant": told.redundant,
                "cumulative": {"rows": told.cumulative_rows.tolist(), "bits": told.cumulative_bits.tolist()},
                "candidates": [{"label": label, "bits": bits} for label, bits in self.candidates],
            },
            "warnings": list(self.warnings),
        }


def observe(cell: Cell, sweeps: Sweeps, *, sigma: float = 0.005) -> Observability:
    """Analyse what sweeps can tell about the free parameters of a cell.

    Parameters
    ----------
    cell
        With its priors and its path model.
    sweeps
        Sweeps of one session; measured ones are linearised at the maximum of the posterior, a plan over draws of
        the prior.
    sigma
        Standard deviation supposed for a plan's rows that have none, in um.
    """
    used = sweeps.take(sweeps.kind != "path")
    if len(used) == 0:
        raise InputError(f"{sweeps.file}: every row is of kind path, expected at least one sweep")
    identification = identify(cell, used) if used.measured else None
    if identification is None:
        used = replace(used, sigma=np.where(np.isfinite(used.sigma), used.sigma, sigma))
        points = Prior.of(cell.free).values(np.random.default_rng(0).standard_normal((_DRAWS, len(cell.free))))
    else:
        points = identification.problem.values(identification.solution.unknowns)[None]

    model = CavityModel.of(cell)
    jacobians = list(_whitened_jacobians(model, used, points))
    spectra = [spectrum_of(jacobian) for jacobian in jacobians]
    ranks = tuple(spectrum.rank for spectrum in spectra)
    # A draw may fall on a symmetry by chance; the rank that the sweeps have in general is the largest.
    chosen = int(np.argmax(ranks))
    jacobian, spectrum, values = jacobians[chosen], spectra[chosen], points[chosen]
    covariance = np.mean([(s.directions.T / (1.0 + s.singular_values**2)) @ s.directions for s in spectra], axis=0)
    # Statuses of a plan: what is to be expected, on average over the prior.
    status = statuses(np.mean([s.null_share for s in spectra], axis=0), np.diag(covariance))
    parts = [(free or "full", cell.select(free or "all")) for free in ("", "extrinsic", "intrinsic")]
    warnings = list(identification.warnings) if identification is not None else []
    if spectrum.gap < 1e3:
        warnings.append(
            f"the rank is not clear-cut: singular values {spectrum.rank} and {spectrum.rank + 1} differ only by a "
            f"factor {spectrum.gap:.0f}"
        )
    return Observability(
        cell=cell,
        sweeps=used,
        parameters=cell.free,
        identification=identification,
        values=values,
        ranks=ranks,
        spectrum=spectrum,
        indices=indices_of(spectrum, len(used)),
        covariance=covariance,
        status=status,
        gauges=tuple(find_gauges(model, values, spectrum.null_space)),
        base=base_parameters(spectrum, cell.free),
        blocks=_blocks(model, used, values, jacobian),
        information=information_of(jacobian, used),
        bounds={
            free: (part, bounds_of(jacobian[:, cell.free.positions(part.names)])) for free, part in parts if len(part)
        },
        candidates=_worth(model, used, values, jacobian, sigma),
        warnings=tuple(warnings),
    )


def whitened_jacobian(model: CavityModel, sweeps: Sweeps, values: Floats) -> Floats:
    """Derivatives of the whitened rows by the free parameters in prior units, shape (n_rows, n)."""
    return next(_whitened_jacobians(model, sweeps, values[None]))


def _whitened_jacobians(model: CavityModel, sweeps: Sweeps, points: Floats) -> Iterator[Floats]:
    """The same at several points (n_points, n)."""
    rows = sweeps.laid_out(model)
    moves = model.cell.mechanics is not None or model.cell.repeatability.any()
    for number, point in enumerate(points):
        if moves or not number:
            whitening = row_whitening(model, sweeps, point)
        yield whitening.apply(model.predict_with_jacobian(point, rows)[1] * model.free.prior_sd)


def _absolute_row(cell: Cell, sweeps: Sweeps) -> Sweeps:
    """One absolute length, at the start of the first sweep."""
    row = sweeps.take(np.array([0]))
    return replace(
        row,
        kind=np.array(["absolute"]),
        group=np.array([""]),
        label=np.array(["absolute length"]),
        q_end=row.q_start,
        sigma=np.array([_ABSOLUTE_SD * cell.wavelength]),
    )


def _blocks(model: CavityModel, sweeps: Sweeps, values: Floats, jacobian: Floats) -> tuple[Block, ...]:
    """The sweeps as they are, their parts, and what a midpoint each or one absolute length would add."""
    moved = sweeps.q_start != sweeps.q_end
    turned = moved[:, model.cell.revolute].any(axis=1)
    slid = moved[:, ~model.cell.revolute].any(axis=1)
    parts = {"all": np.ones(len(sweeps), dtype=bool), "rotations": turned & ~slid, "translations": slid & ~turned}
    blocks = []
    for name, chosen in parts.items():
        if not chosen.any() or (name != "all" and chosen.all()):
            continue
        part = sweeps.take(chosen)
        variants = [(name, jacobian if name == "all" else whitened_jacobian(model, part, values))]
        halved = add_midpoints(part)
        if len(halved) > len(part):
            variants.append((f"{name}, midpoints", whitened_jacobian(model, halved, values)))
        if not sweeps.absolute.any():
            absolute = whitened_jacobian(model, _absolute_row(model.cell, part), values)
            variants += [(f"{title}, absolute length", np.vstack([rows, absolute])) for title, rows in variants]
        for title, rows in variants:
            spectrum = spectrum_of(rows)
            blocks.append(Block(title, len(rows), spectrum, indices_of(spectrum, len(rows))))
    return tuple(blocks)


def _worth(
    model: CavityModel, sweeps: Sweeps, values: Floats, jacobian: Floats, sigma: float
) -> tuple[tuple[str, float], ...]:
    """Information that one midpoint or one absolute length more would add, best first."""
    halved = add_midpoints(sweeps)
    middles = halved.take(np.char.endswith(halved.label, "-mid") & ~np.isin(halved.label, sweeps.label))
    candidates = join([middles, _absolute_row(model.cell, sweeps)])
    alone = replace(
        candidates,
        group=np.full(len(candidates), ""),
        sigma=np.where(np.isfinite(candidates.sigma), candidates.sigma, sigma),
    )
    gains = gain_of(jacobian, whitened_jacobian(model, alone, values))
    return tuple((str(alone.label[i]), float(gains[i])) for i in np.argsort(-gains, kind="stable"))
