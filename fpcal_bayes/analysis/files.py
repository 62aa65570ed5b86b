"""The file that a result is written to: what its command writes."""

from functools import singledispatch
from pathlib import Path
from typing import Any

from fpcal_bayes.analysis.keep import published
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import write_json
from fpcal_bayes.infer.fit.identify import Identification
from fpcal_bayes.infer.observability.observe import Observability
from fpcal_bayes.infer.posterior.draws import Posterior, draws_content
from fpcal_bayes.infer.posterior.netcdf import content as posterior_content
from fpcal_bayes.infer.posterior.netcdf import data_tree, write_netcdf
from fpcal_bayes.model.estimate import SCHEMA, Estimate
from fpcal_bayes.tracking.tracker import Track


@singledispatch
def file_content(result: Any) -> tuple[str, dict[str, Any]]:
    """The command that writes such a result, and the content of its JSON."""
    raise InputError(f"{type(result).__name__}: has no file of its own")


@file_content.register
def _(result: Estimate) -> tuple[str, dict[str, Any]]:
    return "identify", result.content()


@file_content.register
def _(result: Identification) -> tuple[str, dict[str, Any]]:
    return "identify", {**result.content(), **draws_content(result)}


@file_content.register
def _(result: Observability) -> tuple[str, dict[str, Any]]:
    return "observe", result.content()


@file_content.register
def _(result: Posterior) -> tuple[str, dict[str, Any]]:
    return "sample", posterior_content(result)


@file_content.register
def _(result: Track) -> tuple[str, dict[str, Any]]:
    return "track", published(result, None) | result.content()


def arviz_tree(result: Any) -> Any:
    """The draws of a posterior as an ArviZ DataTree."""
    if not isinstance(result, Posterior):
        raise InputError(f"{type(result).__name__}: has no draws, expected what fpcal_bayes.sample gives")
    return data_tree(result, seed=0, command="fpcal_bayes.sample")


def write(result: Any, path: Path) -> None:
    """Write a result as its command does: JSON, or netCDF of a posterior."""
    if path.suffix == ".nc" and isinstance(result, Posterior):
        write_netcdf(arviz_tree(result), path)
        return
    command, content = file_content(result)
    if path.suffix != ".json":
        ends = ".json or .nc" if isinstance(result, Posterior) else ".json"
        raise InputError(f"{path}: expected a file name that ends in {ends}")
    trust = result.estimate.trust if isinstance(result, Identification) else result.trust
    write_json(path, {"schema": SCHEMA, "command": command, **content, "trust": trust.content()})
