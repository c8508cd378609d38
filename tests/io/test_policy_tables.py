"""Tables of policies say what the policies do."""

import importlib.util
import sys
from types import SimpleNamespace

import pytest

from named_policies import EVERY, made, start_of
from played import everywhere, hall
from refusing import refused
from ssp_lp import GIVE_UP, MissingDependencyError
from ssp_lp.policies.chain import policy_chain
from ssp_lp.policies.policy import as_lottery
from ssp_lp.policies.remembering import JointMemory, common_memory
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
    joint = table_of(JointMemory(common_memory(as_lottery(timed)), timed))
    assert {(k, s, memory[0], a): p for (k, s, memory, a), p in joint.items()} == table_of(timed)


def test_a_frame_needs_pandas(monkeypatch):
    policy = everywhere(hall(), "fast")
    if importlib.util.find_spec("pandas") is None:
        words = r"pip install '\.\[frames\]'"
        refused(words, policy.to_frame, error=MissingDependencyError)
    made = SimpleNamespace(DataFrame=lambda rows, columns: (rows, columns))
    monkeypatch.setitem(sys.modules, "pandas", made)
    rows, columns = policy.to_frame()
    assert rows == [row._asdict() for row in policy.table()]
    assert columns == ["state", "memory", "action", "probability", "member"]
