"""Large arrays: kept where they can be, checked in pieces with the same errors."""

import numpy as np
import pytest

from ssp_lp import SSP, ModelError
from ssp_lp.arrays import chunks, pieces_of_chunks


@pytest.fixture(params=[1 << 22, 4, 1])
def chunk(request, monkeypatch):
    """How many entries are worked on at a time."""
    monkeypatch.setattr("ssp_lp.arrays.CHUNK", request.param)
    return request.param


def parts(n_pairs=6, spread=3):
    """Arrays of a model in which every state has one pair with equally likely outcomes."""
    n_outcomes = n_pairs * spread
    return {
        "pair_offsets": np.append(np.arange(n_pairs + 1), n_pairs),
        "outcome_offsets": np.arange(0, n_outcomes + 1, spread),
        "successors": np.arange(n_outcomes, dtype=np.int32) % (n_pairs + 1),
        "probabilities": np.full(n_outcomes, 1 / spread),
        "costs": np.arange(n_outcomes, dtype=np.float64),
        "goal_states": [n_pairs],
    }


def test_arrays_of_the_right_type_are_kept(chunk):
    given = parts(spread=4)
    model = SSP.from_arrays(**given)
    for name in ("pair_offsets", "outcome_offsets", "successors", "probabilities", "costs"):
        assert np.shares_memory(getattr(model, name), given[name]), name
        assert given[name].flags.writeable, name


def test_one_cost_for_all_takes_no_room(chunk):
    model = SSP.from_arrays(**(parts() | {"costs": 2.5}))
    assert model.costs.strides == (0,)
    assert model.costs.tolist() == [2.5] * model.n_outcomes
    for cost, complaint in [(-1.0, "negative cost"), (np.nan, "NaN"), (np.inf, "infinite cost")]:
        with pytest.raises(ModelError, match=f"action 0 of state 0 .*{complaint}"):
            SSP.from_arrays(**(parts() | {"costs": cost}))


def test_sums_that_round_are_divided_out_of_a_copy(chunk):
    given = parts(spread=3)
    given["probabilities"][3:6] = 0.1, 0.2, 0.7 + 1e-12
    before = given["probabilities"].copy()
    model = SSP.from_arrays(**given)
    assert given["probabilities"].tolist() == before.tolist()
    sums = [np.add.reduce(before[k : k + 3]) for k in range(0, 18, 3)]
    assert model.probabilities.tolist() == (before / np.repeat(sums, 3)).tolist()


def test_actions_are_numbered_within_their_state(chunk):
    given = parts()
    given["pair_offsets"] = np.array([0, 2, 2, 5, 6, 6, 6, 6])
    model = SSP.from_arrays(**given, treat_actionless_as_dead_ends=True)
    assert [model.action_of(pair) for pair in range(6)] == [0, 1, 0, 1, 2, 0]
    assert list(model.action_names) == [0, 1, 2]


@pytest.mark.parametrize(
    ("name", "faults", "complaint"),
    [
        ("successors", {10: 7, 13: -1}, "state 3 has a successor that is no state"),
        ("probabilities", {4: -0.5, 11: np.nan}, "state 3 has a probability that is NaN"),
        ("probabilities", {4: np.inf, 11: -0.5}, "state 3 has a negative probability"),
        ("probabilities", {16: np.inf}, "state 5 has an infinite probability"),
        ("probabilities", {9: 0.5, 16: 0.5}, "state 3: probabilities sum to 1.16666666667"),
        ("costs", {4: -0.5, 11: np.nan}, "state 3 has a cost that is NaN"),
        ("costs", {4: np.inf, 11: -0.5, 14: -1.0}, "state 3 has a negative cost"),
        ("costs", {2: np.inf, 11: np.inf}, "state 0 has an infinite cost"),
    ],
)
def test_rules_are_checked_in_turn_and_name_the_first_outcome(chunk, name, faults, complaint):
    given = parts()
    given[name][list(faults)] = list(faults.values())
    with pytest.raises(ModelError, match=complaint):
        SSP.from_arrays(**given)


def test_offsets_that_fall_and_pairs_without_outcomes(chunk):
    given = parts()
    given["outcome_offsets"][2:4] = 9, 6
    with pytest.raises(ModelError, match="outcome_offsets decreases at position 2"):
        SSP.from_arrays(**given)
    given["outcome_offsets"][3] = 9
    with pytest.raises(ModelError, match="state 2 has no outcomes"):
        SSP.from_arrays(**given)


def test_pieces_cover_every_segment_once(chunk):
    offsets = np.array([0, 0, 3, 3, 4, 11, 11], dtype=np.int32)
    found = list(pieces_of_chunks(offsets))
    segments = [k for piece in found for k in range(piece.segments.start, piece.segments.stop)]
    assert segments == list(range(6))
    for piece in found:
        size = piece.entries.stop - piece.entries.start
        assert size <= chunk or piece.segments.stop - piece.segments.start == 1
        assert piece.lengths.sum() == size
        begins = offsets[:-1][piece.segments] - piece.entries.start
        assert piece.firsts.tolist() == begins.tolist()
    covered = [k for some in chunks(11) for k in range(some.start, some.stop)]
    assert covered == list(range(11))
