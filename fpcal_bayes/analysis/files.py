"""The file that a result is written to: what its command writes."""

from collections.abc import Callable
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
from fpcal_bayes.infer.posterior.netcdf import summarise as summarise
from fpcal_bayes.model.estimate import SCHEMA, Estimate
from fpcal_bayes.tracking.tracker import Track

#: The command that writes each kind of result, and the content of its JSON.
CONTENTS: dict[type, tuple[str, Callable[[Any], dict[str, Any]]]] = {
    Estimate: ("identify", Estimate.content),
    Identification: ("identify", lambda result: {**result.content(), **draws_content(result)}),
    Observability: ("observe", Observability.content),
    Posterior: ("sample", posterior_content),
    Track: ("track", lambda result: published(result, None) | result.content()),
}


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
    command, content = CONTENTS[type(result)]
    if path.suffix != ".json":
        ends = ".json or .nc" if isinstance(result, Posterior) else ".json"
        raise InputError(f"{path}: expected a file name that ends in {ends}")
    trust = result.estimate.trust if isinstance(result, Identification) else result.trust
    write_json(path, {"schema": SCHEMA, "command": command, **content(result), "trust": trust.content()})
