"""attocube's own client of the IDS3010 speaks to the emulated one.

    pip download --no-deps -d /tmp/ids feather-xrol==0.1.1
    python tests/robustness/ids_client.py /tmp/ids/feather_xrol-0.1.1-py3-none-any.whl

The wheel brings attocube's Python interface (`ids_api`) along; it is read where it lies, nothing is installed.
"""

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from rig_fixtures import constant, live

from fpcal_bayes.io.cell import load_cell


def main() -> int:
    """Ask for all that a reading needs; the number of answers that are wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("wheel")
    # The package itself wants ophyd; the interface inside it wants nothing.
    sys.path.insert(0, str(Path(parser.parse_args().wheel) / "feather_xrol"))
    from ids_api import SEN

    cell, wrong = load_cell(mechanics="none"), 0
    with tempfile.TemporaryDirectory() as folder, live(cell, Path(folder), truth=constant(cell)) as found:
        address = found.emulated.server.endpoints["IDS3010"].address
        device = SEN.Device(address.host)
        device.TCP_PORT = address.port
        device.connect()
        length_pm = 1e6 * found.lab.length()
        shift = device.displacement
        answers = {
            "mode": (device.system.getCurrentMode(), lambda found: found == "measurement running"),
            "position": (shift.getAbsolutePosition(0)[1], lambda found: abs(found - length_pm) < 2e4),
            "positions": (shift.getAbsolutePositions()[1:], lambda found: abs(found[0] - length_pm) < 2e4),
            "displacements": (shift.getAxesDisplacement()[1:], lambda found: len(found) == 3),
            "quality": (shift.getAxisSignalQuality(0)[1:], lambda found: tuple(found) == (500, 200)),
            "temperature": (device.ecu.getTemperatureInDegrees(), lambda found: found == 20.0),
            "index": (device.ecu.getRefractiveIndex(), lambda found: 1.0 < found < 1.001),
        }
        for name, (answer, is_right) in answers.items():
            right = bool(is_right(answer))
            wrong += not right
            print(f"{name}: {answer}{'' if right else '  WRONG'}")
        device.close()
    print(f"{len(answers) - wrong} of {len(answers)} answers are right")
    return wrong


if __name__ == "__main__":
    sys.exit(main())
