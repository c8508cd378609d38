"""Dead-end domains of the literature, as generators of any size.

    from examples.domains.river import river
    model, start = river(width=10, height=10)
    problem = MCMP(model, start=start, failure_budget=0.05)

| module | a run fails when | the risk buys |
|---|---|---|
| `triangle_tireworld` | a tyre is flat and no spare is at hand | the straight road |
| `rectangle_tireworld` | a diagonal move wrecks the car | fewer moves |
| `river` | the current carries the swimmer over the waterfall | no detour over the bridge |
| `navigation` | the robot disappears | fewer columns to cross |

Each of these modules has one function of the module's name, which returns a `Domain`: the model and
its start. `inventory` differs: a season's stock, a continuous world that is discretised and
simulated.
"""
