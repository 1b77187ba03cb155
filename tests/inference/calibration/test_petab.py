"""PEtab problems: the objective and its derivatives against SciPy and the package ``petab``."""

import pickle

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import rankone as ro
from tests.inference.calibration.conversion import (
    CONDITIONS,
    MODEL,
    NOMINAL,
    OBSERVABLES,
    PARAMETERS,
    YAML,
    rows,
    simulated,
    skip_without_petab,
    table,
    write,
)

skip_without_petab()
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


MEASURED = table(rows())
EVENT = """<listOfEvents><event id="halved" useValuesFromTriggerTime="true"><trigger
initialValue="false" persistent="true"><math xmlns="http://www.w3.org/1998/Math/MathML"><apply><lt/>
<ci>A</ci><cn>0.5</cn></apply></math></trigger><listOfEventAssignments><eventAssignment
variable="A"><math xmlns="http://www.w3.org/1998/Math/MathML"><cn>1</cn></math></eventAssignment>
</listOfEventAssignments></event></listOfEvents></model>"""


def with_prior(prior):
    """The table of parameters with a prior of k1."""
    header, first, *others = PARAMETERS.strip().split("\n")
    header += "\tobjectivePriorType\tobjectivePriorParameters"
    return "\n".join([header, f"{first}\t{prior}", *(f"{x}\t\t" for x in others)]) + "\n"


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write(tmp_path_factory.mktemp("petab"))


@pytest.fixture(scope="module")
def problem(file):
    return ro.read_petab(file)


def outputs(values):
    """For each measurement the observable and its noise, in closed form."""
    for name, before, condition, measured, at, *_ in rows():
        a, b = simulated(condition, before, float(at), values)
        output = {"obs_B": values["scale"] * b + 0.1, "obs_share": a / (a + b), "obs_A": a}
        noise = {"obs_B": values["sd_B"], "obs_share": values["sd_share"] + 0.01 * a, "obs_A": 0.2}
        yield name, float(measured), output[name], noise[name]


def likelihood(values):
    """Minus the log-likelihood: normal, of logarithms, and Laplace's."""
    total = 0.0
    for name, y, f, s in outputs(values):
        if name == "obs_B":
            total -= stats.norm(np.log10(f), s).logpdf(np.log10(y)) - np.log(y * np.log(10))
        elif name == "obs_A":
            total -= stats.norm(np.log(f), s).logpdf(np.log(y)) - np.log(y)
        else:
            total -= stats.laplace(f, s).logpdf(y)
    return total


def test_objective_is_that_of_petab(problem, file):
    import petab.v1 as petab

    values = {**NOMINAL, "k1": 0.3, "sd_B": 0.4, "a0": 2.0, "sd_share": 0.1}
    tables = petab.Problem.from_yaml(str(file))
    measured, parameters = tables.measurement_df, tables.parameter_df.copy()
    parameters["nominalValue"] = pd.Series(values)
    simulation = measured.rename(columns={"measurement": "simulation"})
    simulation["simulation"] = [f for _, _, f, _ in outputs(values)]
    observables = tables.observable_df.copy()
    observables["noiseFormula"] = observables["noiseFormula"].str.replace(" A", " obs_A")
    with_observables = measured["observableId"] != "obs_share"  # its noise depends on a state
    wanted = -petab.calculate_llh(
        measured[with_observables], simulation[with_observables], observables, parameters
    )
    wanted += sum(
        np.log(2.0 * s) + abs(f - y) / s for name, y, f, s in outputs(values) if name == "obs_share"
    )
    assert problem.objective(values) == pytest.approx(wanted, rel=1e-8)
    assert likelihood(values) == pytest.approx(wanted, rel=1e-12)


def test_derivatives_match_differences_of_the_likelihood(problem):
    evaluation, step = problem.evaluate(), 1e-3
    assert evaluation.parameters == ("k1", "k2", "a0", "scale", "sd_B")
    assert evaluation.objective == pytest.approx(problem.objective(), rel=1e-12)
    assert evaluation.objective == pytest.approx(likelihood(NOMINAL), rel=1e-8)
    np.testing.assert_allclose(
        evaluation.gradient, evaluation.jacobian.T @ evaluation.residuals, rtol=1e-12
    )
    for name, slope in zip(evaluation.parameters, evaluation.gradient):
        parameter = problem.parameters[name]
        coordinates = [parameter.scaled(NOMINAL[name]) + k * step for k in (-2, -1, 1, 2)]
        far, near, ahead, beyond = (
            likelihood({**NOMINAL, name: parameter.value(z)}) for z in coordinates
        )
        difference = (8 * (ahead - near) - beyond + far) / (12 * step)
        assert slope == pytest.approx(difference, rel=1e-6, abs=1e-6)


def test_jacobian_is_that_of_the_residuals(problem):
    """Of normal noise: those of Laplace's are signs."""
    k1, step = problem.parameters["k1"], 1e-4
    here = problem.evaluate()
    ahead, behind = (
        problem.evaluate({"k1": k1.value(k1.scaled(0.8) + h)}).residuals for h in (step, -step)
    )
    m = (problem.measurements["observableId"] == "obs_B").sum()
    difference = (ahead[:m] - behind[:m]) / (2 * step)
    np.testing.assert_allclose(here.jacobian[:m, 0], difference, rtol=1e-6, atol=1e-6)
    assert len(here.residuals) == 2 * len(here.standardised)


def test_priors_add_minus_the_logarithm_of_their_density(problem, tmp_path):
    header, *lines = PARAMETERS.strip().split("\n")
    kinds = {
        "k1": "parameterScaleNormal\t0;0.5",
        "k2": "logNormal\t-1;0.3",
        "a0": "normal\t2;0.4",
        "scale": "laplace\t1;0.5",
    }
    header += "\tobjectivePriorType\tobjectivePriorParameters"
    rows_ = [f"{line}\t{kinds.get(line.split()[0], chr(9))}" for line in lines]
    with_priors = ro.read_petab(write(tmp_path, parameters="\n".join([header, *rows_]) + "\n"))
    densities = [
        stats.norm(0, 0.5).logpdf(np.log10(0.8)),
        stats.lognorm(0.3, scale=np.exp(-1)).logpdf(0.6),
        stats.norm(2, 0.4).logpdf(1.5),
        stats.laplace(1, 0.5).logpdf(2.0),
    ]
    without = problem.objective()
    assert with_priors.objective() == pytest.approx(without - sum(densities), rel=1e-10)
    evaluation, step = with_priors.evaluate(), 1e-4
    for name, slope in zip(evaluation.parameters, evaluation.gradient):
        parameter = with_priors.parameters[name]
        ahead, behind = (
            with_priors.objective({name: parameter.value(parameter.scaled(parameter.nominal) + h)})
            for h in (step, -step)
        )
        assert slope == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-4)


def test_a_condition_sets_a_species(problem, tmp_path):
    """B at the start in place of what the file gives, and in place of the steady state."""
    table = "conditionId\tdose\tB\nrest\t0\t\nlow\t0.5\t\nhigh\t3\t0.9\n"
    changed = ro.read_petab(write(tmp_path, conditions=table)).evaluate().standardised
    plain = problem.evaluate().standardised
    measured = problem.measurements
    high = (measured["simulationConditionId"] == "high").to_numpy()
    np.testing.assert_allclose(changed[~high], plain[~high], rtol=1e-8, atol=1e-10)
    start = high & (measured["time"] == 0.0).to_numpy() & (measured["observableId"] == "obs_B")
    wanted = (np.log10(2.0 * 0.9 + 0.1) - np.log10(measured["measurement"][start])) / 0.1
    np.testing.assert_allclose(changed[start], wanted, rtol=1e-10)


def test_a_dose_after_a_lag_and_a_species_set_in_all_conditions(tmp_path):
    """No file has a number for A, and rates jump at a time that is a parameter."""
    pieces = "<piecewise><piece><ci>dose</ci><apply><geq/>{}<ci>lag</ci></apply></piece>{}"
    time = (
        '<csymbol encoding="text" definitionURL="http://www.sbml.org/sbml/symbols/time">time'
        "</csymbol>"
    )
    late = pieces.format(time, "<otherwise><cn>0</cn></otherwise></piecewise>")
    lag = '<parameter id="lag" value="9" constant="true"/><parameter id="dose"'
    model = MODEL.replace("<ci>dose</ci>", late).replace('<parameter id="dose"', lag)
    files = {
        "model": model,
        "parameters": "\n".join(PARAMETERS.split("\n")[:3]) + "\nlag\tlin\t0\t2\t0.7\t0\n",
        "conditions": "conditionId\tdose\tA\tB\nlow\t0.5\t1.5\t0.2\n",
        "observables": "observableId\tobservableFormula\tnoiseFormula\nobs_A\tA\t1\n",
        "measurements": table([("obs_A", "", "low", "0", at, "", "") for at in ("0.5", "2")]),
    }
    problem = ro.read_petab(write(tmp_path, **files))

    def amount(k1, k2):
        a, b = 1.5, 1.7 * k2 / (k1 + k2)
        early = [b + (a - b) * np.exp(-(k1 + k2) * t) for t in (0.5, 0.7)]
        rest = 1.7 * k2 / (k1 + 0.5 + k2)
        return early[0], rest + (early[1] - rest) * np.exp(-(k1 + 0.5 + k2) * 1.3)

    at = problem.evaluate()
    np.testing.assert_allclose(at.standardised, amount(0.8, 0.6), rtol=1e-8)
    step = 1e-5
    difference = np.subtract(amount(0.8 * 10**step, 0.6), amount(0.8 / 10**step, 0.6)) / (2 * step)
    np.testing.assert_allclose(at.jacobian[:2, 0], difference, rtol=1e-6)
    files["parameters"] = files["parameters"].replace("0.7\t0", "0.7\t1")
    estimated = ro.read_petab(write(tmp_path, **files))
    with pytest.raises(ro.ProblemError, match="rates jump where `lag` says"):
        estimated.evaluate()
    with pytest.raises(ro.ProblemError, match="rates jump where `lag` says"):
        estimated.fit(starts=1)


def test_text(problem):
    assert repr(problem).splitlines()[0] == (
        "CalibrationProblem conversion: 2 experiments, 27 measurements of 3 observables, "
        "5 of 6 parameters to estimate"
    )
    assert "<table" in problem._repr_html_()


def test_pickles(problem):
    problem.objective()  # compiled parts are left out
    copied = pickle.loads(pickle.dumps(problem))
    assert copied.objective({"k1": 0.3}) == problem.objective({"k1": 0.3})


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"conditions": CONDITIONS.replace("dose", "doze")}, "doze"),
        ({"observables": OBSERVABLES.replace("A / (A", "C / (A")}, "`C`|C"),
        (
            {"observables": OBSERVABLES.replace("0.01 * A", "piecewise(1, A > 1, 2)")},
            "row `obs_share`",
        ),
        ({"parameters": PARAMETERS.replace("k2\tlog\t", "k2\troot\t")}, "root"),
        ({"model": MODEL.replace("<model", "<modell")}, "conversion.yaml"),
        ({"measurements": MEASURED.split("\n")[0] + "\n"}, "measurement table has no rows|valid"),
        ({"measurements": MEASURED.replace("\t0.5\t", "\t-0.5\t", 1)}, "row 4: the time -0.5"),
        ({"conditions": "conditionId\tdose\tcell\nrest\t0\t2\nlow\t1\t2\nhigh\t3\t1\n"}, "`cell`"),
        ({"conversion": YAML.replace("format_version: 1", "format_version: 2.0.0")}, "2.0.0"),
        ({"conversion": ""}, "format_version"),
        ({"model": MODEL.replace("</model>", EVENT)}, "has 1 event, `halved`"),
        ({"conditions": CONDITIONS.replace("3\n", "\n").replace("0\n", "-9\n")}, "steady state"),
        ({"measurements": table([(*rows()[0][:3], "inf", *rows()[0][4:])])}, "row 1.* is inf"),
        ({"parameters": with_prior("uniform\t2;1")}, "prior of `k1` the parameters `2;1`"),
        ({"parameters": with_prior("normal\t1;0")}, "prior of `k1` the parameters `1;0`"),
    ],
)
def test_faults_are_named(tmp_path, files, message):
    with pytest.raises(ro.RankoneError, match=message):
        ro.read_petab(write(tmp_path, **files)).objective()


def test_a_mapping_table_is_refused(tmp_path):
    (tmp_path / "mapping.tsv").write_text("petabEntityId\tmodelEntityId\nA_\tA\n")
    files = YAML.rstrip() + "\n  mapping_files: [mapping.tsv]\n"
    with pytest.raises(ro.ProblemError, match="mapping"):
        ro.read_petab(write(tmp_path, conversion=files))


def test_values(problem):
    with pytest.raises(ro.OptionError, match="no parameter `k3`"):
        problem.objective({"k3": 1.0})
    with pytest.raises(ro.OptionError, match="not a mapping"):
        problem.objective([1.0])
    with pytest.raises(ro.ProblemError, match="noise of `obs_B` is -1 at row 1"):
        problem.objective({"sd_B": -1.0})
    with pytest.raises(ro.EvaluationError, match=r"`obs_B` is -.* has no logarithm, at row"):
        problem.objective({"scale": -1.0})
    with pytest.raises(ro.OptionError, match="`k1` is inf, not a finite number"):
        problem.objective({"k1": float("inf")})
    with pytest.raises(ro.ProblemError, match="there is no file"):
        ro.read_petab("nowhere.yaml")


def test_the_package_is_asked_for(file, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "petab.v1", None)
    with pytest.raises(ro.ProblemError, match=r"pip install petab"):
        ro.read_petab(file)


@pytest.mark.slow
def test_workers_take_starts_and_change_no_bit(problem):
    here, there = problem.fit(starts=1), problem.fit(starts=1, executor=1)
    assert there.x == here.x
    assert there.log_likelihood == here.log_likelihood
