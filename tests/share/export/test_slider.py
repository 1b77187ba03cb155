"""Sliders of the page are even on the scale of their parameter."""

from __future__ import annotations

from pathlib import Path

import rankone as ro
from tests.share.export.node import needs_node, script

VALUES = Path(ro.__file__).parent / "share" / "export" / "explorer" / "values.js"


@needs_node
def test_steps_of_a_slider(tmp_path):
    module = tmp_path / "model.mjs"
    module.write_text(VALUES.read_text())
    answer = script(
        tmp_path,
        """
const { valueAt, stepAt, stepped } = m;
const [box, wide] = [[0.1, 10], [1e-3, 10]];
console.log(JSON.stringify({
  log: [0, 250, 500, 750, 1000].map((step) => valueAt(wide, step, "log")),
  linear: valueAt([1, 2], 333),
  reciprocal: valueAt(box, 500, "reciprocal"),
  back: [stepAt(wide, 0.1, "log"), stepAt(box, 0.198, "reciprocal"), stepAt([1, 2], 1.333)],
  keys: [stepped(wide, 0.1, 10, "log"), stepped(wide, 10, 10, "log")],
}));
""",
    )
    assert answer["log"] == [0.001, 0.01, 0.1, 1, 10]
    assert answer["linear"] == 1.333
    assert answer["reciprocal"] == 0.198
    assert answer["back"] == [500, 500, 333]
    assert answer["keys"] == [0.10965, 10]
