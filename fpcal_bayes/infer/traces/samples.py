"""Recorded traces laid out for a fit of the irradiance itself."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.measure.recordings import TraceIndex, moving_joint
from fpcal_bayes.model.air_index import air_index
from fpcal_bayes.model.cavity import CavityModel, Rows
from fpcal_bayes.model.interferometer import fringe, mirror_views

#: Nodes of a Chebyshev series of the cavity length along a sweep: a turn by 90 deg is met to a femtometre.
NODES = 20


@dataclass(frozen=True, eq=False)
class TraceSamples:
    """Samples of all traces, one trace after the other."""

    labels: tuple[str, ...]
    first: Ints  # samples of trace s are ``first[s]`` to ``first[s + 1]``, shape (n_traces + 1,)
    place: Floats  # joint position along the sweep, from -1 to 1, shape (n_samples,)
    time: Floats  # from -1 to 1 in each trace, shape (n_samples,)
    # amplitude of the fringes relative to the middle of the sweep, as the estimate's mirror makes it, (n_samples,)
    envelope: Floats
    irradiance: Floats  # in V, shape (n_samples,)
    nodes: Floats  # joint vectors at the Chebyshev nodes of each sweep, shape (n_traces * NODES, n_joints)
    wave_number: Floats  # 4 pi n / lambda of each trace, shape (n_traces,)

    @classmethod
    def of(cls, model: CavityModel, values: Floats, index: TraceIndex) -> "TraceSamples":
        """Lay out the sweeps of an index; rows without a trace are left out.

        The mirror of `model` at free parameters `values` (n_free,) makes the envelopes. `InputError` if there is no
        trace, or the joint of one does not move.
        """
        cell, sweeps = model.cell, index.sweeps
        rows = [i for i, trace in enumerate(index.traces) if len(trace) and sweeps.kind[i] == "sweep"]
        if not rows:
            raise InputError(f"{sweeps.file}: no sweep with a trace")
        nodes_at = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
        place, time, nodes = [], [], []
        for i in rows:
            trace, joint = index.traces[i], moving_joint(sweeps, i)
            low, high = float(trace.joint.min()), float(trace.joint.max())
            if not high > low:
                raise InputError(f"{trace.file or sweeps.label[i]}: the joint does not move")
            place.append((2.0 * trace.joint - low - high) / (high - low))
            time.append(np.linspace(-1.0, 1.0, len(trace)))
            at_nodes = np.repeat(sweeps.q_start[i : i + 1], NODES, axis=0)
            at_nodes[:, joint] = (low + high) / 2.0 + (high - low) / 2.0 * nodes_at
            nodes.append(at_nodes)
        chosen = np.array(rows)
        wavelength = np.where(np.isnan(index.wavelength), cell.wavelength, index.wavelength)[chosen]
        air = (index.temperature_c[chosen], index.pressure_hpa[chosen], index.humidity_pct[chosen])
        samples = cls(
            labels=tuple(str(label) for label in sweeps.label[chosen]),
            first=np.concatenate([[0], np.cumsum([len(index.traces[i]) for i in rows])]).astype(np.int64),
            place=np.concatenate(place),
            time=np.concatenate(time),
            envelope=np.ones(sum(map(len, place))),
            irradiance=np.concatenate([index.traces[i].irradiance for i in rows]),
            nodes=np.vstack(nodes),
            wave_number=4.0 * np.pi * air_index(wavelength, *air) / wavelength,
        )
        return samples.seen_by(model, values)

    def seen_by(self, model: CavityModel, values: Floats) -> "TraceSamples":
        """The same samples with the envelopes that the mirror of other parameters (n_free,) makes."""
        # The amplitude is smooth along a sweep, so that the nodes tell it everywhere.
        _, distance, tilt = mirror_views(model, values, self.nodes)
        height = fringe(model.cell.interferometer, distance, tilt)[1].reshape(len(self), NODES)
        series = np.hstack([height.mean(axis=1, keepdims=True), height @ self._to_series.T])
        envelope = [
            chebyshev.chebval(self.place[begin:end], coefficients / coefficients[0])
            for begin, end, coefficients in zip(self.first[:-1], self.first[1:], series, strict=True)
        ]
        return replace(self, envelope=np.concatenate(envelope))

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def counts(self) -> Ints:
        """Samples of each trace, shape (n_traces,)."""
        return np.diff(self.first)

    @cached_property
    def _to_series(self) -> Floats:
        """Matrix from values at the nodes to Chebyshev coefficients 1 .. NODES - 1: a discrete cosine transform."""
        order, node = np.arange(1, NODES)[:, None], np.arange(NODES)[None]
        return np.asarray(2.0 / NODES * np.cos(np.pi * order * (node + 0.5) / NODES))

    def rows(self, model: CavityModel) -> Rows:
        """The nodes laid out for the kernels."""
        return model.pose_rows(self.nodes)

    def series(self, model: CavityModel, values: Floats, rows: Rows) -> tuple[Floats, Floats]:
        """Chebyshev series of the cavity lengths (n_traces, NODES - 1), and derivatives (n_traces, NODES - 1, n_free).

        The constant of the series is left out: the phase of a trace stands for it.
        """
        lengths, jacobian = model.predict_with_jacobian(values, rows)
        # Without the length of the first node the digits of the changes survive.
        lengths = lengths.reshape(len(self), NODES)
        change = lengths - lengths[:, :1]
        slopes = jacobian.reshape(len(self), NODES, -1)
        return change @ self._to_series.T, self._to_series @ slopes
