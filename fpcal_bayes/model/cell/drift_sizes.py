"""How much each parameter of a cell drifts, as its TOML file states it."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class DriftSize:
    """Drift of one parameter: a sum of independent parts, each zero where it is absent; in um, rad and days."""

    name: str  # of the parameter
    walk: float = 0.0  # standard deviation of a random walk after one day; it grows with the square root of time
    rate_sd: float = 0.0  # standard deviation of a steady rate per day, unknown beforehand
    #: bounded_sd, bounded_hours: Standard deviation and time constant of a motion that returns (Ornstein-Uhlenbeck).
    bounded_sd: float = 0.0
    bounded_hours: float = 0.0
    #: temperature, temperature_sd: Change per kelvin of the logged temperature: expected value and its standard
    #: deviation.
    temperature: float = 0.0
    temperature_sd: float = 0.0

    def content(self) -> dict[str, Any]:
        """The sizes as a JSON-like value, for hashes."""
        return asdict(self)


#: Keys of a drift table that are sizes in the parameter's own unit, and the fewest they may be.
SIZES_IN_UNIT: dict[str, float] = {
    "walk": 0.0,
    "rate_sd": 0.0,
    "bounded_sd": 0.0,
    "temperature": float("-inf"),
    "temperature_sd": 0.0,
}
