"""``fpcal ingest``: from recorded irradiance to sweeps."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import fpcal_bayes.report as report
from fpcal_bayes.cli.common import show, write_result
from fpcal_bayes.core.files import make_folder, replacing, require_suffix
from fpcal_bayes.core.linalg import counted, finite
from fpcal_bayes.fringes.ingest import Ingested, IngestSettings, ingest
from fpcal_bayes.fringes.kernels import fit_signal
from fpcal_bayes.fringes.wavelength_scan import ScanReading
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.recordings import read_recordings
from fpcal_bayes.io.sweeps import HDF5_SUFFIXES, write_sweeps
from fpcal_bayes.measure.recordings import TraceIndex, moving_joint
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.kernels.compile import needs_compilation
from fpcal_bayes.model.trust import Trust

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def run(options: argparse.Namespace, cell: Cell) -> int:
    require_suffix(options.output, ".csv", *HDF5_SUFFIXES)
    estimate = None if options.estimate is None else read_estimate(options.estimate, cell)
    index = read_recordings(options.index, cell, options.columns)
    if needs_compilation(fit_signal):
        print("fpcal: compiling the kernels; this happens once and takes about 20 s", file=sys.stderr)
    settings = IngestSettings(
        points=options.points or 0,
        absolute=options.absolute,
        wavelength_sd=1e-6 * (options.wavelength_sd_pm or 0.0),
        index_sd=options.index_sd or 0.0,
    )
    if len(index.sweeps) > 20:
        print(f"fpcal: reading {len(index.sweeps)} recordings, up to a second each", file=sys.stderr)
    found = ingest(index, cell, estimate=estimate, settings=settings)
    folder = options.plots or options.output.with_name(f"{options.output.stem}_doubtful")
    drawn = 0 if options.no_plots else _draw(folder, found, index, cell)
    _write(options, found, index, cell)
    write_result(options.json, "ingest", recordings_content(found, index, cell), Trust())
    _report(options, found, folder if drawn else None)
    return 0


def _write(options: argparse.Namespace, found: Ingested, index: TraceIndex, cell: Cell) -> None:
    said = {name: getattr(options, name) for name in ("points", "absolute", "wavelength_sd_pm", "index_sd")}
    said["columns"] = ",".join(f"{key.split('_')[0]}={name}" for key, name in (options.columns or {}).items())
    said["estimate"] = options.estimate and Path(options.estimate).name
    texts = {
        name: "" if value is True else f" {value:g}" if isinstance(value, float) else f" {value}"
        for name, value in said.items()
        if value
    }
    words = [f"--{name.replace('_', '-')}{text}" for name, text in texts.items()]
    command = " ".join(["fpcal ingest", Path(options.index).name, *words])
    beside = {"recordings": index, "doubtful": found.doubtful if len(found.doubtful) else None}
    write_sweeps(options.output, found.sweeps, cell, command=command, about=options.about, **beside)


def _draw(folder: Path, found: Ingested, index: TraceIndex, cell: Cell) -> int:
    drawn = [i for i in found.doubtful.recording.tolist() if found.readings[i] is not None]
    if not drawn:
        return 0
    make_folder(folder)
    reasons = dict(zip(found.doubtful.recording.tolist(), found.doubtful.reason.tolist(), strict=True))
    for i in drawn:
        with replacing(folder / f"{i + 1:04d}.png") as temporary:
            drawn_sweep(found, index, cell, i, reasons[i]).savefig(temporary, format="png", dpi=110)
    return len(drawn)


def drawn_sweep(found: Ingested, index: TraceIndex, cell: Cell, i: int, reason: str) -> "Figure":
    """One sweep of an index, drawn with what is said of it."""
    joint = moving_joint(index.sweeps, i)
    start, end = (float(q[i, joint] / cell.joint_scales[joint]) for q in (index.sweeps.q_start, index.sweeps.q_end))
    reading, samples = found.readings[i], found.samples[i]
    if reading is None or samples is None:
        raise ValueError(f"row {i} has no trace")
    unit = cell.joints[joint].unit
    # What draws is loaded for a sweep in doubt alone.
    figure: Figure = report.draw_sweep(reading, samples, start, end, f"q{joint + 1} [{unit}]", reason)
    return figure


def recordings_content(found: Ingested, index: TraceIndex, cell: Cell) -> dict[str, Any]:
    """The JSON: every recording, used or not."""
    sweeps = index.sweeps
    reasons = dict(zip(found.doubtful.recording.tolist(), found.doubtful.reason.tolist(), strict=True))
    rows = []
    for i, reading in enumerate(found.readings):
        row: dict[str, Any] = {name: str(getattr(sweeps, name)[i]) for name in ("session", "label", "kind")}
        row["doubtful"] = reasons.get(i)
        row["scan_before"] = _scan_content(found.scans_before[i])
        row["scan_after"] = _scan_content(found.scans_after[i])
        if reading is not None:
            scale = float(cell.joint_scales[moving_joint(sweeps, i)])
            row |= {
                "dl_um": finite(reading.dl),
                "sigma_um": finite(reading.sigma),
                "signed": int(reading.signed),
                "sign_from": reading.sign_source or None,
                "fringes": finite(reading.fringes),
                "reversals": [turn / scale for turn in reading.reversals],
                "lost_motion": reading.late / scale,
                "uneven": reading.uneven,
                "alternatives_um": list(reading.alternatives),
                "samples_per_fringe": finite(reading.samples_a_fringe),
                "noise_v": finite(reading.noise),
                "visibility": finite(reading.amplitude / float(index.traces[i].irradiance.mean())),
            }
        elif (scan := found.scans_after[i]) is not None:
            row |= {"dl_um": finite(scan.length), "sigma_um": finite(scan.sigma), "signed": 1}
            row |= {"fringes": finite(scan.fringes), "reversals": [], "alternatives_um": []}
        rows.append(row)
    counts = {"recordings": len(index), "rows": len(found.sweeps), "doubtful": len(found.doubtful)}
    return {"counts": counts, "sweeps": rows, "warnings": list(found.warnings)}


def _scan_content(scan: ScanReading | None) -> dict[str, Any] | None:
    if scan is None:
        return None
    doubt = scan.refused or scan.doubt or None
    return {"length_um": finite(scan.length), "sigma_um": finite(scan.sigma), "doubtful": doubt}


def _report(options: argparse.Namespace, found: Ingested, folder: Path | None) -> None:
    readings = [reading for reading in found.readings if reading is not None and reading.good]
    sentences = [
        f"{counted(len(found.sweeps), 'row')} from {counted(len(found.readings), 'recording')} -> {options.output}"
    ]
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
        sentences.append(f"{len(found.doubtful)} doubtful, left out{where}: see why, and record these again")
    show(options, sentences, found.warnings)
