"""The policies of `played` by name, solved once, and where they start."""

from functools import cache

from played import START, ferry, hall, level_policy, policies, remembering, task


@cache
def made():
    """Policies of every class on the hall, of the ferry's levels, and with a task's memory."""
    others = {"levels": level_policy(ferry()), "remembering": remembering(task(hall()))}
    return policies(hall()) | others


EVERY = sorted(made())


def start_of(name):
    return "quay" if name == "levels" else START
