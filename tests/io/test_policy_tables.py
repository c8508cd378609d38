"""Tables and graphs of policies say what the policies do."""

import importlib.util
import re
import sys
from types import SimpleNamespace

import pytest

from named_policies import EVERY, HALL, made, start_of
from played import START, everywhere, hall
from refusing import refused
from ssp_lp import GIVE_UP, MissingDependencyError
from ssp_lp.io import write_dot
from ssp_lp.policies.chain import policy_chain
from ssp_lp.policies.policy import as_lottery
from ssp_lp.policies.remembering import common_memory
from ssp_lp.processes.failure_semantics import start_distribution


def table_of(policy):
    return {(r.member, r.state, r.memory, r.action): r.probability for r in policy.table()}


def test_a_stationary_policy():
    assert table_of(made()["stochastic"]) == {
        (0, ("hall", 0), None, "fast"): 0.25,
        (0, ("hall", 0), None, ("slow", 1)): 0.75,
        (0, ("hall", 1), None, "fast"): 0.5,
        (0, ("hall", 1), None, GIVE_UP): 0.5,
        (0, ("hall", 2), None, "fast"): 1.0,
    }


@pytest.mark.parametrize("name", EVERY)
def test_what_is_reached_stands_in_the_table(name):
    """Every decision on the policy's chain, played by a person who keeps the memory in words."""
    policy, model = made()[name], made()[name].model
    rows, sums = set(), {}
    for row in policy.table():
        rows.add((row.member, row.state, row.action))
        key = row.member, row.state, row.memory
        sums[key] = sums.get(key, 0.0) + row.probability
    assert all(total == pytest.approx(1.0) for total in sums.values())
    for k, member in enumerate(as_lottery(policy).policies):
        chain = policy_chain(model, member, start_distribution(model, start_of(name)))
        for node, pair in zip(chain.branch_node, chain.branch_pair, strict=True):
            action = GIVE_UP if pair < 0 else model.action_of(int(pair))
            assert (k, model.states[int(chain.state[node])], action) in rows


def test_memories_in_words():
    told = {name: {row.memory for row in made()[name].table()} for name in EVERY}
    aware, cap = told["cost aware"], made()["cost aware"].cap
    assert {k for k in aware if not isinstance(k, str)} <= {float(k) for k in range(cap)}
    assert {k for k in aware if isinstance(k, str)} <= {"tail 0", "tail 1"}
    assert told["timed"] == told["remembering"] == {0, 1, 2}
    assert told["carried"] <= aware
    timed = made()["timed"]
    assert table_of(common_memory(as_lottery(timed)).followed_by(timed)) == table_of(timed)


def test_a_frame_needs_pandas(monkeypatch):
    policy = everywhere(hall(), "fast")
    if importlib.util.find_spec("pandas") is None:
        words = r"pip install '\.\[frames\]'"
        refused(words, policy.to_frame, error=MissingDependencyError)
    made = SimpleNamespace(DataFrame=lambda rows, columns: (rows, columns))
    monkeypatch.setitem(sys.modules, "pandas", made)
    rows, columns = policy.to_frame()
    assert rows == list(policy.table())
    assert columns == ["state", "memory", "action", "probability", "member"]


@pytest.mark.parametrize("name", HALL)
def test_a_graph_has_the_nodes_and_steps_of_the_chain(name, tmp_path):
    policy, path = made()[name], tmp_path / "policy.dot"
    write_dot(policy, path, START, most_nodes=2000)
    text, start = path.read_text(), start_distribution(policy.model, START)
    members = as_lottery(policy).policies
    chains = [policy_chain(policy.model, member, start) for member in members]
    nodes = re.findall(r"^ *n(\d+_\d+) \[label", text, flags=re.MULTILINE)
    steps = re.findall(r'n\d+_\d+ -> n\d+_\d+ \[label="([\d.e-]+)"\]', text)
    assert len(nodes) == len(set(nodes)) == sum(chain.n_nodes for chain in chains)
    moving = sum(float((chain.matrix.sum(axis=1))[()].sum()) for chain in chains)
    assert sum(map(float, steps)) == pytest.approx(moving, rel=1e-4)
    assert text.count("{") == text.count("}")
    assert ("doublecircle" in text) == any(chain.goal.any() for chain in chains)


def test_a_small_graph_in_full(tmp_path):
    write_dot(everywhere(hall(), "fast"), tmp_path / "policy.dot", ("hall", 2))
    lines = (tmp_path / "policy.dot").read_text().splitlines()
    assert [line.strip() for line in lines] == [
        "digraph policy {",
        "rankdir=LR;",
        "node [shape=ellipse];",
        "subgraph cluster_0 {",
        "n0_0 [label=\"('hall', 2)\\nfast\", penwidth=2];",
        'n0_1 [label="pit", shape=box];',
        "n0_2 [label=\"('hall', 3)\", shape=doublecircle];",
        'n0_0 -> n0_0 [label="0.2"];',
        'n0_0 -> n0_1 [label="0.1"];',
        'n0_0 -> n0_2 [label="0.7"];',
        "}",
        "}",
    ]


def test_a_graph_too_large_is_refused(tmp_path):
    path, policy = tmp_path / "policy.dot", everywhere(hall(), "fast")
    refused("5 nodes, more than 4", write_dot, policy, path, START, most_nodes=4)
    assert not path.exists()
