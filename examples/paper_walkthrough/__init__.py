"""The paper's sections 2 and 3 in numbers: `walkthrough` by hand, `cross_check` on its robot."""
