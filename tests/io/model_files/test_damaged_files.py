"""A sample of `examples/checks/damaged_files.py`: damaged files are read, or refused by name."""

import pytest

from examples.checks.damaged_files import READ, REFUSED, damaged, verdict


@pytest.mark.parametrize("ending", ["json", "json.gz", "nested.json", "explicit.json", "prism"])
def test_damaged_files_are_read_or_refused_by_name(ending, tmp_path):
    found = {
        number: verdict(ending, tmp_path / f"m.{ending}")
        for number, _ in damaged(ending, tmp_path, range(40))
    }
    assert set(found.values()) <= {READ, REFUSED}
    assert list(found.values()).count(REFUSED) > 20


MANY = 10**12
CLAIMS = [
    ("json", f'{{"format": "explicit-mdp-v1", "num_states": {MANY}, "choices": [[]]}}'),
    ("json", f'{{"format": "explicit-mdp-v1", "goal": [{MANY}], "choices": [[]]}}'),
    ("drn", f"@type: MDP\n@nr_states\n{MANY}\n@model\nstate 0 goal\n\taction 0\n\t\t0 : 1\n"),
    ("prism", f'mdp\nmodule m\n x : [0..{MANY}] init 0;\nendmodule\nlabel "goal" = x = 0;\n'),
]


@pytest.mark.parametrize(("ending", "text"), CLAIMS)
def test_a_claim_of_many_states_takes_no_memory(ending, text, tmp_path):
    path = tmp_path / f"m.{ending}"
    path.write_text(text, encoding="utf-8")
    assert verdict(ending, path) in (READ, REFUSED)
