"""Where results go: files, links, devices and streams; what is refused; and terminals that fail."""

import json
import os
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from fpcal_bayes.cli import main as main_module
from fpcal_bayes.cli.main import main
from fpcal_bayes.core import files
from fpcal_bayes.core.errors import InputError

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs the files of a POSIX system")


@pytest.fixture
def device(tmp_path: Path) -> Path:
    """A private node of the null device."""
    node = tmp_path / "null.json"
    try:
        os.mknod(node, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        node.write_bytes(b"")
    except OSError as error:
        pytest.skip(f"no device can be made here ({error})")
    return node


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    return line


def test_a_device_is_written_and_stays_one(device: Path) -> None:
    files.write_text(device, "content")
    assert stat.S_ISCHR(device.stat().st_mode)
    assert main(["cell", "--json", str(device), "--quiet"]) == 0
    assert stat.S_ISCHR(device.stat().st_mode)
    assert [path.name for path in device.parent.iterdir()] == [device.name]


def test_a_link_to_a_device_is_followed(device: Path, tmp_path: Path) -> None:
    (tmp_path / "link.json").symlink_to(device.name)
    files.write_text(tmp_path / "link.json", "content")
    assert (tmp_path / "link.json").is_symlink()
    assert stat.S_ISCHR(device.stat().st_mode)


def test_a_device_is_no_input(device: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "is a device or a pipe, expected a file" in refused(capsys, "doctor", str(device))


def test_pipes_and_sockets_are_refused_and_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe, point = tmp_path / "pipe.json", tmp_path / "socket.json"
    os.mkfifo(pipe)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(point))
        for path in (pipe, point):
            before = path.lstat()
            assert "is a pipe or a socket" in refused(capsys, "cell", "--json", str(path))
            assert "is a device or a pipe, expected a file" in refused(capsys, "doctor", str(path))
            assert os.path.samestat(before, path.lstat())
            with pytest.raises(InputError, match="pipe or a socket"):
                files.write_text(path, "content")


def test_links_are_followed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "there").mkdir()
    first, second, far = tmp_path / "first", tmp_path / "second", tmp_path / "there" / "far.txt"
    first.symlink_to("second")
    second.symlink_to(Path("there") / "far.txt")
    for text in ("new", "old"):
        files.write_text(first, text)
        assert first.is_symlink()
        assert second.is_symlink()
        assert far.read_text() == text
    loop = tmp_path / "loop.json"
    loop.symlink_to(loop.name)
    assert "loop.json: cannot be written" in refused(capsys, "cell", "--json", str(loop))
    assert loop.is_symlink()


def test_the_mode_of_a_file_stays(tmp_path: Path) -> None:
    path = tmp_path / "private"
    files.write_text(path, "old")
    path.chmod(0o600)
    files.write_text(path, "new")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("name", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"])
def test_a_stream_is_written_behind_what_was_printed(name: str, tmp_path: Path) -> None:
    if not os.path.exists(name):
        pytest.skip("this system has no such name")
    script = "import sys; from pathlib import Path; from fpcal_bayes.core.files import write_text; print('first'); "
    script += "write_text(Path(sys.argv[1]), 'second\\n'); print('third')"
    expected = "first\nsecond\nthird\n"
    command = [sys.executable, "-c", script, name]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == expected
    with (tmp_path / "out").open("w") as file:
        subprocess.run(command, stdout=file, check=True)
    assert (tmp_path / "out").read_text() == expected


def test_outputs_are_neither_inputs_nor_one_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell, sweeps = tmp_path / "cell.toml", tmp_path / "sweeps.csv"
    assert main(["simulate", "-o", str(sweeps), "--quiet"]) == 0
    assert main(["cell", "--new", "x y z rx rz ry", "--name", "a", "-o", str(cell), "--quiet"]) == 0
    before = cell.read_bytes(), sweeps.read_bytes()
    (tmp_path / "link.json").symlink_to("new.json")
    for message, *arguments in (
        ("is an input", "identify", str(sweeps), "--cell", str(cell), "--json", str(cell)),
        ("is an input", "observe", str(sweeps), "--html", str(sweeps)),
        ("two names", "observe", str(sweeps), "--json", str(tmp_path / "a"), "--html", str(tmp_path / "a")),
        (
            "two names",
            "observe",
            str(sweeps),
            "--json",
            str(tmp_path / "link.json"),
            "--html",
            str(tmp_path / "new.json"),
        ),
    ):
        assert message in refused(capsys, *arguments)
    assert (cell.read_bytes(), sweeps.read_bytes()) == before


def test_names_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    long = str(tmp_path / ("x" * 300))
    assert "cannot be written (File name too long)" in refused(capsys, "cell", "--json", long)
    assert "File name too long" in refused(capsys, "identify", long)
    assert "expected a name in utf-8" in refused(capsys, "cell", "--json", os.fsdecode(b"caf\xe9.json"))
    longest = tmp_path / ("x" * 250 + ".json")
    assert main(["cell", "--json", str(longest), "--quiet"]) == 0
    assert json.loads(longest.read_text())["command"] == "cell"


def test_temporary_files_of_processes_that_have_ended_are_removed(tmp_path: Path) -> None:
    killed = (
        "import os, sys; from pathlib import Path; from fpcal_bayes.core.files import replacing\n"
        "with replacing(Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", killed, str(tmp_path / "a")], check=False)
    (left,) = tmp_path.iterdir()
    foreign, old = (tmp_path / f".fpcal-elsewhere-1-{n}.tmp" for n in (1, 2))
    foreign.write_text("a writer on another machine")
    old.write_text("long ago")
    os.utime(old, (0, 0))
    with files.replacing(tmp_path / "b") as own:
        own.write_text("content")
        files.write_text(tmp_path / "c", "meanwhile")
        assert own.exists()
        assert not left.exists()
    assert {path.name for path in tmp_path.iterdir()} == {"b", "c", foreign.name}


SLOW_WRITER = """
import signal, sys, time
from fpcal_bayes.cli import cell, main
# A shell that starts its jobs in the background has them ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)
def write(*_):
    from pathlib import Path
    from fpcal_bayes.core.files import replacing
    with replacing(Path("out.json")) as temporary:
        temporary.write_text("half")
        print("writing", flush=True)
        # A signal that arrives just before a sleep begins is seen when it ends.
        for _ in range(600):
            time.sleep(0.1)
cell.write_result = write
sys.exit(main.main(["cell", "--json", "out.json"]))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupted_command_leaves_no_temporary_file(number: signal.Signals, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    # Kernels that are not compiled yet would be announced among the errors.
    assert main(["cell", "--json", str(tmp_path / "out.json"), "--quiet"]) == 0
    (tmp_path / "out.json").write_text("old")
    with subprocess.Popen(
        [sys.executable, "-c", SLOW_WRITER], cwd=tmp_path, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert "writing" in iter(process.stdout.readline, "").__next__()
        process.send_signal(number)
        errors = process.communicate(timeout=60)[1]
    assert (process.returncode, errors) == (128 + number, "fpcal: interrupted\n")
    assert [path.name for path in tmp_path.iterdir()] == ["out.json"]
    assert (tmp_path / "out.json").read_text() == "old"


def test_a_kernel_that_is_interrupted_is_no_internal_error(monkeypatch, capsys):
    """Python says SystemError where compiled code returns while a signal's exception waits."""

    def ended(*_: object) -> int:
        raise SystemError("returned a result with an exception set") from SystemExit(143)

    monkeypatch.setattr(main_module, "_run", lambda words, *, alone: ended())
    assert main_module.main(["identify", "x.csv"]) == 143
    assert capsys.readouterr().err == "fpcal: interrupted\n"
    monkeypatch.setattr(main_module, "_run", lambda words, *, alone: exec("raise SystemError('odd')"))
    assert main_module.main(["identify", "x.csv"]) == 2
    assert "SystemError" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("terminal", ["closed", "full", "both full", "ascii", "gone"])
def test_a_terminal_that_fails_loses_nothing(terminal: str, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    tail = {
        "closed": ">&- 2>&-", "full": "> /dev/full", "both full": "> /dev/full 2> /dev/full", "ascii": "",
        "gone": "| true",
    }[terminal]  # fmt: skip
    if terminal == "ascii":
        environment |= {"PYTHONIOENCODING": "ascii"}
    if "full" in terminal and not os.path.exists("/dev/full"):
        pytest.skip("this system has no full device")
    line = f"'{sys.executable}' -m fpcal_bayes cell --json 'µ out.json' {tail}"
    done = subprocess.run(["bash", "-c", line], cwd=tmp_path, env=environment, capture_output=True, check=False)
    assert done.returncode == (2 if "full" in terminal else 0)
    assert b"Traceback" not in done.stderr
    assert b"Exception ignored" not in done.stderr
    if terminal == "full":
        assert b"fpcal: error: the standard output cannot be written (No space left on device)\n" in done.stderr
    assert json.loads((tmp_path / "µ out.json").read_text())["command"] == "cell"
    assert [path.name for path in tmp_path.iterdir()] == ["µ out.json"]
