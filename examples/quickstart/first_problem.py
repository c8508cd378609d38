"""The cheapest way home that ends in a wreck in at most 5 % of the trips.

python examples/quickstart/first_problem.py
"""

import sys

from ssp_lp import MCMP, SSP, solve

if {"-h", "--help"} & set(sys.argv):
    print(__doc__)
    sys.exit()

alley = [(0.90, "home", 4.0), (0.10, "wreck", 2.0)]  # (probability, successor, cost)
road = [(0.99, "home", 9.0), (0.01, "wreck", 5.0)]
choices = {"depot": {"alley": alley, "road": road}, "wreck": {}}
names = {"crash": ["wreck"]}
model = SSP.from_transitions(
    choices, goal={"home"}, state_labels=names, treat_actionless_as_dead_ends=True
)
solution = solve(MCMP(model, start="depot", failure_budget=0.05))
print(solution.summary())
episode = solution.policy.start(0)  # a seed: it is a lottery between the two ways
print("first action:", episode.action("depot"))
