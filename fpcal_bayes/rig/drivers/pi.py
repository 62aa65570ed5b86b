"""PI controllers that speak GCS 2.0 (E-712, E-727 and others), by the maker's own PIPython, without its library.

PIPython builds the commands, checks ``ERR?`` after each and reads the answers. The bytes go through our `Link` in the
place of its `PISocket`: that one waits without a timeout for a connection, burns a core while it waits for an answer,
and never comes back from a connection that the controller closed.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cell.joints import ControllerAxis
from fpcal_bayes.rig.drivers.interface import DeviceError
from fpcal_bayes.rig.drivers.link import Link

try:
    from pipython.pidevice.gcs2.gcs2commands import GCS2Commands
    from pipython.pidevice.gcserror import GCSError
    from pipython.pidevice.gcsmessages import GCSMessages
except ImportError:
    # The extra `rig` is not installed: said when a rig asks for this driver.
    GCS2Commands = None

DEFAULT_PORT = 50000

_STOP_ALL = "\x18"
_ERROR = "ERR?\n"
#: "Controller was stopped by command": what a stop leaves behind.
_STOPPED_BY_COMMAND = 10


class PIStage:
    """Axes of one PI controller, in the order of `joints`; speeds in um/s or rad/s, shape (n_axes,)."""

    def __init__(
        self, link: Link, joints: tuple[int, ...], axes: tuple[ControllerAxis, ...], speeds: Floats, servo_on: bool
    ) -> None:
        self.name, self.joints = link.device, joints
        self._link, self._axes, self._speeds = link, axes, speeds
        self._servo_on = servo_on
        # Axes whose targets stay are left alone.
        self._targets = np.full(len(axes), np.nan)
        self._channels = [axis.channel for axis in axes]
        self._gateway = _Gateway(link)
        if GCS2Commands is None:
            raise InputError('driver pi-gcs2 needs PIPython: pip install "fpcal-bayes[rig]"')
        self._gcs: Any = GCS2Commands(GCSMessages(self._gateway))

    def prepare(self) -> None:
        """Connect; axes stopped that move, servos on, speeds set."""
        self._link.open()
        self.stop()
        self._gcs.errcheck = False
        self._asked(self._gcs.qERR)  # An error from before this session is none of ours.
        self._gcs.errcheck = True
        name = self._asked(self._gcs.qIDN).strip()
        known = self._asked(self._gcs.qSAI)
        for channel in self._channels:
            if channel not in known:
                raise self._link.error(f"{name!r:.60} has the axes {', '.join(known)}, expected {channel!r}")
        off = [channel for channel, on in self._of(self._gcs.qSVO).items() if not on]
        if off and not self._servo_on:
            raise self._link.error(f"the servo of axis {', '.join(off)} is off: switch it on, or set servo_on = true")
        if off:
            self._asked(lambda: self._gcs.SVO(dict.fromkeys(off, True)))
        speeds = {
            axis.channel: abs(float(speed / axis.per_unit))
            for axis, speed in zip(self._axes, self._speeds, strict=True)
        }
        self._asked(lambda: self._gcs.VEL(speeds))

    def move(self, positions: Floats) -> None:
        """Start to move; all axes of one command start together, but do not move in step."""
        targets = {
            axis.channel: float(axis.reading_of(q))
            for axis, q, before in zip(self._axes, positions, self._targets, strict=True)
            if q != before
        }
        if targets:
            self._asked(lambda: self._gcs.MOV(targets))
        self._targets = positions.copy()

    def position(self) -> Floats:
        """Joint values in um and rad."""
        read = self._of(self._gcs.qPOS)
        return np.array([float(axis.joint_value(np.asarray(read[axis.channel]))) for axis in self._axes])

    def settled(self) -> bool:
        """Whether all axes are on target."""
        if all(self._of(self._gcs.qONT).values()):
            return True
        off = [channel for channel, on in self._of(self._gcs.qSVO).items() if not on]
        if off:
            raise self._link.error(f"the servo of axis {', '.join(off)} went off: following error, or a reset", "MOV")
        return False

    def stop(self) -> None:
        """Stop all axes by the one character that interrupts everything."""
        self._targets[:] = np.nan
        self._link.shout(_STOP_ALL)

    def stopped(self) -> bool:
        """Whether no axis moves; over a new connection, in which the stop is said again."""
        self._link.open()
        self._link.shout(_STOP_ALL)
        self._gcs.errcheck = False
        try:
            left = self._asked(self._gcs.qERR)
            if left not in (0, _STOPPED_BY_COMMAND):
                raise self._link.error(f"error {left} after the stop", "STP")
            first = self._of(self._gcs.qPOS)
            moving = self._asked(lambda: self._gcs.messages.read("\x05"))
            return int(moving.strip(), 16) == 0 and len(first) == len(self._channels)
        except ValueError as error:
            raise self._link.error("expected the state of motion", "#5") from error
        finally:
            self._gcs.errcheck = True

    def _of(self, query: Callable[[list[str]], dict[str, Any]]) -> dict[str, Any]:
        found: dict[str, Any] = self._asked(lambda: query(self._channels))
        if sorted(found) != sorted(self._channels) or any(value == "" for value in found.values()):
            raise self._link.error(f"expected a value of each of the axes {', '.join(self._channels)}")
        return found

    def _asked(self, call: Callable[[], Any]) -> Any:
        """What PIPython makes of an exchange; its failures as ours."""
        try:
            return call()
        except DeviceError:
            raise
        except GCSError as error:
            raise self._link.error(" ".join(str(error).split()), self._gateway.command) from error
        except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
            # What its readers raise at text that is no answer.
            raise self._link.error(f"the answer is not understood ({error})") from error


class _Gateway:
    """Our link as PIPython wants a connection."""

    connected = True
    connectionid = 0

    def __init__(self, link: Link) -> None:
        self._link = link
        #: What was sent last, the question for its error left aside.
        self.command = ""

    @property
    def timeout(self) -> int:
        return round(1e3 * self._link.timeout_s)

    def settimeout(self, value: int) -> None:
        self._link.timeout_s = value / 1e3

    def send(self, message: str) -> None:
        if message != _ERROR:
            self.command = message
        self._link.send(message)

    def read(self) -> str:
        """A whole answer: its last line's end has no blank before it."""
        return self._link.take(lambda data: len(data) if data.endswith(b"\n") and not data.endswith(b" \n") else 0)

    def flush(self) -> None:
        """Nothing to do: a new connection begins empty."""

    def close(self) -> None:
        self._link.close()

    unload = close
