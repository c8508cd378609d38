"""A maze with a cliff, a safe detour, and loops that are free or paid."""

from small_models import model_of

MAZE = model_of(
    {
        "start": {
            "cliff": [(0.8, "goal", 2.0), (0.2, "pit", 1.0)],
            "road": [(0.95, "town", 3.0), (0.05, "pit", 1.0)],
            "detour": [(1.0, "town", 6.0)],
            "loop": [(1.0, "start", 1.0)],
        },
        "town": {
            "bus": [(0.5, "goal", 1.0), (0.49, "town", 1.0), (0.01, "pit", 1.0)],
            "walk": [(1.0, "goal", 5.0)],
            "rest": [(1.0, "town", 0.0)],
        },
        "pit": {"stay": [(1.0, "pit", 1.0)]},
    },
    "goal",
    {"hurt": ["pit"]},
)
