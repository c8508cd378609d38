"""Run the README's blocks of Python in order, and see that the wheel has one top-level name."""

import re
from importlib.metadata import files
from pathlib import Path

tops = {path.parts[0] for path in files("ssp-lp") or [] if path.parts[0] not in {"..", "bin"}}
names = {top for top in tops if not top.endswith(".dist-info")}
if names != {"ssp_lp"}:
    raise SystemExit(f"the wheel installs {sorted(names)}")
readme = Path("README.md").read_text(encoding="utf-8")
namespace: dict[str, object] = {}
for block in re.findall(r"^```python\n(.*?)^```$", readme, flags=re.DOTALL | re.MULTILINE):
    exec(block, namespace)  # noqa: S102
