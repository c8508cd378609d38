"""Case M as an occupation-measure program, for models too large to enumerate."""

from references import combined
from references.chain import PlainModel, start_distribution
from references.mcmp import Start


def program(
    model: PlainModel,
    start: Start,
    *,
    give_up: str,
    charge_failing_step: bool,
    discount: float | None = None,
) -> combined.Program:
    """The program of `references.combined` in which the cost alone counts."""
    choices = model.choices | {goal: {} for goal in model.goals}
    return combined.program(
        combined.Task(choices, model.goals, start_distribution(start), {}),
        0,
        give_up=give_up,
        charged=charge_failing_step,
        minimised=("cost",),
        discount=discount or 1.0,
    )


def least_failure(data: combined.Program) -> float:
    """The least failure of any policy."""
    return combined.solved(data, data.parts["failure"], [], ratio=False)


def least_cost(data: combined.Program, budget: float) -> float:
    """The least cost within the budget."""
    return combined.solved(data, data.parts["cost"], [(data.parts["failure"], budget)], ratio=False)


def least_priced(data: combined.Program, price: float) -> float:
    """The least cost + price * failure of any policy."""
    return combined.solved(
        data, data.parts["cost"] + price * data.parts["failure"], [], ratio=False
    )
