"""Every Python block of the README and the docs runs, and prints what the page shows.

A block marked ``text`` after a Python block is its output. The blocks of a file share one
namespace. ``pytest tests/docs --update-golden`` writes the outputs again.

Numbers are compared with a tolerance. Numbers in the summary of a solution depend on the machine
and are not compared. ``...`` stands for anything.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import math
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import rankone
from rankone.share.commands.cli import main
from tests.benchmarks.report import COST

ROOT = Path(__file__).parents[2]
FILES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(
    r"^```python\n(?P<code>.*?)^```\n(?:\n```text\n(?P<output>.*?)^```\n)?", re.M | re.S
)
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?(?![\w])")
SUMMARY = re.compile(r"^  (?:success|error|train|timings) .*(?:\n {12}.*)*", re.M)
CODE = re.compile(r"^```.*?^```|`[^`\n]+`", re.M | re.S)
LINK = re.compile(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)")

LONG = {
    ROOT / "docs" / name
    for name in (
        "classic-method.md",
        "cross.md",
        "guide/algebraic-equations.md",
        "guide/calibration.md",
        "guide/changing-orders.md",
        "guide/doses-and-restarts.md",
        "guide/events.md",
        "guide/fields.md",
        "guide/falling-card.md",
        "guide/functions-of-unknowns.md",
        "guide/fits.md",
        "guide/friction.md",
        "guide/models.md",
        "guide/many-decades.md",
        "guide/many-states.md",
        "guide/models-as-written.md",
        "guide/more-than-one-machine.md",
        "guide/neuron.md",
        "guide/oscillators.md",
        "guide/outputs.md",
        "guide/plots.md",
        "guide/populations.md",
        "guide/saturation.md",
        "guide/steady-states.md",
        "guide/thermostat.md",
        "guide/unknown-lag.md",
    )
}
COMMANDS = sorted((ROOT / "docs" / "export").glob("*.md"))
"""The guides with commands, which are slow."""

FREE, RTOL, ATOL, MEASURED_FACTOR = "#", 1e-4, 5e-6, 100.0


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _normal(text: str) -> str:
    """Text without what depends on the machine: numbers of summaries, versions, line breaks."""
    text = SUMMARY.sub(lambda summary: NUMBER.sub(FREE, summary.group()), text)
    text = re.sub(rf" \(up to {FREE} at the corners of the box\)", "", " ".join(text.split()))
    return re.sub(r"\(rankone [^)]*\)", "(rankone)", text)


def _close(wanted: str, got: str) -> bool:
    a, b = float(wanted), float(got)
    if "e-" in wanted and "e-" in got:  # a measured error
        return a * b > 0 and 1 / MEASURED_FACTOR <= a / b <= MEASURED_FACTOR
    return abs(a - b) <= ATOL + RTOL * abs(a)


def _agree(wanted: str, got: str) -> bool:
    """Whether two outputs agree: the same words, close numbers."""
    wanted, got = _normal(wanted), _normal(got)
    pattern = "".join(
        re.escape(words).replace(re.escape("..."), ".*")
        + (rf"({NUMBER.pattern})" if figure else "")
        for words, figure in itertools.zip_longest(
            NUMBER.split(wanted), NUMBER.findall(wanted), fillvalue=""
        )
    )
    match = re.fullmatch(pattern, got, re.S)
    return match is not None and all(map(_close, NUMBER.findall(wanted), match.groups()))


def _each(files: dict[Path, bool]) -> pytest.MarkDecorator:
    """A test for each file, slow if it says so."""
    slow = pytest.mark.slow
    params = [pytest.param(path, marks=slow if long else ()) for path, long in files.items()]
    return pytest.mark.parametrize("path", params, ids=_name)


def _skip_without_tools(path: Path) -> None:
    """An FMU is run by FMPy, and has a binary only where there is a compiler; SBML is optional."""
    if path.name == "models.md":
        pytest.importorskip("libsbml", reason="needs python-libsbml: pip install python-libsbml")
    if path.name == "calibration.md":
        pytest.importorskip("petab", reason="needs petab: pip install petab")
    if path.name == "fmu.md":
        pytest.importorskip("fmpy", reason="FMPy is not installed (pip install fmpy)")
        if not any(map(shutil.which, ("cc", "gcc", "clang"))):
            pytest.skip("no C compiler")


@pytest.fixture
def figures():
    """Closes the figures of a page."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.mark.usefixtures("figures")
@_each({path: path in LONG or path in COMMANDS for path in FILES})
def test_page(path, tmp_path, monkeypatch, request, capsys):
    _skip_without_tools(path)
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "examples" / "enzyme.xml", tmp_path)
    shutil.copytree(ROOT / "examples" / "conversion", tmp_path / "conversion")
    text = path.read_text()
    namespace: dict[str, object] = {"__name__": "__main__"}
    pieces, end = [], 0
    for block in BLOCK.finditer(text):
        line = text.count("\n", 0, block.start("code"))
        stream = io.StringIO()
        code = compile("\n" * line + block["code"], str(path), "exec")
        with contextlib.redirect_stdout(stream), warnings.catch_warnings():
            warnings.simplefilter("error")
            exec(code, namespace)
        got = stream.getvalue()
        if block["output"] is None:
            assert got == "", f"{_name(path)}, line {line}: output that the text does not show"
            continue
        if request.config.getoption("--update-golden"):
            if not _agree(block["output"], got):
                pieces += [text[end : block.start("output")], _versioned(got)]
                end = block.end("output")
        else:
            assert _agree(block["output"], got), f"{_name(path)}, line {line}\n{got}"
    if pieces:
        path.write_text("".join([*pieces, text[end:]]))
    if path in COMMANDS:
        _run_commands(text, tmp_path, monkeypatch, capsys)


def _versioned(text: str) -> str:
    return text.replace("(rankone 0+unknown)", "(rankone 0.1.0)")


def _run_script(name: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """What ``python name`` prints, run in this process: a start takes longer than most scripts."""
    stream = io.StringIO()
    with monkeypatch.context() as patch, contextlib.redirect_stdout(stream):
        patch.setattr(sys, "argv", [name, *arguments])
        try:
            runpy.run_path(name, run_name="__main__")
            status = 0
        except SystemExit as end:
            status = end.code
    assert not status, f"{name} {arguments} ended with {status}"
    return stream.getvalue()


def _run_commands(text, folder, monkeypatch, capsys):
    """The guides of what is exported: other languages and commands run as well, after Python."""
    (folder / "examples").mkdir()
    for place in (folder, folder / "examples"):
        shutil.copy(ROOT / "examples" / "lotka_volterra.py", place)
    for number, code in enumerate(re.findall(r"^```c\n(.*?)^```", text, re.M | re.S)):
        (folder / ("main.c" if number == 0 else f"main{number}.c")).write_text(code)
    for number, code in enumerate(re.findall(r"^```js\n(.*?)^```", text, re.M | re.S)):
        (folder / ("main.mjs" if number == 0 else f"main{number}.mjs")).write_text(code)
    blocks = re.findall(r"^```console\n(.*?)^```", text, re.M | re.S)
    lines = "".join(blocks).splitlines()
    if "```c\n" in text:
        lines.append("./main")
    programs = {
        "cc": shutil.which("cc") or shutil.which("gcc"),
        "./main": "./main",
        "node": shutil.which("node"),
    }
    said = {}
    for line in lines:
        program, *arguments = shlex.split(line)
        if program == "rankone":
            (folder / arguments[-1]).unlink(missing_ok=True)
            assert main(arguments) == 0, f"{line}\n{capsys.readouterr().err}"
            continue
        if program == "python":
            said[line] = _run_script(arguments[0], arguments[1:], monkeypatch)
            continue
        if programs[program] is None:
            pytest.skip(f"no {program}")
        command = [programs[program], *arguments]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert run.returncode == 0, f"{line}\n{run.stderr}"
        said[line] = run.stdout
    if "```js\n" in text:
        values = [float(line) for line in said["node main.mjs"].splitlines()[:-1]]
        assert values == pytest.approx([math.exp(-2.0)] * 4, rel=1e-5)
    if "```c\n" in text:
        assert float(said["./main"]) == pytest.approx(math.exp(-2.0), rel=1e-5)


def test_links():
    missing = [
        (_name(path), target)
        for path in FILES
        for target in LINK.findall(CODE.sub("", path.read_text()))
        if not (path.parent / target).exists()
    ]
    assert not missing


def test_files_that_pages_name_exist():
    missing = [
        (_name(path), name)
        for path in FILES
        for name in re.findall(r"(?<![\w/])(?:tests|examples)/[\w./]*\w", path.read_text())
        if not (ROOT / name).exists()
    ]
    assert not missing


def test_the_reference_names_everything_public():
    text = (ROOT / "docs" / "reference.md").read_text()
    for name in rankone.__all__:
        assert name.startswith("__") or f"`{name}" in text, name


def test_the_map_of_the_source_has_every_room_after_those_it_imports():
    page = (ROOT / "docs" / "structure.md").read_text()
    rooms = re.findall(r"^\| `(\w+)` \|", page.partition("## Two walks")[0], re.M)
    source = Path(rankone.__file__).parent
    assert sorted(rooms) == sorted(path.parent.name for path in source.glob("*/__init__.py"))
    for order, room in enumerate(rooms):
        text = "".join(path.read_text() for path in (source / room).rglob("*.py"))
        imported = set(re.findall(r"^\s*(?:from|import) rankone\.(\w+)", text, re.M))
        opened = {"inference", "share"} if room == "solution" else set()  # by its methods
        assert imported - opened <= set(rooms[: order + 1]), room


def test_the_walks_lead_to_functions_that_exist():
    text = (ROOT / "docs" / "structure.md").read_text()
    steps = re.findall(r"^\d+\. `([\w/]+\.py)`: `(\w+)(?:\.(\w+))?`", text, re.M)
    assert len(steps) >= 10
    for path, name, member in steps:
        module = importlib.import_module(f"rankone.{path[:-3].replace('/', '.')}")
        assert hasattr(getattr(module, name), member or "__name__"), f"{path}: {name}.{member}"


def test_the_site_has_the_docstrings_of_everything_public():
    pages = "".join(path.read_text() for path in (ROOT / "docs" / "api").glob("*.rst"))
    for name in rankone.__all__:
        home = getattr(rankone, name)
        shown = re.search(rf"^\.\. auto(?:class|function):: {name}$", pages, re.M)
        assert shown or name.startswith("__") or home.__module__ == "rankone.support.errors", name


@pytest.mark.parametrize(
    ("wanted", "got", "agrees"),
    [
        ("x = 1.0000", "x = 1.00001", True),
        ("x = 1.0", "x = 1.1", False),
        ("error 3.0e-07", "error 8e-8", True),
        ("error 3.0e-07", "error 3e-4", False),
        ("[1. 2.]", "[1.  2.]", True),
        ("x0 = 1", "x1 = 1", False),
        ("a ... c 2", "a b c 2", True),
        ("  timings   march 0.1 s", "  timings   march 0.2 s", True),
        ("  train     march 0.1 s", "  train     sweep 0.2 s", False),
    ],
)
def test_comparison(wanted, got, agrees):
    assert _agree(wanted, got) is agrees


def test_the_readme_quotes_what_was_measured():
    """The least and the largest break-even are those of the table."""
    table = (ROOT / "docs" / "measured.md").read_text().partition("The same in absolute")[0]
    rows = [line.split("|") for line in table.splitlines() if line.startswith("| ")]
    column = [title.strip() for title in rows[0]].index("break-even")
    break_evens = [int(row[column]) for row in rows[2:]]
    quoted = COST.search((ROOT / "README.md").read_text())
    assert len(break_evens) >= 20
    assert [*map(int, quoted.groups())] == [min(break_evens), max(break_evens)]


def test_the_navigation_has_every_page(monkeypatch):
    """The build of the site fails where no section of the index and no table lists a page."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    docs = ROOT / "docs"
    source = [(docs / "index.md").read_text(encoding="utf-8")]
    runpy.run_path(str(docs / "conf.py"))["_read"](None, "index", source)
    listed = {docs / entry for entry in re.findall(r"^\S+\.(?:md|rst)$", source[0], re.M)}
    for page in docs.rglob("*.rst"):
        table = re.search(
            r"^\.\. toctree::\n(?:   :.*\n)*\n((?:   \S+\n)+)", page.read_text(), re.M
        )
        if table:
            listed |= {page.parent / f"{entry}.rst" for entry in table[1].split()}
    pages = {page for end in ("md", "rst") for page in docs.rglob(f"*.{end}")}
    built = {page for page in pages if "_build" in page.parts}
    assert pages - built - listed == {docs / "index.md"}
    assert listed <= pages
