"""From recorded traces to sweeps: every trace read, signs settled, rows made."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.fringes.count import Reading, SignSource
from fpcal_bayes.fringes.fit import CALM, Nuisance
from fpcal_bayes.fringes.profile import (
    centre_and_spread,
    coefficients_of,
    estimated_profiles,
    lengths_at,
    nodes,
    prior_profiles,
)
from fpcal_bayes.fringes.reader import Recorded, estimate_sign_source, read_traces
from fpcal_bayes.fringes.samples import Samples, lay_out
from fpcal_bayes.fringes.wavelength_scan import ScanReading, expected_lengths, read_wavelength_scan
from fpcal_bayes.measure.campaign import DoubtfulRecord
from fpcal_bayes.measure.recordings import TraceIndex, moving_joint
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.traces import WavelengthScan
from fpcal_bayes.model.air_index import air_index
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.chain import fibre_in_world, optical_axis
from fpcal_bayes.model.estimate import Estimate
from fpcal_bayes.model.interferometer import mirror_amplitude
from fpcal_bayes.model.mechanics import Terms

#: Share of the full scale below which a higher gain is proposed.
_LITTLE = 0.25
#: Draws of expected fading, and the nodes of each.
_DRAWS, _SEED, _NODES = 120, 20240502, 9
#: Legendre polynomials of the logarithm, from the first on; what the optics' own uncertainty adds to each.
_FLOORS = (0.03, 0.02, 0.005, 0.003)
_OPTICS_SHARE = 0.3
#: What a mirror misses of its joint's course at its ends and is worth a word, in um.
_MISSED = 0.005


@dataclass(frozen=True)
class IngestSettings:
    """How traces are read."""

    points: int = 0  # interior points of each sweep that become rows of their own, in a group with its end
    absolute: bool = False  # whether scans before and after sweeps become rows of kind ``absolute``
    wavelength_sd: float = 0.0  # standard deviation of the laser's wavelength, in um
    index_sd: float = 0.0  # standard deviation of the refractive index of the air


@dataclass(frozen=True)
class Ingested:
    """What recorded traces gave."""

    sweeps: Sweeps  # rows that may be used
    doubtful: DoubtfulRecord  # recordings that gave none
    readings: tuple[Reading | None, ...]  # of each recording, None for absolute lengths
    samples: tuple[Samples | None, ...]  # of each recording as it was laid along its sweep, None for absolute lengths
    scans_before: tuple[ScanReading | None, ...]  # of each recording, None where there is none
    scans_after: tuple[ScanReading | None, ...]  # the same after it
    warnings: tuple[str, ...]  # sentences for the user


def ingest(
    index: TraceIndex, cell: Cell, *, estimate: Estimate | None = None, settings: IngestSettings | None = None
) -> Ingested:
    """Read recorded traces; `InputError` if none can be used.

    index: sweeps, their traces and scans.
    estimate: of the cell: it tells signs, and counts that a trace leaves open. It never changes a reading otherwise.
    """
    found = read_index(index, cell, estimate=estimate, settings=settings)
    if not len(found.sweeps):
        raise InputError(f"{index.sweeps.file}: no sweep can be used; {'; '.join(_left_out(found.doubtful))}")
    return found


def read_index(
    index: TraceIndex,
    cell: Cell,
    *,
    estimate: Estimate | None = None,
    settings: IngestSettings | None = None,
    told: Ints | None = None,
) -> Ingested:
    """As `ingest`, doubtful traces alone included; `told`: rows that are told of, all are read."""
    settings = IngestSettings() if settings is None else settings
    sweeps, paths = index.sweeps, index.sweeps.kind == "path"
    if paths.any():
        row, wanted = int(sweeps.rows[np.argmax(paths)]), "expected sweep or absolute"
        raise located(
            sweeps.file, f"{wanted}: a path is held against an estimate, by fpcal check", row=row, column="kind"
        )
    light, optics = _light(index, cell, settings), cell.interferometer
    before = _read_scans(index, cell, sweeps.q_start, index.scans_before)
    after = _read_scans(index, cell, sweeps.q_end, index.scans_after)
    recorded = _record(index, cell, light, estimate, before, after)
    found = read_traces(
        [each for each in recorded if each],
        noise=optics.noise,
        full_scale=optics.full_scale,
        # Two beams r1, s make the mean r1^2 + s^2 and the amplitude 2 r1 s.
        mirror_light=1.0 / (4.0 * optics.fibre_reflectivity * optics.gain),
    )
    remaining = iter(found)
    readings = tuple(None if each is None else next(remaining) for each in recorded)
    if told is not None:
        # What a trace says depends on the others, so that it is read among them.
        index, sweeps, light = index.take(told), sweeps.take(told), (light[0][told], light[1][told])
        recorded, readings = [recorded[i] for i in told], tuple(readings[i] for i in told)
        before, after = tuple(before[i] for i in told), tuple(after[i] for i in told)

    parts = []
    for i, reading in enumerate(readings):
        if reading is not None and reading.good:
            parts.append(sweep_rows(sweeps, i, reading, settings.points))
        elif reading is None and (scan := after[i]) is not None and scan.good:
            parts.append(absolute_rows(sweeps, i, None, scan, light[1][i]))
        if reading is not None and settings.absolute:
            parts.append(absolute_rows(sweeps, i, before[i], after[i], light[1][i]))
    doubtful, parts = _doubtful(index, readings, after), [part for part in parts if len(part)]
    rows = join(parts, sweeps.file) if parts else sweeps.take(np.zeros(0, dtype=np.int64))
    if parts:
        check_sweeps(rows, cell)
    return Ingested(
        sweeps=rows,
        doubtful=doubtful,
        readings=readings,
        samples=tuple(None if each is None else each.samples for each in recorded),
        scans_before=before,
        scans_after=after,
        warnings=(*_warnings(index, readings, doubtful, before, after), *_gain(index, optics.full_scale)),
    )


def _light(index: TraceIndex, cell: Cell, settings: IngestSettings) -> tuple[Floats, Floats]:
    """Wavelength in the air of each row in um, and its relative standard deviation, (n_rows,) each."""
    vacuum = np.where(np.isnan(index.wavelength), cell.wavelength, index.wavelength)
    try:
        air = air_index(vacuum, index.temperature_c, index.pressure_hpa, index.humidity_pct)
    except InputError as error:
        raise InputError(f"{index.sweeps.file}: {error}") from error
    return vacuum / air, np.hypot(settings.wavelength_sd / vacuum, settings.index_sd / air)


def _read_scans(
    index: TraceIndex, cell: Cell, q: Floats, scans: Sequence[WavelengthScan | None]
) -> tuple[ScanReading | None, ...]:
    """Readings of the scans at poses `q` (n_rows, n_joints)."""
    if not any(scans):
        return (None,) * len(scans)
    optics, (lengths, sds) = cell.interferometer, expected_lengths(cell, q)
    return tuple(
        None
        if scan is None
        else read_wavelength_scan(
            scan,
            float(lengths[i]),
            float(sds[i]),
            air=(float(index.temperature_c[i]), float(index.pressure_hpa[i]), float(index.humidity_pct[i])),
            noise=optics.noise,
            full_scale=optics.full_scale,
        )
        for i, scan in enumerate(scans)
    )


def _record(
    index: TraceIndex,
    cell: Cell,
    light: tuple[Floats, Floats],
    estimate: Estimate | None,
    before: Sequence[ScanReading | None],
    after: Sequence[ScanReading | None],
) -> list[Recorded | None]:
    """Each row with what is expected of it; None for absolute lengths."""
    sweeps, (wavelength, share) = index.sweeps, light
    profiles, fading = prior_profiles(cell, sweeps), fading_priors(cell, sweeps)
    expected = None if estimate is None else estimated_profiles(estimate, sweeps)
    made: list[Recorded | None] = []
    sizes = cell.mechanics
    encoder = np.zeros(len(cell.joints)) if sizes is None else Terms.of(cell, sizes).encoder
    for i, trace in enumerate(index.traces):
        if sweeps.kind[i] == "absolute":
            made.append(None)
            continue
        sign_sources = []
        first, last = before[i], after[i]
        if first is not None and last is not None and first.good and last.good:
            sd = float(np.hypot(first.sigma, last.sigma))
            sign_sources.append(SignSource(last.length - first.length, sd, "scans"))
        if expected is not None:
            sign_sources.append(estimate_sign_source(expected[i]))
        joint = moving_joint(sweeps, i)
        start, end = float(sweeps.q_start[i, joint]), float(sweeps.q_end[i, joint])
        samples = lay_out(
            trace,
            start,
            end,
            unit=cell.joints[joint].unit,
            scale=float(cell.joint_scales[joint]),
            place=f"{sweeps.file}: {sweeps.label[i]}",
        )
        made.append(
            Recorded(
                label=str(sweeps.label[i]),
                samples=samples,
                start=start,
                end=end,
                profile=profiles[i],
                wavelength=float(wavelength[i]),
                wavelength_share=float(share[i]),
                fading=fading[i],
                joint=joint,
                errs=sizes is not None,
                ripple=float(encoder[joint] / np.sqrt(2.0)),
                sign_sources=tuple(sign_sources),
            )
        )
    return made


def fading_priors(cell: Cell, sweeps: Sweeps) -> list[Nuisance]:
    """What a signal may do beside its fringes along each sweep, if the mirror fades as the optics say."""
    model = CavityModel.of(cell)
    sds = np.array([p.prior_sd for p in model.free])
    draws = model.free.nominal + sds * np.random.default_rng(_SEED).standard_normal((_DRAWS, len(sds)))
    q, fit = nodes(sweeps, len(_FLOORS), _NODES)
    normals, origins = model.mirrors(draws, q)
    vectors = [model.vector(values) for values in draws]
    fibres = np.array([fibre_in_world(vector)[:3, 3] for vector in vectors])
    axes = np.array([optical_axis(cell, vector) for vector in vectors])
    distance = np.abs(np.einsum("vqi,vqi->vq", normals, origins - fibres[:, None]))
    tilt = np.arccos(np.clip(np.abs(np.einsum("vqi,vi->vq", normals, axes)), 0.0, 1.0))
    seen = np.log(np.maximum(mirror_amplitude(cell.interferometer, distance, tilt), 1e-12))
    centre, spread = centre_and_spread(coefficients_of(seen, fit))
    wide = np.hypot(spread, _OPTICS_SHARE * np.abs(centre)) + np.array(_FLOORS)
    return [
        Nuisance(CALM.offset, CALM.gain, tuple(sd.tolist()), tuple(mean.tolist()))
        for mean, sd in zip(centre, wide, strict=True)
    ]


def sweep_rows(sweeps: Sweeps, row: int, reading: Reading, points: int = 0) -> Sweeps:
    """The row of a sweep by a good reading, after `points` interior points that share a group with it."""
    one = sweeps.take(np.array([row]))
    if points == 0:
        one = one.with_measurement(np.array([reading.dl]), reading.sigma)
        return replace(one, signed=np.array([reading.signed]), group=np.array([""]), scale_ppm=reading.scale_ppm)
    s, changes, sigma = reading.grouped(points)
    changes = changes if reading.signed else np.abs(changes)
    rows = replace(rows_along(one, s), signed=np.full(len(s), reading.signed))
    return replace(rows, scale_ppm=np.repeat(reading.scale_ppm, len(s))).with_measurement(changes, sigma)


def rows_along(one: Sweeps, s: Floats) -> Sweeps:
    """Rows of `one` sweep that end at places on it, shape (n,), the last of which is its end; they share its start."""
    n = len(s)
    rows = one.take(np.zeros(n, dtype=np.int64))
    label = str(one.label[0]) or f"row {one.rows[0]}"
    names = [f"{label}-mid"] if n == 2 else [f"{label}-{i}of{n}" for i in range(1, n)]
    q_end = rows.q_start + (s[:, None] + 1.0) / 2.0 * (rows.q_end - rows.q_start)
    q_end[-1] = one.q_end[0]
    labels = np.array([*names, label], dtype=np.str_)
    return replace(rows, q_end=q_end, label=labels, group=np.array([label] * n, dtype=np.str_))


def absolute_rows(
    sweeps: Sweeps, row: int, before: ScanReading | None, after: ScanReading | None, share: float = 0.0
) -> Sweeps:
    """Absolute lengths at the ends of a sweep by its good scans; `share`: relative sd of wavelength over index."""
    one = sweeps.take(np.array([row]))
    here = one.q_start, one.q_end
    good = [(scan, q, name) for scan, q, name in zip((before, after), here, ("before", "after"), strict=True)]
    kept = [(scan, q, name) for scan, q, name in good if scan is not None and scan.good]
    rows = one.take(np.zeros(len(kept), dtype=np.int64))
    if not kept:
        return rows
    apart = one.kind[0] != "absolute"
    rows = replace(
        rows,
        q_start=np.concatenate([q for _, q, _ in kept]),
        q_end=np.concatenate([q for _, q, _ in kept]),
        label=np.array([f"{one.label[0]}-{name}" if apart else str(one.label[0]) for *_, name in kept], dtype=np.str_),
        kind=np.full(len(kept), "absolute"),
        group=np.full(len(kept), "", dtype=np.str_),
        signed=np.ones(len(kept), dtype=bool),
        trace=np.full(len(kept), "", dtype=np.str_),
        scale_ppm=np.full(len(kept), 1e6 * share if share else np.nan),
    )
    lengths, sigmas = (np.array([getattr(scan, name) for scan, *_ in kept]) for name in ("length", "sigma"))
    return rows.with_measurement(lengths, sigmas)


def _doubtful(
    index: TraceIndex, readings: Sequence[Reading | None], after: Sequence[ScanReading | None]
) -> DoubtfulRecord:
    """The recordings that gave no row."""
    found: list[tuple[int, str, ScanReading | Reading]] = []
    for i, (reading, scan) in enumerate(zip(readings, after, strict=True)):
        if reading is None and scan is not None and not scan.good:
            found.append((i, scan.refused or scan.doubt, scan))
        elif reading is not None and not reading.good:
            found.append((i, f"refused: {reading.refused}" if reading.refused else reading.doubt, reading))
    at = np.array([i for i, *_ in found], dtype=np.int64)
    # A scan tells a length.
    dl = [each.length if isinstance(each, ScanReading) else each.dl for *_, each in found]
    return DoubtfulRecord(
        session=index.sweeps.session[at],
        label=index.sweeps.label[at],
        reason=np.array([why for _, why, _ in found], dtype=np.str_),
        recording=at,
        dl=np.array(dl, dtype=float),
        sigma=np.array([each.sigma for *_, each in found], dtype=float),
        signed=np.array([isinstance(each, ScanReading) or each.signed for *_, each in found], dtype=bool),
        alternatives=tuple(() if isinstance(each, ScanReading) else each.alternatives for *_, each in found),
    )


def _warnings(
    index: TraceIndex,
    readings: Sequence[Reading | None],
    doubtful: DoubtfulRecord,
    before: Sequence[ScanReading | None],
    after: Sequence[ScanReading | None],
) -> list[str]:
    sweeps = index.sweeps
    said = _left_out(doubtful)
    for i, scans in enumerate(zip(before, after, strict=True)):
        for name, scan in zip(("before", "after"), scans, strict=True):
            if scan is not None and not scan.good and sweeps.kind[i] != "absolute":
                said.append(f"{sweeps.label[i]}: the scan {name} it is not used: {scan.refused or scan.doubt}")
    for i, reading in enumerate(readings):
        first, last = before[i], after[i]
        if reading is None or not reading.good or reading.signed or not (first and last and first.good and last.good):
            continue
        told = f"{last.length - first.length:.3f} +- {np.hypot(first.sigma, last.sigma):.3f} um"
        said.append(f"{sweeps.label[i]}: no sign: the scans say {told}, the trace +-{reading.dl:.3f} um")
    missed = {}
    for each in readings:
        if each is not None and each.good and (each.uneven or each.late):
            lengths = lengths_at(each.profile, np.array([-1.0, each.set_out, each.stop, 1.0]))
            missed[each.label] = float(np.abs(np.diff(lengths)[::2]).sum())
    # An uneven course between ends that hold is no matter.
    astray = [label for label, miss in missed.items() if miss >= _MISSED]
    if astray:
        said.append(
            f"in {counted(len(astray), 'sweep')} the mirror does not follow its joint ({_some(astray)}; it misses up "
            f"to {max(missed.values()):.2f} um): dL is the mirror's by its fringes, the joint's ends are not held to "
            "it; fpcal trace shows them"
        )
    if (sweeps.group != "").any():
        said.append("groups of the index are dropped: each trace has a start of its own")
    return said


def _left_out(doubtful: DoubtfulRecord) -> list[str]:
    """Why sweeps are left out, sweeps of one reason together; what one turn of the gain mends is said once."""
    reasons: dict[str, list[str]] = {}
    also, cut = {}, ""
    for label, why, others in zip(doubtful.label, doubtful.reason, doubtful.alternatives, strict=True):
        if why.startswith("refused: saturated"):
            cut = cut or why
            why = cut
        reasons.setdefault(why, []).append(label)
        also[why] = f"; it may also be {', '.join(f'{dl:.3f}' for dl in others)} um" if others else ""
    return [
        f"{labels[0]}: {why}{also[why]}" if len(labels) == 1 else f"{len(labels)} sweeps ({_some(labels)}): {why}"
        for why, labels in reasons.items()
    ]


def _some(labels: Sequence[str]) -> str:
    return ", ".join(labels[:5]) + (", ..." if len(labels) > 5 else "")


def _gain(index: TraceIndex, full_scale: float | None) -> list[str]:
    """How much more gain the converter has room for, where its steps are coarse beside the fringes."""
    used = max((float(trace.irradiance.max()) for trace in index.traces if len(trace)), default=np.inf)
    if full_scale is None or not 0.0 < used < _LITTLE * full_scale:
        return []
    return [f"the light reaches {used:.3g} V of {full_scale:g} V: raise the gain {0.9 * full_scale / used:.2g} times"]
