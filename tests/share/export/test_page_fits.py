"""The fit of a page is that of Python."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import rankone as ro
from tests.inference.estimation.experiments import TRUE, bateman, oral
from tests.share.export.browser import NoBrowserError, browser, settle
from tests.share.export.node import needs_node, script

FOLDER = Path(ro.__file__).parent / "share" / "export" / "explorer"
HOURS = np.array([0.5, 1, 2, 3, 4, 6, 8, 12, 16, 24])
AGREES = 1e-6


def csv_of(columns):
    rows = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values()))]
    return "\n".join(rows) + "\n"


def measured(sigma=None):
    noise = np.random.default_rng(6).standard_normal((2, HOURS.size))
    level = bateman(HOURS) + 0.15 * noise[0]
    gut = 100.0 * np.exp(-TRUE["ka"] * HOURS) + 2.0 * noise[1]
    columns = {"t": HOURS, "C": level, "A": gut, "dose": np.full(HOURS.size, 100.0)}
    if sigma is not None:
        columns |= {"sigma_C": np.full(HOURS.size, sigma), "sigma_A": np.full(HOURS.size, 2.0)}
    return columns


def page_data():
    """What a page knows of the solution."""
    return {
        "unknowns": [{"name": name} for name in oral().unknowns],
        "parameters": [
            {"name": name, "range": list(ends), "scale": "linear"}
            for name, ends in oral().parameters.items()
        ],
        "time": {"name": "t", "range": list(oral().time)},
    }


def write_modules(folder):
    """The model and the parts of a page that fit it, as modules."""
    oral().export(folder / "model.mjs")
    for name in ("values", "measurements", "fitting"):
        (folder / f"{name}.js").write_text((FOLDER / f"{name}.js").read_text())
    (folder / "package.json").write_text('{"type": "module"}')


@needs_node
@pytest.mark.parametrize("sigma", [None, 0.15])
def test_the_fit_is_that_of_python(tmp_path, sigma):
    write_modules(tmp_path)
    columns = measured(sigma)
    result = script(
        tmp_path,
        f"""
import {{ fitParameters }} from "./fitting.js";
import {{ readMeasurements }} from "./measurements.js";
const data = {json.dumps(page_data())};
const measurements = readMeasurements({json.dumps(csv_of(columns))}, data);
const start = Float64Array.from(data.parameters, ({{ range: [a, b] }}) => 0.5 * (a + b));
const {{ p, ...rest }} = fitParameters(m, data.parameters, measurements, start);
console.log(JSON.stringify({{ p: [...p], ...rest, count: measurements.count }}));
""",
    )
    fit = oral().fit(columns)
    assert fit.success, fit.message
    wanted = [fit.values[name] for name in oral().parameters]
    np.testing.assert_allclose(result["p"], wanted, rtol=AGREES)
    deviations = {"A": 2.0, "C": sigma} if sigma else {"A": 1.0, "C": 1.0}
    squares = [np.sum((fit.residuals[name] / deviations[name]) ** 2) for name in ("A", "C")]
    np.testing.assert_allclose(result["squares"], squares, rtol=AGREES)
    assert (result["atBounds"], result["unseen"], result["count"]) == ([], [], 20)


@needs_node
def test_tables_that_cannot_be_used(tmp_path):
    write_modules(tmp_path)
    texts = [
        "",
        "hours,C\n1,2",
        "t,level\n1,2",
        "t,C\n1,high",
        "t,C\n99,1",
        "t,C\n,1",
        "t,C,dose\n1,1,50\n2,1,60",
        "t,C,dose\n1,1,5000",
        "t,C,sigma\n1,1,0",
        "t,C,sigma\n1,1,0.1\n2,1,",
        "t,A,C,sigma_C\n1,,1,0.1\n2,1,1,0.1",
    ]
    messages = script(
        tmp_path,
        f"""
import {{ readMeasurements }} from "./measurements.js";
const told = {json.dumps(texts)}.map((text) => {{
  try {{ readMeasurements(text, {json.dumps(page_data())}); return ""; }}
  catch (error) {{ return error.message; }}
}});
console.log(JSON.stringify(told));
""",
    )
    assert messages == [
        "the table is empty",
        "the table has no column t for time",
        "the table has no values of an unknown: name columns A, C",
        "line 2: C is high, not a number",
        "line 2: t = 99 is not in [0, 24]",
        "line 2: t =  is not in [0, 24]",
        "dose differs from row to row: a page fits one experiment",
        "dose = 5000 is not in [20, 250]",
        "line 2: a standard deviation is not positive",
        "line 3: C has no standard deviation, and other measurements have one",
        "line 3: A has no standard deviation, and other measurements have one",
    ]


@pytest.mark.slow
def test_the_button_of_a_page(tmp_path):
    page_file = oral().explore(tmp_path / "page.html")
    table = tmp_path / "measured.csv"
    labels = {"condition": ["first"] * 5 + ["second"] * 5}
    table.write_text(csv_of(measured() | labels))
    fit = oral().fit(measured() | labels)
    try:
        with browser() as chromium, chromium.open(page_file) as page:
            assert page.locator("#fit").is_hidden()
            page.locator("#file").set_input_files(table)
            page.locator("#fit").wait_for()
            assert "20 measurements of measured.csv" in page.locator("#notice").inner_text()
            assert "differ in condition count as the same" in page.locator("#notice").inner_text()
            page.locator("#fit").click()
            settle(page)
            shown = page.evaluate("rankone.values()")["parameters"]
            assert "Fitted ka, ke, V to 20 measurements" in page.locator("#notice").inner_text()
    except NoBrowserError as reason:
        pytest.skip(str(reason))
    for name, x in fit.values.items():
        assert shown[name] == pytest.approx(x, rel=AGREES)


@pytest.mark.slow
def test_a_page_says_what_measurements_do_not_determine(tmp_path):
    """With the dose free, the blood alone does not tell it from the volume."""
    columns = {name: column for name, column in measured(0.15).items() if name in ("t", "C")}
    assert not oral().fit(columns).identifiable["V"]
    table = tmp_path / "measured.csv"
    table.write_text(csv_of(columns))
    try:
        with browser() as chromium, chromium.open(oral().explore(tmp_path / "page.html")) as page:
            page.locator("#file").set_input_files(table)
            page.locator("#fit").click()
            settle(page)
            told = page.locator("#notice.doubtful").inner_text()
            assert page.evaluate("rankone.fit().unseen") == ["V", "dose"]
    except NoBrowserError as reason:
        pytest.skip(str(reason))
    assert "Not determined: V, dose; other values fit as well" in told


IN_SIGHT = """(shown) => [...document.querySelectorAll(shown)].filter((element) => {
  const box = element.getBoundingClientRect();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  const top = document.elementFromPoint(x, y);
  return box.top >= 0 && box.bottom <= innerHeight && (top === element || element.contains(top));
}).length"""


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_sliders_curves_and_what_a_fit_says_are_in_sight(tmp_path, width, scheme):
    """Beside each other on a screen; on a telephone each slider below the curves."""
    table = tmp_path / "measured.csv"
    table.write_text(csv_of({"t": HOURS, "C": bateman(HOURS)}))
    page_file = oral().explore(tmp_path / "page.html")
    sliders = "#parameters input[type=range]"
    try:
        with browser() as chromium, chromium.open(page_file, width=width, scheme=scheme) as page:
            page.locator("#file").set_input_files(table)
            page.locator("#fit").click()
            for part in ("#notice.doubtful", "#fit"):
                page.wait_for_function(f"() => ({IN_SIGHT})('{part}') === 1")
            if width == 1280:
                assert page.evaluate(IN_SIGHT, sliders) == 4
                return
            for slider in page.locator(sliders).all():
                slider.focus()
                page.wait_for_function(f"() => ({IN_SIGHT})('{sliders}:focus') === 1")
                assert page.evaluate(IN_SIGHT, ".plot .u-over") >= 1
                assert page.evaluate(IN_SIGHT, "#time") == 1
    except NoBrowserError as reason:
        pytest.skip(str(reason))


def test_units_are_typeset_and_time_is_named(tmp_path):
    problem = ro.Problem.from_strings(
        {"u": "-k*u"},
        {"u": "a"},
        {"k": (1, 2), "a": (1, 2)},
        (0, 2),
        units={"t": "s", "k": "1/s^2", "u": "kg*m**-1"},
    )
    text = ro.solve(problem, 1e-5).explore(tmp_path / "page.html").read_text()
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    assert [data["parameters"][0]["unit"], data["unknowns"][0]["unit"]] == ["1/s²", "kg·m⁻¹"]
    assert data["time"]["unit"] == "s"
    assert "k from 1 to 2 1/s²" in text


def test_a_page_opens_where_the_unknowns_vary(tmp_path):
    problem = ro.Problem.from_strings({"u": "-k*u"}, {"u": "1"}, {"k": (0.5, 2)}, (0, 4))
    text = ro.solve(problem, 1e-5).explore(tmp_path / "page.html").read_text()
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    low, high = (np.exp(-k * np.array(data["times"])) for k in (2.0, 0.5))
    widest = data["times"][int(np.argmax(high - low))]
    assert data["time"]["start"] == pytest.approx(widest, abs=0.05)
