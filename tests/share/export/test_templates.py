"""Hostile names, titles, units and equations stay text in every exported file."""

from __future__ import annotations

import ast
import json
import re
import runpy
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree
from zipfile import ZipFile

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.codegen.layout import commented, docstring, quoted
from rankone.share.export.standalone import c_comment, c_string, js_comment, js_string
from rankone.solution.solution import Solution
from rankone.trajectories.system.verdict import Remedy
from tests.share.export.node import NODE, needs_node
from tests.share.export.solutions import solved

COMPILER = shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler (gcc or clang)")
STRICT = ["-std=c99", "-trigraphs", "-Wall", "-Wextra", "-Werror", "-fsyntax-only"]
PARTS = (
    *("*/", "/*", "//", "\\", "??/", "?", "*", "/", "\n", "\r", "\r\n", "\u2028", "\u2029", "\0"),
    *("</script>", "<!--", "-->", "<script>", "]]>", "&", '"', "'", '"""', "`", "${", "#", "\t"),
    *("\x7f", "\ufeff", "\u202e", "😀", "é", " ", "evil", "\n#error evil\n", "\nevil();//"),
)
rng = np.random.default_rng(22)
TEXTS = [*PARTS, *("".join(rng.choice(PARTS, 6)) for _ in range(400))]
printable = [text for text in TEXTS if text.isprintable() and text.strip()]


@needs_compiler
def test_c(tmp_path):
    lines = []
    for number, text in enumerate(TEXTS):
        size = len(text.encode()) + 1
        lines += [
            "/* " + c_comment(text),
            f" * {c_comment(text)}",
            " */",
            f"/* {c_comment(text)} */",
        ]
        lines += [f"static const char s{number}[] = {c_string(text)};"]
        lines += [f"typedef char t{number}[sizeof s{number} == {size} ? 1 : -1];"]
    path = tmp_path / "texts.c"
    path.write_text("\n".join([*lines, "int main(void) { return 0; }", ""]), encoding="utf-8")
    strict = [flag for flag in STRICT if flag != "-Wextra"]
    run = subprocess.run(
        [COMPILER, *strict, "-Wno-unused-variable", "-Wno-unused-const-variable", path],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert not run.returncode, run.stderr[:2000]


@needs_node
def test_javascript(tmp_path):
    lines = ["const found = [];"]
    for text in TEXTS:
        lines += [f"/* {js_comment(text)}", f" * {js_comment(text)}", " */"]
        lines += [f"found.push({js_string(text)});"]
    path = tmp_path / "texts.js"
    path.write_text("\n".join([*lines, "console.log(JSON.stringify(found));"]), encoding="utf-8")
    run = subprocess.run([NODE, path], capture_output=True, text=True, check=True)
    assert json.loads(run.stdout) == TEXTS
    assert not re.search("</script|<!--|<script>", path.read_text().replace("<script>", ""))


def test_python():
    lines = ["found = []"]
    for text in TEXTS:
        lines += docstring([text, text], indent="") + docstring([text], indent="")
        lines += [commented("x = 1", text), f"found.append({quoted(text)})"]
    names = {}
    exec("\n".join(lines), names)
    assert names["found"] == TEXTS
    tree = ast.parse("\n".join(lines))
    assert len(tree.body) == 1 + 4 * len(TEXTS)


class Elements(HTMLParser):
    """The elements of a page and the texts of its scripts."""

    def __init__(self, page):
        super().__init__()
        self.names, self.scripts = [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.names.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data):
        if self.names and self.names[-1] == "script" and self.scripts:
            self.scripts[-1] += data


def hostile(number):
    """A solution with texts of all kinds where names, a title, units and equations were."""
    solution = solved("coupled")
    pool = np.random.default_rng(number).permutation(printable).tolist()
    states, parameters = pool[:3], pool[3:6]
    metadata = replace(
        solution.metadata,
        states=tuple(states),
        parameters=tuple(parameters),
        time=pool[6],
        name=pool[7],
        units=tuple(zip(pool[:7], pool[8:15], strict=True)),
        equations=tuple("".join(TEXTS[number::7])[k::5] for k in range(5)),
    )
    outcome = replace(solution.outcome, notes=(Remedy("".join(TEXTS[number::11])),))
    return Solution(outcome, metadata)


@pytest.mark.parametrize("number", range(3))
def test_models(number, tmp_path):
    """Every export of a hostile solution is well formed and says the names as they are."""
    solution = hostile(number)
    names = solution.unknowns
    for suffix in (".py", ".c", ".mjs"):
        solution.export(tmp_path / f"model{suffix}")
    module = {}
    exec((tmp_path / "model.py").read_text(encoding="utf-8"), module)
    assert module["UNKNOWNS"] == names
    if COMPILER is not None:
        run = subprocess.run(
            [COMPILER, *STRICT, tmp_path / "model.c"], capture_output=True, text=True, check=False
        )
        assert not run.returncode, run.stderr[:2000]
    if NODE is not None:
        script = tmp_path / "names.mjs"
        script.write_text('import * as m from "./model.mjs"; console.log(JSON.stringify(m.names))')
        run = subprocess.run([NODE, script], capture_output=True, text=True, check=True)
        assert tuple(json.loads(run.stdout)) == names


@pytest.mark.slow
def test_page(tmp_path):
    plain, other = solved("coupled"), hostile(1)
    pages = []
    for name, solution in (("plain", plain), ("other", other)):
        path = solution.export(tmp_path / f"{name}.html")
        pages.append(Elements(path.read_text(encoding="utf-8")))
    assert pages[0].names.count("script") == pages[1].names.count("script")
    assert len(pages[1].scripts) == len(pages[0].scripts)
    assert json.loads(pages[1].scripts[0])["unknowns"][0]["name"] == other.unknowns[0]
    for number, script in enumerate(pages[1].scripts[1:]):
        path = tmp_path / f"script{number}.js"
        path.write_text(script, encoding="utf-8")
        if NODE is not None:
            subprocess.run([NODE, "--check", path], check=True)


@pytest.mark.parametrize("fmi", ["2.0", "3.0"])
@pytest.mark.filterwarnings("ignore:the FMU has no binary")
def test_fmu(fmi, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "none-there")
    solution = hostile(2)
    with ZipFile(solution.export(tmp_path / "model.fmu", fmi=fmi)) as archive:
        archive.extractall(tmp_path)
    root = ElementTree.parse(tmp_path / "modelDescription.xml").getroot()
    tag = "Float64" if fmi == "3.0" else "ScalarVariable"
    found = [variable.get("name") for variable in root.find("ModelVariables").findall(tag)]
    assert found[1:] == [*solution.parameters, *solution.unknowns]
    if COMPILER is not None:
        sources = sorted((tmp_path / "sources").glob("*.c"))
        run = subprocess.run(
            [COMPILER, *STRICT, *sources], capture_output=True, text=True, check=False
        )
        assert not run.returncode, run.stderr[:2000]


@pytest.mark.slow
def test_generated_solver(tmp_path):
    """Titles and names of a problem, in the generated module and in the exported solver."""
    x, name = 'x*/??/"""\\', 'a"""\\'
    t, a = sp.symbols("t"), sp.Symbol(name)
    u = sp.Function(x)(t)
    problem = ro.Problem(
        [sp.Eq(u.diff(t), -a * u)], (t, 0, 1), {a: (1, 2)}, {u: 1},
        name='"""\\ # */ </script>\\', units={u: 'm"""\\'},
    )  # fmt: skip
    path = ro.compile(problem).export(tmp_path / "solver.py")
    module = runpy.run_path(str(path))
    assert module["METADATA"].states == (x,)
