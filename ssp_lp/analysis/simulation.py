"""Simulation of a policy, vectorised over episodes, in the model or in a world of your own.

Means have confidence intervals that are valid for rare expensive events, too (:class:`Estimate`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import scipy.sparse as sp

from ssp_lp.analysis.evaluation import entering_charges, lost_situations, state_give_up_charges
from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    drawn_in_segments,
    read_only,
    segment_ids,
    segment_minima,
)
from ssp_lp.errors import ModelError, as_percentage, check_between_0_and_1, check_whole
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.continuous_model import Moved, World, WorldSimulator
from ssp_lp.model.graph import attention_states, dead_ends, end_marks, stop_marks
from ssp_lp.model.product import ProductSSP
from ssp_lp.model.report import ByName, Facts, Table
from ssp_lp.model.ssp import ImplicitSSP
from ssp_lp.options import progress_shown
from ssp_lp.policies import MixedPolicy, Policy
from ssp_lp.policies.policy import GIVE_UP_CODE, MOST_EPISODES, Randomness, as_lottery, generator_of
from ssp_lp.problem import Problem, on_one_model
from ssp_lp.processes.failure_semantics import GiveUp


class Estimate(NamedTuple):
    """A mean and its confidence interval."""

    value: float
    low: float
    high: float
    confidence: float
    standard_error: float | None = None  # of a mean cost

    def __str__(self) -> str:
        """Return the mean, its standard error and interval, or that no episode reached the goal."""
        if self.value != self.value:
            return "unknown: no episode reached the goal"
        error = "" if self.standard_error is None else f" ± {self.standard_error:.2g}"
        return f"{self.value:.4g}{error} [{self.low:.4g}, {self.high:.4g}]"


def proportion_estimate(hits: int, trials: int, confidence: float) -> Estimate:
    """Return the estimate of a probability with Clopper and Pearson's exact interval."""
    from scipy import special

    miss = (1.0 - confidence) / 2.0
    low = 0.0 if hits == 0 else float(special.betaincinv(hits, trials - hits + 1, miss))
    high = 1.0 if hits == trials else float(special.betaincinv(hits + 1, trials - hits, 1.0 - miss))
    return Estimate(hits / trials, low, high, confidence)


def mean_estimate(sample: FloatArray, confidence: float, most: float) -> Estimate:
    """Return the estimate of a mean cost, with an interval that is valid for any distribution.

    The interval covers rare expensive events that the sample does not contain, unlike normal
    intervals and the bootstrap. The upper end is the empirical Bernstein bound for costs up to
    ``most``. The lower end needs no greatest cost: it is the integral of the sample's survival
    function, less the greatest amount by which this function is likely to exceed the true one. If
    an episode pays for ever, the mean and both ends are infinite; without a sample they are nan.

    Args:
        sample: costs in [0, most], independent and identically distributed.
        confidence: confidence of the interval, with half of the error on either side.
        most: greatest cost that can occur.

    Reference:
        Maurer and Pontil, COLT 2009, theorem 4; Anderson, Confidence limits for the expected value
        of an arbitrary bounded random variable, 1969, with Massart's constant (1990).
    """
    if sample.size == 0:
        return Estimate(float("nan"), float("nan"), float("nan"), confidence)
    mean, most = float(sample.mean()), max(most, float(sample.max()))
    if sample.size == 1 or mean == float("inf"):
        return Estimate(mean, 0.0 if mean < float("inf") else mean, most, confidence)
    log = float(np.log(4.0 / (1.0 - confidence)))
    spread = float(np.sqrt(2.0 * log / sample.size) * sample.std(ddof=1))
    unseen = 7.0 * log / (3.0 * (sample.size - 1))  # times the range: error of the variance
    exceed = float(np.sqrt(np.log(2.0 / (1.0 - confidence)) / (2.0 * sample.size)))
    above = np.arange(sample.size, 0, -1) / sample.size  # share of the sample from each cost up
    low = float(np.diff(np.sort(sample), prepend=0.0) @ np.maximum(above - exceed, 0.0))
    error = float(sample.std(ddof=1) / np.sqrt(sample.size))
    return Estimate(mean, low, min(mean + spread + unseen * most, most), confidence, error)


def greatest_total(
    model: SSP, steps: int, pairs: BoolArray | None = None, most_work: int = 300_000_000
) -> tuple[float, bool]:
    """Return an upper bound of the total cost of an episode with at most ``steps`` steps.

    Steps within a strong component may be repeated, and count as the most expensive of them. All
    other steps occur at most once; their total is that of the most expensive path through the
    components.

    Args:
        model: the model.
        steps: greatest number of steps of an episode.
        pairs: pairs of the policy, [pairs]; None: all.
        most_work: greatest number of outcomes to examine for this path, a few seconds' work. If it
            does not suffice, each step counts as the most expensive step of the model.

    Returns:
        The bound, and whether more steps would increase it.
    """
    over = dead_ends(model) | model.goal_mask
    starts = model.outcome_offsets[model.pair_offsets]  # of each state's outcomes, [states + 1]
    source = segment_ids(starts)
    occurs = model.probabilities > 0.0
    if pairs is not None:
        occurs &= np.repeat(pairs, np.diff(model.outcome_offsets))
    entries = np.ones(int(occurs.sum())), (source[occurs], model.successors[occurs])
    graph = sp.csr_array(entries, shape=(model.n_states, model.n_states))
    label = sp.csgraph.connected_components(graph, connection="strong")[1]
    going, again = occurs & ~over[source], label[source] == label[model.successors]
    dearest = steps * float(model.costs[going].max(initial=0.0))
    repeated = steps * float(model.costs[going & again].max(initial=0.0))
    paid, total = np.where(going & ~again, model.costs, -np.inf), np.zeros(model.n_states)
    for sweep in range(steps):
        before = total
        total = np.maximum(-segment_minima(-(paid + before[model.successors]), starts), 0.0)
        if (total == before).all():
            break
        if sweep * model.n_outcomes > most_work:
            return dearest, True
    return min(dearest, repeated + float(total.max())), repeated > 0.0


def pairs_taken(policy: MixedPolicy, model: SSP) -> BoolArray | None:
    """Return the pairs that a simulated policy may take, [pairs]; None if unknown."""
    try:
        table = policy.table()
    except ModelError:
        return None
    taken = np.zeros(model.n_pairs, dtype=np.bool_)
    for member in table.members:
        for block in member.decisions():
            taken[block.pair[(block.pair >= 0) & (block.probability > 0.0)]] = True
    return taken


_LOG = logging.getLogger("ssp_lp.simulation")


@runtime_checkable
class Simulator(Protocol):
    """A world in which episodes are played, many at a time."""

    def reset(self, episodes: int, rng: np.random.Generator) -> tuple[World, IntArray]:
        """Start episodes; return their worlds, [episodes, ...], and states, [episodes]."""

    def step(self, world: World, pair: IntArray, rng: np.random.Generator) -> Moved:
        """Take one step in each of k simulated episodes.

        Args:
            world: state of each world, [k, ...].
            pair: state-action pairs of the model, [k].

        Returns:
            The next worlds, [k, ...], the model's states that correspond to them, and the costs of
            the step, [k] each.
        """


@dataclass(frozen=True, eq=False)
class ModelSimulator:
    """A simulator that draws from a model.

    A world is a state of the model. If the model is a product (with memory or time), a world is a
    state of the original model.
    """

    model: SSP
    start: FloatArray  # [states]
    stated: SSP | None = None  # the model of which ``model`` is a product; None: ``model`` itself

    def reset(self, episodes: int, rng: np.random.Generator) -> tuple[World, IntArray]:
        """Draw start states; return the worlds and the model's states, [episodes] each."""
        state = rng.choice(self.model.n_states, size=episodes, p=self.start)
        return self._stated[0][state], state

    def step(self, world: World, pair: IntArray, rng: np.random.Generator) -> Moved:
        """Draw one outcome of each pair by inversion of its distribution."""
        (seen, costs), offsets = self._stated, self.model.outcome_offsets
        outcome = drawn_in_segments(self._sums, offsets[pair], offsets[pair + 1], rng)
        successor = self.model.successors[outcome].astype(np.int64)
        return seen[successor], successor, costs[outcome]

    @cached_property
    def _stated(self) -> tuple[IntArray, FloatArray]:
        """For each state, its state in the original model; for each outcome, its original cost."""
        model, stated = self.model, self.model if self.stated is None else self.stated
        state: IntArray = np.arange(model.n_states)
        outcome: IntArray = np.arange(model.n_outcomes)
        while model is not stated and isinstance(model, ProductSSP):
            state, outcome = model.original_state[state], model.original_outcome[outcome]
            model = model.original
        return state, model.costs[outcome]

    @cached_property
    def _sums(self) -> FloatArray:
        """Cumulative sums of the outcomes' probabilities, beginning with 0, [outcomes + 1]."""
        return np.append(0.0, np.cumsum(self.model.probabilities))


@dataclass(frozen=True, eq=False)
class _ProductSimulator:
    """A simulator of a product: it simulates the original model, and updates the memory."""

    inner: Simulator
    product: ProductSSP

    def reset(self, episodes: int, rng: np.random.Generator) -> tuple[World, IntArray]:
        """Start episodes, each with the initial memory of its start state."""
        world, state = self.inner.reset(episodes, rng)
        return world, self.product.table[state, self.product.first_memory(state)]

    def step(self, world: World, pair: IntArray, rng: np.random.Generator) -> Moved:
        """Take a step in the original model's world, and update the memory."""
        moved, state, cost = self.inner.step(world, self.product.original_pair[pair], rng)
        _check_simulated_states(self.product.original, state)
        return moved, self.product.moved(pair, state, cost), cost


def _on_products(simulator: Simulator, model: SSP, stated: SSP) -> Simulator:
    """Return a simulator of the solved model, given a simulator of the stated model.

    The solved model is the stated model, or a product built from it.
    """
    if model is stated or not isinstance(model, ProductSSP):
        return simulator
    return _ProductSimulator(_on_products(simulator, model.original, stated), model)


@dataclass(frozen=True, eq=False, repr=False)
class SimulationReport(Facts, ReadOnlyCopies):
    """Counts and estimates of simulated episodes."""

    episodes: int
    ends: Mapping[str, int]  # goal, each label, dead_end, gave_up, unfinished
    goal_probability: Estimate
    conditional_cost: Estimate  # mean total cost of the episodes that reached the goal in time
    expected_cost: Estimate  # mean cost until the goal or failing, as in ``Evaluation``
    success_costs: FloatArray  # [successes] total costs of the episodes that reached the goal
    mean_steps: float
    max_steps: int  # after which an episode counted as unfinished
    paths: tuple[World, ...]  # worlds of the first recorded episodes, [steps + 1, ...] each
    cost_after_failing: Estimate | None = None  # until the true end; None: failing ends runs
    is_most_cut: bool = False  # whether only max_steps bounds the total cost

    @property
    def note(self) -> str:
        """Note on unfinished episodes, or on costs that only ``max_steps`` bounds; else empty."""
        cut, steps = self.ends["unfinished"], f"{self.max_steps:,} steps"
        if cut:
            return f"costs are cut: {cut:,} episodes were unfinished after {steps}"
        if self.is_most_cut:
            told = "upper ends of costs allow for an unseen episode of"
            return f"{told} {steps}; a smaller max_steps lowers them"
        return ""

    @property
    def failure_probability(self) -> Estimate:
        """Simulated probability of not reaching the goal, unfinished episodes included."""
        reached = self.goal_probability
        miss = 1.0 - reached.value, 1.0 - reached.high, 1.0 - reached.low
        return Estimate(*miss, reached.confidence)

    def tables(self) -> list[Table]:
        """Return a table of the ends of the episodes, and the costs with their intervals."""
        return [
            Table([
                ("episodes", self.episodes),
                ("ends", self.ends),
                ("failure probability", self.failure_probability),
                ("cost given success", self.conditional_cost),
                ("cost until failure", self.expected_cost),
                ("cost after failing", self.cost_after_failing),
                ("mean steps", self.mean_steps),
                ("note", self.note),
            ])
        ]  # fmt: skip


@explained
def simulate(
    policy: Policy | MixedPolicy,
    problem: Problem,
    *,
    episodes: int = 10_000,
    seed: Randomness = 0,
    max_steps: int = 10_000,
    simulator: Simulator | None = None,
    record: int = 0,
    confidence: float = 0.95,
    verbose: bool = False,
) -> SimulationReport:
    """Play episodes and count how they end.

    An episode ends at a goal, in a dead-end, when the policy gives up, or unfinished after
    ``max_steps``. A mixed policy draws one member for each episode. Costs count as in
    :func:`evaluate`, until the policy can no longer reach the goal of the model.

    Intervals of probabilities are Clopper and Pearson's. Intervals of mean costs are valid for rare
    expensive events, too (``mean_estimate``). Their upper ends, by empirical Bernstein, depend on
    the most expensive episode that the policy can play in ``max_steps`` steps (in a world of your
    own, at the model's costs). The cost of an unfinished episode is the cost of its ``max_steps``
    steps. The report's ``note`` says whether there are unfinished episodes, and whether only
    ``max_steps`` bounds the total cost.

    Args:
        policy: the policy, on the problem's model.
        problem: problem with the start and the cost of failing.
        episodes: number of episodes.
        seed: source of all randomness: a number, with which every call plays the same episodes, or
            a generator.
        max_steps: steps after which an episode counts as unfinished.
        simulator: the world in which episodes are played, such as a continuous one; None: the
            model.
        record: number of episodes, the first ones, whose paths are in the report.
        confidence: confidence of the intervals.
        verbose: show progress (``ssp_lp.progress_shown``).

    Raises:
        ModelError: wrong arguments, or a state in which the policy has no decision.
    """
    check_between_0_and_1("confidence", confidence, as_percentage(confidence))
    check_whole("episodes", episodes, most=MOST_EPISODES)
    check_whole("max_steps", max_steps)
    check_whole("record", record, 0)
    played_by, solved = on_one_model(policy, problem, "simulate")
    if isinstance(simulator, WorldSimulator):
        simulator.check_model(problem.model)
    stated = solved.model if isinstance(problem.model, ImplicitSSP) else problem.model
    taken = pairs_taken(played_by, solved.model) if simulator is None else None
    if simulator is None:
        world: Simulator = ModelSimulator(solved.model, solved.start_mass, stated)
    else:
        world = _on_products(simulator, solved.model, stated)
    source, limits = generator_of(seed), (max_steps, record)
    with progress_shown(verbose):
        played = _simulate_episodes(played_by, solved, world, episodes, source, *limits)
        most = greatest_total(solved.model, max_steps, taken)
        report = _report_of(solved, played, float(confidence), max_steps, *most)
        _LOG.info("%r", report)
    return report


@dataclass(frozen=True, eq=False)
class _Played:
    """Results of simulated episodes."""

    mark: IntArray  # [episodes] numbers of graph.end_marks, -1 for unfinished
    cost: FloatArray  # [episodes] total of stage costs until failing
    charge: FloatArray  # [episodes] charge for failing
    later: FloatArray  # [episodes] total of stage costs after failing
    steps: IntArray  # [episodes]
    paths: tuple[World, ...]


def _simulate_episodes(
    policy: Policy | MixedPolicy,
    problem: Problem,
    simulator: Simulator,
    episodes: int,
    rng: np.random.Generator,
    max_steps: int,
    record: int,
) -> _Played:
    """Play all episodes of a simulation, one step of each at a time."""
    model, marks = problem.model, end_marks(problem.model)
    players = as_lottery(policy).start_many(episodes, rng)
    world, state = simulator.reset(episodes, rng)
    world, state = world.copy(), np.array(state, dtype=np.int64)
    players.begin(state, marks[state] < 0)
    cost, later, steps = np.zeros(episodes), np.zeros(episodes), np.zeros(episodes, dtype=np.int64)
    gave_up, lost = np.zeros((2, episodes), dtype=np.bool_)
    charge, charges = np.zeros(episodes), _failing_charges(problem)
    label, lost_in = model.failure_label, cache(lambda member: lost_situations(member, problem))
    watched = attention_states(model) & (marks < 0)  # elsewhere no policy has lost the goal
    watched &= problem.semantics.give_up is not GiveUp.DEAD_ENDS  # which pays until a dead-end
    trace = [world[:record].copy()]
    for step in range(max_steps):
        alive = np.flatnonzero((marks[state] < 0) & ~gave_up)
        if alive.size == 0:
            break
        over = episodes - alive.size
        share = {"share": over / episodes}
        _LOG.debug("step %d, %d of %d episodes are over", step, over, episodes, extra=share)
        unsure = alive[watched[state[alive]] & ~lost[alive]]
        for member, mine in players.shares(unsure):
            here = unsure[mine]
            here = here[lost_in(member)(state[here], players.memory[here])]
            lost[here], charge[here] = True, charges[1][state[here]]
        pair = players.decide(alive, state[alive])
        gave_up[alive[pair == GIVE_UP_CODE]] = True
        alive, pair = alive[pair != GIVE_UP_CODE], pair[pair != GIVE_UP_CODE]
        moved, successor, paid = simulator.step(world[alive], pair, rng)
        _check_simulated_states(model, successor)
        if not (np.isfinite(paid) & (np.asarray(paid) >= 0)).all():
            raise ModelError("the simulator returned a cost that is negative or not finite")
        world[alive], state[alive] = moved, successor
        past = lost[alive]
        if label is not None:
            failed = label.after[successor]
            later[alive] += np.where(past | failed, paid, 0.0)
            paid = np.where(failed, model.costs[model.outcome_offsets[pair]], paid)
        cost[alive] += np.where(past, 0.0, paid)
        steps[alive] += 1
        going = marks[successor] < 0
        players.remember(alive[going], pair[going], successor[going], paid[going])
        if record:
            trace.append(world[:record].copy())
    mark = np.where(gave_up, stop_marks(model)[state], marks[state])  # < 0: unfinished
    history = np.stack(trace)
    paths = tuple(history[: int(steps[i]) + 1, i] for i in range(min(record, episodes)))
    ended = np.where(gave_up, charges[1][state], charges[0][state])
    return _Played(mark, cost, np.where(lost, charge, ended), later, steps, paths)


def _check_simulated_states(model: SSP, state: IntArray) -> None:
    """Raise :class:`ModelError` unless a simulator returned states of the model."""
    if ((state < 0) | (state >= model.n_states)).any():
        raise ModelError(f"the simulator returned a state outside 0 .. {model.n_states - 1}")


def _failing_charges(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return two charges, [states] each: of entering a dead-end, and of failing elsewhere."""
    model, semantics = problem.model, problem.semantics
    entering = entering_charges(model, semantics)
    if semantics.forbids_failing:
        return np.where(dead_ends(model), np.inf, entering), np.full(model.n_states, np.inf)
    return entering, state_give_up_charges(model, semantics)


def _report_of(
    problem: Problem, played: _Played, confidence: float, max_steps: int, most: float, is_cut: bool
) -> SimulationReport:
    """Return the report of simulated episodes.

    Args:
        problem: problem whose model was played.
        played: results of the episodes.
        confidence: confidence of the intervals.
        max_steps: steps after which an episode counted as unfinished.
        most: greatest total that an episode can pay in ``max_steps`` steps.
        is_cut: whether more steps would increase the greatest total.
    """
    names = ["goal", *problem.model.state_labels, "dead_end", "gave_up"]
    ends = {name: int((played.mark == i).sum()) for i, name in enumerate(names)}
    ends["unfinished"] = int((played.mark < 0).sum())
    reached, after = played.mark == 0, None
    charged = most + float(problem.model.costs.max(initial=0.0))  # failing costs at most a step
    if (label := problem.model.failure_label) is not None:
        later = max_steps * float(label.original.costs.max(initial=0.0))
        after = mean_estimate(played.later, confidence, later)
    return SimulationReport(
        episodes=len(played.mark),
        ends=ByName(ends),
        goal_probability=proportion_estimate(int(reached.sum()), len(played.mark), confidence),
        conditional_cost=mean_estimate(played.cost[reached], confidence, most),
        expected_cost=mean_estimate(played.cost + played.charge, confidence, charged),
        success_costs=read_only(played.cost[reached]),
        mean_steps=float(played.steps.mean()),
        max_steps=max_steps,
        paths=played.paths,
        cost_after_failing=after,
        is_most_cut=is_cut,
    )
