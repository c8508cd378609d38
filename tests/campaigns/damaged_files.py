"""Files with small damages, thousands of each format: each must be read, or refused by name.

    python tests/campaigns/damaged_files.py --formats json drn --count 10000
    python tests/campaigns/damaged_files.py --formats prism --count 10000

A file that raises anything but an SSPError, ends the process that reads it, or takes more memory
than a reader may is told with its number, and the least of it of which the same is said; `--seed
NUMBER --count 1 --keep FOLDER` makes it again. What is written in a modelling language may describe
a model of any size: such files are read under the same limits by Storm, and those that run into
them are counted apart. Damaged JANI files may end the process in Storm's own parser: they are
checked where they are named alone.

Certificates (`--formats s3p.cert quantile.cert` and others) and UMB archives are damaged before
they are compressed: each certificate is refused by the checker, or proves an interval that holds
the optimum still.
"""

import argparse
import gzip
import multiprocessing
import resource
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from formulations import EGUBS, MCMP, S3P, CostBoundedReach, CostQuantile
from ssp_lp import SSP, SSPError, check_certificate, solve, write_certificate
from ssp_lp.io import read_any, write_any
from tests.campaigns.campaign import smallest

LONGEST = 10  # seconds that a file is given
ROUNDED = 1e-9  # of an optimum
MOST_MEMORY = 3 << 30  # bytes of a reading process, of which Python and its libraries take 1 GiB
READ, REFUSED = "read", "refused by name"
LARGE = ("too long", "refused for memory")

MODEL = SSP.from_transitions(
    {
        "depot": {
            "alley": [(0.90, "home", 4.0), (0.10, "wreck", 2.0)],
            "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
        },
        "wreck": {},
    },
    goal={"home"},
    state_labels={"crash": ["wreck"], "a place": ["depot"]},
    treat_actionless_as_dead_ends=True,
)

NESTED = """{"depot": {"alley": [[0.9, "home", 4], [0.1, "wreck", 2.5]], "road": [[1, "home", 9]]},
 "wreck": {}, "7": {"on": [[1, 7, 0], [0, "home", 1e-3]]}}
"""

EXPLICIT = """{"format": "explicit-mdp-v1", "init": 0, "goal": [1],
 "labels": {"pit": [2], "init": [0]},
 "choices": [[{"name": "a", "to": [[1, "9/10"], [2, "1/10"]], "rewards": {"time": "1/3"}},
   {"name": "a", "to": [[1, "1"]], "rewards": {"time": "9"}}],
  [{"name": "", "to": [[1, "1"]], "rewards": {}}], []]}
"""

PROGRAM = """mdp
const int N = 5;
const double p = 0.1;
formula last = x = N;
module walker
    x : [0..N] init 0;
    broken : bool init false;
    k : [0..3] init 0;
    [go] x < N & !broken -> 1 - p : (x' = x + 1) + p : (broken' = true);
    [walk] !last & !broken & k < 3 -> (x' = min(x + 1, N)) & (k' = k + 1);
    [] last -> true;
endmodule
module other = walker [x = y, broken = torn, k = l] endmodule
rewards "time"
    [go] true : 1;
    [walk] true : 3;
    x = 1 : 0.1;
endrewards
label "done" = x = N & y = N;
"""

JANI = """{"jani-version": 1, "name": "walker", "type": "mdp", "actions": [{"name": "go"}],
 "constants": [{"name": "p", "type": "real", "value": 0.25}],
 "variables": [{"name": "x", "type": {"kind": "bounded", "base": "int", "lower-bound": 0,
   "upper-bound": 3}, "initial-value": 0},
  {"name": "toll", "type": "real", "transient": true, "initial-value": 0},
  {"name": "done", "type": "bool", "transient": true, "initial-value": false}],
 "properties": [],
 "automata": [{"name": "a", "initial-locations": ["l"], "locations": [{"name": "l",
   "transient-values": [{"ref": "done", "value": {"op": "=", "left": "x", "right": 3}}]}],
  "edges": [{"location": "l", "action": "go",
   "guard": {"exp": {"op": "<", "left": "x", "right": 3}},
   "assignments": [{"ref": "toll", "value": 5}],
   "destinations": [{"location": "l",
     "probability": {"exp": {"op": "-", "left": 1, "right": "p"}},
     "assignments": [{"ref": "x", "value": {"op": "+", "left": "x", "right": 1}}]},
    {"location": "l", "probability": {"exp": "p"}}]}]}],
 "system": {"elements": [{"automaton": "a"}], "syncs": [{"synchronise": ["go"],
   "result": "go"}]}}
"""

GOALS: dict[str, tuple[str, ...]] = {
    "json": (),
    "json.gz": (),
    "npz": (),
    "nested.json": ("home",),
    "explicit.json": (),
    "prism": ("done",),
    "jani": ("done",),
}
"""What each format is asked for; "goal" if nothing is said."""

CERTIFIED: dict[str, Any] = {
    "mcmp.cert": MCMP(MODEL, "depot", 0.05),
    "s3p.cert": S3P(MODEL, "depot", 0.05),
    "within.cert": CostBoundedReach(MODEL, "depot", 5, 0.05),
    "quantile.cert": CostQuantile(MODEL, "depot", 0.9, 0.05),
    "utility.cert": EGUBS(MODEL, "depot", -0.3, 1.0),
}
"""Problems of which certificates are damaged."""

TEXTS = {"explicit.json": EXPLICIT, "nested.json": NESTED, "prism": PROGRAM, "jani": JANI}
FORMATS = (*TEXTS, *CERTIFIED, "json", "json.gz", "drn", "drn.gz", "npz", "umb")
SOUND = tuple(ending for ending in FORMATS if ending != "jani")
PACKED = (*CERTIFIED, "umb")


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """One small damage: bytes changed, cut, doubled, or a number made large."""
    kind, at = int(rng.integers(5)), int(rng.integers(len(content)))
    if kind == 0:
        return content[:at] + bytes([int(rng.integers(256))]) + content[at + 1 :]
    if kind == 1:
        return content[:at]
    if kind == 2:
        return content[:at] + content[at + int(rng.integers(1, 20)) :]
    if kind == 3:
        return content[:at] + b"99999999999" + content[at:]
    return content[:at] + content[max(0, at - 30) :]


def sound_files(ending: str, folder: Path) -> list[Path]:
    """Write a sound file of a format, and what stands beside it."""
    path = folder / f"m.{ending}"
    if ending in TEXTS:
        path.write_text(TEXTS[ending], encoding="utf-8")
    elif ending in CERTIFIED:
        write_certificate(solve(CERTIFIED[ending]), path)
    else:
        write_any(MODEL, path, "depot")
    return sorted(folder.iterdir())


@cache
def certified(ending: str) -> float:
    """The optimum that certificates of this name prove."""
    return float(solve(CERTIFIED[ending]).objective)


def verdict(ending: str, path: Path) -> str:
    """Read a file; what came of it."""
    if ending in CERTIFIED:
        checked, known = check_certificate(path), certified(ending)
        is_true = float(checked.lower) - ROUNDED <= known <= float(checked.upper) + ROUNDED
        return REFUSED if not checked.accepted else READ if is_true else "it lies"
    try:
        read_any(path, GOALS.get(ending, ("goal",)))
    except SSPError as error:
        return LARGE[1] if "bad_alloc" in str(error) else REFUSED
    except MemoryError:
        return "out of memory"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return READ


def damaged(ending: str, folder: Path, numbers: Sequence[int]) -> Iterator[tuple[int, Path]]:
    """Put one damaged file after the other into a folder, in the place of a sound one."""
    files = sound_files(ending, folder)
    sound = {file: file.read_bytes() for file in files}
    if (said := verdict(ending, folder / f"m.{ending}")) != READ:
        raise RuntimeError(f"the sound file of {ending} is {said}")
    for number in numbers:
        rng = np.random.default_rng(number)
        broken = files[int(rng.integers(len(files)))]
        content, is_packed = sound[broken], ending in PACKED
        content = mutated(gzip.decompress(content) if is_packed else content, rng)
        broken.write_bytes(gzip.compress(content) if is_packed else content)
        yield number, broken
        broken.write_bytes(sound[broken])


def read_damaged(ending: str, first: int, count: int, keep: Path | None, told: Connection) -> None:
    """Read the damaged files of some numbers, and tell what came of each."""
    with tempfile.TemporaryDirectory() as name:
        for number, broken in damaged(ending, Path(name), range(first, first + count)):
            if keep is not None:
                (keep / f"{number}.{broken.name}").write_bytes(broken.read_bytes())
            read_file(ending, Path(name), told)


def read_file(ending: str, folder: Path, told: Connection) -> None:
    """Read a file within limits of time and memory, and tell what came of it."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    signal.alarm(LONGEST)
    said = verdict(ending, folder / f"m.{ending}")
    signal.alarm(0)
    told.send((said, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))


def told_apart(read: Callable[..., None], *asked: Any) -> Iterator[tuple[str, int]]:
    """What a process of its own tells of files, and the memory it took; its end, if it is ended."""
    heard, told = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=read, args=(*asked, told))
    process.start()
    told.close()
    while True:
        try:
            yield heard.recv()
        except EOFError:
            process.join()
            if process.exitcode:
                late = process.exitcode == -signal.SIGALRM
                yield LARGE[0] if late else f"the process ended, code {process.exitcode}", 0
            return


def check(ending: str, first: int, count: int, keep: Path | None = None) -> Counter[str]:
    """Read damaged files of one format in a process of their own.

    Returns:
        How often each verdict was given; findings are printed.
    """
    found, peak, number, end = Counter[str](), 0, first, first + count
    while number < end:  # where a process is ended, another goes on with the next file
        for said, size in told_apart(read_damaged, ending, number, end - number, keep):
            peak = max(peak, size)
            found[said] += 1
            if said not in (READ, REFUSED, *LARGE):
                print(f"{ending}, number {number}: {said}", flush=True)
                print(f"the least of it: {shrunk(ending, number)!r}", flush=True)
            number += 1
    counts = ", ".join(f"{name} {times:,}" for name, times in found.most_common())
    print(f"{ending:<12} {counts}; peak memory {peak >> 10:,} MiB", flush=True)
    return found


def shorter(content: bytes) -> Iterator[bytes]:
    """The same without a stretch, long ones first."""
    size = len(content) // 2
    while size:
        yield from (content[:at] + content[at + size :] for at in range(0, len(content), size))
        size //= 2


def shrunk(ending: str, number: int) -> bytes:
    """The least of a damaged file of which the same is said, but for what it names."""
    packed = ending in PACKED
    with tempfile.TemporaryDirectory() as name:

        def kind(content: bytes) -> str:
            broken.write_bytes(gzip.compress(content) if packed else content)
            ((said, _),) = told_apart(read_file, ending, Path(name))
            return str(said).partition(":")[0]

        _, broken = next(damaged(ending, Path(name), [number]))
        content = broken.read_bytes()
        content = gzip.decompress(content) if packed else content
        wrong = kind(content)
        return smallest(content, shorter, lambda case: kind(case) == wrong)


def main(arguments: Sequence[str] | None = None) -> int:
    """Check formats from the command line; 1 if anything was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=SOUND)
    parser.add_argument("--count", type=int, default=1000, help="of each format")
    parser.add_argument("--seed", type=int, default=0, help="the number of the first file")
    parser.add_argument("--keep", type=Path, help="a folder for the damaged files")
    options = parser.parse_args(arguments)
    allowed = {READ, REFUSED, *LARGE}
    counts = [check(e, options.seed, options.count, options.keep) for e in options.formats]
    return int(any(set(found) - allowed for found in counts))


if __name__ == "__main__":
    sys.exit(main())
