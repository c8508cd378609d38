"""The paper's robot among obstacles (section 4): `obstacle_avoidance` is the experiment."""
