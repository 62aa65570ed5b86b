"""A posterior as an ArviZ DataTree in a netCDF file, read again, and its summary."""

import contextlib
import hashlib
import json
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import CONTENT_HASH, content_sha256, file_sha256, replacing
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.core.version import __version__
from fpcal_bayes.infer.posterior.diagnostics import Diagnostics, diagnose
from fpcal_bayes.infer.posterior.draws import Posterior
from fpcal_bayes.infer.posterior.proposal import in_parts
from fpcal_bayes.infer.posterior.target_slip import SlipTarget
from fpcal_bayes.io.hdf5 import Reader, reading
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.parameters import ParameterSet
from fpcal_bayes.model.trust import Trust, trust_of


@dataclass(frozen=True)
class PosteriorDraws:
    """Draws from the posterior of a cell's parameters."""

    cell: Cell  # the cell they belong to
    parameters: ParameterSet  # in the cell's order
    values: Floats  # in um and rad, shape (n_draws, n)
    trust: Trust = field(default_factory=Trust)

    def thinned(self, most: int) -> "PosteriorDraws":
        """At most `most` of the draws, evenly spaced."""
        return replace(self, values=self.values[:: -(-len(self.values) // most)])


def read_posterior(path: str | Path, cell: Cell) -> PosteriorDraws:
    """Read the draws of a posterior file."""
    path = Path(path)
    with _reading(path, cell) as reader:
        group = reader.group(reader.root, "posterior")
        parameters = ParameterSet(p for p in cell.parameters if reader.has(group, p.name))
        columns = [_column(reader, group, p.name, p.unit) for p in parameters]
        hashed = CONTENT_HASH in reader.root.attrs
        sha256, said = (reader.text_attribute(reader.root, name) if hashed else "" for name in (CONTENT_HASH, "trust"))
    if not columns:
        raise InputError(f"{path}: group posterior: expected draws of parameters of cell {cell.name!r}")
    if len({column.shape for column in columns}) != 1 or columns[0].size == 0:
        raise InputError(f"{path}: group posterior: expected as many draws of each parameter, one or more")
    if hashed and sha256 != _draws_sha256(parameters.names, np.stack(columns, axis=-1), said):
        raise InputError(f"{path}: attribute {CONTENT_HASH}: the draws are not those that fpcal sample wrote")
    try:
        trust = trust_of(json.loads(said) if hashed else None)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: attribute trust: {error}") from error
    values = parameters.to_internal(np.column_stack([column.ravel() for column in columns]))
    return PosteriorDraws(cell, parameters, values, trust)


@contextlib.contextmanager
def _reading(path: Path, cell: Cell) -> Iterator[Reader]:
    """Open a posterior file, which must be of this cell and have converged."""
    with reading(path, "a netCDF file of draws") as reader:
        root = reader.root
        if "cell_sha256" not in root.attrs:
            raise InputError(f"{path}: attribute cell_sha256: missing, expected a file that fpcal sample wrote")
        if reader.text_attribute(root, "cell_sha256") != cell.sha256:
            name, opd = (reader.text_attribute(root, each) for each in ("cell_name", "opd"))
            raise InputError(
                f"{path}: attribute cell_sha256: the draws are of another cell ({name!r:.60}, opd {opd!r:.40}), "
                f"expected {cell.name!r}, opd {cell.opd!r}, {cell.sha256[:12]}"
            )
        if "converged" in root.attrs and not reader.integer_attribute(root, "converged"):
            raise InputError(f"{path}: attribute converged: the sampling did not converge, expected draws that did")
        yield reader


def _column(reader: Reader, group: Any, name: str, unit: str) -> Floats:
    place = f"{reader.path}: posterior/{name}"
    values = reader.numbers(group, name, None)
    stated = reader.text_attribute(group[name], "units") if "units" in group[name].attrs else ""
    if stated != unit:
        raise InputError(f"{place}: expected the units {unit!r}, found {stated[:40]!r}")
    if not np.isfinite(values).all():
        raise InputError(f"{place}: expected finite numbers")
    return values


@dataclass(frozen=True)
class PosteriorSummary:
    """Draws of a posterior and what they are worth."""

    file: str  # name without folder
    sha256: str  # hash of the bytes
    parameters: ParameterSet
    draws: Floats  # in the units a person reads, shape (n_chains, n_draws, n)
    prior: Floats  # draws of the prior in the same units, shape (n_prior_draws, n)
    n_ensembles: int  # independent ensembles; chains of one ensemble interact
    diagnostics: Diagnostics
    residuals: Floats  # measured less predicted, in standard deviations of the prediction, shape (n_rows,)
    command: str  # that made the file

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return int(self.draws.shape[0] * self.draws.shape[1])


def read_posterior_summary(path: str | Path, cell: Cell) -> PosteriorSummary:
    """Read a posterior file and work out its convergence."""
    path = Path(path)
    parameters = read_posterior(path, cell).parameters
    with _reading(path, cell) as reader:
        root = reader.root
        posterior, before = (reader.group(root, name) for name in ("posterior", "prior"))
        draws = np.stack([reader.numbers(posterior, name, None) for name in parameters.names], axis=-1)
        prior = np.stack([reader.numbers(before, name, None).ravel() for name in parameters.names], axis=-1)
        observed = reader.numbers(reader.group(root, "observed_data"), "dl_um")
        predicted = reader.numbers(reader.group(root, "posterior_predictive"), "dl_um", 3)
        residuals = (observed - predicted.mean(axis=(0, 1))) / predicted.std(axis=(0, 1))
        n_ensembles = reader.integer_attribute(root, "n_ensembles") if "n_ensembles" in root.attrs else 1
        command = reader.text_attribute(root, "command") if "command" in root.attrs else ""
    if draws.ndim != 3:
        raise InputError(f"{path}: group posterior: expected draws by chain and draw")
    if n_ensembles < 1 or len(draws) % n_ensembles:
        raise InputError(f"{path}: attribute n_ensembles: expected a divisor of {len(draws)} chains")
    walkers = draws.reshape(n_ensembles, -1, draws.shape[1], draws.shape[2]).transpose(0, 2, 1, 3)
    return PosteriorSummary(
        file=path.name,
        sha256=file_sha256(path),
        parameters=parameters,
        draws=draws,
        prior=prior,
        n_ensembles=n_ensembles,
        diagnostics=diagnose(walkers),
        residuals=residuals,
        command=command,
    )


#: Likelihoods and predictions that are kept at most, draws times rows.
_KEPT_CELLS = 1_000_000
#: Rows less likely than this to have slipped are not listed.
_LEAST_SLIP = 0.01
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def summarise(posterior: Posterior | PosteriorSummary) -> dict[str, dict[str, float]]:
    """Mean, sd, quantiles, effective sizes and nested R-hat of each parameter, in the units a person reads."""
    if isinstance(posterior, Posterior):
        parameters = posterior.identification.free
        draws = parameters.to_shown(posterior.values().reshape(-1, len(parameters)))
    else:
        parameters, draws = posterior.parameters, posterior.draws.reshape(-1, len(posterior.parameters))
    diagnostics = posterior.diagnostics
    return {
        p.name: {
            **_summary(draws[:, i]),
            "ess_bulk": float(diagnostics.ess_bulk[i]),
            "ess_tail": float(diagnostics.ess_tail[i]),
            "rhat": float(diagnostics.rhat[i]),
        }
        for i, p in enumerate(parameters)
    }


def _summary(draws: Floats) -> dict[str, float]:
    quantiles = np.quantile(draws, QUANTILES)
    named = {f"q{100 * q:02.0f}": float(value) for q, value in zip(QUANTILES, quantiles, strict=True)}
    return {"mean": float(draws.mean()), "sd": float(draws.std(ddof=1)), **named}


def content(posterior: Posterior) -> dict[str, Any]:
    """What ``sample --json`` writes, without schema and command."""
    summary = summarise(posterior)
    base = posterior.identification.content()
    parameters = posterior.identification.free
    draws = parameters.to_shown(posterior.values().reshape(-1, len(parameters)))
    for name, entry in summary.items():
        # Value and sd are those of the posterior; the maximum stands in the fit.
        base["parameters"][name] |= {"value": entry["mean"], **entry}
    diagnostics = posterior.diagnostics
    noise = posterior.target.noise_factors(posterior.points)
    if noise is not None:
        base["noise_scale"] = _summary(noise.ravel())
    slips = slip_probabilities(posterior)
    if slips is not None:
        base["slips"] = [{"label": label, "probability": p} for label, p in slips if p > _LEAST_SLIP]
    if posterior.predictive_p is not None:
        base["fit"]["predictive_p"] = posterior.predictive_p
    return {
        **base,
        "trust": posterior.trust.content(),
        "covariance": {
            "names": list(parameters.names),
            "matrix": np.cov(draws.T).reshape(len(parameters), -1).tolist(),
        },
        "sampler": {
            "draws": int(np.prod(posterior.log_density.shape)),
            "evaluations": posterior.evaluations,
            "seconds": posterior.seconds,
            "acceptance": posterior.acceptance,
            "min_ess": float(diagnostics.ess_bulk.min()),
            "min_ess_tail": float(diagnostics.ess_tail.min()),
            "max_rhat": float(diagnostics.rhat.max()),
            "autocorrelation_time": diagnostics.autocorrelation_time,
            "outside_charts": posterior.outside,
            "charts": posterior.charts,
            "converged": posterior.converged,
            "failures": list(posterior.failures),
        },
    }


def slip_probabilities(posterior: Posterior) -> list[tuple[str, float]] | None:
    """Label of each row and the probability that it slipped, likeliest first; None if slips were not thought of."""
    target = posterior.target
    if not isinstance(target, SlipTarget):
        return None
    points = posterior.points[:, :: max(1, posterior.points.shape[1] // 16)].reshape(-1, target.n_unknowns)
    mean = target.slip_probabilities(points).mean(axis=0)
    labels = posterior.identification.problem.sweeps.label
    return [(str(labels[i]), float(mean[i])) for i in np.argsort(-mean, kind="stable")]


def data_tree(posterior: Posterior, *, seed: int, command: str) -> Any:
    """The draws as an ArviZ DataTree, in shown units; a row's likelihood is given those before it in its group."""
    # Importing it takes long: only where it is used. ArviZ's plots, which nothing here needs, would take longer.
    import arviz_base as az

    identification = posterior.identification
    problem, parameters = identification.problem, identification.free
    values = posterior.values()
    n_chains, n_draws, _ = values.shape
    shown = parameters.to_shown(values)
    rng = np.random.default_rng(seed)
    scores = rng.standard_normal((*values.shape[:2], problem.n_free))
    prior = parameters.to_shown(problem.prior.values(scores)[..., identification.own])
    chains = posterior.points.transpose(0, 2, 1, 3).reshape(n_chains, n_draws, -1)
    # Of very many rows draws of some chains are kept.
    some = chains[:: -(-n_chains * len(problem.target) // _KEPT_CELLS)]
    unknowns = some[:, :: -(-some.shape[0] * n_draws * len(problem.target) // _KEPT_CELLS)]
    log_likelihood, predicted = _pointwise(posterior, unknowns.reshape(-1, unknowns.shape[-1]), rng)
    shape = (*unknowns.shape[:2], -1)
    draws = {name: shown[:, :, i] for i, name in enumerate(parameters.names)}
    noise = posterior.target.noise_factors(chains)
    if noise is not None:
        draws["noise_scale"] = noise
    if isinstance(posterior.target, SlipTarget):
        draws["slip_probability"] = posterior.target.eps(chains)
    with warnings.catch_warnings():
        # Each walker is a chain: there may be more of them than steps.
        warnings.filterwarnings("ignore", message="Found chain dimension to be longer", category=UserWarning)
        tree = az.from_dict(
            {
                "posterior": draws,
                "prior": {name: prior[:, :, i] for i, name in enumerate(parameters.names)},
                "sample_stats": {"lp": posterior.log_density.transpose(0, 2, 1).reshape(n_chains, n_draws)},
                "log_likelihood": {"dl_um": log_likelihood.reshape(shape)},
                "posterior_predictive": {"dl_um": predicted.reshape(shape)},
                "observed_data": {"dl_um": problem.target},
            },
            coords={"sweep": problem.sweeps.label},
            dims={"dl_um": ["sweep"]},
            attrs={"/": _attributes(posterior, seed, command)},
        )
    for node in tree.subtree:
        # The same draws give the same file.
        node.attrs.pop("created_at", None)
    for group in ("posterior", "prior"):
        for p in parameters:
            tree[group][p.name].attrs.update({"units": p.unit, "long_name": p.latex})
    for group in ("posterior_predictive", "observed_data"):
        tree[group]["dl_um"].attrs.update({"units": "um", "long_name": "change of cavity length"})
    return tree


def write_netcdf(tree: Any, path: Path) -> None:
    """Write a DataTree as netCDF, whole or not at all."""
    # Made in memory: on a full disk the library fails while it closes the file, where nothing catches it.
    # The buffer is let go at once: one that an error's frame keeps can crash Python's garbage collection (3.12.1).
    with tree.to_netcdf(engine="h5netcdf") as content, replacing(path) as temporary:
        temporary.write_bytes(content)


def _attributes(posterior: Posterior, seed: int, command: str) -> dict[str, Any]:
    estimate, parameters = posterior.identification.estimate, posterior.identification.free
    trust = json.dumps(posterior.trust.content())
    return {
        "program": f"fpcal_bayes {__version__}",
        "command": command,
        "seed": seed,
        "cell_name": estimate.cell.name,
        "cell_sha256": estimate.cell.sha256,
        "opd": estimate.cell.opd,
        "data_file": estimate.data.get("file", ""),
        "data_sha256": estimate.data.get("sha256", ""),
        "converged": int(posterior.converged),
        "n_ensembles": posterior.points.shape[0],
        "trust": trust,
        CONTENT_HASH: _draws_sha256(parameters.names, parameters.to_shown(posterior.values()), trust),
    }


def _draws_sha256(names: Sequence[str], draws: Floats, trust: str) -> str:
    """Hash of the draws in the units of the file, (n_chains, n_draws, n), and of what is held against them."""
    columns = [[name, hashlib.sha256(np.ascontiguousarray(draws[..., i])).hexdigest()] for i, name in enumerate(names)]
    return content_sha256([columns, trust])


def _pointwise(posterior: Posterior, unknowns: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Log likelihood of each row and a prediction of it with noise, at unknowns (n_points, n_unknowns)."""
    problem = posterior.identification.problem
    n_rows = len(problem.target)
    likelihood, predicted = np.empty((len(unknowns), n_rows)), np.empty((len(unknowns), n_rows))
    for part in in_parts(len(unknowns), max(1, min(256, _KEPT_CELLS // (4 * n_rows)))):
        mean = problem.model.predict(problem.values(unknowns[part]), problem.rows)
        if problem.sensitivity is not None:
            mean = mean + unknowns[part, problem.n_free : problem.n_unknowns] @ problem.sensitivity.T
        likelihood[part] = posterior.target.log_likelihoods(unknowns[part])
        predicted[part] = mean + problem.whitening.unwhiten(posterior.target.draw_noise(unknowns[part], rng).T).T
    return likelihood, predicted
