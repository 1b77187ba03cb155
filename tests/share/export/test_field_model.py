"""Exported fields give the entries that the solution gives."""

import importlib
import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import rankone as ro
from tests.share.export.node import needs_node, run_node
from tests.share.export.test_models import COMPILER, STRICT, needs_compiler
from tests.solution.fields.small_fields import small_fields

AT = {"t": 0.4, "k": 1.3, "s": 0.7}


@pytest.fixture(scope="module")
def solution():
    return small_fields()


def test_python(solution, tmp_path, monkeypatch):
    solution.export(tmp_path / "whole.py")
    monkeypatch.syspath_prepend(tmp_path)
    model, modes = importlib.import_module("whole"), importlib.import_module("whole_fields")
    coefficients = model.value(**AT)
    assert modes.fields(coefficients) == pytest.approx(solution(**AT), rel=1e-10)
    many = {**AT, "t": np.linspace(0.0, 1.0, 5)}
    assert modes.field("u", model.value(**many)) == pytest.approx(solution["u"](**many), rel=1e-10)
    assert modes.field("w", coefficients)[0] == pytest.approx(solution["w"](**AT), rel=1e-10)
    assert "largest value of each field: u 2e-05" in " ".join(modes.__doc__.split())


@needs_compiler
def test_c(solution, tmp_path):
    solution.export(tmp_path / "whole.c")
    (tmp_path / "main.c").write_text(
        '#include "whole_fields.h"\n#include <stdio.h>\n'
        "int main(void) {\n"
        "    double p[2] = {1.3, 0.7}, a[WHOLE_UNKNOWNS], u[WHOLE_ENTRIES];\n"
        "    int i;\n"
        "    if (whole_eval(p, 0.4, a)) return 1;\n"
        "    whole_fields(a, u);\n"
        '    for (i = 0; i < WHOLE_ENTRIES; i++) printf("%.17g\\n", u[i]);\n'
        "    return 0;\n}\n"
    )
    sources = [tmp_path / name for name in ("main.c", "whole.c", "whole_fields.c")]
    build = [COMPILER, *STRICT, *sources, "-o", tmp_path / "main", "-lm"]
    subprocess.run(build, check=True)
    run = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True)
    entries = np.array(run.stdout.split(), dtype=float)
    assert entries == pytest.approx(solution(**AT), rel=1e-10)


@needs_node
def test_javascript(solution, tmp_path):
    solution.export(tmp_path / "whole.mjs")
    script = tmp_path / "script.mjs"
    script.write_text(
        'import { evaluate } from "./whole.mjs";\n'
        'import { fields, blocks } from "./whole_fields.mjs";\n'
        "const entries = fields(evaluate(0.4, { k: 1.3, s: 0.7 }));\n"
        "console.log(JSON.stringify([...entries]));\n"
    )
    entries = np.array(json.loads(run_node(script)))
    assert entries == pytest.approx(solution(**AT), rel=1e-10)


def test_what_cannot_be_written_is_refused(solution, tmp_path):
    for name in ("whole.fmu", "whole.txt"):
        with pytest.raises(ro.ExportError, match=r"solution\.output"):
            solution.export(tmp_path / name)
    path = solution.export(tmp_path / "whole.c")
    path.unlink()
    with pytest.raises(ro.ExportError, match=r"whole_fields\.c` exists"):
        solution.export(path)
    assert not path.exists()
    solution.export(path, overwrite=True)
    failed = replace(solution, status=ro.Status.TOLERANCE)
    with pytest.raises(ro.ExportError, match="not a success"):
        failed.export(tmp_path / "failed.c")
    failed.export(tmp_path / "failed.c", allow_failed=True)
