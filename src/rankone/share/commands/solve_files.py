"""``rankone solve``, ``show`` and ``fit``: what is done with a problem."""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rankone.share.commands.common import (
    FAILURE,
    MODEL_HELP,
    PAIRS,
    SOLVED_HELP,
    SUCCESS,
    Commands,
    add_command,
    add_set,
    add_solve_arguments,
    complain,
    display,
    finite_or_none,
    model_problem,
    problem_of,
    solution_of,
    summary,
    toml_help,
    with_numbers,
)
from rankone.share.export.program import pairs_of
from rankone.solvers.request import USUAL_POINTS
from rankone.support.budget import EFFORT_HELP, MEMORY_HELP, SECONDS_HELP, effort_of
from rankone.support.errors import OptionError, listing, quote
from rankone.support.options import INTEGRATOR_HELP, INTEGRATORS, LEVEL, RTOL

if TYPE_CHECKING:
    from rankone.inference.estimation.fit import Fit
    from rankone.inference.estimation.posterior import Posterior
    from rankone.problem.problem import Problem
    from rankone.solution.compiled import CompiledProblem
    from rankone.solution.solution import Solution
    from rankone.tensors.distributions import Distribution


T = TypeVar("T")

_SIGMA_HELP = "standard deviation of the noise, one or by unknown, numbers or expressions"
_NOISE_HELP = "kind of noise, one or by unknown: constant, proportional, combined, ..."
_OBSERVE_HELP = "columns to use, perhaps with what they are: signal='scale*x + offset'"
_DOSES_HELP = "the parameter that is the amount of a dose, and the column of amounts"
_BOUNDS_HELP = "interval of a parameter; SCALE is log"
_EFFORT_HELP = "low, normal (default), high or a factor on the budget of the solve and the starts"
_FIT_DATA_EXIT_HELP = """\
data: a table with commas; the first line names the columns: time (by the name it has in the
problem) and what was measured. Empty cells are missing values. Columns `condition` and `subject`
tell experiments apart, columns of parameters hold their values, `sigma` and `sigma_x` the
standard deviations. With --doses, rows of doses have an amount and no data.

exit status:
  0  nothing speaks against the fit
  1  something does; it is printed all the same
  2  bad input
"""


def register_fit(commands: Commands) -> None:
    parser = add_command(
        commands,
        "fit",
        _fit,
        usage="rankone fit FILE DATA [options]",
        help="fit parameters to measured data",
        description="Fit parameters of a solution, or of a problem that is solved first, to data.",
        epilog=_FIT_DATA_EXIT_HELP,
    )
    add = parser.add_argument
    add("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    add("data", metavar="DATA", type=Path, help="a .csv file (see below)")
    add("--observe", metavar="NAME[=EXPR]", **PAIRS, help=_OBSERVE_HELP)
    add("--sigma", metavar="S|NAME=S", nargs="+", help=_SIGMA_HELP)
    add("--noise", metavar="KIND|NAME=KIND", nargs="+", help=_NOISE_HELP)
    add("--doses", metavar="NAME=COLUMN", **PAIRS, help=_DOSES_HELP)
    for option, meaning in (("fixed", "parameters that are known"), ("start", "where to start")):
        add(f"--{option}", metavar="NAME=VALUE", **PAIRS, help=meaning)
    add(
        "--bounds",
        metavar="NAME=LOWER:UPPER[:SCALE]",
        **PAIRS,
        help=_BOUNDS_HELP,
    )
    add(
        "--prior",
        metavar="NAME=DISTRIBUTION",
        **PAIRS,
        help="what was known before, as in scipy.stats: k='norm(1, 0.1)'",
    )
    add("--level", type=float, default=LEVEL, help="level of intervals (default: %(default)g)")
    add("--posterior", action="store_true", help="the distribution of the parameters as well")
    add_solve_arguments(parser)
    add("--effort", metavar="E", type=effort_of, default="normal", help=_EFFORT_HELP)
    add("--json", action="store_true", help="print the result as JSON")


def _fit(arguments: argparse.Namespace) -> int:
    from rankone.inference.estimation.posterior import posterior_of
    from rankone.share.export.program import box_of, pairs_of

    solution = solution_of(arguments, effort=arguments.effort)
    table = _read(arguments.data)
    fit = solution.fit(
        table,
        observe=_observe(arguments.observe),
        sigma=_one_or_named("--sigma", arguments.sigma, _number_or_text),
        noise=_one_or_named("--noise", arguments.noise, str),
        fixed=pairs_of("--fixed", arguments.fixed, float),
        doses=pairs_of("--doses", arguments.doses, str, "--doses dose=amt") or None,
        start=pairs_of("--start", arguments.start, float) or None,
        bounds={k: tuple(ends) for k, ends in box_of(arguments.bounds, "--bounds").items()},
        prior=_priors(arguments.prior),
        level=arguments.level,
        effort=arguments.effort,
    )
    posterior = posterior_of(fit) if arguments.posterior else None
    if arguments.json:
        print(json.dumps(_plain(fit, posterior), indent=2, allow_nan=False))
    else:
        display(fit)
        if posterior is not None:
            display(posterior)
    return SUCCESS if fit.success else FAILURE


def _observe(texts: Sequence[str] | None) -> dict[str, str] | None:
    """What was measured, by the name of its column."""
    if texts is None:
        return None
    pairs = [text.partition("=") for text in texts]
    names = [name.strip() for name, _, _ in pairs]
    if len({*names}) < len(names):
        raise OptionError(f"--observe names an unknown twice: {listing(names)}", term=names)
    return {name: (right or name).strip() for name, (_, _, right) in zip(names, pairs, strict=True)}


def _priors(texts: Sequence[str] | None) -> dict[str, Distribution]:
    """Distributions by parameter: ``k=norm(loc=1, scale=0.1)``."""
    from rankone.tensors.distributions import from_text

    priors = {}
    for text in texts or ():
        name, _, right = text.partition("=")
        if not name or not right:
            raise OptionError(f"--prior: {text!r} cannot be read", remedy="write k='norm(1, 0.1)'")
        priors[name.strip()] = from_text(right.strip())
    return priors


def _one_or_named(option: str, texts: Sequence[str] | None, read: Callable[[str], T]) -> Any:
    """One for all that was measured, one for each by name, or nothing."""
    from rankone.share.export.program import pairs_of

    if texts is None:
        return None
    if len(texts) > 1 or "=" in texts[0]:
        return pairs_of(option, texts, read)
    return read(texts[0])


def _number_or_text(text: str) -> float | str:
    """A number, or an expression."""
    try:
        return float(text)
    except ValueError:
        return text


def _read(file: Path) -> dict[str, list[str]]:
    """The columns of a table."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            lines = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except (OSError, ValueError, csv.Error) as reason:
        raise OptionError(f"{quote(file)} cannot be read: {reason}", term=str(file)) from None
    if not lines:
        raise OptionError(f"{quote(file)} is empty", term=str(file))
    header = [name.strip() for name in lines[0][1]]
    if len(header) == 1 and ";" in header[0]:
        raise OptionError(
            f"{quote(file)} has semicolons between its columns", remedy="write commas"
        )
    if len(set(header)) < len(header):
        raise OptionError(f"{quote(file)} names a column twice: {listing(header)}", term=header)
    for line, row in lines[1:]:
        if len(row) != len(header):
            raise OptionError(
                f"{quote(file)}, line {line}: {len(row)} cells for {len(header)} columns", term=row
            )
    return {name: [row[i].strip() for _, row in lines[1:]] for i, name in enumerate(header)}


def _ends(intervals: Mapping[str, tuple[float, float]]) -> dict[str, list[float | None]]:
    return {name: [*map(finite_or_none, ends)] for name, ends in intervals.items()}


def _plain(fit: Fit, posterior: Posterior | None) -> dict[str, object]:
    """The fit for JSON; numbers that are not finite are null."""
    more: dict[str, object] = {}
    if posterior is not None:
        more["posterior"] = {
            "success": posterior.success,
            "message": posterior.message,
            "mean": posterior.mean,
            "std": posterior.std,
            "interval": _ends(posterior.interval()),
        }
    return {
        "success": fit.success,
        "message": fit.message,
        "x": fit.x,
        "interval": _ends(fit.interval()),
        "level": fit.level,
        "std": {name: finite_or_none(deviation) for name, deviation in fit.std.items()},
        "identifiable": fit.identifiable,
        "limits": fit.limits,
        "combinations": {
            text: {
                "value": fit.value_of(text),
                "interval": [*map(finite_or_none, fit.interval_of(text))],
            }
            for text in fit.combinations
        },
        "fixed": fit.fixed,
        "experiments": [trial.name for trial in fit.trials],
        "observed": list(fit.observed),
        "data": fit.size,
        "dof": fit.dof,
        "chi2": fit.chi2,
        "sigma": finite_or_none(fit.sigma),
        "p_value": finite_or_none(fit.p_value),
        "log_likelihood": finite_or_none(fit.log_likelihood),
        "aic": finite_or_none(fit.aic),
        "bic": finite_or_none(fit.bic),
        "checks": list(fit.checks),
        **more,
    }


# -----------------------------------------------------------------------------
# ``rankone solve`` and ``rankone show``, also for pieces of a box side by side.


_SPLIT_HELP = "solve pieces of the box, as many of each parameter as its number says, and join them"
_CHECKPOINT_HELP = (
    "a folder for finished solutions; after an interrupt the same command goes on from there"
)
_EXECUTOR_HELP = (
    "how many processes solve pieces side by side, or the address of a scheduler of dask, "
    "tcp://host:port; without --split they share the trajectories of the solve"
)


def add_pieces(add: Callable[..., object]) -> None:
    """Add the options to the parser of ``rankone solve``."""
    add("--split", metavar="NAME=COUNT", **PAIRS, help=_SPLIT_HELP)
    add("--checkpoint", metavar="FOLDER", help=_CHECKPOINT_HELP)
    add("--executor", metavar="N|ADDRESS", type=_executor, help=_EXECUTOR_HELP)


def in_pieces(arguments: argparse.Namespace) -> bool:
    """Whether what is asked for is a solve of pieces, or of one that is kept in a checkpoint."""
    return arguments.split is not None or arguments.checkpoint is not None


def solve_pieces(
    compiled: CompiledProblem,
    arguments: argparse.Namespace,
    options: Mapping[str, Any],
    progress: bool,
) -> Solution:
    """One solution of all pieces; a table of them on stderr if one is without success."""
    import rankone

    boxes = compiled.problem.split(pairs_of("--split", arguments.split, int, "NAME=COUNT"))
    pieces = rankone.solve_many(
        compiled,
        boxes,
        executor=arguments.executor,
        checkpoint=arguments.checkpoint,
        progress=progress,
        **options,
    )
    if len(pieces) == 1:
        return pieces[0]
    if not pieces.success and not arguments.quiet:
        complain(str(pieces))
    return pieces.join()


def _executor(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


# -----------------------------------------------------------------------------
# ``rankone solve FILE`` and ``rankone show FILE``: solve a problem, or print its stages.


ARGUMENTS = (
    *("self", "rtol", "method", "parameters", "t_final", "check", "cover", "effort"),
    *("max_seconds", "max_memory", "unknowns", "outputs", "integrator", "markers", "progress"),
    "on_failure",
)
"""Arguments of ``CompiledProblem.solve`` beside the options of an engine."""
# What ``show`` prints: for each flag the title and the attribute of the compiled problem
_STAGES = {
    "first-order": ("first-order system", "first_order"),
    "weak-form": ("weak form", "weak_form"),
    "separated": ("separated form", "separated"),
    "lifted": ("lifted form", "lifted"),
    "quadratic": ("quadratic system", "quadratic"),
    "source": ("generated module", "source"),
}
_CHECK_HELP = "number of check points in the interior; 0 leaves the error unknown (status 1)"
_BOX_HELP = (
    "other ranges of parameters, for this solve, NAME=LOWER:UPPER:log in the logarithm; "
    "of a model the parameters that are free"
)
_END_HELP = "another end of the horizon, for this solve; a model starts at 0 and needs it"
_OPTIONS_HELP = "options of the engine, such as max_rank=300"
_COVER_HELP = "whether success covers the corners of the box; by default up to three parameters"
_OUTPUTS_HELP = "quantities to solve for in place of the unknowns, in quotes: 'q=x + y'"
_UNKNOWNS_HELP = "the unknowns whose error has to be within the tolerance; by default all"
_MARKERS_HELP = (
    "what may end stretches of time besides events: auto, none, or what crosses zero "
    "(default: auto)"
)
_EXIT_HELP = """\
exit status:
  0  the measured error is within the tolerance
  1  it is not, or is not known; the summary is printed and the file is saved all the same
  2  bad input
"""


def register(commands: Commands) -> None:
    solve = add_command(
        commands,
        "solve",
        _solve,
        usage="rankone solve FILE [options]",
        help="solve a problem, print a summary and optionally save the solution",
        description="Solve a problem for every parameter value of its box and measure the error.",
        epilog=f"{toml_help()}\n{_EXIT_HELP}",
    )
    add = solve.add_argument
    add("file", metavar="FILE", type=Path, help=MODEL_HELP)
    add("--rtol", type=float, default=RTOL, help="relative tolerance (default: %(default)g)")
    add("--save", metavar="PATH", type=Path, help="write the solution (.npz, or .nc for netCDF)")
    add("--overwrite", action="store_true", help="let --save replace a file")
    add("--check", metavar="N", type=_count, help=_CHECK_HELP)
    add("--method", default="auto", help="auto, cross, train or greedy (default: %(default)s)")
    add("--box", metavar="NAME=LOWER:UPPER[:SCALE]", **PAIRS, help=_BOX_HELP)
    add("--t-final", metavar="T", type=float, help=_END_HELP)
    add_set(solve)
    add("--options", metavar="NAME=VALUE", **PAIRS, help=_OPTIONS_HELP)
    add("--cover", choices=("interior", "box"), help=_COVER_HELP)
    add("--effort", metavar="E", type=effort_of, default="normal", help=EFFORT_HELP)
    add("--max-seconds", metavar="S", type=float, help=SECONDS_HELP)
    add("--max-memory", metavar="SIZE", help=MEMORY_HELP)
    add("--unknowns", metavar="NAME", nargs="+", help=_UNKNOWNS_HELP)
    add("--outputs", metavar="NAME=EXPR", **PAIRS, help=_OUTPUTS_HELP)
    add("--integrator", choices=INTEGRATORS, default="auto", help=INTEGRATOR_HELP)
    add("--markers", metavar="WHEN", nargs="+", default=["auto"], help=_MARKERS_HELP)
    add_pieces(add)
    add("--json", action="store_true", help="print the summary as JSON")
    add("--quiet", action="store_true", help="no summary (except --json) and no progress bar")

    show = add_command(
        commands,
        "show",
        _show,
        help="print what a problem compiles to, from the first-order system to the source",
        description="Print what a problem compiles to; everything if no flag selects.",
        epilog=toml_help(),
    )
    show.add_argument("file", metavar="FILE", type=Path, help=MODEL_HELP)
    show.add_argument(
        "--box",
        metavar="NAME=LOWER:UPPER[:SCALE]",
        **PAIRS,
        help="of a model the parameters that are free",
    )
    show.add_argument(
        "--t-final",
        metavar="T",
        type=float,
        help="of a model the end of the horizon; without it the model itself is printed",
    )
    add_set(show)
    for stage, (title, _) in _STAGES.items():
        show.add_argument(f"--{stage}", action="store_true", help=f"the {title}")


def _count(text: str) -> int:
    try:
        count = int(text)
    except ValueError:
        count = -1
    if count < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0")
    return count


def _markers(words: list[str]) -> str | list[str] | None:
    """The option ``markers`` of a solve."""
    if len(words) == 1 and words[0] in ("auto", "none"):
        return "auto" if words[0] == "auto" else None
    return words


def _solve(arguments: argparse.Namespace) -> int:
    from rankone.problem.models.sbml_formulas import is_model_file
    from rankone.share.export.program import box_of, options_of, pairs_of
    from rankone.solution.storage import target

    box, options = box_of(arguments.box), options_of(arguments.options, ARGUMENTS)
    if arguments.save is not None:  # find out before the solve, not after it
        target(arguments.save, arguments.overwrite)

    of_model = is_model_file(arguments.file)  # its box and horizon are those of the problem
    compiled = _compiled(arguments, box, of_model)
    options |= {
        "rtol": arguments.rtol,
        "method": arguments.method,
        "t_final": None if of_model else arguments.t_final,
        "check": USUAL_POINTS if arguments.check is None else arguments.check,
        "cover": arguments.cover,
        "effort": arguments.effort,
        "max_seconds": arguments.max_seconds,
        "max_memory": arguments.max_memory,
        "unknowns": arguments.unknowns,
        "outputs": pairs_of("--outputs", arguments.outputs, str) or None,
        "integrator": arguments.integrator,
        "markers": _markers(arguments.markers),
    }
    solution = _solution(compiled, arguments, {} if of_model else box, options)
    if arguments.save is not None:
        solution.save(arguments.save, overwrite=arguments.overwrite)
    if arguments.json:
        saved = None if arguments.save is None else str(arguments.save)
        answer = {"file": str(arguments.file), **summary(solution), "saved": saved}
        print(json.dumps(answer, indent=2, allow_nan=False))
    elif not arguments.quiet:
        display(solution)
        if arguments.save is not None:
            print(f"  saved     {arguments.save}")
    sys.stdout.flush()
    return SUCCESS if solution.success else FAILURE


def _compiled(
    arguments: argparse.Namespace, box: Mapping[str, Any], of_model: bool
) -> CompiledProblem:
    """The compiled problem, which varies the box if it is of a model or is solved in pieces."""
    import rankone
    from rankone.support.budget import preparing

    with preparing(arguments.max_seconds):
        if of_model:
            problem = model_problem(arguments.file, box, arguments.t_final)
            return rankone.compile(with_numbers(problem, arguments.set))
        problem = problem_of(arguments.file, arguments.set)
        return rankone.compile(problem.vary(box) if in_pieces(arguments) and box else problem)


def _solution(
    compiled: CompiledProblem,
    arguments: argparse.Namespace,
    box: Mapping[str, Any],
    options: dict[str, Any],
) -> Solution:
    """The solution; one that has not converged is reported on stderr."""
    from rankone.support.errors import ConvergenceError

    bar = sys.stderr.isatty() and not arguments.quiet
    try:
        if in_pieces(arguments):
            return solve_pieces(compiled, arguments, options, bar)
        if arguments.executor is not None:
            options["executor"] = arguments.executor
        return compiled.solve(parameters=box, progress=bar, **options)
    except ConvergenceError as error:
        if error.solution is None:
            raise
        complain(f"error: {error}")
        solution: Solution = error.solution
        return solution


def _shown_problem(arguments: argparse.Namespace) -> Problem | None:
    """The problem whose stages are printed; None for a model, which has been printed."""
    from rankone.problem.models.sbml import read_sbml
    from rankone.problem.models.sbml_formulas import is_model_file
    from rankone.share.export.program import box_of
    from rankone.support.errors import OptionError

    file, box, t_final = arguments.file, box_of(arguments.box), arguments.t_final
    for_models = bool(box) or t_final is not None
    if is_model_file(file) and for_models:
        return with_numbers(model_problem(file, box, t_final), arguments.set)
    if is_model_file(file) and arguments.set:
        raise OptionError(
            "--set is for problems; without --box and --t-final the model itself is printed",
            remedy="give --t-final, or leave --set out",
        )
    if is_model_file(file):
        print(read_sbml(file))
        return None
    if for_models:
        raise OptionError(
            f"--box and --t-final are for models; `{file}` has its own", remedy="leave them out"
        )
    return problem_of(file, arguments.set)


def _show(arguments: argparse.Namespace) -> int:
    """Print the stages that are flagged, or all; of a model without a horizon the model."""
    import rankone

    problem = _shown_problem(arguments)
    if problem is None:
        return SUCCESS
    compiled = rankone.compile(problem)
    flags = vars(arguments)
    stages = [stage for stage in _STAGES if flags[stage.replace("-", "_")]]
    if not stages:
        stages = [stage for stage in _STAGES if stage != "lifted" or compiled.lifted is not None]
        print("# methods\n")
        for method, reason in compiled.methods.items():
            print(f"{method:6} {'applies' if reason is None else f'does not apply: {reason}'}")
        print(f"auto   tries {', then '.join(compiled.automatic)}\n")
    for position, stage in enumerate(stages):
        title, attribute = _STAGES[stage]
        if len(stages) > 1:
            print(f"{'' if position == 0 else chr(10)}# {title}\n")
        form = getattr(compiled, attribute)
        reason = "not all terms separate" if stage == "quadratic" else "there is nothing to lift"
        print(f"none: {reason}" if form is None else str(form).rstrip("\n"))
    sys.stdout.flush()
    return SUCCESS
