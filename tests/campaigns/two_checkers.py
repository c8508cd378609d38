"""The checker in C and the checker in Python on the same files, true, changed and damaged.

    python tests/campaigns/two_checkers.py --count 1000 --seed 0 --changes 6 --damages 6

Problems, and changes of a certificate's content, are those of `certificate_check.py`; damages of
its text those of `damaged_files.py`. The checker in C is compiled with the sanitizers of addresses
and of undefined behaviour, which must have nothing to say. What it accepts checker.py must accept,
with the same interval to the last digit, and what it refuses checker.py must refuse: but for files
that are written in a way in which `write_certificate` writes none, which are counted by its words.
"""

import argparse
import gzip
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from ssp_lp import SSPError, solve
from ssp_lp.verification import checker
from ssp_lp.verification.certificate_file import write_certificate
from tests.campaigns.certificate_check import Lines, case_of, changed, lines_of, question, signed
from tests.campaigns.damaged_files import mutated

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang") or ""
STRICT = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-O1"]
SANITIZED = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
LIBRARIES = ["-lgmp", "-lz", "-lcrypto"]
HEADERS = "#include <gmp.h>\n#include <openssl/evp.h>\n#include <zlib.h>\nint main(void) {}\n"
OPTIONS = {"ASAN_OPTIONS": "detect_leaks=0"}  # what is in use to the end is no leak
SECONDS = 60  # that a file is given
WRITTEN_OTHERWISE = (
    "printable ASCII", "escaped", "it is empty", "no number ends in", "no whole number",
    "is no value", "is no text", '"after_failing" is not known', ' through"',
)  # fmt: skip
"""Words of the checker in C for files that differ in their writing alone, and what it leaves."""


def build(folder: Path, flags: Sequence[str] = ()) -> Path:
    """Compile the checker in C.

    Raises:
        FileNotFoundError: there is no compiler, or headers of its libraries are missing.
    """
    if not COMPILER:
        raise FileNotFoundError("there is no compiler of C")
    (folder / "headers.c").write_text(HEADERS)
    command = [COMPILER, *STRICT, *flags, "-o", str(folder / "check")]
    if subprocess.run([*command, folder / "headers.c", *LIBRARIES], capture_output=True).returncode:  # noqa: S603
        raise FileNotFoundError("C lacks libraries or headers: libgmp-dev, zlib1g-dev, libssl-dev")
    source = Path(checker.__file__).with_suffix(".c")
    subprocess.run([*command, source, *LIBRARIES], check=True)  # noqa: S603
    return folder / "check"


def difference(program: Path, path: Path) -> str:
    """What the two checkers say differently of a file; nothing if they agree.

    Returns:
        Words that begin with "stricter:" where the checker in C alone refuses it.
    """
    done = subprocess.run(  # noqa: S603
        [program, path], capture_output=True, text=True, timeout=SECONDS, check=False, env=OPTIONS
    )
    words, checked = done.stdout, checker.check_certificate(path)
    if done.stderr or done.returncode not in (0, 1):
        return f"it ends with {done.returncode}: {done.stderr}"
    if done.returncode == 1:
        return f"stricter: {words.strip()}" if checked.accepted else ""
    if not checked.accepted:
        return f"accepted, but checker.py says: {checked.reason}"
    ends = [Fraction(end) for end in re.findall(r"at (?:least|most) .* = (\S+)", words)]
    exceeded = re.findall(r"exceeds row (.*) by (\S+)", words)
    same = ends == [checked.lower, checked.upper] and checked.digest in words
    same &= {row: Fraction(excess) for row, excess in exceeded} == checked.exceeded
    return "" if same else f"another verdict: {words}\n{checked}"


def files(lines: Lines, rng: np.random.Generator, changes: int, damages: int) -> Iterator[Lines]:
    """A file, and files made of it: with changed contents, and with damaged texts."""
    yield lines
    lines = signed(lines)
    for _ in range(changes):
        found = lines
        for _ in range(int(rng.integers(1, 3))):
            try:
                found = changed(found, rng)[1]
                found = signed(found) if rng.random() < 0.9 else found
            except (ValueError, KeyError, IndexError, TypeError, AttributeError):
                break  # lines were exchanged, and a second change finds no place
        yield found
    for _ in range(damages):
        found = mutated(b"\n".join(lines), rng).split(b"\n")
        try:
            yield signed(found)
        except (ValueError, KeyError, IndexError, TypeError, AttributeError):
            yield found


def check(
    seed: int, program: Path, changes: int, damages: int, tally: Counter[str], keep: Path
) -> Iterator[str]:
    """Files of one problem; yield where the checkers differ, and keep such files in a folder."""
    problem, _ = question(case_of(seed))
    path = keep / "one.cert"
    try:
        write_certificate(solve(problem), path)
    except SSPError as error:
        tally[f"no certificate: {type(error).__name__}"] += 1
        return
    rng = np.random.default_rng([seed, 2801])
    for number, lines in enumerate(files(lines_of(path), rng, changes, damages)):
        path.write_bytes(gzip.compress(b"\n".join(lines), 1))
        said = difference(program, path)
        if said.startswith("stricter") and any(words in said for words in WRITTEN_OTHERWISE):
            tally["refused for how it is written"] += 1
        elif said:
            shutil.copy(path, keep / f"{seed}-{number}.cert")
            yield f"file {number}: {said}"
        else:
            tally["agreed"] += 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the checkers from the command line; 1 if they differ anywhere."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100, help="of problems")
    parser.add_argument("--seed", type=int, default=0, help="of the first one")
    parser.add_argument("--changes", type=int, default=6, help="of the content of each file")
    parser.add_argument("--damages", type=int, default=6, help="of the text of each file")
    options = parser.parse_args(arguments)
    tally, found = Counter[str](), 0
    keep = Path(tempfile.mkdtemp(prefix="two-checkers-"))
    program = build(keep, SANITIZED)
    for seed in range(options.seed, options.seed + options.count):
        for said in check(seed, program, options.changes, options.damages, tally, keep):
            print(f"seed {seed}, {said}", flush=True)
            found += 1
    for name, count in sorted(tally.items()):
        print(f"{name:<60} {count:,}")
    print("they agree" if not found else f"{found} findings, kept in {keep}")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
