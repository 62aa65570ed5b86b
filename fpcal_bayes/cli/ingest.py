"""``fpcal ingest``: from recorded irradiance to sweeps."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpcal_bayes.cli.options import (
    Commands,
    add_command,
    add_json,
    cell_of,
    check_output,
    console,
    count,
    positive,
    warn,
    write_result,
)
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.kernels import warm_up
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import Estimate

if TYPE_CHECKING:
    from fpcal_bayes.fringes.alignment import Alignment
    from fpcal_bayes.fringes.ingest import Ingested
    from fpcal_bayes.fringes.wavelength_scan import ScanReading
    from fpcal_bayes.measure.recordings import TraceIndex


_EPILOG = """\
INDEX is a CSV with a row for each sweep: session,time_h,label,q1_start_um,..,q6_end_deg,trace, where trace is a CSV
with the columns t_s,joint,irradiance_v (joint: the one that moves, in um or deg). Optional columns: wavelength_nm (of
the laser in vacuum), temperature_c, pressure_hpa, humidity_pct (without all three the index of the air is 1),
scan_before, scan_after (CSV wavelength_nm,irradiance_v), group, kind, utc. Files are named relative to INDEX and lie in
its folder. Or an HDF5 of the same (fpcal simulate --traces -o INDEX.h5), a campaign that fpcal ingest made, or a MATLAB
file (-v7) with variables of these names: t_s, joint, irradiance_v as cell arrays of vectors.

A photodiode does not tell the sign of dL. It is taken from scans before and after, from --estimate, or from the cell's
priors where these leave no doubt; other rows have signed = 0. Doubtful sweeps are no rows of FILE: they are listed,
drawn, and kept in an HDF5 FILE under /doubtful. All traces are kept in an HDF5 FILE, so it can be ingested again.

--alignment writes the fibre's direction against the mirror, by the fringe amplitude along the first session's sweeps
that tilt the mirror, as a prior: `fpcal identify FILE --prior OUT`. On the perpendicular path dL does not see it. The
amplitude is made linear at --estimate, or at what the first session's sweeps identify; OUT holds nothing else of it.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to the program."""
    parser = add_command(commands, "ingest", "read sweeps from recorded irradiance", run, _EPILOG)
    parser.add_argument("index", metavar="INDEX", help="recorded sweeps: CSV, HDF5 or MATLAB file")
    parser.add_argument(
        "-o", dest="output", metavar="FILE", type=Path, required=True, help="sweeps to write: .csv or .h5"
    )
    parser.add_argument("--estimate", metavar="ESTIMATE", help="estimate JSON that tells signs and doubtful counts")
    parser.add_argument("--points", type=count, metavar="N", help="rows for N interior points of each sweep too")
    parser.add_argument("--absolute", action="store_true", help="rows for the absolute lengths of all scans too")
    parser.add_argument(
        "--wavelength-sd-pm", type=positive, metavar="PM", help="standard deviation of the laser's wavelength"
    )
    parser.add_argument("--index-sd", type=positive, metavar="SD", help="standard deviation of the air's index")
    parser.add_argument(
        "--alignment", metavar="OUT", type=Path, help="estimate JSON to write: the fibre's direction, for --prior"
    )
    plots = parser.add_mutually_exclusive_group()
    plots.add_argument(
        "--plots", metavar="DIR", type=Path, help="folder for pictures of doubtful sweeps (default: FILE_doubtful)"
    )
    plots.add_argument("--no-plots", action="store_true", help="draw nothing")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from fpcal_bayes.fringes.ingest import IngestSettings, ingest
    from fpcal_bayes.io.recordings import read_index
    from fpcal_bayes.io.sweeps import HDF5_SUFFIXES

    cell = cell_of(options)
    if options.output.suffix.lower() not in (".csv", *HDF5_SUFFIXES):
        raise InputError(f"{options.output}: expected a file name that ends in .csv, {' or '.join(HDF5_SUFFIXES)}")
    for output in (options.output, options.json, options.alignment):
        check_output(output, options.index, options.estimate)
    if options.json is not None and options.json.resolve() == options.output.resolve():
        raise InputError(f"{options.json}: is the output too, expected another name for the JSON")
    if options.alignment is not None:
        taken = [other.resolve() for other in (options.output, options.json) if other is not None]
        if options.alignment.resolve() in taken:
            raise InputError(f"{options.alignment}: is another output too, expected another name for --alignment")
    estimate = None if options.estimate is None else read_estimate(options.estimate, cell)
    index = read_index(options.index, cell)
    _announce()
    settings = IngestSettings(
        points=options.points or 0,
        absolute=options.absolute,
        wavelength_sd=1e-6 * (options.wavelength_sd_pm or 0.0),
        index_sd=options.index_sd or 0.0,
    )
    found = ingest(index, cell, estimate=estimate, settings=settings)
    alignment = None if options.alignment is None else _align(cell, found, index, estimate)
    folder = options.plots or options.output.with_name(f"{options.output.stem}_doubtful")
    drawn = 0 if options.no_plots else _draw(folder, found, index, cell)
    _write(options, found, index, cell)
    write_result(options.json, "ingest", _content(found, index, cell))
    _report(options, found, folder if drawn else None)
    if alignment is not None:
        _write_alignment(options, alignment, index)
    return 0


def _announce() -> None:
    import sys

    from fpcal_bayes.fringes.kernels import fit_signal
    from fpcal_bayes.model.kernels.compile import needs_compilation

    if needs_compilation(fit_signal):
        print("fpcal: compiling the kernels; this happens once and takes about 20 s", file=sys.stderr)


def _write(options: argparse.Namespace, found: "Ingested", index: "TraceIndex", cell: Cell) -> None:
    from dataclasses import replace

    from fpcal_bayes.io.campaign import write_campaign
    from fpcal_bayes.io.sweeps import HDF5_SUFFIXES, write_sweeps
    from fpcal_bayes.measure.campaign import Campaign

    if options.output.suffix.lower() in HDF5_SUFFIXES:
        extras = [
            f"--points {options.points}" if options.points else "",
            "--absolute" if options.absolute else "",
            f"--wavelength-sd-pm {options.wavelength_sd_pm:g}" if options.wavelength_sd_pm else "",
            f"--index-sd {options.index_sd:g}" if options.index_sd else "",
            f"--estimate {Path(options.estimate).name}" if options.estimate else "",
        ]
        command = " ".join(["fpcal ingest", Path(options.index).name, *filter(None, extras)])
        campaign = Campaign.of(found.sweeps, cell, command=command)
        campaign = replace(campaign, recordings=index, doubtful=found.doubtful if len(found.doubtful) else None)
        write_campaign(options.output, campaign, cell)
    else:
        write_sweeps(options.output, found.sweeps, cell)


def _align(cell: Cell, found: "Ingested", index: "TraceIndex", estimate: Estimate | None) -> "Alignment":
    """The fibre's direction, near `estimate` or near what the sweeps of the first session identify."""
    from fpcal_bayes.fringes.alignment import align
    from fpcal_bayes.fringes.amplitude import fringe_amplitudes
    from fpcal_bayes.infer.fit.identify import identify

    amplitudes = fringe_amplitudes(cell, index.sweeps, found)
    if estimate is None:
        warm_up(cell)
        identified = identify(cell, found.sweeps.of_session(str(index.sweeps.session[0])))
        estimate = identified.estimate if identified.converged else None
    return align(cell, amplitudes, estimate)


def _write_alignment(options: argparse.Namespace, found: "Alignment", index: "TraceIndex") -> None:
    from fpcal_bayes.core.files import file_sha256

    data = {
        "file": Path(options.index).name,
        "sha256": file_sha256(Path(options.index)),
        "session": str(index.sweeps.session[0]),
    }
    content = found.content() | {"data": data}
    write_result(options.alignment, "ingest", content)
    sds = np.degrees(np.sqrt(np.diag(found.noise)))
    names = ", ".join(
        f"{name} to {sd:.2g} deg" for name, sd in zip(content["alignment"]["names"], sds.tolist(), strict=True)
    )
    console(options).print(
        f"fringe amplitude along {found.n_sweeps} sweeps tells, the mirror held, {names} (chi-square "
        f"{found.chi_square:.1f}, expected {found.freedom}) -> {options.alignment}",
        markup=False,
        soft_wrap=True,
    )


def _draw(folder: Path, found: "Ingested", index: "TraceIndex", cell: Cell) -> int:
    """Draw the doubtful sweeps; how many were drawn."""
    drawn = [i for i in found.doubtful.recording.tolist() if found.readings[i] is not None]
    if not drawn:
        return 0
    from fpcal_bayes.core.files import make_folder, replacing
    from fpcal_bayes.measure.recordings import moving_joint
    from fpcal_bayes.report.fringes import draw_sweep

    make_folder(folder)
    reasons = dict(zip(found.doubtful.recording.tolist(), found.doubtful.reason.tolist(), strict=True))
    for i in drawn:
        joint = moving_joint(index.sweeps, i)
        start, end = (float(q[i, joint] / cell.joint_scales[joint]) for q in (index.sweeps.q_start, index.sweeps.q_end))
        name = f"q{joint + 1} [{cell.joints[joint].unit}]"
        reading, samples = found.readings[i], found.samples[i]
        if reading is None or samples is None:
            continue
        figure = draw_sweep(reading, samples, start, end, name, reasons[i])
        with replacing(folder / f"{i + 1:04d}.png") as temporary:
            figure.savefig(temporary, format="png", dpi=110)
    return len(drawn)


def _content(found: "Ingested", index: "TraceIndex", cell: Cell) -> dict[str, Any]:
    """The JSON: every recording, used or not."""
    from fpcal_bayes.measure.recordings import moving_joint

    sweeps = index.sweeps
    reasons = dict(zip(found.doubtful.recording.tolist(), found.doubtful.reason.tolist(), strict=True))
    rows = []
    for i, reading in enumerate(found.readings):
        row: dict[str, Any] = {
            "session": str(sweeps.session[i]),
            "label": str(sweeps.label[i]),
            "kind": str(sweeps.kind[i]),
            "doubtful": reasons.get(i),
            "scan_before": _scan_content(found.scans_before[i]),
            "scan_after": _scan_content(found.scans_after[i]),
        }
        if reading is not None:
            scale = float(cell.joint_scales[moving_joint(sweeps, i)])
            row |= {
                "dl_um": _number(reading.dl),
                "sigma_um": _number(reading.sigma),
                "signed": int(reading.signed),
                "sign_from": reading.sign_source or None,
                "fringes": _number(reading.fringes),
                "reversals": [turn / scale for turn in reading.reversals],
                "alternatives_um": list(reading.alternatives),
                "samples_per_fringe": _number(reading.samples_a_fringe),
                "noise_v": _number(reading.noise),
            }
        elif (scan := found.scans_after[i]) is not None:
            row |= {"dl_um": _number(scan.length), "sigma_um": _number(scan.sigma), "signed": 1}
            row |= {"fringes": _number(scan.fringes), "reversals": [], "alternatives_um": []}
        rows.append(row)
    counts = {"recordings": len(index), "rows": len(found.sweeps), "doubtful": len(found.doubtful)}
    return {"counts": counts, "sweeps": rows, "warnings": list(found.warnings)}


def _scan_content(scan: "ScanReading | None") -> dict[str, Any] | None:
    if scan is None:
        return None
    doubt = scan.refused or scan.doubt or None
    return {"length_um": _number(scan.length), "sigma_um": _number(scan.sigma), "doubtful": doubt}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _report(options: argparse.Namespace, found: "Ingested", folder: Path | None) -> None:
    readings = [reading for reading in found.readings if reading is not None and reading.good]
    out = console(options)
    sentences = [f"{len(found.sweeps)} rows from {len(found.readings)} recordings -> {options.output}"]
    if readings:
        sigmas = 1e3 * np.array([reading.sigma for reading in readings])
        unsigned = sum(not reading.signed for reading in readings)
        turned = sum(bool(reading.turns) for reading in readings)
        sentences.append(
            f"sigma {np.median(sigmas):.2g} nm (median), {sigmas.max():.2g} nm (largest); L turns back in {turned} "
            f"sweeps; the sign of dL is unknown in {unsigned}"
        )
    if len(found.doubtful):
        where = f", drawn in {folder}" if folder else ""
        sentences.append(f"{len(found.doubtful)} doubtful, left out{where}")
    for sentence in sentences:
        out.print(sentence, markup=False, soft_wrap=True)
    warn(found.warnings)
