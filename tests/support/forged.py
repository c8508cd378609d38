"""Certificate files written by hand, and what is said of them."""

import gzip
import json

from ssp_lp import check_certificate

GOAL = {"name": "g", "sets": ["goal"], "actions": []}
DEAD = {"name": "d", "sets": [], "actions": []}
NOTHING = {"constant": "0", "terms": []}
COST = {"constant": "0", "terms": [["1", "cost", 0]]}
SPENT = [[">=", "0", "0", "1"]]  # a total is charged itself


def state(**actions):
    return {"name": "s", "sets": [], "actions": [[name, *rest] for name, rest in actions.items()]}


def proof(*lines, **head):
    """A proof in units of 1: its head, and a line for each node."""
    kept = {"cap": "0", "prices": ["0"], "weights": ["1"], "unit": 1, "lines": len(lines)}
    return [kept | head, *lines]


def lines_stating(states, *proofs, answer=None, **stated):
    """Lines of a file with this question."""
    question = {
        "format": "ssp-lp certificate 2", "states": len(states), "costs": 1, "sets": [],
        "start": [["1", 0]], "give_up": "dead_ends", "charge_failing_step": False,
        "greatest": False, "objective": COST, "failure": None, "discount": None, "horizon": None,
        "rows": [], "ratio": False, "charge": [], "quantile": None, **stated,
    }  # fmt: skip
    told = [question, *states, {"answer": answer}, *(line for lines in proofs for line in lines)]
    return [json.dumps(line).encode() for line in told]


def verdict(path, states, *proofs, answer=None, **stated):
    """What is said of a file with this question."""
    lines = lines_stating(states, *proofs, answer=answer, **stated)
    path.write_bytes(gzip.compress(b"".join(line + b"\n" for line in lines), 1))
    return check_certificate(path)
