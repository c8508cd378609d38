"""Plain reference answers for small problems: enumeration, dense solves, explicit programs.

No reference imports the library; the tests beside them measure them by one another. Models are
nested dictionaries `{state: {action: [(probability, successor, cost), ...]}}` with a set of goal
states, and every number is computed in the plainest way that is still exact: all deterministic
stationary policies are enumerated, each one's Markov chain is solved by a dense linear solve, and a
budget is met by the best lottery over two of them. Where accumulated cost matters, the product with
the cost is written out and handed to `scipy.optimize.linprog`.
"""
