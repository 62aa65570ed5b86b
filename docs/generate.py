"""Pages of the reference that are written from the program: every command's help, every module."""

import argparse
import io
import pkgutil
from contextlib import redirect_stdout
from pathlib import Path

import fpcal_bayes
from fpcal_bayes.cli.main import make_parser


def write_pages(folder: Path, *, api: bool) -> None:
    """Write ``reference/cli.md``, and a page for each part of the package below ``reference/api`` if `api`."""
    _write(folder / "reference" / "cli.md", cli_page())
    if not api:
        _write(folder / "reference" / "api.md", "# Python interface\n\nBuilt by `make docs`.\n")
        return
    pages = _pages()
    listing = "\n".join(f"api/{name}" for name in pages)
    intro = (
        "The whole workflow fits on one screen: see [](../how-to/notebook.md). Lengths are in um and angles in rad, "
        "except where a name ends in `_deg` or `_nm`."
    )
    toc = "```{toctree}\n:maxdepth: 2\n\n" + listing + "\n```\n"
    _write(folder / "reference" / "api.md", f"# Python interface\n\n{intro}\n\n{toc}")
    (folder / "reference" / "api").mkdir(exist_ok=True)
    for old in (folder / "reference" / "api").glob("*.rst"):
        if old.stem not in pages:
            old.unlink()
    for name, modules in pages.items():
        parts = [_heading(name, "=")]
        for module in modules:
            parts += [_heading(module, "-"), f".. automodule:: {module}\n"]
        _write(folder / "reference" / "api" / f"{name}.rst", "\n".join(parts))


def cli_page() -> str:
    """The help of every command."""
    parser = make_parser()
    parts = ["# Commands", _block(_help(parser))]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                parts += [f"## fpcal {name}", _block(_help(command))]
    return "\n\n".join(parts) + "\n"


def _help(parser: argparse.ArgumentParser) -> str:
    text = io.StringIO()
    with redirect_stdout(text):
        parser.print_help()
    return text.getvalue().rstrip()


def _block(text: str) -> str:
    return f"```text\n{text}\n```"


def _heading(text: str, line: str) -> str:
    return f"{text}\n{line * len(text)}\n"


def _pages() -> dict[str, list[str]]:
    """Public modules of each part of the package, without its commands."""
    pages: dict[str, list[str]] = {}
    for module in pkgutil.walk_packages(fpcal_bayes.__path__, "fpcal_bayes."):
        parts = module.name.split(".")
        if module.ispkg or parts[-1].startswith("_") or parts[1] == "cli":
            continue
        page = ".".join(parts[:2]) if len(parts) > 2 else "fpcal_bayes"
        pages.setdefault(page, []).append(module.name)
    return {name: sorted(modules) for name, modules in sorted(pages.items())}


def _write(path: Path, text: str) -> None:
    # A page that did not change is not read again.
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
