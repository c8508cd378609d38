"""Every formulation is a page of mathematics, in one order, with a file of its own."""

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


def test_each_has_a_file_of_its_own():
    pages = Path(formulations.__file__).parent.glob("*.py")
    assert len(CRITERIA) == len([page for page in pages if page.stem not in OTHER_PAGES])
    assert len(set(map(inspect.getmodule, CRITERIA))) == len(CRITERIA)


@pytest.mark.parametrize("criterion", CRITERIA, ids=lambda c: c.__name__)
def test_the_page_has_its_parts_in_order_and_describes_every_argument(criterion):
    headings = re.findall(r"^    (\w+):$", criterion.__doc__, flags=re.MULTILINE)
    assert tuple(h for h in headings if h in PARTS) == PARTS
    described = criterion.__doc__.split("    Args:\n")[1].split("    Returns:\n")[0]
    fields = {field.name for field in dataclasses.fields(criterion)}
    assert all(f"        {field}: " in described for field in fields)
    members = {name for name in vars(Problem) if not name.startswith("_")}
    assert members <= fields | set(dir(criterion))
