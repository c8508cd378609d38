"""The robot's transition probabilities by midpoint quadrature, as compressed arrays.

The model is a sum over points: for every cell and action, quadrature^4 combinations of a position
in the cell (x, y), a heading in the cell and a steering error, each with the same weight. Two facts
keep it small. The sampled angles form a lattice, so all (heading, action) with the same sum share
their transitions: one `_Turn`, computed once for all cells. And a motion shifts all cells alike, so
only "is this point free?" has to be asked cell by cell. The work goes turn by turn, so the scratch
memory is that of one turn, a small fraction of the model.

A heading exactly between two cells gives half its weight to each. Such headings are common (a
quarter of all samples at the default), and giving them to one side would make the robot drift; the
rule moves the cost at least failure, 25.3 steps, by up to 0.2.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from examples.paper_robot.arena import TOLERANCE, BoolArray, FloatArray, Place, PlaceArray
from examples.paper_robot.grid import N_ACTIONS, STEP_LENGTH, IntArray, RobotGrid
from examples.paper_robot.progress_bar import Progress

CountArray = npt.NDArray[np.int32]
_Users = list[tuple[int, int]]  # (heading, action)


@dataclass(frozen=True)
class GridArrays:
    """The transitions of the robot's grid model; costs are not part of them."""

    pair_offsets: IntArray  # [states + 1]
    outcome_offsets: IntArray  # [pairs + 1]
    successors: CountArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]

    @property
    def n_pairs(self) -> int:
        """The number of state-action pairs."""
        return len(self.outcome_offsets) - 1


@dataclass(frozen=True)
class _Turn:
    """What one total turn (heading + action) does, for every position cell."""

    lengths: IntArray  # [columns * rows]: distinct successors
    successors: CountArray  # [sum of lengths], ascending within a cell
    weights: CountArray  # [sum of lengths]: doubled counts of points


def grid_arrays(grid: RobotGrid, progress: Progress | None = None) -> GridArrays:
    """Return the transitions of the grid model.

    Pairs 5 s .. 5 s + 4 belong to cell s; the goal has none; obstacle and wall stay where they are
    by one pair each. Within a pair the successors are distinct and ascend, and the probabilities
    are exact counts of points over quadrature^4 (half counts where a heading is split).

    progress: called with the number of turns gone through and their total. Each is gone through
        twice: to count its successors, and to write them where they belong.
    """
    n_cell_pairs = N_ACTIONS * grid.n_cells
    outcome_offsets = _outcome_offsets(grid, _turns(grid, 0, progress))
    begins = outcome_offsets[:n_cell_pairs].reshape(-1, grid.headings, N_ACTIONS)
    successors = np.empty(outcome_offsets[-1], dtype=np.int32)
    probabilities = np.empty(outcome_offsets[-1])
    for turn, users in _turns(grid, 1, progress):
        _write(turn, [begins[:, h, a] for h, a in users], successors, probabilities)
    probabilities /= 2 * grid.quadrature**4
    successors[-2:] = grid.end_state(Place.OBSTACLE), grid.end_state(Place.WALL)
    probabilities[-2:] = 1.0
    pair_offsets = np.append(np.arange(0, n_cell_pairs + 1, N_ACTIONS), n_cell_pairs + np.arange(3))
    return GridArrays(pair_offsets, outcome_offsets, successors, probabilities)


def _outcome_offsets(grid: RobotGrid, turns: Iterable[tuple[_Turn, _Users]]) -> IntArray:
    """Where the outcomes of each pair begin, and end: [pairs + 1]."""
    n_cell_pairs = N_ACTIONS * grid.n_cells
    offsets = np.zeros(n_cell_pairs + 3, dtype=np.int64)
    lengths = offsets[1 : n_cell_pairs + 1].reshape(-1, grid.headings, N_ACTIONS)
    for turn, users in turns:
        for heading, action in users:
            lengths[:, heading, action] = turn.lengths
    offsets[-2:] = 1  # obstacle and wall
    return np.cumsum(offsets, out=offsets)


def _write(
    turn: _Turn, begins: list[IntArray], successors: CountArray, weights: FloatArray
) -> None:
    """Write a turn's outcomes to each of its places: the offsets of its pairs, [cells] each."""
    firsts = np.cumsum(turn.lengths) - turn.lengths
    within = np.arange(len(turn.successors)) - np.repeat(firsts, turn.lengths)
    for begin in begins:
        places = np.repeat(begin, turn.lengths) + within
        successors[places] = turn.successors
        weights[places] = turn.weights


def _turns(
    grid: RobotGrid, rounds: int, progress: Progress | None
) -> Iterator[tuple[_Turn, _Users]]:
    """Yield each distinct turn, and tell after each how many are done in two rounds of them.

    rounds: how many rounds were made before.
    """
    users = _users(grid)
    for done, (centre, pairs) in enumerate(users.items(), rounds * len(users) + 1):
        yield _turn(grid, centre), pairs
        if progress is not None:
            progress(done, 2 * len(users))


def _users(grid: RobotGrid) -> dict[int, _Users]:
    """Return each distinct total turn with the (heading, action) pairs that make it."""
    full_circle = 24 * grid.quadrature * grid.headings
    users: dict[int, _Users] = {}
    for heading in range(grid.headings):
        for action in range(N_ACTIONS):
            turned = 2 * grid.quadrature * (12 * heading + grid.headings * (action - 2))
            users.setdefault(turned % full_circle, []).append((heading, action))
    return users


def _turn(grid: RobotGrid, centre: int) -> _Turn:
    """Count where the sampled points of the cells go when the new heading is about `centre`."""
    n_places = grid.segments**2
    ends = {place: np.zeros(n_places, dtype=np.int32) for place in list(Place)[1:]}
    moves: dict[tuple[int, int, int], CountArray] = {}
    for angle, repeats in _angles(grid, centre):
        place, shifts = _motion(grid, angle)
        for end, count in ends.items():
            count += 2 * repeats * _tally(place == end)
        free = place == Place.FREE
        for across, some in _groups(shifts[0]):
            for up, others in _groups(shifts[1]):
                count = repeats * _tally(free[some, others])
                for heading in _nearest_headings(grid, angle):
                    key = across, up, heading
                    moves[key] = moves.get(key, 0) + count
    order = sorted(moves)
    offsets = np.array([(a * grid.segments + u) * grid.headings + h for a, u, h in order])
    weights = np.stack([*(moves[key] for key in order), *ends.values()], axis=-1)
    where = np.empty(weights.shape, dtype=np.int32)
    where[..., : len(order)] = np.arange(n_places)[:, None] * grid.headings + offsets
    where[..., len(order) :] = [grid.end_state(place) for place in ends]
    used = weights > 0
    return _Turn(used.sum(axis=-1), where[used], weights[used])


def _tally(hits: BoolArray) -> CountArray:
    """Count the sampled points that hit, for each cell: [points, points, columns, rows]."""
    return np.sum(hits, axis=(0, 1), dtype=np.int32).ravel()


def _angles(grid: RobotGrid, centre: int) -> list[tuple[int, int]]:
    """Return the distinct new headings about `centre`, in angle units, with their multiplicity."""
    spread = 12 * grid.midpoints[:, None] + grid.headings * grid.midpoints[None, :]
    angles, repeats = np.unique(centre + spread, return_counts=True)
    return list(zip(angles.tolist(), repeats.tolist(), strict=True))


def _motion(grid: RobotGrid, angle: int) -> tuple[PlaceArray, tuple[IntArray, IntArray]]:
    """Move every sampled position of the cells by one step along a heading.

    Returns the places reached, [points of x, points of y, columns, rows], and the numbers of cells
    by which the points are shifted in x and in y, [points] each.
    """
    width = grid.arena.side / grid.segments
    within = (np.arange(grid.quadrature) + 0.5) / grid.quadrature
    points = (np.arange(grid.segments) + within[:, None]) * width
    x, y = points[:, None, :, None], points[None, :, None, :]
    across = np.float64(STEP_LENGTH * np.cos(angle * grid.angle_unit))
    up = np.float64(STEP_LENGTH * np.sin(angle * grid.angle_unit))
    if grid.along_segment:
        place, _ = grid.arena.first_contact(x, y, np.asarray(across), np.asarray(up))
    else:
        place = grid.arena.classify(x + across, y + up)
    cells_x = np.floor(within + across / width + TOLERANCE).astype(np.int64)
    cells_y = np.floor(within + up / width + TOLERANCE).astype(np.int64)
    return place, (cells_x, cells_y)


def _groups(shifts: IntArray) -> list[tuple[int, slice]]:
    """Return each distinct shift and the slice of points that have it; the shifts ascend."""
    values, firsts = np.unique(shifts, return_index=True)
    bounds = [*firsts.tolist(), len(shifts)]
    return [(int(v), slice(bounds[k], bounds[k + 1])) for k, v in enumerate(values)]


def _nearest_headings(grid: RobotGrid, angle: int) -> tuple[int, int]:
    """Return the heading cell of an angle, twice; two different ones if it lies between them."""
    cell = 24 * grid.quadrature
    below = -((cell // 2 - angle) // cell)  # ceiling of angle / cell - 1 / 2
    above = (angle + cell // 2) // cell  # floor of angle / cell + 1 / 2
    return below % grid.headings, above % grid.headings
