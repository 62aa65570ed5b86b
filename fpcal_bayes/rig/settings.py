"""A rig: which devices move and read a cell, and how; what RIG.toml says."""

from dataclasses import dataclass
from typing import Literal

from fpcal_bayes.model.cell.joints import ControllerAxis
from fpcal_bayes.rig.clock import Clock
from fpcal_bayes.rig.drivers.attocube import IDSSettings
from fpcal_bayes.rig.drivers.interface import Address

StageDriver = Literal["pi-gcs2", "smaract-mcs2"]


@dataclass(frozen=True)
class ControllerSettings:
    """One motion controller.

    Attributes
    ----------
    timeout_s
        Seconds of the wall within which every answer comes.
    servo_on
        Whether servos found off are switched on.
    """

    name: str
    driver: StageDriver
    address: Address
    timeout_s: float
    servo_on: bool


@dataclass(frozen=True)
class JointSettings:
    """How one joint is driven; in um or rad, and in seconds of the cell.

    Attributes
    ----------
    axis
        Controller, channel, unit, sign and zero.
    speed
        Per second.
    tolerance
        How near to its target it stands.
    settle_s
        For how long it must stand there.
    settle_timeout_s
        Beyond the time of the move itself; after that the move has failed.
    """

    axis: ControllerAxis
    speed: float
    tolerance: float
    settle_s: float
    settle_timeout_s: float


@dataclass(frozen=True)
class IDSDevice:
    """An interferometer that counts.

    Attributes
    ----------
    noise
        Standard deviation of one reading, in um; a row's is sqrt(2) times that.
    """

    name: str
    address: Address
    timeout_s: float
    settings: IDSSettings
    noise: float


@dataclass(frozen=True)
class ProgramDevice:
    """A photodiode recorded by a program."""

    command: str
    timeout_s: float


@dataclass(frozen=True)
class FaultSettings:
    """A fault that an emulated device has by itself: which, when and for how long, in seconds of the cell."""

    device: str
    kind: str
    at_s: float
    duration_s: float


@dataclass(frozen=True)
class EmulationSettings:
    """What only the emulated cell needs.

    Attributes
    ----------
    truth
        TOML file of the truth beside RIG.toml, or empty: the paper's.
    time_h
        Hours of the campaign at which the cell begins.
    settle_s
        How long an axis rings after a move.
    """

    truth: str = ""
    seed: int = 0
    time_h: float = 0.0
    settle_s: float = 0.05
    faults: tuple[FaultSettings, ...] = ()


@dataclass(frozen=True)
class Rig:
    """All devices of a cell.

    Attributes
    ----------
    file
        Where it was read.
    joints
        In the cell's order.
    close
        Largest difference between a sweep's start and its return, in um.
    repeats
        How often a sweep that is disturbed is driven again.
    least_gap
        Least distance of fibre and mirror that a move may come to, in um.
    """

    file: str
    name: str
    clock: Clock
    controllers: tuple[ControllerSettings, ...]
    joints: tuple[JointSettings, ...]
    instrument: IDSDevice | ProgramDevice
    close: float
    repeats: int
    least_gap: float
    emulation: EmulationSettings

    @property
    def measuring(self) -> tuple[object, ...]:
        """What the numbers of a session depend on, which therefore stays the same until its end."""
        device = self.instrument
        read = (device.settings, device.noise) if isinstance(device, IDSDevice) else device
        return (tuple(joint.axis for joint in self.joints), read)
