"""Public names of a package, listed once in the stub beside its ``__init__``."""

import ast
from pathlib import Path


def names_in_stub(package: str, file: str) -> dict[str, str]:
    """Return the public names of a package, each with the module that defines it.

    They are read from the package's stub, which type checkers read, too, so that one list of names
    is enough.

    Args:
        package: full name of the package.
        file: path of its ``__init__.py``; the stub ``__init__.pyi`` is beside it.
    """
    stub = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    return {
        alias.name: f"{package}.{node.module}" if node.level else str(node.module)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
