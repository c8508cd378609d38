"""Every formulation is a page of mathematics, in one order."""

import dataclasses
import inspect
import re
from pathlib import Path

import pytest

import formulations
from ssp_lp.formulation import Formulation
from ssp_lp.problem import Problem

PARTS = ("Problem", "Program", "Guarantee", "Semantics", "Reference", "Args", "Returns", "Raises",
         "Example")  # fmt: skip

OTHER_PAGES = {"__init__", "comparison"}
CLASSES = list(filter(inspect.isclass, (getattr(formulations, n) for n in formulations.__all__)))
CRITERIA = [named for named in CLASSES if issubclass(named, Formulation)]


def test_there_are_criteria():
    pages = Path(formulations.__file__).parent.glob("*.py")
    assert len(CRITERIA) == len([page for page in pages if page.stem not in OTHER_PAGES])


@pytest.mark.parametrize("criterion", CRITERIA, ids=lambda c: c.__name__)
def test_the_docstring_has_its_parts_in_order(criterion):
    headings = re.findall(r"^    (\w+):$", criterion.__doc__, flags=re.MULTILINE)
    assert tuple(h for h in headings if h in PARTS) == PARTS


@pytest.mark.parametrize("criterion", CRITERIA, ids=lambda c: c.__name__)
def test_every_argument_is_described(criterion):
    described = criterion.__doc__.split("    Args:\n")[1].split("    Returns:\n")[0]
    for field in dataclasses.fields(criterion):
        assert f"        {field.name}: " in described, field.name


@pytest.mark.parametrize("criterion", CRITERIA, ids=lambda c: c.__name__)
def test_each_is_a_problem_with_a_file_of_its_own(criterion):
    members = {name for name in vars(Problem) if not name.startswith("_")}
    fields = {field.name for field in dataclasses.fields(criterion)}
    assert members <= fields | set(dir(criterion))
    module = inspect.getmodule(criterion)
    others = [c for c in CRITERIA if c is not criterion]
    assert all(inspect.getmodule(other) is not module for other in others)
