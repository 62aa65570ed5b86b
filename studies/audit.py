"""Known weaknesses of the packages installed here, by pip-audit; skipped, with the reason, where it cannot ask.

python studies/audit.py
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

_LONGEST_S = 900


def judged(content: dict[str, Any]) -> tuple[list[str], list[str], int]:
    """From pip-audit's JSON: a line a known weakness, the packages it knows nothing of, and how many it judged."""
    weak, unknown, asked = [], [], 0
    for package in content["dependencies"]:
        if "skip_reason" in package:
            unknown.append(package["name"])
            continue
        asked += 1
        for found in package["vulns"]:
            fixed = ", ".join(found["fix_versions"]) or "no version yet"
            weak.append(f"{package['name']} {package['version']}: {found['id']}, mended in {fixed}")
    return weak, unknown, asked


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--service", default="pypi", choices=("pypi", "osv"), help="whom to ask (default: pypi)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        output = Path(name) / "audit.json"
        command = [sys.executable, "-m", "pip_audit", "--local", "--skip-editable", "--progress-spinner", "off"]
        command += ["--timeout", "5", "--vulnerability-service", options.service, "-f", "json", "-o", str(output)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_LONGEST_S)
        except subprocess.TimeoutExpired:
            print(f"skipped: pip-audit did not end within {_LONGEST_S} s")
            return 0
        if not output.exists():
            # It ends with status 1 both for a weakness and for a failure; only the first leaves its JSON.
            lines = done.stderr.strip().splitlines()
            print(f"skipped: pip-audit cannot ask: {lines[-1] if lines else f'status {done.returncode}'}")
            return 0
        weak, unknown, asked = judged(json.loads(output.read_text()))
    for line in weak:
        print(line)
    if not asked:
        print(f"skipped: the service that was asked knows none of {len(unknown)} packages: is it a mirror?")
        return 0
    beside = f"; not known there: {', '.join(unknown)}" if unknown else ""
    print(f"{len(weak)} known weaknesses in {asked} packages{beside}")
    return 1 if weak else 0


if __name__ == "__main__":
    raise SystemExit(main())
