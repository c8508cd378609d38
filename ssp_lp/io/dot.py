"""The chain that a policy makes of its model, as a graph for Graphviz."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping
from os import PathLike
from pathlib import Path

from ssp_lp.analysis.chain import Chain, policy_chain
from ssp_lp.errors import ModelError
from ssp_lp.io.policy_tables import memories_of
from ssp_lp.model.arguments import explained
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.mixed import as_lottery
from ssp_lp.policies.policy import GIVE_UP_CODE, Policy
from ssp_lp.processes.failure_semantics import start_distribution

_MOST_NODES = 300
"""More than this no picture shows; Graphviz would take minutes, too."""


@explained
def write_dot(
    policy: Policy | MixedPolicy,
    path: str | PathLike[str],
    start: Hashable | Mapping[Hashable, float],
    *,
    most_nodes: int = _MOST_NODES,
) -> None:
    """Write what a policy does from a start as a graph: ``dot -Tsvg FILE`` draws it.

    A node is a state with what is remembered, and the action taken there (with its probability, if
    it is drawn); an edge is a step with its probability. Goals have two rings, dead-ends and giving
    up a box. The members of a lottery stand side by side.

    Args:
        policy: any policy of the library.
        path: of the file, ``policy.dot``.
        start: a state, or ``{state: probability}``.
        most_nodes: refuse more nodes than this.

    Raises:
        ModelError: there are more nodes, the policy has no decision in a state that it reaches, or
            is of a class whose memory is not known.
    """
    lottery = as_lottery(policy)
    first = start_distribution(lottery.model, start)
    chains = [policy_chain(lottery.model, member, first) for member in lottery.policies]
    count = sum(chain.n_nodes for chain in chains)
    if count > most_nodes:
        raise ModelError(f"the policy's chain has {count:,} nodes, more than {most_nodes:,}")
    lines = ["digraph policy {", "  rankdir=LR;", "  node [shape=ellipse];"]
    for k, (member, chain) in enumerate(zip(lottery.policies, chains, strict=True)):
        lines.append(f"  subgraph cluster_{k} {{")
        if len(chains) > 1:
            lines.append(f"    label={_dot_text(f'with probability {lottery.weights[k]:.6g}')};")
        lines += [f"    {line}" for line in (*_dot_nodes(member, chain, k), *_dot_edges(chain, k))]
        lines.append("  }")
    Path(path).write_text("\n".join([*lines, "}", ""]), encoding="utf-8")


def _dot_nodes(policy: Policy, chain: Chain, member: int) -> Iterator[str]:
    """The nodes of the graph, as lines of dot."""
    model, told = chain.model, dict(memories_of(policy))
    actions = defaultdict(list)
    branches = zip(chain.branch_node, chain.branch_pair, chain.branch_probability, strict=True)
    for node, pair, probability in branches:
        action = "give up" if pair == GIVE_UP_CODE else f"{model.action_of(int(pair))}"
        share = "" if probability == 1.0 else f" {probability:.6g}"
        actions[int(node)].append(f"{action}{share}")
    for node in range(chain.n_nodes):
        memory = told.get(int(chain.memory[node]))
        goal, dead = chain.goal[node] > 0.0, chain.dead[node] > 0.0
        name = f"{model.states[int(chain.state[node])]}"
        if memory is not None and not (goal or dead):
            name += f" | {memory}"
        shape = ", shape=doublecircle" if goal else ", shape=box" if dead else ""
        if chain.give_up[node] == 1.0:
            shape = ", shape=box"
        if chain.start[node] > 0.0:
            shape += ", penwidth=2"
        yield f"n{member}_{node} [label={_dot_text(chr(10).join([name, *actions[node]]))}{shape}];"


def _dot_edges(chain: Chain, member: int) -> Iterator[str]:
    """The edges of the graph, as lines of dot."""
    steps = chain.matrix.tocoo()
    for source, target, probability in zip(steps.row, steps.col, steps.data, strict=True):
        if probability > 0.0:
            share = f"{probability:.6g}"
            yield f"n{member}_{source} -> n{member}_{target} [label={_dot_text(share)}];"


def _dot_text(text: str) -> str:
    """A text in quotation marks, as dot reads it."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'
