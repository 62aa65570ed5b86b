"""The emulated cell of a RIG.toml: all its devices on loopback, and the RIG.toml that finds them."""

import json
import tomllib
from pathlib import Path
from typing import Any

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import read_text, write_text
from fpcal_bayes.io.truth import read_truth
from fpcal_bayes.measure.truth import Truth, default_truth
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.rig.clock import Halt
from fpcal_bayes.rig.emulate.attocube import IDS3010
from fpcal_bayes.rig.emulate.cell import SimulatedCell
from fpcal_bayes.rig.emulate.pi import PIController
from fpcal_bayes.rig.emulate.server import Server
from fpcal_bayes.rig.emulate.smaract import MCS2
from fpcal_bayes.rig.settings import IDSDevice, Rig
from fpcal_bayes.simulator.machine import Machine


class EmulatedBench:
    """All devices of a rig, emulated: `lab` is the simulated cell behind them, `server.inject` gives them faults."""

    def __init__(self, rig: Rig, cell: Cell, truth: Truth | None = None, machine: Machine | None = None) -> None:
        stated = rig.emulation
        if truth is None:
            place = Path(rig.file).parent / stated.truth
            truth = read_truth(place, cell) if stated.truth else default_truth(cell, stated.seed)
        instrument = rig.instrument
        if not isinstance(instrument, IDSDevice):
            raise InputError(f"{rig.file}: key interferometer.record: a program is not emulated, expected attocube-ids")
        self.rig = rig
        self.lab = SimulatedCell(
            cell,
            truth,
            rig.clock,
            noise=instrument.noise * instrument.settings.samples**0.5,
            settle_s=stated.settle_s,
            seed=stated.seed,
            time_h=stated.time_h,
            machine=machine,
        )
        self.server = Server(rig.clock)
        self.stages: dict[str, PIController | MCS2] = {}
        for controller in rig.controllers:
            axes = {i: joint.axis for i, joint in enumerate(rig.joints) if joint.axis.name == controller.name}
            for i in axes:
                self.lab.axes[i].speed = rig.joints[i].speed
            self.stages[controller.name] = (PIController if controller.driver == "pi-gcs2" else MCS2)(self.lab, axes)
            self.server.add(controller.name, self.stages[controller.name], controller.address)
        space = instrument.settings.namespace
        spaces = ("ids", "sen") if space == "auto" else (space,)
        self.ids = IDS3010(self.lab, instrument.settings.axis, instrument.settings.sign, spaces)
        self.server.add(instrument.name, self.ids, instrument.address)
        self._instrument = instrument.name
        self._pending = sorted(stated.faults, key=lambda fault: fault.at_s)

    def write_live(self, path: Path) -> None:
        """Write the rig's file with the ports that are open and the clock that runs."""
        table = tomllib.loads(read_text(Path(self.rig.file)))
        for name in self.stages:
            table["controller"][name]["address"] = str(self.server.endpoints[name].address)
        table["interferometer"]["address"] = str(self.server.endpoints[self._instrument].address)
        table["clock"] = {"speedup": self.rig.clock.speedup, "anchor_s": self.rig.clock.anchor}
        table.pop("emulate", None)
        write_text(path, _toml(table))

    def run(self, halt: Halt) -> None:
        """Serve until `halt` says so; faults of the file come at their times."""
        began = self.rig.clock.now()
        self.server.start()
        try:
            for fault in self._pending:
                halt.wait(self.rig.clock.wall(began + fault.at_s - self.rig.clock.now()))
                self.server.inject(fault.device, fault.kind, fault.duration_s)
            halt.wait(float("inf"))
        finally:
            self.server.stop()


def _toml(table: dict[str, Any], place: str = "") -> str:
    lines = [f"{key} = {json.dumps(value)}\n" for key, value in table.items() if not isinstance(value, (dict, list))]
    for key, value in table.items():
        if isinstance(value, dict):
            name = f"{place}{json.dumps(key)}"
            lines.append(f"\n[{name}]\n{_toml(value, f'{name}.')}")
    return "".join(lines)
