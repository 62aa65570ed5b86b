"""Inject faults into every command, and see that each is one clear line, nothing is lost, and nothing half-written.

Faults: an input cut at a random byte, or changed as by a careless editor; SIGKILL or SIGTERM at a random moment, then
the command again; a disk that is full after some bytes; a folder that may not be written; a clock that jumps; two
writers on one campaign. Each command runs in a process of its own, forked from this one, in a fresh folder.

    python tests/robustness/faults.py --faults 2000
    python tests/robustness/faults.py --faults 300 --kinds killed
    python tests/robustness/faults.py --faults 2000 --kinds lexical
    python tests/robustness/faults.py --faults 100 --commands week study
"""

import os

# NumPy reads these when it is imported.
# ruff: noqa: E402
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import contextlib
import io
import json
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from fault_cases import QUICK, SLOW, Case, make_inputs
from fault_child import Child, Outcome, contents, is_part, meaning
from lexical import faulty

from fpcal_bayes.cli.main import main as fpcal
from fpcal_bayes.core.files import CONTENT_HASH

#: Of a user who owns nothing.
NOBODY = 65534
#: Inputs that a command adds to.
KEPT = ("campaign.h5", "store.jsonl")
#: Share of the pairs of writers that meet on a store, whose processes take longer to start.
STORE_SHARE = 0.2


class Injector:
    """Injects faults, and notes what went wrong."""

    def __init__(self, folder: Path, cases: tuple[Case, ...], random: np.random.Generator) -> None:
        self.folder, self.cases, self.random = folder, cases, random
        self.count: Counter[str] = Counter()
        self.notes: Counter[str] = Counter()
        self.problems: list[str] = []
        self.references: dict[Case, tuple[int | None, dict[str, Any], float]] = {}
        self.warmed: set[Case] = set()
        self.tmpfs: Path | None = None
        #: Each case in turn, if all are to be met equally often.
        self.even: Iterator[Case] | None = None

    @contextlib.contextmanager
    def bench(self, case: Case, place: Path | None = None) -> Iterator[Path]:
        """A fresh folder with every input."""
        with tempfile.TemporaryDirectory(dir=place or self.folder, prefix="bench-") as name:
            there = Path(name)
            for source in (self.folder / "inputs").iterdir():
                if source.is_dir():
                    if source.name in case.inputs:
                        shutil.copytree(source, there / source.name)
                elif source.name in case.arguments or source.name in case.inputs:
                    shutil.copy(source, there / source.name)
            yield there

    def warm(self, case: Case) -> None:
        """Import what a command needs, by a run that finds no input, so that the forked ones need not."""
        if case not in self.warmed:
            self.warmed.add(case)
            unread = io.StringIO()
            out, errors = contextlib.redirect_stdout(unread), contextlib.redirect_stderr(unread)
            with tempfile.TemporaryDirectory(dir=self.folder) as empty, out, errors, contextlib.chdir(empty):
                fpcal([*case.arguments, "--quiet"])

    def reference(self, case: Case) -> tuple[int | None, dict[str, Any], float]:
        """Exit status and outputs of a command that runs in peace, and its time."""
        if case not in self.references:
            self.warm(case)
            with self.bench(case) as there:
                began = time.monotonic()
                outcome = Child(case.arguments, there).wait()
                seconds = time.monotonic() - began
                missing = [name for name in case.outputs if not (there / name).exists()]
                if outcome.code not in (0, 1) or missing:
                    raise RuntimeError(f"{' '.join(case.arguments)}: {outcome}, missing {missing}")
                names = [name for name in contents(there) if name not in case.inputs or name in KEPT]
                self.references[case] = outcome.code, {name: meaning(there / name) for name in names}, seconds
        return self.references[case]

    def problem(self, fault: str, case: Case, outcome: Outcome, why: str) -> None:
        text = f"{fault}: {' '.join(case.arguments)}: {why}; status {outcome.code}: {outcome.errors[-600:]}"
        self.problems.append(text)
        print(text, file=sys.stderr, flush=True)

    def check_refused(self, fault: str, case: Case, outcome: Outcome, before: dict[str, str], there: Path) -> None:
        """One line, and every file as it was."""
        self.notes[f"{fault}: refused in one line"] += outcome.one_line
        if not outcome.one_line:
            self.problem(fault, case, outcome, "not refused in one line")
        if contents(there) != before:
            self.problem(fault, case, outcome, "files changed")
        if hidden := [path.name for path in there.rglob(".*")]:
            self.problem(fault, case, outcome, f"left behind: {hidden}")

    def pick(self, *, costly: bool = False) -> Case:
        """A case; mostly a quick one for a fault that lets the command do all its work."""
        if self.even is not None:
            return next(self.even)
        quick = tuple(case for case in self.cases if case in QUICK)
        cases = quick if quick and costly and self.random.random() < 0.97 else self.cases
        return cases[self.random.integers(len(cases))]

    def truncated(self) -> None:
        """One input ends at a random byte."""
        case = self.pick()
        self.warm(case)
        with self.bench(case) as there:
            paths = [
                p for name in case.inputs for p in ([there / name] if "." in name else sorted((there / name).iterdir()))
            ]
            path = paths[self.random.integers(len(paths))]
            whole = path.read_bytes()
            keep = int(self.random.integers(len(whole)))
            path.write_bytes(whole[:keep])
            before = contents(there)
            outcome = Child(case.arguments, there).wait()
            if outcome.code in (0, 1) and self._cut_between_lines(path, whole, keep):
                # Nothing in a text says that more was there; a store or an HDF5 file never comes here.
                what = "a trace" if path.parent != there else path.name
                self.notes[f"truncated: {what} cut at a row's end, a valid shorter text: cannot be seen"] += 1
                return
            self.check_refused(f"truncated {path.suffix} at {keep} of {len(whole)}", case, outcome, before, there)
            self.notes["truncated: refused in one line"] += outcome.one_line

    @staticmethod
    def _cut_between_lines(path: Path, whole: bytes, keep: int) -> bool:
        if not whole[keep:].strip():
            return True
        if path.suffix == ".jsonl":
            return b"\n" in whole[:keep]
        in_comment = path.suffix == ".toml" and b"#" in whole[:keep].rpartition(b"\n")[2]
        between = whole[:keep].endswith(b"\n") or whole[keep:].startswith(b"\n") or in_comment
        return path.suffix in (".csv", ".toml") and between

    def lexical(self) -> None:
        """One input is changed as text or bytes, whatever it means: the result is one line, or one that can be had."""
        case = self.pick()
        self.warm(case)
        with self.bench(case) as there:
            given = [path for name in case.inputs for path in [there / name, *sorted((there / name).glob("*"))]]
            files = [path for path in given if path.is_file()]
            path = files[self.random.integers(len(files))]
            whole = path.read_bytes()
            if path.suffix == ".json" and self.random.random() < 0.7:
                # Of an older program; else the hash tells most faults.
                older = {key: value for key, value in json.loads(whole).items() if key != CONTENT_HASH}
                whole = json.dumps(older).encode()
            name, content = faulty(whole, self.random, text=path.suffix in (".csv", ".toml", ".json"))
            path.write_bytes(content)
            before = contents(there)
            outcome = Child(case.arguments, there).wait()
            if outcome.code in (0, 1):
                self.notes["lexical: the command came to its end"] += 1
                said = [line for line in outcome.errors.splitlines() if not line.startswith("fpcal: ")]
                if said or list(there.rglob(".fpcal-*")):
                    self.problem(f"lexical {name} in {path.name}", case, outcome, f"said {said}, or left something")
                return
            self.check_refused(f"lexical {name} in {path.name}", case, outcome, before, there)
            self.notes["lexical: refused in one line"] += outcome.one_line
            if "to report it" in outcome.errors:
                self.notes[f"lexical: not foreseen: {outcome.errors.split('; to report it')[0][:120]}"] += 1

    def killed(self) -> None:
        """SIGKILL or SIGTERM at a random moment, then the command again."""
        case = self.pick(costly=self.even is None)
        by = signal.SIGKILL if self.random.random() < 0.5 else signal.SIGTERM
        code, outputs, seconds = self.reference(case)
        with self.bench(case) as there:
            before = contents(there)
            outcome = Child(case.arguments, there).wait(float(self.random.uniform(0.0, 1.1) * seconds), by)
            self.notes[f"killed: {by.name} met the command under way"] += outcome.code is None
            self.notes[f"killed: {by.name} on {case.name}"] += 1
            asked = by == signal.SIGTERM and "interrupted" in outcome.errors
            if asked and (left := list(there.rglob(".fpcal-*"))):
                self.problem("asked to end", case, outcome, f"left behind: {left}")
            if "Traceback" in outcome.errors:
                self.problem("killed", case, outcome, "a traceback")
            after = contents(there)
            changed = [name for name, value in after.items() if before.get(name) != value]
            for name in changed:
                # A file is there whole or not at all, a store with some of its replicates, inputs as they were.
                whole = name in outputs and meaning(there / name) == outputs[name]
                begun = case.name == "study" and name in outputs and is_part(there / name, outputs[name])
                self.notes["killed: a store with some of its replicates"] += begun and not whole
                if not whole and not begun:
                    self.problem("killed", case, outcome, f"{name} is half-written, or an input that changed")
            if lost := before.keys() - after.keys():
                self.problem("killed", case, outcome, f"lost: {lost}")
            again = Child(case.arguments, there).wait()
            if left := [*there.rglob(".fpcal-*"), *there.rglob("*.blocks"), *there.rglob("*.lock")]:
                self.problem("killed, again", case, again, f"left behind: {left}")
            if changed and "is there already" in again.errors and again.one_line:
                # A session is appended once, a cell made once.
                self.notes["killed: the work was done, and the next run says so"] += 1
                return
            if again.code != code:
                self.problem("killed, again", case, again, f"expected status {code}")
                return
            for name, expected in outputs.items():
                if "campaign.h5" in changed and name == "out.json":
                    # States that were saved before the kill change the hash of the campaign.
                    continue
                if meaning(there / name) != expected:
                    self.problem("killed, again", case, again, f"{name} is another one")

    def full_disk(self) -> None:
        """Room for a part of the output only."""
        case = self.pick(costly=True)
        _, outputs, _ = self.reference(case)
        smallest = min(len(v) if isinstance(v, bytes) else len(repr(v)) // 2 for v in outputs.values())
        if self.tmpfs is not None and self.random.random() < 0.5:
            with self.bench(case, self.tmpfs) as there:
                filler = self.tmpfs / "filler"
                with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
                    # The files of a week do not fit in any case: some of them may.
                    while case.name != "week" or file.tell() < 1 << 20:
                        file.write(bytes(4096))
                before = contents(there)
                outcome = Child(case.arguments, there).wait()
                self._check_full(case, outcome, before, there)
                filler.unlink()
            return
        # Larger files meet the limit; a page or two must be possible, or nothing can be tried.
        room = int(self.random.integers(1, max(2, min(smallest, 2000))))
        with self.bench(case) as there:
            before = contents(there)
            limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))  # noqa: E731
            outcome = Child(case.arguments, there, limit).wait()
            self._check_full(case, outcome, before, there)

    def _check_full(self, case: Case, outcome: Outcome, before: dict[str, str], there: Path) -> None:
        if case.name == "track" and outcome.code == 0 and "not saved" in outcome.errors and not case.outputs:
            self.notes["full disk: states not saved, said"] += 1
            return
        # Warnings of the result itself may come first.
        lines = outcome.errors.splitlines()
        errors = [line for line in lines if not line.startswith("fpcal: warning: ")]
        after = contents(there)
        if case.name == "week":
            # Of many files the first ones may be there, each of them whole.
            outputs = self.reference(case)[1]
            whole = {name for name in after.keys() - before.keys() if meaning(there / name) == outputs.get(name)}
            self.notes["full disk: some files of a week are there, each whole"] += bool(whole)
            before = before | {name: after[name] for name in whole}
        self.check_refused("full disk", case, Outcome(outcome.code, "\n".join(errors)), before, there)

    def read_only(self) -> None:
        """A folder in which nothing may be written."""
        case = self.pick()
        self.warm(case)
        with self.bench(case) as there:
            before = contents(there)
            os.chmod(self.folder, 0o755)
            there.chmod(0o555)
            for path in there.rglob("*"):
                path.chmod(0o555 if path.is_dir() else 0o444)

            def prepare() -> None:
                if os.geteuid() == 0:
                    os.setegid(NOBODY)
                    os.seteuid(NOBODY)

            outcome = Child(case.arguments, there, prepare).wait()
            there.chmod(0o755)
            self.check_refused("read-only folder", case, outcome, before, there)

    def clock(self) -> None:
        """A clock that jumps by up to ten years at each look."""
        case = self.pick(costly=True)
        code, outputs, _ = self.reference(case)
        steps = timedelta(days=1) * self.random.uniform(-3650, 3650, 1000)

        def prepare() -> None:
            from fpcal_bayes.tracking import sessions

            looks = iter(steps)

            class Jumping(datetime):
                @classmethod
                def now(cls, tz: Any = None) -> datetime:
                    return datetime.now(UTC) + next(looks)

            sessions.datetime = Jumping
            real = time.time
            time.time = lambda: real() + next(looks).total_seconds()

        with self.bench(case) as there:
            outcome = Child(case.arguments, there, prepare).wait()
            if outcome.code != code:
                self.problem("clock", case, outcome, f"expected status {code}")
            elif any(meaning(there / name) != expected for name, expected in outputs.items()):
                self.problem("clock", case, outcome, "another result")

    def shared(self) -> list[Case]:
        """Commands that write into a file that is there: following a campaign, then adding to a store."""
        follow = [case for case in self.cases if case.name == "track" and case.inputs[0] == "campaign.h5"]
        return follow + [case for case in self.cases if case.inputs[0] == "store.jsonl"]

    def two_writers(self) -> None:
        """Two processes follow one campaign, or add to one store, at the same time."""
        pairs = self.shared()
        on_store = pairs[-1].name == "study" and (len(pairs) == 1 or self.random.random() < STORE_SHARE)
        case = pairs[-1] if on_store else pairs[0]
        _, outputs, seconds = self.reference(case)
        first, kept = (case.arguments, "store.jsonl") if case.name == "study" else (case.arguments[:2], "campaign.h5")
        with self.bench(case) as there:
            one = Child(first, there)
            time.sleep(float(self.random.uniform(0.0, 0.8) * seconds))
            two = Child(first, there)
            outcomes = [one.wait(), two.wait()]
            words = ("has this file open", "another fpcal", "replaced")
            refused = [o for o in outcomes if o.one_line and any(word in o.errors for word in words)]
            told = [o for o in outcomes if o.code == 0 and "not saved" in o.errors]
            self.notes["two writers: the second told"] += len(refused) + len(told)
            if len(refused) + sum(o.code == 0 for o in outcomes) != 2 or len(refused) == 2:
                self.problem("two writers", case, outcomes[1], f"the other: {outcomes[0]}")
            if meaning(there / kept) != outputs[kept]:
                self.problem("two writers", case, outcomes[1], f"{kept} holds something else")

    def run(self, faults: int, minutes: float, kinds: list[str] | None = None) -> None:
        """Inject so many faults of all kinds, fewer if time runs out."""
        end = time.monotonic() + 60.0 * minutes
        shares = {
            self.truncated: 0.4, self.lexical: 0.3, self.killed: 0.1, self.full_disk: 0.06, self.read_only: 0.08,
            self.clock: 0.04, self.two_writers: 0.02,
        }  # fmt: skip
        shares = {kind: share for kind, share in shares.items() if kinds is None or kind.__name__ in kinds}
        if not self.shared() and self.two_writers in shares:
            del shares[self.two_writers]
        every, weights = list(shares), np.array(list(shares.values()))
        for number in range(faults):
            if time.monotonic() > end:
                break
            # Every kind is met early; then by share.
            at = number if number < len(every) else self.random.choice(len(every), p=weights / weights.sum())
            every[at]()
            self.count[every[at].__name__] += 1
            if number % 20 == 19:
                print(f"{number + 1} faults, {len(self.problems)} problems", file=sys.stderr, flush=True)


@contextlib.contextmanager
def small_disk(place: Path) -> Iterator[Path | None]:
    """A file system of a few MiB, or None where none can be mounted."""
    folder = place / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    mounted = os.geteuid() == 0 and subprocess.run(command, check=False, capture_output=True).returncode == 0
    try:
        yield folder if mounted else None
    finally:
        if mounted:
            # What was killed may still stand in it.
            subprocess.run(["umount", "--lazy", str(folder)], check=False)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="inject no more after this time")
    parser.add_argument("--commands", nargs="+", metavar="NAME", help="faults of these commands only")
    parser.add_argument("--kinds", nargs="+", metavar="KIND", help="truncated, lexical, killed, full_disk, ...")
    parser.add_argument("--even", action="store_true", help="every command equally often, slow ones too")
    parser.add_argument("--quick", action="store_true", help="the quick commands only, and no disk of its own")
    options = parser.parse_args()
    # So that the small disk is unmounted when the study is stopped.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "inputs").mkdir()
        # Killed processes leave temporary folders behind.
        (folder / "temporary").mkdir()
        tempfile.tempdir = str(folder / "temporary")
        make_inputs(folder / "inputs", quick=options.quick)
        known = tuple(
            case
            for case in (QUICK if options.quick else QUICK + SLOW)
            if all((folder / "inputs" / file).exists() for file in case.inputs)
            and (options.commands is None or case.name in options.commands)
        )
        if not known:
            parser.error(f"--commands {' '.join(options.commands)}: expected some command of the study")
        injector = Injector(folder, known, np.random.default_rng(options.seed))
        with contextlib.ExitStack() as stack:
            injector.tmpfs = None if options.quick else stack.enter_context(small_disk(folder))
            injector.even = cycle(known) if options.even else None
            injector.run(options.faults, options.minutes, options.kinds)
    for kind, count in injector.count.items():
        print(f"{kind.replace('_', ' '):12} {count:6}")
    for note, count in sorted(injector.notes.items()):
        # One of each cut says no more than their sum.
        if not note.startswith("truncated ."):
            print(f"  {note}: {count}")
    total = sum(injector.count.values())
    print(
        f"{total} faults injected into {len(known)} commands in {time.monotonic() - began:.0f} s: "
        f"{len(injector.problems)} problems"
    )
    return 1 if injector.problems else 0


if __name__ == "__main__":
    raise SystemExit(main())
