"""One solution joined of pieces, compared with closed forms."""

import pickle

import numpy as np
import pytest
import scipy

import rankone as ro

TIMES = np.array([0.0, 0.3, 2.0])
BOXES = [
    {"k": (0.5, 1.0)},
    {"k": (1.0, 5.0), "a": (1.0, 1.7)},
    {"k": (1.0, 5.0), "a": (1.7, 3.0)},
]


@pytest.fixture(scope="module")
def problem():
    """u = a exp(-k t), k uniform in its logarithm."""
    box = {"k": (0.5, 5, "log"), "a": (1, 3)}
    return ro.Problem.from_strings({"u": "-k*u"}, {"u": "a"}, box, (0, 2), name="decay")


@pytest.fixture(scope="module")
def pieces(problem):
    return ro.solve_many(problem, BOXES, 1e-8)


@pytest.fixture(scope="module")
def joined(pieces):
    return pieces.join()


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(1)
    return {"k": rng.uniform(0.5, 5, (4, 1, 50)), "a": rng.uniform(1, 3, 50)}


def exact(t, k, a):
    return a * np.exp(-k * t)


def test_values_are_those_of_the_closed_form(joined, points):
    times = TIMES[:, None]
    values = joined(times, points)
    assert values.shape == (1, 4, 3, 50)
    assert np.abs(values[0] - exact(times, **points)).max() < 1e-7
    assert joined["u"](t=1.0, k=1.0, a=1.7) == pytest.approx(exact(1.0, 1.0, 1.7), abs=1e-7)
    axes = {"k": [4.0, 0.5, 1.0], "a": [1.0, 1.7, 3.0, 2.0]}
    grid = joined.grid(t=TIMES, **axes)[0]
    on_mesh = exact(*np.meshgrid(TIMES, axes["k"], axes["a"], indexing="ij"))
    assert np.abs(grid - on_mesh).max() < 1e-7


def test_each_point_has_the_bits_of_its_piece(joined, pieces):
    point = {"k": 3.0, "a": 2.0}
    assert joined(1.0, point) == pieces[2](1.0, point)
    assert joined(1.0, {"k": 1.0, "a": 1.7}) == pieces[2](1.0, {"k": 1.0, "a": 1.7})


def test_gradient(joined, points):
    times = TIMES[:, None]
    slopes = joined.gradient(times, points)[0]
    u = exact(times, **points)
    assert np.abs(slopes[0] + times * u).max() < 1e-5
    assert np.abs(slopes[1] - u / points["a"]).max() < 1e-5


def test_error_is_that_of_the_worst_piece(joined, pieces):
    assert joined.success
    assert joined.error == max(pieces.errors)
    worst = int(np.argmax(pieces.errors))
    assert f"that of piece {worst}, the worst of 3" in joined.message
    assert [piece.parameters for piece in joined.pieces] == [p.parameters for p in pieces]


def test_statistics_are_exact(joined):
    """The mean of exp(-n k t) over a uniform logarithm is a difference of exponential integrals."""
    width = np.log(10.0)

    def mean(n):
        integral = scipy.special.exp1(0.5 * n * TIMES[1:]) - scipy.special.exp1(5 * n * TIMES[1:])
        return np.append(1.0, integral / width)

    a, a2, a3 = 2.0, 13.0 / 3.0, 10.0
    assert np.allclose(joined.mean(TIMES)[0], a * mean(1), rtol=1e-7)
    variance = a2 * mean(2) - (a * mean(1)) ** 2
    assert np.allclose(joined.var(TIMES)[0], variance, rtol=1e-6)
    assert np.allclose(joined.moment(3, TIMES, central=False)[0], a3 * mean(3), rtol=1e-6)
    sobol = joined.sobol(TIMES)
    of_k = a**2 * (mean(2) - mean(1) ** 2) / variance
    of_a = (a2 - a**2) * mean(1) ** 2 / variance
    assert np.allclose(sobol.first[0], [of_k, of_a], atol=1e-6)
    assert np.allclose(sobol.total[0], [1.0 - of_a, 1.0 - of_k], atol=1e-6)
    assert np.allclose(sobol.second[0, 0, 1], 1.0 - of_a - of_k, atol=1e-6)
    effects = joined.main_effects(TIMES, count=5)
    assert np.allclose(
        effects.means["k"][0], a * np.exp(-effects.values["k"][:, None] * TIMES), atol=1e-7
    )


def test_statistics_of_a_distribution_that_misses_a_piece(joined):
    under = {"k": scipy.stats.uniform(2, 1), "a": scipy.stats.uniform(2, 0.5)}
    mean = 2.25 * (np.exp(-2 * 0.3) - np.exp(-3 * 0.3)) / 0.3
    assert joined.mean(0.3, under=under)[0] == pytest.approx(mean, rel=1e-7)


def test_quantiles_follow_the_pieces(joined):
    quantiles = joined.quantile([0.25, 0.5], 0.0)[:, 0]
    assert np.allclose(quantiles, [1.5, 2.0], atol=2e-3)


def test_a_fit_across_pieces(joined):
    times = np.linspace(0.1, 2, 9)
    fit = joined.fit(times, exact(times, 1.02, 1.69), sigma=1e-3, start={"k": 0.7, "a": 2.5})
    assert fit.success
    assert fit.x == pytest.approx({"k": 1.02, "a": 1.69}, rel=1e-5)


@pytest.mark.parametrize("suffix", ["npz", "nc"])
def test_files_give_the_same_bits(joined, points, tmp_path, suffix):
    if suffix == "nc":
        pytest.importorskip("h5netcdf")
    path = joined.save(tmp_path / f"joined.{suffix}")
    again = ro.load(path)
    assert (again(1.0, points) == joined(1.0, points)).all()
    assert again.message == joined.message
    assert len(again.pieces) == 3
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ro.StorageError, match="damaged"):
        ro.load(path)


def test_pickle(joined, points):
    assert (pickle.loads(pickle.dumps(joined))(1.0, points) == joined(1.0, points)).all()


def test_smaller_solutions(joined):
    fixed = joined.fix(k=2.0)
    assert len(fixed.pieces) == 2
    assert fixed(1.0, a=2.5)[0] == pytest.approx(exact(1.0, 2.0, 2.5), abs=1e-7)
    assert len(joined.fix(k=0.7).pieces) == 1
    part = joined.restrict(k=(0.8, 1.5), a=(1.0, 1.2))
    assert part.parameters == {"k": (0.8, 1.5), "a": (1.0, 1.2)}
    assert part(1.0, k=1.2, a=1.1)[0] == pytest.approx(exact(1.0, 1.2, 1.1), abs=1e-7)
    at_one = joined.at(1.0)
    assert at_one(k=2.0, a=2.5)[0] == pytest.approx(exact(1.0, 2.0, 2.5), abs=1e-7)
    squares = joined.output({"q": "u**2"})
    assert squares.success
    assert squares(1.0, k=2.0, a=2.5)[0] == pytest.approx(exact(1.0, 2.0, 2.5) ** 2, abs=1e-6)


@pytest.mark.parametrize(
    "what",
    [
        lambda joined, folder: joined.to_canonical(),
        lambda joined, folder: joined.export(folder / "model.py"),
        lambda joined, folder: joined.explore(folder / "page.html"),
        lambda joined, folder: joined.timeline,
    ],
)
def test_what_takes_pieces_one_by_one(joined, what, tmp_path):
    with pytest.raises(ro.RankoneError, match="joined of pieces"):
        what(joined, tmp_path)


def test_pieces_of_different_problems(problem, pieces):
    other = ro.Problem.from_strings({"u": "-2*k*u"}, {"u": "1"}, {"k": (0, 1)}, (0, 2))
    with pytest.raises(ro.OptionError, match="pieces 0 and 1 differ in their parameters"):
        ro.Solution.join([pieces[0], ro.solve(other, 1e-4)])
    longer = ro.solve(problem, 1e-4, t_final=3)
    with pytest.raises(ro.OptionError, match="differ in their horizons"):
        ro.Solution.join([pieces[0], longer])


def test_a_single_piece_is_itself(pieces):
    assert ro.Solution.join(pieces[0]) is pieces[0]
    assert pieces[0].pieces == (pieces[0],)


def test_a_failed_piece_is_no_success(problem, pieces):
    coarse = ro.compile(problem).solve(
        1e-8, parameters={"k": (0.5, 1.0)}, max_rank=1, max_attempts=1, method="cross"
    )
    assert not coarse.success
    joined = ro.Solution.join([pieces[2], coarse, pieces[1]])
    assert not joined.success
    assert joined.error == coarse.error
    assert "no success: pieces 1 of 3" in joined.message


@pytest.mark.slow
def test_events_move_from_piece_to_piece():
    """Bouncing from heights on which the number of bounces depends."""
    problem = ro.Problem.from_strings(
        {"x": "v", "v": "-1"},
        {"x": "h", "v": "0"},
        {"h": (0.4, 1.6)},
        (0, 2),
        events=[{"when": "x", "direction": "falling", "then": {"v": "-0.5*v"}, "name": "bounce"}],
    )
    joined = ro.solve_many(problem, problem.split(h=2), 1e-5).join()
    heights = np.array([0.5, 1.5])
    assert np.allclose(joined.event_times("bounce", h=heights)[0], np.sqrt(2 * heights), atol=1e-4)
    assert (joined.end(h=heights) == 2.0).all()
    assert joined(1.8, h=1.5)[0] == pytest.approx(height(1.8, 1.5), abs=1e-4)
    even = np.linspace(0.4, 1.6, 2001)
    assert joined.mean(1.0)[0] == pytest.approx(np.mean(height(1.0, even)), abs=1e-3)


def height(t, h):
    """Height of the ball before its second bounce, for its first height."""
    bounce = np.sqrt(2 * h)
    after = 0.5 * bounce * (t - bounce) - 0.5 * (t - bounce) ** 2
    return np.where(t < bounce, h - 0.5 * t**2, after)
