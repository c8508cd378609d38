"""Problems on layers of accumulated cost whose only limit is on failure, and how to price them.

Beyond the cap on accumulated cost a policy follows a stationary *tail* policy, whose values are
known in closed form. A *choice*, [layers, nodes], is a policy below the cap: for each node of each
layer, the position of the pair taken among the pairs of the node.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ssp_lp.accumulated_cost import written_out
from ssp_lp.accumulated_cost.charges import TOTAL_COST, Charge
from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.accumulated_cost.sweep import KEPT_VALUES, PartOfSweep, Sweep, at_price
from ssp_lp.accumulated_cost.totals import CAP_MARGIN, MOST_GROWTH, layers_within, step_costs
from ssp_lp.arrays import MACHINE_EPSILON, ROUNDED, FloatArray, IntArray
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    pricing_weights,
    required,
)
from ssp_lp.column_generation.compiled_problem import (
    MOST_ENTRIES,
    MOST_STEPS,
    CompiledProblem,
    GoalFacts,
    LayerAndTails,
    LeastFailure,
    Tails,
)
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming import bellman
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_states, dead_ends, goal_approach
from ssp_lp.policies.policy import DeterministicPolicy, Policy
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.processes.live_rows import uniform_cost


@dataclass(frozen=True, eq=False)
class LayeredPricing(PricingProblem):
    """Pricing problem of a layered process whose only limit is on failure.

    Choices and values have the shape [cap, nodes]: layers below the cap, and nodes of each layer.
    """

    process: LayeredProcess
    by_goal: bool = False  # the second reward is minus the goal probability instead of failure

    n_rewards: ClassVar[int] = 2

    def counting_success(self) -> LayeredPricing:
        """Return this pricing problem with failure replaced by minus success as second reward."""
        return replace(self, by_goal=True)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """Shape of value functions and choices: [cap, nodes]."""
        return self.process.cap, self.process.base.n_nodes

    @cached_property
    def sweep(self) -> Sweep:
        """The backward sweeps over the process."""
        return Sweep.of_ends(self.process)

    def incumbent(self, reached: Any) -> Column | None:
        """Return the column of a backward sweep that was stopped, or None.

        The sweep has solved the last layers. Followed from the start, the policy of these layers is
        optimal at a lower price of failure: the price of the sweep minus the total of the first
        solved layer. The result is None if the charge is not the cost itself.
        """
        if not isinstance(reached, PartOfSweep) or reached.layer == self.process.cap:
            return None
        if not self.is_shifted:
            return None
        measures = reached.measures
        if measures is not None:
            measures = self.process.base.start @ measures
            measures[0] -= float(self._paid[reached.layer]) * measures[2]
        swept = Column(0.0, 0.0, 0.0, reached.choice, reached.price)
        return self._begun_in(reached.layer, swept, measures)

    @property
    def covered_price(self) -> float:
        """Greatest price of failure at which one sweep also solves all lower prices, or 0."""
        return float(self._paid[-1]) if self.is_shifted else 0.0

    @cached_property
    def is_shifted(self) -> bool:
        """Whether beginning in a later layer is equivalent to a lower price of failure."""
        return self.process.grows_evenly and not self.process.base.by_steps

    @cached_property
    def _paid(self) -> FloatArray:
        """Amount by which beginning in each layer lowers the price of failure, [cap]."""
        process = self.process
        return process.totals.values[: process.cap] / process.base.survival

    def _begun_in(self, layer: int, swept: Column, measures: FloatArray | None = None) -> Column:
        """Return the column that a sweep found for episodes that begin in a given layer.

        Args:
            layer: the layer of ``swept`` that becomes the first one.
            swept: the column of a sweep; its choice is known in ``layer`` and all later layers.
            measures: cost, failure and goal of the result, [3]; None: they are computed.
        """
        if layer == 0 and swept.by_layer is not None:
            return swept
        choice = required(swept.choice)
        if measures is None and swept.by_layer is not None:
            known = swept.by_layer[layer, 1:]
            measures = None if np.isnan(known).any() else known
        price = swept.tail_price - float(self._paid[layer])
        begun = self._process_from(layer)
        within, choice = replace(self, process=begun), choice[layer:]
        if measures is None:
            measures = within.sweep.measure(choice, begun.measures_beyond(price))
        column, policy = within._column(measures, choice, price, 0), begun.policy(choice, price)
        return replace(column, choice=None, policy=policy, swept=swept)

    def nearby_columns(self, column: Column, row: FailureRow) -> tuple[Column, ...]:
        """Return columns that are optimal at lower prices, and fail about as often as allowed.

        One backward sweep solves the pricing problem at many prices: the price of the column minus
        the total of each layer. The first column is optimal at the price with the best dual bound,
        the second one at a neighbouring price, on the other side of the budget.
        """
        rest = column.by_layer
        if rest is None or column.choice is None or not (row.ratio and row.required > 0.0):
            return ()
        prices = column.tail_price - self._paid
        rest = rest[:, 0]
        best = int(np.argmax(prices + np.where(rest >= 0.0, rest, rest / row.required)))
        nearest = self._begun_in(best, column)
        other = best - 1 if row.is_violated_by(nearest) else best + 1
        if not 0 <= other < len(prices) or prices[other] <= 0.0:
            return ()
        return replace(nearest, found_at=float(prices[best])), self._begun_in(other, column)

    def policy_failing(
        self, column: Column, failure: float, tried: set[int], *, above: bool
    ) -> Policy | None:
        """Return a policy of about a given failure probability, or None if none is known.

        The sweep that found ``column`` also found the policies that are optimal at lower prices.
        Their failure probability is the slope of the least value as a function of the price.

        Args:
            column: a column that ``minimise`` or ``nearby_columns`` returned.
            failure: the failure probability.
            tried: layer counts of the policies that were returned earlier, which are not returned
                again; updated.
            above: whether the policy fails more often than ``failure``, rather than less often.
        """
        swept = column.swept or column
        if swept.by_layer is None or swept.choice is None:
            return None
        goal = np.diff(swept.by_layer[:, 0]) / np.diff(self._paid)  # between a layer and the next
        fails = np.maximum.accumulate(1.0 - goal)
        layer = int(np.searchsorted(fails, failure)) + int(above)
        left = self.process.cap - layer
        if layer >= len(fails) or left in tried:
            return None
        tried.add(left)
        price = swept.tail_price - float(self._paid[layer])
        return self._process_from(layer).policy(swept.choice[layer:], price)

    def _process_from(self, layer: int) -> LayeredProcess:
        """Return the process in which a given layer is the first one, with cost 0."""
        totals = self.process.base.totals(self.process.cap - layer)
        return replace(self.process, totals=totals)

    def first(self) -> Column:
        """Return the column that follows the tail policy to the goal from the start on."""
        base, tails = self.process.base, self.process.tails
        if tails.guess is not None:
            guess = tails.guess[0], 1.0, tails.guess[1] + base.start_goal
            return Column(*guess, None, by_goal=self.by_goal)
        nothing_paid = self.process.charge.beyond(np.zeros(base.n_nodes), tails.first)
        cost = float(base.start @ nothing_paid) + self.process.start_charge
        goal = float(base.start @ tails.first.goal)
        failure = float(base.start @ tails.first.failure) + base.start_failure
        policy = DeterministicPolicy(base.quotient.model, tails.decisions[0])
        found = cost, failure, goal + base.start_goal, None
        return Column(*found, policy=policy, by_goal=self.by_goal)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Return a column of least ``E[charge; goal] + price * failure``."""
        failure_price = float(pricing_weights(price)[1])
        base, tails, choice = self.process.base, self.process.tails, self.sweep.empty_choice()
        most = (
            0.0 if base.start_goal or base.start_failure else float(self.process.totals.values[-1])
        )
        if self.sweep.by_blocks and self.is_shifted and failure_price * base.survival <= most:
            return self._minimise_and_prove(failure_price, choice)
        goal = tails.guess[1] if tails.guess else float(base.start @ tails.first.goal)
        # if success is improbable, use the form cost - price * goal
        failing = failure_price if goal + base.start_goal >= 0.5 else 0.0
        begun = np.full((self.process.cap, 4), np.nan) if self.is_shifted else None
        measures = self.sweep.minimise(at_price(self.sweep, failure_price, failing), choice, begun)
        column = self._column(measures, choice, failure_price, self.process.cap)
        if begun is None:
            return column
        prices = failure_price - self._paid
        ended = base.start_goal
        if failing:
            begun[:, 0] -= self._paid * base.start.sum()
            ended = 1.0 - base.start_failure
        begun[:, 0] -= prices * ended
        begun[:, 1] -= self._paid * begun[:, 3]
        return replace(column, by_layer=begun)

    def _minimise_and_prove(self, price: float, choice: IntArray) -> Column:
        """Return a nearly optimal column, with the dual bounds that the same sweep proves.

        The price is so low that beyond the cap failing is optimal in every state that can avoid the
        goal. The lower bound beyond the cap is exact in these states.

        Args:
            price: price of failure.
            choice: filled with the choice of the column, [cap, nodes].
        """
        priced = at_price(self.sweep, price, 0.0, bounds=True)
        bounds, values = self.sweep.bound(priced, self.infinite, choice)
        by_layer = np.full((self.process.cap, 4), np.nan)
        by_layer[:, 0] = bounds
        column = replace(self.measure(choice, price), by_layer=by_layer, totals=values)
        return replace(column, work=bellman.Work(2 * self.process.cap, self.process.cap))

    def _proved_by(self, swept: Column, price: float, *, slack: bool) -> Proof | None:
        """Return the dual bound at a price that the sweep of a column proved, or None."""
        layer = int(np.abs(swept.tail_price - self._paid - price).argmin())
        at = swept.tail_price - float(self._paid[layer])
        if abs(at - price) > ROUNDED * price:
            return None
        found, bound = required(swept.totals), float(required(swept.by_layer)[layer, 0])
        values = self.infinite
        if found.size <= KEPT_VALUES:
            values = np.array(values)
            values[: self.process.cap - layer] = found[layer:] + (0.0 if slack else at)
        return Proof(at, 0.0, bound, values)

    def measure(self, choice: IntArray, tail_price: float) -> Column:
        """Return the column of a choice, with its exact E[cost; goal] and failure.

        Args:
            choice: [cap, nodes].
            tail_price: price of failure at which the tails beyond the cap are chosen.
        """
        measures = self.sweep.measure(choice, self.process.measures_beyond(tail_price))
        return self._column(measures, choice, tail_price, 0)

    def _column(
        self, totals: FloatArray, choice: IntArray, tail_price: float, backups: int
    ) -> Column:
        """Return the column of a choice.

        Args:
            totals: charge, failure and goal of episodes that begin with a step, [3].
            choice: [cap, nodes].
            tail_price: price of failure at which the tails beyond the cap are chosen.
            backups: number of layer backups in the search for the choice.
        """
        base, work = self.process.base, bellman.Work(backups, self.process.cap)
        cost, failure, goal = totals.tolist()
        failure = max(failure + base.start_failure, 0.0)  # a negative value is rounding
        goal = max(goal + base.start_goal, 0.0)
        cost += self.process.start_charge
        return Column(cost, failure, goal, choice, tail_price, work=work, by_goal=self.by_goal)

    def prove(
        self, price: float | FloatArray, best: Column | None = None, *, slack: bool = False
    ) -> Proof:
        """Prove the best dual bound at a price, by a sweep unless that of ``best`` proved it."""
        price = float(pricing_weights(price)[1])
        swept, proved = None if best is None else best.swept or best, None
        if swept is not None and swept.totals is not None and swept.by_layer is not None:
            proved = self._proved_by(swept, price, slack=slack)
        return proved or self._proof(price, 0.0 if slack else price, self.infinite)

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Prove a dual bound from a given value function, [cap, nodes].

        A backward sweep lowers the values to a sub-solution. It starts from the lower bound beyond
        the cap, and subtracts the rounding error of every backup. Infinite values give the best
        bound. The proof then also has the choice that attains the bound, if a forward sweep can
        evaluate this choice.

        Raises:
            ModelError: values have the wrong shape.
        """
        choice = None
        self.check_shape(values)
        if self.sweep.can_follow and self.sweep.one_pass is None:
            wants_best = all(bool(np.isposinf(layer).all()) for layer in values)
            choice = self.sweep.empty_choice() if wants_best else None
        return self._proof(price, 0.0 if slack else price, values, choice)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Return an upper bound of the error of a dual bound that is due to the cap.

        One sweep starts from the values of the tail policies beyond the cap, another one from lower
        bounds of all values there. The error is the difference of their results at the start. It is
        at most the mass that the second sweep's choice sends beyond the cap, times the difference
        of the values there. It is 0 if the tail policies are optimal.

        Args:
            price: price of failure.
            slack: use the form ``cost - price * goal`` (:class:`Proof`).
            proof: a proof at this price, which may save a sweep.
        """
        process, failing = self.process, 0.0 if slack else price
        tails = process.beyond_value(price, failing)
        least = process.beyond_bound(price, failing)
        same = tails - least <= ROUNDED * (np.abs(tails) + np.abs(least))
        lost = np.where(same, 0.0, tails - least)
        if not lost.any():
            return 0.0
        if proof is not None and proof.choice is not None:
            left = self.sweep.mass_beyond(proof.choice)
            most = float((left[: len(lost)] * lost).sum())
            if most <= ROUNDED * abs(proof.bound):
                return most
        followed = at_price(self.sweep, price, failing)
        reached = float(self.sweep.bound(followed, self.infinite)[0][0])
        if proof is not None and reached <= proof.bound:
            return 0.0
        return max(reached - self.prove(price, slack=slack).bound, 0.0)

    def _proof(
        self, price: float, failing: float, values: FloatArray, choice: IntArray | None = None
    ) -> Proof:
        """Reduce values to a checked sub-solution, by a backward sweep from bounds beyond the cap.

        Args:
            price: price of failure.
            failing: the price, or 0 for the form ``cost - price * goal`` (:class:`Proof`).
            values: upper limits of the result, [cap, nodes].
            choice: filled with the choice that attains the bound, [cap, nodes], or None.
        """
        priced = at_price(self.sweep, price, failing, bounds=True)
        bounds, kept = self.sweep.bound(priced, values, choice)
        work = bellman.Work(self.process.cap, 0)
        return Proof(price, failing, float(bounds[0]), kept, work, choice, by_layer=bounds)

    def pulled_back(self, column: Column) -> Policy:
        """Return the policy that follows a column's choice below the cap, and tails beyond."""
        return self.process.policy(required(column.choice), column.tail_price)


_NEARLY = 1.25  # first cap of a trial by sums, in costs given success of a way to the goal

_MOST_LAYERS = 100_000
"""Most layers of a charge that never settles; the gap that remains is reported."""

_DOUBLINGS = 60  # most doublings of a cap
_LOST = 1e-6  # goal probability that a policy of least failure may lose to rounding of long runs


@dataclass(frozen=True, eq=False)
class CompiledLayered(CompiledProblem):
    """Minimise E[charge(total cost); goal], or its ratio to Pr(goal), within a failure budget.

    With the total cost as charge and a ratio this is case S (paper, section 3.1.1). The layers of
    accumulated cost end at a cap, which depends on the charge:

    - Where the charge becomes affine, the optimal tail policy is known in closed form.
    - If the affine charge grows, the cap is at least the price of failure: beyond it, failing is
      optimal in every state where the goal can surely be avoided.
    - A charge that never becomes affine is truncated, and the cap is raised by refinement.

    Simple tails are any policy to the goal and one of least goal probability, with 1 as the upper
    bound of the goal probability. With a cap at the price of failure they cause (almost) no error.
    The exact tails, of greatest goal probability, are computed only if the price is too large for
    such a cap.
    """

    facts: GoalFacts
    layer: LayerAndTails  # with the same facts
    charge: Charge = TOTAL_COST
    ratio: bool = True
    cap: float | None = None  # total at which the layers end, in units; None: a first guess
    fixed_cap: float | None = None  # the user's cap on accumulated cost
    tails: Tails = Tails.LEAST_FAILURE

    @classmethod
    def given_success(
        cls, model: SSP, start: FloatArray, discount: float | None = None, **caps: Any
    ) -> CompiledLayered:
        """Compile case S: minimise E[total cost | goal].

        Args:
            model: the model.
            start: distribution over states, [states].
            discount: the discount, or None.
            caps: the fields ``cap`` or ``fixed_cap`` of the problem.
        """
        facts = GoalFacts(model, start, discount)
        return cls(facts, LayerAndTails(facts), tails=Tails.ANY_WAY, **caps)

    @cached_property
    def lowest(self) -> float:
        """Lower bound of the objective: in case S, least number of steps times least step cost."""
        if not (self.charge.is_the_total and self.ratio) or self.layer.by_sums:
            return self.charge.lowest
        model, start, base = self.facts.model, self.facts.start, self.layer.base
        begins = np.flatnonzero(start)
        begins = begins[~dead_ends(model)[begins]]
        if self.facts.discount is not None or not begins.size:
            return 0.0
        steps, same = int(goal_approach(model)[1][begins].min()), uniform_cost(model)
        if steps == 0:
            return 0.0
        last = float(model.costs.min()) if same is None else same
        going_on = base.step_classes.least * base.unit if same is None else same
        return ((steps - 1) * going_on + last) * (1.0 - 2.0 * MACHINE_EPSILON)

    @cached_property
    def cost_horizon(self) -> float:
        """Accumulated cost from which a stationary policy is optimal; 0: unknown."""
        return self.layer.cost_horizon

    @property
    def _grows(self) -> bool:
        """Whether the charge is unbounded, so that failing becomes optimal at some total."""
        return self.charge.slope > 0.0 and not self.layer.safest_only

    @cached_property
    def is_guess(self) -> bool:
        """Whether the cap is a guess, and the solution only serves to find a better cap."""
        if self.cap is not None or self.fixed_cap is not None or not self._grows:
            return False
        return self.layer.by_sums or not self._has_exact_tails

    @cached_property
    def is_cap_poor(self) -> bool:
        """Whether the quickly found policy to the goal has runs too long to derive a cap from."""
        layer, facts = self.layer, self.facts
        is_guess = self.cap is None and self.fixed_cap is None and self.tails is Tails.ANY_WAY
        if not is_guess or layer.base.quotient.merged.any():
            return False
        if layer.guess is not None:
            cost, goal = layer.guess[0], layer.guess[1] + layer.base.start_goal
        else:
            cost, goal = facts.cost_and_goal(facts.directed)
        steps = (
            written_out.TYPICAL * cost / max(goal, 1e-300) / (layer.base.unit * layer.base.width)
        )
        return steps > MOST_STEPS

    @cached_property
    def _has_exact_tails(self) -> bool:
        """Whether the tails are exact, by request or because simple tails cannot be used."""
        merged = self.layer.base.quotient.merged
        return self.tails is Tails.LEAST_FAILURE or bool(merged.any()) or self.is_cap_poor

    @cached_property
    def is_lossy(self) -> bool:
        """Whether every cap may change the optimum: a start state cannot surely avoid the goal."""
        return bool(self.facts.start[~attention_states(self.facts.model)].any())

    @property
    def _cannot_surely_fail(self) -> bool:
        """Whether no policy surely avoids the goal from the start."""
        return float(self.facts.start @ self.facts.riskiest.values.goal) > 0.0

    def capped_at(self, cost: float) -> CompiledLayered:
        """Return the problem with a cap near a given cost; a problem with exact tails is unchanged.

        If no policy surely avoids the goal from the start, simple tails would change the optimum at
        every cap. Then the result has exact tails.
        """
        if self.tails is not Tails.ANY_WAY:
            return self
        base, exact = self.layer.base, self._cannot_surely_fail
        most = MOST_ENTRIES // max(base.n_nodes, 1) - 2 * base.width
        layers = int(min(np.ceil(cost / base.unit), max(most, 0))) + base.width
        return replace(self, cap=layers, tails=Tails.LEAST_FAILURE if exact else self.tails)

    @cached_property
    def process(self) -> LayeredProcess:
        """The process, truncated at the cap."""
        layer, cap = self.layer, self._first_cap() if self.cap is None else self.cap
        base = layer.base
        if not self.fits(cap):
            raise ModelError(
                f"too many layers of accumulated cost ({cap:.6g} of unit {base.unit:g}, on "
                f"{base.n_nodes:,} states): use a coarser grid of costs or a smaller "
                f"{'bound on the cost' if layer.counts_law else 'cost_cap'}"
            )
        while (totals := layer.totals(cap)) is None:  # as many as fit; the gap shows the loss
            check_time()
            cap /= 2.0
        if self._has_exact_tails:
            tails = layer.exact_tails
        elif self.tails is Tails.FAILING:
            facts = self.facts
            tails = layer.tails(facts.riskiest, facts.riskiest, facts.least.bound, exact=False)
        else:
            tails = layer.simple_tails
        counts = layer.counts_law and self._grows
        if counts and (least := self.facts.least_cost) is not None:
            tails = replace(tails, least_cost=base.quotient.least_over_members(least))
        return LayeredProcess(base, totals, tails, self.charge)

    def fits(self, cap: float) -> bool:
        """Return whether the layers up to a cap, in units, fit into memory.

        For layers that are sums of costs the result is true: their number is checked later.
        """
        base = self.layer.base
        return self.layer.by_sums or (cap + base.width) * base.n_nodes <= MOST_ENTRIES

    def _first_cap(self) -> float:
        """Return the first cap, in units: the layers that are always needed, plus a guess."""
        layer, facts, settled = self.layer, self.facts, self.charge.affine_from_total
        if self.fixed_cap is not None:
            return max(layer.units(self.fixed_cap), 1)
        if settled is not None and not self._grows:
            return self._settled_units()
        base, share = layer.base, written_out.TYPICAL
        if self.is_guess and layer.by_sums:
            share, (cost, goal) = _NEARLY, facts.cost_and_goal(facts.directed)
        elif not self._has_exact_tails and layer.guess is not None:
            cost, goal = layer.guess
        else:
            exact = self._has_exact_tails
            tails = layer.exact_tails if exact else layer.simple_tails
            cost, goal = float(base.start @ tails.first.cost), float(base.start @ tails.first.goal)
        first = layer.units(share * cost / max(goal + base.start_goal, 1e-300))
        if settled is None and not layer.by_sums:  # few layers if the charge is soon constant
            while first > 1 and self.charge.is_affine_beyond(0.5 * first * base.unit):
                first //= 2
            first = max(min(first, written_out.MOST_AT_FIRST // 2), written_out.FIRST_LAYERS)
        if not layer.by_sums:
            first += base.width
        elif not self.is_guess:
            first += float(step_costs(facts.model)[1][-1])
        needed = self._settled_units() if settled or layer.by_sums else 0
        return needed + first

    def _settled_units(self) -> float:
        """Return the total, in units, from which the charge is affine.

        For an exponential utility it is the total from which the stationary tail is optimal.
        """
        layer, settled, least = self.layer, self.charge.affine_from_total or 0.0, 1.0
        if layer.by_sums:  # so that total 0 has a layer
            dearest = float(step_costs(self.facts.model)[1].max())
            least = written_out.BEYOND * dearest or 1.0
        if layer.utility is not None:
            return max(layer.units(self.cost_horizon), least)
        if layer.by_sums:
            return max(settled * (1.0 + written_out.BEYOND), least)
        if layer.base.width == 1:
            return 1  # no step costs anything
        return max(layers_within(settled, layer.base.exact_unit), 1)

    def lossless_units(self, price: float) -> float:
        """Return the total, in units, from which failing is optimal at a price, with a margin.

        If the charge becomes constant, it is the total from which the charge is constant.
        """
        charge, settled = self.charge, self._settled_units()
        if charge.slope == 0.0:
            return settled
        room = 0 if self.layer.by_sums else 1
        return max(settled, self.layer.units(CAP_MARGIN * charge.lossless_total(price)) + room)

    def refined(self, price: float) -> CompiledLayered | None:
        """Return the problem with more layers or exact tails; None if neither would improve it.

        Args:
            price: price of failure at the optimum of this problem.
        """
        layer, here, exact = self.layer, self.process.end, self._has_exact_tails
        if self.fixed_cap is not None:
            return None if exact else replace(self, tails=Tails.LEAST_FAILURE)
        wanted, tails = 2.0 * here, Tails.LEAST_FAILURE
        if self.charge.affine_from_total is None:
            wanted = wanted if layer.by_sums else min(wanted, _MOST_LAYERS)
        elif not self._grows:
            return None
        else:
            lossless = self.lossless_units(price)
            most = (2.0 if exact and self.charge.is_the_total else MOST_GROWTH) * here
            is_near = (self.is_guess or here < lossless) and lossless <= most
            if is_near and self.is_guess and self.is_lossy:  # as in ``capped_at``
                wanted = 2.0 * lossless
            elif is_near:
                wanted, tails = lossless, self.tails if self.is_guess else tails
            elif not exact:
                wanted = here
        fits = layer.totals(wanted) is not None if layer.by_sums else self.fits(wanted)
        if exact and not self.is_guess and not (fits and here < wanted):
            return None
        if not fits:
            wanted, tails = here, Tails.LEAST_FAILURE
        return replace(self, cap=wanted, tails=tails)

    def charging(self, charge: Charge, cap: float | None = None) -> CompiledLayered:
        """Return the problem with another charge and cap; not for exponential utilities."""
        return replace(self, charge=charge, cap=cap)

    def safest(self) -> CompiledLayered:
        """Return the problem restricted to the policies of least failure."""
        return replace(self, layer=self.layer.safest, cap=None)

    def for_program(self) -> CompiledLayered:
        """Return the problem with exact tails, whose explicit process has the same optimum."""
        if self._has_exact_tails:
            return self
        exact = replace(self, tails=Tails.LEAST_FAILURE)
        return replace(exact, cap=exact.process.end)

    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> CompiledLayered:
        """Return the problem with as many layers as a value function.

        Simple tails are replaced by the policy of least goal probability alone.

        Args:
            values: the value function, [layers, nodes].
            levels: totals of the layers of a policy that was found with the value function; the
                last total is the cap. None: unknown.

        Raises:
            ModelError: the array has too few or too many layers for the charge.
        """
        layer, least = self.layer, self._settled_units()
        if values.ndim != 2 or values.shape[0] < (1 if layer.by_sums else least):
            raise ModelError(
                f"values of a wrong shape: pass an array of [layers, nodes], {least} or more layers"
            )
        n_layers, tails = values.shape[0], self.tails
        if not layer.by_sums:
            tails = tails if tails is Tails.LEAST_FAILURE else Tails.FAILING
            return replace(self, cap=n_layers, tails=tails)
        cap, end = least, None
        while layer.totals(cap) is None:  # as many as fitted
            check_time()
            cap /= 2.0
        if levels is not None and levels[-1] >= cap:
            capped = replace(self, cap=float(levels[-1]))
            if capped.process.cap == n_layers:
                return capped
        for _ in range(_DOUBLINGS):
            if (totals := layer.totals(cap)) is None:
                break
            if totals.size >= n_layers:  # the greatest cap with this number of sums
                end = float(totals.values[n_layers])
            if totals.size > n_layers:
                break
            cap *= 2.0
        if end is None:
            raise ModelError("values of too many layers: pass an array of fewer layers")
        return replace(self, cap=end)

    def least_failure(self) -> LeastFailure:
        """Return the policy of least charge among those of least failure.

        The policy may remember the accumulated cost. If the charge is the total cost itself, a
        policy without memory is optimal: a transition of cost g to x' is charged ``g * Pmax(x')``
        (mathematics, section 4).

        Raises:
            ModelError: runs have so many zero-cost steps that rounding errors add up.
        """
        facts = self.facts
        policy: Policy
        if not self.layer.counts_law:
            safest = facts.safest
            cost, goal = facts.cost_and_goal(safest)
            failure = float(facts.start @ safest.values.failure)
            policy = DeterministicPolicy(facts.model, safest.decision)
            column = Column(cost, failure, goal, None, policy=policy)
            bound = float(facts.start @ safest.bound)
        else:
            pricing = self.safest().pricing()
            column = pricing.minimise(0.0)
            if column.goal < float(facts.start @ facts.greatest.goal) - _LOST:
                raise ModelError(
                    "zero-cost cycles make a policy run too long for its failure probability to be "
                    "computed: give these actions a positive cost, or round the costs"
                )
            policy, bound = pricing.policy(column), pricing.prove(0.0, column).bound
            column = replace(column, choice=None, policy=policy)
        if self.ratio:
            greatest = min(float(facts.start @ facts.greatest.bound), 1.0)
            bound = bound / greatest if greatest > 0.0 else 0.0
        if self.ratio and column.goal > 0.0:
            bound = min(bound, column.cost / column.goal)
        proved = self.proved_failure(facts.greatest, column.failure)
        return LeastFailure(policy, column, bound, proved)

    @property
    def layers(self) -> int:
        """Number of layers below the cap."""
        return self.process.cap

    @property
    def n_columns(self) -> int:
        """Number of pairs of all layers."""
        return self.process.cap * len(self.layer.base.quotient.pair_at)

    def pricing(self) -> LayeredPricing:
        """Return the pricing problem, solved by one backward sweep over the layers."""
        return LayeredPricing(self.process)

    def explicit(self) -> ExplicitProcess:
        """Return the explicit process of all layers below the cap."""
        return written_out.materialise(self.process)

    def explicit_choice(self, column: Column) -> IntArray:
        """Return a column's pair in each state of the explicit process, [states].

        States are the nodes of all layers, those of the tails, and the source.
        """
        return written_out.chosen_pairs(self.process, required(column.choice), column.tail_price)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Return an upper bound of the error of a dual bound that is due to the cap."""
        return self.pricing().tail_loss(price, slack=slack, proof=proof)
