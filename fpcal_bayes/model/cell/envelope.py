"""What keeps the mirror off the fibre, as a cell's [envelope] table states it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Envelope:
    """Bounds of every motion of a cell, in um and rad; no part of its hash, for they change no cavity length."""

    least_gap: float  # between mirror and fibre, where the edges of both come nearest
    fibre_radius: float  # radius of the fibre's end, with its ferrule where that reaches as far
    mirror_radius: float  # radius of the mirror around the origin of its frame
    max_tilt: float  # largest angle between the mirror's normal and the light turned round
    max_fringe_rate: float  # half waves a second that the cavity length may change by
    together: tuple[tuple[int, ...], ...] = ()  # groups of joints, by position, that may move at the same time
    # gap, gap_sd: measured cavity length at joint zero and its standard deviation, or None where nobody has measured it
    gap: float | None = None
    gap_sd: float | None = None
