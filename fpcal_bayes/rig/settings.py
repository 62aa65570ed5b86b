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
    """One motion controller."""

    name: str
    driver: StageDriver
    address: Address
    timeout_s: float  # seconds of the wall within which every answer comes
    servo_on: bool  # whether servos found off are switched on


@dataclass(frozen=True)
class JointSettings:
    """How one joint is driven; in um or rad, and in seconds of the cell."""

    axis: ControllerAxis  # controller, channel, unit, sign and zero
    speed: float  # per second
    tolerance: float  # how near to its target it stands
    settle_s: float  # for how long it must stand there
    settle_timeout_s: float  # beyond the time of the move itself; after that the move has failed


@dataclass(frozen=True)
class IDSDevice:
    """An interferometer that counts."""

    name: str
    address: Address
    timeout_s: float
    settings: IDSSettings
    noise: float  # standard deviation of one reading, in um; a row's is sqrt(2) times that


@dataclass(frozen=True)
class ProgramDevice:
    """A photodiode recorded by a program."""

    command: str
    timeout_s: float


@dataclass(frozen=True)
class FaultSettings:
    """A fault that an emulated device has by itself, in seconds of the cell."""

    device: str
    kind: str
    at_s: float
    duration_s: float


@dataclass(frozen=True)
class EmulationSettings:
    """What only the emulated cell needs."""

    truth: str = ""  # TOML file of the truth beside RIG.toml, or empty: the paper's
    seed: int = 0
    time_h: float = 0.0  # hours of the campaign at which the cell begins
    settle_s: float = 0.05  # how long an axis rings after a move
    faults: tuple[FaultSettings, ...] = ()


@dataclass(frozen=True)
class Rig:
    """All devices of a cell."""

    file: str  # where it was read
    name: str
    clock: Clock
    controllers: tuple[ControllerSettings, ...]
    joints: tuple[JointSettings, ...]  # in the cell's order
    instrument: IDSDevice | ProgramDevice
    close: float  # largest difference between a sweep's start and its return, in um
    repeats: int  # how often a sweep that is disturbed is driven again
    least_gap: float  # least distance of fibre and mirror that a move may come to, in um
    emulation: EmulationSettings

    @property
    def measuring(self) -> tuple[object, ...]:
        """What the numbers of a session depend on, which therefore stays the same until its end."""
        device = self.instrument
        read = (device.settings, device.noise) if isinstance(device, IDSDevice) else device
        return (tuple(joint.axis for joint in self.joints), read)
