"""attocube IDS3010 by JSON-RPC 2.0: requests without an end mark, answers that end in CRLF, lengths in pm.

Instruments before 2025 call their methods ``com.attocube.ids.*``, later ones ``com.attocube.sen.*``.
"""

import json
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fpcal_bayes.io.validate import is_number
from fpcal_bayes.rig.drivers.interface import DeviceError, Disturbed
from fpcal_bayes.rig.drivers.link import Link

DEFAULT_PORT = 9090

Namespace = Literal["auto", "ids", "sen"]

_UM = 1e-6
_RUNNING = "measurement running"


@dataclass(frozen=True)
class IDSSettings:
    """How one head of an IDS is read."""

    axis: int = 0  # the head, 0 to 2
    namespace: Namespace = "auto"  # ``ids``, ``sen``, or ``auto``: whichever the instrument answers to
    sign: int = 1  # 1 if the reading grows with the cavity length, else -1
    samples: int = 8  # positions that a reading averages
    steady: float = 0.1  # largest spread of these, in um
    least_contrast_permille: float = 20.0  # below this the fringes count as lost
    air: bool = False  # whether an environmental unit tells the air's temperature


class AttocubeIDS:
    """One head of an IDS3010."""

    def __init__(self, link: Link, settings: IDSSettings) -> None:
        self.name = link.device
        self._link = link
        self._settings = settings
        self._space = settings.namespace
        self._number = 0

    def prepare(self) -> None:
        """Connect; the measurement must run already, since its start takes the zero of the positions."""
        self._link.open()
        if self._space == "auto":
            try:
                self._request("com.attocube.sen.system.getCurrentMode", [])
                self._space = "sen"
            except _UnknownMethodError:
                self._space = "ids"
        mode = self._call("system.getCurrentMode")
        if _RUNNING not in mode:
            raise self._link.error(f"mode {mode[-1]!r:.40}, expected {_RUNNING!r}: start it, then start again")
        self.watch()

    def length(self) -> float:
        """Mean of the samples, in um."""
        read = np.array([self._position() for _ in range(self._settings.samples)])
        self.watch()
        spread = float(np.ptp(read))
        if spread > self._settings.steady:
            raise Disturbed(f"the length moves by {1e3 * spread:.0f} nm while it is read")
        return float(np.mean(read))

    def watch(self) -> None:
        """Hold the contrast to its least value."""
        contrast = self._call("displacement.getAxisSignalQuality", self._settings.axis)[1:2]
        if not contrast or not is_number(contrast[0]):
            raise self._link.error(f"expected contrast and baseline, found {contrast!r:.60}")
        if contrast[0] < self._settings.least_contrast_permille:
            raise Disturbed(f"the fringes are lost: contrast {contrast[0]:g} permille")

    def temperature_c(self) -> float:
        """Temperature of the air, or NaN."""
        if not self._settings.air:
            return float("nan")
        result = self._request("com.attocube.ecu.getTemperatureInDegrees", [])
        if not is_number(result[-1]):
            raise self._link.error(f"expected a temperature, found {result!r:.60}")
        return float(result[-1])

    def _position(self) -> float:
        result = self._call("displacement.getAbsolutePositions")
        if len(result) != 4 or not all(map(is_number, result)):
            raise self._link.error(f"expected an error number and three positions, found {result!r:.60}")
        return float(result[1 + self._settings.axis]) * self._settings.sign * _UM

    def _call(self, method: str, *params: Any) -> list[Any]:
        """The result of a method of the instrument's namespace, its error number first."""
        result = self._request(f"com.attocube.{self._space}.{method}", list(params))
        if result[0] != 0:
            raise self._link.error(f"error {result[0]!r:.40}")
        return result

    def _request(self, method: str, params: list[Any]) -> list[Any]:
        self._number += 1
        request = {"jsonrpc": "2.0", "method": method, "params": params, "id": self._number, "api": 2}
        line = self._link.ask(json.dumps(request))
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise self._link.error(f"expected JSON, found {line!r:.60}", method) from error
        if not isinstance(answer, dict) or answer.get("id") != self._number:
            raise self._link.error(f"expected the answer to request {self._number}, found {line!r:.60}", method)
        if "error" in answer:
            code = answer["error"].get("code") if isinstance(answer["error"], dict) else None
            if code == -32601:
                raise _UnknownMethodError(self.name, self._link.address, method, "unknown to this instrument")
            raise self._link.error(f"{answer['error']!r:.80}", method)
        result = answer.get("result")
        if not isinstance(result, list) or not result:
            raise self._link.error(f"expected a list of results, found {result!r:.60}", method)
        return result


class _UnknownMethodError(DeviceError):
    """The instrument does not know a method; the connection is well."""
