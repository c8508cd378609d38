"""Certificate files written by hand, signed as they should be, and what is said of them."""

import gzip
import json
from hashlib import sha256

from ssp_lp import check_certificate

GOAL = {"name": "g", "sets": ["goal"], "actions": []}
DEAD = {"name": "d", "sets": [], "actions": []}
NOTHING = {"constant": "0", "terms": []}
COST = {"constant": "0", "terms": [["1", "cost", 0]]}
AWAY = {"v": "0", "members": [None]}


def state(**actions):
    return {"name": "s", "sets": [], "actions": [[name, *rest] for name, rest in actions.items()]}


def verdict(path, states, head, proof, **stated):
    """What is said of a file with this question, whose SHA-256 is right."""
    question = {
        "format": "ssp-lp certificate 1", "asked": "", "charge_failing_step": False, "costs": 1,
        "discount": None, "failure": None, "give_up": "dead_ends", "greatest": False,
        "objective": NOTHING, "rows": [], "sets": [], "start": [["1", 0]], "states": len(states),
        **stated,
    }  # fmt: skip
    lines = [json.dumps(one).encode() for one in (question, *states)]
    digest = sha256(b"\n".join(lines)).hexdigest()
    head = {"sha256": digest, "claim": ["-1e9", "1e9"], "weights": ["1"], **head}
    lines += [json.dumps(one).encode() for one in (head, *proof)]
    path.write_bytes(gzip.compress(b"\n".join(lines)))
    return check_certificate(path)
