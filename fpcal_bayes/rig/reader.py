"""Read RIG.toml, with a message for everything that can be wrong in it."""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from fpcal_bayes.io.validate import Tables, literal, read_toml
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.joints import Joint
from fpcal_bayes.rig import settings
from fpcal_bayes.rig.clock import Clock
from fpcal_bayes.rig.drivers import attocube, pi, smaract
from fpcal_bayes.rig.drivers.attocube import IDSSettings, Namespace
from fpcal_bayes.rig.drivers.interface import Address

SCHEMA = "fpcal-rig/1"

#: Kinds of faults, see `emulate.faults`.
FAULTS = ("no-answer", "half-line", "end-stop", "following-error", "reset", "slow-settling", "lost-fringe")

_PORTS = {"pi-gcs2": pi.DEFAULT_PORT, "smaract-mcs2": smaract.DEFAULT_PORT, "attocube-ids": attocube.DEFAULT_PORT}


def read_rig(source: str | Path, cell: Cell) -> settings.Rig:
    """Read the rig of `cell` from a TOML file; InputError if anything in it is not as documented."""
    cell.require_one_beam("a rig")
    return read_toml(Path(source), lambda table: _Reader(str(source)).rig(table, cell))


class _Reader(Tables):
    """Turns the tables of one file into a rig; every refusal names the file and the key."""

    def rig(self, table: dict[str, Any], cell: Cell) -> settings.Rig:
        self.keys(table, "", {"schema", "name", "clock", "session", "controller", "joint", "interferometer", "emulate"})
        if table.get("schema") != SCHEMA:
            raise self.error("schema", f"expected {SCHEMA!r}, found {literal(table.get('schema'))}")
        session = self.optional(table, "", "session")
        self.keys(session, "session", {"close_nm", "repeats", "least_gap_um"})
        named = self.table(table, "", "controller")
        controllers = tuple(self.controller(named, name) for name in named)
        joints = self.table(table, "", "joint")
        places = [f"q{number}" for number in range(1, len(cell.joints) + 1)]
        self.keys(joints, "joint", set(places))
        driven = tuple(
            self.joint(self.table(joints, "joint", place), f"joint.{place}", joint, set(named))
            for place, joint in zip(places, cell.joints, strict=True)
        )
        self.each_once(driven, places)
        idle = set(named) - {joint.axis.name for joint in driven}
        if idle:
            raise self.error(f"controller.{sorted(idle)[0]}", "no joint of the cell is on it, expected one or more")
        instrument = self.instrument(self.table(table, "", "interferometer"))
        counting = [instrument.name] if isinstance(instrument, settings.IDSDevice) else []
        return settings.Rig(
            file=str(self.file),
            name=self.text(table, "", "name"),
            clock=self.clock(self.optional(table, "", "clock")),
            controllers=controllers,
            joints=driven,
            instrument=instrument,
            close=self.number(session, "session", "close_nm", low=0.0, default=30.0) * 1e-3,
            repeats=self.whole(session, "session", "repeats", 0, 100, 1),
            least_gap=self.number(session, "session", "least_gap_um", low=0.0, default=0.0),
            emulation=self.emulation(self.optional(table, "", "emulate"), {*named, *counting}),
        )

    def clock(self, table: dict[str, Any]) -> Clock:
        self.keys(table, "clock", {"speedup", "anchor_s"})
        speedup = self.number(table, "clock", "speedup", low=1.0, high=1e6, default=1.0)
        return Clock(speedup, self.number(table, "clock", "anchor_s", low=0.0, default=time.time()))

    def controller(self, named: dict[str, Any], name: str) -> settings.ControllerSettings:
        table, place = self.table(named, "controller", name), f"controller.{name}"
        self.keys(table, place, {"driver", "address", "timeout_s", "servo_on"})
        driver = self.choice(table, place, "driver", get_args(settings.StageDriver), None)
        address, servo_on = self.address(table, place, _PORTS[driver]), self.flag(table, place, "servo_on")
        return settings.ControllerSettings(name, driver, address, self.timeout(table, place, 2.0), servo_on)

    def joint(self, table: dict[str, Any], place: str, joint: Joint, controllers: set[str]) -> settings.JointSettings:
        unit, scale, stated = joint.unit, 1.0 if joint.unit == "um" else math.radians(1.0), joint.controller
        known = {f"speed_{unit}_s", f"tolerance_{unit}", "settle_s", "settle_timeout_s", "controller", "channel"}
        self.keys(table, place, known)
        if stated is None:
            raise self.error(place, "the cell does not say how a controller counts this joint, expected it to")
        name = self.line(table, place, "controller", stated.name)
        if name not in controllers:
            expected = ", ".join(sorted(controllers))
            raise self.error(f"{place}.controller", f"expected one of {expected}, found {name!r:.60}")
        return settings.JointSettings(
            replace(stated, name=name, channel=self.line(table, place, "channel", stated.channel)),
            speed=self.number(table, place, f"speed_{unit}_s", low=1e-9, high=1e6) * scale,
            tolerance=self.number(table, place, f"tolerance_{unit}", low=1e-9, high=1e3) * scale,
            settle_s=self.number(table, place, "settle_s", low=0.0, high=600.0, default=0.1),
            settle_timeout_s=self.number(table, place, "settle_timeout_s", low=0.001, high=3600.0, default=10.0),
        )

    def each_once(self, joints: tuple[settings.JointSettings, ...], places: list[str]) -> None:
        seen: dict[tuple[str, str], str] = {}
        for place, joint in zip(places, joints, strict=True):
            name, channel = joint.axis.name, joint.axis.channel
            before = seen.setdefault((name, channel), place)
            if before != place:
                what = f"{name} channel {channel} moves {before} already, expected another"
                raise self.error(f"joint.{place}.channel", what)

    def instrument(self, table: dict[str, Any]) -> settings.IDSDevice | settings.ProgramDevice:
        place = "interferometer"
        if "record" in table:
            self.keys(table, place, {"record", "timeout_s"})
            return settings.ProgramDevice(self.text(table, place, "record"), self.timeout(table, place, 10.0))
        known = {"driver", "name", "address", "timeout_s", "axis", "namespace", "sign", "noise_nm", "samples"}
        self.keys(table, place, known | {"steady_nm", "least_contrast_permille", "air"})
        self.choice(table, place, "driver", ("attocube-ids",), None)
        sign = self.whole(table, place, "sign", -1, 1, 1)
        if sign == 0:
            raise self.error(f"{place}.sign", "expected 1 or -1, found 0")
        noise = self.number(table, place, "noise_nm", low=1e-6, high=1e6) * 1e-3
        samples = self.whole(table, place, "samples", 1, 10_000, 8)
        spread_nm = 10.0 * noise * math.sqrt(samples) * 1e3
        contrast = "least_contrast_permille"
        read = IDSSettings(
            axis=self.whole(table, place, "axis", 0, 2, 0),
            namespace=self.choice(table, place, "namespace", get_args(Namespace), "auto"),
            sign=sign,
            samples=samples,
            steady=self.number(table, place, "steady_nm", low=1e-3, high=1e6, default=spread_nm) * 1e-3,
            least_contrast_permille=self.number(table, place, contrast, low=0.0, high=1000.0, default=20.0),
            air=self.flag(table, place, "air"),
        )
        address = self.address(table, place, attocube.DEFAULT_PORT)
        name = self.line(table, place, "name", "IDS3010")
        return settings.IDSDevice(name, address, self.timeout(table, place, 2.0), read, noise)

    def emulation(self, table: dict[str, Any], devices: set[str]) -> settings.EmulationSettings:
        self.keys(table, "emulate", {"truth", "seed", "time_h", "settle_s", "fault"})
        entries = table.get("fault", [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise self.error("emulate.fault", "expected [[emulate.fault]] tables")
        return settings.EmulationSettings(
            truth=self.line(table, "emulate", "truth", ""),
            seed=self.whole(table, "emulate", "seed", 0, 2**32 - 1, 0),
            time_h=self.number(table, "emulate", "time_h", default=0.0),
            settle_s=self.number(table, "emulate", "settle_s", low=0.0, high=600.0, default=0.05),
            faults=tuple(self.fault(entry, f"emulate.fault {i}", devices) for i, entry in enumerate(entries, 1)),
        )

    def fault(self, entry: dict[str, Any], place: str, devices: set[str]) -> settings.FaultSettings:
        self.keys(entry, place, {"device", "kind", "at_s", "duration_s"})
        return settings.FaultSettings(
            self.choice(entry, place, "device", tuple(sorted(devices)), None),
            self.choice(entry, place, "kind", FAULTS, None),
            self.number(entry, place, "at_s", low=0.0),
            self.number(entry, place, "duration_s", low=0.0, default=10.0),
        )

    def timeout(self, table: dict[str, Any], place: str, default: float) -> float:
        return self.number(table, place, "timeout_s", low=0.001, high=600.0, default=default)

    def address(self, table: dict[str, Any], place: str, port: int) -> Address:
        text = self.text(table, place, "address")
        host, digits = text.rsplit(":", 1) if ":" in text else (text, str(port))
        if not host or not digits.isdecimal() or int(digits) > 65535:
            raise self.error(f"{place}.address", f"expected HOST or HOST:PORT, found {literal(text)}")
        return Address(host, int(digits))

    def line(self, table: dict[str, Any], place: str, key: str, default: str) -> str:
        return self.text(table, place, key) if key in table else default
