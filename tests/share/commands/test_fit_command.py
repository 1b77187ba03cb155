"""``rankone fit``: files in, status and output."""

import json
import re

import numpy as np
import pytest

from rankone.share.commands.cli import main
from tests.inference.estimation.systems import DOSE_TIMES, FALL, FALL_TIMES, decay, drug, fall
from tests.inference.populations.test_doses import bolus

TIMES = np.linspace(0.1, 2.0, 10)


@pytest.fixture
def saved(tmp_path):
    return str(decay().save(tmp_path / "decay.npz"))


def table(path, header, *columns):
    rows = [",".join(map(str, row)) for row in zip(*columns)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return str(path)


def test_a_saved_solution(saved, tmp_path, capsys):
    data = table(tmp_path / "d.csv", "t,u", TIMES, 2 * np.exp(-1.3 * TIMES))
    assert main(["fit", saved, data, "--sigma", "0.01", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["x"] == {"k": pytest.approx(1.3, abs=1e-5), "a": pytest.approx(2.0, abs=1e-5)}
    assert found["success"]
    assert main(["fit", saved, data, "--sigma", "u=0.01", "--fixed", "a=2", "--start", "k=3"]) == 0
    assert re.search(r"k +1\.3", capsys.readouterr().out)


def test_empty_cells_and_columns(tmp_path, capsys):
    file = str(drug().save(tmp_path / "drug.npz"))
    person = {"V": 30.0, "Vmax": 10.0, "Km": 2.5, "k12": 0.25}
    c, p = drug()(DOSE_TIMES, person)
    cells = [value if i % 4 == 0 else "" for i, value in enumerate(p)]
    data = table(tmp_path / "d.csv", "p,note,t,c", cells, "x" * 24, DOSE_TIMES, c)
    assert main(["fit", file, data, "--sigma", "0.02", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["data"], found["observed"]) == (30, ["p", "c"])
    assert main(["fit", file, data, "--sigma", "0.02", "--observe", "c", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["data"] == 24


def test_rows_of_doses(tmp_path, capsys):
    file = str(bolus().save(tmp_path / "bolus.npz"))
    times, amounts = np.array([0.0, 1.0, 3.0, 5.0, 6.0, 8.0]), [5.0, "", 3.0, "", "", ""]
    exact = 5.0 * np.exp(-0.3 * times)
    exact[times > 3.0] += 3.0 * np.exp(-0.3 * (times[times > 3.0] - 3.0))
    cells = [value if amount == "" else "" for value, amount in zip(exact, amounts)]
    data = table(tmp_path / "d.csv", "t,amt,u", times, amounts, cells)
    assert main(["fit", file, data, "--sigma", "0.01", "--doses", "dose=amt", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["x"] == {"k": pytest.approx(0.3, abs=1e-4)}
    assert main(["fit", file, data, "--sigma", "0.01"]) == 2
    assert '--doses dose="amt"' in capsys.readouterr().err


def test_not_identified(tmp_path, capsys):
    file = str(fall().save(tmp_path / "fall.npz"))
    u = fall()["u"](FALL_TIMES, FALL) + np.random.default_rng(0).normal(0, 0.1, 20)
    data = table(tmp_path / "d.csv", "t,u", FALL_TIMES, u)
    assert main(["fit", file, data, "--sigma", "0.1", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["identifiable"] == {"C_D": False, "m": False}
    assert found["combinations"]["C_D/m"]["value"] == pytest.approx(0.5, abs=0.02)


def test_a_problem(tmp_path, capsys):
    problem = tmp_path / "p.toml"
    problem.write_text(
        "time = [0, 2]\n[rhs]\nu = '-k*u'\n[initial]\nu = 1\n[parameters]\nk = [0.5, 5]\n"
    )
    data = table(tmp_path / "d.csv", "t,u", TIMES, np.exp(-1.3 * TIMES))
    assert main(["fit", str(problem), data, "--sigma", "0.01"]) == 0
    assert re.search(r"k +1\.3", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("", [], "is empty"),
        ("hours,u\n1,2\n", [], "no column `t`"),
        ("t,w\n1,2\n", [], "no column of an unknown"),
        ("t,u\n1,2\n", ["--observe", "x"], "no unknown `x`"),
        ("t,u,u\n1,2,2\n", [], "names a column twice"),
        ("t,u\n1\n", [], "line 2: 1 cells for 2 columns"),
        ("t,u\n1,b\n", [], "row 1 of the table: `u` is 'b', not a number"),
        ("t,u\n1,2\n", ["--fixed", "k"], "write NAME=VALUE"),
        ("t,u\n1,2\n", ["--fixed", "k=1", "k=2"], "is given twice"),
        ("t,u\n1,2\n", ["--sigma", "K"], "did you mean `k`"),
        ("t,u\n1,2\n", [], "1 value for 2 parameters and sigma"),
    ],
)
def test_bad_input(saved, tmp_path, capsys, text, options, message):
    data = tmp_path / "d.csv"
    data.write_text(text)
    assert main(["fit", saved, str(data), *options]) == 2
    assert message in capsys.readouterr().err


def test_no_file(saved, capsys):
    assert main(["fit", saved, "nowhere.csv"]) == 2
    assert "cannot be read" in capsys.readouterr().err


def test_noise_bounds_and_posterior(saved, tmp_path, capsys):
    noise = 0.05 * np.random.default_rng(1).standard_normal(10)
    columns = TIMES, 3.0 * 2.0 * np.exp(-1.3 * TIMES) * (1.0 + noise)
    data = table(tmp_path / "d.csv", "t,signal", *columns)
    options = ["--observe", "signal=scale*u", "--noise", "proportional", "--fixed", "a=2"]
    more = ["--bounds", "k=0.3:3:log", "--posterior"]
    assert main(["fit", saved, data, *options, *more, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert list(answer["x"]) == ["k", "scale", "relative_signal"]
    assert answer["x"]["scale"] == pytest.approx(3.0, rel=0.1)
    low, high = answer["interval"]["k"]
    assert low < answer["x"]["k"] < high
    assert not any(answer["limits"].values())
    assert answer["posterior"]["mean"]["k"] == pytest.approx(answer["x"]["k"], rel=0.02)
    assert answer["aic"] < 0
    assert main(["fit", saved, data, *options, *more]) == 0
    text = capsys.readouterr().out
    assert "Posterior of k, scale, relative_signal" in text


def test_conditions(tmp_path, capsys):
    file = str(decay().save(tmp_path / "decay.npz"))
    rows = [(t, a * np.exp(-1.3 * t), a) for a in (1.0, 2.0) for t in TIMES]
    data = table(tmp_path / "d.csv", "t,u,a", *zip(*rows))
    assert main(["fit", file, data, "--sigma", "0.02 + 0.01*u", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["experiments"] == ["a=1", "a=2"]
    assert answer["x"] == {"k": pytest.approx(1.3, abs=1e-2)}
    assert main(["fit", file, data, "--noise", "gaussian"]) == 2
    assert "--noise gaussian is unknown" in capsys.readouterr().err
    assert main(["fit", file, data, "--bounds", "k=1"]) == 2
    assert "the bounds of `k` are (1.0,), not a pair" in capsys.readouterr().err


def test_priors(saved, tmp_path, capsys):
    """With data that say little, the estimate is close to the prior."""
    data = table(tmp_path / "d.csv", "t,u", TIMES, 2 * np.exp(-1.3 * TIMES))
    options = ["fit", saved, data, "--sigma", "0.5", "--prior"]
    assert main([*options, "k=norm(loc=1, scale=0.01)", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["x"]["k"] == pytest.approx(1.0, abs=0.005)
    for prior, message in (
        ("k", "--prior: 'k' cannot be read"),
        ("k=nrm(1, 2)", "no continuous distribution `nrm` (did you mean `norm`?)"),
        ("q=norm(1, 2)", "there is no parameter `q`"),
    ):
        assert main([*options, prior]) == 2
        assert message in capsys.readouterr().err
