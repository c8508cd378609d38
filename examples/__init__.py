"""Examples, a folder for each purpose; every script runs from the root of a checkout.

    pip install -e '.[plot]'
    python examples/quickstart/first_problem.py

| folder | what is in it |
|---|---|
| `quickstart` | a first problem in ten lines |
| `formulating` | a task of one's own, and all criteria side by side |
| `paper_robot` | the paper's experiment: a robot among obstacles |
| `paper_walkthrough` | the paper, section by section, and its game as a second opinion |
| `domains` | generators of the literature's dead-end domains, of any size |
| `solver_comparison` | the library's methods beside their peers |
| `checks` | answers against exact fractions, full linear programs and Storm |

`pip install -e` puts the checkout on Python's path, so that an example finds another as
`examples.FOLDER.MODULE`.
"""
