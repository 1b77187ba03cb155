"""Pages of fields have the numbers of Python, and pictures have them where they belong."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import rankone as ro
from rankone.share.export.pages import joined_scripts
from rankone.solution.fields.field_solution import FieldSolution
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.errors import ExportError, OptionError
from rankone.trajectories.fields.field_system import Unknown
from tests.share.export.browser import NoBrowserError, browser, settle
from tests.share.export.node import needs_node, run_node
from tests.solution.fields.small_fields import N, coefficients, orthonormal_modes, small_fields

EXPLORER = Path(ro.__file__).parent / "share" / "export" / "explorer"
AT = {"t": 0.4, "k": 1.3, "s": 0.7}
X, Y = np.linspace(0.0, 2.0, 10), np.linspace(1.0, 2.0, 6)
SINGLE = np.finfo(np.float32).eps / 2


@pytest.fixture(scope="module")
def chromium():
    try:
        with browser() as found:
            yield found
    except NoBrowserError as reason:
        pytest.skip(str(reason))


@cache
def solution():
    return small_fields()


@cache
def body(n=12):
    """A body whose places move by a field with x and y in turn, and a scalar unknown."""
    unknowns = (Unknown("u", 0, 2 * n), Unknown("w", 2 * n, 1, is_field=False))
    modes = (orthonormal_modes(2 * n), np.ones((1, 1)))
    scales, errors = (5.0, 1.0), (2e-5, 1e-6)
    return FieldSolution(coefficients(), FieldModes(unknowns, modes, scales, errors, 12))


def strip(n=12):
    """Places of two rows, and triangles between them."""
    x = np.repeat(np.arange(n // 2, dtype=float), 2)
    places = np.stack([x, np.tile([0.0, 1.0], n // 2)], axis=1)
    return places, [[i, i + 1, i + 2] for i in range(n - 2)]


def data_of(path):
    """What the page has from Python."""
    text = path.read_text()
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])


def single_precision_error(solution, name, at):
    """How much the rounding of modes changes each entry by at most."""
    position = solution.unknowns.index(name)
    own = solution.coefficients(at)[solution.modes.coefficients_of(position)]
    return SINGLE * np.abs(solution.modes_of(name)) @ np.abs(own) + 1e-9 * np.abs(own).max()


# --- numbers, in Node ----------------------------------------------------------------------------


def entries_in_page(path, folder):
    """The entries that the scripts of a page make of its data, without its parts that draw."""
    text = path.read_text()
    model = re.search(r"^const model = .*?^\}\)\(\);$", text, re.S | re.M)[0]
    content = json.dumps(re.search(r'id="data">(.*?)</script>', text, re.S)[1])
    file = folder / "entries.mjs"
    file.write_text(
        f"const document = {{ getElementById: () => ({{ textContent: {content} }}) }};\n"
        f"{model}\n{joined_scripts(['state', 'fields'])}\n"
        f"state.p.set([{AT['k']}, {AT['s']}]);\nstate.time = {AT['t']};\nevaluateFields(true);\n"
        "console.log(JSON.stringify({\n"
        "  entries: state.entries.map((own) => [...own]),\n"
        "  values: [...state.values],\n"
        "  curves: state.curves.map((own) => [...own]),\n"
        "  pictures: data.pictures.map((picture) => [...numbersIn(picture)]),\n"
        "}));\n"
    )
    return json.loads(run_node(file))


@needs_node
def test_numbers_are_those_of_python(tmp_path):
    path = solution().explore(tmp_path / "page.html", coordinates={"x": X, "y": Y})
    shown = entries_in_page(path, tmp_path)
    difference = np.abs(shown["entries"][0] - solution()["u"](**AT))
    assert np.all(difference <= single_precision_error(solution(), "u", AT))
    assert shown["values"] == [pytest.approx(float(solution()["w"](**AT)), rel=1e-10)]
    times = np.array(data_of(path)["times"])
    curve = solution()["w"](t=times, k=AT["k"], s=AT["s"])
    np.testing.assert_allclose(shown["curves"][0], curve, atol=1e-10)


@needs_node
def test_lengths_of_a_displacement(tmp_path):
    fields, (places, triangles) = body(), strip()
    u = fields["u"]
    path = fields.explore(
        tmp_path / "body.html",
        places=places,
        triangles=triangles,
        displacement=(u[0::2], u[1::2]),
    )
    shown = entries_in_page(path, tmp_path)
    moves = u(**AT).reshape(-1, 2)
    assert [p["text"] for p in data_of(path)["pictures"]] == ["displacement", "u"]
    np.testing.assert_allclose(shown["pictures"][0], np.hypot(*moves.T), rtol=1e-5)
    np.testing.assert_allclose(shown["pictures"][1], u(**AT), atol=1e-5)


def run_scripts(folder, names, text):
    file = folder / "scripts.mjs"
    file.write_text(f"{joined_scripts(names)}\n{text}")
    return json.loads(run_node(file))


@needs_node
def test_cells_are_where_their_coordinates_are(tmp_path):
    """Entry i * len(y) + j at x[i], y[j], with y upwards; also along an axis that descends."""
    shown = run_scripts(
        tmp_path,
        ["raster"],
        """
const image = (ranges, width, height) =>
  ({ pixels: new Uint32Array(width * height), width, height, ranges });
const painted = (x, y, ranges, width, height) => {
  const one = image(ranges, width, height);
  const values = [...Array(x.length * y.length).keys()];
  paintCells(one, [bordersOf(x), bordersOf(y)], values, (value) => value + 1);
  return [...one.pixels];
};
console.log(JSON.stringify({
  plain: painted([0, 1, 2], [0, 1], [[-0.5, 2.5], [-0.5, 1.5]], 3, 2),
  down: painted([2, 1, 0], [1, 0], [[-0.5, 2.5], [-0.5, 1.5]], 3, 2),
  uneven: painted([0, 1, 5], [0], [[-1.2, 7.8], [-0.5, 0.5]], 9, 1),
}));
""",
    )
    assert shown["plain"] == [2, 4, 6, 1, 3, 5]
    assert shown["down"] == [5, 3, 1, 6, 4, 2]
    # borders are at -0.5, 0.5, 3 and 7
    assert shown["uneven"] == [0, 1, 2, 2, 3, 3, 3, 3, 0]


@needs_node
def test_triangles_are_linear_and_points_round(tmp_path):
    shown = run_scripts(
        tmp_path,
        ["raster"],
        """
const size = 40;
const shape = { width: size, height: size, ranges: [[0, 1], [0, 1]] };
const image = () => ({ ...shape, pixels: new Uint32Array(size * size) });
const square = image();
const places = [[0, 1, 0, 1], [0, 0, 1, 1]];
const corners = [0, 1, 2, 1, 3, 2];
paintTriangles(square, places, corners, [0, 100, 1000, 1100], (v) => 1 + Math.round(100 * v));
const points = image();
paintPoints(points, [[0.5, 0], [0.5, 0]], 5, [1, 2], (value) => value);
console.log(JSON.stringify({ square: [...square.pixels], points: [...points.pixels] }));
""",
    )
    square = np.array(shown["square"]).reshape(40, 40)[::-1]
    middles = (np.arange(40) + 0.5) / 40
    wanted = 1 + 100 * (100 * middles[None, :] + 1000 * middles[:, None])
    np.testing.assert_allclose(square, wanted, atol=1)
    points = np.array(shown["points"]).reshape(40, 40)
    rows, columns = np.nonzero(points == 1)
    assert np.hypot(rows - 19.5, columns - 19.5).max() <= 5
    assert rows.size == pytest.approx(np.pi * 25, rel=0.1)
    assert np.all(points[-3:, :3] == 2)


@needs_node
def test_equal_steps_of_colours_look_equally_far_apart(tmp_path):
    """By their distances in OKLab, up to the rounding of colours to bytes; and ends are clipped."""
    shown = run_scripts(
        tmp_path,
        ["palette"],
        """
const shade = shades([2, 4]);
console.log(JSON.stringify({ colours, ends: [1, 2, 4, 9].map(shade), same: shades([3, 3])(3) }));
""",
    )
    lab = np.array([oklab(rgb) for rgb in shown["colours"]])
    steps = np.linalg.norm(np.diff(lab[::51], axis=0), axis=1)
    assert steps.max() <= 1.1 * steps.min()
    assert np.all(np.diff(lab[::5, 0]) > 0.0)
    assert lab[0, 0] > 0.4  # lighter than a dark page
    assert lab[-1, 0] < 0.95  # darker than a light one
    assert shown["ends"][0] == shown["ends"][1]
    assert shown["ends"][2] == shown["ends"][3]
    assert isinstance(shown["same"], int)


def oklab(rgb):
    """Lightness and opponent colours of sRGB, by matrices of the paper that palette.js cites."""
    x = np.array(rgb) / 255
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    to_cones = [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
    to_lab = [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
    return np.array(to_lab) @ np.cbrt(np.array(to_cones) @ linear)


# --- what Python writes --------------------------------------------------------------------------


def test_ranges_cover_the_box(tmp_path):
    """Corners of the box are among the sample, with both ends of time."""
    path = solution().explore(tmp_path / "page.html")
    picture, *_ = data_of(path)["pictures"]
    grid = solution()["u"].grid(t=[0.0, 0.5, 1.0], k=[0.5, 2.0], s=[0.5, 1.5])
    least, most = picture["range"]
    assert least <= grid.min()
    assert most >= grid.max()
    assert most - least < 1.5 * np.ptp(grid)


@pytest.mark.parametrize(
    ("layout", "kind"),
    [
        ({}, "line"),
        ({"coordinates": {"x": np.linspace(0, 1, N)}}, "line"),
        ({"coordinates": {"x": X, "y": Y}}, "plane"),
        ({"places": np.random.default_rng(1).random((N, 2))}, "mesh"),
        ({"coordinates": {"x": np.random.default_rng(1).random(N)}}, "line"),
        ({"coordinates": {"x": ("entry", np.arange(N)), "y": ("entry", np.ones(N))}}, "mesh"),
        ({"coordinates": {"a": np.arange(N), "b": np.ones(N)}, "triangles": [[0, 1, 2]]}, "mesh"),
    ],
)
def test_layouts(tmp_path, layout, kind):
    data = data_of(solution().explore(tmp_path / "page.html", **layout))
    assert [each["kind"] for each in data["layouts"]] == [kind]
    assert [(p["text"], p["field"], p["layout"]) for p in data["pictures"]] == [("u", 0, 0)]
    assert [unknown["name"] for unknown in data["unknowns"]] == ["w"]


def test_extents_hold_what_moves(tmp_path):
    fields, (places, _) = body(), strip()
    u = fields["u"]
    moves = (u[0::2], u[1::2])
    path = fields.explore(tmp_path / "body.html", places=places, displacement=moves)
    (layout, _), picture = data_of(path)["layouts"], data_of(path)["pictures"][0]
    for axis, view, (least, most) in zip(places.T, moves, layout["extents"], strict=True):
        moved = axis[:, None] + view(t=np.linspace(0.0, 1.0, 5), k=0.5, s=1.5)
        assert least <= moved.min()
        assert most >= moved.max()
    assert picture["range"][0] == 0.0
    assert picture["text"] == "displacement"


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ({"coordinates": {"x": X, "y": X}}, "10 x 10 = 100 points, and the field has 60 entries"),
        ({"coordinates": {"x": X}}, "grid of `x` has 10 points, and the field has 60 entries"),
        ({"coordinates": {"x": X, "y": Y, "z": [0.0]}}, "3 coordinates, `x`, `y` and `z`"),
        ({"coordinates": {"x": X * 0, "y": Y}}, "`x` neither ascends nor descends"),
        ({"coordinates": {"x": [X], "y": Y}}, r"`x` has the shape \(1, 10\)"),
        ({"coordinates": {"x": X + np.nan, "y": Y}}, "`x` has entries that are not finite"),
        ({"coordinates": {"x": "wide", "y": Y}}, "`x` is .*wide.*, not an array of numbers"),
        ({"coordinates": [X, Y]}, "is not a mapping"),
        ({"coordinates": {"x": ("entry", X), "y": Y}}, "only some are by entry"),
        ({"coordinates": {"x": ("entry", X), "y": ("entry", X)}}, "10 places, and the field"),
        ({"coordinates": {"x": X, "y": Y}, "triangles": [[0, 1, 2]]}, "triangles needs places"),
        ({"places": np.ones((59, 2))}, "59 places, and the field has 60 entries"),
        ({"places": np.ones((60, 3))}, r"places has the shape \(60, 3\)"),
        ({"places": np.ones(60)}, r"places has the shape \(60,\)"),
        ({"places": np.ones((60, 2)), "coordinates": {"x": X, "y": Y}}, "two layouts"),
        ({"triangles": [[0, 1, 2]]}, "triangles needs places"),
        ({"displacement": ("u", "u")}, "displacement needs places"),
        ({"places": np.ones((60, 2)), "triangles": [[0, 1, 60]]}, "place 60, and there are 60"),
        ({"places": np.ones((60, 2)), "triangles": [[0, -1, 2]]}, "place -1"),
        ({"places": np.ones((60, 2)), "triangles": [[0, 1]]}, r"triangles has the shape \(1, 2\)"),
        ({"places": np.ones((60, 2)), "triangles": [[0.0, 1.0, 2.0]]}, "float64"),
        (
            {"places": np.ones((60, 2)), "displacement": ("u", "v")},
            "displacement: .*no unknown `v`",
        ),
        ({"places": np.ones((60, 2)), "displacement": ("u", "w")}, r"solution\[w\] has the shape"),
        ({"places": np.ones((60, 2)), "displacement": ("u",)}, "displacement has 1 unknown"),
        ({"places": np.ones((60, 2)), "displacement": "u"}, "is one unknown"),
    ],
)
def test_layouts_that_do_not_fit_are_errors(tmp_path, layout, message):
    with pytest.raises(OptionError, match=message):
        solution().explore(tmp_path / "page.html", **layout)
    assert not [*tmp_path.iterdir()]


def test_views_of_another_solution_are_refused(tmp_path):
    places, _ = strip()
    u = body().fix(k=1.0)["u"]
    with pytest.raises(OptionError, match=r"solution\[u\] is a view of another solution"):
        body().explore(tmp_path / "p.html", places=places, displacement=(u[0::2], u[1::2]))


def test_options_are_those_of_other_pages(tmp_path):
    path = solution().explore(tmp_path / "page.html", title="Heat & more")
    assert "<title>Heat &amp; more</title>" in path.read_text()
    with pytest.raises(ExportError, match="exists"):
        solution().explore(path)
    with pytest.raises(ExportError, match=r"suffix \.html"):
        solution().explore(tmp_path / "page.txt")
    with pytest.raises(OptionError, match="title=3"):
        solution().explore(path, title=3, overwrite=True)
    with pytest.raises(ExportError, match="do not depend on time"):
        solution().at(0.5).explore(path, overwrite=True)
    failed = replace(solution(), status=ro.Status.TOLERANCE)
    with pytest.raises(ExportError, match="not a success"):
        failed.explore(path, overwrite=True)
    failed.explore(path, overwrite=True, allow_failed=True)
    assert "This solution is not a success" in path.read_text()
    smaller = solution().explore(tmp_path / "smaller.html", rtol=1e-3)
    assert "made smaller to within" in smaller.read_text()


def test_fields_that_were_not_measured_and_those_without_parameters(tmp_path):
    path = small_fields(errors=()).fix(k=1.0, s=1.0).explore(tmp_path / "p.html", allow_failed=True)
    data = data_of(path)
    assert "Error not measured" in path.read_text()
    assert data["parameters"] == []
    assert data["pictures"][0]["error"] is None


def test_fields_that_stay_zero(tmp_path):
    zero = replace(solution().modes, scales=(0.0, 0.0), modes=(np.zeros((N, 4)), np.zeros((1, 1))))
    data = data_of(replace(solution(), modes=zero).explore(tmp_path / "page.html"))
    assert data["time"]["start"] == 0.0
    assert data["pictures"][0]["range"] == [0.0, 0.0]


# --- in a browser --------------------------------------------------------------------------------


def test_pictures_follow_the_sliders(chromium, tmp_path):
    path = solution().explore(tmp_path / "page.html", coordinates={"x": X, "y": Y})
    with chromium.open(path) as page:
        slider = page.locator("#parameters input[type=range]").first
        slider.focus()
        page.keyboard.press("End")
        page.evaluate("rankone.set({t: 0.75})")
        settle(page)
        shown = page.evaluate("rankone.values()")
        at = {"t": 0.75, **shown["parameters"]}
        assert at["k"] == 2.0
        wanted = solution()["u"](**at)
        difference = np.abs(np.array(shown["fields"]["u"]) - wanted)
        assert np.all(difference <= single_precision_error(solution(), "u", at))
        least, most = (number(x) for x in extremes(page))
        assert least == pytest.approx(wanted.min(), rel=1e-3)
        assert most == pytest.approx(wanted.max(), rel=1e-3)
        page.wait_for_timeout(1000)
        assert page.locator("#said").inner_text() == page.locator("#extremes").inner_text()
        assert pixel(page, 0.05, 0.95) == colour_of(wanted[0], shown["range"], page)
        assert pixel(page, 0.95, 0.05) == colour_of(wanted[-1], shown["range"], page)


def extremes(page):
    text = page.locator("#picture").get_attribute("aria-label")
    assert text.startswith("Colours of u over x and y: u from ")
    return re.search(r": u from (\S+) to (\S+) at t", text).groups()


def number(text):
    return float(text.replace("−", "-"))


READ = """(canvas, x, y) => {
  const copy = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, -Math.round(x), -Math.round(y));
  return [...copy.getImageData(0, 0, 1, 1).data].slice(0, 3);
}"""


def pixel(page, across, down):
    """The colour of the picture at shares of its plot from the left and from the top."""
    return page.evaluate(
        f"""([across, down]) => {{
          const over = document.querySelector("#picture .u-over").getBoundingClientRect();
          const canvas = document.querySelector("#picture canvas");
          const box = canvas.getBoundingClientRect();
          const x = over.left - box.left + across * over.width;
          const y = over.top - box.top + down * over.height;
          const scale = canvas.width / box.width;
          return ({READ})(canvas, x * scale, y * scale);
        }}""",
        [across, down],
    )


def colour_of(value, ends, page):
    """What the bar of colours has for a value."""
    share = (value - ends[0]) / (ends[1] - ends[0])
    return page.evaluate(
        f"""(share) => {{
          const bar = document.getElementById("bar");
          return ({READ})(bar, share * (bar.width - 1), 0);
        }}""",
        share,
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_a_body_moves_while_time_goes_on(chromium, tmp_path, width, scheme):
    fields, (places, triangles) = body(), strip()
    u = fields["u"]
    moves = (u[0::2], u[1::2])
    path = fields.explore(
        tmp_path / "body.html", places=places, triangles=triangles, displacement=moves
    )
    with chromium.open(path, width=width, scheme=scheme) as page:
        page.evaluate("rankone.set({t: 0})")
        settle(page)
        before = page.locator("#picture canvas").screenshot()
        page.locator("#play").click()
        page.wait_for_timeout(400)
        page.locator("#play").click()
        settle(page)
        assert page.evaluate("rankone.values().time") > 0.0
        assert page.locator("#picture canvas").screenshot() != before
        assert page.evaluate("document.documentElement.scrollWidth") == width
        page.locator("#shown").select_option("u")
        settle(page)
        assert page.evaluate("rankone.values().picture") == "u"
        assert not page.locator("#colours").is_visible()
        assert page.locator("#picture").get_attribute("aria-label").startswith("Curve of u over e")
