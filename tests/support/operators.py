"""The operators of sections 3.3 and 3.5 of the paper, written out on nested dictionaries.

States are (state, label) in case M, with labels "s" and "f", and (state, accumulated cost) in case
S; END is the artificial state ``*``. ``scale`` is eta / epsilon throughout.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping

from references import s3p
from references.chain import PlainModel, State, reaching

END = "*"
Node = tuple[State, object]
Stage = dict[Node, list[list[tuple[float, object, float]]]]


def actions_of(model: PlainModel, state: State) -> dict:
    """The actions of a state; goals and states without actions wait for nothing."""
    return model.choices.get(state) or {"wait": [(1.0, state, 0.0)]}


def label_choices(model: PlainModel, node: Node, leaving: bool) -> list[tuple[list, str]]:
    """U(x') of section 3.3: (outcomes of u, j) at a (state, label).

    ``leaving``: whether (u, f) is listed for actions u that may leave the attention states too.
    """
    state, label = node
    actions = actions_of(model, state)
    staying = [
        a for a, outs in actions.items() if all(o[1] in model.attention for o in outs)
    ] if state in model.attention else []  # fmt: skip
    if label == "f":
        return [(actions[staying[0]] if staying else next(iter(actions.values())), "f")]
    failing = [] if not staying else list(actions) if leaving else staying
    return [(o, "s") for o in actions.values()] + [(actions[a], "f") for a in failing]


def label_objective(model: PlainModel, node: Node, cost: float) -> float:
    """G_o of section 3.1.2."""
    if node[1] == "s":
        return cost
    return 1.0 if node[0] in model.goals else 0.0


def label_posteriors(alpha: float, gamma: float, depth: int) -> list[float]:
    """alpha_0, alpha_1, ... by nu of section 3.3."""
    found = [alpha]
    for _ in range(depth - 1):
        found.append(found[-1] / (found[-1] + gamma * (1.0 - found[-1])))
    return found


def bayes_label(
    model: PlainModel,
    gamma: float,
    alpha: float,
    scale: float,
    depth: int,
    *,
    printed: bool = False,
    leaving: bool = True,
) -> dict[Node, float]:
    """T^depth 0 of case M at (x', alpha); ``printed`` weighs G-bar by q-bar once more."""
    nodes = [(x, i) for x in [*model.choices, *model.goals] for i in "sf"]
    values: Mapping = defaultdict(float)
    for now in reversed(label_posteriors(alpha, gamma, depth)):
        values = {END: 0.0} | {
            node: min(
                _backup(model, node, outcomes, j, gamma, now, scale, values, printed)
                for outcomes, j in label_choices(model, node, leaving)
            )
            for node in nodes
        }
    return dict(values)


def _backup(
    model: PlainModel,
    node: Node,
    outcomes: list,
    j: str,
    gamma: float,
    alpha: float,
    scale: float,
    values: Mapping,
    printed: bool,
) -> float:
    """One action of T: the mixtures q-bar and G-bar over x'', and what follows."""
    q_bar: dict = defaultdict(float)
    g_bar: dict = defaultdict(float)
    label = "s" if (node[1], j) == ("s", "s") else "f"
    lost = 0.0 if node[0] in model.goals else 1.0 - gamma
    for p, successor, cost in outcomes:
        after = (successor, label)
        q_bar[after] += alpha * p + (1.0 - alpha) * gamma * p
        g_bar[after] += alpha * label_objective(model, node, cost) * p
        g_bar[after] += (1.0 - alpha) * scale * lost * gamma * p
    q_bar[END] += (1.0 - alpha) * (1.0 - gamma)
    g_bar[END] += (1.0 - alpha) * scale * lost * (1.0 - gamma)
    if printed:
        return sum(q_bar[x] * (g_bar[x] + values[x]) for x in q_bar)
    return sum(g_bar[x] + q_bar[x] * values[x] for x in q_bar)


def stationary_label(
    model: PlainModel, gamma: float, alpha: float, scale: float, depth: int, leaving: bool
) -> dict[Node, float]:
    """T_alpha^depth 0 of section 3.5, case M."""
    values: dict[Node, float] = defaultdict(float)
    nodes = [(x, i) for x in [*model.choices, *model.goals] for i in "sf"]
    for _ in range(depth):
        values = {
            node: min(
                sum(
                    p
                    * (
                        alpha * label_objective(model, node, cost)
                        + scale * (1.0 - alpha) * (node[0] not in model.goals) * (1.0 - gamma)
                        + gamma * values[x, "s" if (node[1], j) == ("s", "s") else "f"]
                    )
                    for p, x, cost in outcomes
                )
                for outcomes, j in label_choices(model, node, leaving)
            )
            for node in nodes
        }
    return values


Tail = Callable[[State, float, float], float]


def cost_tail(
    model: PlainModel, policy: Mapping, gamma: float, scale: float, *, discounted: bool
) -> Tail:
    """V of section 3.5.1 beyond M: (state, paid, alpha) -> value of the policy pi'_or from there.

    ``discounted``: whether J_obj is discounted beyond M as well; the paper's is not.
    """
    goal, cost = s3p.values(model, policy, gamma if discounted else None)
    ever = s3p.values(model, policy, gamma)[0]

    def value(state: State, paid: float, alpha: float) -> float:
        if state in model.goals:
            return 0.0
        early = goal.get(state, 0.0) / (gamma if discounted else 1.0)
        objective = paid * early + cost.get(state, 0.0)
        return alpha * objective + (1.0 - alpha) * scale * (1.0 - ever.get(state, 0.0))

    return value


def cost_game(
    model: PlainModel, start: State, gamma: float, alpha: float, scale: float, cap: int,
    tail: Tail, *, bayes: bool,
) -> float:  # fmt: skip
    """The value at (start, 0) of case S, every step of which costs at least 1.

    With ``bayes`` the operator T of section 3.3 along the belief, else T_alpha of section 3.5;
    both over the policies that follow pi'_or from the cost ``cap`` on.
    """
    hopeful = reaching({s: [o for a in actions_of(model, s).values() for o in a]
                        for s in model.choices}, model.goals)  # fmt: skip
    known: dict = {}

    def value(state: State, paid: int, time: int, now: float) -> float:
        if state in model.goals:
            return 0.0
        if paid >= cap:
            return tail(state, paid, now)
        if state not in hopeful:
            return (1.0 - now) * scale
        key = (state, paid, time if bayes else 0)
        if key not in known:
            onward = (now + (1.0 - now) * gamma) if bayes else gamma
            later = now / (now + gamma * (1.0 - now)) if bayes else now
            known[key] = min(
                (1.0 - now) * scale * (1.0 - gamma)
                + sum(
                    p * (now * (paid + cost) * (x in model.goals)
                         + onward * value(x, paid + cost, time + 1, later))
                    for p, x, cost in outcomes
                )
                for outcomes in actions_of(model, state).values()
            )  # fmt: skip
        return known[key]

    return value(start, 0, 0, alpha)
