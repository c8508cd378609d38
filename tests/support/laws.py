"""The law of success costs of one stationary policy, or of a model's only one; the goal is "G"."""

from formulations import S3P
from small_models import model_of
from ssp_lp import DeterministicPolicy, success_costs


def one_way(outcomes, **more):
    """The law of the only policy of a model in which each state has one action, "go"."""
    model = model_of({"a": {"go": outcomes}, **more}, "G")
    return law_of(model, {s: "go" for s in ["a", *more] if s != "pit"})


def law_of(model, actions, start="a"):
    """The law of the policy that plays the actions."""
    return success_costs(DeterministicPolicy.from_actions(model, actions), S3P(model, start=start))
