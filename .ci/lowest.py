"""Print `name==version` for the lowest version that pyproject.toml declares of each dependency."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
declared = {
    requirement
    for group in (project["dependencies"], *project["optional-dependencies"].values())
    for requirement in group
}
for requirement in sorted(declared):
    bound = re.fullmatch(r"([\w.-]+)(?:\[.*\])?>=([\d.]+).*", requirement)
    if bound:
        print(f"{bound[1]}=={bound[2]}")
