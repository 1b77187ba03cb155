"""What success covers: random interior points, or the corners of the box as well."""

import pytest

import rankone as ro
from rankone.trajectories.system.verdict import MeasuredError, Status, Verdict

BOX = dict.fromkeys("abcd", (0.0, 1.0))
PRODUCTS = ro.Problem.from_strings(
    {"x": "-30*a*b*c*d*(x - cos(3.63*t))"}, {"x": "1"}, BOX, (0, 1), name="products"
)
"""Large in one corner of the box alone."""


@pytest.fixture(scope="module")
def compiled():
    return ro.compile(PRODUCTS)


def test_corners_count_where_they_are_asked_for(compiled):
    interior = compiled.solve(1e-4)
    box = compiled.solve(1e-4, cover="box")
    assert interior.success
    assert box.success
    assert interior.outcome.measured.cover == "interior"
    assert box.outcome.measured.cover == "box"
    assert box.corner_error <= box.error <= 1e-4
    assert box.outcome.measured.points > interior.outcome.measured.points


def test_few_parameters_are_covered_by_default():
    problem = ro.Problem.from_strings({"x": "-a*x"}, {"x": "1"}, {"a": (1, 2)}, (0, 1))
    compiled = ro.compile(problem)
    assert compiled.solve(1e-4).outcome.measured.cover == "box"
    assert compiled.solve(1e-4, cover="interior").outcome.measured.cover == "interior"


def test_the_message_says_what_is_covered():
    verdict = Verdict(Status.CONVERGED, None, (MeasuredError(1e-4, 1e-3, None, 3e-3),))
    assert str(verdict) == (
        f"{Status.CONVERGED.value} in the interior of the box: 1.0e-04 of 1.0e-03 "
        "(up to 3.0e-03 at the corners, which count with cover='box')"
    )


def test_an_unknown_cover_is_refused(compiled):
    with pytest.raises(ro.OptionError, match="cover='all' is not valid"):
        compiled.solve(cover="all")


def test_what_was_measured_survives_a_file(compiled, tmp_path):
    solution = compiled.solve(1e-4, cover="box")
    again = ro.load(solution.save(tmp_path / "u.npz"))
    assert again.outcome.measured == solution.outcome.measured
    measured = solution.outcome.measured
    assert measured.quantile <= solution.error
    assert len(measured.worst) == 4
    assert "95 % below" in str(solution)
