"""The process of one solver on one instance: make ready, call, time, report.

    python examples/solver_comparison/measuring/worker.py ORDER REPORT

ORDER is an `Order` as a JSON object; see `process` for REPORT.
"""

import gc
import importlib
import importlib.util
import json
import math
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from examples.solver_comparison.instances.instance import parse_instance
from examples.solver_comparison.measuring.memory import process_memory
from examples.solver_comparison.measuring.process import DONE, PREPARING, Report
from examples.solver_comparison.reporting.results import Outcome
from examples.solver_comparison.solvers.answer import Answer, Prepared, joined
from examples.solver_comparison.solvers.catalogue import Order, Solver, solver_named

_MODELS = "examples.solver_comparison.instances.models"
_SHORT = 5.0  # seconds; longer calls are not repeated


def main(arguments: list[str]) -> None:
    """Carry out an order: prepare, call, time and report."""
    order, report = Order(**json.loads(arguments[0])), Report(Path(arguments[1]))
    solver = solver_named(order.solver)
    report.say(phase=PREPARING)
    missing = [p for p in (solver.package, solver.also_needs) if p and not _is_installed(p)]
    if missing:
        report.say(outcome=Outcome.NOT_INSTALLED, note=solver.pip, phase=DONE)
        return
    try:
        _run(solver, order, report)
    except MemoryError as error:
        report.say(outcome=Outcome.OUT_OF_MEMORY, note=str(error)[:300], phase=DONE)
    except Exception as error:  # whatever goes wrong in a solver is a row of the table
        words = " ".join(str(error).split())[:300]
        report.say(outcome=Outcome.FAILED, note=f"{type(error).__name__}: {words}", phase=DONE)


def _is_installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def _run(solver: Solver, order: Order, report: Report) -> None:
    _, seconds = _timed(lambda: importlib.import_module(solver.package))
    report.say(import_seconds=seconds)
    models, module = (importlib.import_module(m) for m in (_MODELS, solver.module))
    ready, seconds = _timed(lambda: models.build(parse_instance(order.instance)))
    model = ready.model
    report.say(
        model_seconds=seconds,
        states=model.n_states,
        pairs=model.n_pairs,
        transitions=model.n_outcomes,
    )
    prepared, seconds = _timed(lambda: module.prepare(ready, order, **solver.options))
    report.say(convert_seconds=seconds, note=prepared.note, details=prepared.details)
    if prepared.warm_up is not None:
        _, seconds = _timed(prepared.warm_up)
        report.say(warm_up_seconds=seconds)
    gc.collect()
    memory = process_memory()
    report.say(phase="solving", ready_memory=memory[0] if memory else None)
    answer = _repeat(prepared, order, report)
    report.say(phase="evaluating the answer")
    if answer.excess is not None:
        report.say(excess=_finite(answer.excess()))
    report.say(phase=DONE)


def _repeat(prepared: Prepared, order: Order, report: Report) -> Answer:
    """Call the solver at most ``order.repeat`` times; report after each call, to lose nothing."""
    best = math.inf
    for number in range(max(order.repeat, 1)):
        answer, seconds = _timed(prepared.call)
        best, memory = min(best, seconds), process_memory()
        report.say(
            outcome=_outcome(answer),
            seconds=best,
            calls=number + 1,
            objective=_finite(answer.objective),
            gap=None if answer.gap is None else _finite(answer.gap),
            backups=answer.backups,
            products=answer.products,
            note=joined(answer.unsolved, answer.note, prepared.note),
            details=joined(answer.details, prepared.details),
            peak_memory=memory[1] if memory else None,
        )
        if seconds > _SHORT or _outcome(answer) is not Outcome.SOLVED:
            break
    return answer


def _outcome(answer: Answer) -> Outcome:
    if not answer.in_time:
        return Outcome.TIME_OUT
    return Outcome.FAILED if answer.unsolved else Outcome.SOLVED


def _timed(action: Callable[[], Any]) -> tuple[Any, float]:
    began = time.perf_counter()
    result = action()
    return result, time.perf_counter() - began


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("order", metavar="ORDER")
    parser.add_argument("report", metavar="REPORT")
    asked = parser.parse_args()
    main([asked.order, asked.report])
