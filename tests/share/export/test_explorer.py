"""Pages with sliders and curves, in a browser and as text."""

from __future__ import annotations

import colorsys
import csv
import io
import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import rankone as ro
from rankone.share.commands.cli import main
from rankone.share.export.explorer import curve_times
from rankone.share.export.mathml import Notation
from rankone.share.plotting.style import PALETTE
from rankone.solvers.outcome import Role
from rankone.support.errors import ExportError, OptionError
from rankone.trajectories.system.verdict import Status
from tests.problems import GENERAL
from tests.share.export.browser import NoBrowserError, browser, settle
from tests.share.export.solutions import solved, synthetic, synthetic_with_breaks
from tests.solution.evaluation.functions import oscillator, two_unknowns

TOLERANCE = 1e-10
SOLVED = two_unknowns().solution
UNITS = (("t", "s"), ("x", "m"), ("x0", "m"))


@pytest.fixture(scope="module")
def chromium():
    try:
        with browser() as found:
            yield found
    except NoBrowserError as reason:
        pytest.skip(str(reason))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The page of a solution that has units."""
    return with_units(SOLVED).explore(tmp_path_factory.mktemp("explorer") / "page.html")


def with_units(solution, units=UNITS):
    return ro.Solution(solution.outcome, replace(solution.metadata, units=units))


def failed(solution):
    outcome = replace(solution.outcome, status=Status.RANK_LIMIT)
    return ro.Solution(outcome, solution.metadata)


def luminance(colour):
    """Of a colour as rgb(...) or #rrggbb, as WCAG defines it."""
    parts = re.findall(r"\d+", colour) if "(" in colour else re.findall(r"\w\w", colour)
    base = 10 if "(" in colour else 16
    shares = [int(part, base) / 255 for part in parts[:3]]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


def contrast(one, other):
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def hue(colour):
    return colorsys.rgb_to_hls(*(int(part, 16) / 255 for part in re.findall(r"\w\w", colour)))[0]


def plain_name(name):
    return Notation(SOLVED.metadata).text(name)


def values(page):
    return page.evaluate("rankone.values()")


def assert_agrees(found, solution):
    """The curves and values of a page are those of a solution."""
    clock = solution.metadata.time
    times = np.clip(found["times"], *solution.time)
    for name, curve in found["curves"].items():
        wanted = solution[name]({clock: times, **found["parameters"]})
        np.testing.assert_allclose(curve, wanted, rtol=0, atol=TOLERANCE * np.abs(wanted).max())
        now = solution[name]({clock: found["time"], **found["parameters"]})
        assert abs(found["values"][name] - now) <= TOLERANCE * np.abs(wanted).max()


# --- in a browser ------------------------------------------------------------------------------


@cache
def pendulum():
    return ro.solve(GENERAL["pendulum"].problem, rtol=GENERAL["pendulum"].RTOL)


KINDS = {
    "slabs": lambda: solved("lotka_volterra"),
    "six unknowns": lambda: solved("kirchhoff"),
    "pendulum": pendulum,
    "derivative": lambda: oscillator().solution,
    "names": synthetic,
    "breaks": synthetic_with_breaks,
}


@pytest.mark.parametrize("kind", KINDS)
def test_curves_are_those_of_the_solution(chromium, tmp_path, kind):
    solution = KINDS[kind]()
    path = solution.explore(tmp_path / "page.html")
    with chromium.open(path) as page:
        assert_agrees(values(page), solution)
        rng = np.random.default_rng(3)
        point = {name: rng.uniform(*ends) for name, ends in solution.parameters.items()}
        point[solution.metadata.time] = rng.uniform(*solution.time)
        page.evaluate("(point) => rankone.set(point)", point)
        settle(page)
        found = values(page)
        assert {**found["parameters"], solution.metadata.time: found["time"]} == point
        assert_agrees(found, solution)


def test_scripts_see_what_they_set_or_an_error(chromium, written):
    """What is set is there at once; what cannot be shown is an error, and changes nothing."""
    name, (_, upper) = next(iter(SOLVED.parameters.items()))
    with chromium.open(written) as page:
        found = page.evaluate(f"(rankone.set({{{name}: {upper}}}), rankone.values())")
        assert found["parameters"][name] == upper
        assert_agrees(found, SOLVED)
        for wrong in (f"{name}: 1e9", f"{name}: NaN", f"{name}: 'abc'", f"{name}: null", "nope: 1"):
            caught = (
                f"(() => {{try {{rankone.set({{{wrong}}})}} catch (e) {{return e.message}}}})()"
            )
            assert page.evaluate(caught), wrong
            assert page.evaluate("rankone.values()") == found


def test_sliders_and_numbers(chromium, written):
    (lower, upper), *_ = SOLVED.parameters.values()
    name, *_ = SOLVED.parameters
    with chromium.open(written) as page:
        middle = values(page)["parameters"]
        assert middle == {
            k: pytest.approx(0.5 * (a + b)) for k, (a, b) in SOLVED.parameters.items()
        }
        slider = page.locator("#parameters input[type=range]").first
        field = page.locator("#parameters input[type=text]").first
        slider.focus()
        page.keyboard.press("End")
        settle(page)
        assert values(page)["parameters"][name] == upper
        assert float(field.input_value()) == upper
        page.keyboard.press("ArrowLeft")
        settle(page)
        assert lower < values(page)["parameters"][name] < upper
        assert_agrees(values(page), SOLVED)

        exact = lower + (upper - lower) / 7
        field.fill(repr(exact))
        settle(page)
        assert values(page)["parameters"][name] == exact
        assert_agrees(values(page), SOLVED)

        field.fill(repr(upper + 1))
        settle(page)
        assert values(page)["parameters"][name] == exact
        assert field.get_attribute("aria-invalid") == "true"
        assert f"{exact:.6g}".replace("-", "−") in complaint(page)

        page.locator("#reset").click()
        settle(page)
        assert values(page)["parameters"] == middle
        assert field.get_attribute("aria-invalid") == "false"


def complaint(page):
    """What is wrong with the first number."""
    return page.locator("#parameters .wrong").first.inner_text()


@cache
def heater():
    """Names with subscripts, a jump, an unknown that begins at zero, and ranges of two sizes."""
    problem = ro.Problem.from_strings(
        rhs={"T_i": "-k*T_i", "Delta_T": "c*k*T_i"},
        initial={"T_i": "300", "Delta_T": "0"},
        parameters={"k": (20, 40), "c": (0.1, 0.2)},
        time=(0, 0.1),
        jumps={0.05: {"T_i": "T_i + 100"}},
    )
    return ro.solve(problem, rtol=1e-5)


@pytest.fixture(scope="module")
def heated(tmp_path_factory):
    return heater().explore(tmp_path_factory.mktemp("heater") / "page.html")


@pytest.mark.parametrize("end", ["Enter", "Tab"])
def test_a_number_that_ends_as_refused_changes_nothing(chromium, heated, end):
    """Also if it began with one that is not; the message stays until there is a valid one."""
    with chromium.open(heated) as page:
        page.evaluate("rankone.set({ k: 33.5 })")
        field = page.get_by_role("spinbutton").first
        field.focus()
        field.select_text()
        page.keyboard.type("300")
        assert values(page)["parameters"]["k"] == 30
        page.keyboard.press(end)
        assert values(page)["parameters"]["k"] == 33.5
        assert page.locator("#p0").input_value() == "675"
        assert field.input_value() == "300"
        assert field.get_attribute("aria-invalid") == "true"
        assert complaint(page) == "A number from 20 to 40; the curves are those of 33.5."
        field.fill("30")
        assert values(page)["parameters"]["k"] == 30
        assert field.get_attribute("aria-invalid") == "false"
        assert complaint(page) == ""
        field.press("Enter")
        field.fill("")
        field.press("Enter")
        assert values(page)["parameters"]["k"] == 30
        field.press("Escape")
        assert field.input_value() == "30"
        assert complaint(page) == ""


@pytest.mark.parametrize(
    ("typed", "value"),
    [
        ("25,5", 25.5),
        ("2.55e1", 25.5),
        (" 25.5 ", 25.5),
        ("+25.", 25.0),
        ("25.123456789", 25.123456789),
    ],
)
def test_numbers_are_taken_as_typed(chromium, heated, typed, value):
    with chromium.open(heated) as page:
        field = page.get_by_role("spinbutton").first
        field.fill(typed)
        field.press("Enter")
        assert values(page)["parameters"]["k"] == value
        assert field.input_value() == typed


@pytest.mark.parametrize("typed", ["1,025.5", "0x1f", "25 5", "25..5", "thirty", "Infinity", "-"])
def test_what_is_no_number_is_refused(chromium, heated, typed):
    with chromium.open(heated) as page:
        page.get_by_role("spinbutton").first.fill(typed)
        assert values(page)["parameters"]["k"] == 30
        assert "from 20 to 40" in complaint(page)


def test_keys_of_a_number_go_as_far_as_those_of_its_slider(chromium, heated):
    keys = {
        "k": [("ArrowUp", 30.02), ("Shift+ArrowDown", 29.82), ("PageUp", 30.02)],
        "c": [("ArrowUp", 0.1501), ("Shift+ArrowDown", 0.1491), ("ArrowDown", 0.149)],
    }
    with chromium.open(heated) as page:
        for number, (name, wanted) in enumerate(keys.items()):
            field = page.get_by_role("spinbutton").nth(number)
            for key, value in wanted:
                field.press(key)
                assert values(page)["parameters"][name] == value
                assert float(field.input_value()) == value
            lower, upper = heater().parameters[name]
            field.fill(str(upper))
            field.press("ArrowUp")
            assert values(page)["parameters"][name] == upper
            field.fill(str(lower))
            field.press("Shift+ArrowDown")
            assert values(page)["parameters"][name] == lower
            assert field.get_attribute("aria-valuenow") == f"{lower:g}"


def test_numbers_are_short_and_values_exact(chromium, heated):
    exact = 0.1 + 0.5 * (0.2 - 0.1)
    assert exact == 0.15000000000000002
    with chromium.open(heated) as page:
        field = page.get_by_role("spinbutton").nth(1)
        assert field.input_value() == "0.15"
        assert values(page)["parameters"]["c"] == exact
        page.locator("#link").click()
        page.wait_for_selector("#notice:not([hidden])")
        assert f"c={exact}" in page.evaluate("location.hash")
        field.focus()
        field.blur()
        assert values(page)["parameters"]["c"] == exact


def test_values_below_the_error_are_zero_in_the_legend(chromium, heated):
    with chromium.open(heated) as page:
        page.evaluate("rankone.set({ t: 0 })")
        settle(page)
        number = values(page)["values"]["Delta_T"]
        assert 0 < abs(number) < 1e-3
        assert page.locator("#legend .value").all_inner_texts() == ["300.00", "0"]
        row = page.evaluate("rankone.table()").splitlines()[1].split(",")
        assert float(row[2]) == pytest.approx(number, rel=1e-3)
        page.evaluate("rankone.set({ t: 1e-4 })")
        settle(page)
        assert float(page.locator("#legend .value").nth(1).inner_text()) == pytest.approx(
            values(page)["values"]["Delta_T"], rel=1e-4
        )


STROKES = """async () => {
  const [now, strokes] = [{}, []];
  const own = CanvasRenderingContext2D.prototype;
  const kept = {};
  const spy = (name, seen) => {
    kept[name] = own[name];
    own[name] = function (...given) {
      if (document.querySelector("#phase-plot").contains(this.canvas)) seen(this, ...given);
      return kept[name].apply(this, given);
    };
  };
  let last = null;
  let longest = 0;
  spy("beginPath", () => ([last, longest] = [null, 0]));
  spy("moveTo", (context, x, y) => (last = [x, y]));
  spy("lineTo", (context, x, y) => {
    if (last) longest = Math.max(longest, Math.hypot(x - last[0], y - last[1]));
    last = [x, y];
  });
  spy("stroke", (context) => strokes.push({
    longest, dashed: context.getLineDash().length > 0, colour: context.strokeStyle,
  }));
  rankone.set({});
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  Object.assign(own, kept);
  return strokes;
}"""


ACCENT = r"#0072b2|rgba\(0, 114, 178"


def test_jumps_are_no_motion_in_the_phase_plot(chromium, heated):
    """Lines are solid along curves and dashed where a state jumps; the mark is solid as before."""
    with chromium.open(heated) as page:
        page.evaluate("rankone.set({ t: 0.08 })")
        settle(page)
        strokes = page.evaluate(STROKES)
        accent = [found for found in strokes if re.match(ACCENT, found["colour"])]
        assert max(found["longest"] for found in accent if not found["dashed"]) < 20
        dashed = [found for found in strokes if found["dashed"]]
        assert len(dashed) == 2
        assert min(found["longest"] for found in dashed) > 50
        assert not strokes[-1]["dashed"]
        page.evaluate("rankone.set({ t: 0.04 })")
        settle(page)
        assert sum(found["dashed"] for found in page.evaluate(STROKES)) == 1


@pytest.mark.parametrize("font", ["", "serif"])
def test_exponents_are_beside_what_they_belong_to(chromium, written, font):
    """Also with a font that has no measures for formulas.

    On top of it the overlap is 0. Boxes end at whole pixels, so that letters are large here.
    """
    with chromium.open(written) as page:
        overlap = page.evaluate(
            """(font) => {
              const place = document.createElement("p");
              place.innerHTML =
                "<math><msup><mrow><mi>B</mi></mrow><mrow><mn>2</mn></mrow></msup></math>";
              Object.assign(place.firstChild.style, { fontFamily: font, fontSize: "160px" });
              document.body.append(place);
              const [base, above] = ["mi", "mn"].map((name) => place.querySelector(name));
              const size = parseFloat(getComputedStyle(base).fontSize);
              const [{ top }, { bottom }] = [base, above].map((e) => e.getBoundingClientRect());
              return (bottom - top) / size;
            }""",
            font,
        )
        assert 0.15 < overlap < 0.6


def test_a_chosen_theme_lasts(chromium, written):
    theme = "document.documentElement.dataset.theme"
    with chromium.open(written) as page:
        button = page.locator("#theme")
        assert button.get_attribute("aria-pressed") == "false"
        button.click()
        page.reload()
        assert page.evaluate(theme) == "dark"
        assert button.get_attribute("aria-pressed") == "true"
        button.click()
        page.emulate_media(color_scheme="dark")
        page.reload()
        assert page.evaluate(theme) == "dark"  # that of the system was chosen
        page.add_init_script(
            "Object.defineProperty(window, 'localStorage', { get() { throw new Error('none'); } })"
        )
        page.reload()
        assert page.evaluate(theme) == "dark"
        button.click()
        assert page.evaluate(theme) == "light"


def test_it_opens_at_the_medians(chromium, tmp_path):
    name, (lower, upper) = next(iter(SOLVED.parameters.items()))
    given = f"expon({lower}, {0.2 * (upper - lower)})"
    metadata = replace(SOLVED.metadata, distributions=((name, given),))
    path = ro.Solution(SOLVED.outcome, metadata).explore(tmp_path / "page.html", title=" ")
    share = -np.log(1 - 0.5 * (1 - np.exp(-5.0))) * 0.2
    with chromium.open(path) as page:
        found = values(page)["parameters"]
        assert abs(found.pop(name) - (lower + share * (upper - lower))) <= 1e-3 * (upper - lower)
        assert found == {k: 0.5 * (a + b) for k, (a, b) in SOLVED.parameters.items() if k != name}
        assert page.title() == "Page"


def test_times_far_from_zero_are_told_apart(chromium, tmp_path):
    problem = ro.Problem.from_strings(
        rhs={"u": "-k*u"}, initial={"u": 1}, parameters={"k": (1, 2)}, time=(2e6, 2e6 + 1)
    )
    path = ro.solve(problem, rtol=1e-4).explore(tmp_path / "page.html")
    with chromium.open(path) as page:
        page.evaluate("rankone.set({t: 2e6 + 0.25})")
        settle(page)
        assert page.locator("#time-shown").inner_text() == "2000000.2500"


def test_shares_are_those_of_the_time(chromium, tmp_path):
    """A dose matters from when it is given, not before."""
    problem = ro.Problem.from_strings(
        rhs={"u": "-k*u"},
        initial={"u": "1"},
        parameters={"k": (0.2, 0.6), "dose": (0.5, 1)},
        time=(0, 8),
        jumps={4.0: {"u": "u + dose"}},
        name="Two doses",
    )
    solution = ro.solve(problem, rtol=1e-5)
    with chromium.open(solution.explore(tmp_path / "page.html")) as page:
        assert page.title() == "Two doses"
        for time in (0.013, 2.0, 3.97, np.nextafter(4.0, 0.0), 4.0, 4.02, 7.9):
            page.evaluate("(t) => rankone.set({t})", float(time))
            settle(page)
            indices = solution.sobol(float(time))
            wanted = np.stack([indices.first[0], indices.total[0]], axis=-1).reshape(2, 2)
            shares = [values(page)["shares"][name] for name in ("k", "dose")]
            np.testing.assert_allclose(np.array(shares, dtype=float), wanted, atol=0.01)


def test_what_was_fixed_and_made_smaller_is_said(chromium, tmp_path):
    solution = solved("lotka_volterra").fix(x0=9.5)
    path = solution.explore(tmp_path / "page.html", rtol=1e-3)
    with chromium.open(path) as page:
        assert page.locator("math", has_text="x0=9.5").count() == 1
        verdict = page.locator(".verdict").inner_text()
        assert "made smaller to within 1.0 · 10−3" in verdict


def test_links(chromium, written):
    point = {name: a + (b - a) / 3 for name, (a, b) in SOLVED.parameters.items()}
    with chromium.open(written) as page:
        page.evaluate("(point) => rankone.set(point)", {**point, "t": 0.7})
        settle(page)
        page.locator("#link").click()
        page.wait_for_selector("#notice:not([hidden])")
        fragment = page.evaluate("location.hash")
    with chromium.open(written, fragment) as page:
        found = values(page)
        assert (found["parameters"], found["time"]) == (point, 0.7)
        assert page.locator("#notice").is_hidden()
    name, other = SOLVED.parameters
    with chromium.open(written, f"#{name}=1e9&{other}=much&what=1&t") as page:
        found = values(page)["parameters"]
        assert found[name] == SOLVED.parameters[name][1]
        notice = page.locator("#notice").inner_text()
        assert all(text in notice for text in ("1000000000", "much", "there is no what"))


@pytest.mark.parametrize(
    ("fragment", "said", "k"),
    [
        ("#%E0%A4%A", "%E0%A4%A is not a name with a value", 30),
        ("#k=30&k=31", "k is there more than once", 31),
        ("#k=31&c", "c is not a name with a value", 31),
        ("#k=%E0%A4%A", "k = %E0%A4%A is not a number", 30),
        ("#k=31&", None, 31),
        ("#quality", None, 30),
    ],
)
def test_links_that_cannot_be_followed(chromium, heated, fragment, said, k):
    with chromium.open(heated, fragment) as page:
        notice = page.locator("#notice")
        assert notice.is_visible() == (said is not None)
        assert said is None or said in notice.inner_text()
        assert values(page)["parameters"]["k"] == k


def test_after_a_reset_a_reload_brings_nothing_back(chromium, heated):
    with chromium.open(heated, "#k=31") as page:
        page.locator("#reset").click()
        assert page.evaluate("location.href") == heated.as_uri()
        page.reload()
        assert values(page)["parameters"]["k"] == 30


def test_numbers_of_messages_are_on_one_line(chromium, heated):
    with chromium.open(heated, "#k=1e-9") as page:
        assert "k = 1e−9 is not in [20, 40]" in page.locator("#notice").inner_text()


def test_time_shares_and_bands(chromium, written):
    end = SOLVED.time[1]
    with chromium.open(written) as page:
        page.locator("#time").focus()
        page.keyboard.press("End")
        settle(page)
        found = values(page)
        assert found["time"] == end
        assert_agrees(found, SOLVED)
        indices = SOLVED.sobol(end)
        for j, name in enumerate(SOLVED.parameters):
            wanted = indices.first[0, j].item(), indices.total[0, j].item()
            assert found["shares"][name] == pytest.approx(wanted, abs=1e-4)
        page.locator("#shares-of").select_option("1")
        settle(page)
        name, *_ = SOLVED.parameters
        assert values(page)["shares"][name][0] == pytest.approx(
            indices.first[1, 0].item(), abs=1e-4
        )
        data = json.loads(page.locator("#data").inner_text())
    times = np.clip(data["times"], *SOLVED.time)
    low, high = SOLVED.quantile((0.025, 0.975), times, count=2**12)
    for i, unknown in enumerate(data["unknowns"]):
        size = np.abs(high[i]).max()
        np.testing.assert_allclose(unknown["low"], low[i], rtol=0, atol=1e-6 * size)
        np.testing.assert_allclose(unknown["high"], high[i], rtol=0, atol=1e-6 * size)


def test_play_and_point_at_a_time(chromium, written):
    with chromium.open(written) as page:
        page.locator("#play").click()
        page.wait_for_function("rankone.values().time > 0")
        page.locator("#play").click()
        box = page.locator("#plots .u-over").first.bounding_box()
        page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 20)
        settle(page)
        start, end = SOLVED.time
        share = (values(page)["time"] - start) / (end - start)
        assert share == pytest.approx(0.25, abs=0.01)


def test_tables(chromium, written, tmp_path, capsys):
    with chromium.open(written) as page:
        with page.expect_download() as download:
            page.locator("#csv").click()
        assert download.value.suggested_filename == "Page.csv"
        head, *rows = csv.reader(io.StringIO(Path(download.value.path()).read_text()))
        assert head == ["t", *SOLVED.unknowns, *SOLVED.parameters]
        t, *columns = np.array(rows, dtype=float).T
        point = {
            name: columns[len(SOLVED.unknowns) + j][0] for j, name in enumerate(SOLVED.parameters)
        }
        wanted = SOLVED(t=np.clip(t, *SOLVED.time), **point)
        np.testing.assert_allclose(columns[: len(wanted)], wanted, rtol=0, atol=1e-9)
        SOLVED.save(tmp_path / "model.npz")
        main(["fit", f"{tmp_path}/model.npz", f"{download.value.path()}", "--json"])
        found = json.loads(capsys.readouterr().out)
        assert found["observed"] == [*SOLVED.unknowns]
        fitted = {name: found["x"][name] for name in point}  # beside the levels of noise
        assert fitted == pytest.approx(point, abs=1e-9)
        page.locator("#legend button").first.click()
        assert SOLVED.unknowns[0] not in page.evaluate("rankone.table()").partition("\n")[0].split(
            ","
        )


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_cut_off(chromium, written, width, scheme):
    with chromium.open(written, width=width, scheme=scheme) as page:
        assert page.evaluate("document.documentElement.scrollWidth") == width
        assert page.evaluate("document.documentElement.dataset.theme") == scheme
        page.locator("#theme").click()
        assert page.evaluate("document.documentElement.dataset.theme") != scheme
        assert page.locator(".quantity .unit").first.inner_text() == "m"
        unnamed = page.evaluate(
            "[...document.querySelectorAll('input, select, button')].filter((e) => "
            "!(e.labels?.length || e.ariaLabel || e.textContent.trim())).length"
        )
        assert unnamed == 0


SHOWN = "#legend button, #legend .value, .buttons button:not([hidden]), .parameter .row, .ends span"
CUT = """(shown) => [...document.querySelectorAll(shown)].filter((element) => {
  element.scrollIntoView({ block: "end", behavior: "instant" });
  const within = (inner, outer) =>
    inner.left >= outer.left - 0.5 && inner.right <= outer.right + 0.5;
  const places = [{ left: 0, right: innerWidth }];
  for (let place = element.parentElement; place; place = place.parentElement) {
    place.scrollLeft = 0; // what is beside is cut off, too
    if (getComputedStyle(place).overflowX !== "visible" || place.matches(".card, button")) {
      places.push(place.getBoundingClientRect());
    }
  }
  const box = element.getBoundingClientRect();
  const above = box.top < 0 || box.bottom > innerHeight + 0.5;
  return above || !places.every((place) => within(box, place));
}).map((element) => element.outerHTML)"""


@pytest.mark.parametrize("name", ["robertson", "kirchhoff", "chain"])
@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_cut_off_where_there_is_much(chromium, tmp_path, width, name):
    """All names, values, ranges and buttons lie inside of what holds them."""
    path = solved(name).explore(tmp_path / "page.html")
    with chromium.open(path, width=width) as page:
        for arrangement in page.locator("#arrangement button").all():
            arrangement.click()
            settle(page)
            assert page.evaluate("document.documentElement.scrollWidth") == width
            assert page.evaluate(CUT, SHOWN) == []
            assert page.locator("#curves .hint").is_visible()


def test_buttons_stay_in_sight(chromium, tmp_path):
    """Beside a list of ten parameters, which is longer than the window; and no slider is behind."""
    path = solved("chain").explore(tmp_path / "page.html")
    with chromium.open(path) as page:
        for place in (0, 300, 1200):
            page.evaluate("(top) => scrollTo({ top, behavior: 'instant' })", place)
            boxes = [
                button.bounding_box()
                for button in page.locator(".buttons button:not([hidden])").all()
            ]
            assert all(box["y"] > 0 and box["y"] + box["height"] <= 844 for box in boxes)
        page.evaluate("scrollTo({ top: 0, behavior: 'instant' })")
        for slider in page.locator("#parameters input[type=range]").all():
            slider.focus()
            page.wait_for_function(
                "() => { const box = document.activeElement.getBoundingClientRect();"
                " const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];"
                " return document.elementFromPoint(x, y) === document.activeElement; }"
            )


@pytest.mark.parametrize(
    ("extents", "alike"),
    [
        ([[0, 1], [3, 4]], True),
        ([[0, 1], [0, 0.011]], True),
        ([[0, 1], [0, 0.009]], False),
        ([[-1, 99.1], [5, 6]], False),
        ([[0, 1], [7, 7]], True),
        ([[7, 7]], True),
        ([], True),
    ],
)
def test_unknowns_of_other_sizes_are_apart(chromium, written, extents, alike):
    source = (Path(ro.__file__).parent / "share" / "export" / "explorer" / "values.js").read_text()
    found = re.search(r"^export (function areAlike\(.*?^})", source, re.M | re.S)[1]
    with chromium.open(written) as page:
        assert page.evaluate(f"(extents) => {{ {found}; return areAlike(extents); }}", extents) == (
            alike
        )


@pytest.mark.parametrize(("name", "together"), [("robertson", False), ("lotka_volterra", True)])
def test_how_curves_are_arranged_at_first(chromium, tmp_path, name, together):
    path = solved(name).explore(tmp_path / "page.html")
    with chromium.open(path) as page:
        pressed = page.locator("#arrangement button[aria-pressed=true]").inner_text()
        assert pressed == ("Together" if together else "Apart")
        assert page.locator("#plots .plot").count() == (
            1 if together else len(solved(name).unknowns)
        )


DASHES = """async () => {
  const drawn = [];
  const set = CanvasRenderingContext2D.prototype.setLineDash;
  CanvasRenderingContext2D.prototype.setLineDash = function (dash) {
    drawn.push(dash.join());
    return set.call(this, dash);
  };
  const values = rankone.values();
  rankone.set({ [Object.keys(values.parameters)[0]]: Object.values(values.parameters)[0] });
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  CanvasRenderingContext2D.prototype.setLineDash = set;
  return drawn.filter(Boolean);
}"""


def test_curves_in_one_plot_differ_by_more_than_colour(chromium, tmp_path):
    path = solved("kirchhoff").explore(tmp_path / "page.html")
    with chromium.open(path) as page:
        page.locator("[data-together=true]").click()
        settle(page)
        drawn = page.evaluate(DASHES)
        assert len({*drawn}) == len(solved("kirchhoff").unknowns) - 1
        legend = page.locator("#legend path").evaluate_all(
            "(paths) => paths.map((path) => getComputedStyle(path).strokeDasharray)"
        )
        assert len({*legend}) == len(legend)
        page.locator("[data-together=false]").click()
        settle(page)
        assert page.evaluate(DASHES) == []


def test_plots_are_named(chromium, written):
    with chromium.open(written) as page:
        plot = page.get_by_role("img", name=" against ")
        first, second = (plain_name(name) for name in SOLVED.unknowns[:2])
        assert plot.get_attribute("aria-label") == f"{second} against {first}"
        page.locator("#phase-x").select_option("1")
        settle(page)
        assert plot.get_attribute("aria-label") == f"{second} against {second}"


def test_without_scripts_it_says_so(chromium, written):
    with chromium.open(written, scripts=False) as page:
        assert "need JavaScript" in page.locator("noscript .notice").inner_text()
        assert page.locator("noscript .notice").is_visible()
        assert page.locator(".card:visible").count() == 0
        assert page.locator(".equations").is_visible() == bool(SOLVED.metadata.equations)
    with chromium.open(written) as page:
        assert page.locator(".card:visible").count() > 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_contrast(chromium, written, scheme):
    """Of lines at least 3, of texts 4.5 (WCAG 2.2, 1.4.3 and 1.4.11)."""
    with chromium.open(written, scheme=scheme) as page:
        page.locator("#legend button").first.click()
        off = page.locator("#legend button[aria-pressed=false]").first
        style = "(e) => [getComputedStyle(e).color, getComputedStyle(e).opacity]"
        text, opacity = off.evaluate(style)
        card = page.locator("#curves").evaluate("(e) => getComputedStyle(e).backgroundColor")
        assert opacity == "1"
        assert contrast(text, card) >= 4.5
        for i in range(8):
            page.evaluate(f"document.querySelector('#csv').style.color = 'var(--c{i})'")
            assert contrast(page.locator("#csv").evaluate(style)[0], card) >= 3.0


def test_a_failed_solution_says_so(chromium, tmp_path, written):
    solution = failed(SOLVED)
    path = solution.explore(tmp_path / "page.html", allow_failed=True)
    with chromium.open(path) as page:
        assert "not a success" in page.locator(".verdict.bad").inner_text()
        message = solution.message[:1].upper() + solution.message[1:]
        assert message in page.locator(".verdict.bad").inner_text()
    with chromium.open(written) as page:
        assert page.locator(".verdict.bad").count() == 0


def test_without_parameters_and_with_one(chromium, tmp_path):
    alone = solved("decay")
    name, (lower, upper) = next(iter(alone.parameters.items()))
    none = alone.fix({name: 0.5 * (lower + upper)})
    for solution in (alone, none):
        path = solution.explore(tmp_path / "page.html", overwrite=True, allow_failed=True)
        with chromium.open(path) as page:
            assert_agrees(values(page), solution)
            assert page.locator("#shares, #phase").count() == 0


# --- as text -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_it_is_written_as_other_exports_are(tmp_path):
    path = SOLVED.export(tmp_path / "page.html")
    again = SOLVED.explore(tmp_path / "other.html", title="Page")
    assert path.read_bytes() == again.read_bytes()
    assert not re.search(r"https?://(?!github\.com/leeoniya)", path.read_text())
    with pytest.raises(ExportError, match="exists"):
        SOLVED.explore(path)
    with pytest.raises(ExportError, match="suffix"):
        SOLVED.explore(tmp_path / "page.pdf")
    with pytest.raises(ExportError, match="not a success"):
        failed(SOLVED).explore(tmp_path / "failed.html")
    with pytest.raises(ExportError, match=r"name it .*page\.html$") as caught:
        SOLVED.explore(tmp_path / ".html")
    assert ".html.html" not in str(caught.value)
    with pytest.raises(OptionError, match="title"):
        SOLVED.explore(tmp_path / "new.html", title=3)
    with pytest.raises(OptionError, match="states"):
        SOLVED.export(tmp_path / "new.html", states="some")
    with pytest.raises(ExportError, match="do not depend on time"):
        SOLVED.at(1.0).explore(tmp_path / "new.html", allow_failed=True)


def test_names_cannot_end_a_script(tmp_path):
    title = "<script>alert(1)</script>"
    metadata = replace(SOLVED.metadata, units=(("x", "</script>"),), equations=("x' = </script>",))
    solution = ro.Solution(SOLVED.outcome, metadata)
    text = solution.explore(tmp_path / "page.html", title=title).read_text()
    assert text.count("</script>") == text.count("<script") == 3
    assert "&lt;script&gt;alert(1)" in text


@pytest.mark.slow
def test_pages_are_small(tmp_path):
    path = solved("kirchhoff").explore(tmp_path / "kirchhoff.html")
    assert path.stat().st_size < 5e6


def test_correlated_parameters_have_no_shares(tmp_path):
    metadata = replace(SOLVED.metadata, correlations=((*SOLVED.parameters, 0.9),))
    solution = ro.Solution(SOLVED.outcome, metadata)
    text = solution.explore(tmp_path / "page.html").read_text()
    assert "Parameters are correlated" in text
    data = json.loads(re.search(r'id="data">(.*?)</script>', text)[1])
    assert data["sobol"] is None
    low = solution.quantile(0.025, data["times"][-2], count=2**12)
    assert data["unknowns"][0]["low"][-2] == pytest.approx(low[0], rel=1e-6)


@pytest.mark.slow
def test_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    SOLVED.save("model.npz")
    failed(SOLVED).save("failed.npz")
    assert main(["explore", "model.npz", "--title", "Mine"]) == 0
    assert capsys.readouterr().out == "model.html\n"
    assert "<h1>Mine</h1>" in Path("model.html").read_text()
    assert main(["explore", "model.npz"]) == 2
    assert main(["explore", "model.npz", "-o", "model.pdf"]) == 2
    assert main(["explore", "failed.npz"]) == 1
    assert not Path("failed.html").exists()
    assert main(["explore", "failed.npz", "--allow-failed"]) == 1
    assert Path("failed.html").exists()


def test_colours_are_those_of_plots():
    """The same, or darker ones of the same hue where those are too light for a page."""
    style = Path(ro.__file__).parent / "share" / "export" / "explorer" / "page.css"
    root = style.read_text().partition("}")[0]
    found = re.findall(r"--c\d: (#\w{6})", root)
    for own, colour in zip(found, map(str.lower, PALETTE), strict=True):
        if contrast(colour, "#ffffff") >= 3.0:
            assert own == colour
        else:
            assert hue(own) == pytest.approx(hue(colour), abs=0.01)


@pytest.mark.parametrize(
    ("count", "folded"), [(4, False), pytest.param(9, True, marks=pytest.mark.slow)]
)
def test_many_equations_are_folded(tmp_path, count, folded):
    """Curves and sliders come first then; the summary says what is below it."""
    names = [f"x{i}" for i in range(count)]
    rhs = {name: f"-k*{name}" for name in names}
    problem = ro.Problem.from_strings(rhs, dict.fromkeys(names, 1), {"k": (0.5, 1)}, (0, 1))
    text = ro.solve(problem, 1e-3).explore(tmp_path / "page.html").read_text()
    before, _, after = text.partition('<section class="equations"')
    assert before.count('<details class="folded">') == folded
    assert (f"The {2 * count} equations and values</summary>" in before) == folded
    assert after.partition("</section>")[2].lstrip().startswith("</details>") == folded


# --- equations ---------------------------------------------------------------------------------


def notation(*equations, states=("x", "x_t"), roles=(Role.UNKNOWN, Role.DERIVATIVE)):
    return Notation(replace(SOLVED.metadata, states=states, roles=roles, equations=equations))


def plain(text):
    """What is seen: the characters, a space for a factor without a dot, powers, {fractions}."""

    def seen(element):
        parts = [element.text or "", *map(seen, element)]
        match element.tag:
            case "mfrac":
                return f"{{{'/'.join(parts[1:])}}}"
            case "msup":
                return "^".join(parts[1:])
            case "msqrt":
                return f"√({''.join(parts)})"
        return {"\u2061": "", "\u2062": " "}.get("".join(parts), "".join(parts))

    return seen(ElementTree.fromstring(f"<math>{text}</math>"))


def test_equations_are_typeset():
    groups = notation(
        "x' = x_t", "x_t' = -c*x_t - 2.5*sin(theta0)**2/(k + 1)", "x(0) = C_D", "x_t(0) = 1e-05"
    ).equations()
    (motion,), (place, speed) = groups
    assert plain(motion) == "x′′=−c x′−{2.5 sin^2(θ0)/k+1}"
    assert "<msub><mi>C</mi><mi>D</mi></msub>" in place
    assert plain(speed) == "x′(0)=1·10^−5"
    assert notation().equations() == []


def test_parentheses_are_where_they_are_needed():
    cases = {
        "a - (b - c)": "a−(b−c)",
        "a - (-b)": "a−(−b)",
        "a + -b*c": "a+(−b c)",
        "(a + b)*c": "(a+b) c",
        "a*(-b)": "a (−b)",
        "(-a)**2": "(−a)^2",
        "(a/b)**2": "({a/b})^2",
        "exp(a)**k": "(e^a)^k",
        "x_t**2": "(x′)^2",
        "lambda + exp(-k*t)": "λ+e^−k t",
        "Piecewise((1, t > 2), (0, True))": "{1t>20otherwise",
        "a*Piecewise((1, t > 2), (0, True))": "a ({1t>20otherwise)",
    }
    for text, wanted in cases.items():
        assert plain(notation().formula(text)) == wanted


def test_digits_do_not_run_together():
    cases = {
        "-3*2**k*u - 7*2**(-k)": "−3·2^k u−7·2^−k",
        "2*10**x": "2·10^x",
        "2*(1/3)*x": "2·{1/3} x",
        "2*3*x": "2·3 x",
        "a*(2*b/c)": "a·{2 b/c}",
        "2*(x/3)": "2 {x/3}",
        "2*k**3": "2 k^3",
    }
    for text, wanted in cases.items():
        written = notation().formula(text)
        assert plain(written) == wanted
        assert written.count("<mo>·</mo>") == wanted.count("·")


def test_signs_stand_before_fractions():
    cases = {
        "-1/6 + 2*u/3": "−{1/6}+{2 u/3}",
        "-5*u*w/9": "−{5 u w/9}",
        "a*(-5/9)": "a (−{5/9})",
        "a - b/6": "a−{b/6}",
        "(a - b)/6": "{a−b/6}",
    }
    for text, wanted in cases.items():
        assert plain(notation().formula(text)) == wanted


def test_powers_of_functions():
    """Before the argument only where they cannot be taken for an inverse function."""
    cases = {
        "sin(x)**2": "sin^2(x)",
        "sin(x)**(-2)": "sin(x)^−2",
        "sin(x)**k": "sin(x)^k",
        "sin(x)**0.5": "sin(x)^0.5",
    }
    for text, wanted in cases.items():
        assert plain(notation().formula(text)) == wanted


@pytest.mark.parametrize("text", ["x' = ~a", "no equation", "x' = 1 ... 2", "at t: x"])
def test_other_texts_stay_as_they_are(text):
    assert notation(text).equations() == [[f"<code>{text.replace(chr(39), '&#x27;')}</code>"]]


def test_names_that_look_the_same_stay_apart():
    names = ("theta0", "theta_0", "omega0", "theta")
    written = notation(states=names, roles=(Role.UNKNOWN,) * 4)
    assert [written.text(name) for name in names] == ["theta0", "theta_0", "ω₀", "θ"]


def test_jumps_are_typeset():
    ((line,),) = notation("at t = 12, 24: x -> x + Min(1, k), x_t -> 0").equations()
    assert plain(line) == "att=12,24:x→x+Min(1,k),x′→0"


def test_names_are_plain_text_too():
    names = notation()
    wanted = (
        "theta0 θ₀, C_D C_D, x_t x′, u1 u₁, x_{0} x_{0}, α α, k12 k₁₂, Omega_max Ωₘₐₓ, T_i Tᵢ, "
        "Delta_T Δ_T, k_2a k₂ₐ, T_in_C T_in_C, k_cat k_cat, g_alpha g_α"
    )
    pairs = [pair.split() for pair in wanted.split(", ")]
    assert [names.text(name) for name, _ in pairs] == [text for _, text in pairs]


# --- the wheel ---------------------------------------------------------------------------------


def test_files_of_the_page_are_package_data():
    """What is read when a page is written lies inside of the package, with its licence."""
    place = Path(ro.__file__).parent / "share" / "export"
    assert "MIT" in (place / "vendor" / "uPlot.LICENSE").read_text()
    assert (place / "vendor" / "uPlot.iife.min.js").stat().st_size < 60_000


@pytest.mark.slow
def test_all_jumps_are_drawn():
    """Also those of more slabs than are drawn evenly."""
    jumps = {tuple(range(1, 150)): {"x": "x + 1"}}
    problem = ro.Problem.from_strings(
        {"x": "-k*x"}, {"x": 1}, {"k": (0.1, 0.3)}, (0, 150), jumps=jumps
    )
    times = curve_times(ro.solve(problem, rtol=1e-4))
    assert {float(time) for time in range(1, 150)} <= {*times.tolist()}
