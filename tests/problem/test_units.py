"""Units: what may be said, and where it is carried."""

import pickle

import pytest
import sympy as sp

import rankone as ro
from rankone.share.commands.common import load_problem
from rankone.solvers.outcome import per
from rankone.support.errors import ProblemError

t, k, m = sp.symbols("t k m")
x = sp.Function("x")(t)


def oscillator(units):
    equation = sp.Eq(m * x.diff(t, 2), -k * x)
    return ro.Problem(
        [equation], (t, 0, 1), {k: (1, 2), m: (1, 2)}, {x: 1, x.diff(t): 0}, units=units
    )


def test_by_symbols_functions_and_names():
    expected = {"t": "s", "k": "N/m", "x": "m", "x_t": "m/s"}
    for units in ({x: "m", t: "s", k: "N/m"}, {"k": "N/m", "x": " m ", "t": "s"}):
        problem = oscillator(units)
        assert list(problem.units.items()) == list(expected.items())
        assert dict(pickle.loads(pickle.dumps(problem)).units) == expected
    assert dict(oscillator(None).units) == {}
    assert dict(oscillator({x: "m"}).units) == {"x": "m"}
    own = oscillator({x: "m", t: "s", x.diff(t): "knots"})
    assert own.units["x_t"] == "knots"


def test_they_are_shown():
    text = str(oscillator({x: "m", t: "s", k: "N/m"}))
    assert "  t in [0, 1] s, k in [1, 2] N/m, m in [1, 2]\n  x in m, x_t in m/s" in text


@pytest.mark.parametrize(
    ("unit", "by", "times", "expected"),
    [
        ("m", "s", 1, "m/s"),
        ("m", "s", 2, "m/s^2"),
        ("m", "1", 2, "m"),
        ("1", "h", 1, "1/h"),
        ("m/s", "1/s", 1, "(m/s)/(1/s)"),
        ("kg m", "s", 1, "(kg m)/s"),
        ("µmol", "°C", 1, "µmol/°C"),
    ],
)
def test_units_of_derivatives(unit, by, times, expected):
    assert per(unit, by, times) == expected


@pytest.mark.parametrize(
    ("units", "message"),
    [
        ({"z": "m"}, "units has `z`, which is neither time nor a parameter nor an unknown"),
        ({"xt": "m"}, r"did you mean `x_t`\?"),
        ({x: 3}, r"the unit of `x` is 3, not a text in one line; remedy: write it like"),
        ({x: ""}, "not a text in one line"),
        ({x: "a\nb"}, "not a text in one line"),
        ({x: "\ud800"}, "not a text in one line"),
        ({x: "m", "x": "m"}, "the unit of `x` is given twice"),
        ({5: "m"}, "units: `5` is not a name"),
        ({x.subs(t, 2): "m"}, "is not a name, a symbol or a function of `t`"),
        (["m"], r"units are \['m'\], not a mapping"),
    ],
)
def test_what_is_refused(units, message):
    with pytest.raises(ProblemError, match=message):
        oscillator(units)


def test_from_strings():
    problem = ro.Problem.from_strings(
        {"x": "-\u00b5*x"}, {"x": 1}, {"\u03bc": (1, 2)}, (0, 1), units={"\u00b5": "1/s", "t": "s"}
    )
    assert dict(problem.units) == {"t": "s", "\u03bc": "1/s"}


def toml(tmp_path, units):
    path = tmp_path / "decay.toml"
    path.write_text(
        'time = [0, 1]\n[rhs]\nu = "-k*u"\n[initial]\nu = 1\n[parameters]\nk = [1, 2]\n' + units
    )
    return load_problem(path)


def test_from_a_file(tmp_path):
    problem = toml(tmp_path, '[units]\nu = "kg"\nt = "s"\n')
    assert dict(problem.units) == {"t": "s", "u": "kg"}
    for units, message in (
        ("[units]\nu = 3\n", "the unit of `u` is 3"),
        ('[units]\nv = "kg"\n', "units has `v`"),
        ("[[units]]\n", "not a table"),
    ):
        with pytest.raises(ProblemError, match=message):
            toml(tmp_path, units)


def test_a_solution_has_them(tmp_path):
    solution = ro.solve(oscillator({x: "m", t: "s", k: "N/m", m: "kg"}), rtol=1e-3)
    units = {"t": "s", "k": "N/m", "m": "kg", "x": "m", "x_t": "m/s"}
    assert dict(solution.metadata.units) == units
    assert "unknowns  x [m]" in repr(solution)
    assert "t in [0, 1] s, k in [1, 2] N/m, m in [1, 2] kg" in repr(solution)
    assert "x [m]" in solution._repr_html_()
    assert dict(solution.restrict(k=(1, 1.5)).metadata.units) == units
    assert dict(solution.fix(k=1).metadata.units) == {n: u for n, u in units.items() if n != "k"}
    assert dict(solution.at(0.5).metadata.units) == units
    slope = dict(solution.diff(k).metadata.units)
    assert (slope["x"], slope["x_t"], slope["k"]) == ("m/(N/m)", "(m/s)/(N/m)", "N/m")
    assert dict(solution.diff(t).metadata.units)["x"] == "m/s"
    for name in ("u.npz", "u.nc"):
        assert dict(ro.load(solution.save(tmp_path / name)).metadata.units) == units
    for name in ("u.py", "u.h"):
        solution.export((tmp_path / name).with_suffix({"u.py": ".py", "u.h": ".c"}[name]))
        text = (tmp_path / name).read_text()
        assert "k in [1.0, 2.0] N/m" in text
        assert "x in m" in text


def test_a_derivative_by_what_has_no_unit_has_none():
    solution = ro.solve(oscillator({x: "m", t: "s"}), rtol=1e-3)
    assert dict(solution.diff(k).metadata.units) == {"t": "s"}


def test_labels():
    xarray = pytest.importorskip("xarray")
    solution = ro.solve(oscillator({x: "m", k: "N/m"}), rtol=1e-3)
    data = solution.to_xarray(k=[1, 2], m=1)
    assert isinstance(data, xarray.Dataset)
    assert data.x.attrs["units"] == "m"
    assert data.k.attrs == {"long_name": "k", "units": "N/m"}
    assert "units" not in data.t.attrs
