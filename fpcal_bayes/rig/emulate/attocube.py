"""An attocube IDS3010 that speaks JSON-RPC 2.0, in its older or its newer namespace or both."""

import json
from typing import Any

from fpcal_bayes.rig.emulate.cell import SimulatedCell

_UNKNOWN_METHOD, _WRONG_PARAMS, _NO_REQUEST = -32601, -32602, -32600
_SPACES = ("ids", "sen")
_CONSTANT = {
    "system.getCurrentMode": "measurement running",
    "system.getDeviceType": "IDS3010",
    "displacement.getMeasurementEnabled": True,
}
_AIR = {"getTemperatureInDegrees": 20.0, "getRefractiveIndex": 1.000268}


class IDS3010:
    """The cavity length on one head, counted with a sign of 1 or -1; the other two stand still."""

    def __init__(self, lab: SimulatedCell, axis: int = 0, sign: int = 1, spaces: tuple[str, ...] = _SPACES) -> None:
        self._lab = lab
        self._axis = axis
        self._sign = sign
        self.spaces = spaces
        self._decoder = json.JSONDecoder()

    def answers(self, buffer: bytearray) -> list[bytes]:
        """One answer for each request; requests follow one another without an end mark."""
        found: list[bytes] = []
        while buffer:
            text = buffer.decode("utf-8", errors="replace")
            start = len(text) - len(text.lstrip())
            try:
                request, end = self._decoder.raw_decode(text[start:])
            except (ValueError, RecursionError):
                if text.strip() and not text.lstrip().startswith("{"):
                    buffer.clear()
                    found.append(self._error(None, _NO_REQUEST, "no request"))
                break
            # Whole characters were read, so bytes are counted again.
            del buffer[: len(text[: start + end].encode())]
            found.append(self._answer(request))
        return found

    def fault(self, kind: str, active: bool) -> None:
        """The fringes are lost, or the counter begins anew."""
        if kind == "lost-fringe":
            self._lab.contrast = 1.0 if active else 500.0
            if active:
                self._lab.slipped += 3
        elif kind == "reset" and not active:
            self._lab.zero, self._lab.slipped = self._lab.length(), 0

    def _answer(self, request: Any) -> bytes:
        if not isinstance(request, dict) or not isinstance(request.get("method"), str):
            return self._error(None, _NO_REQUEST, "no request")
        number, method, params = request.get("id"), request["method"], request.get("params", [])
        result: list[Any] | None = None
        head, _, rest = method.removeprefix("com.attocube.").partition(".")
        if method.startswith("com.attocube.") and head in self.spaces:
            result = self._instrument(rest, params)
        elif head == "ecu" and rest in _AIR:
            result = [0, _AIR[rest]]
        if result is None:
            return self._error(number, _UNKNOWN_METHOD, f"unknown method {method!r:.80}")
        return self._line({"jsonrpc": "2.0", "result": result, "id": number})

    def _instrument(self, method: str, params: Any) -> list[Any] | None:
        if method in _CONSTANT:
            return [0, _CONSTANT[method]]
        head, _, rest = method.partition(".")
        if head != "displacement":
            return None
        if rest in ("getAbsolutePositions", "getAxesDisplacement"):
            return [0, *self._positions()]
        axis = params[0] if isinstance(params, list) and len(params) == 1 else None
        if rest == "getAxisSignalQuality":
            contrast = round(self._lab.contrast) if axis == self._axis else 500
            return [0, contrast, 200] if axis in (0, 1, 2) else [7, 0, 0]
        if rest in ("getAbsolutePosition", "getAxisDisplacement"):
            return [0, self._positions()[axis]] if axis in (0, 1, 2) else [7, 0]
        return None

    def _positions(self) -> list[int]:
        positions = [0, 0, 0]
        positions[self._axis] = round(self._sign * self._lab.reading() * 1e6)
        return positions

    def _error(self, number: Any, code: int, message: str) -> bytes:
        return self._line({"jsonrpc": "2.0", "error": {"code": code, "message": message}, "id": number})

    @staticmethod
    def _line(content: dict[str, Any]) -> bytes:
        return (json.dumps(content) + "\r\n").encode()
