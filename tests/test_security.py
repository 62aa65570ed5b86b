"""What data must never do: run as code, reach outside its folder, or become markup."""

import ast
from pathlib import Path

import pytest

import fpcal_bayes
from fpcal_bayes.cli.main import main

PACKAGE = Path(fpcal_bayes.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))

#: Modules that turn bytes into objects or code, or start programs.
FORBIDDEN_MODULES = {
    "pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "subprocess", "pty", "commands",
    "code", "codeop", "importlib.util", "importlib.machinery", "importlib.import_module", "runpy", "ctypes", "xml",
    "yaml", "webbrowser", "urllib.request", "http", "socket",
}  # fmt: skip
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__", "breakpoint"}
FORBIDDEN_ATTRIBUTES = {
    ("os", "system"), ("os", "popen"), ("os", "execv"), ("os", "execvp"), ("os", "spawnv"), ("os", "spawnl"),
    ("builtins", "eval"), ("builtins", "exec"), ("importlib", "import_module"), ("importlib", "reload"),
}  # fmt: skip


def offences(source: str) -> list[str]:
    """What in a module's source is not allowed."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            names = []
        for name in names:
            roots = {".".join(name.split(".")[: i + 1]) for i in range(name.count(".") + 1)}
            found += [f"line {node.lineno}: import {root}" for root in roots & FORBIDDEN_MODULES]
        if isinstance(node, ast.Call):
            found += _call_offences(node)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            pair = (node.value.id, node.attr)
            found += [f"line {node.lineno}: {'.'.join(pair)}"] if pair in FORBIDDEN_ATTRIBUTES else []
    return found


def _call_offences(node: ast.Call) -> list[str]:
    found = []
    function = node.func
    name = function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")
    if isinstance(function, ast.Name) and name in FORBIDDEN_CALLS:
        found.append(f"line {node.lineno}: {name}()")
    keywords = {keyword.arg: keyword.value for keyword in node.keywords}
    for option in ("shell", "allow_pickle"):
        value = keywords.get(option)
        if value is not None and not (isinstance(value, ast.Constant) and value.value is False):
            found.append(f"line {node.lineno}: {option}=")
    if name == "Environment":
        value = keywords.get("autoescape")
        if not (isinstance(value, ast.Constant) and value.value is True):
            found.append(f"line {node.lineno}: templates without autoescape=True")
    if name == "Markup" and node.args and not isinstance(node.args[0], ast.Constant):
        found.append(f"line {node.lineno}: {name}() of what is no constant")
    return found


#: What looks forbidden and is not, with the reason.
ALLOWED: dict[str, tuple[str, ...]] = {
    # The name of a shell, for which a script of completions is printed; and a command that the parser knows.
    "cli/main.py": ("shell=", "import importlib.import_module"),
    # The live cell talks to devices whose addresses RIG.toml names, emulates them on loopback, and starts the one
    # program that RIG.toml names, without a shell; the clock's pair of sockets wakes a wait.
    "rig/clock.py": ("import socket",),
    "rig/drivers/link.py": ("import socket",),
    "rig/drivers/photodiode.py": ("import subprocess",),
    "rig/emulate/server.py": ("import socket",),
    # The address that it listens on is bound before the server starts.
    "cli/serve/__init__.py": ("import socket",),
    # Names of the package, from a table of constants.
    "core/lazy.py": ("import importlib.import_module",),
    # Figures that the program drew, whose texts the SVG writer escapes, and files that come with it; the pages' own
    # tests put markup into every text that users give.
    "report/campaign/page.py": ("Markup() of what is no constant",),
    "report/observe.py": ("Markup() of what is no constant",),
}


def test_no_code_from_data():
    assert len(SOURCES) > 100
    for path in SOURCES:
        name = str(path.relative_to(PACKAGE))
        found = [place for place in offences(path.read_text()) if place.split(": ", 1)[1] not in ALLOWED.get(name, ())]
        assert found == [], name


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from os import system\nimport os\nos.system('x')",
        "from subprocess import run",
        "eval('1')",
        "import numpy as np\nnp.load('f', allow_pickle=True)",
        "run('x', shell=True)",
        "import jinja2\njinja2.Environment(loader=None)",
        "import jinja2\njinja2.Environment(autoescape=False)",
        "Markup(text)",
        "import urllib.request",
    ],
)
def test_the_search_finds_what_it_is_for(source):
    assert offences(source) != []


def test_the_search_lets_harmless_code_pass():
    assert offences("import json, ast\nx = json.loads('{}')\nast.literal_eval('1')\n") == []


def test_templates_do_not_switch_escaping_off():
    for template in PACKAGE.rglob("*.html"):
        text = template.read_text()
        assert "autoescape false" not in text, template
        assert "| safe" not in text.replace("|safe", "| safe"), template


@pytest.mark.parametrize("way", ["../secret.csv", "absolute", "link.csv", "traces/../../secret.csv", "~/secret.csv"])
def test_an_index_reaches_nothing_outside_its_folder(way, tmp_path, capsys):
    secret, folder = tmp_path / "secret.csv", tmp_path / "campaign"
    (folder / "traces").mkdir(parents=True)
    secret.write_text("t_s,joint,irradiance_v\n0,0,7.654321\n1,1,7.654321\n")
    (folder / "link.csv").symlink_to(secret)
    name = str(secret) if way == "absolute" else way
    joints = ",".join(f"q{i}_{end}_{'um' if i < 4 else 'deg'}" for end in ("start", "end") for i in range(1, 7))
    row = "0,0,0,0,0,0,1,0,0,0,0,0"
    index = folder / "index.csv"
    index.write_text(f"session,time_h,label,{joints},trace\na,0,b,{row},{name}\n")
    assert main(["ingest", str(index), "-o", str(folder / "out.csv")]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "row 2" in text
    assert "7.65" not in text
    assert not (folder / "out.csv").exists()
